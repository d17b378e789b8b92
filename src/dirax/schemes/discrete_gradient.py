"""Discrete gradients: schemes whose energy balance is exact ([BLM] §7; Gonzalez 1996; Harten, Lax, van Leer 1983)."""

from typing import Any

import numpy as np

from dirax.numerics.arrays import is_whole
from dirax.schemes.discrete_gradient_step import DiscreteGradientStep
from dirax.schemes.step import AbstractScheme, Shape, StepEquation

KINDS = ("gonzalez", "mean-value")


class DiscreteGradient(AbstractScheme):
    """ẋ_d = (J − R)(x̄) ∇̄H + B(x̄) ū, ȳ = B(x̄)ᵀ∇̄H, with ẋ_d = (x_{k+1} − x_k)/h and x̄ the midpoint of the step, where

        ⟨∇̄H(x_k, x_{k+1}), x_{k+1} − x_k⟩ = H(x_{k+1}) − H(x_k),

    so that H(x_{k+1}) − H(x_k) = h⟨ȳ, ū⟩ − h⟨∇̄H, R∇̄H⟩ exactly: [BLM] (20) with the midpoint map, whose own balance
    ⟨dH(x̄), ẋ_d⟩ is not the change of H. On a DiracSystem (ẋ_d, ∇̄H) ∈ D(x̄), and H is conserved; with holonomic constraints
    (ẋ_d, ∇̄H − Gᵀλ) ∈ D(x̄) and G(x̄) ẋ_d = 0, as in Method 1: constraints that are quadratic hold at the rows too, others up to
    O(h²), which stays bounded or drifts as the motion has it. Second order.

    `kind`: "gonzalez", dH(x̄) corrected along the step, in the metric |∂²H/∂x_i²|, in which charges
    and fluxes do not mix whatever their units (the Euclidean one from 128 coordinates on); or "mean-value", the mean of dH over
    the step by Gauss–Legendre quadrature with `nodes` points, corrected in the same way by what the quadrature leaves. What
    roundoff takes from the balance in one step is given back in the next, so that it does not add up over many; the change of H
    that the roundoff of H hides, in short steps or beside a large constant, is found from dH by a finer quadrature.

    Saved with x: `work` (2,), the energy supplied through the ports and the energy dissipated since the start; per step
    `power` (3,), the rates at which energy is stored, supplied and dissipated.
    """

    kind: str
    nodes: int

    def __init__(self, kind: str = "gonzalez", nodes: int = 4):
        if kind not in KINDS:
            raise ValueError(f"kind must be one of {', '.join(map(repr, KINDS))}, but {kind!r} was given.")
        if not is_whole(nodes) or nodes < 1:
            raise ValueError(f"nodes must be a whole number, at least 1, but {nodes!r} was given.")
        self.kind, self.nodes = kind, int(nodes)

    def adjoint(self, system: Any) -> "DiscreteGradient":
        """Itself: the mean of dH over the step, the correction along it and x̄ are the same from either end."""
        return self

    @property
    def constraints_at_rows(self) -> bool:
        """Not those that are not quadratic: they are imposed as G(x̄) ẋ_d = 0."""
        return False

    def discrete_structure(self, system: Any, shape: Shape, step: Any) -> str:
        return "the discrete gradient that (x₁ − x₀)/h is paired with in D is not saved; its balance is measured instead"

    @property
    def keeps_no_form(self) -> str:
        return "discrete gradients keep the energy, and not the two-form or bivector of D"

    def step_equation(self, system: Any, shape: Shape) -> StepEquation:
        relation, energy = system.relation_form(shape), system.energy_form(shape)
        if relation is None or energy is None:
            raise TypeError(
                "dx.DiscreteGradient takes PortHamiltonian and DiracSystem systems, which have a Hamiltonian of x, but a "
                f"{type(system).__name__} was given."
            )
        return DiscreteGradientStep(relation, energy, shape.n, *self._quadrature()).equation()

    def _quadrature(self) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """Points of the step (0 to 1) and weights of the mean of dH."""
        if self.kind == "gonzalez":
            return (0.5,), (1.0,)
        points, weights = np.polynomial.legendre.leggauss(self.nodes)
        return tuple((points + 1) / 2), tuple(weights / 2)
