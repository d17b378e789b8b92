"""The search of the discrete constraint algorithm: levels of states that have a next one, until nothing new is found.

S_d is stated by r(u, x_0) = 0, x_1 = a(u, x_0), the residual and the advance of a StepEquation. With φ the constraints found
so far, G(u, x_0) = (r, φ ∘ a) and bases Z, N of the left and right kernels of ∂G/∂u at one point, the bordered equations

    G(u, x_0) + Z s = 0,   Nᵀ(u − u*) = 0

have one solution (u, s)(x_0) near that point, and s(x_0) = 0 is the condition that x_0 has a next state on the level before.
"""

from collections.abc import Callable
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np

from dirax.numerics.equilibration import equilibrated
from dirax.numerics.newton import GaussNewton
from dirax.numerics.ranks import numerical_rank
from dirax.numerics.tolerances import JACOBIAN_NOISE, STEP_RANK
from dirax.program.roots import regular_root
from dirax.schemes.step import StepEquation
from dirax.schemes.step_units import in_step_units, step_units
from dirax.systems.constraint_chain import DETERMINED, EMPTY, GAUGE, IRREGULAR, ConstraintLevel

SAMPLES = 4
"""Points around the given one at which ranks are compared."""

ONTO = GaussNewton(rank=JACOBIAN_NOISE, floor=1e-14, least_slope=1.0)
"""The Jacobian of a step has entries of roundoff."""


class DiscreteConstraintSearch:
    """The state of the algorithm between levels; states and unknowns are in natural `units`, until the `found` ones."""

    def __init__(self, equation: StepEquation, state, unknowns, h: float, params, radius: float):
        self.units = step_units(equation, state, unknowns, h, params)
        self.equation, self.h, self.params = in_step_units(equation, self.units), h, params
        self.state, self.unknowns = state / self.units[0], unknowns / self.units[1]
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
        return ONTO.zero_near(relation, point)

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
        freedom = _rank(np.asarray(moved) @ free) if free.size else 0
        hidden = free.shape[1] - freedom
        words = [f"M_d,f has dimension {dimension} of {self.size}"]
        words.append(
            f"{freedom} direction{'s' * (freedom > 1)} of the next state undetermined"
            if freedom
            else "the next state is determined"
        )
        words += [f"{hidden} of the other unknowns undetermined"] if hidden else []
        return (GAUGE if freedom else DETERMINED), "; ".join(words) + ".", freedom

    def found(self) -> tuple[np.ndarray, np.ndarray, tuple[ConstraintLevel, ...]]:
        """The state, the unknowns and the levels in the user's units."""
        unit = jnp.asarray(self.units[0])
        of_state = lambda part: lambda x, params: part(x / unit, params)
        levels = tuple(replace(level, constraints=of_state(level.constraints)) for level in self.levels)
        return self.state * self.units[0], self.unknowns * self.units[1], levels

    def nodes(self, count: int) -> list[np.ndarray]:
        """The saved (q, p) or x at states of S_{d,f} around the present one."""
        found = []
        unpack = jax.jit(lambda x, u: self.equation.unpack(x, u, 0.0, self.h, self.params))
        for point in self.around(self.last)[:count]:
            x, u = jnp.asarray(point[: self.size]), jnp.asarray(point[self.size :])
            row: dict[str, np.ndarray] = {name: np.asarray(value) for name, value in unpack(x, u).items()}
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

        return regular_root(bordered, start, tolerance=np.inf, max_steps=30)

    return solve


def _rank(matrix: np.ndarray) -> int:
    """The numerical rank, rows and columns scaled to unit size where they are more than roundoff."""
    if not matrix.size:
        return 0
    matrix = np.where(np.abs(matrix) > JACOBIAN_NOISE * np.abs(matrix).max(), matrix, 0.0)
    values = np.linalg.svd(equilibrated(matrix, rounds=1)[0], compute_uv=False)
    return int(numerical_rank(values, STEP_RANK, least=1.0))
