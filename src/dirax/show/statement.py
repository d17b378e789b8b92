"""The system as its user stated it: formulas where the trace is short, the source of every function, the parameters."""

import dataclasses
import inspect
import textwrap
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np

from dirax.geometry.semidirect import SemidirectProduct
from dirax.program.user_functions import UserFunction
from dirax.show.formula import formulas
from dirax.show.letters import Written, joined, of_params, symbol, symbols
from dirax.show.series import coordinate_names
from dirax.solution.solution import Solution

MATRICES = {"J": "J", "R": "R", "B": "B", "metric": "g"}


@dataclass(frozen=True)
class Equation:
    """left = right, each side in pieces between which a line can break."""

    left: tuple[Written, ...]
    right: tuple[Written, ...]


def equations(sol: Solution) -> list[Equation]:
    """Lagrangian or Hamiltonian, then constraints and forces, as far as they have short formulas."""
    if sol.system is None:
        return []
    writer = _Formulas(sol)
    system, found = sol.system, []
    if lagrangian := writer.scalar("L", _lagrangian(system), ("t", "q", "v")):
        found.append(lagrangian)
    elif hamiltonian := writer.scalar("H", _stated(system, "hamiltonian"), _arguments(system, "hamiltonian")):
        found.append(hamiltonian)
    rows = _constraint_rows(system)
    if rows is not None:
        found += writer.vanishing(rows, ("t", "q", "v"))
    if (holonomic := _stated(system, "holonomic")) is not None:
        found += writer.vanishing(holonomic, _arguments(system, "holonomic"))
    if (forces := _stated(system, "forces")) is not None:
        found += writer.entries("F", forces, ("t", "q", "v"))
    for name, letter in MATRICES.items():
        if name != "metric" and (function := _stated(system, name)) is not None:
            found += writer.matrix(letter, function, _arguments(system, name))
    return found


def sources(system: Any) -> list[tuple[str, str]]:
    """(name, source text) of every function that the user gave, as far as it can be read."""
    if system is None:
        return []
    found = []
    for field in dataclasses.fields(system):
        value = getattr(system, field.name)
        if isinstance(value, UserFunction) and (text := _source(value.function)):
            found.append((field.name, text))
    return list({text: (name, text) for name, text in found}.values())


def _source(function: Any) -> str | None:
    function = getattr(function, "func", function)
    try:
        text = inspect.getsource(inspect.unwrap(function))
    except (OSError, TypeError):
        return None
    return textwrap.dedent(text).strip() if len(text) < 6000 else None


def parameters(params: Any) -> list[tuple[str, str]]:
    """(name, value) of the parameters."""
    found = []
    for path, leaf in jax.tree_util.tree_flatten_with_path(params)[0]:
        name = "_".join(str(getattr(key, "key", getattr(key, "name", getattr(key, "idx", key)))) for key in path) or "params"
        array = np.asarray(leaf)
        small = array.size <= 12
        text = str(array.tolist()).replace("[", "(").replace("]", ")") if small else f"array of shape {array.shape}"
        found.append((name, text))
    return found


def initial_values(sol: Solution) -> list[tuple[str, str]]:
    """(name, numbers) of the first saved row, of the first trajectory of a batch."""
    found = []
    for name in ("q", "p", "x"):
        if name in sol.fields:
            values = np.asarray(sol.fields[name])
            row = values[0] if sol.batch is None else values[0, 0]
            if row.size <= 16:
                found.append((name, "(" + ", ".join(f"{x:.6g}" for x in row.ravel()) + ")"))
    return found


def _stated(system: Any, name: str) -> Callable | None:
    """A function of the user as one of its arguments and params."""
    value = getattr(system, name, None)
    return value if isinstance(value, UserFunction) else None


def _arguments(system: Any, name: str) -> tuple[str, ...]:
    value = getattr(system, name, None)
    return value.arguments if isinstance(value, UserFunction) else ()


def _lagrangian(system: Any) -> Callable | None:
    value = getattr(system, "lagrangian", None)
    if isinstance(value, UserFunction):
        return value.at if value.arguments[-2:] == ("q", "v") else None
    return None if value is None else lambda t, q, v, params: value(q, v, params)


def _constraint_rows(system: Any) -> Callable | None:
    """W(q) v + b(q), as a function of (t, q, v, params)."""
    forms, affine = _stated(system, "one_forms"), _stated(system, "affine")
    if not isinstance(forms, UserFunction) or forms.arguments[-1:] != ("q",):
        return None
    if not isinstance(affine, UserFunction):
        return lambda t, q, v, params: forms.at(t, q, params) @ v
    return lambda t, q, v, params: forms.at(t, q, params) @ v + affine.at(t, q, params)


class _Formulas:
    """Formulas of functions of a solution's variables, by the names of their arguments."""

    def __init__(self, sol: Solution):
        self.params = sol.params_of_one
        self.known: dict[str, tuple[Any, Any]] = {"t": (np.zeros(()), symbols(["t"]).reshape(()))}
        for name, letter in (("q", "q"), ("x", "x")):
            if name in sol.fields:
                values = np.asarray(sol.fields[name])
                row = values[0] if sol.batch is None else values[0, 0]
                if row.ndim == 1:
                    names = coordinate_names(sol, len(row), letter)
                    self.known[name] = (row, symbols(names))
                    if name == "q":
                        self.known["v"] = (row, symbols(names, dotted=True))
        space = getattr(sol.system, "space", None)
        if "x" in self.known and isinstance(space, SemidirectProduct):
            moved, advected = zip(*map(space.split, self.known["x"]), strict=True)
            self.known |= {"mu": moved, "a": advected}

    def of(self, function: Callable | None, arguments: Sequence[str]) -> list[list[Written]] | None:
        if function is None or any(name not in self.known for name in arguments):
            return None
        values = [self.known[name][0] for name in arguments]
        names = [self.known[name][1] for name in arguments]
        return formulas(function, [*values, self.params], [*names, of_params(self.params)])

    def scalar(self, left: str, function: Callable | None, arguments: Sequence[str]) -> Equation | None:
        found = self.of(function, arguments)
        return Equation((symbol(left),), tuple(found[0])) if found and len(found) == 1 else None

    def entries(self, left: str, function: Callable, arguments: Sequence[str]) -> list[Equation]:
        found = self.of(function, arguments) or []
        names = self.known["q"][1] if "q" in self.known else []
        if len(found) != len(names):
            return []
        labels = [f"{left}_{name.text}" for name in names]
        return [
            Equation((symbol(label),), tuple(terms)) for label, terms in zip(labels, found, strict=True) if terms[0].text != "0"
        ]

    def vanishing(self, function: Callable, arguments: Sequence[str]) -> list[Equation]:
        """left = 0 for every entry."""
        found = self.of(function, arguments) or []
        zero = Written("0", "<mn>0</mn>")
        return [Equation(tuple(terms), (zero,)) for terms in found[:8]]

    def matrix(self, left: str, function: Callable, arguments: Sequence[str]) -> list[Equation]:
        found = self.of(function, arguments)
        size = round(len(found) ** 0.5) if found else 0
        if not found or len(found) > 16 or (left != "B" and size * size != len(found)):
            return []
        columns = size if left != "B" else max(1, len(found) // len(self.known["x"][0]))
        whole = [joined(terms) for terms in found]
        rows = [whole[i : i + columns] for i in range(0, len(whole), columns)]
        table = "".join("<mtr>" + "".join(f"<mtd>{w.mathml}</mtd>" for w in row) + "</mtr>" for row in rows)
        text = "; ".join(", ".join(w.text for w in row) for row in rows)
        return [Equation((symbol(left),), (Written(f"[{text}]", f"<mo>(</mo><mtable>{table}</mtable><mo>)</mo>"),))]
