"""Steps of many states at once in NumPy, by the scalar program of the step: nothing is compiled, and no engine is asked."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from dirax.engines.first_sizes import FAR, NOTHING, TYPICAL
from dirax.engines.following import FOLLOWED, followed
from dirax.engines.stage_look import TERMS, stage_look
from dirax.engines.step_program import KEPT, StepProgram, step_program
from dirax.engines.stopping import CONTRACTING, FLOOR, OWN, STALLED
from dirax.numerics.equilibration import balanced_inverse, balancing_scales, condition_number, largest_of_few
from dirax.numerics.inverses import Inverses, applied, applied_sizes, inverted, no_inverses, unknown
from dirax.numerics.tolerances import SMALLEST
from dirax.program.evaluation.in_numpy import LANES, Slopes, Values
from dirax.program.evaluation.noise import Noise
from dirax.program.evaluation.read_again import ReadAgain
from dirax.program.graph import GraphTooLarge
from dirax.program.interpreter import UnsupportedPrimitive
from dirax.program.memo import Memo, Same
from dirax.schemes.step import StepEquation, StepSequence, needs_every_part

UPDATES = 80
"""Updates of Newton's method after which a step has no solution; every other one may be taken back."""

ARRIVALS = 3 * [(True, False)] + 3 * [(True, True)] + 5 * [(False, True)]
"""Updates of unknowns that shall lead to a given state: whether by its entries, and whether by the equations of the step."""

SINGULAR = 1e-10
"""Relative singular values that count as zero in them."""


@dataclass
class Near:
    """By what the equations of steps are solved, of each stage: the inverses of its Jacobians near the solutions, where they are
    known, and the sizes (states, k) of what its unknowns are made of. Steps leave here what they found, and begin with what is
    here."""

    inverses: list[Inverses]
    sizes: list[np.ndarray]

    def __getitem__(self, some: Any) -> "Near":
        return Near([a[some] for a in self.inverses], [a[some] for a in self.sizes])

    def put(self, some: np.ndarray, others: "Near") -> None:
        """Take those of others in place of some."""
        for own, other in ((self.inverses, others.inverses), (self.sizes, others.sizes)):
            for array, values in zip(own, other, strict=True):
                array[some] = values


@dataclass
class Attempts:
    """Steps that were tried from as many states: unknowns and first state of each stage, the states after the step, and which
    steps have a solution. Every array has an axis of the states in front."""

    unknowns: list[np.ndarray]
    states: list[np.ndarray]
    after: np.ndarray
    good: np.ndarray

    def __getitem__(self, some: Any) -> "Attempts":
        return Attempts([u[some] for u in self.unknowns], [a[some] for a in self.states], self.after[some], self.good[some])

    def put(self, some: np.ndarray, others: "Attempts") -> None:
        """Take other attempts in place of some."""
        for own, other in ((self.unknowns, others.unknowns), (self.states, others.states)):
            for array, values in zip(own, other, strict=True):
                array[some] = values
        self.after[some], self.good[some] = others.after, others.good


@dataclass(eq=False)
class StepsInNumbers:
    """The steps of an equation as functions of arrays with an axis of states in front; `params` (states, numbers) in all."""

    equation: Any
    """A StepEquation or a StepSequence; None where no rows are asked for."""
    program: StepProgram
    _depends: list[set[int]] = field(init=False)
    _reads: ReadAgain = field(init=False)
    _slopes: dict[tuple[int, ...], Slopes] = field(init=False, default_factory=dict)

    def __post_init__(self):
        if self.program.is_swept:  # with its derivatives the graph has all its nodes
            _ = [self._plan(e.residual, e.unknowns) for e in self.program.equations]
        else:
            _ = self.program.jacobians
        self._reads = ReadAgain(self.program.graph)
        self._depends = [self._moving(e.unknowns) for e in self.program.equations]

    @classmethod
    def of(cls, equation: StepEquation | StepSequence, params: Any, batch_params: bool) -> "StepsInNumbers":
        """Made once for an equation. Raises `UnsupportedPrimitive` for a step that is no scalar program, `GraphTooLarge` for too
        large a Jacobian."""
        return cls.of_program(step_program(equation, params, batch_params), equation)

    @classmethod
    def found(cls, equation: StepEquation | StepSequence, params: Any, batch_params: bool) -> "StepsInNumbers | None":
        """The same; None for a step that is no scalar program, or has too large a Jacobian."""
        try:
            return cls.of(equation, params, batch_params)
        except (UnsupportedPrimitive, GraphTooLarge):
            return None

    @classmethod
    def of_program(cls, program: StepProgram, equation: StepEquation | StepSequence | None = None) -> "StepsInNumbers":
        """The same, made once for a program."""
        return _made.get((Same(equation), Same(program)), lambda: cls(equation, program))

    def operations(self, states: int = 1, call: int = 1) -> int:
        """About how many scalar operations a step of so many states takes: its functions a few times, and a matrix or two
        inverted. A function takes as long as of `call` states, at least."""
        total, nodes = 0, len(self.program.graph)
        for index, _ in self.program.stages:
            e = self.program.equations[index]
            k, swept = len(e.unknowns), self._plan(e.residual, e.unknowns).size if self.program.is_swept else 0
            total += max(states, call) * nodes + states * (k**3 + k * swept)
        return 4 * total

    def parameters(self, params: Any, batch: int | None, lanes: np.ndarray) -> np.ndarray:
        """The numbers of `params` of these trajectories, (states, numbers); `batch` is None for params that all of them share."""
        numbers = self.program.parameters.flatten(params, batch)
        return np.broadcast_to(numbers, (len(lanes), len(numbers))) if batch is None else numbers[lanes]

    def nothing_near(self, states: int) -> Near:
        """Nothing known of so many steps."""
        sizes = [len(self.program.equations[index].unknowns) for index, _ in self.program.stages]
        return Near([no_inverses(states, k) for k in sizes], [np.zeros((states, k)) for k in sizes])

    def step(
        self,
        states: np.ndarray,
        guesses: Sequence[np.ndarray],
        t: np.ndarray,
        h: float | np.ndarray,
        params: np.ndarray,
        noise: Noise | None = None,
        near: Near | None = None,
        follow: bool = True,
        alone: bool = False,
        far: bool = False,
    ) -> Attempts:
        """A step of each state (states, s), with one guess (states, k) a stage; h is one number, or one a state. `follow`: a
        solution that Newton's method does not find is followed from a short step on, and where it is `far`, from equations that
        the guess solves. `alone`: no bit depends on other states."""
        parts, h = [], np.broadcast_to(h, t.shape)
        for low in range(0, max(len(states), 1), LANES):
            some = slice(low, low + LANES)
            here = self.nothing_near(len(states[some])) if near is None else near[some]
            at = states[some], [g[some] for g in guesses], t[some], h[some], params[some]
            parts.append(self._step(*at, noise, here, follow, alone, far))
        join = np.concatenate
        return Attempts(
            [join(a) for a in zip(*(p.unknowns for p in parts), strict=True)],
            [join(a) for a in zip(*(p.states for p in parts), strict=True)],
            join([p.after for p in parts]),
            join([p.good for p in parts]),
        )

    @np.errstate(all="ignore")
    def _step(self, states, guesses, t, h, params, noise, near: Near, follow: bool, alone: bool, far: bool) -> Attempts:
        unknowns, begun, good = [], [], np.ones(len(states), bool)
        for stage, ((index, fraction), guess) in enumerate(zip(self.program.stages, guesses, strict=True)):
            e, at = self.program.equations[index], (t, fraction * h, params)
            u, solved = self._solved(stage, guess, states, at, noise, near, follow, alone, far)
            known = self._values(index, u, states, at, noise)
            begun.append(states)
            unknowns.append(u)
            states, t, good = self._read(known, e.advance), t + fraction * h, good & solved
        return Attempts(unknowns, begun, states, good & np.all(np.isfinite(states), axis=1))

    def taken(self, state: np.ndarray, u: np.ndarray, t: np.ndarray, h: float, params: np.ndarray) -> Attempts:
        """The steps of one stage with these unknowns, which nothing solves."""
        known = self._values(self.program.stages[0][0], u, state, (t, np.full(len(t), h), params))
        after = self._read(known, self.program.equations[self.program.stages[0][0]].advance)
        return Attempts([u], [state], after, np.all(np.isfinite(after), axis=1))

    @np.errstate(all="ignore")
    def leading_to(
        self, states: np.ndarray, guess: np.ndarray, wanted: dict[int, np.ndarray], t: np.ndarray, h: float, params: np.ndarray
    ) -> Attempts:
        """Steps of one part whose unknowns, near a guess, lead to the `wanted` entries of the state after it: by the method of
        Gauss and Newton of these entries alone, of the step's equations too, and then by Newton's of the equations alone."""
        index, u, after = self.program.stages[0][0], guess.copy(), np.stack(list(wanted.values()), axis=1)
        e, at = self.program.equations[index], (t, np.full(len(t), h), params)
        moved = np.full(len(t), np.inf)
        for of_entries, of_equations in ARRIVALS:
            known = self._values(index, u, states, at)
            nodes = [*(e.advance[i] for i in wanted if of_entries), *(e.residual if of_equations else ())]
            slopes, missed = self._slopes_of(known, nodes, e.unknowns), self._read(known, nodes)
            missed[:, : len(nodes) - len(e.residual) * of_equations] -= after[:, : len(wanted) * of_entries]
            good = np.all(np.isfinite(slopes), axis=(1, 2)) & np.all(np.isfinite(missed), axis=1)
            rows, columns = balancing_scales(np.abs(slopes[good]))
            inverses = np.linalg.pinv(slopes[good] / rows / columns, rcond=SINGULAR) / np.swapaxes(columns, 1, 2)
            inverses, change = inverses / np.swapaxes(rows, 1, 2), np.full_like(u, np.nan)
            change[good] = np.einsum("nij,nj->ni", inverses, missed[good])
            u -= change
            if not of_entries and np.any(good):
                size = np.einsum("nij,nj->ni", np.abs(inverses), self._terms(0, u[good], states[good], *(a[good] for a in at)))
                moved[good] = _largest_ratio(change[good], np.maximum(np.abs(u[good]), size))
        made = self.taken(states, u, t, h, params)
        return replace(made, good=made.good & (moved < STALLED))

    def sizes(
        self, states: np.ndarray, guesses: Sequence[np.ndarray], t: np.ndarray, h: float, params: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """The sizes (states,) of the terms of a step's equations at their solutions, however they cancel, the largest of all its
        parts: what a rounding of each operation and of each unknown does to a residual; and of those that they give the unknowns,
        |∂r/∂u|⁻¹ terms. NaN where there is no solution."""
        near, seen = self.nothing_near(len(t)), set()
        made = self.step(states, guesses, t, h, params, near=near)
        of_equations, of_unknowns = np.zeros(len(t)), np.zeros(len(t))
        for stage, ((index, fraction), u, state) in enumerate(zip(self.program.stages, made.unknowns, made.states, strict=True)):
            if u.shape[1] and (index, fraction) not in seen:  # parts of the same length have terms of the same size
                seen.add((index, fraction))
                terms = self._terms(stage, u, state, t, np.full(len(t), fraction * h), params)
                of_equations = np.maximum(of_equations, np.max(terms, axis=1))
                of_unknowns = np.maximum(of_unknowns, np.max(applied_sizes(near.inverses[stage], terms), axis=1))
            t = t + fraction * h
        known = lambda sizes: np.where(made.good, sizes, np.nan)
        return known(of_equations), known(of_unknowns)

    @np.errstate(all="ignore")
    def solved(
        self,
        states: np.ndarray,
        guesses: Sequence[np.ndarray],
        t: np.ndarray,
        h: float | np.ndarray,
        params: np.ndarray,
        follow: bool = False,
        sizes: Sequence[np.ndarray] | None = None,
    ) -> tuple[list[np.ndarray], list[np.ndarray], np.ndarray]:
        """A step of each state, followed as of `step`: the unknowns of each part, their sizes (states, k), which are their values
        and what a typical rounding of each term of the equations comes to, and whether the equations are solved to roundoff of
        these, (states,). `sizes` that unknowns may have tell which terms are but the roundoff of zero."""
        near = self.nothing_near(len(t))
        made = self.step(states, guesses, t, h, params, near=near, follow=follow, far=True)
        found, good = [], made.good
        for stage, ((_, fraction), u, state) in enumerate(zip(self.program.stages, made.unknowns, made.states, strict=True)):
            at, least = (t, np.full(len(t), fraction * h), params), 0.0 if sizes is None else sizes[stage]
            terms = self._terms(stage, u, state, *at)
            of_part = _sizes_of(u, terms, near.inverses[stage])
            found.append(of_part)
            good = good & self._is_solved(stage, u, state, at, near.inverses[stage], least, terms)
            good = good & np.all(np.isfinite(of_part), axis=1)
            t = t + fraction * h
        return made.unknowns, found, good

    def _terms(self, stage: int, u, state, t, h, params, sizes: np.ndarray | None = None) -> np.ndarray:
        """The sizes (states, k) of the terms of a stage's equations, however they cancel, with unknowns of their own sizes."""
        return stage_look(self.program, stage)(u, state, t, h, params, np.abs(u) if sizes is None else sizes, only=(TERMS,))[0]

    def differentiated(
        self, made: Attempts, t: np.ndarray, h: float, params: np.ndarray, noise: Noise | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """The derivatives (states, s, s) of the states after steps by those before, and the largest condition number of the
        equations of each. With r(u, x) = 0 and x' = a(u, x), ∂x'/∂x = ∂_x a − ∂_u a (∂_u r)⁻¹ ∂_x r."""
        count, size = made.states[0].shape
        jacobians, conditions = np.broadcast_to(np.eye(size), (count, size, size)), np.ones(count)
        for (index, fraction), u, states in zip(self.program.stages, made.unknowns, made.states, strict=True):
            e, k = self.program.equations[index], u.shape[1]
            known = self._values(index, u, states, (t, np.full(count, fraction * h), params), noise)
            slopes = self._slopes_of(known, [*e.residual, *e.advance], [*e.unknowns, *e.state])
            slopes = noise.off(slopes) if noise else slopes  # for what is made of them by matrices
            by_u, by_state = slopes[:, :, :k], slopes[:, :, k:]
            step = by_state[:, k:]
            if k:
                step = step - by_u[:, k:] @ (balanced_inverse(by_u[:, :k]) @ by_state[:, :k])
                regular = np.all(np.isfinite(by_u), axis=(1, 2))
                conditions[regular] = np.maximum(conditions[regular], condition_number(by_u[regular, :k]))
            jacobians, t = step @ jacobians, t + fraction * h
        return jacobians, conditions

    def rows(
        self, made: Attempts, t: np.ndarray, h: float | np.ndarray, params: np.ndarray, noise: Noise | None = None
    ) -> dict[str, np.ndarray]:
        """The named arrays of the rows that the steps leave."""
        parts, h = [], np.broadcast_to(h, t.shape)
        stages = self.program.stages if needs_every_part(self.equation) else self.program.stages[:1]
        for i, (index, fraction) in enumerate(stages):
            rows, pieces = self.program.equations[index].rows, {}
            for low in range(0, max(len(t), 1), LANES):
                some = slice(low, low + LANES)
                at = (t[some], fraction * h[some], params[some])
                known = self._values(index, made.unknowns[i][some], made.states[i][some], at, noise)
                for name, values in self._read_each(known, rows).items():
                    pieces.setdefault(name, []).append(values)
            parts.append({name: np.concatenate(a) for name, a in pieces.items()})
            t = t + fraction * h
        if len(parts) == 1:
            return parts[0]
        whole: dict[str, Any] = {}
        for name, about in self.equation.fields.items():
            arrays = [about.weight(f) * row[name] for row, (_, f) in zip(parts, self.program.stages, strict=True)]
            each = about.rule == "each"
            whole[name] = parts[0][name] if about.rule == "first" else np.stack(arrays, axis=1) if each else sum(arrays)
        return whole

    def _solved(
        self, stage: int, guess, states, at, noise, near: Near, follow: bool, alone: bool, far: bool
    ) -> tuple[np.ndarray, np.ndarray]:
        """The unknowns (states, k) of a stage by Newton's method, and where it has a solution.

        A Jacobian serves as long as updates by it contract. Those of one that does not, or of another step, are taken back. The
        last update is by that of the solution. It ends as in the engines (`stopping.py`)."""
        index = self.program.stages[stage][0]
        e, (count, k) = self.program.equations[index], guess.shape
        if not k:
            return guess, np.ones(count, bool)
        known = self._values(index, guess, states, at)
        known.bind(_nodes(e.previous), guess)
        safe = self._read(known, e.guess)
        known = known.without(self._depends[index])
        known.bind(_nodes(e.unknowns), safe)
        fixed, u, begun = None, safe.copy(), safe.copy()
        inverse, size = near.inverses[stage], near.sizes[stage]
        last, left, renewed = np.full(count, np.inf), np.arange(count), unknown(inverse)
        is_solved = lambda some: self._is_solved(stage, u[some], states[some], tuple(a[some] for a in at), inverse[some])
        own = renewed.copy()  # the Jacobian is of these equations, or was seen to contract
        for _ in range(UPDATES):
            some = known if fixed is None else fixed.at(left) if len(left) < count else fixed.without(set())
            some.bind(_nodes(e.unknowns), u[left])
            residual, fresh = None, renewed[left]
            if np.all(fresh):
                slopes, residual = self._linearized(index, some)
                inverse[left] = inverted(slopes, alone)
            elif np.any(fresh):
                inverse[left[fresh]] = inverted(self._linearized(index, some.at(np.flatnonzero(fresh)))[0], alone)
            residual = self._read(some, e.residual, index) if residual is None else residual
            change = applied(inverse[left], residual)
            fixed = known.without(self._depends[index]) if fixed is None else fixed
            u[left] -= change
            if np.any(fresh):
                new = left[fresh]
                safe[new], own[new] = u[new], True
                terms = self._terms(stage, u[new], states[new], *(a[new] for a in at))
                size[new] = np.nan_to_num(applied_sizes(inverse[new], terms), nan=0.0, posinf=0.0)
            moved = _largest_ratio(change, np.maximum(np.abs(u[left]), size[left]))
            contracts = moved <= CONTRACTING * last[left]
            own[left] |= contracts & np.isfinite(last[left])
            stalled = own[left] & (moved >= last[left] / 2) & (moved < STALLED)
            found = _largest_ratio(change, np.maximum(np.abs(u[left]), OWN * size[left])) <= FLOOR
            ended = found | stalled
            loose = ended & np.any(size[left] > FAR * np.abs(u[left]), axis=1)
            if np.any(loose):
                ended[loose] = is_solved(left[loose])
            ended |= fresh & np.isnan(moved)
            renewed[left] = ~fresh & ~contracts & ~(own[left] & (moved < STALLED)) & ~ended
            last[left] = np.where(renewed[left], np.inf, moved)
            u[renewed] = safe[renewed]
            left = left[~ended]
            if not len(left):
                break
        good = last < STALLED
        self._to_floor(index, u, inverse, states, at, noise, alone)
        if len(left):
            good[left] &= is_solved(left)
        if follow and len(lost := np.flatnonzero(~good)) and k <= FOLLOWED:
            there, _ = self.followed(stage, begun[lost], states[lost], tuple(a[lost] for a in at), far)
            if len(some := lost[np.isfinite(there[:, 0])]):
                u[some] = there[np.isfinite(there[:, 0])]
                of_them = u[some], inverse[some], states[some], tuple(a[some] for a in at), noise, alone
                u[some], inverse[some] = self._to_floor(index, *of_them)
                good[some] = is_solved(some)
        return u, good

    def _to_floor(self, index: int, u, inverse: Inverses, states, at, noise, alone: bool) -> tuple[np.ndarray, Inverses]:
        """A last update in place, by the Jacobians of the solutions: by any other the roundoff of constraints would move what
        they leave free."""
        inverse[:] = inverted(self._linearized(index, self._values(index, u, states, at))[0], alone)
        u -= applied(inverse, self._read(self._values(index, u, states, at, noise), self.program.equations[index].residual))
        return u, inverse

    @np.errstate(all="ignore")
    def followed(self, stage: int, guess, states, at, far: bool) -> tuple[np.ndarray, np.ndarray]:
        """`following.followed` of the equations of a stage, from a guess (states, k) on, in the sizes that unknowns have there:
        where Newton's method went from it, they may have any; where it is `far` that of the equations less what the guess misses,
        too."""
        index, (t, h, params) = self.program.stages[stage][0], at
        e, of_step = self.program.equations[index], self.program.shared.h
        inverses = inverted(self._linearized(index, self._values(index, guess, states, at))[0], alone=True)
        sizes = np.nan_to_num(applied_sizes(inverses, self._terms(stage, guess, states, *at)), nan=0.0, posinf=0.0)

        def slopes(some, u, part):
            known = self._values(index, u, states[some], (t[some], part * h[some], params[some]))
            found = self._slopes_of(known, e.residual, [*e.unknowns, of_step])
            found[:, :, -1] *= h[some][:, None]
            return self._read(known, e.residual), found

        unknowns, reached = followed(slopes, guess, sizes)
        if far and len(cut := np.flatnonzero(reached < 1.0)):
            begun = self._read(self._values(index, guess[cut], states[cut], tuple(a[cut] for a in at)), e.residual)

            def less(some, u, part):
                """r(u) − (1 − part)·r(guess) (Keller 1978)."""
                here = cut[some]
                residual, found = slopes(here, u, np.ones(len(here)))
                found[:, :, -1] = begun[some]
                return residual - (1.0 - part)[:, None] * begun[some], found

            unknowns[cut], part = followed(less, guess[cut], sizes[cut])
            reached[cut] = np.where(part == 1.0, 1.0, reached[cut])
        orientation = lambda u: np.linalg.slogdet(self._linearized(index, self._values(index, u, states, at))[0])[0]
        beyond = np.isfinite(unknowns[:, 0]) & (orientation(guess) != orientation(unknowns))
        unknowns[beyond], reached[beyond] = np.nan, 0.0  # across a place where the equations are singular
        return unknowns, reached

    def _is_solved(
        self, stage: int, u, states, at, inverses: Inverses, least: Any = 0.0, terms: np.ndarray | None = None
    ) -> np.ndarray:
        """Whether the equations are solved, (states,): to roundoff of their `terms`, however they cancel. One that has none but
        the roundoff of zero has those of unknowns of the sizes that equations give them which are solved for sure, or `least`: at
        a place that solves nothing, near a singular Jacobian, unknowns have any size."""
        if not u.size:
            return np.ones(len(u), bool)
        least = np.broadcast_to(least, u.shape)
        terms, index = self._terms(stage, u, states, *at) if terms is None else terms, self.program.stages[stage][0]
        missed = np.abs(self._read(self._values(index, u, states, at), self.program.equations[index].residual))
        within = lambda missed, terms: np.isfinite(terms) & ((missed <= STALLED * terms) | (missed <= SMALLEST))
        good = np.all(within(missed, terms), axis=1)
        if len(some := np.flatnonzero(~good)):
            u, states, at, terms, missed = u[some], states[some], tuple(a[some] for a in at), terms[some], missed[some]
            sizes = _sizes_of(u, np.where(missed <= STALLED * terms, terms, 0.0), inverses[some])
            others = self._terms(stage, u, states, *at, sizes=np.maximum(sizes, least[some]))
            good[some] = np.all(within(missed, np.where(terms < NOTHING * others, others, terms)), axis=1)
        return good

    def _values(self, index: int, u, states, at, noise: Noise | None = None) -> Values:
        e, shared = self.program.equations[index], self.program.shared
        known = Values(self.program.graph, len(states), noise.table if noise else None)
        pairs = [(e.unknowns, u), (e.state, states), (shared.t, at[0]), (shared.h, at[1]), (shared.params, at[2])]
        for nodes, array in pairs:
            known.bind(_nodes(nodes), noise.off(array) if noise else array)
        return known

    def _linearized(self, index: int, known: Values) -> tuple[np.ndarray, np.ndarray]:
        """The Jacobians (states, k, k) of a residual, and the residuals."""
        e = self.program.equations[index]
        if self.program.is_swept:
            return self._slopes_of(known, e.residual, e.unknowns), known.read(_nodes(e.residual))
        rows, residual = self.program.jacobians[index], e.residual
        places = [(i, j, node) for i, row in enumerate(rows) for j, node in row.items()]
        found = self._read(known, [*(node for _, _, node in places), *residual], index)
        out = np.zeros((known.entries, len(rows), len(rows)))
        out[:, [i for i, _, _ in places], [j for _, j, _ in places]] = found[:, : len(places)]
        return out, found[:, len(places) :]

    def _read(self, known: Values, nodes: Any, index: int | None = None) -> np.ndarray:
        """The values of nodes; what does not depend on the unknowns of an equation may stay known, if its `index` is given."""
        return self._reads(known, _nodes(nodes), None if index is None else self._depends[index], index)

    def _slopes_of(self, known: Values, nodes: list[int], inputs: list[int]) -> np.ndarray:
        """The derivatives of nodes by inputs, (states, nodes, inputs)."""
        return known.slopes(nodes, inputs, self._plan(nodes, inputs))

    def _plan(self, nodes: list[int], inputs: list[int]) -> Slopes:
        """How they are found, made once."""
        if (key := (*nodes, -1, *inputs)) not in self._slopes:
            self._slopes[key] = Slopes(self.program.graph, nodes, inputs)
        return self._slopes[key]

    def _read_each(self, known: Values, named: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        """The values of arrays of nodes by their names, all at once."""
        flat = self._read(known, np.concatenate([nodes.ravel() for nodes in named.values()]))
        parts = np.split(flat, np.cumsum([nodes.size for nodes in named.values()])[:-1], axis=1)
        return {name: part.reshape(len(flat), *nodes.shape) for part, (name, nodes) in zip(parts, named.items(), strict=True)}

    def _moving(self, inputs: list[int]) -> set[int]:
        """The nodes that depend on these."""
        moving, args = set(inputs), self.program.graph.args
        for node in range(len(args)):
            if node not in moving and any(a in moving for a in args[node]):
                moving.add(node)
        return moving


_made: Memo[StepsInNumbers] = Memo(KEPT)


def _sizes_of(u: np.ndarray, terms: np.ndarray, inverses: Inverses) -> np.ndarray:
    """Those of unknowns (states, k): their values, and what a typical rounding of each term of their equations comes to."""
    return np.maximum(np.abs(u), TYPICAL * applied_sizes(inverses, terms))


def _largest_ratio(values: np.ndarray, sizes: np.ndarray) -> np.ndarray:
    """The largest |value|/size of each row, NaN where one is not finite."""
    ratios = np.divide(np.abs(values), sizes, out=np.zeros_like(values), where=sizes > SMALLEST)
    return np.where(np.all(np.isfinite(values), axis=1), largest_of_few(ratios), np.nan)


def _nodes(nodes: Any) -> np.ndarray:
    return np.asarray(nodes, dtype=np.int64)
