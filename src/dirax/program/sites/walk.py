"""A jaxpr run on pieces: every array becomes a few expressions."""

import math
from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np
from jax.core import Tracer
from jax.extend.core import ClosedJaxpr, Literal
from jax.interpreters import partial_eval

from dirax.program.complex_numbers import by_pairs, has_complex
from dirax.program.interpreter import RULES, Interpreter, Unsupported, check_dtypes, is_integer
from dirax.program.pairs import Pair
from dirax.program.rules.control import inner_jaxpr
from dirax.program.rules.differentiable import RULED, is_float, tangent
from dirax.program.rules.reductions import FOLDS, factors_of_product
from dirax.program.sites.courses import Course, NotBySites, taken_apart
from dirax.program.sites.pieces import SHORT, Expressions, Piece, Place, combined, gathered, one_at_a_time, shared
from dirax.program.sparsity.indexing import places_of_updates, read
from dirax.program.sparsity.movement import MOVES
from dirax.program.sparsity.movement import pad as padded
from dirax.program.sparsity.values import evaluated
from dirax.program.sparsity.walk import BY_ENTRY, CALLS, IN_NUMPY, iota

CONSTANT = 8
"""Different stretches of a known array up to which each is a constant."""

LOGICAL = frozenset(("lt", "le", "gt", "ge", "eq", "ne", "and", "or", "not", "xor", "is_finite", "select_n", "stop_gradient"))

NEVER = frozenset(("custom_linear_solve", "while", "scan", "cond", "lu", "triangular_solve", "cholesky", "sort", "cumsum"))
"""Primitives whose results are no expressions of a few entries."""

Value = np.ndarray | list[Piece]
"""An array whose numbers are known, or one in pieces."""


class Sites(NamedTuple):
    """Results in pieces, with the arrays that they depend on beside the arguments, `constants`, and the `totals`, each the sum
    of an array in pieces; the argument −1 of a place has the totals as its entries."""

    expressions: Expressions
    results: list[list[Piece]]
    sizes: list[int]
    constants: list[np.ndarray]
    totals: list[list[Piece]]


def sites_of(function: Callable, *arguments: Any) -> Sites:
    """The results of a function; its arguments, flattened, those of places. Floats among them may be `jax.ShapeDtypeStruct`s, the
    numbers of others are known. Raises `NotBySites`."""
    closed = jax.make_jaxpr(function)(*arguments)
    return _Walk(len(closed.jaxpr.invars)).results(closed, jax.tree.leaves(arguments))


class _Walk:
    def __init__(self, arguments: int):
        self.expressions = Expressions()
        self.interpreter = Interpreter(self.expressions.graph)
        self.arguments, self.constants, self.totals = arguments, [], []
        self.plain = False

    def results(self, closed: ClosedJaxpr, leaves: list[Any]) -> Sites:
        given: list[Value] = []
        for i, leaf in enumerate(leaves):
            shape, kind = np.shape(leaf), jax.numpy.result_type(leaf)
            if kind == np.float64:
                given.append(self._argument(i, math.prod(shape)))
            elif isinstance(leaf, jax.ShapeDtypeStruct | Tracer):
                raise NotBySites(f"a parameter has the type {kind}")
            else:
                given.append(np.asarray(leaf))
        found = [self.pieces(x, v.aval.shape) for x, v in zip(self._run(closed, given), closed.jaxpr.outvars, strict=True)]
        sizes = [math.prod(v.aval.shape) for v in closed.jaxpr.outvars]
        return Sites(self.expressions, found, sizes, self.constants, self.totals)

    def _argument(self, number: int, size: int) -> list[Piece]:
        return [Piece(Course(0, 1), size, self.expressions.input(Place(number, Course(0, int(size > 1)))))] if size else []

    def _run(self, closed: ClosedJaxpr, operands: Sequence[Any]) -> list[Any]:
        """The results of a jaxpr: each a Value, or a pair of them where it is complex."""
        jaxpr, used = partial_eval.dce_jaxpr(closed.jaxpr, [True] * len(closed.jaxpr.outvars))[:2]
        values: dict[Any, Any] = {}
        for variable, constant in zip(closed.jaxpr.constvars, closed.consts, strict=True):
            if isinstance(constant, Tracer):
                raise NotBySites("an array that JAX traces is captured")
            values[variable] = _in_parts(constant)
        values.update(zip(jaxpr.invars, (o for o, u in zip(operands, used, strict=True) if u), strict=True))
        read = lambda atom: _in_parts(atom.val) if isinstance(atom, Literal) else values[atom]
        for equation in jaxpr.eqns:  # before anything is done
            if equation.primitive.name in NEVER:
                raise NotBySites(f"'{equation.primitive.name}' is not known entry by entry")
        for equation in jaxpr.eqns:
            results = self._equation(equation, [read(atom) for atom in equation.invars])
            values.update((v, self._whole(x, v)) for v, x in zip(equation.outvars, results, strict=True))
        return [read(atom) for atom in jaxpr.outvars]

    def _whole(self, value: Any, variable: Any) -> Any:
        """Whole numbers as their type has them."""
        if isinstance(value, np.ndarray) or not is_integer(variable):
            return value
        try:
            nodes = self.interpreter.whole(np.array([piece.node for piece in value], np.int64), variable)
        except Unsupported as error:
            raise NotBySites(str(error)) from None
        return [piece._replace(node=node) for piece, node in zip(value, nodes.tolist(), strict=True)]

    def _equation(self, equation: Any, operands: list[Any]) -> Sequence[Any]:
        name, p = equation.primitive.name, equation.params
        known = all(isinstance(part, np.ndarray) for o in operands for part in (o if isinstance(o, Pair) else (o,)))
        if name in RULED and not self.plain and not known:
            try:
                return self._by_its_rule(equation, operands)
            except Unsupported as error:
                raise NotBySites(f"'{name}' {error}") from None
        if name in CALLS:
            inner = p[CALLS[name]]
            return self._run(inner if isinstance(inner, ClosedJaxpr) else ClosedJaxpr(inner, ()), operands)
        if name.startswith("dirax_"):
            impl = lambda *given: equation.primitive.impl(*given, **p)
            return self._run(jax.make_jaxpr(impl)(*(v.aval for v in equation.invars)), operands)
        if has_complex(equation):
            if (found := by_pairs(equation, operands, self._run)) is None:
                raise NotBySites(f"'{name}' is not known of complex numbers")
            return found
        if known:
            return self._known(equation, operands)
        if not any(v.aval.size for v in equation.outvars):
            return [[] for _ in equation.outvars]
        try:
            check_dtypes(equation)
            if name in MOVES or name == "pad":
                return self._moved(equation, operands)
            if name in BY_ENTRY or name in LOGICAL:
                return [self._by_entry(equation, operands)]
            if name in ("gather", "dynamic_slice", "dynamic_update_slice"):
                return [self._indexed(equation, operands)]
            if name in ("scatter-add", "scatter"):
                return [self._scattered(equation, *operands)]
            if name == "dot_general":
                return [self._product(equation, *operands)]
            if name in FOLDS and "axes" in p:
                return [self._folded(equation, operands[0])]
        except Unsupported as error:
            raise NotBySites(f"'{name}' {error}") from None
        raise NotBySites(f"'{name}' is not known entry by entry")

    def _by_its_rule(self, equation: Any, operands: list[Value]) -> Sequence[Value]:
        """What has a rule of its own for its derivative, as `dirax.program.rules.differentiable` has it."""
        make, e = self.expressions.graph.make, self.expressions

        def of(op: str, variables: Sequence[Any]) -> list[Value]:
            chosen = [(x, v) for x, v in zip(operands, equation.invars, strict=True) if v in variables]
            pieces = [self.pieces(x, v.aval.shape) for x, v in chosen]
            return [[p._replace(node=make(op, p.node)) for p in own] for own in pieces]

        if has_complex(equation):
            raise Unsupported("has complex numbers")
        if equation.primitive.name == "stop_gradient":
            return of("held", equation.invars)
        inner = inner_jaxpr(equation)
        values = self._run(inner if isinstance(inner, ClosedJaxpr) else ClosedJaxpr(inner, ()), operands)
        moving = [v for v in equation.invars if is_float(v)]
        self.plain = True  # in a tangent all that could have a rule is held
        try:
            along = iter(self._run(tangent(equation), [*of("held", equation.invars), *of("motion", moving)]))
        finally:
            self.plain = False

        def ruled(value: Value, variable: Any) -> Value:
            if not is_float(variable):
                return value
            both = shared(e, [self.pieces(x, variable.aval.shape) for x in (value, next(along))])
            return [piece._replace(node=make("ruled", *nodes)) for piece, nodes in both]

        return [ruled(value, v) for value, v in zip(values, equation.outvars, strict=True)]

    def _known(self, equation: Any, operands: list[Any]) -> Sequence[Value]:
        name = equation.primitive.name
        if name in MOVES:
            return [np.asarray(a) for a in RULES[name](self.interpreter, equation, *operands)]
        if name == "iota":
            return [iota(equation)]
        if name in IN_NUMPY:
            return [np.asarray(IN_NUMPY[name](*operands)).astype(equation.outvars[0].aval.dtype)]
        return evaluated(equation, operands)

    # ------------------------------------------------------------------------------------------------ arrays in pieces

    def pieces(self, value: Value, shape: tuple[int, ...]) -> list[Piece]:
        """An array of this shape in pieces: of one that is known a few constants, or an array beside the arguments and zeros."""
        if isinstance(value, list):
            return value
        flat, graph = np.ravel(value), self.expressions.graph
        if not flat.size:
            return []
        bits = flat.view(np.int64) if flat.dtype == np.float64 else flat  # of which NaN is equal to itself
        change = np.flatnonzero(bits[1:] != bits[:-1]) + 1
        if len(change) < CONSTANT:
            starts, stops = [0, *change.tolist()], [*change.tolist(), flat.size]
            return [Piece(Course(a, 1), b - a, graph.constant(flat[a])) for a, b in zip(starts, stops, strict=True)]
        if flat.dtype == np.bool_:
            courses = taken_apart(flat.astype(np.int64), np.zeros(flat.size, np.int64), _periods(shape))
            return [Piece(course, count, graph.constant(bool(i))) for course, count, i, _ in courses]
        numbers = np.asarray(flat, float)
        self.constants.append(numbers)
        (whole,) = self._argument(self.arguments + len(self.constants) - 1, flat.size)
        there = (numbers != 0.0) | np.signbit(numbers)  # what is zero makes no entries of a Jacobian
        if np.all(there):
            return [whole]
        return self._taken([whole], flat.size, np.where(there, np.arange(flat.size), -1).reshape(shape))

    def _by_entry(self, equation: Any, operands: list[Value]) -> Value:
        shape = equation.outvars[0].aval.shape
        size, arrays = math.prod(shape), []
        for value, variable in zip(operands, equation.invars, strict=True):
            own = self.pieces(value, variable.aval.shape)
            inner = variable.aval.shape
            if inner != shape and size:  # repeated along axes of length 1
                there = np.arange(math.prod(inner)).reshape(inner)
                own = self._taken(own, there.size, np.broadcast_to(there, shape), inner)
            arrays.append(own)
        if not size:
            return []
        both = shared(self.expressions, arrays)
        assert sum(p.length for p, _ in both) == size, (equation, arrays)
        nodes = [np.array(column, np.int64) for column in zip(*(nodes for _, nodes in both), strict=True)]
        (found,) = RULES[equation.primitive.name](self.interpreter, equation, *nodes)
        return [p._replace(node=int(node)) for (p, _), node in zip(both, found, strict=True)]

    def _one(self, operands: list[Value], equation: Any) -> tuple[list[Piece], list[np.ndarray]]:
        """All operands as one array in pieces, and the numbers of the entries of each in it."""
        pieces, numbers, first = [], [], 0
        for value, variable in zip(operands, equation.invars, strict=True):
            shape = variable.aval.shape
            pieces += [p.shifted(first) for p in self.pieces(value, shape)]
            numbers.append(first + np.arange(math.prod(shape)).reshape(shape))
            first += math.prod(shape)
        return pieces, numbers

    def _taken(self, pieces: list[Piece], size: int, entries: np.ndarray, *shapes: tuple[int, ...]) -> list[Piece]:
        periods = [p for shape in (entries.shape, *shapes) for p in _periods(shape)]
        return gathered(self.expressions, pieces, size, entries, periods)

    def _moved(self, equation: Any, operands: list[Value]) -> list[Value]:
        name = equation.primitive.name
        if name in ("squeeze", "expand_dims") or (name == "reshape" and equation.params["dimensions"] is None):
            return [operands[0]]
        pieces, numbers = self._one(operands, equation)
        size, shapes = sum(n.size for n in numbers), [n.shape for n in numbers]
        found = padded(None, equation, *numbers) if name == "pad" else RULES[name](self.interpreter, equation, *numbers)
        return [self._taken(pieces, size, np.asarray(entries), *shapes) for entries in found]

    def _indexed(self, equation: Any, operands: list[Value]) -> Value:
        """Entries at places that are known."""
        given = 2 if equation.primitive.name == "dynamic_update_slice" else 1
        indices = [o for o in operands[given:] if isinstance(o, np.ndarray)]
        if len(indices) < len(operands) - given:
            raise NotBySites(f"'{equation.primitive.name}' has indices that depend on values")
        pieces, numbers = self._one(operands[:given], equation.replace(invars=equation.invars[:given]))
        found = read(equation, [1 + n for n in numbers], indices)
        return self._taken(pieces, sum(n.size for n in numbers), found - 1, *(n.shape for n in numbers))

    def _scattered(self, equation: Any, value: Value, indices: Value, updates: Value) -> Value:
        if isinstance(indices, list):
            raise NotBySites("'scatter' has indices that depend on values")
        shape, given = equation.invars[0].aval.shape, equation.invars[2].aval.shape
        targets = places_of_updates(equation, indices, shape, given) - 1
        total, pieces = self.pieces(value, shape), self.pieces(updates, given)
        for entries in one_at_a_time(targets, math.prod(shape)):
            term = self._taken(pieces, math.prod(given), entries.reshape(shape), given)
            if equation.primitive.name == "scatter":
                kept = np.where(entries < 0, np.arange(len(entries)), -1)
                total = self._taken(total, math.prod(shape), kept.reshape(shape))
            total = combined(self.expressions, "add", total, term)
        return total

    def _product(self, equation: Any, a: Value, b: Value) -> Value:
        shapes = [v.aval.shape for v in equation.invars]
        rows, columns = factors_of_product(equation, *(np.arange(math.prod(shape)).reshape(shape) for shape in shapes))
        terms, out = rows.shape[-1], (*rows.shape[:2], columns.shape[1])
        pieces = [self.pieces(x, shape) for x, shape in zip((a, b), shapes, strict=True)]
        if terms > SHORT and math.prod(out) <= SHORT:
            taken = lambda k, numbers: self._taken(pieces[k], math.prod(shapes[k]), numbers, shapes[k])
            places = ((rows[b, i], columns[b, j]) for b, i, j in np.ndindex(*out))
            return self._totals(combined(self.expressions, "mul", taken(0, own), taken(1, other)) for own, other in places)
        if terms > SHORT:
            raise NotBySites("'dot_general' has sums of many terms")
        total: list[Piece] | None = None
        for m in range(terms):
            of_a, of_b = np.broadcast_to(rows[:, :, None, m], out), np.broadcast_to(columns[:, None, :, m], out)
            taken = [
                self._taken(x, math.prod(s), n, equation.outvars[0].aval.shape)
                for x, s, n in zip(pieces, shapes, (of_a, of_b), strict=True)
            ]
            term = combined(self.expressions, "mul", *taken)
            total = term if total is None else combined(self.expressions, "add", total, term)
        size = math.prod(out)
        return total or ([Piece(Course(0, 1), size, self.expressions.graph.zero)] if size else [])

    def _folded(self, equation: Any, value: Value) -> Value:
        shape, axes = equation.invars[0].aval.shape, tuple(equation.params["axes"])
        kept, op = [a for a in range(len(shape)) if a not in axes], FOLDS[equation.primitive.name]
        pieces, out = self.pieces(value, shape), tuple(shape[a] for a in kept)
        numbers = np.arange(math.prod(shape)).reshape(shape).transpose(*kept, *axes).reshape(math.prod(out), -1)
        if numbers.shape[1] > SHORT >= len(numbers) and op == "add":
            return self._totals(self._taken(pieces, math.prod(shape), row, shape) for row in numbers)
        if not 0 < numbers.shape[1] <= SHORT:
            raise NotBySites(f"'{equation.primitive.name}' has {numbers.shape[1]} terms")
        columns = [self._taken(pieces, math.prod(shape), column.reshape(out), shape) for column in numbers.T]
        total = columns[0]
        for column in columns[1:]:
            total = combined(self.expressions, op, total, column)
        return total

    def _totals(self, arrays: Iterable[list[Piece]]) -> list[Piece]:
        """The sum of each of these arrays in pieces, an array."""
        found = []
        for i, pieces in enumerate(arrays):
            self.totals.append(pieces)
            found.append(Piece(Course(i, 1), 1, self.expressions.input(Place(-1, Course(len(self.totals) - 1, 0)))))
        return found


def _in_parts(constant: Any) -> np.ndarray | Pair:
    """An array whose numbers are known, a pair of such where they are complex."""
    array = np.asarray(constant)
    return Pair(array.real, array.imag) if array.dtype == np.complex128 else array


def _periods(shape: tuple[int, ...]) -> list[int]:
    """After how many entries an array of this shape repeats itself."""
    return [math.prod(shape[i:]) for i in range(1, len(shape))]
