"""The trivializations λ_d, λ̃_d, λ̂_d, λ̌_d and Λ_{d±} of [RL] §§3.1, 3.2 and 5.1, with their inverses and adjoints.

Each is a diffeomorphism between trivial bundles, linear where the connection is. Its adjoint pulls covectors back along its
derivative at a point, which a linear one does not need. Points of Q are (n,), of Σ (n − k,), of the group (k,).
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from dirax.program.memo import Memo
from dirax.reduction.connection import AbstractConnection, LinearConnection

Vector = Float[Array, " n"]
Shape = Float[Array, " n-k"]
Group = Float[Array, " k"]
Two = tuple[Array, Array]
Three = tuple[Array, Array, Array]

_checks: Memo[None] = Memo(64)


def checked(connection: Any, sign: str) -> None:
    """Raise `TypeError` for something that is no connection, `ValueError` for a sign other than "+" and "-"."""
    if not isinstance(connection, AbstractConnection):
        raise TypeError(f"connection must be one such as dx.LinearConnection(fibre=[0]), but {connection!r} was given.")
    if sign not in ("+", "-"):
        raise ValueError(f'sign must be "+" or "-", but {sign!r} was given.')


def on_q(connection: AbstractConnection, **vectors: Any) -> tuple[Vector, ...]:
    """Points or covectors of Q as arrays; raises `ValueError` where they have different shapes, or the connection does not fit
    them."""
    arrays = {name: jnp.asarray(value, dtype=float) for name, value in vectors.items()}
    shapes = {name: a.shape for name, a in arrays.items()}
    n = next(iter(shapes.values()))
    if len(n) != 1 or len(set(shapes.values())) > 1:
        raise ValueError(f"{', '.join(shapes)} must be vectors of one length n, but their shapes are {shapes}.")
    _checks.get((connection, n), lambda: connection.check(n[0]))
    return tuple(arrays.values())


def on_factors(connection: AbstractConnection, shape: tuple[str, Any], group: tuple[str, Any], q: tuple[str, Any]) -> Three:
    """Parts in Σ or Σ*, in G or g*, and on Q, named, as arrays; raises `ValueError` for shapes that do not belong together."""
    (q_array,) = on_q(connection, **{q[0]: q[1]})
    n, k = q_array.shape[0], len(connection.fibre)
    found = []
    for (name, value), size in ((shape, n - k), (group, k)):
        found.append(jnp.asarray(value, dtype=float))
        if found[-1].shape != (size,):
            raise ValueError(
                f"{name} must have shape ({size},) beside {q[0]} of shape ({n},), but its shape is {found[-1].shape}."
            )
    return found[0], found[1], q_array


class PairTrivialization(eqx.Module):
    """λ_d: Q × Q → Q × (Σ × G), (q0, q1) ↦ (q0, x1, ω_d(q0, q1)), for the sign "+" ([RL] (3.2)); for "-"
    λ̃_d: Q × Q → (Σ × G) × Q, (q0, q1) ↦ (x0, ω_d(q1, q0), q1) ([RL] Remark 3.1).

        trivialize = dx.PairTrivialization(dx.LinearConnection(fibre=[0]))
        q0, x1, g1 = trivialize(q0, q1)

    Raises `TypeError` for something that is no connection, `ValueError` for another sign and for arrays of wrong shapes.
    """

    connection: AbstractConnection
    sign: str = eqx.field(static=True, default="+")

    def __check_init__(self):
        checked(self.connection, self.sign)

    def __call__(self, q0: Vector, q1: Vector) -> Three:
        """(q0, x1, g1), or (x0, g0, q1) for the sign "-"."""
        return self._forward(*on_q(self.connection, q0=q0, q1=q1))

    def inverse(self, first: Array, second: Array, third: Array) -> Two:
        """(q0, q1) of (q0, x1, g1) ([RL] (3.3)), or of (x0, g0, q1)."""
        return self._backward(*self._given(first, second, third))

    def adjoint(self, first: Array, second: Array, third: Array, at: Two | None = None) -> Two:
        """λ*_d: (p0, w1, r1) ↦ (p0 − ⟨r1, h_d(·, 0)⟩, (w1 − ⟨r1, h_d(0, ·)⟩, r1)) ([RL] (3.4)); (w0, r0, p1) for "-".

        `at` = (q0, q1) is where the derivative is taken, for a connection that is not linear (`ValueError` without it)."""
        covector = self._given(first, second, third)
        return jax.vjp(self._forward, *self._at(at, covector))[1](covector)

    def adjoint_inverse(self, p0: Vector, p1: Vector, at: Two | None = None) -> Three:
        """(λ*_d)⁻¹: (p0, p1) ↦ (p0 + ⟨r1, h_d(·, 0)⟩, w1 + ⟨r1, h_d(0, ·)⟩, r1) ([RL] (3.5)); `at` as in `adjoint`."""
        covector = on_q(self.connection, p0=p0, p1=p1)
        return jax.vjp(self._backward, *self._forward(*self._at(at, covector)))[1](covector)

    def _forward(self, q0, q1) -> Three:
        return self.connection.trivialize_pair(q0, q1) if self.sign == "+" else self.connection.trivialize_pair_backward(q0, q1)

    def _backward(self, first, second, third) -> Two:
        if self.sign == "+":
            return first, self.connection.untrivialize_pair(first, second, third)
        return self.connection.untrivialize_pair_backward(first, second, third), third

    def _given(self, first, second, third) -> Three:
        if self.sign == "+":
            x, g, q = on_factors(self.connection, ("x1", second), ("g1", third), ("q0", first))
            return q, x, g
        return on_factors(self.connection, ("x0", first), ("g0", second), ("q1", third))

    def _at(self, at: Two | None, like: tuple[Array, ...]) -> Two:
        q = like[0] if self.sign == "+" else like[-1]
        if at is None:
            return origin(self.connection, q), origin(self.connection, q)
        return jnp.asarray(at[0], float), jnp.asarray(at[1], float)


class CovectorTrivialization(eqx.Module):
    """λ̂_d: Q × Q* → Q × (Σ* × g*), (q, p) ↦ (q, w + h*_{d,Σ}(r), r) with p = (w, r), for the sign "+" ([RL] (3.6)); for "-"
    λ̌_d: Q* × Q → (Σ* × g*) × Q, (p, q) ↦ (w + h*_{d,Σ}(r), r, q) ([RL] Remark 3.3). r = μ is the momentum map.

    For a connection that is not linear h*_{d,Σ} is A(x)ᵀ, with A(x) = D2 h⁰_d(x, x) at the shape x of q. Raises as
    `PairTrivialization`.
    """

    connection: AbstractConnection
    sign: str = eqx.field(static=True, default="+")

    def __check_init__(self):
        checked(self.connection, self.sign)

    def __call__(self, first: Vector, second: Vector) -> Three:
        """(q, w, μ) of (q, p), or (w, μ, q) of (p, q) for the sign "-"."""
        names = ("q", "p") if self.sign == "+" else ("p", "q")
        return self._forward(*on_q(self.connection, **dict(zip(names, (first, second), strict=True))))

    def inverse(self, first: Array, second: Array, third: Array) -> Two:
        """(q, p) of (q, w, μ) ([RL] (3.7)), or (p, q) of (w, μ, q)."""
        return self._backward(*self._given(("w", "mu", "q"), first, second, third))

    def adjoint(self, first: Array, second: Array, third: Array, at: Three | None = None) -> Two:
        """λ̂*_d: (p1, x1, ξ1) ↦ (p1, (x1, h_{d,Σ}(x1) + ξ1)) ([RL] (3.8)); (x1, ξ1, p1) ↦ (q1, p1) for "-".

        `at` = (q, w, μ), or (w, μ, q), is the point of T*(Q × (Σ* × g*)), for a connection that is not linear."""
        covector = self._given(("x", "xi", "p"), first, second, third)
        point = self._at(at, covector)
        return jax.vjp(self._forward, *self._backward(*point))[1](covector)

    def adjoint_inverse(self, first: Vector, second: Vector, at: Three | None = None) -> Three:
        """(λ̂*_d)⁻¹: (p1, q1) ↦ (p1, x1, g1 − h_{d,Σ}(x1)) ([RL] (3.9)); (q1, p1) ↦ (x1, g1 − h_{d,Σ}(x1), p1) for "-"."""
        names = ("p1", "q1") if self.sign == "+" else ("q1", "p1")
        covector = on_q(self.connection, **dict(zip(names, (first, second), strict=True)))
        return jax.vjp(self._backward, *self._at(at, covector))[1](covector)

    def _forward(self, first, second) -> Three:
        q, p = (first, second) if self.sign == "+" else (second, first)
        q, w, mu = self.connection.trivialize_covector(q, p)
        return (q, w, mu) if self.sign == "+" else (w, mu, q)

    def _backward(self, first, second, third) -> Two:
        q, w, mu = (first, second, third) if self.sign == "+" else (third, first, second)
        p = self.connection.untrivialize_covector(self.connection.split(q)[0], w, mu)
        return (q, p) if self.sign == "+" else (p, q)

    def _given(self, names: tuple[str, str, str], first, second, third) -> Three:
        parts = (first, second, third) if self.sign == "-" else (second, third, first)
        x, g, q = on_factors(self.connection, *((name, part) for name, part in zip(names, parts, strict=True)))
        return (q, x, g) if self.sign == "+" else (x, g, q)

    def _at(self, at: Three | None, like: tuple[Array, ...]) -> Three:
        if at is not None:
            return self._given(("w", "mu", "q"), *at)
        q = like[0] if self.sign == "+" or len(like) == 2 else like[-1]
        return self._forward(origin(self.connection, q), origin(self.connection, q))


class PontryaginTrivialization(eqx.Module):
    """Λ_{d+} = (λ_d, λ̂_d): (q0, q0⁺, q1, p1) ↦ (q0, x0⁺, g0⁺, q1, w1, μ1), for the sign "+" ([RL] (5.2)); for "-"
    Λ_{d−} = (λ̃_d, λ̌_d): (q0⁻, q1, p0, q0) ↦ (x0⁻, g0⁻, q1, w0, μ0, q0) ([RL] (5.4)). Raises as `PairTrivialization`."""

    connection: AbstractConnection
    sign: str = eqx.field(static=True, default="+")

    def __check_init__(self):
        checked(self.connection, self.sign)

    def __call__(self, first: Vector, second: Vector, third: Vector, fourth: Vector) -> tuple[Array, ...]:
        """The six parts."""
        pair, covector = self._maps()
        return (*pair(first, second), *covector(third, fourth))

    def inverse(self, *parts: Array) -> tuple[Array, ...]:
        """The four parts on Q and Q* of six."""
        if len(parts) != 6:
            raise ValueError(f"the inverse of Λ_d takes six arrays, but {len(parts)} were given.")
        pair, covector = self._maps()
        return (*pair.inverse(*parts[:3]), *covector.inverse(*parts[3:]))

    def _maps(self) -> tuple[PairTrivialization, CovectorTrivialization]:
        return PairTrivialization(self.connection, self.sign), CovectorTrivialization(self.connection, self.sign)


def origin(connection: AbstractConnection, like: Array) -> Array:
    """Zero, where a linear map has the derivative that it has everywhere; raises `ValueError` for a connection that is not."""
    if not isinstance(connection, LinearConnection):
        raise ValueError(
            "the adjoint of this trivialization depends on the point, since its connection is not linear: give at=, the point "
            "at which the derivative is taken."
        )
    return jnp.zeros_like(like)
