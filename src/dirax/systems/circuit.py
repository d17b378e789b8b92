"""Circuits from a list of their elements."""

from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from dirax.numerics.arrays import Data, Numbers
from dirax.numerics.tolerances import SOLVED_ROUNDOFF
from dirax.program.roots import FEWEST_SPARSE, nearest_root
from dirax.program.sparse_matrix import SparseMatrix
from dirax.program.user_functions import UserFunction
from dirax.systems.circuit_sources import refuse_contradictions
from dirax.systems.forms import RelationForm
from dirax.systems.implicit_system import ImplicitSystem
from dirax.systems.shape import Shape
from dirax.systems.system import AbstractSystem, refuse_start

GROUND = 0
Element = tuple[str, Any, Any, Any]
"""(kind, from, to, value): see `circuit`."""

KINDS = ("C", "L", "R", "V", "I", "T")
ELEMENT = "(C, L, R, V, I or T, node, other node, value)"
TRIED = np.concatenate([-np.geomspace(1e-9, 1.0, 40)[::-1], [0.0], np.geomspace(1e-9, 1.0, 40)])
"""Voltages at which a diode-like resistor is asked for its current."""


def circuit(netlist: Sequence[Element]) -> "ImplicitSystem | Circuit":
    """The system of a list of elements (kind, node, other node, value); node 0 is the ground.

    - ("C", a, b, capacitance) and ("L", a, b, inductance), more than 0;
    - ("R", a, b, resistance), more than 0, or ("R", a, b, current), a function of the voltage from a to b, such as a diode's:
      zero at zero, never of the other sign, and never smaller at a larger voltage;
    - ("V", a, b, voltage) of a at b, and ("I", a, b, current) from a through the source to b: numbers, or functions of
      the time t;
    - ("T", (a, b), (c, d), ratio): a transformer, u_ab = ratio · u_cd, without losses.

    x = (charges of the capacitors, fluxes of the inductors), in the order of the list; the potentials of the nodes in ascending
    order, then the currents of the voltage sources and of the transformers' first sides, are the multipliers (Kirchhoff's laws):

        A_C q̇ + A_L φ/L + A_R i(Aᵀ_R e) + A_I I + A_V i_V + (A_T − A'_T n) i_T = 0,
        φ̇ = Aᵀ_L e,   q/C = Aᵀ_C e,   V = Aᵀ_V e,   Aᵀ_T e = n A'ᵀ_T e.

    Loops of capacitors or voltage sources, and nodes with inductors or current sources alone, are found by the constraint
    algorithm where all elements are linear and constant, as an `ImplicitSystem`, in circuits of less than 128 nodes. In larger
    ones a step costs in proportion to the elements.

        rectifier = dx.circuit([("V", 1, 0, jnp.sin), ("R", 1, 2, lambda u: 1e-6 * jnp.expm1(20 * u)), ("C", 2, 0, 1.0),
                                ("R", 2, 0, 5.0)])

    Raises `ValueError` for unknown kinds, values that are not positive, resistors that give energy, parts that are not
    connected to the ground, and constant sources that contradict each other; `TypeError` for what is no number and no function
    of one number where it has to be one, and for nodes that are no whole numbers.
    """
    if not isinstance(netlist, list | tuple) or not netlist:
        raise TypeError(f"netlist must be a list of elements {ELEMENT}, but {netlist!r:.100} was given.")
    for element in netlist:
        _check(element)
    made = Circuit(netlist)
    return made.implicit() if made.is_linear and not made.is_large else made


class Circuit(AbstractSystem):
    """A circuit with diode-like resistors, sources that change in time, or very many nodes; made by `dx.circuit`."""

    netlist: tuple[Element, ...] = eqx.field(static=True)
    nodes: tuple[int, ...] = eqx.field(static=True)

    def __init__(self, netlist: Sequence[Element]):
        self.netlist = tuple(netlist)
        self.nodes = tuple(sorted({node for pair in _pairs(netlist) for node in pair} - {GROUND}))
        _refuse_islands(netlist, self.nodes)
        refuse_contradictions(netlist, GROUND)

    def elements(self, kind: str) -> list[Element]:
        """The elements of a kind, in the order of the list."""
        return [element for element in self.netlist if element[0] == kind]

    def values(self, kind: str) -> np.ndarray:
        """The values of a kind of elements that have numbers."""
        return np.array([element[3] for element in self.elements(kind)], dtype=float)

    def incidence(self, kind: str, side: int = 1) -> Any:
        """+1 where an element of the kind leaves a node and −1 where it arrives, (nodes, elements); of a transformer's first or
        second `side`. A `SparseMatrix` for very many nodes."""
        chosen = self.elements(kind)
        ends: list[Any] = [element[side] if kind == "T" else element[1:3] for element in chosen]
        number = {node: row for row, node in enumerate(self.nodes)}
        entries = [
            (number[node], column, sign)
            for column, pair in enumerate(ends)
            for node, sign in zip(pair, (1.0, -1.0), strict=True)
            if node != GROUND
        ]
        rows, columns, signs = (np.array(part) for part in zip(*entries, strict=True)) if entries else (np.zeros(0, int),) * 3
        shape = len(self.nodes), len(chosen)
        if self.is_large:
            return SparseMatrix((np.asarray(signs, float), (rows, columns)), shape)
        matrix = np.zeros(shape)
        matrix[rows, columns] = signs
        return matrix

    @property
    def transformers(self) -> Any:
        """A_T − A'_T n: the currents of the nodes by those of the first sides."""
        first, second = self.incidence("T"), self.incidence("T", 2)
        if not self.is_large:
            return first - second * self.values("T")
        return SparseMatrix(first.matrix - second.matrix.multiply(self.values("T")[None, :]))

    @property
    def is_large(self) -> bool:
        """Whether there are so many nodes that matrices of all of them are sparse ones."""
        return len(self.nodes) >= FEWEST_SPARSE

    @property
    def is_linear(self) -> bool:
        """Whether no element is stated as a function."""
        return not any(callable(element[3]) for element in self.netlist)

    def implicit(self) -> ImplicitSystem:
        """The same as E ẋ = f(x) + B u, of linear and constant elements."""
        values = {kind: self.values(kind) for kind in KINDS}
        c, l, r, v = (self.incidence(kind) for kind in "CLRV")
        i, t = self.incidence("I"), self.transformers
        nc, nl, nv, nt, n = c.shape[1], l.shape[1], v.shape[1], t.shape[1], len(self.nodes)
        E = np.zeros((n + nl + nc + nv + nt, nc + nl))
        E[:n, :nc], E[n : n + nl, nc:] = c, np.eye(nl)
        B = np.zeros((n + nl + nc + nv + nt, n + nv + nt))
        B[:n, :n], B[:n, n : n + nv], B[:n, n + nv :] = -r @ np.diag(1 / values["R"]) @ r.T, -v, -t
        B[n : n + nl, :n], B[n + nl : n + nl + nc, :n] = l.T, c.T
        B[n + nl + nc : n + nl + nc + nv, :n], B[n + nl + nc + nv :, :n] = v.T, t.T
        given = -i @ values["I"]

        def stated(x):
            self.refuse_length(x)
            return jnp.asarray(E)

        def f(x):
            current, voltage = x[nc:] / values["L"], x[:nc] / values["C"]
            nodes = -jnp.asarray(l) @ current
            nodes = nodes + given if i.shape[1] else nodes
            parts = [nodes, jnp.zeros(nl), -voltage, -jnp.asarray(values["V"])]
            return jnp.concatenate([*parts, jnp.zeros(nt)] if nt else parts)

        return ImplicitSystem(stated, f, lambda x: jnp.asarray(B), self.energy)

    def energy(self, x: Float[Numbers, " N"]) -> Float[Numbers, ""]:
        """That of the capacitors and inductors."""
        c, l = self.values("C"), self.values("L")
        return jnp.sum(x[: len(c)] ** 2 / c) / 2 + jnp.sum(x[len(c) :] ** 2 / l) / 2

    def currents(self, voltages: Float[Numbers, " r"]) -> Float[Numbers, " r"]:
        """The currents of the resistors at their voltages."""
        return _each(self.elements("R"), lambda value, i: value(voltages[i]), lambda values, i: voltages[i] / values)

    def source(self, kind: str, t: Any) -> Array:
        """The values of the sources at a time."""
        return _each(self.elements(kind), lambda value, _: value(t), lambda values, _: jnp.asarray(values))

    def relation(self, x: Array, velocity: Array, multipliers: Array, t: Any, params: Any = None) -> Float[Numbers, " r"]:
        """Kirchhoff's laws: currents of the nodes; voltages of the inductors, capacitors, sources, transformers."""
        array = (lambda matrix: matrix) if self.is_large else jnp.asarray
        c, l, r, v, i = (array(self.incidence(kind)) for kind in "CLRVI")
        sides = array(self.transformers)
        nc, n, nv = c.shape[1], len(self.nodes), v.shape[1]
        e, i_v, i_t = multipliers[:n], multipliers[n : n + nv], multipliers[n + nv :]
        nodes = c @ velocity[:nc] + l @ (x[nc:] / self.values("L")) + r @ self.currents(r.T @ e) + i @ self.source("I", t)
        nodes = nodes + v @ i_v + sides @ i_t
        voltages = velocity[nc:] - l.T @ e, x[:nc] / self.values("C") - c.T @ e, self.source("V", t) - v.T @ e, sides.T @ e
        return jnp.concatenate([nodes, *voltages])

    # ------------------------------------------------------------------ AbstractSystem

    def sizes(self, data: Data, params: Any) -> tuple[int, int]:
        refuse_start(self, data, "x")
        self.refuse_length(data["x"])
        return data["x"].shape[0], len(self.nodes) + len(self.elements("V")) + len(self.elements("T"))

    def refuse_length(self, x: Any) -> None:
        """Raise `ValueError` for data of another circuit."""
        expected = len(self.elements("C")) + len(self.elements("L"))
        if x.shape[0] != expected:
            raise ValueError(f"x are the charges and then the fluxes of the circuit, {expected} numbers, not {x.shape[0]}.")

    def relation_form(self, shape: Shape) -> RelationForm:
        currents = [f"current of {kind} {i}" for kind in "VT" for i in range(len(self.elements(kind)))]
        labels = (*(f"potential of node {node}" for node in self.nodes), *currents)
        return RelationForm(self.relation, shape.m, labels, shape.m, axis="closed_port")

    def complete(self, data: Data, params: Any, project: bool) -> Data:
        x, t, n = data["x"], data.get("t", 0.0), data["x"].shape[0]
        m = len(self.nodes) + len(self.elements("V")) + len(self.elements("T"))
        laws = lambda z: self.relation(x, z[:n], z[n:], t, params)
        found = nearest_root(laws, jnp.zeros(n + m))
        return {"x": x, "velocity": found[:n], "potentials": found[n:]}

    def initial_defect(self, data: Data, params: Any) -> Float[Numbers, " r"]:
        """What is left of the laws where no currents and potentials satisfy them."""
        return self.relation(data["x"], data["velocity"], data["potentials"], data.get("t", 0.0), params)

    def sizes_of_data(self, data: Data, params: Any) -> Data:
        """Currents and voltages that are zero up to roundoff of the others."""
        c, n = len(self.elements("C")), len(self.nodes)
        rates, rest = data["velocity"], data["potentials"]
        largest = lambda *parts: jnp.max(jnp.abs(jnp.concatenate(parts)), initial=0.0)
        current, voltage = (SOLVED_ROUNDOFF * largest(*pair) for pair in ((rates[:c], rest[n:]), (rates[c:], rest[:n])))
        of = lambda a, first, second: jnp.concatenate([jnp.abs(a[0]) + first, jnp.abs(a[1]) + second])
        sizes = {name: jnp.abs(a) for name, a in data.items()}
        velocity = of((rates[:c], rates[c:]), current, voltage)
        return sizes | {"velocity": velocity, "potentials": of((rest[:n], rest[n:]), voltage, current)}

    def energy_at(self, row: Data, params: Any) -> Float[Numbers, ""]:
        return self.energy(row["x"])

    def constraint_at(self, row: Data, params: Any) -> Float[Numbers, " r"]:
        now = {"x": row["x"], "t": jnp.asarray(row.get("t", 0.0))}
        return self.initial_defect(self.complete(now, params, False) | now, params)

    @property
    def projected(self) -> str:
        return ""

    @property
    def energy_changes(self) -> str:
        sources = bool(self.elements("V") or self.elements("I"))
        parts = ["has sources"] * sources + ["has resistors"] * bool(self.elements("R"))
        return " and ".join(parts) and f"{' and '.join(parts)} that change its energy"


def _check(element: Any) -> None:
    given = f"{element!r:.100} was given"
    if not isinstance(element, tuple | list) or len(element) != 4 or not isinstance(element[0], str) or element[0] not in KINDS:
        raise ValueError(f"an element is {ELEMENT}, but {given}.")
    kind, start, end, value = element
    sides = (start, end) if kind == "T" else ((start, end),)
    if not all(isinstance(ends, tuple | list) and len(ends) == 2 for ends in sides):
        raise ValueError(f"a transformer is (T, (a, b), (c, d), ratio), but {given}.")
    if not all(isinstance(node, int | np.integer) and not isinstance(node, bool) for ends in sides for node in ends):
        raise TypeError(f"nodes are whole numbers, {GROUND} that of the ground, but {given}.")
    if any(a == b for a, b in sides):
        raise ValueError(f"an element is {ELEMENT} between two nodes, but {given}.")
    if callable(value):
        if kind not in "RVI":
            raise TypeError(f"only R, V and I may be functions, of the voltage and of the time, but {given}.")
        _check_function(value, "voltage" if kind == "V" else "current", "u" if kind == "R" else "t", given)
        if kind == "R":
            _check_current(value, given)
        return
    if isinstance(value, bool) or not isinstance(value, int | float | np.number) or not np.isfinite(value):
        raise TypeError(f"the value of an element must be a finite number, or a function for R, V and I, but {given}.")
    if kind in "CLR" and not value > 0:
        raise ValueError(f"an element is (C, L, R, V, I or T, node, other node, value > 0), but {given}.")
    if kind == "T" and value == 0:
        raise ValueError(f"the ratio of a transformer is not zero, but {given}.")


def _check_function(value: Callable, name: str, argument: str, given: str) -> None:
    """Refuse what is no function of one number, with a number for result, that JAX can trace."""
    try:
        function = UserFunction(value, name, (argument,))
        if function.takes_params:
            raise TypeError(f"{name} must be a function {name}({argument}), without params.")
        if shape := function.shape(np.float64(0.0), None).shape:
            raise TypeError(f"{name}({argument}) must return one number, but it returned shape {shape}.")
    except (TypeError, ValueError) as error:
        raise TypeError(f"{str(error).rstrip('.')}; {given}.") from error


def _check_current(current: Callable, given: str) -> None:
    """Refuse a resistor that gives energy, or has a falling current."""
    found = np.array([float(current(u)) for u in TRIED])
    wrong = ~np.isfinite(found) | (np.sign(found) * TRIED < 0) | ((TRIED == 0) & (found != 0))
    if np.any(wrong):
        at = TRIED[int(np.argmax(wrong))]
        raise ValueError(
            f"the current of a diode-like resistor is zero at zero and has the sign of its voltage, but at {at:.3g} it is "
            f"{found[int(np.argmax(wrong))]:.3g}: {given}."
        )
    if np.any(np.diff(found) < 0):
        raise ValueError(f"the current of a diode-like resistor never falls with its voltage, but here it does: {given}.")


def _pairs(netlist: Sequence[Element]) -> list[tuple[int, int]]:
    """The nodes that elements are between."""
    return [tuple(ends) for kind, *nodes, _ in netlist for ends in (nodes if kind == "T" else [nodes])]


def _each(elements: Sequence[Element], of_function: Callable, of_numbers: Callable) -> Array:
    """A number of each element: by its function, or those with numbers at once; both are given places in the list too."""
    functions = [i for i, element in enumerate(elements) if callable(element[3])]
    numbers = np.array([i for i, element in enumerate(elements) if not callable(element[3])], int)
    found: list[Any] = [jnp.asarray(of_function(elements[i][3], i), float) for i in functions]
    parts = [jnp.stack(found)] if found else []
    parts += [of_numbers(np.array([elements[i][3] for i in numbers], float), numbers)] if len(numbers) else []
    if not parts:
        return jnp.zeros(0)
    return jnp.concatenate(parts)[np.argsort([*functions, *numbers])] if len(parts) > 1 else parts[0]


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
