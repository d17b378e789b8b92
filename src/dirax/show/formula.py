"""Functions of the user as formulas: their trace as sums and products, typeset in MathML, or None where it is too long."""

import html
import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import jax
import numpy as np

from dirax.program.graph import Graph, GraphTooLarge
from dirax.program.interpreter import Interpreter, Unavailable

LONGEST = 420
"""Most characters of a formula as text; a longer one is shown as its source."""

NODES = 4000

WIDE = 29
"""Most letters of a term that is kept on one line; a line may break inside the parentheses of a longer one."""

SPACE = '<mspace width="0.17em"></mspace>'

GREEK = {
    **{"alpha": "α", "beta": "β", "gamma": "γ", "delta": "δ", "epsilon": "ε", "zeta": "ζ", "eta": "η", "theta": "θ"},
    **{"kappa": "κ", "lambda": "λ", "mu": "μ", "nu": "ν", "xi": "ξ", "rho": "ρ", "sigma": "σ", "tau": "τ", "phi": "φ"},
    **{"chi": "χ", "psi": "ψ", "omega": "ω", "Gamma": "Γ", "Delta": "Δ", "Theta": "Θ", "Lambda": "Λ", "Pi": "Π"},
    **{"Sigma": "Σ", "Phi": "Φ", "Psi": "Ψ", "Omega": "Ω"},
}

FUNCTIONS = {
    **{name: name for name in ("sin", "cos", "tan", "sinh", "cosh", "tanh", "exp", "log", "erf", "max", "min", "sign")},
    **{"asin": "arcsin", "acos": "arccos", "atan": "arctan", "atan2": "arctan2", "asinh": "arsinh", "expm1": "expm1"},
    "log1p": "log1p",
}


class NotReadable(Exception):
    """A trace that has no short formula."""


@dataclass(frozen=True)
class Written:
    """A piece of a formula as text and as MathML; `tight`: whether it can be a factor, or the base of a power, as it is."""

    text: str
    mathml: str
    tight: bool = True
    indexed: tuple[str, str] | None = None
    """Of a letter with an index, both in MathML, so that a power can stand above the index."""

    def grouped(self) -> "Written":
        """With parentheses where it needs them."""
        if self.tight:
            return self
        return Written(f"({self.text})", f"<mrow><mo>(</mo>{self.mathml}<mo>)</mo></mrow>")


def symbol(name: str, dotted: bool = False) -> Written:
    """A name as a letter with an index: θ1, m_2, omega; dotted for a velocity."""
    base, index = name, ""
    if found := re.fullmatch(r"([^\W\d_]+?)_?(\d+(?:,\d+)*)", name) or re.fullmatch(r"([^\W_]+)_(\w+)", name):
        base, index = found.groups()
    base, index = GREEK.get(base, base), GREEK.get(index, index)
    letter = f"<mi>{html.escape(base)}</mi>"
    if dotted:
        letter = f'<mover accent="true">{letter}<mo>˙</mo></mover>'
    text = base[:1] + "\u0307" * dotted + base[1:] + index
    if not index:
        return Written(text, letter)
    below = f"<mi>{html.escape(index)}</mi>"
    return Written(text, f"<msub>{letter}{below}</msub>", indexed=(letter, below))


def symbols(names: Sequence[str], dotted: bool = False) -> np.ndarray:
    """One symbol a name."""
    found = np.empty(len(names), dtype=object)
    found[:] = [symbol(name, dotted) for name in names]
    return found


def of_params(params: Any) -> Any:
    """The symbols of parameters: of numbers by their names, of arrays with an index an entry."""

    def named(path: Any, leaf: Any) -> np.ndarray:
        name = "_".join(str(getattr(key, "key", getattr(key, "name", getattr(key, "idx", key)))) for key in path) or "params"
        shape = np.shape(leaf)
        entries = np.empty(shape, dtype=object)
        for at in np.ndindex(shape):
            index = ",".join(str(i + 1) for i in at)
            entries[at] = symbol(f"{name}_{index}" if index else name)
        return entries

    return jax.tree_util.tree_map_with_path(named, params)


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


def joined(pieces: Sequence[Written]) -> Written:
    """Pieces as one formula."""
    return Written("".join(one.text for one in pieces), "".join(one.mathml for one in pieces), tight=len(pieces) < 2)


class _Writer:
    """Writes nodes of a graph; `table`: input node → (its number, symbol)."""

    def __init__(self, graph: Graph, table: dict[int, tuple[int, Written]], parameters: int):
        self.graph, self.table = graph, table
        self.first_parameter = len(table) - parameters
        self.known: dict[int, Written] = {}

    def terms(self, node: int) -> list[Written]:
        """The terms of a sum, each with its sign, positive ones first."""
        parts = self._parts(node)
        written = [_signed(k, factor, self._fraction(abs(factor), powers)) for k, (factor, powers) in enumerate(parts)]
        if sum(len(part.text) for part in written) > LONGEST:
            raise NotReadable
        return written

    def pieces(self, node: int) -> list[Written]:
        """The same, with long terms in pieces."""
        self.terms(node)  # of a length that can be read
        found = []
        for k, (factor, powers) in enumerate(self._parts(node)):
            first, *rest = self._broken(abs(factor), powers)
            found += [_signed(k, factor, first), *rest]
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
        raised, exponent = (f"<msup>{bracket(')')}<mn>{n}</mn></msup>", _exponent(n)) if n != 1 else (bracket(")"), "")
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
            self.known[node] = Written(*_texts(terms), tight=len(terms) == 1 and terms[0].tight)
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
        number = _number(factor) if whole is None else None if whole.numerator == 1 else _number(whole.numerator)
        if whole is not None and whole.denominator != 1:
            below.insert(0, _number(whole.denominator))
        if number is not None:
            above.insert(0, number)
        if not above:
            above = [_number(1)]
        if not below:
            return _beside(above)
        top, bottom = _alone(above), _alone(below)
        text = f"{_beside(above).text}/{bottom.grouped().text if len(below) == 1 else '(' + bottom.text + ')'}"
        return Written(text, f"<mfrac><mrow>{top.mathml}</mrow><mrow>{bottom.mathml}</mrow></mfrac>")

    def _power(self, node: int, n: int) -> Written:
        op, args = self.graph.op[node], self.graph.args[node]
        exponent = _exponent(n) if n != 1 else ""
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


def _signed(place: int, factor: float, body: Written) -> Written:
    """A term of a sum with its sign."""
    minus, plus = ("−", "") if place == 0 else (" − ", " + ")
    sign = minus if factor < 0 else plus
    mark = f'<mo form="{"prefix" if place == 0 else "infix"}">{sign.strip()}</mo>' if sign else ""
    return Written(sign + body.text, mark + body.mathml, tight=place == 0 and factor > 0 and body.tight)


def _exponent(n: int) -> str:
    return f"^{n}" if n > 9 else "⁰¹²³⁴⁵⁶⁷⁸⁹"[n]


def _texts(terms: Sequence[Written]) -> tuple[str, str]:
    whole = joined(terms)
    return whole.text, f"<mrow>{whole.mathml}</mrow>"


def _alone(parts: list[Written]) -> Written:
    """Factors under or over a line of their own, where a single sum needs no parentheses."""
    return parts[0] if len(parts) == 1 else _beside(parts)


def _beside(parts: list[Written]) -> Written:
    grouped = [part.grouped() for part in parts]
    texts = " ".join(part.text for part in grouped)
    return Written(texts, f"<mrow>{SPACE.join(part.mathml for part in grouped)}</mrow>")


def _number(value: float | int) -> Written:
    text = f"{value:.6g}"
    if "e" in text:
        mantissa, exponent = text.split("e")
        power = str(int(exponent)).replace("-", "−")
        return Written(
            f"{mantissa}·10^{power}", f"<mn>{mantissa}</mn><mo>·</mo><msup><mn>10</mn><mn>{power}</mn></msup>", tight=False
        )
    return Written(text, f"<mn>{text}</mn>")
