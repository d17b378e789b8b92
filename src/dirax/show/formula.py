"""Functions of the user as formulas: their trace as sums and products, typeset in MathML, or None where it is too long."""

import math
from collections.abc import Callable, Sequence
from fractions import Fraction
from typing import Any

import jax
import numpy as np

from dirax.program.graph import Graph, GraphTooLarge
from dirax.program.interpreter import Interpreter, Unavailable
from dirax.show.letters import SPACE, Written, alone, beside, joined, number_of, raised_text, signed, texts

LONGEST = 420
"""Most characters of a formula as text; a longer one is shown as its source."""

NODES = 4000

WIDE = 29
"""Most letters of a term that is kept on one line; a line may break inside the parentheses of a longer one."""

FUNCTIONS = {
    **{name: name for name in ("sin", "cos", "tan", "sinh", "cosh", "tanh", "exp", "log", "erf", "max", "min", "sign")},
    **{"asin": "arcsin", "acos": "arccos", "atan": "arctan", "atan2": "arctan2", "asinh": "arsinh", "expm1": "expm1"},
    "log1p": "log1p",
}


class NotReadable(Exception):
    """A trace that has no short formula."""


def formulas(function: Callable, values: Sequence[Any], names: Sequence[Any]) -> list["list[Written]"] | None:
    """Every entry of function(*values), raveled, as the list of its pieces, between which a line can break, with the symbols
    `names` for the entries of the values (arrays of Written, in trees alike; the last value are the parameters); None where it
    is not readable."""
    leaves, structure = jax.tree.flatten(tuple(values))
    marks = jax.tree.leaves(tuple(names), is_leaf=lambda x: isinstance(x, np.ndarray))
    try:
        flat = lambda *leaves: function(*jax.tree.unflatten(structure, leaves))
        closed = jax.make_jaxpr(flat)(*(np.asarray(leaf, float) for leaf in leaves))
        graph, table, operands = Graph(NODES), {}, []
        for mark in marks:
            nodes = np.zeros(np.shape(mark), dtype=np.int64)
            for at in np.ndindex(nodes.shape):
                nodes[at] = graph.input(f"s{len(table)}")
                table[int(nodes[at])] = (len(table), mark[at])
            operands.append(nodes)
        (result,) = Interpreter(graph).run(closed, *operands)
    except (GraphTooLarge, ValueError, TypeError):
        return None
    if isinstance(result, Unavailable):
        return None
    parameters = sum(np.size(mark) for mark in marks) - sum(np.size(name) for name in names[:-1])
    writer = _Writer(graph, table, parameters)
    try:
        return [writer.pieces(int(node)) for node in np.ravel(result)]
    except (NotReadable, RecursionError):
        return None


class _Writer:
    """Writes nodes of a graph; `table`: input node → (its number, symbol)."""

    def __init__(self, graph: Graph, table: dict[int, tuple[int, Written]], parameters: int):
        self.graph, self.table = graph, table
        self.first_parameter = len(table) - parameters
        self.known: dict[int, Written] = {}

    def terms(self, node: int) -> list[Written]:
        """The terms of a sum, each with its sign, positive ones first."""
        parts = self._parts(node)
        written = [signed(k, factor, self._fraction(abs(factor), powers)) for k, (factor, powers) in enumerate(parts)]
        if sum(len(part.text) for part in written) > LONGEST:
            raise NotReadable
        return written

    def pieces(self, node: int) -> list[Written]:
        """The same, with long terms in pieces."""
        self.terms(node)  # of a length that can be read
        found = []
        for k, (factor, powers) in enumerate(self._parts(node)):
            first, *rest = self._broken(abs(factor), powers)
            found += [signed(k, factor, first), *rest]
        return found

    def _parts(self, node: int) -> list[tuple[float, tuple[tuple[int, int], ...]]]:
        """The terms of a sum as numbers and powers."""
        like: dict[tuple, float] = {}
        for sign, one in self._summands(node, 1.0):
            factor, powers = self._product(sign, one)
            like[powers] = like.get(powers, 0.0) + factor
        parts = [(factor, powers) for powers, factor in like.items() if factor] or [(0.0, ())]
        return sorted(parts, key=lambda part: (part[0] < 0, self._place(part[1])))

    def _broken(self, factor: float, powers: tuple[tuple[int, int], ...]) -> list[Written]:
        """A product in pieces: a long one parted inside the longest parentheses that it has above the line."""
        whole = self._fraction(factor, powers)
        fences = {(node, n): fence for node, n in powers if n > 0 and (fence := self._fence(node, n)) is not None}
        if len(whole.text.replace("\u0307", "")) <= WIDE or not fences:
            return [whole]
        longest = max(fences, key=lambda power: len(self._power(*power).text))
        opening, inside, closing = fences[longest]
        rest = tuple(power for power in powers if power != longest)
        first, *others = [piece for argument in inside for piece in self.pieces(argument)]
        pieces = [joined([opening, first]), *others]
        pieces[-1] = joined([pieces[-1], closing])
        if factor == 1 and not rest:
            return pieces
        *front, last = self._broken(factor, rest)
        return [*front, joined([last, Written(" ", SPACE), pieces[0]]), *pieces[1:]]

    def _fence(self, node: int, n: int) -> tuple[Written, list[int], Written] | None:
        """What opens and closes the parentheses of a power, and the nodes of what is inside; None where it has none."""
        op, args = self.graph.op[node], self.graph.args[node]
        bracket = lambda mark: f'<mo stretchy="false">{mark}</mo>'
        raised, exponent = (f"<msup>{bracket(')')}<mn>{n}</mn></msup>", raised_text(n)) if n != 1 else (bracket(")"), "")
        if op in ("add", "sub"):
            return Written("(", bracket("(")), [node], Written(f"){exponent}", raised)
        if op == "sqrt" and n == 1:
            return Written("√(", f"<mo>√</mo>{bracket('(')}"), [args[0]], Written(")", raised)
        if op in FUNCTIONS and len(args) == 1 and args[0] not in self.table and n == 1:
            name = FUNCTIONS[op]
            return Written(f"{name}(", f"<mi>{name}</mi>{bracket('(')}"), [args[0]], Written(")", raised)
        return None

    def written(self, node: int) -> Written:
        if node not in self.known:
            terms = self.terms(node)
            self.known[node] = Written(*texts(terms), tight=len(terms) == 1 and terms[0].tight)
        return self.known[node]

    def _summands(self, node: int, factor: float) -> list[tuple[float, int]]:
        op, args = self.graph.op[node], self.graph.args[node]
        if op == "add":
            return self._summands(args[0], factor) + self._summands(args[1], factor)
        if op == "sub":
            return self._summands(args[0], factor) + self._summands(args[1], -factor)
        if op == "neg":
            return self._summands(args[0], -factor)
        return [(factor, node)]

    def _product(self, factor: float, node: int) -> tuple[float, tuple[tuple[int, int], ...]]:
        """The number and the powers (node, exponent) of a product, in the order in which they are written."""
        powers: dict[int, int] = {}
        stack = [(node, 1)]
        while stack:
            node, n = stack.pop()
            op, args = self.graph.op[node], self.graph.args[node]
            if op == "mul":
                stack += [(args[1], n), (args[0], n)]
            elif op == "recip":
                stack.append((args[0], -n))
            elif op == "neg":
                factor = factor * (-1) ** n
                stack.append((args[0], n))
            elif (value := self.graph.number(node)) is not None:
                factor = factor * value**n if value or n > 0 else math.inf
            else:
                powers[node] = powers.get(node, 0) + n
        for base, n in list(powers.items()):  # x/√x = √x
            if self.graph.op[base] == "sqrt" and n * powers.get(inside := self.graph.args[base][0], 0) < 0:
                powers[inside], powers[base] = divmod(2 * powers[inside] + n, 2)
        for base, n in powers.items():
            if n and self.graph.op[base] in ("add", "sub") and self.written(base).text == "0":  # terms that cancel
                factor = 0.0 if n > 0 else math.inf
        return factor, tuple(sorted(((k, n) for k, n in powers.items() if n), key=lambda item: self._rank(item[0])))

    def _rank(self, node: int) -> tuple[int, int]:
        """Parameters, coordinates, velocities, each in their order; then functions, then sums."""
        if node in self.table:
            number, name = self.table[node]
            return (0 if number >= self.first_parameter else 2 if "\u0307" in name.text else 1, number)
        return (4 if self.graph.op[node] in ("add", "sub") else 3, node)

    def _place(self, powers: tuple[tuple[int, int], ...]) -> tuple:
        """Where a term stands in a sum: those with velocities first, each kind in the order of its variables."""
        inputs = [k for k in self.graph.reachable([node for node, _ in powers]) if k in self.table]
        ranks = [self._rank(k) for k in inputs]
        moving, resting = ([number for kind, number in ranks if kind == wanted] for wanted in (2, 1))
        return (not moving, moving or resting or [math.inf])

    def _fraction(self, factor: float, powers: Sequence[tuple[int, int]]) -> Written:
        if not math.isfinite(factor):
            raise NotReadable
        ratio = Fraction(factor).limit_denominator(64)
        whole = ratio if float(ratio) == factor else None
        above = [self._power(node, n) for node, n in powers if n > 0]
        below = [self._power(node, -n) for node, n in powers if n < 0]
        number = number_of(factor) if whole is None else None if whole.numerator == 1 else number_of(whole.numerator)
        if whole is not None and whole.denominator != 1:
            below.insert(0, number_of(whole.denominator))
        if number is not None:
            above.insert(0, number)
        if not above:
            above = [number_of(1)]
        if not below:
            return beside(above)
        top, bottom = alone(above), alone(below)
        text = f"{beside(above).text}/{bottom.grouped().text if len(below) == 1 else '(' + bottom.text + ')'}"
        return Written(text, f"<mfrac><mrow>{top.mathml}</mrow><mrow>{bottom.mathml}</mrow></mfrac>")

    def _power(self, node: int, n: int) -> Written:
        op, args = self.graph.op[node], self.graph.args[node]
        exponent = raised_text(n) if n != 1 else ""
        raised = lambda m: f"<msup><mrow>{m}</mrow><mn>{n}</mn></msup>" if n != 1 else m
        if node in self.table:
            name = self.table[node][1]
            if name.indexed is not None and n != 1:
                return Written(name.text + exponent, f"<msubsup>{''.join(name.indexed)}<mn>{n}</mn></msubsup>")
            return Written(name.text + exponent, raised(name.mathml))
        if op == "sqrt":
            inner = self.written(args[0])
            return Written(f"√({inner.text}){exponent}", raised(f"<msqrt>{inner.mathml}</msqrt>"))
        if op == "abs":
            inner = self.written(args[0])
            return Written(f"|{inner.text}|{exponent}", raised(f"<mrow><mo>|</mo>{inner.mathml}<mo>|</mo></mrow>"))
        if op == "pow":
            base, top = self.written(args[0]).grouped(), self.written(args[1])
            power = f"<msup>{base.mathml}<mrow>{top.mathml}</mrow></msup>"
            return Written(f"{base.text}^({top.text})" if n == 1 else f"({base.text}^({top.text})){exponent}", raised(power))
        if op in FUNCTIONS:
            inside = [self.written(a) for a in args]
            bare = len(inside) == 1 and args[0] in self.table
            listed = ", ".join(one.text for one in inside)
            comma = "<mo>,</mo>".join(f"<mrow>{one.mathml}</mrow>" for one in inside)
            name = FUNCTIONS[op]
            opened = comma if bare else f"<mrow><mo>(</mo>{comma}<mo>)</mo></mrow>"
            mathml = f"<mrow>{raised(f'<mi>{name}</mi>')}<mo>&#x2061;</mo>{SPACE if bare else ''}{opened}</mrow>"
            return Written(f"{name}{exponent} {listed}" if bare else f"{name}{exponent}({listed})", mathml)
        if op in ("add", "sub"):
            inner = self.written(node)
            if n == 1:
                return Written(inner.text, inner.mathml, tight=False)
            group = inner.grouped()
            return Written(group.text + exponent, raised(group.mathml))
        raise NotReadable
