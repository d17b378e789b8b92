"""AbstractSystem: what every system says of itself to schemes, to the constraint algorithm, to `simulate` and to `verify`."""

from abc import abstractmethod
from collections.abc import Callable, Mapping
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Float

from dirax.geometry.manifolds import AbstractManifold
from dirax.geometry.semidirect import SemidirectProduct
from dirax.numerics.arrays import Data, Numbers
from dirax.program.legendre import constrained_velocity
from dirax.program.rounding import sizes_of_terms
from dirax.program.tracing import gradient, jacobian
from dirax.program.user_functions import is_traced
from dirax.systems.constraints import Constraints
from dirax.systems.forms import EnergyForm, FinalManifold, ImplicitForm, RelationForm
from dirax.systems.implicit_form import of_relation
from dirax.systems.premise import Premise
from dirax.systems.shape import Shape
from dirax.text.representation import module_html, module_text


class AbstractSystem(eqx.Module):
    """A mechanical system as the user states it; no time step in here.

    A system of one's own subclasses this one. It must say its sizes, complete initial data, and say how far they are off the
    constraints, its energy and its constraint at a saved row: the five abstract methods. It should say in what forms it can
    be discretized, at least one of these:

    - `relation_form`: a relation between x and ẋ, for Method 1 of `dx.DiscreteDirac` with any discretization map; and where
      it is affine in ẋ and in the multipliers, for `dx.constraint_algorithm`;
    - `lagrangian_form`: a Lagrangian with constraints, for every scheme that takes a `dx.LagrangeDirac`;
    - `final_manifold`: its final constraint manifold, for Method 2.

    All methods act on one trajectory (no batch axis); those of data, rows and points are traceable.
    """

    def __repr__(self) -> str:
        return module_text(self)

    def _repr_html_(self) -> str:
        return module_html(self)

    # ------------------------------------------------------------------ what every system says

    @abstractmethod
    def sizes(self, data: Data, params: Any) -> tuple[int, ...]:
        """(n, m) or (n, m, c): the number of coordinates, of constraints and of holonomic constraints.

        `data` are the initial data as they were given: x · q, v · q, p · q0, q1 · q. Raises `ValueError` where they are not
        among those that the system starts from, and when the user's functions have wrong shapes.
        """

    @abstractmethod
    def complete(self, data: Data, params: Any, project: bool) -> Data:
        """The initial data, which hold the time `t` too, with everything a scheme may start from.

        - From x: x and `velocity`, the ẋ there (a first guess of it, where the equations do not determine it); and `guess`, that
          of the multipliers of the relation form, where it is not zero.
        - From q with v or p, and from q alone where the system determines the rest: q, v, p; and x, `velocity` too where the
          system has a relation form.
        - From q0, q1: these two.

        Other keys are the system's own, for its `initial_defect`. With `project` the data are moved onto the constraints.
        """

    @abstractmethod
    def initial_defect(self, data: Data, params: Any) -> Float[Numbers, " k"]:
        """By how much completed initial data violate the constraints, one number a constraint."""

    def initial_terms(self, data: Data, params: Any) -> Float[Numbers, " k"]:
        """The sizes of the terms of `initial_defect`, however they cancel: what it is compared with, whatever the units."""
        return defect_terms(self, data, params)

    def sizes_of_data(self, data: Data, params: Any) -> Data:
        """How large each of the completed data counts as in these terms: |a|, and more where a zero may be one up to a rounding
        of what it could be."""
        return {name: jnp.abs(a) for name, a in data.items()}

    @property
    def searches_near(self) -> tuple[str, ...]:
        """The saved fields that say where, of several, the velocity or the parameters of a row are, its entry `about`: those of
        nodes by their changes from row to row, those of steps by those before and after it; () where none are searched."""
        return ()

    @abstractmethod
    def energy_at(self, row: Data, params: Any) -> Float[Numbers, ""]:
        """The energy at one saved row (its node fields, and the time `t`)."""

    @abstractmethod
    def constraint_at(self, row: Data, params: Any) -> Float[Numbers, " k"]:
        """The constraints at one saved row (its node fields, and the time `t`), zero where they hold."""

    def velocity_at(self, row: Data, params: Any) -> Numbers:
        """q̇, or ẋ of a row without q, at one row (its node fields, and the time `t`), for schemes that ask for it in a step; by
        default the q̇ of p of a system with a Lagrangian."""
        form = self.lagrangian_form()
        if form is None or "p" not in row:
            return self.complete(row, params, False)["v" if "q" in row else "velocity"]
        t, q, rest = row["t"], row["q"], jnp.zeros_like(row["q"])
        rows, offset = form.constraints.matrix(t, q, params), form.constraints.velocity_defect(t, q, rest, params)
        return constrained_velocity(lambda v: form.lagrangian.at(t, q, v, params), row["p"], rows, offset, rest)[0]

    @property
    def stepped_by(self) -> str:
        """Which schemes step it, a sentence for those that do not; empty where many do."""
        return ""

    @property
    def linearized_as(self) -> str:
        """What is linearized in its place, a clause; empty where it is itself."""
        return ""

    # ------------------------------------------------------------------ the forms in which it can be discretized

    def relation_form(self, shape: Shape) -> RelationForm | None:
        """The relation between x and ẋ that a discretization map discretizes; None for a system without one."""
        return None

    def energy_form(self, shape: Shape) -> EnergyForm | None:
        """The Hamiltonian whose balance `dx.DiscreteGradient` keeps, of a system with a relation form; None where none is."""
        return None

    def lagrangian_form(self) -> Any:
        """The same system as a Lagrangian with constraints in coordinates, a `dx.LagrangeDirac`; None where there is none."""
        return None

    def manifold_form(self) -> Any:
        """The same system as a Lagrangian on a manifold in R^N, a `dx.ManifoldLagrangian`; None where there is none."""
        return None

    def hamiltonian_form(self) -> Any:
        """The same system as a Hamiltonian on T*Q with constraints on velocities, a `dx.HamiltonDirac`; None where there is
        none."""
        return None

    def phase_space_form(self) -> Any:
        """The same system in x = (q, p) as a `dx.HamiltonDirac`, whose one-forms need not be counted among the constraints of
        this one; its `hamiltonian_form` by default."""
        return self.hamiltonian_form()

    def quotient_form(self) -> Any:
        """The same system as one on the quotient by its symmetry, a `dx.ReducedLagrangeDirac`; None where it is none."""
        return None

    def lie_algebra_form(self) -> Any:
        """The same system as one on a Lie algebra or its dual, reduced by the group, a `dx.EulerPoincare` or `dx.LiePoisson`;
        None where it is none."""
        return None

    @property
    def manifolds(self) -> dict[str, AbstractManifold]:
        """Of which manifolds in R^N the arrays of a row, or of initial data, are points, by name."""
        return {}

    def metric_form(self) -> Any:
        """The same system as a metric, a potential and one-forms alone, a `dx.NonholonomicMechanics`, for which Method 2 has
        closed forms ([BLM] §8); None where there is none."""
        return None

    def final_manifold(self, shape: Shape) -> FinalManifold | None:
        """The final constraint manifold M_f = {φ = 0} in coordinates x, for Method 2; None where it is not known.

        Raises `ValueError` where it is known to be out of reach, with the way out.
        """
        return None

    def final_relation(self, shape: Shape) -> RelationForm | None:
        """The system on M_f in coordinates of M_f itself, for Method 2; None where it is not known."""
        return None

    def implicit_form(self, near: Any, params: Any) -> ImplicitForm:
        """The system around the point `near` as linear equations of (ẋ, u), for the constraint algorithm.

        `near` is an array x, or a dict of initial data such as {"q": …, "v": …}, with the time as "t". By default that of the
        relation form, with the positions' constraints g = 0. Raises `TypeError` for a system without an implicit form, and
        `ValueError` for points of the wrong length.
        """
        return of_relation(self, near, params)

    # ------------------------------------------------------------------ constraints

    @property
    def constraints(self) -> Constraints:
        """The constraints that are stated as functions of (t, q), or of (t, x); none by default."""
        return Constraints(None, None, None)

    def point(self, data: Data) -> Numbers:
        """The point in initial data at which the constraints hold: x, q or q0."""
        return next(data[name] for name in ("x", "q", "q0") if name in data)

    def project_position(self, q: Numbers, v: Numbers, params: Any = None, t: Any = 0.0) -> Numbers:
        """A point with g = 0 near q, moved along Gᵀ, G = ∂g/∂q."""
        if self.constraints.holonomic is None:
            return q
        return self.constraints.nearest_position(t, q, self.constraints.holonomic_matrix(t, q, params).T, params)

    def project_velocity(self, q: Numbers, v: Numbers, params: Any = None, t: Any = 0.0) -> Numbers:
        """The velocity nearest to v with W v + b = 0 and G v + ∂g/∂t = 0."""
        return self.constraints.nearest_velocity(t, q, v, self.constraints.matrix(t, q, params).T, params)

    # ------------------------------------------------------------------ the rest

    def premise(self, data: Data, params: Any) -> Premise | None:
        """What has to hold of numbers at initial data beside their shapes, for runs that begin near these, which are concrete;
        None for a system that presupposes nothing of the kind."""
        return None

    def check(self, data: Data, params: Any) -> None:
        """Raise `ValueError` where the premise does not hold at initial data; of traced ones nothing is asked."""
        if not is_traced(data, params) and (premise := self.premise(data, params)):
            premise.check(data, params)

    @property
    def premise_everywhere(self) -> bool:
        """Whether the premise is one of all points that a run comes to, and not of where it begins alone: `verify` asks it."""
        return False

    @property
    def premise_of_params(self) -> bool:
        """Whether there is a premise of the functions themselves too, which other params may break: `check` asks it."""
        return False

    def lagrangian_value(self, t: Any, q: Numbers, v: Numbers, params: Any) -> Float[Numbers, ""] | None:
        """L(t, q, v), by which data outside its domain are found; None for a system without a Lagrangian."""
        form = self.lagrangian_form()
        return None if form is None else form.lagrangian.at(t, q, v, params)

    def velocity_hessian(self, t: Any, q: Numbers, v: Numbers, params: Any) -> Float[Numbers, "n n"] | None:
        """∂²L/∂v², by which a singular Lagrangian is told; None for a system without a Lagrangian on TQ."""
        form = self.lagrangian_form()
        return None if form is None else jacobian(gradient(lambda v: form.lagrangian.at(t, q, v, params)))(v)

    def with_inputs(self, inputs: Callable) -> "AbstractSystem":
        """The same system driven by u = inputs(t, x[, params]) through its open ports; raises `TypeError` without ports."""
        raise TypeError(
            f"inputs= drives an open dx.PortHamiltonian system, but the system is a {type(self).__name__}: leave it out."
        )

    @property
    def projected(self) -> str:
        """What `complete` moves with `project`, in words that follow "project=True, which moves"; "" where it moves nothing."""
        return "the data"

    def explain(self, x: Numbers) -> str:
        """Which constraint the point x is off, and the way back, in words for a message; "" where there is no more to say."""
        return ""

    @property
    def has_clock(self) -> bool:
        """Whether the time is a coordinate, which `clock` reads."""
        return False

    def clock(self, data: Mapping[str, Any]) -> Any:
        """The time of initial data, (B,) of a batch."""
        raise TypeError(f"the time is no coordinate of a {type(self).__name__}.")

    # ------------------------------------------------------------------ what `verify` asks

    @property
    def energy_changes(self) -> str:
        """Why the system changes its energy, forces apart, in words that follow "the system"; "" where it does not."""
        return ""

    @property
    def has_power(self) -> bool:
        """Whether `power_at` says how the equations change the energy, where `energy_changes` does not know."""
        return False

    def power_at(self, row: Data, params: Any) -> Float[Numbers, " 2"]:
        """The rate of the energy at a row, and the sum of the absolute values of its terms."""
        raise TypeError(f"a {type(self).__name__} does not say the rate of its energy at a row.")

    @property
    def constrains_differential(self) -> bool:
        """Whether the constraint is that dE lie in a subspace, so that it has the size of dE."""
        return False

    @property
    def has_constraint_sizes(self) -> bool:
        """Whether `constraint_sizes_at` says more of the sizes of constraints than their derivatives do."""
        return False

    def constraint_sizes_at(self, row: Data, params: Any) -> Float[Numbers, " k"]:
        """How large the terms of `constraint_at` count as at one saved row."""
        return jnp.abs(self.constraint_at(row, params))

    def flow_size(self, x: Float[Numbers, " N"], params: Any) -> Float[Numbers, ""]:
        """The sum of the sizes of the terms of ⟨dH, ẋ⟩, which may cancel; 0 where it is not balanced against ports."""
        return jnp.zeros(())

    @property
    def dual(self) -> SemidirectProduct | None:
        """The dual of a Lie algebra or of a semidirect product that the points x are of; None for other systems."""
        return None


def defect_terms(system: AbstractSystem, data: Data, params: Any) -> Float[Numbers, " k"]:
    """The sizes of the terms of the `initial_defect` of a system, of data as large as its `sizes_of_data`."""
    values, errors = ({n: jnp.asarray(a, float) for n, a in d.items()} for d in (data, system.sizes_of_data(data, params)))
    defect = lambda *values: system.initial_defect(dict(zip(data, values, strict=True)), params)
    return sizes_of_terms(defect, *values.values(), errors=tuple(errors[name] for name in data))


def refuse_start(system: AbstractSystem, data: Data, *kinds: str) -> None:
    """Raise `ValueError` for initial data that are none of `kinds`, such as "q, v"."""
    given = set(data) - {"t"}
    if given in [set(kind.split(", ")) for kind in kinds]:
        return
    known = " · ".join(f"{kind.replace(',', '=,')}=" for kind in kinds)
    own = f"a {type(system).__name__} system starts from {known}"
    if given == {"q"}:
        raise ValueError(f"initial data must be one of q=, v= · q=, p= · q0=, q1= · x=, but q= alone was given: {own}.")
    raise ValueError(f"{own}, but {', '.join(f'{name}=' for name in data)} was given.")
