"""Port-Hamiltonian systems: open, closed, with dissipation, and interconnected."""

from collections.abc import Callable, Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from dirax.geometry.linear import LinearDirac
from dirax.geometry.structures import DiracStructure
from dirax.geometry.subspaces import PontryaginSubspace
from dirax.numerics.arrays import Data, Numbers, is_whole
from dirax.program.sparse_matrix import SparseMatrix
from dirax.program.tracing import gradient
from dirax.program.user_functions import UserFunction
from dirax.systems.constraints import no_constraint
from dirax.systems.forms import EnergyForm, ImplicitForm, Observed, RelationForm
from dirax.systems.implicit_form import in_time, names, point_of, uses_time, without_time
from dirax.systems.magnitudes import as_large_as_energy
from dirax.systems.port_matrices import (
    ConstantFunction,
    constituent,
    matrix_function,
    refuse_unless_dissipative,
    refuse_unless_skew,
)
from dirax.systems.port_structures import closed_structure, structure_of
from dirax.systems.premise import Premise
from dirax.systems.shape import Shape
from dirax.systems.system import AbstractSystem


class PortHamiltonian(AbstractSystem):
    """ẋ = (J(x) − R(x)) dH(x) + B(x) u, y = B(x)ᵀ dH(x) ([BLM] (20)).

    `hamiltonian(x[, params])` a scalar; `J(x[, params])` (N, N) skew; `B(x[, params])` (N, m), no ports by default;
    `R(x[, params])` (N, N) symmetric, positive semidefinite, no dissipation by default. J, B and R may be constant arrays, or
    sparse matrices of SciPy, with which a step of the discretized system costs in proportion to their entries.
    Open (default): u = `inputs(t, x[, params])` (m,), zero without it. Closed: u is the multiplier that keeps y = 0
    ([BLM] (23), a Dirac system); `closed` may also name the columns of B that are closed, the others stay open. A closed
    port imposes y = 0 alone: for constraints g(x) = 0 on positions, not on their rates only, see `DiracSystem`.

    Raises `ValueError` at the start of a run where J is not skew or R not symmetric positive semidefinite, with the defect.
    """

    hamiltonian: UserFunction
    J: UserFunction
    B: UserFunction | None
    R: UserFunction | None
    inputs: UserFunction | None
    closed: bool | tuple[int, ...]

    def __init__(
        self,
        hamiltonian: Callable,
        J: Callable | Any,
        B: Callable | Any = None,
        R: Callable | Any = None,
        closed: bool | Sequence[int] = False,
        inputs: Callable | None = None,
    ):
        self.hamiltonian = UserFunction(hamiltonian, "hamiltonian", ("x",))
        self.J = matrix_function(J, "J")
        self.B = None if B is None else matrix_function(B, "B")
        self.R = None if R is None else matrix_function(R, "R")
        self.inputs = None if inputs is None else UserFunction(inputs, "inputs", ("t", "x"))
        if not isinstance(closed, bool) and (isinstance(closed, str) or not all(map(is_whole, closed))):
            raise ValueError(f"closed must be True, False or the numbers of the columns of B that are closed, not {closed!r}.")
        self.closed = closed if isinstance(closed, bool) else tuple(int(port) for port in closed)
        if self.closed and B is None:
            raise ValueError("a closed port-Hamiltonian system needs B: its columns are the ports that are closed.")
        if self.closed is True and inputs is not None:
            raise ValueError("a closed port-Hamiltonian system takes no inputs: u is determined by y = 0.")

    def with_inputs(self, inputs: Callable) -> "PortHamiltonian":
        """The same open system driven by u = inputs(t, x[, params])."""
        matrices = (constituent(self.J), constituent(self.B), constituent(self.R))
        return PortHamiltonian(self.hamiltonian, *matrices, self.closed, inputs)

    def differential(self, x: Float[Numbers, " N"], params: Any = None) -> Float[Numbers, " N"]:
        """dH(x)."""
        return gradient(lambda x: self.hamiltonian(x, params))(x)

    def input_matrix(self, x: Float[Numbers, " N"], params: Any = None) -> Float[Numbers, "N m"] | SparseMatrix:
        """B(x); (N, 0) without ports."""
        return jnp.zeros((x.shape[0], 0)) if self.B is None else self.B(x, params)

    def closed_matrix(self, x: Float[Numbers, " N"], params: Any = None) -> Float[Numbers, "N k"] | SparseMatrix:
        """The columns of B(x) whose ports are closed."""
        b = self.input_matrix(x, params)
        return b[:, list(self._split(b.shape[1])[0])]

    def open_matrix(self, x: Float[Numbers, " N"], params: Any = None) -> Float[Numbers, "N k"] | SparseMatrix:
        """The columns of B(x) whose ports are open."""
        b = self.input_matrix(x, params)
        return b[:, list(self._split(b.shape[1])[1])]

    def _split(self, ports: int) -> tuple[tuple[int, ...], tuple[int, ...]]:
        closed = (tuple(range(ports)) if self.closed else ()) if isinstance(self.closed, bool) else self.closed
        return closed, tuple(port for port in range(ports) if port not in closed)

    def flow_matrix(self, x: Float[Numbers, " N"], params: Any = None) -> Float[Numbers, "N N"] | SparseMatrix:
        """J(x) − R(x)."""
        return self.J(x, params) if self.R is None else self.J(x, params) - self.R(x, params)

    def input(self, t: Any, x: Float[Numbers, " N"], params: Any = None) -> Float[Numbers, " m"]:
        """u(t, x) of the open ports, zero without inputs."""
        if self.inputs is None:
            return jnp.zeros(self.open_matrix(x, params).shape[1])
        return jnp.asarray(self.inputs(t, x, params))

    def output(self, x: Float[Numbers, " N"], params: Any = None) -> Float[Numbers, " m"]:
        """y = B(x)ᵀ dH(x)."""
        return self.input_matrix(x, params).T @ self.differential(x, params)

    def relation(
        self,
        x: Float[Numbers, " N"],
        velocity: Float[Numbers, " N"],
        multipliers: Float[Numbers, " m"],
        t: Any,
        params: Any = None,
        differential: Float[Numbers, " N"] | None = None,
    ) -> Float[Numbers, " k"]:
        """ẋ − (J − R) dH − B u, and y of the closed ports, whose u are `multipliers`; `differential` replaces dH(x)."""
        dh = self.differential(x, params) if differential is None else differential
        closed = self.closed_matrix(x, params)
        balance = velocity - self.flow_matrix(x, params) @ dh - closed @ multipliers
        if self.inputs is not None:
            balance = balance - self.open_matrix(x, params) @ self.input(t, x, params)
        return jnp.concatenate([balance, closed.T @ dh]) if self.closed else balance

    def power(self, x: Float[Numbers, " N"], velocity: Float[Numbers, " N"], t: Any, params: Any = None) -> Float[Numbers, " 3"]:
        """(⟨dH, ẋ⟩, ⟨y, u⟩ of the open ports, ⟨dH, R dH⟩); the first is the second less the third ([BLM] §7.1)."""
        dh = self.differential(x, params)
        supplied = self.input(t, x, params) @ (self.open_matrix(x, params).T @ dh)
        dissipated = jnp.zeros(()) if self.R is None else _squared(self.R(x, params), dh)
        return jnp.stack([dh @ velocity, supplied, dissipated])

    def relation_form(self, shape: Shape) -> RelationForm:
        labels = tuple(f"output y[{a}]" for a in range(shape.m))
        about = "power stored ⟨dH, ẋ⟩, supplied and dissipated at the base point"
        observed = (Observed("power", self.power, (3,), ("power",), about),)
        dirac = "ẋ = (J − R) dH + B u" + ", Bᵀ dH = 0 at the closed ports" * bool(shape.m)
        alone = None if self.R is not None or self.B is not None else lambda x, params: self.J(x, params)
        return RelationForm(
            self.relation,
            shape.m,
            labels,
            shape.m,
            axis="closed_port",
            observed=observed,
            dirac=dirac,
            bivector=alone,
            explicit=True,
        )

    def ports(
        self, t: Any, x: Float[Numbers, " N"], gradient: Float[Numbers, " N"], params: Any = None
    ) -> tuple[Numbers, Numbers, Numbers]:
        """(u, y, ⟨α, Rα⟩) with the inputs of the open ports, their outputs y = Bᵀα and the power dissipated, for a covector α
        in place of dH."""
        driven = self.input(t, x, params)
        outputs = self.open_matrix(x, params).T @ gradient
        return driven, outputs, jnp.zeros(()) if self.R is None else _squared(self.R(x, params), gradient)

    def dirac_structure(self, x: Any, params: Any = None) -> LinearDirac | PontryaginSubspace:
        """The set of all (v, α) at x (N,) that the equations leave: with open ports {v − Bu = Jα for some u} ([BLM] (22)), a
        coisotropic `dx.PontryaginSubspace`; with all ports closed that with Bᵀα = 0 ([BLM] (23)), a `dx.LinearDirac`; with some
        closed Bᵀα = 0 of these alone, coisotropic too (Proposition 7.1, whose D^⊥ is the part with Bᵀα = 0).

        Without inputs (ẋ, dH(x)) is in it. Raises `ValueError` with dissipation, and where J is not skew at x.
        """
        self._refuse_dissipation()
        x = jnp.asarray(x, dtype=float)
        self.sizes({"x": x}, params)
        self.check({"x": x}, params)
        return structure_of(self, x, params)

    def closed_dirac_structure(self) -> DiracStructure:
        """(23) at every x, a `dx.DiracStructure` as `dx.DiracSystem` and `dx.DiscretizationMapDirac` take it: smooth where the
        rank of the columns of B is constant. Raises `ValueError` with dissipation, and for a system whose ports are not all
        closed."""
        self._refuse_dissipation()
        if self.B is not None and self.closed is not True:
            raise ValueError("only a system whose ports are all closed has a Dirac structure: state it with closed=True.")
        return closed_structure(self)

    def _refuse_dissipation(self) -> None:
        if self.R is not None:
            raise ValueError(
                "with dissipation R the pairs (v, α) of a port-Hamiltonian system are no coisotropic set: state it without R, as "
                "a port of its own whose input is u = −R y."
            )

    def energy_form(self, shape: Shape) -> EnergyForm:
        return EnergyForm(self.hamiltonian, self.differential, self.relation, self.ports)

    def implicit_form(self, near: Any, params: Any) -> ImplicitForm:
        near, t = without_time(near)
        x = point_of(near, ("x",), self)
        n, m = self.sizes({"x": jnp.asarray(x)}, params)
        self.check({"x": jnp.asarray(x)}, params)

        def equations(t, x, params):
            dh = self.differential(x, params)
            closed = self.closed_matrix(x, params)
            right = self.flow_matrix(x, params) @ dh + self.open_matrix(x, params) @ self.input(t, x, params)
            matrix = jnp.block([[jnp.eye(n), -jnp.asarray(closed)], [jnp.zeros((m, n + m))]])
            return matrix, jnp.concatenate([right, closed.T @ dh])

        about = "closed ports: u keeps y = 0" if m else "no closed ports"
        energy = lambda t, x, params: self.energy_at({"x": x}, params)
        timed = uses_time(self.inputs, x, params)
        return in_time(timed, t, equations, x, names("x", n), names("u", m), energy, about)

    def sizes(self, data: Data, params: Any) -> tuple[int, int]:
        if "x" not in data:
            raise ValueError(f"a PortHamiltonian starts from x=, but {', '.join(data)} were given.")
        x = data["x"]
        size = x.shape[0]
        if self.hamiltonian.shape(x, params).shape != ():
            raise ValueError(f"hamiltonian must return a scalar, not shape {self.hamiltonian.shape(x, params).shape}.")
        for function in (self.J, self.R):
            if function is not None and function.shape(x, params).shape != (size, size):
                raise ValueError(
                    f"{function.name} must have shape ({size}, {size}) for x of shape ({size},), but its shape is "
                    f"{function.shape(x, params).shape}."
                )
        ports = 0
        if self.B is not None:
            shape = self.B.shape(x, params).shape
            if len(shape) != 2 or shape[0] != size:
                raise ValueError(f"B must have shape ({size}, m), one column a port, but its shape is {shape}.")
            ports = shape[1]
        closed, unclosed = self._split(ports)
        if any(not 0 <= port < ports for port in closed) or len(set(closed)) < len(closed):
            raise ValueError(f"closed must name different columns of B, which has {ports}, but {closed} were given.")
        if self.inputs is not None:
            shape = self.inputs.shape(np.zeros(()), x, params).shape
            if shape != (len(unclosed),):
                raise ValueError(
                    f"inputs must return shape ({len(unclosed)},), one number an open port, but it returned shape {shape}."
                )
        return size, len(closed)

    @property
    def premise_everywhere(self) -> bool:
        return True

    def premise(self, data: Data, params: Any) -> Premise:
        """J is skew, and R symmetric and positive semidefinite."""
        return Premise(self._matrices, self._refuse)

    def _matrices(self, data, params):
        """Those of J and R that depend on x, or may."""
        given = {"J": self.J, "R": self.R}
        return {name: f(data["x"], params) for name, f in given.items() if f is not None and not isinstance(f, ConstantFunction)}

    def _refuse(self, matrices):
        refuse_unless_skew(self.J, matrices.get("J"))
        if self.R is not None:
            refuse_unless_dissipative(self.R, matrices.get("R"))

    def complete(self, data: Data, params: Any, project: bool) -> Data:
        x = data["x"]
        velocity = self.flow_matrix(x, params) @ self.differential(x, params)
        if self.inputs is not None:
            velocity = velocity + self.open_matrix(x, params) @ self.input(data.get("t", 0.0), x, params)
        return {"x": x, "velocity": velocity}

    def initial_defect(self, data: Data, params: Any) -> Float[Numbers, " m"]:
        """y = Bᵀ dH of the closed ports: zero on M_0."""
        if not self.closed:
            return no_constraint()
        return self.closed_matrix(data["x"], params).T @ self.differential(data["x"], params)

    def sizes_of_data(self, data: Data, params: Any) -> Data:
        """Each coordinate as large as all of the energy makes it."""
        largest = jnp.abs(data["x"]) + as_large_as_energy(lambda x: self.differential(x, params), data["x"])
        return {name: jnp.abs(a) for name, a in data.items()} | {"x": largest}

    def energy_at(self, row: Data, params: Any) -> Float[Numbers, ""]:
        """H(x)."""
        return self.hamiltonian(row["x"], params)

    def constraint_at(self, row: Data, params: Any) -> Float[Numbers, " m"]:
        return self.initial_defect({"x": row["x"]}, params)

    @property
    def projected(self) -> str:
        return ""

    @property
    def energy_changes(self) -> str:
        return "does not conserve it" if self.R is not None or self.inputs is not None else ""

    def flow_size(self, x: Float[Numbers, " N"], params: Any) -> Float[Numbers, ""]:
        """|dH|ᵀ (|J − R| |dH| + 1), where 1 is the unit in which ẋ is solved."""
        dh = jnp.abs(self.differential(x, params))
        return dh @ (abs(self.flow_matrix(x, params)) @ dh + 1.0)


def _squared(R: Any, covector: Float[Numbers, " N"]) -> Float[Numbers, ""]:
    """⟨α, Rα⟩."""
    return covector @ (R @ covector) if isinstance(R, SparseMatrix) else covector @ R @ covector
