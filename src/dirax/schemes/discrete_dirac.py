"""Discrete Dirac systems by discretization maps ([BLM] §5): one scheme for Hamiltonian, Lagrangian and port systems."""

import dataclasses
from typing import Any

import jax.numpy as jnp
import numpy as np

from dirax.geometry.cotangent_lift import CotangentLift
from dirax.geometry.maps import AbstractDiscretizationMap, Midpoint, Theta
from dirax.program.tracing import gradient, jacobian
from dirax.program.user_functions import evaluated
from dirax.schemes.constraint_rows import independent_constraints
from dirax.schemes.discretized import stepping
from dirax.schemes.lagrangian_methods import discretized_lagrangian, resolved_lagrangian, resolved_nonholonomic
from dirax.schemes.resolved import of_chain, of_constrained_hamiltonian, projected_field
from dirax.schemes.step import AbstractScheme, Field, Shape, StepEquation
from dirax.systems.constraint_algorithm import rank_of
from dirax.systems.constraint_chain import ResolvedSystem
from dirax.systems.dirac_system import DiracSystem
from dirax.systems.implicit_system import ImplicitSystem
from dirax.systems.lagrange_dirac import LagrangeDirac
from dirax.systems.nonholonomic import NonholonomicMechanics, as_lagrange_dirac
from dirax.systems.phase_space import PhaseSpaceLagrangian
from dirax.systems.port_hamiltonian import PortHamiltonian

CONSTRAINTS = ("discretize", "resolve")


class DiscreteDirac(AbstractScheme):
    """The discrete Dirac system S_d^h of a discretization map ([BLM] §5.1):

        (R_d⁻¹(x_k, x_{k+1})/h, α_x) ∈ D_x,   x the base point of R_d⁻¹(x_k, x_{k+1}).

    `map`: any discretization map; on T*Q of a Lagrangian system a map on Q is lifted. `constraints`:
    "discretize" ([BLM] Method 1) discretizes the implicit system S_0 as it stands; "resolve" ([BLM] Method 2) runs the
    constraint algorithm first and discretizes on M_f, so that its constraints hold at the nodes to roundoff. Of holonomic
    constraints g = 0, Method 1 imposes the distribution G q̇ + ∂g/∂t = 0 at the base point, which keeps quadratic g for the
    midpoint map and others to O(h²); Method 2 keeps g and G q̇ + ∂g/∂t at the nodes, to roundoff. With either kind of
    constraint the multipliers of Method 1 alternate around those of the system by O(h), and means of neighbours are of the
    order of q. Method 2 of a DiracSystem with `holonomic` is stated here for graphs of two-forms and bivectors with
    {g_i, g_j} = 0, and by its resolved chain for others. Multipliers are forces at the base point, ṗ = … + Wᵀλ; those of
    `dx.LagrangeDAlembert` are impulses of the opposite sign.

    Takes DiracSystem, PortHamiltonian, ImplicitSystem, LagrangeDirac, NonholonomicMechanics and PhaseSpaceLagrangian
    systems, and what `ConstraintChain.resolved` returns, on which it is Method 2 for any system; raises `TypeError` for
    others, and `ValueError` for maps that do not fit the system's space and for Method 2 of a system with constraints that
    are not stated as such, those of a singular Lagrangian say.
    """

    map: AbstractDiscretizationMap
    constraints: str

    def __init__(self, map: AbstractDiscretizationMap | None = None, constraints: str = "discretize"):
        if map is not None and not isinstance(map, AbstractDiscretizationMap):
            raise TypeError(f"map must be a discretization map such as dx.Midpoint(), but {map!r} was given.")
        if constraints not in CONSTRAINTS:
            raise ValueError(f'constraints must be "discretize" or "resolve", but {constraints!r} was given.')
        self.map = Midpoint() if map is None else map
        self.constraints = constraints

    def step_equation(self, system: Any, shape: Shape) -> StepEquation:
        resolve = self.constraints == "resolve"
        if isinstance(system, ResolvedSystem):
            return projected_field(of_chain(system), shape.n, _theta_of_points(self.map))
        if isinstance(system, DiracSystem) and system.is_graph and shape.c and resolve:
            return projected_field(of_constrained_hamiltonian(system, shape), shape.n, _theta_of_points(self.map))
        if isinstance(system, DiracSystem | PortHamiltonian | ImplicitSystem) and shape.m + shape.c and resolve:
            raise ValueError(
                f"Method 2 of this {type(system).__name__} with multipliers needs its final manifold: simulate "
                "dx.constraint_algorithm(system, near=x).resolved() instead of the system."
            )
        if isinstance(system, DiracSystem | PortHamiltonian | ImplicitSystem):
            return _nothing_hidden(system, discretized_relation(system, shape, self.map), resolve)
        if isinstance(system, PhaseSpaceLagrangian):
            if resolve:
                return _on_graph(system, shape, self.map)
            return discretized_lagrangian(system.lagrange_dirac(), shape, _theta_of(self.map))
        if isinstance(system, NonholonomicMechanics) and resolve and system.closed_form and not shape.redundant:
            return resolved_nonholonomic(system, shape, _theta_of(self.map))
        system = as_lagrange_dirac(system)
        if isinstance(system, LagrangeDirac):
            if resolve and shape.m + shape.c:
                return resolved_lagrangian(system, shape, _theta_of(self.map))
            return _nothing_hidden(system, discretized_lagrangian(system, shape, _theta_of(self.map)), resolve)
        raise TypeError(
            "dx.DiscreteDirac discretizes DiracSystem, PortHamiltonian, ImplicitSystem, LagrangeDirac, NonholonomicMechanics and "
            f"PhaseSpaceLagrangian systems, but a {type(system).__name__} was given."
        )


def _nothing_hidden(system: Any, equation: StepEquation, resolve: bool) -> StepEquation:
    """The equation, which for Method 2 refuses systems whose constraints are not stated as such: a Lagrangian with a singular
    Hessian, equations of ẋ with a singular matrix."""
    if not resolve or isinstance(system, PortHamiltonian):
        return equation
    hessian = lambda t, q, v, params: jacobian(gradient(lambda v: system.lagrangian.at(t, q, v, params)))(v)

    def check(data, h, params):
        equation.check(data, h, params)
        if isinstance(system, LagrangeDirac):
            if "p" in data:
                return
            q, v = (data["q0"], (data["q1"] - data["q0"]) / h) if "q0" in data else (data["q"], data["v"])
            matrix, what = np.asarray(evaluated(hessian, np.zeros(()), q, v, params)), "∂²L/∂v²"
        else:
            x = system.point(data) if isinstance(system, DiracSystem) else data["x"]
            matrix, what = np.asarray(evaluated(system.equations, np.asarray(x), params)[0]), "the matrix of ẋ"
        rank = rank_of(matrix)
        if rank < max(matrix.shape):
            near = '{"q": …, "v": …}' if isinstance(system, LagrangeDirac) else "x"
            raise ValueError(
                f"Method 2 of this {type(system).__name__} needs its final manifold, since {what} has rank {rank} of "
                f"{max(matrix.shape)} at the initial data: simulate dx.constraint_algorithm(system, near={near}).resolved() "
                "instead of the system, from x=chain.point."
            )

    return dataclasses.replace(equation, check=check)


def discretized_relation(
    system: DiracSystem | PortHamiltonian | ImplicitSystem, shape: Shape, map: AbstractDiscretizationMap
) -> StepEquation:
    """The relation between (x, ẋ) of a system on M, discretized by a map on M: state x, unknowns (ẋ, multipliers)."""
    size = shape.n
    system, m, all_of_them = independent_constraints(system, shape)
    step = stepping(map, size)
    d = step.dimension

    def residual(u, state, t, h, params):
        x, velocity, _ = step.move(state, u[:d], h)
        r = system.relation(x, velocity, u[d:], t + h / 2, params)
        if step.tangent is None:
            return r
        return jnp.concatenate([step.tangent(state, x) @ r[:size], r[size:]])

    def advance(u, state, t, h, params):
        return step.move(state, u[:d], h)[2]

    def unpack(state, u, t, h, params):
        row = {"x": state, "multipliers": all_of_them(u[d:])} if m else {"x": state}
        if ported is not None:
            x, velocity, _ = step.move(state, u[:d], h)
            row["power"] = power_of(ported, x, velocity, t + h / 2, params)
        return row

    def start(data, h, params):
        if "x" not in data:
            raise ValueError("this scheme starts from x= (or q=, p= for a system on T*Q).")
        return data["x"], jnp.concatenate([step.initial(data["x"], data["velocity"]), jnp.zeros(m)])

    ported = system if isinstance(system, PortHamiltonian) else None
    fields = {"x": Field((size,))}
    if m:
        axis = "constraint" if shape.c else "closed_port"
        fields["multipliers"] = Field((shape.m + shape.c,), "step", (axis,), "multipliers at the base point")
    if ported is not None:
        fields["power"] = Field((3,), "step", ("power",), "power stored ⟨dH, ẋ⟩, supplied and dissipated at the base point")
    return StepEquation(
        start=start,
        residual=residual,
        advance=advance,
        unpack=unpack,
        state_size=size,
        unknowns=d + m,
        fields=fields,
        labels=tuple(f"component {i} of the Dirac condition" for i in range(d))
        + tuple(f"rate of constraint {a}" if shape.c else f"output y[{a}]" for a in range(m)),
        canonical=isinstance(system, DiracSystem) and system.canonical,
    )


def power_of(system: PortHamiltonian, x, velocity, t, params):
    """(⟨dH, ẋ⟩, ⟨y, u⟩ of the open ports, ⟨dH, R dH⟩) at a base point; the first is the second less the third ([BLM] §7.1)."""
    dh = system.differential(x, params)
    supplied = system.input(t, x, params) @ (system.open_matrix(x, params).T @ dh)
    dissipated = jnp.zeros(()) if system.R is None else dh @ system.R(x, params) @ dh
    return jnp.stack([dh @ velocity, supplied, dissipated])


def _on_graph(system: PhaseSpaceLagrangian, shape: Shape, map: AbstractDiscretizationMap) -> StepEquation:
    """Method 2 on M_f = graph α: the Dirac system (dα, H) on Q ([BLM] (14)); p = α(q) is saved beside q."""
    inner = discretized_relation(system.dirac_system(), Shape(shape.n), map)

    def start(data, h, params):
        if "q" not in data:
            raise ValueError("Method 2 is a one-step method on Q: start it from q= (v= or p= are then determined).")
        return inner.start({"x": data["q"], "velocity": data["v"]}, h, params)

    def unpack(state, u, t, h, params):
        return {"q": state, "p": system.one_form(state, params)}

    return StepEquation(
        start=start,
        residual=inner.residual,
        advance=inner.advance,
        unpack=unpack,
        state_size=shape.n,
        unknowns=inner.unknowns,
        fields={"q": Field((shape.n,)), "p": Field((shape.n,))},
        labels=inner.labels,
    )


def _theta_of(map: AbstractDiscretizationMap) -> float:
    """θ of a θ map (or of its lift): the Lagrangian methods are written for vector spaces."""
    base = getattr(map, "map", map)
    if not isinstance(base, Theta):
        raise ValueError(
            f"a Lagrangian system is discretized by a θ map on its coordinates, but {type(map).__name__} was given: state "
            "the system on its manifold as a dx.DiracSystem on T*Q, with dx.cotangent_lift(map)."
        )
    return base.theta


def _theta_of_points(map: AbstractDiscretizationMap) -> float:
    """θ of a θ map of all coordinates x alike; the lift of the midpoint map is one."""
    theta = map.theta if isinstance(map, Theta) else None
    if isinstance(map, CotangentLift) and isinstance(map.map, Theta) and map.map.theta == 0.5:
        theta = 0.5
    if theta is None:
        raise ValueError(
            "Method 2 on a final manifold in coordinates x takes dx.Theta maps and dx.Midpoint(), which treat all coordinates "
            f"alike, but {type(map).__name__} was given."
        )
    return theta
