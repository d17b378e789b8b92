"""Newmark's method with constraints on the velocity, a rival of the rows of docs/hard_cases.md: a scheme stated from outside.

After the idea of Anahory Simoes, Ferraro, Marrero and Martín de Diego, "Nonholonomic Newmark method" (arXiv 2201.13162), whose
compositions of two Newmark methods keep the energy well; the formulas are our own statement of it. Of L(q, v) with W(q) v = 0,
a_k is the acceleration of the end k with a multiplier, M a = ∂L/∂q − (∂²L/∂v∂q) v + Wᵀλ, all at (q_k, v_k), and a step is

    q1 = q0 + h v0 + h²/2 ((1 − 2β) a0 + 2β a1),   v1 = v0 + h ((1 − γ) a0 + γ a1),   W(q1) v1 = 0.

- β = ½, γ = 1 takes a1 alone, whose multiplier makes v1 admissible: order 1;
- β = γ = 0 takes a0 alone, whose multiplier does it: its adjoint, since one with (β, γ) is one with (β + ½ − γ, 1 − γ);
- anything between takes the acceleration of the motion at the start, and a1 with the multiplier that makes v1 admissible.

Half a step of the second and half a step of the first make a self-adjoint one of order 2, with multipliers at both ends, and
compositions of that one have orders 4 and more.
"""

from typing import Any

import jax
import jax.numpy as jnp

import dirax as dx


class Newmark(dx.AbstractScheme):
    """Newmark's method (β, γ) with the multiplier that keeps v in the distribution at every row."""

    beta: float = 0.5
    gamma: float = 1.0

    def adjoint(self, system: Any) -> "Newmark | None":
        """The other one of the pair (½, 1) and (0, 0)."""
        return {(0.5, 1.0): Newmark(0.0, 0.0), (0.0, 0.0): Newmark(0.5, 1.0)}.get((self.beta, self.gamma))

    def step_equation(self, system: Any, shape: Any) -> dx.StepEquation:
        n, m, beta, gamma = shape.n, shape.m, self.beta, self.gamma
        state, unknowns = dx.Layout(q=n, v=n), dx.Layout(acceleration=n, multiplier=m)
        forms = system.constraints.one_forms_at

        def forces(t, q, v, params):
            """M and ∂L/∂q − (∂²L/∂v∂q) v."""
            momentum = jax.grad(lambda q, v: system.lagrangian.at(t, q, v, params), 1)
            slope = jax.grad(lambda q: system.lagrangian.at(t, q, v, params))(q)
            return jax.jacfwd(momentum, 1)(q, v), slope - jax.jvp(lambda q: momentum(q, v), (q,), (v,))[1]

        def acceleration(t, q, v, params):
            """That of the motion: M a = F + Wᵀλ with W a + Ẇ v = 0."""
            (mass, force), rows = forces(t, q, v, params), forms(t, q, params)
            change = jax.jvp(lambda q: forms(t, q, params) @ v, (q,), (v,))[1]
            block = jnp.block([[mass, -rows.T], [rows, jnp.zeros((m, m))]])
            return jnp.linalg.solve(block, jnp.concatenate([force, -change]))[:n]

        def ends(u, x, t, h, params):
            """q1 and v1; the end whose acceleration is unknown is the first where γ = 0."""
            now, a = state.split(x), unknowns.split(u).acceleration
            if gamma in (0.0, 1.0):
                return now.q + h * now.v + h**2 / 2 * a, now.v + h * a
            first = acceleration(t, now.q, now.v, params)
            q = now.q + h * now.v + h**2 / 2 * ((1 - 2 * beta) * first + 2 * beta * a)
            return q, now.v + h * ((1 - gamma) * first + gamma * a)

        def residual(u, x, t, h, params):
            now, new, (q, v) = state.split(x), unknowns.split(u), ends(u, x, t, h, params)
            at = (t, now.q, now.v) if gamma == 0.0 else (t + h, q, v)
            mass, force = forces(*at, params)
            pull = forms(at[0], at[1], params).T @ new.multiplier
            return jnp.concatenate([mass @ new.acceleration - force - pull, forms(t + h, q, params) @ v / h])

        def start(data, h, params):
            x = state.join(q=data["q"], v=data["v"])
            return x, unknowns.join(acceleration=acceleration(data.get("t", 0.0), data["q"], data["v"], params))

        def unpack(x, u, t, h, params):
            now = state.split(x)
            p = jax.grad(lambda v: system.lagrangian.at(t, now.q, v, params))(now.v)
            return {"q": now.q, "p": p, "multiplier": unknowns.split(u).multiplier}

        return dx.StepEquation(
            start=start,
            residual=residual,
            advance=lambda u, x, t, h, params: jnp.concatenate(ends(u, x, t, h, params)),
            unpack=unpack,
            state_layout=state,
            unknown_layout=unknowns,
            fields={"q": dx.Field((n,)), "p": dx.Field((n,)), "multiplier": dx.Field((m,), "step", ("constraint",))},
        )


COMPOSED = dx.SymmetricComposition(Newmark())
"""Half a step of (0, 0), then half a step of (½, 1)."""
