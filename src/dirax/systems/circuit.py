"""Circuits from a list of their elements."""

from collections.abc import Callable, Sequence
from copy import copy
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from dirax.numerics.arrays import Data, Numbers
from dirax.numerics.sparse import FEWEST_SPARSE
from dirax.numerics.tolerances import SOLVED_ROUNDOFF
from dirax.program.roots import nearest_root
from dirax.program.sparse_matrix import SparseMatrix
from dirax.program.user_functions import UserFunction
from dirax.systems.circuit_elements import (
    ELEMENT,
    GROUND,
    TRIED,
    Element,
    check_result,
    check_values,
    checked,
    function_of,
)
from dirax.systems.circuit_sources import refuse_contradictions
from dirax.systems.forms import RelationForm
from dirax.systems.implicit_system import ImplicitSystem
from dirax.systems.premise import Premise
from dirax.systems.shape import Shape
from dirax.systems.system import AbstractSystem, refuse_start

POTENTIAL = "potential of node "
"""How the label of a node's equation begins."""


def circuit(netlist: Sequence[Element]) -> "ImplicitSystem | Circuit":
    """The system of a list of elements (kind, node, other node, value); node 0 is the ground.

    - ("C", a, b, capacitance) and ("L", a, b, inductance), more than 0;
    - ("R", a, b, resistance), more than 0, or ("R", a, b, current), a function of the voltage u from a to b, such as a diode's:
      zero at zero, never of the other sign, and never smaller at a larger voltage;
    - ("V", a, b, voltage) of a at b, and ("I", a, b, current) from a through the source to b: numbers, or functions of
      the time t;
    - ("T", (a, b), (c, d), ratio): a transformer, u_ab = ratio · u_cd, without losses.

    A value but that of T may also be the name of one of the params, or a function `lambda params: …`; functions of u and of t may
    take params after it.

    x = (charges of the capacitors, fluxes of the inductors), in the order of the list; the potentials of the nodes in ascending
    order, then the currents of the voltage sources and of the transformers' first sides, are the multipliers (Kirchhoff's laws):

        A_C q̇ + A_L φ/L + A_R i(Aᵀ_R e) + A_I I + A_V i_V + (A_T − A'_T n) i_T = 0,
        φ̇ = Aᵀ_L e,   q/C = Aᵀ_C e,   V = Aᵀ_V e,   Aᵀ_T e = n A'ᵀ_T e.

    Loops of capacitors or voltage sources, and nodes with inductors or current sources alone, are found by the constraint
    algorithm where resistors are linear; where all values are numbers, in circuits of less than 128 nodes, as those of an
    `ImplicitSystem`. In larger ones a step costs in proportion to the elements.

        rectifier = dx.circuit([("V", 1, 0, jnp.sin), ("R", 1, 2, lambda u: 1e-6 * jnp.expm1(20 * u)), ("C", 2, 0, 1.0),
                                ("R", 2, 0, "load")])
        sol = dx.simulate(rectifier, dx.DiscreteDirac(), x=[0.0], step=0.02, steps=3000, params={"load": 5.0})

    Raises `ValueError` for unknown kinds, values that are not positive, resistors that give energy, parts that are not
    connected to the ground, a circuit without C and L, and constant sources that contradict each other; `TypeError` for what is
    no number and no function of one number where it has to be one, and for nodes that are no whole numbers.
    """
    if not isinstance(netlist, list | tuple) or not netlist:
        raise TypeError(f"netlist must be a list of elements {ELEMENT}, but {netlist!r:.100} was given.")
    netlist = [checked(element) for element in netlist]
    if not any(element[0] in "CL" for element in netlist):
        raise ValueError(
            "the circuit has no capacitor and no inductor, and so no state that could move: its currents follow from its sources "
            "at every moment."
        )
    made = Circuit(netlist)
    return made.implicit() if made.is_linear and not made.is_large else made


class Circuit(AbstractSystem):
    """A circuit with values that are functions or of params, or with very many nodes; made by `dx.circuit`."""

    netlist: tuple[Element, ...] = eqx.field(static=True)
    functions: tuple[UserFunction | None, ...]
    """The values of the elements that are no numbers."""
    nodes: tuple[int, ...] = eqx.field(static=True)

    def __init__(self, netlist: Sequence[Element]):
        hashable = lambda ends: tuple(ends) if isinstance(ends, list) else ends
        self.functions = tuple(map(function_of, netlist))
        stated = [f.function if callable(e[3]) and f is not None else e[3] for e, f in zip(netlist, self.functions, strict=True)]
        self.netlist = tuple((e[0], hashable(e[1]), hashable(e[2]), value) for e, value in zip(netlist, stated, strict=True))
        self.nodes = tuple(sorted({node for pair in _pairs(netlist) for node in pair} - {GROUND}))
        _refuse_islands(netlist, self.nodes)
        refuse_contradictions([(*e[:3], f or e[3]) for e, f in zip(self.netlist, self.functions, strict=True)], GROUND)

    def hoisted(self, values: list[Tracer]) -> "Circuit":
        """The same of params that hold what its functions close over and JAX traces, which is added to `values`."""
        other = copy(self)
        functions = tuple(f and f.hoisted(values) for f in self.functions)
        stated = ((*e[:3], f.function if f and callable(e[3]) else e[3]) for e, f in zip(self.netlist, functions, strict=True))
        vars(other).update(functions=functions, netlist=tuple(stated))
        return other

    def elements(self, kind: str) -> list[Element]:
        """The elements of a kind, in the order of the list."""
        return [element for element in self.netlist if element[0] == kind]

    def count(self, kinds: str) -> int:
        """How many elements of these kinds there are."""
        return sum(element[0] in kinds for element in self.netlist)

    def values(self, kind: str, params: Any = None) -> Any:
        """The numbers that a kind of elements has, or has at these params."""
        return self._each(kind, lambda value, _: value(params), lambda values, _: values)

    def incidence(self, kind: str, side: int = 1) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Nodes, elements of the kind, and +1 where an element leaves a node, −1 where it arrives; of a transformer's first or
        second `side`."""
        ends: list[Any] = [element[side] if kind == "T" else element[1:3] for element in self.elements(kind)]
        number = {node: row for row, node in enumerate(self.nodes)}
        entries = [
            (number[node], column, sign)
            for column, pair in enumerate(ends)
            for node, sign in zip(pair, (1.0, -1.0), strict=True)
            if node != GROUND
        ]
        rows, columns, signs = zip(*entries, strict=True) if entries else ((), (), ())
        return np.array(rows, int), np.array(columns, int), np.array(signs, float)

    @property
    def resistors(self) -> Any:
        """A_Rᵀ, (resistors, nodes): their voltages by the potentials."""
        nodes, elements, signs = self.incidence("R")
        return self._matrix(elements, nodes, signs, (self.count("R"), len(self.nodes)))

    @property
    def laws(self) -> Any:
        """The matrix of Kirchhoff's laws: by rows the currents of the nodes, and the voltages of L, C, V and T; by columns the
        currents of C, L, R, I, V and T, the voltages of L, C and V, and the potentials."""
        row, column, entries = len(self.nodes), 0, []
        potentials = self.count("CLRIVT") + self.count("LCV")
        across: dict[str, Any] = {}
        for kind in "CLRIVT":
            nodes, elements, signs = self.incidence(kind)
            if kind == "T":  # A_T − A'_T n
                others, seconds, back = self.incidence("T", 2)
                nodes, elements = np.concatenate([nodes, others]), np.concatenate([elements, seconds])
                signs = np.concatenate([signs, -back * self.values("T")[seconds]])
            across[kind] = nodes, elements, signs
            entries.append((nodes, column + elements, signs))
            column += self.count(kind)
        for kind in "LCVT":
            nodes, elements, signs = across[kind]
            entries.append((row + elements, potentials + nodes, -signs))
            if kind != "T":
                own = np.arange(self.count(kind))
                entries.append((row + own, column + own, np.ones(len(own))))
                column += len(own)
            row += self.count(kind)
        rows, columns, values = map(np.concatenate, zip(*entries, strict=True))
        return self._matrix(rows, columns, values, (row, potentials + len(self.nodes)))

    def _matrix(self, rows: np.ndarray, columns: np.ndarray, entries: np.ndarray, shape: tuple[int, int]) -> Any:
        """A matrix by its entries, of which those at one place add up; a `SparseMatrix` for very many nodes."""
        if self.is_large:
            return SparseMatrix((entries, (rows, columns)), shape)
        matrix = np.zeros(shape)
        np.add.at(matrix, (rows, columns), entries)
        return matrix

    @property
    def is_large(self) -> bool:
        """Whether there are so many nodes that matrices of all of them are sparse ones."""
        return len(self.nodes) >= FEWEST_SPARSE

    @property
    def is_linear(self) -> bool:
        """Whether all elements are stated as numbers."""
        return not any(self.functions)

    def implicit(self) -> ImplicitSystem:
        """The same as E ẋ = f(x) + B u, of linear and constant elements."""
        nc, nl, nv = map(self.count, "CLV")
        ends = np.cumsum([nc, nl, self.count("R"), self.count("I"), nv + self.count("T"), nl, nc, nv])
        c, l, r, i, branches, fluxes, charges, v, potentials = np.split(self.laws, ends, axis=1)
        E = np.concatenate([c, fluxes], axis=1)
        B = -np.concatenate([potentials + r @ (self.resistors / self.values("R")[:, None]), branches], axis=1)
        of_x = -np.concatenate([charges / self.values("C"), l / self.values("L")], axis=1)
        given = -(i @ self.values("I") + v @ self.values("V"))

        def stated(x):
            self.refuse_length(x)
            return jnp.asarray(E)

        return ImplicitSystem(stated, lambda x: of_x @ x + given, lambda x: jnp.asarray(B), self.energy)

    def energy(self, x: Float[Numbers, " N"], params: Any = None) -> Float[Numbers, ""]:
        """That of the capacitors and inductors."""
        c, l = self.values("C", params), self.values("L", params)
        return jnp.sum(x[: len(c)] ** 2 / c) / 2 + jnp.sum(x[len(c) :] ** 2 / l) / 2

    def currents(self, voltages: Float[Numbers, " r"], params: Any = None) -> Float[Numbers, " r"]:
        """The currents of the resistors at their voltages."""
        of_one = lambda value, i: value(voltages[i], params) if value.arguments else voltages[i] / value(params)
        return self._each("R", of_one, lambda values, i: voltages[i] / values)

    def source(self, kind: str, t: Any, params: Any = None) -> Any:
        """The values of the sources at a time."""
        of_one = lambda value, _: value(t, params) if value.arguments else value(params)
        return self._each(kind, of_one, lambda values, _: values)

    def _each(self, kind: str, of_function: Callable, of_numbers: Callable) -> Any:
        """A number of each element of a kind, in their order: by its function, or those with numbers at once."""
        own = [f or e[3] for e, f in zip(self.netlist, self.functions, strict=True) if e[0] == kind]
        functions = [i for i, value in enumerate(own) if callable(value)]
        if not functions:
            return of_numbers(np.array(own, float), slice(None))
        parts: list[Any] = [jnp.stack([jnp.asarray(of_function(own[i], i), float) for i in functions])]
        numbers = np.setdiff1d(np.arange(len(own)), functions)
        if len(numbers):
            parts.append(of_numbers(np.array([own[i] for i in numbers], float), numbers))
        return jnp.concatenate(parts)[np.argsort([*functions, *numbers])] if len(numbers) else parts[0]

    def relation(self, x: Array, velocity: Array, multipliers: Array, t: Any, params: Any = None) -> Float[Numbers, " r"]:
        """Kirchhoff's laws: currents of the nodes; voltages of the inductors, capacitors, sources, transformers."""
        c, n = self.count("C"), len(self.nodes)
        e, branches = multipliers[:n], multipliers[n:]
        inductors, resistors = x[c:] / self.values("L", params), self.currents(self.resistors @ e, params)
        currents = velocity[:c], inductors, resistors, self.source("I", t, params), branches
        voltages = velocity[c:], x[:c] / self.values("C", params), self.source("V", t, params)
        return self.laws @ jnp.concatenate([*currents, *voltages, e])

    # ------------------------------------------------------------------ AbstractSystem

    def sizes(self, data: Data, params: Any) -> tuple[int, int]:
        refuse_start(self, data, "x")
        self.refuse_length(data["x"])
        for element, function in zip(self.netlist, self.functions, strict=True):
            if function is not None and function.takes_params:
                check_result(element, function, params)
        return data["x"].shape[0], len(self.nodes) + self.count("VT")

    def refuse_length(self, x: Any) -> None:
        """Raise `ValueError` for data of another circuit."""
        expected = self.count("CL")
        if x.shape[0] != expected:
            raise ValueError(f"x are the charges and then the fluxes of the circuit, {expected} numbers, not {x.shape[0]}.")

    def premise(self, data: Data, params: Any) -> Premise | None:
        """What is stated of elements that are numbers holds at these params."""
        return Premise(self._of_params, self._refuse) if self._asked else None

    @property
    def _asked(self) -> list[tuple[Element, UserFunction]]:
        pairs = zip(self.netlist, self.functions, strict=True)
        return [(e, f) for e, f in pairs if f is not None and f.takes_params and e[0] in "CLR"]

    def _of_params(self, data: Data, params: Any) -> list[Any]:
        at_all = lambda function: jax.vmap(lambda u: function(u, params))(jnp.asarray(TRIED))
        return [at_all(function) if function.arguments else function(params) for _, function in self._asked]

    def _refuse(self, found: list[Any]) -> None:
        for (element, _), values in zip(self._asked, found, strict=True):
            check_values(element, values)

    def relation_form(self, shape: Shape) -> RelationForm:
        currents = [f"current of {kind} {i}" for kind in "VT" for i in range(self.count(kind))]
        labels = (*(f"{POTENTIAL}{node}" for node in self.nodes), *currents)
        return RelationForm(self.relation, shape.m, labels, shape.m, axis="closed_port")

    def complete(self, data: Data, params: Any, project: bool) -> Data:
        x, t, n = data["x"], data.get("t", 0.0), data["x"].shape[0]
        left = lambda z: self.relation(x, z[:n], z[n:], t, params)
        found = nearest_root(left, jnp.zeros(n + len(self.nodes) + self.count("VT")))
        return {"x": x, "velocity": found[:n], "potentials": found[n:]}

    def initial_defect(self, data: Data, params: Any) -> Float[Numbers, " r"]:
        """What is left of the laws where no currents and potentials satisfy them."""
        return self.relation(data["x"], data["velocity"], data["potentials"], data.get("t", 0.0), params)

    def sizes_of_data(self, data: Data, params: Any) -> Data:
        """Currents and voltages that are zero up to roundoff of the others."""
        c, n = self.count("C"), len(self.nodes)
        rates, rest = data["velocity"], data["potentials"]
        largest = lambda *parts: jnp.max(jnp.abs(jnp.concatenate(parts)), initial=0.0)
        current, voltage = (SOLVED_ROUNDOFF * largest(*pair) for pair in ((rates[:c], rest[n:]), (rates[c:], rest[:n])))
        of = lambda a, first, second: jnp.concatenate([jnp.abs(a[0]) + first, jnp.abs(a[1]) + second])
        sizes = {name: jnp.abs(a) for name, a in data.items()}
        velocity = of((rates[:c], rates[c:]), current, voltage)
        return sizes | {"velocity": velocity, "potentials": of((rest[:n], rest[n:]), voltage, current)}

    def energy_at(self, row: Data, params: Any) -> Float[Numbers, ""]:
        return self.energy(row["x"], params)

    def constraint_at(self, row: Data, params: Any) -> Float[Numbers, " r"]:
        now = {"x": row["x"], "t": jnp.asarray(row.get("t", 0.0))}
        return self.initial_defect(self.complete(now, params, False) | now, params)

    @property
    def projected(self) -> str:
        return ""

    @property
    def energy_changes(self) -> str:
        parts = ["has sources"] * bool(self.count("VI")) + ["has resistors"] * bool(self.count("R"))
        return " and ".join(parts) and f"{' and '.join(parts)} that change its energy"


def _pairs(netlist: Sequence[Element]) -> list[tuple[int, int]]:
    """The nodes that elements are between."""
    return [tuple(ends) for kind, *nodes, _ in netlist for ends in (nodes if kind == "T" else [nodes])]


def _refuse_islands(netlist: Sequence[Element], nodes: Sequence[int]) -> None:
    beside: dict[int, list[int]] = {node: [] for node in (GROUND, *nodes)}
    for start, end in _pairs(netlist):
        beside[start].append(end)
        beside[end].append(start)
    reached, new = {GROUND}, [GROUND]
    while new:
        more = [node for node in beside[new.pop()] if node not in reached]
        reached.update(more)
        new += more
    if set(nodes) - reached:
        raise ValueError(
            f"the nodes {sorted(set(nodes) - reached)} are not connected to the ground, node {GROUND}; a transformer does not "
            "connect its sides."
        )
