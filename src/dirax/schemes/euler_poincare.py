"""Discrete Euler–Poincaré, Lie–Poisson and Suslov equations: left-invariant discrete mechanics on a Lie group, reduced."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from dirax.geometry.group_retractions import RETRACTIONS, coadjoint, pulled_back, retraction
from dirax.program.tracing import once
from dirax.reduction.euler_poincare import EulerPoincare
from dirax.reduction.lie_poisson import LiePoisson
from dirax.schemes.step import AbstractScheme, Field, Shape, StepEquation


class DiscreteEulerPoincare(AbstractScheme):
    """The discrete Euler–Poincaré equations of l_d(f_k, a_k), f_k = g_k⁻¹g_{k+1} = τ(hξ_k), τ = `map`, "exp" or "cayley".

    Where they come from: l_d = (h/2)[l(ξ_k, a_k) + l(ξ_k, a_{k+1})], a_{k+1} = f_k⁻¹·a_k, and the action Σ l_d is varied by
    δg_k = g_k η_k, with forces at the nodes that do no work on A η = 0. With dτ_ζ the right-trivialized tangent,
    dτ_{−ζ} = Ad_{τ(ζ)}⁻¹ dτ_ζ the left-trivialized one, h δξ_k = dτ⁻¹_{−hξ} η_{k+1} − dτ⁻¹_{hξ} η_k and
    δa_k = −η_k·a_k, so that the discrete Legendre transforms are, for ν = ½[∂l/∂ξ(ξ_k, a_k) + ∂l/∂ξ(ξ_k, a_{k+1})],

        μ_k⁻ = −D₁ = (dτ⁻¹_{hξ_k})*ν + (h/2) J_k,   μ⁺_{k+1} = D₂ = (dτ⁻¹_{−hξ_k})*ν − (h/2) J_{k+1},

    J_k = J(∂l/∂a(ξ_k, a_k), a_k), and the equations μ_k⁺ + forces = μ_k⁻. Solved for ξ_k without any inverse of dτ:

        (dτ_{hξ_k})*m = ν,   m = μ_k + (h/2)(A_kᵀλ_k − J_k),   A ξ_k = 0,
        μ_{k+1} = Ad*_{f_k} m + (h/2)(A_{k+1}ᵀλ'_k − J_{k+1}),   A ∂h/∂μ(μ_{k+1}) = 0,   g_{k+1} = g_k f_k.

    A force at a node acts half in the step before, half in the step after, so that the momenta satisfy the constraint at
    the nodes as the velocities do in the steps. For A that depends on a, A ξ_k = 0 is the mean of both ends.
    Of a `dx.LiePoisson` system ν is an unknown, and ξ_k = ½[∂h/∂μ(ν, a_k) + ∂h/∂μ(ν, a_{k+1})] (discrete Hamilton–Pontryagin).

    One step, self-adjoint, second order. Without constraints it is a Poisson map that stays on the coadjoint orbits, and the
    spatial momentum Ad*_{g⁻¹}μ (its part that fixes a_0) is conserved. Saved: x = (μ, a), the group element g (from the
    identity on, or from q=), per step xi (d,) and, with constraints, `constraint` A ξ_k and the impulse `multipliers`
    (h/2)(λ'_{k−1} + λ_k) at its first node: μ_k⁻ − μ_k⁺ is Aᵀ times it (at k = 0, where the motion starts in the middle of
    it, the second half).

    Bobenko & Suris 1999; Marsden, Pekarsky & Shkoller 1999; Fedorov & Zenkov 2005; Kobilarov & Marsden 2011. Raises
    `TypeError` for other systems; a step that turns by π or more is refused.
    """

    map: str = eqx.field(static=True)

    def __init__(self, map: str = "exp"):
        if map not in RETRACTIONS:
            raise ValueError(f"map must be {' or '.join(RETRACTIONS)}, but {map!r} was given.")
        self.map = map

    def discrete_structure(self, system: Any, shape: Shape, step: Any) -> str:
        return "D is the graph of a Lie–Poisson bivector: whether a step is a Poisson map is measured instead"

    def step_equation(self, system: Any, shape: Shape) -> StepEquation:
        if not isinstance(system, EulerPoincare | LiePoisson):
            raise TypeError(
                "dx.DiscreteEulerPoincare steps dx.EulerPoincare and dx.LiePoisson systems, but a "
                f"{type(system).__name__} was given."
            )
        return discrete_euler_poincare(system, shape, self.map)


def discrete_euler_poincare(system: Any, shape: Shape, name: str) -> StepEquation:
    """The StepEquation: state (μ, a, g) and the impulse (h/2)λ' of the step before; unknowns ξ, of a Lie–Poisson system
    also ν, with constraints (λ, ξ', λ') too, ξ' the velocity at the end of the step."""
    space, m = system.space, shape.m
    group, d, n = space.group, space.dimension, space.size
    tau = retraction(group, name)
    hamiltonian = isinstance(system, LiePoisson)
    motion_size = 2 * d if hamiltonian else d
    whole = n + group.ambient_dimension

    def split(state):
        return state[:d], state[d:n], state[n:whole]

    def motion(u, a, h, params):
        """ξ, ν, f, the next a, J at both ends and what is left of ξ = ∂h/∂μ."""
        xi = u[:d]
        f = tau(h * xi)
        after = space.carried(f, a)
        at = u[d : 2 * d] if hamiltonian else xi
        (first, slope), (second, next_slope) = system.slopes(at, a, params), system.slopes(at, after, params)
        mean = (first + second) / 2.0 if space.advected else first
        if hamiltonian:
            return xi, at, f, after, -space.diamond(slope, a), -space.diamond(next_slope, after), xi - mean
        return xi, mean, f, after, space.diamond(slope, a), space.diamond(next_slope, after), jnp.zeros(0)

    def reaction(a, multipliers, params):
        return system.constraint_forms(a, params).T @ multipliers if m else jnp.zeros(d)

    def parts(u):
        """(λ, ξ', λ')."""
        v = u[motion_size:]
        return v[:m], v[m : m + d], v[m + d :]

    def step(u, state, h, params):
        return once(whole_step)(u, state, h, params)

    def whole_step(u, state, h, params):
        """ξ, m, ν, the next μ and a, f, and the residual of ξ = ∂h/∂μ."""
        momentum, a, _ = split(state)
        xi, nu, f, after, torque, next_torque, defect = motion(u, a, h, params)
        first, _, last = parts(u)
        leaving = momentum + h / 2.0 * (reaction(a, first, params) - torque)
        arriving = coadjoint(group, f, leaving) + h / 2.0 * (reaction(after, last, params) - next_torque)
        return xi, leaving, nu, arriving, after, f, defect

    def discrete_constraint(xi, a, after, params):
        forms = system.constraint_forms(a, params)
        return (forms + system.constraint_forms(after, params)) @ xi / 2.0 if space.advected else forms @ xi

    def residual(u, state, t, h, params):
        xi, leaving, nu, arriving, after, _, defect = step(u, state, h, params)
        angle = h * xi[group.translations :]
        small = jnp.sum(angle * angle) < np.pi**2
        rows = [jnp.where(small, pulled_back(group, tau, h * xi, leaving) - nu, jnp.nan), defect]
        if m:
            _, end, _ = parts(u)
            rows.append(discrete_constraint(xi, split(state)[1], after, params))
            rows.append(system.legendre(end, after, params) - arriving)
            rows.append(system.constraint_forms(after, params) @ end)
        return jnp.concatenate(rows)

    def advance(u, state, t, h, params):
        _, _, _, arriving, after, f, _ = step(u, state, h, params)
        return jnp.concatenate([arriving, after, group.nearest(group.multiply(split(state)[2], f)), h / 2.0 * parts(u)[2]])

    def unpack(state, u, t, h, params):
        saved = {"x": state[:n], "g": state[n:whole], "xi": u[:d]}
        if m:
            a = split(state)[1]
            saved["multipliers"] = state[whole:] + h / 2.0 * parts(u)[0]
            saved["constraint"] = discrete_constraint(u[:d], a, space.carried(tau(h * u[:d]), a), params)
        return saved

    def start(data, h, params):
        x, xi = data["x"], data["v"]
        zero = jnp.zeros(m)
        motion = [xi, x[:d]] if hamiltonian else [xi]
        u = jnp.concatenate([*motion, *([zero, xi, zero] if m else [])])
        return jnp.concatenate([x, data.get("g", group.identity()), zero]), u

    fields = {
        "x": Field((n,), dims=("component",), description="body momentum μ and advected quantities a"),
        "g": Field(
            (group.ambient_dimension,), dims=("group",), description="group element g_k, from the identity on unless q= was given"
        ),
        "xi": Field((d,), "step", ("algebra",), "velocity ξ_k of the step, g_k⁻¹g_{k+1} = τ(hξ_k)"),
    }
    labels = [f"discrete Euler–Poincaré equation {i}, of a step that turns by less than π" for i in range(d)]
    labels += [f"velocity ∂h/∂μ, component {i}" for i in range(motion_size - d)]
    if m:
        fields["multipliers"] = Field((m,), "step", ("constraint",), "impulse of the constraints at the node")
        fields["constraint"] = Field((m,), "step", ("constraint",), "discrete constraint A ξ_k")
        labels += [f"discrete constraint {r}" for r in range(m)]
        labels += [f"Legendre transform {i} at the end of the step" for i in range(d)]
        labels += [f"constraint {r} at the end of the step" for r in range(m)]
    return StepEquation(
        start=start,
        residual=residual,
        advance=advance,
        unpack=unpack,
        state_size=whole + m,
        unknowns=motion_size + (2 * m + d if m else 0),
        fields=fields,
        labels=tuple(labels),
    )
