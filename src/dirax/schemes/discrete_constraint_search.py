"""The search of the discrete constraint algorithm: levels of states that have a next one, until nothing new is found.

S_d is stated by r(u, x_0) = 0, x_1 = a(u, x_0), the residual and the advance of a StepEquation. With φ the constraints found
so far, G(u, x_0) = (r, φ ∘ a) and bases Z, N of the left and right kernels of ∂G/∂u at one point, the bordered equations

    G(u, x_0) + Z s = 0,   Nᵀ(u − u*) = 0

have one solution (u, s)(x_0) near that point, and s(x_0) = 0 is the condition that x_0 has a next state on the level before.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from dirax.schemes.step import StepEquation
from dirax.systems.affine_equations import equilibrated
from dirax.systems.constraint_chain import DETERMINED, EMPTY, GAUGE, IRREGULAR, ConstraintLevel

RANK_TOLERANCE = 1e-11
"""Singular values below this, of the equilibrated Jacobian, count as zero: those of a constraint of index ν are of size h^ν."""

NOISE = 1e-13
"""Entries of a Jacobian below this, relative to its largest, are roundoff."""

ZERO = 1e-10
"""Equations that keep a value of this, relative to their slope and to the point, have no solution there."""

SAMPLES = 4
"""Points around the given one at which ranks are compared."""


class DiscreteConstraintSearch:
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
