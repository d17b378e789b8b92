"""The reduced (±)-discrete Dirac structures, Dirac differentials, Lagrangians and generalized energies ([RL] §§3–5)."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from dirax.geometry.subspaces import AnyArray
from dirax.numerics.tolerances import STRUCTURE_DEFECT
from dirax.reduction.connection import AbstractConnection
from dirax.reduction.trivializations import (
    CovectorTrivialization,
    PairTrivialization,
    PontryaginTrivialization,
    Three,
    checked,
    on_factors,
)

Function = Callable[..., Float[Array, ""]]
Six = tuple[Array, Array, Array, Array, Array, Array]


class ReducedGeneratingFunctionDirac(eqx.Module):
    """The reduced (±)-discrete Dirac structure [D̂^{d±}] of Q = Σ × G in the trivialization of a connection ([RL] §3.4):

        (+)  ((x0, w0, μ0, q1, w1, μ1), (x0, w1, μ1, p, x1, ξ)) with p = (w0 − h*_{d,Σ}(μ0), μ0), ξ = g1 − h_{d,Σ}(x1),
        (−)  ((q0, w0, μ0, x1, w1, μ1), (w0, μ0, x1, −x0, ξ, p)) with ξ = −g0 + h_{d,Σ}(x0), p = (−w1 + h*_{d,Σ}(μ1), −μ1)

    (Propositions 3.8 and 3.10). A *pair* stands for two trivialized points of T*Q, seen from the point q0 for (+) and q1 for
    (−), whose group coordinate is taken to be 0; a *covector* for one of T*(Q × (Σ* × g*)), seen from there too. They are
    tuples of six arrays: x, w (n − k,); μ, ξ (k,); q, p (n,). For a connection that is not linear these are the images of
    `dx.GeneratingFunctionDirac` by λ̂_d and the adjoint of its derivative: then w1 moves from x1 to x0, h_{d,Σ}(x1) is A(x0) x1,
    and p has the part −∂⟨μ1, A(x) x1⟩/∂x more; (−) likewise.

        D = dx.ReducedGeneratingFunctionDirac(dx.LinearConnection(fibre=[0]), "+")
        D.contains(pair, D.dirac_differential(ld, x0, x1, g1))  # one step of (4.6)

    Raises `TypeError` for something that is no connection, `ValueError` for another sign and for arrays of wrong shapes.
    """

    connection: AbstractConnection
    sign: str = eqx.field(static=True, default="+")

    def __check_init__(self):
        checked(self.connection, self.sign)

    # ------------------------------------------------------------------ quotients

    def tangent_quotient(self, first: Three, second: Three) -> Six:
        """The pair of two points (q, w, μ): (x0, w0, μ0, q1 − g0, w1, μ1) for (+), (q0 − g1, w0, μ0, x1, w1, μ1) for (−)
        ([RL] (3.10), Remark 3.5)."""
        (w0, mu0, q0), (w1, mu1, q1) = (self._point(point, ("w", "mu", "q")) for point in (first, second))
        (x0, g0), (x1, g1) = self.connection.split(q0), self.connection.split(q1)
        if self.sign == "+":
            return x0, w0, mu0, self._moved(q1, -g0), w1, mu1
        return self._moved(q0, -g1), w0, mu0, x1, w1, mu1

    def cotangent_quotient(self, base: Three, covector: Three) -> Six:
        """(x0, w0, μ0, p1, x1, ξ1 − g0) of (p1, x1, ξ1) at (q0, w0, μ0) for (+) ([RL] (3.11)); (w, μ, x1, x, ξ + g1, p) of
        (x, ξ, p) at (w, μ, q1) for (−), where G moves covectors by −g."""
        if self.sign == "+":
            w, mu, q = self._point(base, ("w", "mu", "q"))
            x, xi, p = self._point(covector, ("x", "xi", "p"))
            x0, g0 = self.connection.split(q)
            return x0, w, mu, p, x, xi - g0
        w, mu, q = on_factors(self.connection, ("w", base[0]), ("mu", base[1]), ("q", base[2]))
        x, xi, p = on_factors(self.connection, ("x", covector[0]), ("xi", covector[1]), ("p", covector[2]))
        x1, g1 = self.connection.split(q)
        return w, mu, x1, x, xi + g1, p

    # ------------------------------------------------------------------ the structure

    def flat(self, pair: Six) -> Six:
        """[Ω̂♭_{d±}]: the covector that belongs to a pair ([RL] Lemmas 3.7 and 3.9)."""
        q0, p0, q1, p1 = self._unreduced(pair)
        if self.sign == "+":
            return self._image((q0, p1), (p0, q1))
        return self._image((p0, q1), (-q0, -p1))

    def membership_defect(self, pair: Six, covector: Six) -> Float[Array, " four_n"]:
        """The covector − Ω̂♭_{d±}(pair), side by side: zero iff (pair, covector) ∈ [D̂^{d±}] ([RL] (3.12), (3.13))."""
        if len(covector) != 6:
            raise ValueError(f"a covector is a tuple of six arrays, but {len(covector)} were given.")
        return jnp.concatenate([jnp.asarray(a, float) - b for a, b in zip(covector, self.flat(pair), strict=True)])

    def contains(self, pair: Six, covector: Six, tolerance: float = STRUCTURE_DEFECT) -> Bool[AnyArray, ""]:
        """Whether (pair, covector) ∈ [D̂^{d±}], to `tolerance` relative to the length of the pair."""
        size = jnp.linalg.norm(jnp.concatenate([jnp.asarray(a, float) for a in pair]))
        return jnp.linalg.norm(self.membership_defect(pair, covector)) <= tolerance * size

    # ------------------------------------------------------------------ of a discrete Lagrangian

    def dirac_differential(self, discrete_lagrangian: Function, *parts: Array) -> Six:
        """[D̂^±L_d] of an invariant `discrete_lagrangian(q0, q1)`, a scalar, at (x0, x1, g1) ([RL] Proposition 4.3) or
        (x0, g0, x1) ([RL] Proposition 4.4)."""
        q0, q1 = self._points(*parts)
        d0, d1 = jax.grad(discrete_lagrangian, argnums=(0, 1))(q0, q1)
        return self._image((q0, d1), (-d0, q1)) if self.sign == "+" else self._image((-d0, q1), (-q0, -d1))

    def lagrangian(self, discrete_lagrangian: Function, *parts: Array) -> Float[Array, ""]:
        """l_{d+}(x0, x1, g1) = L_d((x0, 0), (x1, g1 + h⁰_d(x0, x1))) ([RL] (4.5)), or
        l_{d−}(x0, g0, x1) = L_d((x0, g0 + h⁰_d(x1, x0)), (x1, 0)) ([RL] (4.7))."""
        return discrete_lagrangian(*self._points(*parts))

    def energy(self, discrete_lagrangian: Function, *parts: Array) -> Float[Array, ""]:
        """e_{d+}(x0, x0⁺, g0⁺, q1, w1, μ1) = l_{d+} + ⟨w1 − h*μ1, x1 − x0⁺⟩ + ⟨μ1, g1 − g0⁺ − h⁰_d(x0, x0⁺)⟩ ([RL] Lemma 5.1), or
        e_{d−}(x0⁻, g0⁻, x1, w0, μ0, q0) = l_{d−} + ⟨w0 − h*μ0, x0 − x0⁻⟩ + ⟨μ0, g0 − g0⁻ − h⁰_d(x1, x0⁻)⟩ ([RL] Lemma 5.4)."""
        if len(parts) != 6:
            raise ValueError(f"e_d takes six arrays after the discrete Lagrangian, but {len(parts)} were given.")
        whole = self._at_zero(parts[0]) if self.sign == "+" else self._at_zero(parts[2])
        parts = (whole, *parts[1:]) if self.sign == "+" else (*parts[:2], whole, *parts[3:])
        first, second, third, fourth = PontryaginTrivialization(self.connection, self.sign).inverse(*parts)
        along = fourth @ (third - second) if self.sign == "+" else third @ (fourth - first)
        return discrete_lagrangian(first, second) + along

    # ------------------------------------------------------------------ between Q and the quotient

    def _image(self, base: tuple[Array, Array], covector: tuple[Array, Array]) -> Six:
        """A covector of T*(Q × Q*), or T*(Q* × Q), in the trivialization and its quotient."""
        trivialize = CovectorTrivialization(self.connection, self.sign)
        at = trivialize(*base)
        return self.cotangent_quotient(at, trivialize.adjoint_inverse(*covector, at=at))

    def _unreduced(self, pair: Any) -> tuple[Array, Array, Array, Array]:
        """(q0, p0, q1, p1) with group coordinate 0 at one of the points."""
        if len(pair) != 6:
            raise ValueError(f"a pair is a tuple of six arrays, but {len(pair)} were given.")
        one, w0, mu0, other, w1, mu1 = pair
        q0, q1 = (self._at_zero(one), other) if self.sign == "+" else (one, self._at_zero(other))
        untrivialize = CovectorTrivialization(self.connection).inverse
        (q0, p0), (q1, p1) = untrivialize(q0, w0, mu0), untrivialize(q1, w1, mu1)
        return q0, p0, q1, p1

    def _points(self, *parts: Array) -> tuple[Array, Array]:
        """(q0, q1) of (x0, x1, g1), or of (x0, g0, x1)."""
        if len(parts) != 3:
            raise ValueError(f"the discrete Lagrangian is taken at three arrays, but {len(parts)} were given.")
        at = (self._at_zero(parts[0]), *parts[1:]) if self.sign == "+" else (*parts[:2], self._at_zero(parts[2]))
        return PairTrivialization(self.connection, self.sign).inverse(*at)

    def _at_zero(self, x: Array) -> Array:
        """(x, 0)."""
        x = jnp.asarray(x, dtype=float)
        if x.ndim != 1:
            raise ValueError(f"x must be one point of the shape space, (n − k,), but its shape is {x.shape}.")
        return self.connection.join(x, jnp.zeros(len(self.connection.fibre)))

    def _moved(self, q: Array, g: Array) -> Array:
        x, own = self.connection.split(q)
        return self.connection.join(x, own + g)

    def _point(self, parts: Three, names: tuple[str, str, str]) -> Three:
        """(shape part, group part, part on Q) of one with the part on Q first."""
        q, x, g = parts
        return on_factors(self.connection, (names[0], x), (names[1], g), (names[2], q))
