"""The two-form of a discrete Lagrangian on Q × Q, and what constraint forces change in it in one step ([PY] §3.2)."""

from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from dirax.geometry.finite_difference import projector_slope
from dirax.numerics.arrays import Data
from dirax.numerics.ranks import significant
from dirax.numerics.tolerances import PAIR_RANK
from dirax.program.tracing import jacobian as jacobian_of
from dirax.schemes.discrete_structure import AbstractStepForm, DifferentiatedStep, nonzero
from dirax.schemes.step_forms import pulled_back


class FormOnPairs(AbstractStepForm):
    """φ*Ω = Ω + dβ at a pair (q0, q1) with w_d(q0, q1) = 0, under constraints.

    φ(q0, q1) = (q1, q2) is the discrete Lagrange–d'Alembert map, Ω = −d(−D1 L_d dq0) = F⁻L_d*(dq ∧ dp), and
    β = ⟨F, dq1⟩ with F the part in Δ°(q1) of D2 L_d(q0, q1) + D1 L_d(q1, q2) ([PY] §3.2). There β_d is printed as a
    pull-back from the first point of the pair; the variation (11) puts the force at q1, the first point of φ(q0, q1), and
    only this makes the relation true. Both sides are restricted to the vectors tangent to {w_d = 0}, or {w_d = 0, g(q0) = 0,
    g(q1) = 0}, where dβ has no part from holonomic constraints: without others φ is symplectic.
    """

    pairs: Any
    """The `LagrangianPairs` whose L_d and constraints these are."""

    @property
    def name(self) -> str:
        return "structural relation φ*Ω = Ω + dβ"

    @property
    def points(self) -> int:
        return 2

    def told(self, numbers: Any, place: str) -> str:
        return f"on the pairs with w_d = 0, {place}; without dβ it would be off by {numbers[1]:.2g}"

    @property
    def reads(self) -> tuple[str, ...]:
        return ("q",)

    def begins(self, equation: Any, rows: Data, params: Any) -> tuple[Float[Array, " s"], Float[Array, " k"]]:
        q0, q1 = rows["q"]
        first = equation.stages[0][0]
        guess = jnp.concatenate([(q1 - q0) / self.pairs.step, jnp.zeros(first.unknowns - q0.shape[0])])
        of_start = jnp.zeros(first.state_size - first.state_layout.place("p").stop)
        return jnp.concatenate([q1, self.pairs.slots(rows["t"][0], q0, q1, params)[1], of_start]), guess

    def terms(self, step: DifferentiatedStep, equation: Any, rows: Data, params: Any) -> Float[Array, "2 2 s s"]:
        """Those of φ*Ω − Ω − dβ, and those of φ*Ω − Ω."""
        pairs, (q0, q1), (before, t) = self.pairs, rows["q"], rows["t"]
        n = q0.shape[0]
        d1 = lambda t, a, b: pairs.slots(t, a, b, params)[0]
        d2 = lambda t, a, b: pairs.slots(t, a, b, params)[1]

        def state_of(z):
            return jnp.concatenate([z[n:], d2(before, z[:n], z[n:])])

        def sum_at_q1(z, c):
            return d2(before, z[:n], z[n:]) + d1(t, z[n:], c)

        def lagrangian_two_form(t, z):
            """−dΘ of Θ = −D1 L_d dq0: dq0 ∧ dq1 with the coefficients −D1 D2 L_d, and nothing else (D1 D1 L_d is symmetric)."""
            mixed = -jacobian_of(lambda b: d1(t, z[:n], b))(z[n:])  # ∂p0_i/∂q1_j
            zero = jnp.zeros((n, n))
            return jnp.block([[zero, mixed], [-mixed.T, zero]])

        z = jnp.concatenate([q0, q1])
        of_pair, (after, of_state, _) = jacobian_of(state_of)(z), step
        q2, q2_of_pair = after[:n], of_state[:n, : 2 * n] @ of_pair
        jacobian = jnp.concatenate([jnp.eye(2 * n)[n:], q2_of_pair])  # of φ
        of_z, of_q2 = jacobian_of(sum_at_q1, argnums=(0, 1))(z, q2)
        force = pairs.annihilator(t, q1, params) @ (of_z + of_q2 @ q2_of_pair)
        turning = projector_slope(lambda q: pairs.matrix(t, q, params), q1, sum_at_q1(z, q2))
        beta = jnp.concatenate([jnp.zeros((n, 2 * n)), force.at[:, n:].add(turning)])  # ∂_j β_i
        two_form, two_form_after = lagrangian_two_form(before, z), lagrangian_two_form(t, jnp.concatenate([q1, q2]))
        change = pulled_back(two_form_after, jacobian) - two_form
        dbeta = beta.T - beta  # (dβ)_ij = ∂_i β_j − ∂_j β_i

        def constraints_of_pair(z):
            first = pairs.system.constraints.position_defect(before, z[:n], params)
            return jnp.concatenate([pairs.constraint(before, z[:n], z[n:], params), first])

        units = _units(two_form[:n, n:])
        constraint_matrix = jacobian_of(constraints_of_pair)(z) * units[None]
        constraint_matrix = constraint_matrix / nonzero(jnp.max(jnp.abs(constraint_matrix), axis=1, keepdims=True))
        _, values, right = jnp.linalg.svd(constraint_matrix, full_matrices=True)
        kept = jnp.concatenate([significant(values, PAIR_RANK, xp=jnp), jnp.zeros(right.shape[0] - values.shape[0], bool)])
        tangent = jnp.where(kept, 0.0, right.T)  # without the normal vectors, as many as there are independent constraints
        sizes = pulled_back(jnp.abs(two_form_after), jnp.abs(jacobian)) + jnp.abs(beta) + jnp.abs(beta).T
        scaled = lambda form: form * units[None] * units[:, None]
        size = jnp.full_like(sizes, jnp.max(scaled(sizes)))  # entries have one unit, and belong to no coordinates
        return jnp.stack([jnp.stack([pulled_back(scaled(form), tangent), size]) for form in (change - dbeta, change)])


def _units(mixed: Array) -> Array:
    """Units (2n,) of two points in which every coordinate has the same mass, of the slope of p0 by q1; relative to the first."""
    masses = jnp.abs(jnp.diag(mixed))
    masses = jnp.where(masses > 0.0, masses, jnp.max(masses))
    units = jnp.sqrt(nonzero(masses[0]) / nonzero(masses))
    return jnp.concatenate([units, units])
