"""The first step of a run linearized in numbers, from the graph that the native engine compiles."""

from typing import Any

import numpy as np

from dirax.engines.native.program import program
from dirax.program.evaluation.in_numpy import Values, in_parts
from dirax.program.graph import GraphTooLarge
from dirax.program.interpreter import UnsupportedPrimitive

IN_NUMBERS = 2**22
"""Derivatives of nodes up to which a Jacobian is found in numbers, which is quicker once than to write it as nodes."""


def linearized(equation: Any, params: Any, batch_params: bool, u, state, t, h) -> tuple[np.ndarray, np.ndarray] | None:
    """(residual, Jacobian) of the first stage of `equation`, (entries, k) and (entries, k, k), from the graph that the native
    engine compiles; arguments have an axis of entries, `params` with `batch_params`. None where it does not compile the step."""
    try:
        made, _ = program(equation, params, batch_params)
        first, shared, graph, k = made.equations[0], made.shared, made.graph, equation.stages[0][0].unknowns
        few = len(u) * k * len(graph) <= IN_NUMBERS
        entries = [] if few else [row.get(j, graph.zero) for row in made.jacobian(0) for j in range(k)]
    except (UnsupportedPrimitive, GraphTooLarge):
        return None
    graph = graph.copy() if few else graph
    node = lambda nodes: np.asarray(nodes, dtype=np.int64)
    leaves = np.broadcast_to(made.parameters.flatten(params, len(u) if batch_params else None), (len(u), made.parameters.size))

    def part(arguments: list[np.ndarray]) -> list[np.ndarray]:
        known = Values(graph, len(arguments[0]))
        for nodes, array in zip((first.unknowns, first.state, shared.t, shared.h, shared.params), arguments, strict=True):
            known.bind(node(nodes), array)
        slopes = known.slopes(first.residual, first.unknowns) if few else known.read(node(entries).reshape(k, k))
        return [known.read(node(first.residual)), slopes]

    residual, jacobian = in_parts(part, [u, state, t, h, leaves])
    return residual, jacobian
