"""Dirac systems: a Dirac structure and a Hamiltonian, ẋ ⊕ dH(x) ∈ D_x."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from dirax.geometry.lagrangian_submanifolds import LagrangianSubmanifold
from dirax.geometry.representations import KERNEL_PAIRS
from dirax.geometry.structures import DiracStructure, Induced
from dirax.numerics.arrays import Data, Numbers
from dirax.numerics.tolerances import BRACKET_DEFECT, RATE_RANK
from dirax.program.linear_solves import scaled_inverse, solve
from dirax.program.roots import nearest_root
from dirax.program.tracing import gradient, jacobian, once
from dirax.program.user_functions import UserFunction, evaluated
from dirax.systems.constraints import Constraints
from dirax.systems.forms import EnergyForm, FinalManifold, ImplicitForm, RelationForm
from dirax.systems.hamilton_dirac import HamiltonDirac
from dirax.systems.implicit_form import energy_of_x, names, point_of
from dirax.systems.magnitudes import as_large_as_energy, of_solution
from dirax.systems.premise import Premise
from dirax.systems.shape import Shape
from dirax.systems.system import AbstractSystem


class DiracSystem(AbstractSystem):
    """The Dirac system (D, H): ẋ ⊕ dH(x) ∈ D_x ([BLM] §3), with D = {F(x) ẋ + E(x) dH(x) = 0} in kernel form.

    `structure`: a `DiracStructure` in coordinates x (N,), integrable or not; `hamiltonian(x[, params])` returns a scalar.
    On a submanifold such as the sphere, x are ambient coordinates, and the discretization map names the manifold.
    `holonomic(x[, params])` (c,) restricts the system to N = {g = 0}: (ẋ, dH − Gᵀλ) ∈ D and ẋ ∈ TN with G = ∂g/∂x and
    multipliers λ, the Dirac system of H on N with the structure that N inherits from D. On T*Q, where x = (q, p) and g is a
    function of q, these are q̇ = ∂H/∂p, ṗ = −∂H/∂q + Gᵀλ, g = 0 for any H, and G ∂H/∂p = 0 follows.

        so3 = dx.DiracStructure.from_bivector(lambda x: jnp.cross(x, jnp.eye(3), axisb=0, axisc=0))
        body = dx.DiracSystem(so3, lambda x: x @ (x / jnp.array([1.0, 2.0, 3.0])) / 2)
        pendulum = dx.DiracSystem(  # x = (q, p), |q| = 1
            dx.induced_dirac(None, 3), lambda x: x[3:] @ x[3:] / 2 + x[2], holonomic=lambda x: jnp.array([x[:3] @ x[:3] - 1.0]))

    Raises `TypeError` where `structure` is not a DiracStructure, or a function not one of x.
    """

    structure: DiracStructure
    hamiltonian: UserFunction
    holonomic: UserFunction | None = None

    def __init__(self, structure: DiracStructure, hamiltonian: Callable, *, holonomic: Callable | None = None):
        if not isinstance(structure, DiracStructure):
            raise TypeError(
                f"structure must be a dx.DiracStructure, but a {type(structure).__name__} was given: "
                "use one of its constructors, e.g. dx.DiracStructure.from_bivector(lambda x: …)."
            )
        if isinstance(hamiltonian, LagrangianSubmanifold):
            raise TypeError(
                "a dx.DiracSystem has a Hamiltonian; with a Lagrangian submanifold in the place of dH it is "
                "dx.GeneralizedDiracSystem(structure, submanifold)."
            )
        self.structure = structure
        self.hamiltonian = UserFunction(hamiltonian, "hamiltonian", ("x",))
        self.holonomic = None if holonomic is None else UserFunction(holonomic, "holonomic", ("x",))

    def differential(self, x: Float[Numbers, " N"], params: Any = None) -> Float[Numbers, " N"]:
        """dH(x)."""
        return gradient(lambda x: self.hamiltonian(x, params))(x)

    @property
    def constraints(self) -> Constraints:
        """The constraints g(x) = 0, as functions of (t, x, params)."""
        return Constraints(None, None, self.holonomic)

    @once
    def holonomic_matrix(self, x: Float[Numbers, " N"], params: Any = None) -> Float[Numbers, "c N"]:
        """G(x) = ∂g/∂x; (0, N) without constraints."""
        return self.constraints.holonomic_matrix(0.0, x, params)

    def relation(
        self,
        x: Float[Numbers, " N"],
        velocity: Float[Numbers, " N"],
        multipliers: Float[Numbers, " c"],
        t: Any,
        params: Any = None,
        differential: Float[Numbers, " N"] | None = None,
    ) -> Float[Numbers, " k"]:
        """F ẋ + E (dH − Gᵀλ), zero iff (ẋ, dH − Gᵀλ) ∈ D_x, and G ẋ; `differential` replaces dH(x)."""
        dh = self.differential(x, params) if differential is None else differential
        if self.holonomic is None:
            return self._defect(x, velocity, dh, params)
        rows = self.holonomic_matrix(x, params)
        return jnp.concatenate([self._defect(x, velocity, dh - rows.T @ multipliers, params), rows @ velocity])

    def _defect(self, x, velocity, covector, params):
        """F ẋ + E α, zero iff (ẋ, α) ∈ D_x."""
        if self.canonical:
            of_q, of_p = jnp.split(velocity, 2)
            return jnp.concatenate([-of_p, of_q]) - covector
        F, E = self.structure.kernel(x, params)
        return jnp.asarray(F @ velocity + E @ covector)

    def relation_form(self, shape: Shape) -> RelationForm:
        labels = tuple(f"rate of constraint {a}" for a in range(len(shape.kept)))
        saved = shape.m + shape.c
        relation = self.independent(shape).relation
        form = RelationForm(relation, len(shape.kept), labels, saved, shape.spread, canonical=self.canonical, dirac="(ẋ, dH) ∈ D")
        if self.holonomic is None and self.is_graph:
            matrix: dict[str, Any] = {self.structure.representation: lambda x, params: self.structure.evaluate(x, params)[0]}
            return form._replace(**matrix, explicit=self.structure.representation == "bivector")
        return form

    def energy_form(self, shape: Shape) -> EnergyForm:
        return EnergyForm(self.hamiltonian, self.differential, self.independent(shape).relation)

    def independent(self, shape: Shape) -> "DiracSystem":
        """The same system with the holonomic constraints that are not redundant."""
        if not shape.redundant or self.holonomic is None:
            return self
        g = self.holonomic
        picked = lambda x, params: shape.pick(g(x, params))
        return DiracSystem(self.structure, self.hamiltonian, holonomic=picked)

    def implicit_form(self, near: Any, params: Any) -> ImplicitForm:
        x = point_of(near, ("x",), self)
        phase = self.phase_space_form()
        if phase is not None and phase.constraints.any:  # rows of F add velocities to forces, which have other units
            return phase.implicit_form(x, params)._replace(about="q̇ = ∂H/∂p, ṗ = −∂H/∂q + Wᵀu, W q̇ = 0")
        c = sum(self.sizes({"x": jnp.asarray(x)}, params)[1:])
        self.check({"x": jnp.asarray(x)}, params)

        def equations(x, params):
            matrix, right = self.equations(x, params)
            right = jnp.concatenate([right, self.constraints.position_defect(0.0, x, params)])
            return jnp.concatenate([matrix, jnp.zeros((c, x.size + c))]), right

        about = "F ẋ = −E (dH − Gᵀλ), g = 0" if c else "F ẋ = −E dH"
        return ImplicitForm(equations, x, names("x", x.size), names("λ", c), energy_of_x(self), about)

    def equations(self, x: Float[Numbers, " N"], params: Any = None) -> tuple[Numbers, Numbers]:
        """([F, −E Gᵀ], −E dH), of shapes (N, N + c) and (N,): the linear equations of (ẋ, λ)."""
        F, E = map(jnp.asarray, self.structure.kernel(x, params))
        return jnp.concatenate([F, -E @ self.holonomic_matrix(x, params).T], axis=1), -E @ self.differential(x, params)

    # ------------------------------------------------------------------ where D is a graph: M_f = {g = 0, {g, H} = 0}

    @property
    def is_graph(self) -> bool:
        """Whether D is stated as the graph of a two-form or of a bivector, so that every covector has one velocity."""
        return self.structure.representation in ("two_form", "bivector")

    @property
    def explicit(self) -> bool:
        """Whether D is stated as the graph of a bivector, or is canonical: velocities follow from covectors by no equations."""
        return self.canonical or self.structure.representation == "bivector"

    @property
    def canonical(self) -> bool:
        """Whether D is the canonical symplectic structure of T*Q in (q, p)."""
        return isinstance(self.structure.evaluate, Induced) and self.structure.evaluate.one_forms is None

    def phase_space_form(self) -> HamiltonDirac | None:
        """H(q, p) and the W(q) of a D that `dx.induced_dirac` made; None for others, and with holonomic constraints."""
        induced = self.structure.evaluate
        if not isinstance(induced, Induced) or self.holonomic is not None:
            return None
        forms, H = induced.one_forms, self.hamiltonian
        one_forms = None if forms is None else lambda q, params: forms(q, params)
        return HamiltonDirac(lambda q, p, params: H(jnp.concatenate([q, p]), params), one_forms)

    def hamiltonian_vector(
        self, x: Float[Numbers, " N"], covector: Float[Numbers, " N"], params: Any = None
    ) -> Float[Numbers, " N"]:
        """The ẋ with (ẋ, α) ∈ D_x, unique where D is the graph of a bivector or of a nondegenerate two-form."""
        if self.canonical:
            q, p = jnp.split(covector, 2)
            return jnp.concatenate([p, -q])
        F, E = self.structure.kernel(x, params)
        v = jnp.asarray(-E @ covector)
        return v if self.structure.representation == "bivector" else solve(jnp.asarray(F), v)

    @once
    def hidden_defect(self, x: Float[Numbers, " N"], params: Any = None) -> Float[Numbers, " c"]:
        """{g, H} = G ẋ for the ẋ of dH, the rate of change of g."""
        velocity = self.hamiltonian_vector(x, self.differential(x, params), params)
        return self.constraints.hidden_defect(0.0, x, velocity, params)

    def brackets(self, x: Float[Numbers, " N"], params: Any = None) -> Float[Numbers, "c c"]:
        """{g_i, g_j}: zero for functions of q on T*Q, and wherever N is coisotropic."""
        return self.holonomic_matrix(x, params) @ self.forces(x, params)

    @once
    def forces(self, x: Float[Numbers, " N"], params: Any = None) -> Float[Numbers, "N c"]:
        """The velocities of the rows of G, by columns: λ changes ẋ by −forces λ."""
        rows = self.holonomic_matrix(x, params)
        return jax.vmap(lambda row: self.hamiltonian_vector(x, row, params))(rows).T

    def tangency_defect(self, x: Float[Numbers, " N"], params: Any = None) -> Float[Numbers, " c"]:
        """The part of {g, H} that no λ takes away by its brackets {g_i, g_j} λ: all of it where they vanish."""
        return self.hidden_defect(x, params) - self.brackets(x, params) @ self.held(x, params)

    def held(self, x: Float[Numbers, " N"], params: Any = None) -> Float[Numbers, " c"]:
        """The λ that take {g, H} away by the brackets {g_i, g_j} λ; zero where these vanish."""
        hidden, brackets = self.hidden_defect(x, params), self.brackets(x, params)
        size = jnp.sum(self.holonomic_matrix(x, params) ** 2)
        normal = brackets.T @ brackets + (BRACKET_DEFECT * size) ** 2 * jnp.eye(hidden.shape[0])
        return solve(normal, brackets.T @ hidden)

    def constrained_field(self, x: Float[Numbers, " N"], params: Any = None) -> tuple[Float[Numbers, " N"], Float[Numbers, " c"]]:
        """(ẋ, λ) at a point of M_f = {g = 0, {g, H} = 0}, where the brackets {g_i, g_j} are zero: λ keeps {g, H} = 0."""
        free = self.hamiltonian_vector(x, self.differential(x, params), params)
        forces = self.forces(x, params)
        slope = jacobian(lambda x: self.hidden_defect(x, params))(x)
        multipliers = solve(slope @ forces, slope @ free)
        return free - forces @ multipliers, multipliers

    def final_manifold(self, shape: Shape) -> FinalManifold | None:
        """M_f = {g = 0, {g, H} = 0} of a system with holonomic constraints whose D is a graph, projected onto along the
        Hamiltonian vectors of φ, which on a symplectic manifold are the vectors ω-orthogonal to M_f."""
        if not (self.is_graph and shape.c):
            return None
        system = self.independent(shape)

        def constraints(x, params):
            return jnp.concatenate([system.constraints.position_defect(0.0, x, params), system.hidden_defect(x, params)])

        def check(data, h, params):
            brackets, rows = map(np.asarray, evaluated(system._brackets_and_rows, np.asarray(system.point(data)), params))
            if np.max(np.abs(brackets)) > BRACKET_DEFECT * np.sum(rows**2):
                raise ValueError(
                    f"Method 2 takes holonomic constraints whose brackets {{g_i, g_j}} vanish, as those of functions of q on "
                    f"T*Q do, but they are up to {np.max(np.abs(brackets)):.3g} here: simulate "
                    "dx.constraint_algorithm(system, near=x).resolved() instead of the system."
                )

        both = once(lambda x, params: system.constrained_field(x, params))
        field = lambda x, params: both(x, params)[0]
        multipliers = lambda x, params: shape.spread(both(x, params)[1])
        size = 2 * len(shape.kept)
        return FinalManifold(constraints, size, field, multipliers, shape.c, system.hamiltonian_vector, check)

    def _brackets_and_rows(self, x, params):
        return self.brackets(x, params), self.holonomic_matrix(x, params)

    # ------------------------------------------------------------------ AbstractSystem

    def point(self, data: Data) -> Float[Numbers, " N"]:
        """x of initial data; raises `ValueError` for others than x, or q and p."""
        if "x" in data:
            return data["x"]
        if "p" not in data:
            raise ValueError(f"a DiracSystem starts from x= (or q=, p= with x = (q, p)), but {', '.join(data)} were given.")
        return jnp.concatenate([data["q"], data["p"]])

    def sizes(self, data: Data, params: Any) -> tuple[int, ...]:
        """(N, 0), or (N, 0, c) with holonomic constraints."""
        x = self.point(data)
        out = self.hamiltonian.shape(x, params)
        if out.shape != ():
            raise ValueError(f"hamiltonian must return a scalar, but for x of shape {x.shape} it returned shape {out.shape}.")
        kernel = lambda x: self.structure.kernel(x, params)[0]
        dimension = self.structure.n if self.canonical else jax.eval_shape(kernel, x).shape[0]
        if dimension != x.size:
            raise ValueError(
                f"the Dirac structure has dimension {dimension}, but x has {x.size} entries"
                + (f": {self.structure.ports} ports are open; connect them by `compose`." if self.structure.ports else ".")
            )
        return (x.size, 0) if self.holonomic is None else (x.size, *self.constraints.sizes(x, params))

    @property
    def premise_everywhere(self) -> bool:
        return True

    def premise(self, data: Data, params: Any) -> Premise | None:
        """The matrices are those of a Dirac structure."""
        if self.canonical:
            return None
        of_structure = KERNEL_PAIRS[self.structure.representation]
        return Premise(self._structure_matrices, lambda matrices: of_structure(*matrices))

    def _structure_matrices(self, data, params):
        return self.structure.evaluate(self.point(data), params)

    def complete(self, data: Data, params: Any, project: bool) -> Data:
        """x, ẋ and λ; `project` moves x to M_f where D is a graph."""
        x = self.point(data)
        if project and self.holonomic is not None and self.is_graph:
            x = self.project(x, params)
        if self.explicit:
            rate, held = self.hamiltonian_vector(x, self.differential(x, params), params), jnp.zeros(0)
            if self.holonomic is not None:
                held = self.held(x, params)
                rate = rate - self.forces(x, params) @ held
            return {"x": x, "velocity": rate, "multipliers": held}
        matrix, right = self._rates(x, params)
        rates = scaled_inverse(matrix, RATE_RANK)[0] @ right
        return {"x": x, "velocity": rates[: x.shape[0]], "multipliers": rates[x.shape[0] :]}

    def velocity_at(self, row: Data, params: Any) -> Float[Numbers, " N"]:
        """ẋ: of a two-form without constraints by one elimination, not finite where that is degenerate. In odd dimensions it is
        so everywhere, and the smallest ẋ is taken."""
        x = row["x"]
        if self.structure.representation == "two_form" and self.holonomic is None and x.shape[0] % 2 == 0:
            return self.hamiltonian_vector(x, self.differential(x, params), params)
        return self.complete(row, params, False)["velocity"]

    def _rates(self, x, params):
        """The linear equations of (ẋ, λ) with G ẋ = 0 among them."""
        (matrix, right), rows = self.equations(x, params), self.holonomic_matrix(x, params)
        count = rows.shape[0]
        matrix = jnp.concatenate([matrix, jnp.concatenate([rows, jnp.zeros((count, count))], axis=1)])
        return matrix, jnp.concatenate([right, jnp.zeros(count)])

    def project(self, x: Float[Numbers, " N"], params: Any = None) -> Float[Numbers, " N"]:
        """A point of M_f near x, for a graph D: g = 0 nearest in x, then {g, H} = 0 along the forces if the brackets vanish."""
        x = self.project_position(x, x, params)
        along, rows = self.forces(x, params), self.holonomic_matrix(x, params)
        end = x + along @ nearest_root(lambda s: self.hidden_defect(x + along @ s, params), jnp.zeros(along.shape[1]))
        return jnp.where(jnp.max(jnp.abs(rows @ along)) <= BRACKET_DEFECT * jnp.sum(rows**2), end, x)

    def initial_defect(self, data: Data, params: Any) -> Float[Numbers, " k"]:
        """The part of F ẋ + E dH that no velocity makes zero: x is on M_0 where it vanishes. With holonomic constraints g and
        what no (ẋ, λ) makes zero of (F ẋ + E (dH − Gᵀλ), G ẋ): the tangency defect where D is a graph."""
        x = data["x"]
        if self.holonomic is None:
            return self.relation(x, data["velocity"], jnp.zeros(0), 0.0, params)
        if self.is_graph:
            return jnp.concatenate([self.holonomic(x, params), self.tangency_defect(x, params)])
        return jnp.concatenate([self.holonomic(x, params), self.relation(x, data["velocity"], data["multipliers"], 0.0, params)])

    def sizes_of_data(self, data: Data, params: Any) -> Data:
        """Each coordinate as large as all of the energy makes it, and rates that are zero up to roundoff of the others."""
        x = data["x"]
        largest = jnp.abs(x) + as_large_as_energy(lambda x: self.differential(x, params), x)
        sizes = {name: jnp.abs(a) for name, a in data.items()} | {"x": largest}
        if self.holonomic is not None and self.is_graph:
            return sizes
        rates = of_solution(
            lambda: self._rates(x, params)[0], jnp.concatenate([data["velocity"], data["multipliers"]]), tolerance=RATE_RANK
        )
        return sizes | {"velocity": rates[: x.shape[0]], "multipliers": rates[x.shape[0] :]}

    def energy_at(self, row: Data, params: Any) -> Float[Numbers, ""]:
        """H(x)."""
        return self.hamiltonian(row["x"], params)

    def constraint_at(self, row: Data, params: Any) -> Float[Numbers, " k"]:
        """The defect of x, as in `initial_defect`."""
        return self.initial_defect(self.complete({"x": row["x"]}, params, False), params)

    @property
    def projected(self) -> str:
        return "x across the constraint by its forces" if self.holonomic is not None and self.is_graph else ""

    @property
    def constrains_differential(self) -> bool:
        return self.holonomic is None

    @property
    def has_constraint_sizes(self) -> bool:
        return self.holonomic is None

    def constraint_sizes_at(self, row: Data, params: Any) -> Float[Numbers, " k"]:
        """The terms of F ẋ + E dH: those of a two-form cancel, and are as large as it is."""
        x = row["x"]
        velocity = jnp.abs(self.complete({"x": x}, params, False)["velocity"])
        covector = jnp.abs(self.differential(x, params))
        if self.canonical:
            return jnp.roll(velocity, x.shape[0] // 2) + covector
        F, E = (jnp.abs(jnp.asarray(a)) for a in self.structure.kernel(x, params))
        return F @ velocity + E @ covector
