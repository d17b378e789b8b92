"""Discrete Euler–Poincaré, Lie–Poisson and Suslov equations: left-invariant discrete mechanics on a Lie group, reduced."""

from typing import Any

import equinox as eqx

from dirax.geometry.group_retractions import RETRACTIONS
from dirax.schemes.euler_poincare_step import EulerPoincareStep
from dirax.schemes.step import AbstractScheme, Shape, StepEquation


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
        if shape.m:
            return "the forces of the constraints are those of the algebra's equations: the steps replayed are these themselves"
        return "D is the graph of a Lie–Poisson bivector: whether a step is a Poisson map is measured instead"

    def step_equation(self, system: Any, shape: Shape) -> StepEquation:
        reduced = system.lie_algebra_form()
        if reduced is None:
            raise TypeError(
                "dx.DiscreteEulerPoincare steps dx.EulerPoincare and dx.LiePoisson systems, but a "
                f"{type(system).__name__} was given."
            )
        return EulerPoincareStep(reduced, shape.m, self.map).equation()
