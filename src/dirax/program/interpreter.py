"""Interprets a jaxpr on arrays of graph nodes: every array of a user's function becomes an array of scalar expressions."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import numpy as np
from jax._src import source_info_util
from jax.core import Tracer
from jax.extend.core import ClosedJaxpr, Literal

from dirax.program.complex_numbers import by_pairs, has_complex
from dirax.program.graph import Graph
from dirax.program.pairs import Pair
from dirax.program.whole_numbers import Ranges, are_floats

Nodes = np.ndarray
"""An integer array of node numbers, in the shape of the array that it stands for."""

MANY = 256
"""Entries of an array from which on it pays to look for equal ones."""

SHORT = (np.dtype(np.float32), np.dtype(np.float16))
"""Floats all of which float64 has: constants are held, and what is made of constants alone is found by JAX in their own type."""

LOOP_LIMIT = 4096
"""Most iterations of one loop that are written out."""


class UnsupportedPrimitive(Exception):
    """A primitive that the native engine does not know, with the user's source line."""

    def __init__(self, primitive: str, reason: str, line: str):
        self.primitive, self.reason, self.line = primitive, reason, line
        super().__init__(f"primitive '{primitive}' {reason} ({line})")


class Unavailable:
    """The result of an equation that could not be interpreted; an error only if something needs it."""

    def __init__(self, error: UnsupportedPrimitive):
        self.error = error


class Held(Unavailable):
    """A constant that nodes do not hold, such as a key of `jax.random`: an error only if something else than JAX needs it."""

    def __init__(self, value: Any, error: UnsupportedPrimitive):
        super().__init__(error)
        self.value = value


Rule = Callable[..., Sequence[Any]]
RULES: dict[str, Rule] = {}
"""Primitive name → rule(interpreter, equation, *operands) returning one Nodes array per result."""

LAZY: set[str] = set()
"""Primitives whose rule looks at its operands itself: an unavailable one matters only where it is used."""

IN_PAIRS: set[str] = set()
"""Those whose rule takes pairs for complex numbers."""


def rule(*names: str, lazy: bool = False, pairs: bool = False) -> Callable[[Rule], Rule]:
    """Register a rule for primitives of these names, `lazy` and in `pairs` as those two say."""

    def register(function: Rule) -> Rule:
        for name in names:
            RULES[name] = function
            if lazy:
                LAZY.add(name)
            if pairs:
                IN_PAIRS.add(name)
        return function

    return register


class Unsupported(Exception):
    """Raised by a rule that meets a case it does not know; the interpreter adds the primitive and the line."""


class Interpreter:
    """Runs jaxprs on node arrays of one graph; `rules` are used before those in `RULES`."""

    def __init__(self, graph: Graph, rules: Mapping[str, Rule] | None = None):
        self.graph, self.rules = graph, {**RULES, **(rules or {})}
        self._equations: list[Any] = []
        self.ranges = Ranges(graph)
        self.called: dict[tuple, tuple[Any, list[Any]]] = {}

    def run(self, closed: ClosedJaxpr, *operands: Any) -> list[Any]:
        """The results of a closed jaxpr; each a Nodes array or Unavailable."""
        jaxpr = closed.jaxpr
        values: dict[Any, Any] = dict(zip(jaxpr.constvars, map(self.constants, closed.consts), strict=True))
        values.update(zip(jaxpr.invars, operands, strict=True))
        read = lambda atom: self.constants(atom.val) if isinstance(atom, Literal) else values[atom]
        for equation in jaxpr.eqns:
            results = self._equation(equation, [read(atom) for atom in equation.invars])
            values.update(zip(equation.outvars, results, strict=True))
        return [read(atom) for atom in jaxpr.outvars]

    def constants(self, value: Any) -> Any:
        """The nodes of a concrete array, a pair of a complex one, or Unavailable."""
        if isinstance(value, Tracer):
            return Unavailable(UnsupportedPrimitive("constant", "is a value that JAX traces", "a captured array"))
        known = isinstance(value, jax.Array | np.ndarray | np.generic)
        dtype = value.dtype if known else np.asarray(value).dtype
        if dtype == np.complex128:
            whole = np.asarray(value)  # the parts of an array of JAX are made by JAX, which may be tracing
            return Pair(self.constants(whole.real), self.constants(whole.imag))
        if not is_held_by_nodes(dtype) and dtype not in SHORT:
            failure = UnsupportedPrimitive("constant", f"has dtype {dtype}", "a captured array")
            return Held(value, failure) if known else Unavailable(failure)
        array = np.asarray(value)
        if array.dtype.kind in "iu" and not are_floats(array):
            return Held(
                value, UnsupportedPrimitive("constant", "is a whole number that float64 does not hold", "a captured array")
            )
        array = array.astype(np.float64) if dtype in SHORT else array
        numbers = array.ravel().tolist()
        if array.dtype != np.float64 or len(numbers) < MANY:
            return np.array(list(map(self.graph.constant, numbers)), dtype=np.int64).reshape(array.shape)
        bits = array.ravel().view(np.int64)  # in which 0 is not −0
        known = dict(zip(bits.tolist(), numbers, strict=True))
        return elementwise(lambda one: self.graph.constant(known[one]), bits.reshape(array.shape))

    def static(self, nodes: Nodes) -> np.ndarray | None:
        """The whole numbers that constant nodes hold, None when one is not constant."""
        graph = self.graph
        flat = [graph.value[n] if graph.is_constant(n) else None for n in nodes.ravel().tolist()]
        return None if None in flat else np.array(flat, dtype=np.int64).reshape(nodes.shape)

    def numbers(self, nodes: Nodes) -> np.ndarray | None:
        """The numbers or truth values that constant nodes hold, None when one is not constant."""
        graph = self.graph
        if not nodes.size or not graph.is_constant(int(nodes.flat[0])):
            return None
        own, which = np.unique(nodes, return_inverse=True)
        if not all(map(graph.is_constant, own.tolist())):
            return None
        return np.array([graph.value[node] for node in own.tolist()])[which.reshape(nodes.shape)]

    def whole(self, nodes: Any, variable: Any) -> Any:
        """Whole numbers as their type has them. Raises `Unsupported`."""
        if isinstance(nodes, Unavailable):
            return nodes

        def wrapped(node: int) -> int:
            if (found := self.ranges.wrapped(node, variable.aval.dtype)) is None:
                raise Unsupported("may make whole numbers that float64 does not have")
            return found

        return elementwise(wrapped, nodes)

    def _known(self, equation: Any, operands: list[Any]) -> list[Any] | None:
        """The results of constants that have no rule, by JAX; None where an operand is no constant."""
        if not folds(equation) or any(isinstance(o, Unavailable) and not isinstance(o, Held) for o in operands):
            return None
        values = []
        for nodes, atom in zip(operands, equation.invars, strict=True):
            if isinstance(nodes, Held):
                values.append(nodes.value)
                continue
            if (value := self._value(nodes)) is None:
                return None
            values.append(value.astype(atom.aval.dtype))
        with jax.ensure_compile_time_eval():
            found = equation.primitive.bind(*values, **equation.params)
        results = found if equation.primitive.multiple_results else [found]
        return [self._of_known(value, equation) for value in results]

    def _value(self, nodes: Nodes | Pair) -> np.ndarray | None:
        """The array of constant nodes or of a pair of them, None when one is not constant."""
        if isinstance(nodes, Pair):
            re, im = map(self._value, nodes)
            return None if re is None or im is None else re + 1j * im
        return self.numbers(nodes) if nodes.size else np.zeros(nodes.shape)

    def _of_known(self, value: Any, equation: Any) -> Nodes | Unavailable:
        """The nodes of a concrete array, which is held where they do not hold it."""
        found = self.constants(value)
        if isinstance(found, Held):
            return Held(value, self._failure(equation.primitive.name, "has a result that float64 does not hold"))
        return found

    def _failure(self, name: str, reason: str) -> UnsupportedPrimitive:
        # equations inside a library's jitted functions have no line of the user's: the calling equation has it
        line = next(filter(None, map(source_line, reversed(self._equations))), "unknown line")
        return UnsupportedPrimitive(name, reason, line)

    def _equation(self, equation: Any, operands: list[Any]) -> Sequence[Any]:
        name = equation.primitive.name
        lost = next((o for o in operands if isinstance(o, Unavailable)), None)
        self._equations.append(equation)
        try:
            if lost is not None and name not in LAZY:
                return self._known(equation, operands) or [Unavailable(lost.error)] * len(equation.outvars)
            if has_complex(equation) and name not in IN_PAIRS:
                return self._in_pairs(equation, operands)
            if name not in self.rules:
                raise Unsupported("is not supported")
            if name not in LAZY:  # those look at what is inside
                check_dtypes(equation)
            results = self.rules[name](self, equation, *operands)
            return [self.whole(x, v) if is_integer(v) else x for x, v in zip(results, equation.outvars, strict=True)]
        except Unsupported as error:
            if (known := self._known(equation, operands)) is not None:
                return known
            return [Unavailable(self._failure(name, str(error)))] * len(equation.outvars)
        finally:
            self._equations.pop()

    def _in_pairs(self, equation: Any, operands: list[Any]) -> list[Any]:
        """The results of an equation with complex numbers, by the real parts that it is made of. Raises `Unsupported`."""
        found = by_pairs(equation, operands, lambda closed, parts: self.run(closed, *parts))  # one that is lost is so twice
        if found is None:
            raise Unsupported("is not known of complex numbers")
        return found


def folds(equation: Any) -> bool:
    """Whether an equation is one primitive of JAX alone, with results that nodes can hold."""
    inner = any(hasattr(p, "eqns") or hasattr(p, "jaxpr") for p in jax.tree.leaves(list(equation.params.values())))
    return not inner and not equation.effects and not equation.primitive.name.startswith("dirax_")


def check_dtypes(equation: Any) -> None:
    """Raise `Unsupported` for results that are neither float64, nor whole numbers, nor booleans."""
    if others := has_others(equation):
        raise Unsupported(f"has a result of dtype {others[0]}")


def has_others(equation: Any) -> list[Any]:
    """The dtypes of results that are none of these."""
    dtypes = [getattr(variable.aval, "dtype", None) for variable in equation.outvars]
    return [d for d in dtypes if d is None or not is_held_by_nodes(d)]


def is_held_by_nodes(dtype: Any) -> bool:
    """Whether nodes stand for values of this dtype, which may be one of JAX's own."""
    return isinstance(dtype, np.dtype) and (dtype == np.float64 or dtype.kind in "biu")


def source_line(equation: Any) -> str:
    """Where in the user's code an equation comes from."""
    return source_info_util.summarize(equation.source_info)


def is_integer(variable: Any) -> bool:
    """Whether a jaxpr variable holds whole numbers."""
    return isinstance(dtype := variable.aval.dtype, np.dtype) and dtype.kind in "iu"


def elementwise(function: Callable[..., int], *operands: Nodes) -> Nodes:
    """`function` on nodes, entry by entry, scalars spread; of many entries asked once for those whose operands are the same."""
    shape = operands[0].shape
    if any(a.shape != shape for a in operands):
        operands = tuple(np.broadcast_arrays(*operands))
        shape = operands[0].shape
    each = [a.ravel().tolist() for a in operands]
    if len(each[0]) < MANY:
        return np.array(list(map(function, *each)), dtype=np.int64).reshape(shape)
    entries = list(zip(*each, strict=True))
    found = {entry: function(*entry) for entry in dict.fromkeys(entries)}
    return np.array([found[entry] for entry in entries], dtype=np.int64).reshape(shape)
