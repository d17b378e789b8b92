"""Functions of a few numbers through the scalar graph and NumPy: nothing is compiled, which is quicker where they run once.

What the graph has no nodes for (a singular value decomposition, a loop whose length depends on its values) is computed by
NumPy between two parts of the graph.
"""

import functools
import math
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import jax
import numpy as np
from jax.core import Tracer

from dirax.engines.native.graph import Graph, GraphTooLarge
from dirax.engines.native.interpret import RULES, Interpreter, Nodes, Unavailable, Unsupported, UnsupportedPrimitive
from dirax.engines.native.program import program
from dirax.engines.native.reductions import factors_of_product
from dirax.engines.native.trace import NODE_LIMIT
from dirax.tracing import in_scalars

KEPT = 128
"""Functions kept in memory."""

LARGE_PRODUCT = 256
"""Multiplications of a product of arrays from which on it is no graph of them."""

LANES = 1024
"""Entries of a batch that are computed at a time, which bounds the memory that the nodes' values take."""


class Values:
    """What nodes of a graph are at some entries; operands are computed where something needs them."""

    def __init__(self, graph: Graph, entries: int):
        self.graph, self.entries, self._known = graph, entries, {}

    def bind(self, nodes: Nodes, array: np.ndarray) -> None:
        """Nodes (…) are the entries of `array` (entries, …)."""
        columns = np.asarray(array, dtype=np.float64).reshape(self.entries, -1).T
        self._known.update(zip(nodes.ravel().tolist(), columns, strict=True))

    def read(self, nodes: Nodes) -> np.ndarray:
        """The values of nodes (…), an array (entries, …)."""
        table = np.empty((nodes.size, self.entries))
        with np.errstate(all="ignore"):
            for row, value in enumerate(self.graph.evaluate(nodes.ravel().tolist(), {}, values=self._known)):
                table[row] = value
        return table.T.reshape(self.entries, *nodes.shape)


def in_parts(function: Callable, leaves: list[np.ndarray]) -> list[np.ndarray]:
    """`function` on LANES entries of the leaves at a time."""
    parts = [function([leaf[low : low + LANES] for leaf in leaves]) for low in range(0, len(leaves[0]), LANES)]
    return parts[0] if len(parts) == 1 else [np.concatenate(pieces) for pieces in zip(*parts, strict=True)]


@dataclass
class Opaque:
    """A computation between nodes that is no node: arrays (entries, …) of the operands to those of the results."""

    operands: list[Nodes]
    results: list[Nodes]
    function: Callable[[list[np.ndarray]], list[np.ndarray]]


@dataclass
class HostFunction:
    """A jaxpr as a graph: arrays of input nodes, the nodes of its results, and what is computed between nodes."""

    inputs: list[Nodes]
    results: list[Nodes] = field(default_factory=list)
    opaque: list[Opaque] = field(default_factory=list)
    graph: Graph = field(default_factory=lambda: Graph(NODE_LIMIT))

    def __call__(self, leaves: list[np.ndarray]) -> list[np.ndarray]:
        """The results for arguments (entries, …), with that leading axis."""
        return in_parts(self._part, leaves)

    def _part(self, leaves: list[np.ndarray]) -> list[np.ndarray]:
        known = Values(self.graph, len(leaves[0]))
        for nodes, leaf in zip(self.inputs, leaves, strict=True):
            known.bind(nodes, leaf)
        for step in self.opaque:
            for nodes, array in zip(step.results, step.function([known.read(o) for o in step.operands]), strict=True):
                known.bind(nodes, array)
        return [known.read(nodes) for nodes in self.results]

    def fresh(self, shape: tuple[int, ...]) -> Nodes:
        """New input nodes."""
        first = len(self.graph)
        return np.array([self.graph.input(f"x{first + i}") for i in range(int(np.prod(shape)))], np.int64).reshape(shape)

    def between(self, operands: list[Nodes], shapes: list[tuple[int, ...]], function: Callable) -> list[Nodes]:
        """The nodes of the results of an opaque computation."""
        self.opaque.append(Opaque(operands, [self.fresh(shape) for shape in shapes], function))
        return self.opaque[-1].results


def interpreted(jaxpr: Any) -> HostFunction:
    """A closed jaxpr as a HostFunction. Raises `UnsupportedPrimitive` and `GraphTooLarge`."""
    made = HostFunction([])
    made.inputs = [made.fresh(v.aval.shape) for v in jaxpr.jaxpr.invars]
    own = (("svd", _svd), ("eigh", _eigh), ("while", _while), ("dot_general", _dot_general))
    rules = {name: functools.partial(rule, made) for name, rule in own}
    made.results = Interpreter(made.graph, rules).run(jaxpr, *made.inputs)
    for result in made.results:
        if isinstance(result, Unavailable):
            raise result.error
    return made


def _dot_general(made: HostFunction, interpreter: Interpreter, equation: Any, a: Nodes, b: Nodes) -> list[Nodes]:
    """Large products stay products of arrays; summed in one order, so that an entry's bits do not depend on the others."""
    shape, (rows, columns) = equation.outvars[0].aval.shape, factors_of_product(equation, a, b)
    length = rows.shape[-1]
    if math.prod(shape) * length < LARGE_PRODUCT or equation.outvars[0].aval.dtype != np.float64:
        return list(RULES["dot_general"](interpreter, equation, a, b))
    left, right = np.moveaxis(rows, -1, 0)[..., None], np.moveaxis(columns, -1, 0)[:, :, None]

    def product(arrays: list[np.ndarray]) -> list[np.ndarray]:
        x, y = arrays
        with np.errstate(all="ignore"):
            total = x[:, 0] * y[:, 0]
            for k in range(1, length):
                total = total + x[:, k] * y[:, k]
        return [total.reshape(len(x), *shape)]

    return made.between([left, right], [shape], product)


def _svd(made: HostFunction, interpreter: Interpreter, equation: Any, matrix: Nodes) -> list[Nodes]:
    p = equation.params
    if p.get("subset_by_index") is not None:
        raise Unsupported("finds some singular values only")

    def decompose(operands: list[np.ndarray]) -> list[np.ndarray]:
        (a,) = operands
        good = np.all(np.isfinite(a), axis=(-2, -1))[..., None, None]
        found = np.linalg.svd(np.where(good, a, 0.0), full_matrices=p["full_matrices"])
        left, values, right = (np.where(good if x.ndim == a.ndim else good[..., 0], x, np.nan) for x in found)
        return [values, left, right] if p["compute_uv"] else [values]

    return made.between([matrix], [v.aval.shape for v in equation.outvars], decompose)


def _eigh(made: HostFunction, interpreter: Interpreter, equation: Any, matrix: Nodes) -> list[Nodes]:
    p = equation.params
    if p.get("subset_by_index") is not None:
        raise Unsupported("finds some eigenvalues only")

    def decompose(operands: list[np.ndarray]) -> list[np.ndarray]:
        (a,) = operands
        good = np.all(np.isfinite(a), axis=(-2, -1))[..., None, None]
        values, vectors = np.linalg.eigh(np.where(good, a, 0.0), UPLO="L" if p["lower"] else "U")
        return [np.where(good, vectors, np.nan), np.where(good[..., 0], values, np.nan)]

    return made.between([matrix], [v.aval.shape for v in equation.outvars], decompose)


def _while(made: HostFunction, interpreter: Interpreter, equation: Any, *operands: Nodes) -> list[Nodes]:
    try:
        return list(RULES["while"](interpreter, equation, *operands))
    except Unsupported:
        pass
    if lost := next((o for o in operands if isinstance(o, Unavailable)), None):
        return [lost] * len(equation.outvars)
    p = equation.params
    condition, body = interpreted(p["cond_jaxpr"]), interpreted(p["body_jaxpr"])
    a, b = p["cond_nconsts"], p["cond_nconsts"] + p["body_nconsts"]

    def loop(arrays: list[np.ndarray]) -> list[np.ndarray]:
        for_condition, for_body, carry = arrays[:a], arrays[a:b], arrays[b:]
        while True:
            going = condition([*for_condition, *carry])[0] != 0
            if not np.any(going):
                return carry
            after = body([*for_body, *carry])
            carry = [np.where(going.reshape(-1, *(1,) * (x.ndim - 1)), x, y) for x, y in zip(after, carry, strict=True)]

    return made.between(list(operands), [v.aval.shape for v in equation.outvars], loop)


_functions: OrderedDict[tuple, tuple[Any, tuple[HostFunction, Any] | None]] = OrderedDict()


def on_host(function: Callable, leaves: list[np.ndarray], kept: tuple, key: Any = None) -> Any:
    """`function(*arguments)` for each entry of `leaves`, arguments (entries, …): a pytree of arrays with that leading axis.

    None where the function has a primitive for which there is no rule, or closes over values that JAX traces. What was
    traced is remembered by the identity of the objects `kept`, on which `function` may depend, and by `key`.
    """
    shapes = [jax.ShapeDtypeStruct(leaf.shape[1:], leaf.dtype) for leaf in leaves]
    known = (*map(id, kept), key, *((s.shape, s.dtype.str) for s in shapes))
    if known not in _functions:
        _functions[known] = kept, _traced(function, shapes)
        if len(_functions) > KEPT:
            _functions.popitem(last=False)
    _functions.move_to_end(known)
    made = _functions[known][1]
    return None if made is None else jax.tree.unflatten(made[1], made[0](leaves))


def _traced(function: Callable, shapes: list[jax.ShapeDtypeStruct]) -> tuple[HostFunction, Any] | None:
    with in_scalars():
        closed, result = jax.make_jaxpr(function, return_shape=True)(*shapes)
    if any(isinstance(c, Tracer) for c in closed.consts):
        return None
    try:
        return interpreted(closed), jax.tree.structure(result)
    except (UnsupportedPrimitive, GraphTooLarge):
        return None


def linearized(equation: Any, params: Any, batch_params: bool, u, state, t, h) -> tuple[np.ndarray, np.ndarray] | None:
    """(residual, Jacobian) of the first stage of `equation`, (entries, k) and (entries, k, k), from the graph that the native
    engine compiles; arguments have an axis of entries, `params` with `batch_params`. None where it does not compile the step."""
    try:
        made, _ = program(equation, params, batch_params)
        first = made.equations[0]
        rows = made.jacobian(0)
    except (UnsupportedPrimitive, GraphTooLarge):
        return None
    k, node = len(first.unknowns), lambda nodes: np.asarray(nodes, dtype=np.int64)
    entries = node([[row.get(j, made.graph.zero) for j in range(k)] for row in rows]).reshape(k, k)
    leaves = np.broadcast_to(made.parameters.flatten(params, len(u) if batch_params else None), (len(u), made.parameters.size))
    shared = made.shared

    def part(arguments: list[np.ndarray]) -> list[np.ndarray]:
        known = Values(made.graph, len(arguments[0]))
        for nodes, array in zip((first.unknowns, first.state, shared.t, shared.h, shared.params), arguments, strict=True):
            known.bind(node(nodes), array)
        return [known.read(node(first.residual)), known.read(entries)]

    residual, jacobian = in_parts(part, [u, state, t, h, leaves])
    return residual, jacobian
