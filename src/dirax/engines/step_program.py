"""StepProgram: a step as one scalar program, of its functions traced at the flat sizes; what every engine asks of it."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import ClosedJaxpr

import dirax.program.rules  # noqa: F401  (registers the rules)
from dirax.engines import policy
from dirax.engines.blocks import blocks
from dirax.engines.parameters import Parameters, parameters
from dirax.engines.step_jaxpr import step_jaxpr
from dirax.program.counts import array_operations, nesting
from dirax.program.equal_nodes import without_equals
from dirax.program.evaluation.by_jax import by_jax
from dirax.program.evaluation.in_floats import Floats, in_floats
from dirax.program.evaluation.in_levels import in_levels
from dirax.program.evaluation.in_numpy import Slopes, Values, in_parts
from dirax.program.graph import NODE_LIMIT, Graph, GraphTooLarge, Order, with_ends
from dirax.program.graph_derivatives import jacobian
from dirax.program.interpreter import Nodes, Rule, UnsupportedPrimitive
from dirax.program.memo import Memo, Same
from dirax.program.rules.differentiable import DIFFERENTIABLE, has_rules
from dirax.program.scalar_program import ScalarProgram

DERIVED = 4
"""Nodes of Jacobians, as a multiple of the limit of the graph, of which those that are left are counted that are not equal."""

KEPT = 128
"""Programs kept in memory."""

IN_NUMBERS = 2**22
"""Derivatives of nodes up to which a Jacobian is found in numbers, which is quicker once than to write it as nodes."""

SWEPT = 30_000
"""Products of derivatives from which on it takes a second to write a Jacobian as nodes, and one in numbers is found by sweeps."""

FULL = 3
"""A block of a Jacobian is full of which one entry in so many may differ from zero."""

WRITTEN = 50_000
"""Unknowns times nodes of a step up to which its Jacobian is written as nodes for one entry in floats."""


@dataclass
class TracedEquation:
    """One StepEquation as nodes: inputs and outputs of its functions."""

    state: list[int]
    unknowns: list[int]
    previous: list[int]
    guess: list[int]
    residual: list[int]
    advance: list[int]
    rows: dict[str, Nodes]
    nesting: int
    """How deep derivatives of derivatives go in its functions."""
    array_operations: float
    """How many operations on arrays they are for XLA."""
    jaxpr: ClosedJaxpr
    weak: tuple[tuple[range, range], ...] = ()
    """(rows, columns) of the Jacobian that Newton's method may leave out."""


@dataclass
class Inputs:
    """The scalars that every equation of a step shares."""

    t: int
    h: int
    params: list[int]


def inputs(g: Graph, size: int) -> Inputs:
    """The nodes of t, h and `size` parameters."""
    return Inputs(g.input("t"), g.input("h"), [g.input(f"param{i}") for i in range(size)])


def trace(g: Graph, shared: Inputs, equation: Any, p: Parameters) -> TracedEquation:
    """The nodes of one equation, which is traced once, whether alone or as a part of compositions. Raises
    `UnsupportedPrimitive`."""
    closed, s, k = step_jaxpr(equation, p), equation.state_size, equation.unknowns
    return _nodes(g, shared, closed, tuple(sorted(equation.fields)), s, k, p, equation.weak)


def _nodes(
    g: Graph, shared: Inputs, closed: ClosedJaxpr, names: tuple[str, ...], s: int, k: int, p: Parameters, weak: tuple,
    rules: Mapping[str, Rule] | None = None,
) -> TracedEquation:  # fmt: skip
    state = [g.input(f"state{i}") for i in range(s)]
    unknowns = [g.input(f"u{i}") for i in range(k)]
    previous = [g.input(f"previous{i}") for i in range(k)]
    ids = lambda nodes, shape=None: np.array(nodes, dtype=np.int64).reshape((len(nodes),) if shape is None else shape)
    leaves, at = [], 0
    for shape in p.shapes:
        count = int(np.prod(shape))
        leaves.append(ids(shared.params[at : at + count], shape))
        at += count
    arguments = [ids(unknowns), ids(state), ids(previous), ids(shared.t, ()), ids(shared.h, ()), *leaves]
    program, for_arrays = ScalarProgram(g, arguments), array_operations(closed.jaxpr, policy.MORE_FOR_XLA)
    g.limit = max(g.limit, len(g) + policy.most_traced(for_arrays))
    try:
        program.run(closed, rules)
    except GraphTooLarge as error:
        raise UnsupportedPrimitive("the step as a whole", f"has {error}", "see docs/native-engine.md") from None
    guess, residual, advance, *rows = program.results
    if len(rows) != len(names):
        raise UnsupportedPrimitive("unpack", f"returns {len(rows)} arrays for {len(names)} fields", "the scheme")
    return TracedEquation(
        state, unknowns, previous, guess.tolist(), residual.tolist(), advance.tolist(),
        dict(zip(names, rows, strict=True)), nesting(closed.jaxpr),
        for_arrays, closed, weak,
    )  # fmt: skip


@dataclass(eq=False)
class StepProgram:
    """A step as nodes of one graph: its distinct equations, and for each stage which of them it solves and its fraction of h.

    The graph gains Jacobians alone, which are always the same nodes; what else is to be added goes to a copy.
    """

    graph: Graph
    shared: Inputs
    equations: list[TracedEquation]
    stages: list[tuple[int, float]]
    parameters: Parameters
    size: int = field(init=False)
    """Nodes of the step without its Jacobians."""

    def __post_init__(self):
        self.size = len(self.graph)

    @classmethod
    def of(cls, equation: Any, p: Parameters) -> "StepProgram":
        """The program of a StepEquation or a StepSequence. Raises `UnsupportedPrimitive`."""
        graph = Graph(NODE_LIMIT)
        shared = inputs(graph, p.size)
        distinct: list[Any] = []
        stages = []
        for stage, fraction in equation.stages:
            index = next((i for i, other in enumerate(distinct) if other is stage), len(distinct))
            distinct += [stage] if index == len(distinct) else []
            stages.append((index, float(fraction)))
        return cls(graph, shared, [trace(graph, shared, stage, p) for stage in distinct], stages, p)

    @cached_property
    def differentiable(self) -> "StepProgram":
        """The same in a graph whose derivatives are those of JAX, where functions have rules of their own for them: in its own
        graph such functions are what they are made of, as Newton's method needs them. Raises `UnsupportedPrimitive`."""
        if not any(has_rules(e.jaxpr.jaxpr) for e in self.equations):
            return self
        graph, p = Graph(DERIVED * self.graph.limit), self.parameters
        shared = inputs(graph, p.size)
        of = lambda e: (e.jaxpr, tuple(sorted(e.rows)), len(e.state), len(e.unknowns), p, e.weak, DIFFERENTIABLE)
        return StepProgram(graph, shared, [_nodes(graph, shared, *of(e)) for e in self.equations], self.stages, p)

    @property
    def nested(self) -> bool:
        """Whether derivatives lie in one another so deep that an array program is far larger than the graph."""
        return self.nesting >= policy.NESTED

    @property
    def nesting(self) -> int:
        """How deep derivatives of derivatives go in it."""
        return max(e.nesting for e in self.equations)

    @property
    def array_operations(self) -> float:
        """How many operations on arrays the step is for XLA."""
        return sum(e.array_operations for e in self.equations)

    @property
    def jacobians(self) -> list[list[dict[int, int]]]:
        """The rows {column: node} of the Jacobian of every equation's residual. Raises `GraphTooLarge`."""
        if isinstance(self._jacobians, GraphTooLarge):
            raise GraphTooLarge(str(self._jacobians))
        return self._jacobians

    @cached_property
    def _jacobians(self) -> list[list[dict[int, int]]] | GraphTooLarge:
        """The same, or that they are too large, which takes long to find."""
        every = self.graph.copy(DERIVED * self.graph.limit)
        try:
            found = [jacobian(every, e.residual, e.unknowns) for e in self.equations]
            wanted = [node for rows in found for row in rows for node in row.values()]
            entries = iter(without_equals(self.graph, every, wanted))
        except GraphTooLarge as error:
            return error.with_traceback(None)
        kept = [[{j: next(entries) for j in row} for row in rows] for rows in found]
        return [[{j: node for j, node in row.items() if node != self.graph.zero} for row in rows] for rows in kept]

    @cached_property
    def is_swept(self) -> bool:
        """Whether Jacobians are found in numbers by sweeps over the graph, where they would be too many nodes."""
        return max(self.graph.products(e.residual, e.unknowns) for e in self.equations) > SWEPT

    @cached_property
    def full(self) -> int:
        """Rows of the largest of the blocks that Jacobians are eliminated by, of those that are full; 0 for none."""
        there = [self.graph.dependence(e.residual, e.unknowns) for e in self.equations]
        each = [(len(rows), one[np.ix_(rows, columns)]) for one in there if one.size for rows, columns in blocks(one)]
        return max((size for size, block in each if FULL * np.sum(block) > block.size), default=0)

    @property
    def least_operations(self) -> int:
        """Those that the elimination of such a block takes at least, that of a symmetric matrix."""
        return self.full**3 // 6

    @cached_property
    def entries(self) -> int:
        """Operations of the step for each column of a stage's Jacobian: about those of its sizes written as nodes."""
        return max(len(e.unknowns) for e in self.equations) * self.size

    @property
    def sizes_are_written(self) -> bool:
        """Whether the step is small enough for its sizes to be written as nodes."""
        return self.entries <= WRITTEN

    @cached_property
    def first_slopes(self) -> Slopes:
        """How the derivatives of the first stage's residual by the unknowns are found in numbers, in a graph of their own."""
        first = self.equations[self.stages[0][0]]
        return Slopes(self.graph.copy(), first.residual, first.unknowns)

    @cached_property
    def first_entries(self) -> tuple[Nodes, Order]:
        """The columns of the first stage's Jacobian and its residual (k + 1, k), and an order for them that gives the memory of
        what is not needed any more to what comes."""
        index, g = self.stages[0][0], self.graph
        rows, residual = self.jacobians[index], self.equations[index].residual
        read = [*(row.get(j, g.zero) for j in range(len(rows)) for row in rows), *residual]
        (order,) = with_ends(g, [(g.reachable(read), read)])
        return nodes_array(read).reshape(-1, len(rows)), order

    @cached_property
    def first_in_floats(self) -> Floats:
        """(unknowns, state, t, h, params) ↦ residual and Jacobian of the first stage, for one entry, all of them in one row."""
        first, shared = self.equations[self.stages[0][0]], self.shared
        inputs = [*first.unknowns, *first.state, shared.t, shared.h, *shared.params]
        if (tape := self.first_slopes.tape) is not None:
            places = [inputs.index(node) for node in tape.numbers.inputs]

            def function(given: Sequence[float]) -> tuple[float, ...]:
                residual, slopes = tape(np.array([given], float)[:, places])
                return *residual[0].tolist(), *slopes.ravel().tolist()

            return function
        entries = [row.get(j, self.graph.zero) for row in self.jacobians[self.stages[0][0]] for j in range(len(first.unknowns))]
        return in_floats(self.graph, inputs, [*first.residual, *entries])

    def in_jax(self, index: int, outputs: list[int], graph: Graph | None = None) -> Callable:
        """(u, state, t, h, params) ↦ nodes of an equation as one array, of this graph or a copy of it with more nodes."""
        equation, g, shared = self.equations[index], graph or self.graph, self.shared

        def function(u, state, t, h, params):
            numbers = [x for leaf in self._moving(params) for x in leaf]
            values: dict[int, Any] = {shared.t: jnp.asarray(t, float), shared.h: jnp.asarray(h, float)}
            values.update(zip(shared.params, numbers, strict=True))
            values.update(zip([*equation.unknowns, *equation.state], [*u, *state], strict=True))
            return by_jax(g, outputs, values)

        return jax.jit(function)  # so that JAX traces it once for all the places that a loop has it in

    def in_levels(self, index: int, outputs: list[int]) -> Callable:
        """The same, equal operations of one depth at once."""
        equation, shared = self.equations[index], self.shared
        inputs = [*equation.unknowns, *equation.state, shared.t, shared.h, *shared.params]
        by_level = in_levels(self.graph, inputs, outputs)

        def function(u, state, t, h, params):
            clock = jnp.stack([jnp.asarray(t, float), jnp.asarray(h, float)])
            return by_level(jnp.concatenate([u, state, clock, *self._moving(params)]))

        return jax.jit(function)

    def _moving(self, params: Any) -> list[Any]:
        """The floating leaves, flat."""
        leaves = zip(jax.tree.leaves(params), self.parameters.dynamic, strict=True)
        return [jnp.ravel(jnp.asarray(leaf, float)) for leaf, moves in leaves if moves]

    def linearized(self, params: Any, batch_params: bool, u, state, t, h) -> tuple[np.ndarray, np.ndarray]:
        """(residual, Jacobian) of the first stage in numbers, (entries, k) and (entries, k, k); arguments have an axis of
        entries, `params` with `batch_params`. Raises `GraphTooLarge`."""
        index, graph = self.stages[0][0], self.graph
        e = self.equations[index]
        few = len(u) * len(e.unknowns) * len(graph) <= IN_NUMBERS
        plan = self.first_slopes if few else None

        def read(known: Values) -> list[np.ndarray]:
            if plan is None:
                both = known.read(*self.first_entries)
                return [both[:, -1], both[:, :-1].swapaxes(1, 2)]
            slopes = known.slopes(e.residual, e.unknowns, plan)
            return [known.read(nodes_array(e.residual)), slopes]

        leaves = self.parameters.flatten(params, len(u) if batch_params else None)
        residual, slopes = self.in_numbers(read, plan.graph if plan else graph, e, u, state, t, h, leaves)
        return residual, slopes

    def in_numbers(
        self, read: Callable[[Values], list[np.ndarray]], graph: Graph, e: TracedEquation, *arguments, more: Sequence = ()
    ) -> list[np.ndarray]:
        """What `read` reads of a graph that begins as that of the step; u, state, t, h, parameters, and what there is `more`,
        pairs of nodes and values, have an axis of entries."""
        shared, others = self.shared, [nodes for nodes, _ in more]
        inputs = [nodes_array(nodes) for nodes in (e.unknowns, e.state, shared.t, shared.h, shared.params, *others)]

        def part(arguments: list[np.ndarray]) -> list[np.ndarray]:
            known = Values(graph, len(arguments[0]))
            for nodes, array in zip(inputs, arguments, strict=True):
                known.bind(nodes, array)
            return read(known)

        *first, leaves = arguments
        leaves = np.broadcast_to(leaves, (len(first[0]), self.parameters.size))
        return in_parts(part, [*first, leaves, *(values for _, values in more)])


def nodes_array(nodes: Any) -> Nodes:
    """Nodes in an array, also none."""
    return np.asarray(nodes, dtype=np.int64)


_programs: Memo[StepProgram | UnsupportedPrimitive] = Memo(KEPT)


def step_program(equation: Any, params: Any, batch_params: bool) -> StepProgram:
    """The program of a step, the same object for the same equation and parameters of one kind. Raises `UnsupportedPrimitive`."""
    p = parameters(params, batch_params)

    def made() -> StepProgram | UnsupportedPrimitive:
        try:
            return StepProgram.of(equation, p)
        except UnsupportedPrimitive as error:
            return error.with_traceback(None)

    found = _programs.get((Same(equation), p.key), made)
    if isinstance(found, UnsupportedPrimitive):
        raise UnsupportedPrimitive(found.primitive, found.reason, found.line)
    return found


def linearized(equation: Any, params: Any, batch_params: bool, u, state, t, h) -> tuple[np.ndarray, np.ndarray] | None:
    """`StepProgram.linearized`; None for a step that is no scalar program."""
    try:
        return step_program(equation, params, batch_params).linearized(params, batch_params, u, state, t, h)
    except (UnsupportedPrimitive, GraphTooLarge):
        return None
