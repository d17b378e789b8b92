"""Method 2 of [BLM] on a final constraint manifold in coordinates x: the projected θ map."""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from dirax.program.tracing import call, gradient
from dirax.program.user_functions import evaluated
from dirax.schemes.constraint_rows import independent_constraints
from dirax.schemes.step import Field, Shape, StepEquation
from dirax.systems.constraint_chain import ResolvedSystem
from dirax.systems.dirac_system import TINY_BRACKET, DiracSystem


class FinalManifold(NamedTuple):
    """M_f = {φ = 0} with what a step needs, functions of (x, params): constraints φ, `size` of them; the `field` ẋ = X(x); the
    `multipliers`, as many as `forces`; and `normal(x, α, params)`, the vector by which a combination α of the dφ moves a
    point onto M_f. `check(data, params)` refuses initial data for which this is not M_f."""

    constraints: Callable
    size: int
    field: Callable
    multipliers: Callable
    forces: int
    normal: Callable
    check: Callable | None = None


def of_chain(system: ResolvedSystem) -> FinalManifold:
    """M_f of a constraint chain, projected onto by the nearest point."""
    chain = system.chain
    count = sum(level.count for level in chain.levels)
    nearest = lambda x, covector, params: chain.normal(covector)
    return FinalManifold(chain.constraints, count, chain.field, chain.multipliers, len(chain.multiplier_names), nearest)


def of_constrained_hamiltonian(system: DiracSystem, shape: Shape) -> FinalManifold:
    """M_f = {g = 0, {g, H} = 0} of a Hamiltonian system with holonomic constraints, projected onto along the Hamiltonian
    vectors of φ, which on a symplectic manifold are the vectors ω-orthogonal to M_f."""
    system, count, all_of_them = independent_constraints(system, shape)

    def constraints(x, params):
        return jnp.concatenate([system.constraints.position_defect(0.0, x, params), system.hidden_defect(x, params)])

    def brackets_and_rows(x, params):
        return system.brackets(x, params), system.holonomic_matrix(x, params)

    def check(data, h, params):
        x = np.asarray(system.point(data))
        brackets, rows = map(np.asarray, evaluated(brackets_and_rows, x, params))
        if np.max(np.abs(brackets)) > TINY_BRACKET * np.sum(rows**2):
            raise ValueError(
                f"Method 2 takes holonomic constraints whose brackets {{g_i, g_j}} vanish, as those of functions of q on T*Q do, "
                f"but they are up to {np.max(np.abs(brackets)):.3g} here: simulate dx.constraint_algorithm(system, near=x)"
                ".resolved() instead of the system."
            )

    both = partial(call, lambda x, params: system.constrained_field(x, params))
    field = lambda x, params: both(x, params)[0]
    multipliers = lambda x, params: all_of_them(both(x, params)[1])
    return FinalManifold(constraints, 2 * count, field, multipliers, shape.c, system.hamiltonian_vector, check)


def projected_field(manifold: FinalManifold, n: int, theta: float) -> StepEquation:
    """ẋ = X(x) on M_f = {φ = 0} by the projected map (P × P) ∘ R_d ([BLM] Prop 7.3), P the projection along N, the normal
    vectors of the manifold:

        x_k = P(x − θh X(x)),   x_{k+1} = P(x + (1 − θ)h X(x)),   x ∈ M_f.

    Unknowns are (w, s) with x = x_k + θh w, w = X(x) + N(x_k) s, and the same of the second half. φ holds at the nodes
    to roundoff. Self-adjoint and of second order for θ = ½.
    """
    k = n + manifold.size
    constraints, field_at, multipliers, normal = (  # each is used several times in a step
        partial(call, f) for f in (manifold.constraints, manifold.field, manifold.multipliers, manifold.normal)
    )

    def parts(u, state, h):
        x = state + theta * h * u[:n]
        return x, x + (1.0 - theta) * h * u[k : k + n]

    def half(w, s, at, there, field, fraction, params):
        covector = gradient(lambda y: constraints(y, params) @ s)(at)
        # a half of length zero moves nothing, and needs no force
        on = s if fraction == 0.0 else constraints(there, params)
        return jnp.concatenate([w - field - normal(at, covector, params), on])

    def residual(u, state, t, h, params):
        x, end = parts(u, state, h)
        field = field_at(x, params)
        first = half(u[:n], u[n:k], state, x, field, theta, params)
        return jnp.concatenate([first, half(u[k : k + n], u[k + n :], end, end, field, 1.0 - theta, params)])

    def start(data: dict[str, Any], h, params):
        u = jnp.concatenate([data["velocity"], jnp.zeros(manifold.size)])
        return data["x"], jnp.concatenate([u, u])

    def unpack(state, u, t, h, params):
        return {"x": state, "multipliers": multipliers(parts(u, state, h)[0], params)}

    about = "multipliers at the base point"
    return StepEquation(
        start=start,
        residual=residual,
        advance=lambda u, state, t, h, params: parts(u, state, h)[1],
        unpack=unpack,
        state_size=n,
        unknowns=2 * k,
        fields={"x": Field((n,)), "multipliers": Field((manifold.forces,), "step", ("constraint",), about)},
        labels=tuple(f"equation {i} of the projected map" for i in range(2 * k)),
        check=manifold.check,
    )
