"""The dual of a semidirect product 𝔤 ⋉ V: body momenta of a group, with quantities that it carries along."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from dirax.geometry.group_retractions import coadjoint, rotate
from dirax.geometry.lie_group import AbstractLieGroup, Algebra
from dirax.geometry.lie_groups import cross, quarter_turn
from dirax.geometry.manifolds import Vector
from dirax.program.memo import Memo, Same
from dirax.program.user_functions import evaluated, is_traced

Advected = Float[Array, " r"]

KEPT = 1e-9
"""By how much of its values a representation may miss what makes it one."""

_asked: Memo[Any] = Memo(64)


class SemidirectProduct(eqx.Module):
    """Points x = (μ, a): a body momentum μ (d,) of `group` and advected quantities a (r,), r = `advected`.

    a is seen from the body: a_t = g_t⁻¹·a_0 for a motion g_t. The group acts by `representation(matrix, a) -> (r,)`, linear
    in a, of its matrices (homogeneous ones for rigid motions); by default a consists of vectors of the plane or of space,
    which rotations turn and translations leave alone, such as the direction of gravity.
    Raises `TypeError` and `ValueError` for a group that is none of dirax, and for sizes that do not fit.
    """

    group: AbstractLieGroup
    advected: int = eqx.field(static=True, default=0)
    representation: Callable | None = eqx.field(static=True, default=None)

    def __check_init__(self):
        if not isinstance(self.group, AbstractLieGroup):
            raise TypeError(f"group must be a Lie group such as dx.SO3(), but {self.group!r} was given.")
        k = self.vector_size
        if not isinstance(self.advected, int) or self.advected < 0 or (self.representation is None and self.advected % k):
            raise ValueError(
                f"advected must be the number of advected quantities, a multiple of {k} for vectors that the group turns, but "
                f"{self.advected!r} was given: give representation=, a function of (matrix, a), for other quantities."
            )
        if self.representation is not None and not callable(self.representation):
            raise TypeError(f"representation must be a function (matrix, a) -> (r,), but {self.representation!r} was given.")

    @property
    def vector_size(self) -> int:
        """2 for groups of the plane, 3 for those of space."""
        return 3 if self.group.double_cover else 2

    @property
    def dimension(self) -> int:
        """d, the dimension of the group."""
        return self.group.dimension

    @property
    def size(self) -> int:
        """d + r."""
        return self.dimension + self.advected

    def split(self, x: Float[Array, " n"]) -> tuple[Algebra, Advected]:
        """(μ, a)."""
        return x[: self.dimension], x[self.dimension :]

    def act(self, g: Vector, a: Advected) -> Advected:
        """g·a."""
        if not self.advected:
            return a
        if self.representation is not None:
            return self.representation(self.group.matrix(g), a)
        k = self.vector_size
        return jnp.concatenate([rotate(self.group, g, a[i : i + k]) for i in range(0, self.advected, k)])

    def refuse_no_representation(self, a: Advected) -> None:
        """Raise `ValueError` where `representation` is not linear in a, or not one of the group: (gh)·a = g·(h·a) and e·a = a.
        Asked once, of concrete quantities of the size of a."""
        if self.representation is None or is_traced(a):
            return
        size = float(np.max(np.abs(a), initial=0.0)) or 1.0
        key = type(self.group).__name__, self.advected, Same(self.representation)
        off, sizes = np.asarray(_asked.get(key, lambda: evaluated(self._missed, np.asarray(size))))
        if not np.any(missed := ~(off <= KEPT * sizes)):
            return
        law = ("linear in a", "one of the group, (gh)·a = g·(h·a)", "one of the group, e·a = a")[k := int(np.argmax(missed))]
        raise ValueError(
            f"representation(matrix, a) is not {law}: it is off by {off[k]:.2g} where its values are {sizes[k]:.2g}. It "
            "says what g makes of a, of the matrix of g; that bodies see a as g⁻¹·a is seen to by dirax."
        )

    def _missed(self, size: Any) -> Float[Array, "2 3"]:
        """The most by which each law is missed at elements and quantities of one kind, and the size of the values."""
        xi, eta = (jnp.cos(k + jnp.arange(1.0, self.dimension + 1.0)) for k in (0.0, 2.0))
        a, b = (size * jnp.cos(k + jnp.arange(1.0, self.advected + 1.0)) for k in (1.0, 4.0))
        g, h = self.group.group_exp(xi), self.group.group_exp(eta)
        whole = self.act(g, a + 2.0 * b)
        nonlinear = jnp.max(jnp.abs(whole - self.act(g, a) - 2.0 * self.act(g, b)))
        twice = jnp.max(jnp.abs(self.act(self.group.multiply(g, h), a) - self.act(g, self.act(h, a))))
        unmoved = jnp.max(jnp.abs(self.act(self.group.identity(), a) - a))
        of_whole = jnp.max(jnp.abs(whole))
        return jnp.stack([jnp.stack([nonlinear, twice, unmoved]), jnp.stack([of_whole, of_whole, jnp.max(jnp.abs(a))])])

    def carried(self, g: Vector, a: Advected) -> Advected:
        """g⁻¹·a."""
        return self.act(self.group.inverse(g), a) if self.advected else a

    def infinitesimal(self, xi: Algebra, a: Advected) -> Advected:
        """ξ·a, the derivative of exp(εξ)·a at ε = 0."""
        if not self.advected:
            return a
        if self.representation is None:
            return jnp.concatenate([self._turned(xi, part) for part in self._vectors(a)])
        return jax.jvp(lambda xi: self.act(self.group.group_exp(xi), a), (jnp.zeros_like(xi),), (xi,))[1]

    def diamond(self, slope: Advected, a: Advected) -> Algebra:
        """J (d,) with ⟨J, η⟩ = ⟨slope, η·a⟩: the torque that goes with a force `slope` on a."""
        if not self.advected:
            return jnp.zeros(self.dimension)
        if self.representation is None:
            torque = sum(self._moment(part, force) for part, force in zip(self._vectors(a), self._vectors(slope), strict=True))
            return jnp.concatenate([jnp.zeros(self.group.translations), torque])
        zero = jnp.zeros(self.dimension)
        return jax.vjp(lambda xi: self.act(self.group.group_exp(xi), a), zero)[1](slope)[0]

    def _vectors(self, a: Advected) -> list[Float[Array, " k"]]:
        """The vectors that a is made of."""
        k = self.vector_size
        return [a[i : i + k] for i in range(0, self.advected, k)]

    def _turned(self, xi: Algebra, vector: Float[Array, " k"]) -> Float[Array, " k"]:
        """ω × v with the angular velocity ω of ξ."""
        omega = xi[self.group.translations :]
        return omega * quarter_turn(vector) if self.vector_size == 2 else cross(omega, vector)

    def _moment(self, vector: Float[Array, " k"], force: Float[Array, " k"]) -> Float[Array, " d"]:
        """v × f, with ⟨v × f, ω⟩ = ⟨f, ω × v⟩."""
        return jnp.sum(force * quarter_turn(vector))[None] if self.vector_size == 2 else cross(vector, force)

    def ad_star(self, xi: Algebra, momentum: Algebra) -> Algebra:
        """ad*_ξ μ, the derivative of Ad*_{exp(εξ)} μ at ε = 0."""
        flow = lambda xi: coadjoint(self.group, self.group.group_exp(xi), momentum)
        return jax.jvp(flow, (jnp.zeros_like(xi),), (xi,))[1]

    def field(self, x: Float[Array, " n"], xi: Algebra, slope: Advected) -> Float[Array, " n"]:
        """(μ̇, ȧ) = (ad*_ξ μ − J(∂l/∂a, a), −ξ·a)."""
        momentum, a = self.split(x)
        rate = self.ad_star(xi, momentum) - self.diamond(slope, a)
        return jnp.concatenate([rate, -self.infinitesimal(xi, a)]) if self.advected else rate

    def bivector(self, x: Float[Array, " n"]) -> Float[Array, "n n"]:
        """The matrix Λ(x) of the Lie–Poisson bivector: ẋ = Λ(x) dh(x)."""
        d = self.dimension
        return jax.vmap(lambda dh: self.field(x, dh[:d], -dh[d:]), out_axes=1)(jnp.eye(self.size))
