"""Method 2 of [BLM] on a final constraint manifold in coordinates x: the projected θ map."""

from typing import Any

import jax.numpy as jnp

from dirax.program.tracing import gradient, once
from dirax.schemes.step import Field, StepEquation
from dirax.systems.forms import FinalManifold


def projected_field(manifold: FinalManifold, n: int, theta: float) -> StepEquation:
    """ẋ = X(x) on M_f = {φ = 0} by the projected map (P × P) ∘ R_d ([BLM] Prop 7.3), P the projection along N, the normal
    vectors of the manifold:

        x_k = P(x − θh X(x)),   x_{k+1} = P(x + (1 − θ)h X(x)),   x ∈ M_f.

    Unknowns are (w, s) with x = x_k + θh w, w = X(x) + N(x_k) s, and the same of the second half. φ holds at the nodes
    to roundoff. Self-adjoint and of second order for θ = ½.
    """
    k = n + manifold.size
    constraints, field_at, multipliers, normal = (  # each is used several times in a step
        once(f) for f in (manifold.constraints, manifold.field, manifold.multipliers, manifold.normal)
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
