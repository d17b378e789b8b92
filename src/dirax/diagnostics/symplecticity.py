"""Symplecticity of one step, and what takes its place under constraints: φ*Ω = Ω + dβ. By automatic differentiation."""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from dirax.engines.xla import first_lane, take_step
from dirax.geometry.structures import canonical_two_form
from dirax.geometry.tulczyjew import slot_derivatives

MAX_ITERATIONS = 50


def begin(system: Any, equation: Any, data: dict[str, Array], h: Any, params: Any):
    """The state (q, p) of an equation at saved data, and a guess of the unknowns of the step leaving it."""
    stage, fraction = equation.stages[0]
    return stage.start(system.complete(data, params, False), fraction * h, params)


def step_map(equation: Any, state, guess, t, h, params):
    """The state after one step, through the engine's solve, and the unknowns of its first stage; differentiable."""
    lane = first_lane(state, (guess,) * len(equation.stages))
    after, unknowns = take_step(equation, lane, t, h, params, MAX_ITERATIONS)
    return after.state, unknowns[0]


def condition_number(equation: Any, unknowns, state, t, h, params) -> Float[Array, ""]:
    """Condition number of the Jacobian of the step's equations, after scaling rows and columns to unit size; ≥ 1."""
    stage, fraction = equation.stages[0]
    if stage.unknowns == 0:
        return jnp.ones(())
    matrix = jax.jacfwd(stage.residual)(unknowns, state, t, fraction * h, params)
    for _ in range(3):
        matrix = matrix / _nonzero(jnp.max(jnp.abs(matrix), axis=1, keepdims=True))
        matrix = matrix / _nonzero(jnp.max(jnp.abs(matrix), axis=0, keepdims=True))
    values = jnp.linalg.svd(matrix, compute_uv=False)
    return values[0] / values[-1]


def symplecticity_defect(system, equation, data, t, h, params) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """(‖JᵀΩJ − Ω‖ relative to ‖|J|ᵀ|Ω||J|‖, condition number) of the step from saved data, J = ∂(q', p')/∂(q, p).

    Entries are the largest ones after q and p were brought to balanced units, q → q√s, p → p/√s.
    """
    state, guess = begin(system, equation, data, h, params)
    jacobian = jax.jacfwd(lambda x: step_map(equation, x, guess, t, h, params)[0])(state)
    _, unknowns = step_map(equation, state, guess, t, h, params)
    n = state.shape[0] // 2
    form = canonical_two_form(n)
    qp, pq = jnp.max(jnp.abs(jacobian[:n, n:])), jnp.max(jnp.abs(jacobian[n:, :n]))
    units = jnp.where((qp > 0) & (pq > 0), (pq / _nonzero(qp)) ** 0.25, 1.0)
    scale = jnp.concatenate([jnp.full(n, units), jnp.full(n, 1 / units)])
    jacobian = jacobian * scale[:, None] / scale[None, :]
    defect = jnp.max(jnp.abs(jacobian.T @ form @ jacobian - form))
    size = jnp.max(jnp.abs(jacobian).T @ jnp.abs(form) @ jnp.abs(jacobian))
    return defect / size, condition_number(equation, unknowns, state, t, h, params)


def structural_defect(ld, constraint, projector, equation, guess, q0, q1, t, h, params):
    """(relative defect of φ*Ω = Ω + dβ, relative size of φ*Ω − Ω, condition number) at a pair (q0, q1) with w_d = 0.

    φ(q0, q1) = (q1, q2) is the discrete Lagrange–d'Alembert map, Ω = −d(−D1 L_d dq0), and β = ⟨F, dq1⟩ with F the part
    in Δ°(q1) of the force D2 L_d(q0, q1) + D1 L_d(q1, q2) ([PY] §3.2, where β is printed over the first point of the
    pair it is seen from after the step, that is q1). Both sides are restricted to the vectors tangent to {w_d = 0}.
    """
    n = q0.shape[0]

    def next_point(z):
        _, p = slot_derivatives(ld, z[:n], z[n:])
        return step_map(equation, jnp.concatenate([z[n:], p]), guess, t, h, params)

    def shifted(z):
        return jnp.concatenate([z[n:], next_point(z)[0][:n]])

    def momentum_form(z):
        return jnp.concatenate([-slot_derivatives(ld, z[:n], z[n:])[0], jnp.zeros(n)])

    def force_form(z):
        after = shifted(z)
        force = slot_derivatives(ld, z[:n], z[n:])[1] + slot_derivatives(ld, z[n:], after[n:])[0]
        return jnp.concatenate([jnp.zeros(n), projector(z[n:]) @ force])

    z = jnp.concatenate([q0, q1])
    jacobian = jax.jacfwd(shifted)(z)
    minus_dtheta = lambda z: -_exterior(jax.jacfwd(momentum_form)(z))
    pulled_back = jacobian.T @ minus_dtheta(shifted(z)) @ jacobian
    force_derivative = jax.jacfwd(force_form)(z)
    tangent = _kernel_basis(jax.jacfwd(lambda z: constraint(z[:n], z[n:]))(z))
    restrict = lambda form: tangent.T @ form @ tangent
    change = pulled_back - minus_dtheta(z)
    size = jnp.max(jnp.abs(jacobian).T @ jnp.abs(minus_dtheta(shifted(z))) @ jnp.abs(jacobian))
    size = jnp.maximum(size, jnp.max(jnp.abs(force_derivative)))
    _, p = slot_derivatives(ld, q0, q1)
    state = jnp.concatenate([q1, p])
    condition = condition_number(equation, next_point(z)[1], state, t, h, params)
    defect = jnp.max(jnp.abs(restrict(change - _exterior(force_derivative))))
    return defect / size, jnp.max(jnp.abs(restrict(change))) / size, condition


def _exterior(derivative):
    """The matrix of dθ, (dθ)_ij = ∂_i θ_j − ∂_j θ_i, from derivative[j, i] = ∂_i θ_j."""
    return derivative.T - derivative


def _kernel_basis(matrix):
    """Orthonormal columns that span ker of a full-rank (m, N) matrix."""
    _, _, right = jnp.linalg.svd(matrix, full_matrices=True)
    return right[matrix.shape[0] :].T


def _nonzero(values):
    return jnp.where(values > 0, values, 1.0)
