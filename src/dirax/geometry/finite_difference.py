"""The (±)-finite-difference discrete Dirac structures of [PY] §5: on a manifold M, and the induced ones on T*Q.

A pair of points stands for a velocity at one of them: at the new point for (+), at the old one for (−). So the
structure over a point x is the continuous one at x, seen through the finite-difference map, and pairs replace vectors.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

from dirax.geometry.linear import LinearDirac
from dirax.geometry.representations import skew
from dirax.geometry.structures import canonical_two_form
from dirax.geometry.subspaces import AnyArray
from dirax.numerics.tolerances import ONE_FORM_RANK, STRUCTURE_DEFECT
from dirax.program.linear_solves import pseudo_inverse
from dirax.program.tracing import jacobian
from dirax.program.user_functions import UserFunction, is_traced

Vector = Float[Array, " n"]
Covector = Float[Array, " n"]
PhasePoint = Float[Array, " two_n"]


def annihilator_projector(one_forms: Float[Array, "m n"]) -> Float[Array, "n n"]:
    """The orthogonal projector of V* onto Δ° = image Wᵀ, Δ = ker W: W⁺W, by singular values.

    One-forms that depend on the others do not count, whatever units each has, so that W of any rank is accepted; differentiable
    where the rank is constant.
    """
    if one_forms.shape[0] == 0:
        return jnp.zeros((one_forms.shape[1], one_forms.shape[1]))
    rows = one_forms / sizes_of_rows(one_forms)
    return pseudo_inverse(rows, ONE_FORM_RANK) @ rows


def sizes_of_rows(one_forms: Float[Array, "m n"]) -> Float[Array, "m 1"]:
    """The largest number of each row, without a derivative, and 1 for a row of zeros: units, in which one-forms span the same."""
    sizes = jnp.max(jnp.abs(lax.stop_gradient(one_forms)), axis=1, keepdims=True)
    return jnp.where(sizes > 0.0, sizes, 1.0)


def projector_slope(one_forms: Callable, q: Float[Array, " n"], covector: Float[Array, " n"]) -> Float[Array, "n n"]:
    """∂(P(q)α)_i/∂q_j of P(q), the `annihilator_projector` of the one-forms W(q) (m, n), for a covector α that stays:
    dP = W⁺ dW (1 − P) + (W⁺ dW (1 − P))ᵀ where the rank of W is constant (Golub, Pereyra 1973, Lemma 4.1)."""
    w = one_forms(q)
    if w.shape[0] == 0:
        return jnp.zeros((q.shape[0], q.shape[0]))
    units = sizes_of_rows(w)
    w, moved = w / units, jacobian(lambda q: one_forms(q) / units)(q)  # (m, n); (m, n, n), by q last
    inverse = pseudo_inverse(w, ONE_FORM_RANK)
    across = jnp.eye(q.shape[0]) - inverse @ w
    first = inverse @ jnp.einsum("mij,i->mj", moved, across @ covector)
    return first + across @ jnp.einsum("mij,m->ij", moved, inverse.T @ covector)


class FiniteDifferenceDirac(eqx.Module):
    """The (±)-discrete Dirac structure D^{d±} on M = R^n ([PY] Theorem 5.7), of a two-form and a distribution.

        D^{d±}(x) = {((x0, x1), α) : (x0, x1) ∈ Δ^{d±}, α − (Ω^{d±})♭(x0, x1) ∈ (Δ^{d±})°},   x = x1 for (+), x0 for (−).

    `two_form(x[, params])` (n, n), ω[i, j] = ω(e_i, e_j); `one_forms(x[, params])` (m, n), the rows of W with
    Δ = ker W, none by default; `step` is the time h between the two points; `sign` is "+" or "-".
    Raises `ValueError` for another sign, and where it is asked at a point at which the form is not skew.

        D = FiniteDifferenceDirac(lambda x: jnp.array([[0.0, 1.0], [-1.0, 0.0]]), step=0.1, sign="+")
        D.flat(jnp.array([0.0, 0.0]), jnp.array([0.1, 0.2]))  # (−2, 1)
    """

    two_form: UserFunction
    one_forms: UserFunction | None
    step: Float[Array, ""] | float
    sign: str = eqx.field(static=True)

    def __init__(self, two_form: Callable, one_forms: Callable | None = None, *, step: Any, sign: str = "+"):
        self.two_form = UserFunction(two_form, "two_form", ("x",))
        self.one_forms = None if one_forms is None else UserFunction(one_forms, "one_forms", ("x",))
        self.step, self.sign = _checked_step(step), _checked_sign(sign)

    def base_point(self, x0: Vector, x1: Vector) -> Vector:
        """The point over which the pair lies: x1 for (+), x0 for (−)."""
        return floats(x1 if self.sign == "+" else x0)

    def velocity(self, x0: Vector, x1: Vector) -> Vector:
        """ẋ^± = (x1 − x0)/h, the (±)-finite-difference map Ψ at the base point ([PY] Definition 5.1)."""
        return (floats(x1) - floats(x0)) / self.step

    def pairing(self, covector: Covector, x0: Vector, x1: Vector) -> Float[Array, ""]:
        """⟨(x, α), (x0, x1)⟩_{d±} = ⟨α, ẋ^±⟩, α at the base point ([PY] Definition 5.3)."""
        return jnp.vdot(floats(covector), self.velocity(x0, x1))

    def discrete_two_form(self, x0: Vector, x1: Vector, w: Vector, params: Any = None) -> Float[Array, ""]:
        """Ω^{d±}((x0, x1), w) = Ω(x)(ẋ^±, w), w at the base point x ([PY] Definition 5.4)."""
        return jnp.vdot(self.flat(x0, x1, params), floats(w))

    def flat(self, x0: Vector, x1: Vector, params: Any = None) -> Covector:
        """(Ω^{d±})♭(x0, x1), a covector at the base point ([PY] Definition 5.5)."""
        return self._form(self.base_point(x0, x1), params).T @ self.velocity(x0, x1)

    def constraint(self, x0: Vector, x1: Vector, params: Any = None) -> Float[Array, " m"]:
        """W(x) ẋ^±, zero iff (x0, x1) ∈ Δ^{d±} ([PY] Definition 5.6)."""
        return self._matrix(self.base_point(x0, x1), params) @ self.velocity(x0, x1)

    def annihilator(self, x: Vector, params: Any = None) -> Float[Array, "n n"]:
        """The orthogonal projector onto (Δ^{d±})°(x) = image W(x)ᵀ ([PY] Definition 5.6)."""
        return annihilator_projector(self._matrix(x, params))

    def membership_defect(
        self, x0: Vector, x1: Vector, covector: Covector, params: Any = None
    ) -> tuple[Float[Array, " m"], Covector]:
        """(W ẋ^±, the part of α − (Ω^{d±})♭(x0, x1) outside (Δ^{d±})°): both zero iff ((x0, x1), α) ∈ D^{d±}."""
        force = floats(covector) - self.flat(x0, x1, params)
        onto = self.annihilator(self.base_point(x0, x1), params)
        return self.constraint(x0, x1, params), force - onto @ force

    def contains(
        self, x0: Vector, x1: Vector, covector: Covector, params: Any = None, tolerance: float = STRUCTURE_DEFECT
    ) -> Bool[AnyArray, ""]:
        """Whether ((x0, x1), α) ∈ D^{d±} ([PY] Theorem 5.7): its distance is at most `tolerance` of its length."""
        vector = self.velocity(x0, x1)
        return self.at(self.base_point(x0, x1), params).contains(vector, floats(covector), tolerance)

    def orthogonal_defect(
        self, first: tuple[Vector, Vector, Covector], second: tuple[Vector, Vector, Covector]
    ) -> Float[Array, ""]:
        """⟨α, (x0', x1')⟩_{d±} + ⟨α', (x0, x1)⟩_{d±} of two elements ((x0, x1), α) over one point ([PY] (30))."""
        (x0, x1, covector), (y0, y1, other) = first, second
        return self.pairing(covector, y0, y1) + self.pairing(other, x0, x1)

    def at(self, x: Vector, params: Any = None) -> LinearDirac:
        """D^{d±} over the point x as a linear Dirac structure in (ẋ^±, α): D = D^⊥ is [PY] Theorem 5.7.

        Raises `ValueError` where the one-forms are dependent at x or the two-form is not skew.
        """
        if self.one_forms is None:
            return LinearDirac.from_two_form(self._form(x, params))
        return LinearDirac.from_annihilator(self._matrix(x, params), self._form(x, params))

    def _form(self, x, params):
        form = floats(self.two_form(floats(x), params))
        skew("two_form(x)", form)
        return form

    def _matrix(self, x, params):
        return _rows_of(self.one_forms, x, params)


class InducedFiniteDifferenceDirac(eqx.Module):
    """The (±)-discrete Dirac structure on T*Q, Q = R^n, induced by Δ_Q = ker W ([PY] Theorem 5.16, Proposition 5.17).

    Its finite differences are twisted ([PY] Definition 5.8): the momentum is differenced on the far side of the base
    point, so that a third momentum enters, p2 for (+) and p_{−1} for (−). A path element is (q0, q1, p, p'):

        (+) at z1 = (q1, p1):  q̂ = (q1 − q0)/h,  p̂ = (p2 − p1)/h,       `momenta` = (p1, p2)
        (−) at z0 = (q0, p0):  q̂ = (q1 − q0)/h,  p̂ = (p0 − p_{−1})/h,   `momenta` = (p_{−1}, p0)

    and ((z0, z1), (β, γ)) ∈ D^{d±} iff W q̂ = 0, γ = q̂ and β + p̂ ∈ Δ°_Q, with W at the base point.
    `one_forms(q[, params])` (m, n), or None; `step` is h; `sign` is "+" or "-" (`ValueError` otherwise).
    """

    one_forms: UserFunction | None
    step: Float[Array, ""] | float
    sign: str = eqx.field(static=True)

    def __init__(self, one_forms: Callable | None = None, *, step: Any, sign: str = "+"):
        if one_forms is None or isinstance(one_forms, UserFunction):
            self.one_forms = one_forms
        else:
            self.one_forms = UserFunction(one_forms, "one_forms", ("q",))
        self.step, self.sign = _checked_step(step), _checked_sign(sign)

    def base_point(self, q0: Vector, q1: Vector, momenta: tuple[Covector, Covector]) -> tuple[Vector, Covector]:
        """z1 = (q1, p1) for (+), z0 = (q0, p0) for (−)."""
        q, p = (q1, momenta[0]) if self.sign == "+" else (q0, momenta[1])
        return floats(q), floats(p)

    def velocity(self, q0: Vector, q1: Vector, momenta: tuple[Covector, Covector]) -> tuple[Vector, Covector]:
        """ẑ^± = (q̂, p̂), the twisted finite-difference map ([PY] Definition 5.8)."""
        before, after = momenta
        return (floats(q1) - floats(q0)) / self.step, (floats(after) - floats(before)) / self.step

    def pairing(
        self, beta: Covector, gamma: Vector, q0: Vector, q1: Vector, momenta: tuple[Covector, Covector]
    ) -> Float[Array, ""]:
        """⟨(z, β, γ), (z0, z1)⟩_{d±} = ⟨β, q̂⟩ + ⟨p̂, γ⟩, (β, γ) at the base point z ([PY] §5.2)."""
        dq, dp = self.velocity(q0, q1, momenta)
        return jnp.vdot(floats(beta), dq) + jnp.vdot(dp, floats(gamma))

    def canonical_one_form(self, q0: Vector, q1: Vector, momenta: tuple[Covector, Covector]) -> Float[Array, ""]:
        """Θ^{d±}(z0, z1) = ⟨p, q̂⟩, p at the base point ([PY] Definition 5.10)."""
        _, p = self.base_point(q0, q1, momenta)
        return jnp.vdot(p, self.velocity(q0, q1, momenta)[0])

    def discrete_two_form(
        self, q0: Vector, q1: Vector, momenta: tuple[Covector, Covector], w: tuple[Vector, Covector]
    ) -> Float[Array, ""]:
        """Ω^{d±}((z0, z1), w) = Ω(ẑ^±, w), w = (δq, δp) at the base point ([PY] Definition 5.11)."""
        beta, gamma = self.flat(q0, q1, momenta)
        return jnp.vdot(beta, floats(w[0])) + jnp.vdot(gamma, floats(w[1]))

    def flat(self, q0: Vector, q1: Vector, momenta: tuple[Covector, Covector]) -> tuple[Covector, Vector]:
        """(Ω^{d±})♭(z0, z1) = (−p̂, q̂) at the base point ([PY] (32), (33))."""
        dq, dp = self.velocity(q0, q1, momenta)
        return -dp, dq

    def constraint(self, q0: Vector, q1: Vector, params: Any = None) -> Float[Array, " m"]:
        """W q̂ at the base point, zero iff (q0, q1) ∈ Δ_Q^{d±} ([PY] Definition 5.13, lifted by Definition 5.14)."""
        q0, q1 = floats(q0), floats(q1)
        base = q1 if self.sign == "+" else q0
        return _rows_of(self.one_forms, base, params) @ ((q1 - q0) / self.step)

    def annihilator(self, q: Vector, params: Any = None) -> Float[Array, "n n"]:
        """The projector of η onto Δ°_Q(q): the annihilator on T*Q is {(η, ξ) : η ∈ Δ°_Q, ξ = 0} ([PY] (34), (35))."""
        return annihilator_projector(_rows_of(self.one_forms, q, params))

    def membership_defect(
        self,
        q0: Vector,
        q1: Vector,
        momenta: tuple[Covector, Covector],
        beta: Covector,
        gamma: Vector,
        params: Any = None,
    ) -> tuple[Float[Array, " m"], Vector, Covector]:
        """(W q̂, γ − q̂, the part of β + p̂ outside Δ°_Q): all zero iff the element is in D^{d±} ([PY] (37), (39))."""
        base, _ = self.base_point(q0, q1, momenta)
        dq, dp = self.velocity(q0, q1, momenta)
        force = floats(beta) + dp
        return self.constraint(q0, q1, params), floats(gamma) - dq, force - self.annihilator(base, params) @ force

    def contains(
        self,
        q0: Vector,
        q1: Vector,
        momenta: tuple[Covector, Covector],
        beta: Covector,
        gamma: Vector,
        params: Any = None,
        tolerance: float = STRUCTURE_DEFECT,
    ) -> Bool[AnyArray, ""]:
        """Whether the element is in D^{d±} ([PY] Proposition 5.17): its distance is at most `tolerance` of its length."""
        base, _ = self.base_point(q0, q1, momenta)
        vector = jnp.concatenate(self.velocity(q0, q1, momenta))
        return self.at(base, params).contains(vector, jnp.concatenate([floats(beta), floats(gamma)]), tolerance)

    def at(self, q: Vector, params: Any = None) -> LinearDirac:
        """D^{d±} over a point with position q as a linear Dirac structure in ((q̂, p̂), (β, γ)) on R^{2n}.

        Raises `ValueError` where the one-forms are dependent at q.
        """
        form = canonical_two_form(len(q))
        if self.one_forms is None:
            return LinearDirac.from_two_form(form)
        matrix = _rows_of(self.one_forms, q, params)
        return LinearDirac.from_annihilator(jnp.concatenate([matrix, jnp.zeros_like(matrix)], axis=1), form)


def floats(values: Any) -> Array:
    """An array of floats of what may be a list, or of whole numbers."""
    return jnp.asarray(values, dtype=float)


def _rows_of(one_forms: UserFunction | None, x, params):
    if one_forms is None:
        return jnp.zeros((0, len(x)))
    x = floats(x)
    rows = floats(one_forms(x, params))
    if rows.ndim != 2 or rows.shape[1] != x.shape[0]:
        raise ValueError(f"one_forms returned shape {rows.shape}; (m, {x.shape[0]}), one one-form a row, was expected.")
    return rows


def _checked_sign(sign: str) -> str:
    if sign not in ("+", "-"):
        raise ValueError(f'sign must be "+" or "-", but {sign!r} was given.')
    return sign


def _checked_step(step: Any):
    if not is_traced(step) and not (np.ndim(step) == 0 and np.isfinite(step) and step != 0):
        raise ValueError(f"step must be a finite number other than 0, but {step!r} was given.")
    return step
