"""The search of the constraint algorithm: level by level, until it repeats or nothing is left ([BLM] §3)."""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from dirax.numerics.equilibration import geometric_scales
from dirax.numerics.ranks import numerical_rank
from dirax.numerics.tolerances import HESSIAN_RANK, MANIFOLD_RANK, ON_MANIFOLD
from dirax.program.linear_solves import solve
from dirax.program.tracing import along, jacobian, once
from dirax.program.user_functions import constant_entries, evaluated
from dirax.systems.affine_equations import Solved, explicit, solved, switching
from dirax.systems.constraint_chain import DETERMINED, EMPTY, GAUGE, IRREGULAR, ConstraintChain, ConstraintLevel
from dirax.systems.constraint_points import Function, Points
from dirax.systems.constraint_units import in_units, natural_units
from dirax.systems.forms import ImplicitForm

MOST_CHOICES = 6
"""Choices of pivots, beyond the best one of a point, that the functions of a chain change between."""


def rank_of(matrix: np.ndarray, reference: np.ndarray | None = None) -> int:
    """The numerical rank, rows scaled to unit size, or to the sizes `reference` (rows,)."""
    if not matrix.size:
        return 0
    rows = np.abs(matrix).max(axis=1) if reference is None else reference
    values = np.linalg.svd(matrix / np.where(rows > 0, rows, 1.0)[:, None], compute_uv=False)
    return int(numerical_rank(values, MANIFOLD_RANK, least=1.0))


class Landing(NamedTuple):
    """Where the conditions of a level vanish: the equations solved, the conditions with those of the levels before as a
    `function`, the point, None where there is none, and whether they were singular on the way to one."""

    found: Solved
    function: Function
    point: np.ndarray | None
    singular: bool


class Search:
    """The state of the algorithm between levels; points x are in the natural `units` of the form, until the `end`."""

    def __init__(self, form: ImplicitForm, params, radius: float):
        self.units = natural_units(form, params)
        self.form, self.params = in_units(form, self.units), params
        form = self.form
        self.x = np.array(form.point)
        self.size, self.unknowns = self.x.size, self.x.size + len(form.multipliers)
        moved = np.arange(self.size) < self.size - form.clock  # what a search may move: all but the time
        self.points = Points(radius * (1.0 + np.abs(self.x).max()), moved)
        self.parts: list[Callable] = []
        self.levels: list[ConstraintLevel] = []
        self.phi_and_slope: Callable = lambda x: (np.zeros(0), np.zeros((0, self.size)))
        equations = once(form.equations)
        self.given = self.at_points(equations)
        self.explicit = explicit(equations, self.constant_entries(equations), self.size)
        self.rows = [self.explicit.rest]
        """Equations of c, where (ẋ, u) = w + K c solves the explicit ones."""

    # ------------------------------------------------------------------ functions of the current level

    def at_points(self, function: Callable) -> Callable:
        """A function of (x, params) as one of points, with NumPy's arrays."""
        return lambda x: tuple(np.asarray(a) for a in evaluated(function, x, self.params))

    def constant_entries(self, equations: Callable) -> np.ndarray:
        """A of the equations (A, b), with NaN for what depends on x or is not known not to."""
        found = constant_entries(equations, self.x, self.params)
        return np.full(jax.eval_shape(equations, self.x, self.params)[0].shape, np.nan) if found is None else found

    def constraints(self) -> Callable:
        """(x, params) ↦ the constraints of all levels so far."""
        parts = tuple(self.parts)
        if not parts:
            return lambda x, params: jnp.zeros(0)
        return once(lambda x, params: jnp.concatenate([part(x, params) for part in parts]))

    def equations(self) -> Callable:
        """(x, params) ↦ the equations (A, b) of c that none of the ẋ and u so far satisfies by itself, one below the other."""
        rows = tuple(self.rows)
        return lambda x, params: tuple(jnp.concatenate(a) for a in zip(*(row(x, params) for row in rows), strict=True))

    def tangency(self, part: Callable) -> Callable:
        """Dφ ẋ = 0 as equations of c."""
        family, size = self.explicit.family, self.size

        @once
        def rows(x, params):
            w, basis = family(x, params)
            rate = lambda y: along(lambda x: part(x, params), (x,), (y[:size],))
            columns = [rate(basis[:, j]) for j in range(basis.shape[1])]
            right = -rate(w)
            return jnp.stack(columns, axis=1) if columns else jnp.zeros((*right.shape, 0)), right

        return rows

    def matrix(self, x: np.ndarray) -> np.ndarray:
        """A_k at a point."""
        slope = self.phi_and_slope(x)[1]
        return np.concatenate([self.given(x)[0], np.pad(slope, ((0, 0), (0, self.unknowns - self.size)))])

    def with_conditions(self, conditions: Callable) -> Callable:
        """x ↦ (φ, Dφ) of the constraints so far and the conditions after them, as numpy arrays."""
        phi = self.constraints()
        both = once(lambda x, params: jnp.concatenate([phi(x, params), conditions(x, params)]))
        return self.at_points(lambda x, params: (both(x, params), jacobian(lambda x: both(x, params))(x)))

    # ------------------------------------------------------------------ the loop

    def run(self) -> ConstraintChain:
        """Level after level; every end is a chain with its verdict."""
        if larger := self._larger_rank_around():
            return self.end(IRREGULAR, larger)
        while True:
            number = len(self.levels)
            points = self.points.around(self.x, self.phi_and_slope if self.parts else None)
            matrices = [self.matrix(x) for x in points]
            if not all(np.all(np.isfinite(a)) for a in matrices):
                return self.end(IRREGULAR, "the equations are not finite around the point: it is at the edge of their domain.")
            ranks = [rank_of(a) for a in matrices]
            place = f"M_{number - 1}" if number else "the whole space"
            if len(set(ranks)) > 1:
                return self.end(
                    IRREGULAR,
                    f"the rank of the equations of (ẋ, u) is {ranks[0]} at the point and {sorted(set(ranks[1:]))} around it on "
                    f"{place}: it is not constant, and the algorithm does not apply across such a point. Give another `near`.",
                )
            rank, equations = ranks[0], self.equations()
            entries, free = self.constant_entries(equations), rank - self.explicit.rank
            # sizes off the manifold too: what vanishes on it is left as roundoff, and is no pivot
            here, *others = (self.at_points(equations)(x)[0] for x in (*points, *self.points.around(self.x)[1:]))
            usual = np.nanmax(np.abs([here, *others]), axis=0)
            found = solved(equations, here, free, entries, usual)
            null = np.linalg.svd(matrices[0])[2][rank:].T
            everywhere = partial(self.everywhere, equations, (here, *others), free, entries, usual)
            if not found.count:
                return self.finish(everywhere(found), null, rank)
            missed = self.at_points(lambda x, params, found=found: (found.conditions(x, params),))
            size = 1.0 + np.abs(self.given(self.x)[1]).max(initial=0.0) + np.abs(self.x).max()
            if all(np.all(np.abs(missed(x)[0]) <= ON_MANIFOLD * size) for x in points):
                return self.finish(everywhere(found), null, rank)
            landing = self.landing(self.choices(equations, here, free, entries, usual), equations, usual)
            outcome = self.add(landing, points, rank, self._off_manifold(rank, place), everywhere)
            if outcome is not None:
                return outcome
            self.rows = [*(self.rows if rank > self.explicit.rank else ()), self.tangency(self.parts[-1])]

    def _larger_rank_around(self) -> str:
        """In words, that the Hessian, which the form takes for one of its rank at the point, has a larger one around it."""
        if self.form.hessian is None:
            return ""
        around = Points(self.points.radius, self.points.moved).around(self.x)
        matrices = np.array([np.asarray(evaluated(self.form.hessian, x, self.params)) for x in around])
        if not np.all(np.isfinite(matrices)):
            return ""
        rows, columns = geometric_scales(np.max(np.abs(matrices), axis=0))
        here, *others = numerical_rank(np.linalg.svd(matrices / rows / columns, compute_uv=False), HESSIAN_RANK).tolist()
        return (max(others) > here) * (
            f"the rank of ∂²L/∂v² is {here} at the point and {max(others)} around it: it is not constant, and the algorithm "
            "does not apply across such a point. Give another `near`, or take other coordinates."
        )

    def _off_manifold(self, rank: int, place: str) -> str:
        """A remark where conditions exist on the manifold only, because the rank is larger off it."""
        if not self.parts:
            return ""
        off = min(rank_of(self.matrix(self.points.sample(self.x))) for _ in range(2))
        return f"appears only on {place}: off it the rank is {off}" if off > rank else ""

    def choices(
        self, equations: Callable, matrix: np.ndarray, rank: int, entries: np.ndarray, usual: np.ndarray
    ) -> Iterator[Solved]:
        """The equations solved by different pivots: a pivot may vanish where the conditions do. The best ones of the point come
        first, then what is left without one of their rows, or of their columns, or of both."""
        first = solved(equations, matrix, rank, entries, usual)
        yield first
        tried = {first.pivots}
        for row, column in zip(*first.pivots, strict=True):
            for places in ([np.s_[row, :]], [np.s_[:, column]], [np.s_[row, :], np.s_[:, column]]):
                left = matrix.copy()
                for place in places:
                    left[place] = 0.0
                if rank_of(left) == rank and (found := solved(equations, left, rank, entries, usual)).pivots not in tried:
                    tried.add(found.pivots)
                    yield found

    def everywhere(
        self,
        equations: Callable,
        matrices: Iterable[np.ndarray],
        rank: int,
        entries: np.ndarray,
        usual: np.ndarray,
        found: Solved,
    ) -> Solved:
        """The equations solved by the pivots of `found`, and by others, chosen at the point and around it, where those that
        depend on x vanish further away."""
        if np.all(np.isfinite(entries[list(found.pivots[0])])):
            return found
        more = {found.pivots: found}
        for matrix in matrices:
            for choice in self.choices(equations, matrix, rank, entries, usual):
                if len(more) > MOST_CHOICES:
                    break
                more.setdefault(choice.pivots, choice)
        return switching(list(more.values()), equations, entries, usual)

    def landing(self, choices: Iterable[Solved], equations: Callable, usual: np.ndarray) -> Landing:
        """The nearest point where the conditions vanish and a choice of pivots is regular; else what the first choice gave."""
        first, regular, matrix = None, [], self.at_points(equations)
        for found in choices:
            function = self.with_conditions(found.conditions)
            landing = Landing(found, function, *self.points.nearest(function, self.x))
            first = first or landing
            if landing.point is not None and found.regular(matrix(landing.point)[0], usual):
                regular.append((float(np.linalg.norm(landing.point - self.x)), len(regular), landing))
                if regular[-1][0] <= self.points.radius:
                    break
        assert first is not None
        return min(regular)[2] if regular else first

    def add(
        self, landing: Landing, points: list[np.ndarray], rank: int, note: str, everywhere: Callable
    ) -> ConstraintChain | None:
        """Take the independent ones of the conditions as the constraints of a new level; the chain where that ends it. Where
        all of them are, they are those of `everywhere`, which takes other pivots further away."""
        conditions, function, x = landing.found.conditions, landing.function, landing.point
        number, old = len(self.levels), sum(level.count for level in self.levels)
        slopes = [function(x)[1] for x in points]
        reference = np.max([np.abs(slope).max(axis=1) for slope in slopes], axis=0)
        if x is None and landing.singular:
            return self.end(
                IRREGULAR,
                f"the rank of the equations of (ẋ, u) changes where the conditions of level {number} vanish, so that others "
                "hold only there: state these as equations of their own (rows of zeros in E), or give another `near`.",
            )
        if x is None:
            value = np.abs(function(self.x)[0][old:]).max()
            varies = any(rank_of(a, reference) > rank_of(a[:old], reference[:old]) for a in slopes)
            why = "have no common zero near the point" if varies else "do not vary" + f" on M_{number - 1}" * (number > 0)
            return self.end(
                EMPTY,
                f"the conditions of level {number} {why}, where they are up to {value:.3g}: the system is inconsistent, and no "
                "point here has a velocity.",
            )
        before, self.x = self.x, x
        slope = function(x)[1]
        new = rank_of(slope, reference) - rank_of(slope[:old], reference[:old])
        if new <= 0:
            self.x = before
            return self.end(
                IRREGULAR,
                f"the conditions of level {number} vanish with their derivative (as y² = 0 does): M_{number} is not their "
                "regular zero set. State such a constraint by a function whose derivative does not vanish.",
            )
        select = _independent(slope[old:], slope[:old], reference[old:], new)
        if new == len(select.T):
            conditions = everywhere(landing.found).conditions
        part = once(lambda x, params: select @ conditions(x, params))

        def constraints_of_level(x):
            value, slope = function(x)
            combine = lambda a: np.concatenate([a[:old], select @ a[old:]])
            return combine(value), combine(slope)

        self.phi_and_slope = constraints_of_level
        samples = self.points.around(x, constraints_of_level)
        rest = max(np.abs(function(y)[0]).max() for y in samples)
        ranks = {rank_of(constraints_of_level(y)[1]) for y in samples}
        self.parts.append(part)
        self.levels.append(ConstraintLevel(number, self.size - old - new, new, rank, part, note))
        said = ""
        if len(ranks) > 1:
            said = f"have ranks from {min(ranks)} to {max(ranks)} on M_{number}"
        elif rest > 1e-7 * max(reference.max(), 1e-300) * (1.0 + np.abs(x).max()):
            said = f"do not let all of them vanish on M_{number}, by {rest:.3g}"
        if said:
            said = f"the derivatives of the conditions of level {number} {said}"
            return self.end(IRREGULAR, f"{said}: their rank is not constant around the point.")
        return None

    # ------------------------------------------------------------------ ends

    def finish(self, found: Solved, null: np.ndarray, rank: int) -> ConstraintChain:
        """The chain where a level has no new conditions: the last manifold is M_f."""
        n = self.size
        freedom = rank_of(null[:n].T, np.ones(null.shape[1])) if null.size else 0
        redundant = null.shape[1] - freedom
        if not self.levels:
            none = lambda x, params: jnp.zeros(0)
            self.levels.append(ConstraintLevel(0, n, 0, rank, none, "every point has a velocity"))
            index = 0
        else:
            index = len(self.levels)
            last = self.levels[-1]
            self.levels.append(ConstraintLevel(index, last.dimension, 0, rank, lambda x, params: jnp.zeros(0), "repeats: M_f"))
        words = [f"M_f has dimension {self.levels[-1].dimension} of {n} ({self.form.about})"]
        words.append(f"{freedom} direction{'s' * (freedom > 1)} of ẋ undetermined" if freedom else "ẋ is determined")
        if redundant:
            words.append(f"{redundant} multiplier{'s' * (redundant > 1)} undetermined: constraints are redundant, consistently")
        family = self.explicit.family

        @once
        def kernel(x, params):
            free = family(x, params)[1] @ found.kernel(x, params)
            return free

        @once
        def solution(x, params):
            w, basis = family(x, params)
            rates = w + basis @ found.solution(x, params)
            if not null.size:
                return rates
            free = kernel(
                x, params
            )  # the part in it is zero: a condition that holds on, as one by the null space of a point does not
            return rates - free @ solve(free.T @ free, free.T @ rates, apart=True)

        return self.end(GAUGE if freedom else DETERMINED, "; ".join(words) + ".", index, freedom, redundant, solution, kernel)

    def end(self, verdict, explanation, index=None, freedom=0, redundant=0, solution=None, kernel=None) -> ConstraintChain:
        """The chain with what was found so far, as functions of x in the units of the system."""
        units, of_x = self.units.coordinates, self.units.of_x
        rates = np.concatenate([units / self.units.time, self.units.multipliers])
        return ConstraintChain(
            levels=tuple(replace(level, constraints=of_x(level.constraints)) for level in self.levels),
            point=self.x * units,
            units=units,
            index=len(self.levels) if index is None else index,
            verdict=verdict,
            explanation=explanation,
            freedom=freedom,
            redundant=redundant,
            coordinates=self.form.coordinates,
            multiplier_names=self.form.multipliers,
            clock=self.form.clock,
            params=self.params,
            _constraints=of_x(self.constraints()),
            _solution=None if solution is None else of_x(solution, rates),
            _kernel=None if kernel is None else of_x(kernel, rates[:, None]),
            _energy=self.form.energy,
        )


def _independent(slope: np.ndarray, old: np.ndarray, reference: np.ndarray, count: int) -> np.ndarray:
    """(count, conditions): combinations whose derivatives are independent of one another and of the `old` ones."""
    unit = np.where(reference > 0, reference, 1.0)
    rest = slope / unit[:, None]
    if old.size:
        rest = rest - rest @ np.linalg.pinv(old, rcond=1e-10) @ old
    left = np.linalg.svd(rest)[0][:, :count]
    return (left / unit[:, None]).T
