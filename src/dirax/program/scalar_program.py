"""ScalarProgram: a function of a few numbers, traced once into scalar expressions; values of it in NumPy and in JAX."""

import contextlib
import functools
import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import ClosedJaxpr, jaxpr_as_fun

from dirax.program.evaluation.by_jax import by_jax
from dirax.program.evaluation.in_floats import Floats, in_floats
from dirax.program.evaluation.in_numpy import LANES, Values, in_parts, lanes_of
from dirax.program.evaluation.noise import Noise
from dirax.program.evaluation.tape import FEWEST_NODES, Tape
from dirax.program.graph import NODE_LIMIT, Graph, GraphTooLarge, Order, with_ends
from dirax.program.interpreter import Interpreter, Nodes, Unavailable, UnsupportedPrimitive, elementwise, is_integer
from dirax.program.memo import Memo, Same
from dirax.program.pairs import Pair
from dirax.program.primitives import plain_primitive

OFTEN = 32
"""Times that a program is evaluated for one entry until Python's floats are worth their compiling."""

IN_NUMPY = 4 * NODE_LIMIT
"""Nodes up to which a program is evaluated in NumPy: some µs each to make and to evaluate, where XLA takes a millisecond."""

NUMPY_RULES: dict[str, Callable] = {}
"""Primitive name → rule(made, interpreter, equation, *operands), which may add computations in NumPy to the program `made`."""


def numpy_rule(name: str) -> Callable[[Callable], Callable]:
    """Register a rule that is used before that of the graph, in programs that are evaluated in NumPy alone."""
    return lambda function: NUMPY_RULES.setdefault(name, function)


@dataclass
class Opaque:
    """A computation between nodes that is no node: arrays (entries, …) of the operands to those of the results."""

    operands: list[Nodes]
    results: list[Nodes]
    function: Callable[[list[np.ndarray]], list[np.ndarray]]
    name: Any = None

    def same(self, name: Any, operands: list[Nodes]) -> bool:
        """Whether it is what a name says, of these operands."""
        return name is not None and self.name == name and all(map(np.array_equal, self.operands, operands))


@dataclass(eq=False)
class ScalarProgram:
    """A jaxpr as a graph: arrays of input nodes, the nodes of its results, and what is computed between nodes by NumPy."""

    graph: Graph
    inputs: list[Nodes]
    results: list[Nodes] = field(default_factory=list)
    opaque: list[Opaque] = field(default_factory=list)
    for_few: bool = False
    """Whether it is to be evaluated once, at a handful of entries: then more of it is found in numbers."""
    _asked: int = 0

    @classmethod
    def of(cls, jaxpr: ClosedJaxpr, by_numpy: bool = False, for_few: bool = False, limit: int = NODE_LIMIT) -> "ScalarProgram":
        """The program of a jaxpr, `by_numpy` with decompositions, roots and loops that are no expressions, else of up to `limit`
        nodes.

        Raises `UnsupportedPrimitive` and `GraphTooLarge`."""
        made = cls(Graph(IN_NUMPY if by_numpy else limit), [], for_few=for_few)
        made.inputs = [made.fresh(v.aval.shape) for v in jaxpr.jaxpr.invars]
        made.run(jaxpr, {name: functools.partial(rule, made) for name, rule in NUMPY_RULES.items()} if by_numpy else {})
        return made

    def run(self, jaxpr: ClosedJaxpr, rules: Mapping[str, Callable] | None = None) -> None:
        """Find the results, the nodes of `jaxpr` of the inputs. Raises as `of`."""
        interpreter, given = Interpreter(self.graph, rules), []
        for variable, nodes in zip(jaxpr.jaxpr.invars, self.inputs, strict=True):
            if is_integer(variable):
                interpreter.ranges.given(nodes, variable.aval.dtype)
            is_complex = jnp.issubdtype(variable.aval.dtype, np.complexfloating)
            given.append(Unavailable(UnsupportedPrimitive("argument", "is complex", "its caller")) if is_complex else nodes)
        self.results = interpreter.run(jaxpr, *given)
        for result in self.results:
            if isinstance(result, Unavailable):
                raise result.error
            if isinstance(result, Pair):
                raise UnsupportedPrimitive("result", "is complex", "its caller")

    def fresh(self, shape: tuple[int, ...]) -> Nodes:
        """New input nodes."""
        first = len(self.graph)
        return np.array([self.graph.input(f"x{first + i}") for i in range(math.prod(shape))], np.int64).reshape(shape)

    def depends_on(self, *inputs: Nodes) -> bool:
        """Whether a result needs one of these inputs."""
        needed = set(self.graph.reachable(_flat(self.results)))
        for step in reversed(self.opaque):
            if not needed.isdisjoint(_flat(step.results)):
                needed.update(self.graph.reachable(_flat(step.operands)))
        return not needed.isdisjoint(_flat(inputs))

    def between(self, operands: list[Nodes], shapes: list[tuple[int, ...]], function: Callable, name: Any = None) -> list[Nodes]:
        """The nodes of the results of an opaque computation: of one with an equal `name` and the same operands those there are,
        of one with a name and constant operands the values."""
        for known in self.opaque:
            if known.same(name, operands):
                return known.results
        values = [self.constants(nodes)[None] for nodes in operands] if name is not None else []
        if values and all(np.all(np.isfinite(a)) for a in values):
            return [elementwise(lambda x: self.graph.constant(x), a[0]) for a in function(values)]
        self.opaque.append(Opaque(operands, [self.fresh(shape) for shape in shapes], function, name))
        return self.opaque[-1].results

    def in_numpy(self, leaves: list[np.ndarray], noise: Noise | None = None) -> list[np.ndarray]:
        """The results for arguments (entries, …), with that leading axis; for one entry again and again by Python's floats, which
        have the same bits. `noise`: of the operations, in place of NumPy's; opaque computations have that of their operands."""
        self._asked += 1
        leaves = [leaf.real if leaf.dtype.kind == "c" else leaf for leaf in leaves]  # of complex numbers nothing is read
        if noise is None and self.tape_pays(len(leaves[0])):
            return self._by_tape(leaves)
        if len(leaves[0]) == 1 and noise is None and self._asked > OFTEN:
            with contextlib.suppress(ArithmeticError, ValueError):  # what Python's floats do not have
                return self._by_floats(leaves)
        return in_parts(functools.partial(self._part, noise=noise), leaves, lanes_of(self.graph))

    def _by_floats(self, leaves: list[np.ndarray]) -> list[np.ndarray]:
        found, results, at = self.in_floats([x for leaf in leaves for x in np.asarray(leaf, float).ravel().tolist()]), [], 0
        for nodes in self.results:
            results.append(np.array(found[at : at + nodes.size], float).reshape(1, *nodes.shape))
            at += nodes.size
        return results

    def _by_tape(self, leaves: list[np.ndarray]) -> list[np.ndarray]:
        entries, results, at = len(leaves[0]), [], 0
        given = np.concatenate([np.asarray(leaf, float).reshape(entries, -1) for leaf in leaves], axis=1)
        found = self.tape(given)
        for nodes in self.results:
            results.append(found[:, at : at + nodes.size].reshape(entries, *nodes.shape))
            at += nodes.size
        return results

    def tape_pays(self, entries: int) -> bool:
        """Whether a tape is quicker than arrays from now on."""
        return (self._asked > 1 or entries > LANES) and len(self.graph) >= FEWEST_NODES

    @functools.cached_property
    def tape(self) -> Tape:
        """The program as a table for a compiled loop."""
        return Tape(self.graph, _flat(self.inputs), _flat(self.results), self.opaque)

    def _part(self, leaves: list[np.ndarray], noise: Noise | None) -> list[np.ndarray]:
        known = Values(self.graph, len(leaves[0]), noise.table if noise else None)
        for nodes, leaf in zip(self.inputs, leaves, strict=True):
            known.bind(nodes, noise.off(leaf) if noise else leaf)
        orders = iter(self._orders)
        for step in self.opaque:
            operands = [known.read(nodes, next(orders)) for nodes in step.operands]
            for nodes, array in zip(step.results, step.function(operands), strict=True):
                known.bind(nodes, array)
        return [known.read(nodes, next(orders)) for nodes in self.results]

    @functools.cached_property
    def _orders(self) -> list[Order]:
        """How to compute what is left for the operands of each opaque computation, and then for each result."""
        known, parts = set(_flat(self.inputs)), []
        for step in self.opaque:
            parts += [self._next(nodes, known) for nodes in step.operands]
            known.update(_flat(step.results))
        parts += [self._next(nodes, known) for nodes in self.results]
        return with_ends(self.graph, parts)

    def _next(self, nodes: Nodes, known: set[int]) -> tuple[list[int], list[int]]:
        read = nodes.ravel().tolist()
        order = self.graph.reachable(read, known)
        known.update(order)
        return order, read

    @functools.cached_property
    def in_floats(self) -> Floats:
        """The results for one entry, as floats in order of floats in order."""
        return in_floats(self.graph, _flat(self.inputs), _flat(self.results), self.opaque)

    @functools.cached_property
    def in_jax(self) -> Callable[..., list[Any]]:
        """The program, without opaque computations, as a function of its arguments in JAX, operation by operation."""
        outputs = _flat(self.results)
        ends = np.cumsum([nodes.size for nodes in self.results])[:-1].tolist()

        @jax.jit
        def program(*leaves):
            values: dict[int, Any] = {}
            for nodes, leaf in zip(self.inputs, leaves, strict=True):
                number = leaf if leaf.dtype == bool else leaf.astype(float)  # whole numbers are floats in a graph
                values.update(zip(nodes.ravel().tolist(), jnp.ravel(number), strict=True))
            parts = jnp.split(by_jax(self.graph, outputs, values), ends) if outputs else [jnp.zeros(0)] * len(self.results)
            return [part.reshape(nodes.shape) for part, nodes in zip(parts, self.results, strict=True)]

        return program

    def constants(self, nodes: Nodes) -> np.ndarray:
        """What nodes (…) are whatever the arguments; NaN where that is not constant."""
        graph = self.graph
        entries = [graph.value[node] if graph.is_constant(node) else np.nan for node in nodes.ravel().tolist()]
        return np.array(entries, dtype=float).reshape(nodes.shape)


def _flat(arrays: Iterable[Nodes]) -> list[int]:
    return [node for nodes in arrays for node in nodes.ravel().tolist()]


_written: Memo[Callable] = Memo(128)


def _by_jax(*operands, jaxpr: ClosedJaxpr):
    """By the operations of the scalar program, or as it was traced where it has none."""

    def written() -> Callable:
        try:
            made = ScalarProgram.of(jaxpr)
        except (UnsupportedPrimitive, GraphTooLarge):
            return jaxpr_as_fun(jaxpr)
        return made.in_jax if made.results else jaxpr_as_fun(jaxpr)

    return _written.get(Same(jaxpr), written)(*operands)


program_p = plain_primitive("dirax_program", _by_jax, lambda *_, jaxpr: jaxpr.out_avals)
"""A jaxpr of floats, for JAX by the operations of its scalar program: far fewer than those of derivatives in one another."""
