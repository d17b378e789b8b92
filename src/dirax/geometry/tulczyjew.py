"""Tulczyjew triples, continuous and discrete: all arrows, Dirac differentials, discrete Legendre transforms.

A triple joins three bundles by diffeomorphisms, gamma = flat ∘ kappa⁻¹:

    T*(TQ)  ←kappa—  T(T*Q)  —flat→  T*(T*Q)        discrete:  T*(Q × Q)  ←kappa—  T*Q × T*Q  —flat→  (see each class)

Points are tuples of (n,) arrays: T(T*Q) ∋ (q, p, q̇, ṗ), T*(TQ) ∋ (q, q̇, α_q, α_q̇), T*(T*Q) ∋ (q, p, β, γ),
T*Q × T*Q ∋ (q0, p0, q1, p1), T*(Q × Q) ∋ (q0, q1, α_0, α_1).
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from dirax.geometry.finite_difference import InducedFiniteDifferenceDirac, floats
from dirax.geometry.generating_functions import GeneratingFunctionDirac
from dirax.program.roots import regular_root
from dirax.program.tracing import gradient

Vector = Float[Array, " n"]
Four = tuple[Vector, Vector, Vector, Vector]
Function = Callable[[Vector, Vector], Any]


def slot_derivatives(function: Function, q0: Vector, q1: Vector) -> tuple[Vector, Vector]:
    """(D1 f, D2 f) at (q0, q1), each (n,): the components of df on TQ or on Q × Q."""
    return gradient(function, (0, 1))(*map(floats, (q0, q1)))


def plus_legendre(discrete_lagrangian: Function, q0: Vector, q1: Vector) -> tuple[Vector, Vector]:
    """F⁺L_d(q0, q1) = (q1, D2 L_d) ∈ T*Q ([PY] (14))."""
    q0, q1 = map(floats, (q0, q1))
    return q1, slot_derivatives(discrete_lagrangian, q0, q1)[1]


def minus_legendre(discrete_lagrangian: Function, q0: Vector, q1: Vector) -> tuple[Vector, Vector]:
    """F⁻L_d(q0, q1) = (q0, −D1 L_d) ∈ T*Q ([PY] (14))."""
    q0, q1 = map(floats, (q0, q1))
    return q0, -slot_derivatives(discrete_lagrangian, q0, q1)[0]


class TulczyjewTriple(eqx.Module):
    """The Tulczyjew triple of Q = R^n ([PY] (26)): kappa and flat carry the symplectic form dq ∧ dṗ + dq̇ ∧ dp of T(T*Q)
    to the canonical one of T*(TQ), and to minus that of T*(T*Q)."""

    def flat(self, q: Vector, p: Vector, dq: Vector, dp: Vector) -> Four:
        """Ω♭: T(T*Q) → T*(T*Q), (q, p, q̇, ṗ) ↦ (q, p, −ṗ, q̇)."""
        q, p, dq, dp = map(floats, (q, p, dq, dp))
        return q, p, -dp, dq

    def flat_inverse(self, q: Vector, p: Vector, beta: Vector, gamma: Vector) -> Four:
        """T*(T*Q) → T(T*Q), (q, p, β, γ) ↦ (q, p, γ, −β)."""
        q, p, beta, gamma = map(floats, (q, p, beta, gamma))
        return q, p, gamma, -beta

    def kappa(self, q: Vector, p: Vector, dq: Vector, dp: Vector) -> Four:
        """κ: T(T*Q) → T*(TQ), (q, p, q̇, ṗ) ↦ (q, q̇, ṗ, p)."""
        return q, dq, dp, p

    def kappa_inverse(self, q: Vector, dq: Vector, alpha_q: Vector, alpha_dq: Vector) -> Four:
        """T*(TQ) → T(T*Q), (q, q̇, α_q, α_q̇) ↦ (q, α_q̇, q̇, α_q)."""
        return q, alpha_dq, dq, alpha_q

    def gamma(self, q: Vector, dq: Vector, alpha_q: Vector, alpha_dq: Vector) -> Four:
        """γ = Ω♭ ∘ κ⁻¹: T*(TQ) → T*(T*Q), (q, q̇, α_q, α_q̇) ↦ (q, α_q̇, −α_q, q̇)."""
        return self.flat(*self.kappa_inverse(q, dq, alpha_q, alpha_dq))

    def gamma_inverse(self, q: Vector, p: Vector, beta: Vector, gamma: Vector) -> Four:
        """T*(T*Q) → T*(TQ), (q, p, β, γ) ↦ (q, γ, −β, p)."""
        return self.kappa(*self.flat_inverse(q, p, beta, gamma))

    def dirac_differential(self, lagrangian: Function, q: Vector, v: Vector) -> Four:
        """d_D L = γ ∘ dL: TQ → T*(T*Q), (q, v) ↦ (q, ∂L/∂v, −∂L/∂q, v) ([PY] (27))."""
        return self.gamma(q, v, *slot_derivatives(lagrangian, q, v))


class FiniteDifferenceTriple(eqx.Module):
    """The (±)-discrete triple of [PY] §6.1 on Q = R^n, with the twisted finite differences of Definition 5.8.

    `step` is h, `sign` "+" or "-" (`ValueError` otherwise). The flat lands in T*(T*Q) over z1 for (+) and over z0 for
    (−), and needs one momentum from the neighbouring step, `far`: p2 for (+), p_{−1} for (−); the other end's momentum
    does not enter it. So flat is invertible on (q0, q1, near, far), near = p1 or p0.
    """

    structure: InducedFiniteDifferenceDirac

    def __init__(self, *, step: Any, sign: str = "+"):
        self.structure = InducedFiniteDifferenceDirac(step=step, sign=sign)

    @property
    def sign(self) -> str:
        """ "+" or "-"."""
        return self.structure.sign

    @property
    def step(self) -> Any:
        """h."""
        return self.structure.step

    def flat(self, q0: Vector, p0: Vector, q1: Vector, p1: Vector, far: Vector) -> Four:
        """(Ω^{d±})♭: (z0, z1) ↦ (q1, p1, −(p2 − p1)/h, q̂) for (+), (q0, p0, −(p0 − p_{−1})/h, q̂) for (−) ([PY] (32), (33))."""
        momenta = (p1, far) if self.sign == "+" else (far, p0)
        return (*self.structure.base_point(q0, q1, momenta), *self.structure.flat(q0, q1, momenta))

    def flat_inverse(self, q: Vector, p: Vector, beta: Vector, gamma: Vector) -> Four:
        """(q0, q1, near, far) of the pairs that flat sends to (q, p, β, γ)."""
        if self.sign == "+":
            return q - self.step * gamma, q, p, p - self.step * beta
        return q, q + self.step * gamma, p, p + self.step * beta

    def kappa(self, q0: Vector, p0: Vector, q1: Vector, p1: Vector) -> Four:
        """κ^d: T*Q × T*Q → T*(Q × Q), (q0, p0, q1, p1) ↦ (q0, q1, −p0, p1) ([PY] (44))."""
        return q0, q1, -p0, p1

    def kappa_inverse(self, q0: Vector, q1: Vector, alpha_0: Vector, alpha_1: Vector) -> Four:
        """T*(Q × Q) → T*Q × T*Q, (q0, q1, α_0, α_1) ↦ (q0, −α_0, q1, α_1)."""
        return q0, -alpha_0, q1, alpha_1

    def gamma(self, q0: Vector, q1: Vector, alpha_0: Vector, alpha_1: Vector, far: Vector) -> Four:
        """γ^{d±} = (Ω^{d±})♭ ∘ (κ^d)⁻¹: T*(Q × Q) → T*(T*Q) ([PY] (45))."""
        return self.flat(*self.kappa_inverse(q0, q1, alpha_0, alpha_1), far)

    def dirac_differential(self, discrete_lagrangian: Function, a: Vector, b: Vector, c: Vector) -> Four:
        """d_D^±L_d at three points in a row, over the middle one, b ([PY] Definition 6.5).

        (+) at (q0, v0) = (a, b), next point c: (b, D2 L_d(a, b), −(D2 L_d + D1 L_d)(b, c)/h, (b − a)/h), (46);
        (−) at (v1, q1) = (b, c), point before a: (b, −D1 L_d(b, c), −(D2 L_d + D1 L_d)(a, b)/h, (c − b)/h), (47).
        It is γ^{d±} ∘ dL_d with both momenta of β from one step; they match where the discrete Euler–Lagrange equations hold.
        """
        if self.sign == "+":
            q, p = plus_legendre(discrete_lagrangian, a, b)
            d1, d2 = slot_derivatives(discrete_lagrangian, b, c)
            return q, p, -(d2 + d1) / self.step, (b - a) / self.step
        q, p = minus_legendre(discrete_lagrangian, b, c)
        d1, d2 = slot_derivatives(discrete_lagrangian, a, b)
        return q, p, -(d2 + d1) / self.step, (c - b) / self.step


class GeneratingFunctionTriple(eqx.Module):
    """The (±)-discrete triple of [RL] (2.7), (2.8) on Q = R^n: all arrows are symplectic diffeomorphisms, up to sign.

    `sign` is "+" (type 2, over (q0, p1)) or "-" (type 3, over (p0, q1)); `ValueError` otherwise.
    """

    structure: GeneratingFunctionDirac

    def __init__(self, sign: str = "+"):
        self.structure = GeneratingFunctionDirac(sign)

    @property
    def sign(self) -> str:
        """ "+" or "-"."""
        return self.structure.sign

    def flat(self, q0: Vector, p0: Vector, q1: Vector, p1: Vector) -> Four:
        """Ω♭_{d±}: (z0, z1) ↦ (q0, p1, p0, q1) for (+), (p0, q1, −q0, −p1) for (−)."""
        base, covector = self.structure.flat((q0, p0), (q1, p1))
        return (*base, *covector)

    def flat_inverse(self, a: Vector, b: Vector, alpha: Vector, beta: Vector) -> Four:
        """T*(Q × Q*) or T*(Q* × Q) → T*Q × T*Q."""
        z0, z1 = self.structure.flat_inverse((a, b), (alpha, beta))
        return (*z0, *z1)

    def kappa(self, q0: Vector, p0: Vector, q1: Vector, p1: Vector) -> Four:
        """κ^d: T*Q × T*Q → T*(Q × Q), (q0, p0, q1, p1) ↦ (q0, q1, −p0, p1)."""
        return q0, q1, -p0, p1

    def kappa_inverse(self, q0: Vector, q1: Vector, alpha_0: Vector, alpha_1: Vector) -> Four:
        """T*(Q × Q) → T*Q × T*Q."""
        return q0, -alpha_0, q1, alpha_1

    def gamma(self, q0: Vector, q1: Vector, alpha_0: Vector, alpha_1: Vector) -> Four:
        """γ^{d±} = Ω♭_{d±} ∘ (κ^d)⁻¹: T*(Q × Q) → T*(Q × Q*) for (+), T*(Q* × Q) for (−)."""
        return self.flat(*self.kappa_inverse(q0, q1, alpha_0, alpha_1))

    def gamma_inverse(self, a: Vector, b: Vector, alpha: Vector, beta: Vector) -> Four:
        """T*(Q × Q*) or T*(Q* × Q) → T*(Q × Q)."""
        return self.kappa(*self.flat_inverse(a, b, alpha, beta))

    def dirac_differential(self, discrete_lagrangian: Function, q0: Vector, q1: Vector) -> Four:
        """D^±L_d = γ^{d±} ∘ dL_d: (q0, D2 L_d, −D1 L_d, q1) for (+), (−D1 L_d, q1, −q0, −D2 L_d) for (−) ([RL] §2.3.2)."""
        return self.gamma(q0, q1, *slot_derivatives(discrete_lagrangian, q0, q1))


class DiscreteEvolution(eqx.Module):
    """The (±)-discrete evolution operators X^{d±} and flow maps φ^{d±} of a discrete Lagrange–Dirac system on Q = R^n.

    `discrete_lagrangian(q0, q1)` returns a scalar; `one_forms(q)` the rows (m, n) of W with Δ_Q = ker W, none by default;
    `step` is h, `sign` "+" or "-" (`ValueError` otherwise). They solve the (±)-discrete Lagrange–d'Alembert–Pontryagin
    equations ([PY] (53), (54)) on T*Q, with p_{k+1} = D2 L_d(q_k, q_{k+1}) for (+) and p_k = −D1 L_d(q_k, q_{k+1}) for
    (−), by Newton's method from the `velocity` guess (n,), zero by default; NaN where it does not converge.
    """

    discrete_lagrangian: Function = eqx.field(static=True)
    structure: InducedFiniteDifferenceDirac

    def __init__(self, discrete_lagrangian: Function, one_forms: Callable | None = None, *, step: Any, sign: str = "+"):
        self.discrete_lagrangian = discrete_lagrangian
        self.structure = InducedFiniteDifferenceDirac(one_forms, step=step, sign=sign)

    def plus_operator(self, q1: Vector, p1: Vector, velocity: Vector | None = None) -> Four:
        """X^{d+}: z1 ↦ (z0, z1), a section of the projection onto the second point ([PY] Definition 6.6)."""
        return (*self.inverse_flow(q1, p1, velocity), q1, p1)

    def minus_operator(self, q0: Vector, p0: Vector, velocity: Vector | None = None) -> Four:
        """X^{d−}: z0 ↦ (z0, z1), a section of the projection onto the first point ([PY] Definition 6.6)."""
        return (q0, p0, *self.flow(q0, p0, velocity))

    def flow(self, q0: Vector, p0: Vector, velocity: Vector | None = None) -> tuple[Vector, Vector]:
        """φ^{d±}: z0 ↦ z1; the map F⁺L_d ∘ (F⁻L_d)⁻¹ of [PY] (42) where there are no constraints."""
        if self.structure.sign == "+":
            q1 = self._near_step(q0, p0, velocity, 1.0)
            return plus_legendre(self.discrete_lagrangian, q0, q1)
        return self._far_step(q0, p0, velocity, 1.0)

    def inverse_flow(self, q1: Vector, p1: Vector, velocity: Vector | None = None) -> tuple[Vector, Vector]:
        """(φ^{d±})⁻¹: z1 ↦ z0."""
        if self.structure.sign == "-":
            q0 = self._near_step(q1, p1, velocity, -1.0)
            return minus_legendre(self.discrete_lagrangian, q0, q1)
        return self._far_step(q1, p1, velocity, -1.0)

    def _outgoing(self, a: Vector, b: Vector, direction: float) -> Vector:
        """The Legendre momentum at a of the step between a and b: −D1 L_d(a, b) forwards, D2 L_d(b, a) backwards."""
        if direction > 0:
            return minus_legendre(self.discrete_lagrangian, a, b)[1]
        return plus_legendre(self.discrete_lagrangian, b, a)[1]

    def _near_step(self, q: Vector, p: Vector, velocity: Vector | None, direction: float) -> Vector:
        """The other point of the step from q: p − (Legendre momentum at q) ∈ Δ°(q), the constraint at the other point."""
        n, h = q.shape[0], direction * self.structure.step
        w = self._matrix(q)

        def residual(u):
            other = q + h * u[:n]
            return jnp.concatenate([p - self._outgoing(q, other, direction) - w.T @ u[n:], self._matrix(other) @ u[:n]])

        u = regular_root(residual, jnp.concatenate([_guess(velocity, q), jnp.zeros(w.shape[0])]))
        return q + h * u[:n]

    def _far_step(self, q: Vector, p: Vector, velocity: Vector | None, direction: float) -> tuple[Vector, Vector]:
        """The other point r of the step whose Legendre momentum at q is p, and the momentum there, that of the step
        after: it differs from the incoming one by a force in Δ°(r), and the step after satisfies the constraint at r."""
        n, h = q.shape[0], direction * self.structure.step

        def parts(u):
            r = q + h * u[:n]
            return r, self._outgoing(r, r + h * u[n : 2 * n], direction)

        def residual(u):
            r, momentum = parts(u)
            w = self._matrix(r)
            jump = momentum - self._outgoing(r, q, -direction) - w.T @ u[2 * n :]
            return jnp.concatenate([p - self._outgoing(q, r, direction), jump, w @ u[n : 2 * n]])

        start = _guess(velocity, q)
        return parts(regular_root(residual, jnp.concatenate([start, start, jnp.zeros(self._matrix(q).shape[0])])))

    def _matrix(self, q: Vector) -> Float[Array, "m n"]:
        forms = self.structure.one_forms
        return jnp.zeros((0, q.shape[0])) if forms is None else forms(q, None)


def _guess(velocity: Vector | None, q: Vector) -> Vector:
    return jnp.zeros_like(q) if velocity is None else jnp.asarray(velocity, dtype=float)
