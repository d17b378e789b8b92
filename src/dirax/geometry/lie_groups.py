"""The rotation and rigid-motion groups SO(2), SE(2), SO(3), SE(3) as manifolds.

Exponentials and logarithms are written here because an integrator differentiates them twice at the identity, so they are made of
functions that are smooth in the squared angle.
"""

import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Array, Float

from dirax.geometry.lie_group import AbstractLieGroup
from dirax.geometry.squared_angles import arc_over_sine, radial

_COMPLEX_PRODUCT = np.array([[[1.0, 0], [0, -1]], [[0, 1], [1, 0]]])
_QUATERNION_PRODUCT = np.array(
    [
        np.diag([1.0, -1, -1, -1]),
        [[0, 1, 0, 0], [1, 0, 0, 0], [0, 0, 0, 1], [0, 0, -1, 0]],
        [[0, 0, 1, 0], [0, 0, 0, -1], [1, 0, 0, 0], [0, 1, 0, 0]],
        [[0, 0, 0, 1], [0, 0, 1, 0], [0, -1, 0, 0], [1, 0, 0, 0]],
    ]
)
_LEVI_CIVITA = _QUATERNION_PRODUCT[1:, 1:, 1:]
_TURN_OF_PLANE = np.array([[0.0], [1.0]])
_TURN_OF_SPACE = np.vstack([np.zeros(3), np.eye(3) / 2.0])


class SO2(AbstractLieGroup):
    """The rotations of the plane; an element is (cos, sin), an algebra vector is the angular velocity (1,)."""

    dimension, ambient_dimension, translations = 1, 2, 0
    rotation_product, rotation_basis = _COMPLEX_PRODUCT, _TURN_OF_PLANE
    bi_invariant, double_cover = True, False
    element = "(cos, sin)"
    jaxlie_group = jaxlie.SO2

    def __init__(self): ...

    def group_exp(self, xi):
        """(cos ξ, sin ξ)."""
        return jnp.concatenate([jnp.cos(xi), jnp.sin(xi)])

    def group_log(self, g):
        """The angle of (cos, sin), in (−π, π]."""
        return jnp.arctan2(g[1:2], g[0:1])


class SE2(AbstractLieGroup):
    """The rigid motions of the plane; an element is (cos, sin, x, y), an algebra vector (velocity, angle rate)."""

    dimension, ambient_dimension, translations = 3, 4, 2
    rotation_product, rotation_basis = _COMPLEX_PRODUCT, _TURN_OF_PLANE
    bi_invariant, double_cover = False, False
    element = "(cos, sin, x, y)"
    jaxlie_group = jaxlie.SE2

    def __init__(self): ...

    def group_exp(self, xi):
        """The turn by the angle θ, and (sin θ/θ) u + ((1 − cos θ)/θ) u^⊥ for the velocity u."""
        velocity, angle = xi[:2], xi[2]
        along, across = radial(1, angle**2), angle / 2.0 * radial(1, angle**2 / 4.0) ** 2
        rotation = jnp.stack([jnp.cos(angle), jnp.sin(angle)])
        return jnp.concatenate([rotation, along * velocity + across * quarter_turn(velocity)])

    def group_log(self, g):
        """The inverse of `group_exp` with an angle in (−π, π]."""
        angle, translation = jnp.arctan2(g[1], g[0]), g[2:]
        s = angle**2 / 4.0
        velocity = radial(0, s) / radial(1, s) * translation - angle / 2.0 * quarter_turn(translation)
        return jnp.concatenate([velocity, angle[None]])


class SO3(AbstractLieGroup):
    """The rotations of space; an element is a unit quaternion (w, x, y, z), q and −q being one rotation.

    Algebra vectors are body angular velocities ω (3,), with q̇ = ½ q ω; the distance is the angle of the rotation.
    """

    dimension, ambient_dimension, translations = 3, 4, 0
    rotation_product, rotation_basis = _QUATERNION_PRODUCT, _TURN_OF_SPACE
    bi_invariant, double_cover = True, True
    element = "a unit quaternion (w, x, y, z)"
    jaxlie_group = jaxlie.SO3

    def __init__(self): ...

    def group_exp(self, xi):
        """The unit quaternion (cos θ/2, sin(θ/2) ω/θ), θ = |ω|."""
        return _quaternion_exp(xi)

    def group_log(self, g):
        """The inverse of `group_exp` with an angle of at most π."""
        return _quaternion_log(g)


class SE3(AbstractLieGroup):
    """The rigid motions of space; an element is (quaternion, translation) (7,), an algebra vector (velocity, ω)."""

    dimension, ambient_dimension, translations = 6, 7, 3
    rotation_product, rotation_basis = _QUATERNION_PRODUCT, _TURN_OF_SPACE
    bi_invariant, double_cover = False, True
    element = "(w, x, y, z) of a unit quaternion and a translation"
    jaxlie_group = jaxlie.SE3

    def __init__(self): ...

    def group_exp(self, xi):
        """The rotation of ω, and u + ((1 − cos θ)/θ²) ω × u + ((θ − sin θ)/θ³) ω × (ω × u) for the velocity u."""
        velocity, omega = xi[:3], xi[3:]
        s = jnp.dot(omega, omega) / 4.0
        sinc = radial(1, s)
        # (1 − cos θ)/θ² and (θ − sin θ)/θ³ by half angles, without the cancellation.
        second, third = sinc**2 / 2.0, (sinc**2 - radial(0, s) * radial(2, s)) / 4.0
        once = cross(omega, velocity)
        return jnp.concatenate([_quaternion_exp(omega), velocity + second * once + third * cross(omega, once)])

    def group_log(self, g):
        """The inverse of `group_exp` with an angle of at most π."""
        omega, translation = _quaternion_log(g[:4]), g[4:]
        s = jnp.dot(omega, omega) / 4.0
        once = cross(omega, translation)
        velocity = translation - once / 2.0 + radial(2, s) / (4.0 * radial(1, s)) * cross(omega, once)
        return jnp.concatenate([velocity, omega])


def _quaternion_exp(omega: Float[Array, " 3"]) -> Float[Array, " 4"]:
    s = jnp.dot(omega, omega) / 4.0
    return jnp.concatenate([radial(0, s)[None], 0.5 * radial(1, s) * omega])


def _quaternion_log(q: Float[Array, " 4"]) -> Float[Array, " 3"]:
    # Of q and −q, the one with angle at most π; half the angle is an arc of the unit sphere from (1, 0, 0, 0).
    q = jnp.where(q[0] < 0.0, -q, q)
    sine_squared, cosine = jnp.dot(q[1:], q[1:]), q[0]
    return 2.0 * arc_over_sine(0, sine_squared / (2.0 * (1.0 + cosine)), (1.0 + cosine) / 2.0) * q[1:]


def quarter_turn(v: Float[Array, " 2"]) -> Float[Array, " 2"]:
    """A vector of the plane turned by π/2 to the left."""
    return jnp.stack([-v[1], v[0]])


def cross(a: Float[Array, " 3"], b: Float[Array, " 3"]) -> Float[Array, " 3"]:
    """a × b as one product with the Levi-Civita symbol, which differentiates into products alone."""
    return jnp.sum(_LEVI_CIVITA * (a[None, :, None] * b[None, None, :]), axis=(1, 2))
