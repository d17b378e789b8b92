"""A system as an explicit ordinary differential equation ẏ = f(t, y), for libraries that integrate those."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from dirax.diagnostics.bench.subject import Skipped
from dirax.numerics.equilibration import equilibrated, geometric_scales
from dirax.program.linear_solves import solve
from dirax.program.memo import Same
from dirax.program.user_functions import evaluated
from dirax.run.final_manifold import moved_onto
from dirax.systems.constraint_algorithm import constraint_algorithm
from dirax.systems.constraint_chain import DETERMINED
from dirax.systems.dirac_system import DiracSystem
from dirax.systems.lagrange_dirac import LagrangeDirac
from dirax.systems.nonholonomic import NonholonomicMechanics
from dirax.systems.phase_space import PhaseSpaceLagrangian
from dirax.systems.port_hamiltonian import PortHamiltonian
from dirax.systems.shape import Shape
from dirax.systems.system import AbstractSystem

WRITTEN_OUT = 16
"""Equations up to which elimination is written out in scalars: its operations grow with the third power, and JAX takes half a
millisecond to trace one."""

SINGULAR = 1e12
"""Condition number from which on the equations do not determine the derivatives."""


@dataclass(frozen=True)
class ExplicitODE:
    """`derivative(t, y)` is traceable; `start` (d,) is y at t = 0, whose first `shown` entries are q (or x)."""

    derivative: Callable[[Any, Float[Array, " d"]], Float[Array, " d"]]
    start: np.ndarray
    shown: int


@dataclass(frozen=True)
class _Completion:
    """(data, params) ↦ the data as the system completes them."""

    same: Same
    project: bool

    def __call__(self, data, params):
        return self.same.object.complete(dict(data), params, self.project)


def completed(system: AbstractSystem, data: Mapping[str, Any], params: Any, project: bool = False) -> dict[str, Any]:
    """`system.complete(data, params, project)` of one trajectory, without a compiler where that can be."""
    return evaluated(_Completion(Same(system), project), dict(data), params)


def explicit_ode(system: AbstractSystem, data: Mapping[str, Array], params: Any) -> ExplicitODE:
    """The equations of motion solved for the derivatives, multipliers eliminated; `data` are initial data of one trajectory.

    y is (q, v) for a regular Lagrangian, also with constraints c(t, q, v) = 0: M v̇ = ∂L/∂q + f − (∂²L/∂v∂q) v + (∂c/∂v)ᵀλ
    with ċ = 0, without any term that would bring y back to the constraints. It is q for a phase-space Lagrangian, x for a
    Dirac or port-Hamiltonian system, and of other relations of x the point of the final manifold that the constraint algorithm
    finds, x first. Raises `Skipped` where the equations do not determine ẏ, or are stated in
    another way.
    """
    match system:
        case NonholonomicMechanics():
            return explicit_ode(system.lagrange_dirac(), data, params)
        case LagrangeDirac():
            complete = completed(system, data, params)
            if "v" not in complete:
                raise Skipped("the run starts from two points")
            start = np.concatenate([complete["q"], complete["v"]])
            return _solved(_newton_equations(system, len(complete["q"]), params), start, len(complete["q"]))
        case PhaseSpaceLagrangian():
            return _solved(_hamilton_equations(system, params), data["q"], len(data["q"]))
        case DiracSystem() if system.holonomic is None or system.is_graph:
            x = completed(system, data, params)["x"]
            return _solved(_dirac_equations(system, params), x, len(x))
        case PortHamiltonian() if not system.closed:
            return ExplicitODE(_open_ports(system, params), np.asarray(data["x"]), len(data["x"]))
    if "x" in data and system.relation_form(Shape(*system.sizes(dict(data), params))) is not None:
        return _on_final_manifold(system, data, params)
    raise Skipped(f"no ordinary differential equation is derived for {type(system).__name__} systems")


LinearEquations = Callable[[Any, Any], tuple[Any, Any, Callable]]
"""(t, y) ↦ (A, b, ẏ as a function of the solution z of A z = b)."""


def _newton_equations(system: LagrangeDirac, n: int, params: Any) -> LinearEquations:
    def equations(t, y):
        t, q, v = jnp.asarray(t, float), y[:n], y[n:]
        along = lambda function: jax.jvp(lambda t, q: function(t, q, v), (t, q), (jnp.ones(()), v))[1]
        momentum = lambda t, q, v: system.legendre(q, v, params, t)
        velocity = lambda t, q, v: system.constraints.velocity_defect(t, q, v, params)
        force = jax.grad(lambda q: system.lagrangian.at(t, q, v, params))(q) - along(momentum)
        if system.forces is not None:
            force = force + system.forces(t, q, v, params)
        mass, rows = jax.jacfwd(momentum, argnums=2)(t, q, v), jax.jacfwd(velocity, argnums=2)(t, q, v)
        matrix = jnp.block([[mass, -rows.T], [rows, jnp.zeros((len(rows), len(rows)))]])
        return matrix, jnp.concatenate([force, -along(velocity)]), lambda z: jnp.concatenate([v, z[:n]])

    return equations


def _hamilton_equations(system: PhaseSpaceLagrangian, params: Any) -> LinearEquations:
    def equations(t, q):
        return system.two_form(q, params), jax.grad(lambda q: system.hamiltonian(q, params))(q), lambda z: z

    return equations


def _dirac_equations(system: DiracSystem, params: Any) -> LinearEquations:
    def equations(t, x):
        matrix, right = system.equations(x, params)
        if system.holonomic is None:
            return matrix, right, lambda z: z
        slope = jax.jacfwd(lambda x: system.hidden_defect(x, params))(x)  # of {g, H}, which stays zero
        c, n = slope.shape
        matrix = jnp.concatenate([matrix, jnp.concatenate([slope, jnp.zeros((c, c))], axis=1)])
        return matrix, jnp.concatenate([right, jnp.zeros(c)]), lambda z: z[:n]

    return equations


def _open_ports(system: PortHamiltonian, params: Any) -> Callable:
    def derivative(t, x):
        velocity = system.flow_matrix(x, params) @ system.differential(x, params)
        return velocity if system.inputs is None else velocity + system.open_matrix(x, params) @ system.input(t, x, params)

    return derivative


def _on_final_manifold(system: AbstractSystem, data: Mapping[str, Array], params: Any) -> ExplicitODE:
    """ẏ = the field that the constraint algorithm finds; of data on the final manifold alone."""
    x = np.asarray(completed(system, data, params)["x"])
    chain = constraint_algorithm(system, {"x": x, "t": float(data.get("t", 0.0))} if "t" in data else x, params)
    if chain.verdict != DETERMINED:
        raise Skipped(f"the constraint algorithm ends with {chain.verdict}")
    own = np.asarray(chain.point)[len(x) :]
    start = moved_onto(chain, np.concatenate([x, own]), slice(len(x), len(x) + len(own) - chain.clock), params)
    if off := chain.off_level(jnp.asarray(start), params):
        raise Skipped(f"the data are off the final manifold: {off}")
    return ExplicitODE(lambda t, y: chain.field(y, params), start, len(x))


def _solved(equations: LinearEquations, start: Any, shown: int) -> ExplicitODE:
    """The equations with z eliminated, where there are few in scalars with the order of the pivots as it is at the start."""
    matrix = np.asarray(evaluated(lambda y: equations(0.0, y)[0], jnp.asarray(start)))
    rows, columns = geometric_scales(np.abs(matrix))  # forces and velocities have units of their own
    scaled, _ = equilibrated(matrix / rows / columns)
    if not np.all(np.isfinite(matrix)) or np.linalg.cond(scaled) > SINGULAR:
        raise Skipped("its equations do not determine the derivatives (singular)")
    order = pivot_order(scaled)

    def derivative(t, y):
        matrix, right, rate = equations(t, y)
        return rate(eliminate(matrix, right, order) if len(order) <= WRITTEN_OUT else solve(matrix, right))

    return ExplicitODE(derivative, np.asarray(start), shown)


def pivot_order(matrix: np.ndarray) -> list[int]:
    """The order in which partial pivoting takes the rows."""
    table, order = np.array(matrix, dtype=float), list(range(len(matrix)))
    for c in range(len(table)):
        best = c + int(np.argmax(np.abs(table[c:, c])))
        table[[c, best]], order[c], order[best] = table[[best, c]], order[best], order[c]
        table[c + 1 :] -= np.outer(table[c + 1 :, c] / table[c, c], table[c])
    return order


def eliminate(matrix: Float[Array, "k k"], right: Float[Array, " k"], order: list[int]) -> Float[Array, " k"]:
    """z with matrix z = right, elimination written out with the rows in `order`."""
    k = len(order)
    rows = [[matrix[i, j] for j in range(k)] + [right[i]] for i in order]
    for c in range(k):
        for i in range(c + 1, k):
            factor = rows[i][c] / rows[c][c]
            rows[i] = [a - factor * b if j > c else a for j, (a, b) in enumerate(zip(rows[i], rows[c], strict=True))]
    z: list[Any] = [None] * k
    for i in reversed(range(k)):
        z[i] = (rows[i][k] - sum((rows[i][j] * z[j] for j in range(i + 1, k)), jnp.array(0.0))) / rows[i][i]
    return jnp.stack(z)
