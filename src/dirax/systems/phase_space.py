"""Phase-space Lagrangians L = ⟨α(q), q̇⟩ − H(q): point vortices, Lotka–Volterra, guiding centres."""

from collections.abc import Callable
from typing import Any

from jaxtyping import Float

from dirax.geometry.structures import DiracStructure
from dirax.numerics.arrays import Data, Numbers
from dirax.program.tracing import jacobian
from dirax.program.user_functions import UserFunction
from dirax.systems.constraints import no_constraint
from dirax.systems.dirac_system import DiracSystem
from dirax.systems.forms import EnergyForm, ImplicitForm, RelationForm
from dirax.systems.implicit_lagrangian import implicit_lagrangian
from dirax.systems.lagrange_dirac import LagrangeDirac
from dirax.systems.shape import Shape
from dirax.systems.system import AbstractSystem, refuse_start


class PhaseSpaceLagrangian(AbstractSystem):
    """L(q, q̇) = ⟨α(q), q̇⟩ − H(q), degenerate, of first order: (∂_j α_i − ∂_i α_j) q̇^j = −∂_i H ([BLM] §6).

    `one_form(q[, params])` is α of shape (n,); `hamiltonian(q[, params])` returns a scalar. Where the matrix of dα is
    invertible the constraint algorithm stops at the graph p = α(q), a symplectic manifold with the form dα.
    """

    one_form: UserFunction
    hamiltonian: UserFunction

    def __init__(self, one_form: Callable, hamiltonian: Callable):
        self.one_form = UserFunction(one_form, "one_form", ("q",))
        self.hamiltonian = UserFunction(hamiltonian, "hamiltonian", ("q",))

    def lagrangian(self, q: Float[Numbers, " n"], v: Float[Numbers, " n"], params: Any = None) -> Float[Numbers, ""]:
        """⟨α(q), v⟩ − H(q)."""
        return self.one_form(q, params) @ v - self.hamiltonian(q, params)

    def lagrange_dirac(self) -> LagrangeDirac:
        """The same system as a degenerate Lagrangian on TQ, for schemes on Q × Q and Method 1."""
        return LagrangeDirac(self.lagrangian)

    def lagrangian_form(self) -> LagrangeDirac:
        return self.lagrange_dirac()

    def final_relation(self, shape: Shape) -> RelationForm:
        """The Dirac system (dα, H) on M_f = graph α ≅ Q ([BLM] (14)); p = α(q) is saved beside q."""
        form = self.dirac_system().relation_form(Shape(shape.n))
        node = lambda q, params: {"q": q, "p": self.one_form(q, params)}
        return form._replace(names=("q", "p"), node=node, dirac="(ẋ, dH) ∈ graph dα")

    def energy_form(self, shape: Shape) -> EnergyForm:
        """That of the Dirac system on M_f."""
        return self.dirac_system().energy_form(Shape(shape.n))

    def implicit_form(self, near: Any, params: Any) -> ImplicitForm:
        return implicit_lagrangian(self.lagrange_dirac(), self, near, params)

    def two_form(self, q: Float[Numbers, " n"], params: Any = None) -> Float[Numbers, "n n"]:
        """The matrix of dα: (dα)_ij = ∂_i α_j − ∂_j α_i."""
        derivative = jacobian(lambda q: self.one_form(q, params))(q)
        return derivative.T - derivative

    def dirac_system(self) -> DiracSystem:
        """The system on M_f ≅ Q: (dα)_ij q̇^j = ∂_i H is q̇ ⊕ dH ∈ graph of the two-form with matrix −dα (α = ωᵀv)."""
        return DiracSystem(
            DiracStructure.from_two_form(lambda q, params: -self.two_form(q, params)),
            lambda q, params: self.hamiltonian(q, params),
        )

    def sizes(self, data: Data, params: Any) -> tuple[int, int]:
        refuse_start(self, data, "q", "x", "q, v", "q, p", "q0, q1")
        q = self.point(data)
        form, energy = self.one_form.shape(q, params), self.hamiltonian.shape(q, params)
        if form.shape != q.shape:
            raise ValueError(f"one_form must return shape {q.shape} like q, but it returned shape {form.shape}.")
        if energy.shape != ():
            raise ValueError(f"hamiltonian must return a scalar, but it returned shape {energy.shape}.")
        return q.shape[0], 0

    def complete(self, data: Data, params: Any, project: bool) -> Data:
        if "q0" in data:
            return dict(data)
        q = self.point(data)
        p, velocity = self.one_form(q, params), self.dirac_system().complete({"x": q}, params, False)["velocity"]
        p = p if project or "p" not in data else data["p"]
        return {"q": q, "v": velocity, "p": p, "x": q, "velocity": velocity}

    def velocity_at(self, row: Data, params: Any) -> Float[Numbers, " n"]:
        return self.dirac_system().velocity_at({"x": self.point(row)}, params)

    def initial_defect(self, data: Data, params: Any) -> Float[Numbers, " n"]:
        """p − α(q): the primary constraints."""
        if "q0" in data:
            return no_constraint()
        return data["p"] - self.one_form(data["q"], params)

    def energy_at(self, row: Data, params: Any) -> Float[Numbers, ""]:
        """H(q)."""
        return self.hamiltonian(row["q"], params)

    def constraint_at(self, row: Data, params: Any) -> Float[Numbers, " n"]:
        """p − α(q), zero on M_f."""
        return row["p"] - self.one_form(row["q"], params)
