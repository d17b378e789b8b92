"""Whether a map is a discretization map at a point ([BLM] Definition 4.5), and coordinates of TM."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from dirax.geometry.manifolds import AbstractManifold, Vector
from dirax.geometry.maps import AbstractDiscretizationMap
from dirax.program.tracing import once
from dirax.program.user_functions import evaluated, is_traced


class DiscretizationMapReport(eqx.Module):
    """What `check_discretization_map` found; all numbers are 0 for an exact map but the condition number."""

    point_defect: Float[Array, ""]
    """(D1): largest component of R_d(x, 0) − (x, x)."""
    derivative_defect: Float[Array, ""]
    """(D2): largest component of (D_v R_d² − D_v R_d¹)(x, 0)·e − e, over the frame vectors e of the tangent space."""
    inverse_defect: Float[Array, ""]
    """Largest component of R_d⁻¹(R_d(x, v)) − (x, v)."""
    condition_number: Float[Array, ""]
    """Condition number of D R_d(x, v) in the manifold's frames: the map is invertible near (x, v) if it is finite."""

    def __repr__(self):
        if is_traced(self):
            return super().__repr__()
        return f"DiscretizationMapReport({', '.join(f'{name}={float(value):.3g}' for name, value in vars(self).items())})"


def check_discretization_map(map: AbstractDiscretizationMap, x: ArrayLike, v: ArrayLike) -> DiscretizationMapReport:
    """How far (D1), (D2) and invertibility ([BLM] Definition 4.5, Proposition 4.6) fail at the tangent vector v at x. Raises
    `ValueError` for a point and a vector of different shapes, and for a map that returns others."""
    x, v = jnp.asarray(x, dtype=float), jnp.asarray(v, dtype=float)
    if x.ndim != 1 or x.shape != v.shape:
        raise ValueError(
            f"x and v must have one shape (N,), a point and a tangent vector at it, but have {x.shape} and {v.shape}."
        )
    refuse_other_shapes(map, x.shape[0])
    return jax.tree.map(jnp.asarray, evaluated(once(_report, map, True), x, v))


def defects_at(map: AbstractDiscretizationMap, x: ArrayLike) -> DiscretizationMapReport:
    """The same at the zero vector, in numbers; a root that is searched for is none but the inverse."""
    return evaluated(once(_report, map, map.has_explicit_inverse), x, np.zeros_like(x))


def refuse_other_shapes(map: AbstractDiscretizationMap, size: int) -> None:
    """Raise `ValueError` for a map of one's own that does not return two vectors of the `size` of those that it is given."""
    if map.is_known:
        return
    vector = jax.ShapeDtypeStruct((size,), np.float64)
    for function, what in ((map.forward, "(x, v) must return two points"), (map.backward, "(x0, x1) must return x and v")):
        found = jax.eval_shape(function, vector, vector)
        shapes = [getattr(one, "shape", None) for one in found] if isinstance(found, tuple | list) else None
        if shapes != [(size,)] * 2:
            came = f"one of shape {found.shape}" if hasattr(found, "shape") else f"{found}" if shapes is None else f"{shapes}"
            raise ValueError(
                f"{type(map).__name__}.{function.__name__}{what}, two vectors of shape ({size},), but it returned {came}."
            )


def _report(map: AbstractDiscretizationMap, inverse: bool, x: Vector, v: Vector) -> DiscretizationMapReport:
    manifold = map.manifold(x.shape[0])
    d = manifold.dimension

    def with_derivative(v):
        """The two points at (x, v), and their derivatives (N, 2d) in coordinates of TM."""
        tangent, here = tangent_coordinates(manifold, x, v)
        push = lambda direction: jax.jvp(lambda z: map.forward(*tangent(z)), (here,), (direction,))
        return jax.vmap(push, out_axes=(None, -1))(jnp.eye(2 * d))

    (starts, ends), (start_derivatives, end_derivatives) = jax.vmap(with_derivative)(jnp.stack([jnp.zeros_like(v), v]))
    difference_in_v = (end_derivatives - start_derivatives)[0, :, d:]
    components = jax.vmap(manifold.coordinates, (None, 1), 1)
    jacobian = jnp.concatenate([components(starts[1], start_derivatives[1]), components(ends[1], end_derivatives[1])])
    found, velocity = map.backward(starts[1], ends[1]) if inverse else (x, v)
    return DiscretizationMapReport(
        point_defect=_largest(starts[0] - x, ends[0] - x),
        derivative_defect=_largest(difference_in_v - manifold.frame(x)),
        inverse_defect=_largest(found - x, velocity - v),
        condition_number=jnp.linalg.cond(jacobian),
    )


def tangent_coordinates(manifold: AbstractManifold, x: Vector, v: Vector) -> tuple[Callable, Float[Array, " 2d"]]:
    """Coordinates (r, ṙ) of TM near the tangent vector v at x: the map to (point, vector), and its argument at (x, v)."""
    point = manifold.local_parametrization(x)
    here = jnp.concatenate([jnp.zeros(manifold.dimension), manifold.coordinates(x, v)])
    return lambda z: jax.jvp(point, (z[: manifold.dimension],), (z[manifold.dimension :],)), here


def _largest(*arrays: Array) -> Float[Array, ""]:
    return jnp.max(jnp.stack([jnp.max(jnp.abs(array)) for array in arrays]))
