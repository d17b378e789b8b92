"""Discrete mechanics on Q × Q: the discrete Euler–Lagrange map, the one-forms and the two-form of L_d, its flow ([PY] §3)."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from dirax.geometry.linear import LinearDirac
from dirax.geometry.tulczyjew import slot_derivatives
from dirax.program.roots import regular_root
from dirax.program.user_functions import UserFunction, evaluated

Vector = Float[Array, " n"]
Form = Float[Array, " 2*n"]


class DiscreteLagrangianSystem(eqx.Module):
    """A discrete Lagrangian on Q × Q, Q = R^n, with what it makes there ([PY] §3, (11)–(21)).

    `discrete_lagrangian(q0, q1[, params])` returns a scalar; `one_forms(q[, params])` the rows (m, n) of W with Δ_Q = ker W,
    none by default. `sign` says where a discrete constraint W Δq = 0 is taken: "+" at the second point, "-" at the first, as
    in (17). One-forms and vectors on Q × Q are (2n,), in the order (q0, q1). Raises `TypeError` for functions of other
    arguments, `ValueError` for another sign and for points of different shapes.

        pairs = dx.DiscreteLagrangianSystem(lambda q0, q1: (q1 - q0) @ (q1 - q0) / 0.2 - 0.1 * q0 @ q0 / 2)
        q1, q2 = pairs.flow(q0, q1)
    """

    discrete_lagrangian: UserFunction
    one_forms: UserFunction | None
    sign: str = eqx.field(static=True)

    def __init__(self, discrete_lagrangian: Callable, one_forms: Callable | None = None, *, sign: str = "-"):
        if sign not in ("+", "-"):
            raise ValueError(f'sign must be "+" or "-", but {sign!r} was given.')
        self.discrete_lagrangian = UserFunction(discrete_lagrangian, "discrete_lagrangian", ("q0", "q1"))
        self.one_forms = None if one_forms is None else UserFunction(one_forms, "one_forms", ("q",))
        self.sign = sign

    def euler_lagrange(self, q0: Vector, q1: Vector, q2: Vector, params: Any = None) -> Vector:
        """D_DEL L_d((q0, q1), (q1, q2)) = D2 L_d(q0, q1) + D1 L_d(q1, q2), the discrete Euler–Lagrange map ([PY] (11), (13))."""
        q0, q1, q2 = _points(q0, q1, q2)
        return self._slots(q0, q1, params)[1] + self._slots(q1, q2, params)[0]

    def plus_form(self, q0: Vector, q1: Vector, params: Any = None) -> Form:
        """Θ⁺ = D2 L_d dq1 ([PY] §3.1); Θ⁺ − Θ⁻ = dL_d."""
        q0, q1 = _points(q0, q1)
        return jnp.concatenate([jnp.zeros_like(q0), self._slots(q0, q1, params)[1]])

    def minus_form(self, q0: Vector, q1: Vector, params: Any = None) -> Form:
        """Θ⁻ = −D1 L_d dq0 ([PY] §3.1)."""
        q0, q1 = _points(q0, q1)
        return jnp.concatenate([-self._slots(q0, q1, params)[0], jnp.zeros_like(q0)])

    def two_form(self, q0: Vector, q1: Vector, params: Any = None) -> Float[Array, "2*n 2*n"]:
        """Ω_{L_d} = −dΘ⁺ = −dΘ⁻, Ω[i, j] = Ω(e_i, e_j): the pull-back of dq ∧ dp by either Legendre transform ([PY] §3.1)."""
        q0, q1 = _points(q0, q1)
        mixed = -jax.jacfwd(lambda b: self._slots(q0, b, params)[0])(q1)  # ∂p0_i/∂q1_j
        zero = jnp.zeros_like(mixed)
        return jnp.block([[zero, mixed], [-mixed.T, zero]])

    def dirac_structure(self, q0: Vector, q1: Vector, params: Any = None) -> LinearDirac:
        """The graph of Ω_{L_d}♭ on T(Q × Q), with constraints that on the vectors with δq0 ∈ Δ_Q(q0), δq1 ∈ Δ_Q(q1).

        Raises `ValueError` where the one-forms are dependent."""
        form = self.two_form(q0, q1, params)
        if self.one_forms is None:
            return LinearDirac.from_two_form(form)
        first, last = (self._matrix(q, params) for q in _points(q0, q1))
        zero = jnp.zeros_like(first)
        rows = jnp.concatenate([jnp.concatenate([first, zero], axis=1), jnp.concatenate([zero, last], axis=1)])
        return LinearDirac.from_annihilator(rows, form)

    def constraint(self, q0: Vector, q1: Vector, params: Any = None) -> Float[Array, " m"]:
        """w_d(q0, q1) = W Δq at the point of the sign ([PY] (17))."""
        q0, q1 = _points(q0, q1)
        return self._matrix(q1 if self.sign == "+" else q0, params) @ (q1 - q0)

    def flow(self, q0: Vector, q1: Vector, params: Any = None) -> tuple[Vector, Vector]:
        """φ: (q0, q1) ↦ (q1, q2) with D_DEL L_d ∈ Δ°_Q(q1) and w_d(q1, q2) = 0 ([PY] (19)–(21)); NaN where Newton's method,
        from the velocity of the pair, does not converge."""
        q0, q1 = _points(q0, q1)
        return q1, jnp.asarray(evaluated(self._next, q0, q1, params))

    def _next(self, q0: Vector, q1: Vector, params: Any) -> Vector:
        arriving, rows, n = self._slots(q0, q1, params)[1], self._matrix(q1, params), q1.shape[0]

        def residual(u):
            q2 = u[:n]
            balance = arriving + self._slots(q1, q2, params)[0] - rows.T @ u[n:]
            return jnp.concatenate([balance, self.constraint(q1, q2, params)])

        return regular_root(residual, jnp.concatenate([2.0 * q1 - q0, jnp.zeros(rows.shape[0])]))[:n]

    def _slots(self, q0: Vector, q1: Vector, params: Any) -> tuple[Vector, Vector]:
        return slot_derivatives(lambda a, b: self.discrete_lagrangian(a, b, params), q0, q1)

    def _matrix(self, q: Vector, params: Any) -> Float[Array, "m n"]:
        return jnp.zeros((0, q.shape[0])) if self.one_forms is None else jnp.asarray(self.one_forms(q, params), dtype=float)


def _points(*points: Any) -> tuple[Vector, ...]:
    arrays = tuple(jnp.asarray(q, dtype=float) for q in points)
    if arrays[0].ndim != 1 or len({q.shape for q in arrays}) > 1:
        raise ValueError(f"the points must have one shape (n,), but their shapes are {', '.join(str(q.shape) for q in arrays)}.")
    return arrays
