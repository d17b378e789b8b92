"""The image of a projector as a manifold, and discretization maps projected to it ([BLM] Proposition 7.3)."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from dirax.geometry.manifolds import AbstractManifold
from dirax.geometry.maps import AbstractDiscretizationMap
from dirax.geometry.squared_angles import norm
from dirax.numerics.tolerances import POINT_DEFECT
from dirax.program.linear_solves import solve
from dirax.program.roots import regular_root
from dirax.program.tracing import jacobian
from dirax.program.user_functions import evaluated, is_traced

PROJECTOR_DEFECT = 1e-9
"""How far the derivative of a projector may miss that of P ∘ P."""


class Submanifold(AbstractManifold):
    """The image M0 of a smooth projector P: R^N → R^N, P ∘ P = P, defined near M0; `projector(x)` (N,) → (N,).

    P may be oblique: `projection` is the orthogonal one to the tangent space, which is the image of DP. Without
    `dimension` it is the trace of DP, taken at P of some point of R^N; raises `ValueError` if that is no whole number.
    """

    projector: Callable = eqx.field(static=True)
    ambient_dimension: int = eqx.field(static=True)
    dimension: int = eqx.field(static=True)

    def __init__(self, projector: Callable, ambient_dimension: int, dimension: int | None = None):
        self.projector, self.ambient_dimension = projector, ambient_dimension
        self.dimension = self._dimension() if dimension is None else dimension

    def _dimension(self) -> int:
        with jax.ensure_compile_time_eval():
            x = np.asarray(evaluated(self.projector, np.cos(1.0 + np.arange(self.ambient_dimension))))
            trace = float(np.trace(np.asarray(evaluated(jax.jacfwd(self.projector), x))))
        if not (np.isfinite(trace) and abs(trace - round(trace)) < 1e-6):
            raise ValueError(
                f"The projector's derivative has trace {trace:.6g} at a point of its image, where a projector has a "
                "whole number: P(P(x)) = P(x) must hold, and P be defined at that point; otherwise give dimension=."
            )
        return round(trace)

    def defect(self, x):
        """‖P(x) − x‖."""
        return norm(self.projector(x) - x)

    def nearest(self, x):
        """P(x)."""
        return self.projector(x)

    def check_point(self, x, name="x", tolerance=POINT_DEFECT):
        """As of every manifold; and `ValueError` where P is no projector there, D(P ∘ P) = DP, or one to a manifold of another
        dimension."""
        super().check_point(x, name, tolerance)
        self._check_projector(x, name)

    def check_tangent(self, x, v, name="v", tolerance=POINT_DEFECT, point=None):
        """As `check_point` and of every manifold."""
        super().check_tangent(x, v, name, tolerance, point)
        self._check_projector(x, point or "x")

    def _check_projector(self, x, name):
        if is_traced(x):
            return
        slope = np.asarray(evaluated(jacobian(self.projector), x))
        missed = float(np.max(np.abs(slope @ slope - slope), initial=0.0))
        if not missed <= PROJECTOR_DEFECT * max(1.0, float(np.max(np.abs(slope)))):
            raise ValueError(
                f"P(P(x)) = P(x) does not hold near {name}: its derivative misses DP DP = DP by {missed:.3g} there, so that the "
                "points P(x) are no manifold to which P projects."
            )
        if (found := round(float(np.trace(slope)))) != self.dimension:
            raise ValueError(
                f"the image of P has dimension {found} at {name}, the trace of DP, but "
                f"dimension={self.dimension} was given: leave dimension out, or give that."
            )

    def projection(self, x, v):
        """The orthogonal projection to the image of DP(x)."""
        oblique, apart = self._oblique(x)
        return oblique @ solve(apart, v)

    def _oblique(self, x):
        """A, (A + Aᵀ − 1) for the projection A = DP(x), which is oblique: the orthogonal one with the same image is
        A (A + Aᵀ − 1)⁻¹."""
        oblique = jacobian(self.projector)(x)
        return oblique, oblique + oblique.T - jnp.eye(self.ambient_dimension)

    def representative(self, x, near):
        """x."""
        return x

    def local_parametrization(self, x):
        """r ↦ P(x + Fr) with the frame F."""
        basis = self.frame(x)
        return lambda r: self.projector(x + basis @ r)

    def frame(self, x):
        """An orthonormal basis of the image of DP(x): of the orthogonal projection to it the longest column, then that of what
        is left of it, and so on."""
        # A choice of coordinates, held fixed under differentiation, which a rounding of DP(x) must not turn into another one:
        # singular vectors of a projection are all of one singular value, and columns may be equally long.
        oblique, apart = self._oblique(jax.lax.stop_gradient(x))
        rest = oblique @ solve(apart, jnp.eye(self.ambient_dimension))
        unequal, columns = 1.0 + np.cos(1.0 + np.arange(self.ambient_dimension)) / 4.0, []
        for _ in range(self.dimension):
            lengths = jnp.diagonal(rest) * unequal
            longest = rest @ (lengths == jnp.max(lengths)).astype(float)
            columns.append(longest / jnp.sqrt(longest @ longest))
            rest = rest - jnp.outer(columns[-1], columns[-1])
        return jax.lax.stop_gradient(jnp.stack(columns, axis=1))

    def coordinates(self, x, v):
        """Fᵀv with the frame F."""
        return self.frame(x).T @ v


class ProjectedMap(AbstractDiscretizationMap):
    """(P × P) ∘ R_d on the image M0 of a projector P, from a map R_d on the space around it ([BLM] Proposition 7.3).

    `projector(x)` takes and returns (N,), with P(P(x)) = P(x). The inverse is found by Newton's method, and is
    differentiable; where Newton does not converge it is NaN, and an error for concrete points. `dimension` of M0 is
    found from P if not given.
    """

    map: AbstractDiscretizationMap
    projector: Callable = eqx.field(static=True)
    dimension: int | None = eqx.field(static=True, default=None)

    def manifold(self, ambient_dimension):
        """The image of P."""
        return Submanifold(self.projector, ambient_dimension, self.dimension)

    @property
    def has_explicit_inverse(self):
        """It has none."""
        return False

    @property
    def base_fraction(self):
        """That of the map around it."""
        return self.map.base_fraction

    def forward(self, x, v):
        """(P(x0), P(x1)) of the map around it."""
        x0, x1 = self.map.forward(x, v)
        return self.projector(x0), self.projector(x1)

    def backward(self, x0, x1):
        """(x, v) with forward(x, v) = (x0, x1), by Newton from the inverse of the map around it."""
        n = x0.shape[0]

        def tangent(z):
            """(y, w) ∈ R^2N to a tangent vector of M0."""
            x = self.projector(z[:n])
            return x, jax.jvp(self.projector, (x,), (z[n:],))[1]

        def residual(z):
            # 2N equations: the two points, and in the directions normal to M0 that y and w are on it and tangent.
            x, v = tangent(z)
            y0, y1 = self.forward(x, v)
            return jnp.concatenate([y0 - x0 + z[:n] - x, y1 - x1 + z[n:] - v])

        return tangent(regular_root(residual, jnp.concatenate(self.map.backward(x0, x1))))

    def reach(self, x, v):
        """That of the map around it."""
        return self.map.reach(x, v)
