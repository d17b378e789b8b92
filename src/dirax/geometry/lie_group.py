"""What Lie groups of rotations and translations have in common, with jaxlie's representations.

Coordinates, their order and the conversions to and from matrices are jaxlie's. Products are written here because an
integrator's inner loop holds them.
"""

from abc import abstractmethod
from collections.abc import Callable
from contextlib import contextmanager
from typing import TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Array, Float

from dirax.geometry.manifolds import AbstractGeodesicManifold, Vector
from dirax.geometry.squared_angles import Scalar, norm

Algebra: TypeAlias = Float[Array, " d"]
Rotation: TypeAlias = Float[Array, " r"]
Translation: TypeAlias = Float[Array, " l"]


@contextmanager
def _loose_promotion():
    # jaxlie multiplies float by integer constants, which a program with strict promotion refuses.
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        yield


class AbstractLieGroup(AbstractGeodesicManifold):
    """A Lie group of rotations and translations; an element is a unit complex number or quaternion, and a translation.

    Algebra vectors ξ (d,), ordered (translation, rotation) as in jaxlie, are left-trivialized (body) velocities,
    v = g ξ; a covector p at g has the body momentum Π (d,) with ⟨p, g ξ⟩ = Π·ξ. `exp(g, v)` = g exp(g⁻¹v) follows the
    one-parameter subgroups, which are geodesics of a metric only where the group is `bi_invariant`; `transport` is left
    translation. A metric's `distance` combines the angle of the relative rotation with the distance of the translations.
    """

    rotation_product: eqx.AbstractClassVar[np.ndarray]  # (k, k, k): (r s)_i = Σ rotation_product[i, j, l] r_j s_l
    rotation_basis: eqx.AbstractClassVar[np.ndarray]  # (k, d'): the derivative of exp at 0, on rotations
    translations: eqx.AbstractClassVar[int]
    element: eqx.AbstractClassVar[str]  # what the numbers of one are, in words
    bi_invariant: eqx.AbstractClassVar[bool]
    double_cover: eqx.AbstractClassVar[bool]
    jaxlie_group: eqx.AbstractClassVar[type[jaxlie.MatrixLieGroup]]

    @abstractmethod
    def group_exp(self, xi: Algebra) -> Vector:
        """The exponential exp(ξ) of an algebra vector ξ (d,); the angle is in radians."""

    @abstractmethod
    def group_log(self, g: Vector) -> Algebra:
        """The algebra vector ξ (d,) with exp(ξ) = g and angle at most π."""

    # ------------------------------------------------------------------ the group

    def identity(self) -> Vector:
        """The neutral element."""
        return jnp.asarray(np.eye(self.ambient_dimension)[0])

    def multiply(self, g: Vector, h: Vector) -> Vector:
        """The product g h."""
        (rotation, shift), (other, other_shift) = self._split(g), self._split(h)
        product = self._product(rotation, other)
        return self._join(product, lambda: shift + self._rotate(rotation, other_shift))

    def inverse(self, g: Vector) -> Vector:
        """The inverse g⁻¹."""
        rotation, shift = self._split(g)
        back = self._conjugate(rotation)
        return self._join(back, lambda: -self._rotate(back, shift))

    def adjoint(self, g: Vector) -> Float[Array, "d d"]:
        """The matrix Ad_g: g exp(ξ) g⁻¹ = exp(Ad_g ξ)."""
        with _loose_promotion():
            return self._as_jaxlie(g).adjoint()

    def matrix(self, g: Vector) -> Float[Array, "k k"]:
        """The element as a matrix: 2×2 or 3×3 rotations, homogeneous 3×3 or 4×4 rigid motions."""
        with _loose_promotion():
            return self._as_jaxlie(g).as_matrix()

    def from_matrix(self, matrix: Float[Array, "k k"]) -> Vector:
        """The element with the given matrix."""
        with _loose_promotion():
            return self.jaxlie_group.from_matrix(jnp.asarray(matrix)).parameters()

    def left_translate(self, g: Vector, xi: Algebra) -> Vector:
        """The tangent vector v = g ξ at g."""
        rotation, _ = self._split(g)
        spin = self._product(rotation, jnp.asarray(self.rotation_basis @ xi[self.translations :]))
        return self._join(spin, lambda: self._rotate(rotation, xi[: self.translations]))

    def to_algebra(self, g: Vector, v: Vector) -> Algebra:
        """The body velocity ξ = g⁻¹v of a tangent vector v at g."""
        (rotation, _), (spin, shift) = self._split(g), self._split(v)
        back = self._conjugate(rotation)
        angular = self._spin_lengths(self._product(back, spin))
        return jnp.concatenate([self._rotate(back, shift), angular]) if self.translations else angular

    def body_momentum(self, g: Vector, p: Vector) -> Algebra:
        """The body momentum Π (d,) of a covector p at g: Π·ξ = ⟨p, g ξ⟩."""
        return jax.linear_transpose(lambda xi: self.left_translate(g, xi), jnp.zeros(self.dimension))(p)[0]

    def covector(self, g: Vector, momentum: Algebra) -> Vector:
        """The covector at g, as a tangent vector in ambient coordinates, with the body momentum Π (d,)."""
        # The left-invariant frame is orthogonal in the ambient inner product; its rotations have one length.
        angular = momentum[self.translations :] / np.sum(self.rotation_basis[:, 0] ** 2)
        return self.left_translate(g, jnp.concatenate([momentum[: self.translations], angular]))

    def _as_jaxlie(self, g: Vector) -> jaxlie.MatrixLieGroup:
        return self.jaxlie_group(g)

    def _split(self, x: Vector) -> tuple[Rotation, Translation]:
        return x[: self.rotation_product.shape[0]], x[self.rotation_product.shape[0] :]

    def _join(self, rotation: Rotation, translation: Callable[[], Translation]) -> Vector:
        return jnp.concatenate([rotation, translation()]) if self.translations else rotation

    def _product(self, rotation: Rotation, other: Rotation) -> Rotation:
        return jnp.sum(self.rotation_product * (rotation[None, :, None] * other[None, None, :]), axis=(1, 2))

    def _conjugate(self, rotation: Rotation) -> Rotation:
        return rotation * np.array([1.0] + [-1.0] * (rotation.shape[0] - 1))

    def _rotate(self, rotation: Rotation, v: Translation) -> Translation:
        if self.translations == 2:
            return self._product(rotation, v)
        spin = self._product(rotation, jnp.concatenate([jnp.zeros(1), v]))
        return self._product(spin, self._conjugate(rotation))[1:]

    def _spin_lengths(self, spin: Rotation) -> Float[Array, " s"]:
        return spin[1:] / self.rotation_basis[-1, -1]

    # ------------------------------------------------------------------ the manifold

    def defect(self, x):
        """| ‖rotation‖ − 1 |; translations are anything."""
        return jnp.abs(norm(self._split(x)[0]) - 1.0)

    def nearest(self, x):
        """The rotation divided by its length, the translation as it is."""
        rotation, translation = self._split(x)
        return self._join(rotation / jnp.sqrt(jnp.dot(rotation, rotation)), lambda: translation)

    def projection(self, x, v):
        """v without the part of its rotation along the rotation of x."""
        (rotation, _), (spin, shift) = self._split(x), self._split(v)
        return self._join(spin - rotation * jnp.dot(rotation, spin), lambda: shift)

    def representative(self, x, near):
        """Of a unit quaternion and its negative, the one nearer to that of `near`; else x."""
        if not self.double_cover:
            return x
        rotation, translation = self._split(x)
        sign = jnp.where(jnp.dot(rotation, self._split(near)[0]) < 0.0, -1.0, 1.0)
        return self._join(sign * rotation, lambda: translation)

    def local_parametrization(self, x):
        """r ↦ x exp(r), with the roundoff of products taken away."""
        return lambda r: self.nearest(self.multiply(x, self.group_exp(r)))

    def frame(self, x):
        """The left-invariant frame: x e_i for the basis e_i of the algebra, as columns."""
        return jax.vmap(lambda xi: self.left_translate(x, xi), out_axes=1)(jnp.eye(self.dimension))

    def coordinates(self, x, v):
        """The algebra vector x⁻¹v."""
        return self.to_algebra(x, v)

    def exp(self, x, v):
        """x exp(x⁻¹v), along the one-parameter subgroups."""
        return self.multiply(x, self.group_exp(self.to_algebra(x, v)))

    def log(self, x, y):
        """x log(x⁻¹y)."""
        return self.left_translate(x, self.group_log(self.multiply(self.inverse(x), y)))

    def distance(self, x, y):
        """The angle of the rotation from x to y and the distance of the translations, as legs of a right triangle."""
        relative = self.group_log(self.multiply(self.inverse(x), y))
        return norm(jnp.append(self._split(x)[1] - self._split(y)[1], self._angle(relative)))

    def transport(self, x, v, y):
        """y x⁻¹v: left translation."""
        return self.left_translate(y, self.to_algebra(x, v))

    def retraction(self, x, v):
        """exp(x, v)."""
        return self.exp(x, v)

    def inverse_retraction(self, x, y):
        """log(x, y)."""
        return self.log(x, y)

    def exp_reach(self, x, v):
        """The angle of rotation over π."""
        return self._angle(self.to_algebra(x, v)) / jnp.pi

    def retraction_reach(self, x, v):
        """That of `exp`."""
        return self.exp_reach(x, v)

    def _angle(self, xi: Algebra) -> Scalar:
        return norm(xi[self.translations :])
