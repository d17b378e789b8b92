"""The discrete constraint algorithm: the constraint algorithm for the difference equations of a scheme ([BLM] Remark 6.1).

One step of size h is a relation S_d ⊂ M × M between the state and the next. As in the continuous algorithm,

    M_{d,0} = the states that have a next one,   S_{d,k+1} = S_{d,k} ∩ (M_{d,k} × M_{d,k}),

until it repeats. S_d is stated by r(u, x_0) = 0, x_1 = a(u, x_0), the residual and the advance of a StepEquation. With φ the
constraints found so far, G(u, x_0) = (r, φ ∘ a) and bases Z, N of the left and right kernels of ∂G/∂u at one point, the
bordered equations

    G(u, x_0) + Z s = 0,   Nᵀ(u − u*) = 0

have one solution (u, s)(x_0) near that point, and s(x_0) = 0 is the condition that x_0 has a next state on the level before.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from dirax.program.user_functions import check_finite, is_traced
from dirax.schemes.step import AbstractScheme, Shape, StepEquation, make_step_equation
from dirax.systems.affine_equations import equilibrated
from dirax.systems.constraint_algorithm import constraint_algorithm
from dirax.systems.constraint_chain import DETERMINED, EMPTY, GAUGE, IRREGULAR, ConstraintChain, ConstraintLevel
from dirax.systems.system import AbstractSystem
from dirax.text.tables import text_table

RANK_TOLERANCE = 1e-11
"""Singular values below this, of the equilibrated Jacobian, count as zero: those of a constraint of index ν are of size h^ν."""

NOISE = 1e-13
"""Entries of a Jacobian below this, relative to its largest, are roundoff."""

ZERO = 1e-10
SAME = 1e-9
SAMPLES = 4


@dataclass(frozen=True, eq=False)
class DiscreteConstraintChain:
    """The chain M_{d,0} ⊃ M_{d,1} ⊃ … ⊃ M_{d,f} of a scheme around a state; prints as a table.

    - `levels`: the manifolds of states, each with its new `constraints(state, params) -> (count,)`.
    - `verdict`: "determined", "gauge freedom", "empty" or "irregular", and `explanation` in words.
    - `freedom`: the number of undetermined directions of the next state on M_{d,f}.
    - `state` (s,) and `unknowns` (k,): a point of S_{d,f} (of the last level reached); `step` is h.
    - `continuous`: the chain of the system itself, None where it has none; `distance`: the largest of its constraints at
      nodes of M_{d,f}, NaN without; `agrees`: whether M_{d,f} is the final manifold M_f of the system.
    """

    levels: tuple[ConstraintLevel, ...]
    state: np.ndarray
    unknowns: np.ndarray
    step: float
    verdict: str
    explanation: str
    freedom: int
    continuous: ConstraintChain | None = field(repr=False)
    distance: float
    agrees: bool
    comparison: str
    params: Any = field(repr=False)

    @property
    def dimension(self) -> int:
        """The dimension of M_{d,f}; −1 where it is empty."""
        return -1 if self.verdict == EMPTY else self.levels[-1].dimension

    @property
    def empty(self) -> bool:
        """Whether no trajectory of the scheme passes near the given state."""
        return self.verdict == EMPTY

    def constraints(self, state: Float[Array, " s"], params: Any = None) -> Float[Array, " c"]:
        """All constraint functions of M_{d,f} at a state, level by level; traceable."""
        params = self.params if params is None else params
        return jnp.concatenate([jnp.zeros(0), *(level.constraints(state, params) for level in self.levels)])

    def to_dict(self) -> dict[str, Any]:
        """The table as plain Python values."""
        rows = [level.to_dict() for level in self.levels]
        keys = ("step", "verdict", "explanation", "freedom", "dimension", "distance", "agrees", "comparison")
        return {"levels": rows, **{key: getattr(self, key) for key in keys}}

    def __str__(self) -> str:
        header = ("level", "new constraints", "dim M_d,k", "rank of ∂(r, φ∘a)/∂u", "")
        rows = [(f"M_d,{v.number}", str(v.count), str(v.dimension), str(v.rank), v.note) for v in self.levels]
        return "\n".join([text_table(header, rows), f"{self.verdict}: {self.explanation}", self.comparison])


def discrete_constraint_algorithm(
    system: AbstractSystem,
    scheme: AbstractScheme,
    near: Any,
    step: float,
    params: Any = None,
    radius: float = 0.02,
) -> DiscreteConstraintChain:
    """The chain of constraint manifolds of the difference equations that `scheme` makes of `system`, with step size `step`.

    `near`: initial data as a dict such as {"q": …, "v": …}, or a point x (N,), not necessarily on any constraint;
    `radius`: size of the neighbourhood, relative to 1 + |x|, in which ranks are checked to be constant.

        print(dx.discrete_constraint_algorithm(system, dx.DiscreteDirac(), near={"q": q, "v": v}, step=0.01))

    The discrete chain need not be that of the system: Method 1 of a degenerate Lagrangian may be regular, so that every
    state has a next one, where the system itself lives on a smaller manifold ([BLM] Remark 6.1). `comparison` says which.
    Raises `TypeError` for a composition, and what the scheme raises; what is found is no exception but the `verdict`.
    """
    if is_traced(near, params):
        raise TypeError("discrete_constraint_algorithm inspects values: call it outside jax.jit.")
    if not step > 0:
        raise ValueError(f"step must be positive, but {step!r} was given.")
    if not 0 < radius < 1:
        raise ValueError(f"radius must lie between 0 and 1, but {radius!r} was given.")
    given = dict(near) if isinstance(near, Mapping) else {"x": near}
    check_finite("near", given)
    data = {name: jnp.asarray(value, float) for name, value in given.items()}
    equation = make_step_equation(scheme, system, Shape(*system.sizes(data, params)))
    if not isinstance(equation, StepEquation):
        raise TypeError(
            "the discrete constraint algorithm takes one equation a step, but the scheme is a composition of several."
        )
    begin = lambda data: equation.start(system.complete(data, params, False), jnp.asarray(float(step)), params)
    state, unknowns = jax.jit(begin)(data)
    search = _Search(equation, np.asarray(state), np.asarray(unknowns), float(step), params, radius)
    verdict, explanation, freedom = search.run()
    try:
        continuous = constraint_algorithm(system, near, params)
    except (TypeError, ValueError):
        continuous = None
    distance, agrees, comparison = _compared(search, verdict, continuous)
    return DiscreteConstraintChain(
        levels=tuple(search.levels),
        state=search.state,
        unknowns=search.unknowns,
        step=float(step),
        verdict=verdict,
        explanation=explanation,
        freedom=freedom,
        continuous=continuous,
        distance=distance,
        agrees=agrees,
        comparison=comparison,
        params=params,
    )


class _Search:
    """The state of the algorithm between levels."""

    def __init__(self, equation: StepEquation, state, unknowns, h: float, params, radius: float):
        self.equation, self.h, self.params = equation, h, params
        self.state, self.unknowns = state, unknowns
        self.size, self.k = state.size, unknowns.size
        self.radius = radius * (1.0 + np.abs(state).max())
        self.rng = np.random.default_rng(0)
        self.last: Callable = self.relation
        self.parts: list[Callable] = []
        self.levels: list[ConstraintLevel] = []

    def constraints(self) -> Callable:
        parts = tuple(self.parts)
        return lambda x, params: jnp.concatenate([jnp.zeros(0), *(part(x, params) for part in parts)])

    def step_equations(self) -> Callable:
        """(u, x) ↦ G(u, x) = (r, φ ∘ a)."""
        phi, e, h = self.constraints(), self.equation, self.h

        def equations(u, x, params):
            residual = e.residual(u, x, 0.0, h, params)
            return jnp.concatenate([residual, phi(e.advance(u, x, 0.0, h, params), params)]) if self.parts else residual

        return equations

    def onto(self, relation: Callable, point: np.ndarray) -> tuple[np.ndarray | None, float]:
        """The point (x, u) of S_{d,k} near `point` by Gauss–Newton, None where there is none; the equations that are left."""
        start, first = point, 0.0
        for _ in range(60):
            value, slope = (np.asarray(a) for a in relation(point))
            if not (np.all(np.isfinite(value)) and np.all(np.isfinite(slope))):
                return None, np.nan
            first = max(first, np.abs(slope).max(initial=0.0))
            change = np.linalg.lstsq(slope, value, rcond=1e-13)[0]
            point = point - change
            if np.linalg.norm(point - start) > 1e3 * (1.0 + np.linalg.norm(start)):
                break
            if np.abs(change).max(initial=0.0) <= 1e-14 * (1.0 + np.abs(point).max()):
                break
        left = float(np.abs(np.asarray(relation(point)[0])).max(initial=0.0))
        return (point if left <= ZERO * max(first, 1.0) * (1.0 + np.abs(point).max()) else None), left

    def around(self, relation: Callable) -> list[np.ndarray]:
        """The present point of S_{d,k} and samples around it."""
        here = np.concatenate([self.state, self.unknowns])
        points = [here]
        for _ in range(SAMPLES):
            shift = np.concatenate([self.radius * self.rng.normal(size=self.size), np.zeros(self.k)])
            sample, _ = self.onto(relation, here + shift)
            points += [] if sample is None else [sample]
        return points

    def relation(self, equations: Callable) -> Callable:
        """(x, u) as one vector ↦ the value and the slope of (G(u, x), φ(x))."""
        phi, size = self.constraints(), self.size

        def both(point, params):
            x, u = point[:size], point[size:]
            return jnp.concatenate([equations(u, x, params), phi(x, params)])

        compiled = jax.jit(lambda point, params: (both(point, params), jax.jacfwd(both)(point, params)))
        return lambda point: compiled(jnp.asarray(point), self.params)

    def run(self) -> tuple[str, str, int]:
        """(verdict, explanation, freedom)."""
        while True:
            number = len(self.levels)
            equations = self.step_equations()
            self.last = relation = self.relation(equations)
            point, left = self.onto(relation, np.concatenate([self.state, self.unknowns]))
            if point is None:
                where = f"on M_d,{number - 1}" if number else "at all"
                why = f"no state near the given one has a next one {where}: its equations keep a value of {left:.3g}"
                return EMPTY, f"{why}; the difference equations are inconsistent.", 0
            self.state, self.unknowns = point[: self.size], point[self.size :]
            slopes = [np.asarray(relation(p)[1]) for p in self.around(relation)]
            by_u = [slope[: slope.shape[0] - sum(v.count for v in self.levels), self.size :] for slope in slopes]
            ranks = [_rank(a) for a in by_u]
            if len(set(ranks)) > 1:
                return (
                    IRREGULAR,
                    f"the rank of the equations of a step is not constant around the state: {sorted(set(ranks))}.",
                    0,
                )
            solve = _bordered(equations, by_u[0], ranks[0], self.unknowns)
            conditions = lambda x, params, solve=solve: solve(x, params)[self.k :]
            if self.new(conditions, ranks[0]) == 0:
                return self.finish(by_u[0], ranks[0])

    def new(self, conditions: Callable, rank: int) -> int:
        """Take the independent ones of the conditions as the constraints of a new level; how many there are."""
        phi, number = self.constraints(), len(self.levels)
        x = jnp.asarray(self.state)
        both = lambda x: jnp.concatenate([phi(x, self.params), conditions(x, self.params)])
        known, slope = np.split(np.asarray(jax.jit(jax.jacfwd(both))(x)), [sum(level.count for level in self.levels)])
        if not slope.size:
            return 0
        count = _rank(np.concatenate([known, slope])) - _rank(known)
        if count == 0:
            return 0
        unknown = slope - slope @ np.linalg.pinv(known) @ known if known.size else slope
        select = jnp.asarray(np.linalg.svd(unknown)[0][:, :count].T)
        part = jax.jit(lambda x, params: select @ conditions(x, params))
        self.parts.append(part)
        dimension = self.size - sum(level.count for level in self.levels) - count
        self.levels.append(ConstraintLevel(number, dimension, count, rank, part))
        return count

    def finish(self, by_u: np.ndarray, rank: int) -> tuple[str, str, int]:
        number = len(self.levels)
        dimension = self.levels[-1].dimension if self.levels else self.size
        remark = "repeats: M_d,f" if number else "every state has a next one"
        self.levels.append(ConstraintLevel(number, dimension, 0, rank, lambda x, params: jnp.zeros(0), remark))
        free = np.linalg.svd(by_u)[2][rank:].T
        u, x = jnp.asarray(self.unknowns), jnp.asarray(self.state)
        moved = jax.jit(jax.jacfwd(lambda u: self.equation.advance(u, x, 0.0, self.h, self.params)))(u)
        freedom = _rank(np.asarray(moved) @ free / self.h) if free.size else 0
        hidden = free.shape[1] - freedom
        words = [f"M_d,f has dimension {dimension} of {self.size}"]
        words.append(
            f"{freedom} direction{'s' * (freedom > 1)} of the next state undetermined"
            if freedom
            else "the next state is determined"
        )
        words += [f"{hidden} of the other unknowns undetermined"] if hidden else []
        return (GAUGE if freedom else DETERMINED), "; ".join(words) + ".", freedom

    def nodes(self, count: int) -> list[np.ndarray]:
        """The saved (q, p) or x at states of S_{d,f} around the present one."""
        found = []
        unpack = jax.jit(lambda x, u: self.equation.unpack(x, u, 0.0, self.h, self.params))
        for point in self.around(self.last)[:count]:
            x, u = jnp.asarray(point[: self.size]), jnp.asarray(point[self.size :])
            row = {name: np.asarray(value) for name, value in unpack(x, u).items()}
            found.append(row["x"] if "x" in row else np.concatenate([row["q"], row["p"]]))
        return found


def _bordered(equations: Callable, by_u: np.ndarray, rank: int, base: np.ndarray) -> Callable:
    """(x, params) ↦ (u, s) of the bordered equations around the unknowns `base`."""
    left, _, right = np.linalg.svd(by_u)
    left, right, k = jnp.asarray(left[:, rank:]), jnp.asarray(right[rank:]), base.size
    start = jnp.concatenate([jnp.asarray(base), jnp.zeros(left.shape[1])])

    def solve(x, params):
        def bordered(w):
            return jnp.concatenate([equations(w[:k], x, params) + left @ w[k:], right @ (w[:k] - base)])

        return _smooth_root(bordered, start)

    return solve


def _smooth_root(residual: Callable, guess: Float[Array, " k"]) -> Float[Array, " k"]:
    """The root near a guess where the Jacobian is regular: Newton to the floor; differentiable."""

    def solve(residual, guess):
        def update(carry):
            w, _, count = carry
            change = jnp.linalg.solve(jax.jacfwd(residual)(w), residual(w))
            return w - change, jnp.max(jnp.abs(change)) / (1.0 + jnp.max(jnp.abs(w))), count + 1

        unfinished = lambda carry: (carry[1] > 1e-15) & (carry[2] < 30)
        return jax.lax.while_loop(unfinished, update, (guess, jnp.array(1.0), 0))[0]

    tangent = lambda linear, right: jnp.linalg.solve(jax.jacfwd(linear)(jnp.zeros_like(right)), right)
    return jax.lax.custom_root(residual, guess, solve, tangent)


def _rank(matrix: np.ndarray) -> int:
    """The numerical rank, rows and columns scaled to unit size where they are more than roundoff."""
    if not matrix.size:
        return 0
    matrix = np.where(np.abs(matrix) > NOISE * np.abs(matrix).max(), matrix, 0.0)
    values = np.linalg.svd(equilibrated(matrix), compute_uv=False)
    return int(np.sum(values > RANK_TOLERANCE * max(1.0, values[0])))


def _compared(search: _Search, verdict: str, chain: ConstraintChain | None) -> tuple[float, bool, str]:
    """(distance, agrees, comparison) of the discrete final manifold and that of the system."""
    if chain is None:
        return np.nan, False, "The system has no implicit form to compare with."
    if verdict == EMPTY or chain.empty:
        both = verdict == EMPTY and chain.empty
        return np.nan, both, "The system ends empty too." if both else f"The system itself ends {chain.verdict}."
    if verdict == IRREGULAR or chain.verdict == IRREGULAR:
        return np.nan, False, f"The chain of the system ends {chain.verdict}: the two are not compared."
    nodes = search.nodes(SAMPLES + 1)
    if len(nodes[0]) != len(chain.coordinates):
        return np.nan, False, f"The chain of the system is one of {', '.join(chain.coordinates)}: the two are not compared."
    distance = max(float(np.abs(np.asarray(chain.constraints(jnp.asarray(x)))).max(initial=0.0)) for x in nodes)
    on = distance <= SAME * (1.0 + max(np.abs(x).max() for x in nodes))
    dimension = search.levels[-1].dimension
    if on and dimension == chain.dimension:
        return distance, True, f"M_d,f is M_f, of dimension {chain.dimension}: the nodes stay on it."
    if on:
        return distance, False, f"M_d,f lies in M_f, which has dimension {chain.dimension}."
    if dimension > chain.dimension:
        words = (
            f"M_f of the system has dimension {chain.dimension}: the scheme has trajectories off it, and is a method of "
            "its own on the larger manifold."
        )
    else:
        words = (
            f"M_f has the dimension {chain.dimension} too, but is another manifold: the nodes are off it by up to "
            f"{distance:.2g}, less with a shorter step."
        )
    return distance, False, words
