"""Derivatives of nodes of the scalar graph, as nodes of it; those of one operation are in `operations/`."""

from dirax.program.graph import Graph
from dirax.program.operations import OPERATIONS


def partials(g: Graph, node: int) -> list[int | None]:
    """The derivative of a node with respect to each of its operands; None where there is none."""
    op, args = g.op[node], g.args[node]
    if op == "opaque":
        return list(g.slopes[node])
    rule = OPERATIONS[op].derivative
    return [None] * len(args) if rule is None else rule(g, node, *args)


def jacobian(g: Graph, outputs: list[int], inputs: list[int]) -> list[dict[int, int]]:
    """Rows of ∂outputs/∂inputs as {column: node}, zeros left out: forward over the graph, sparse in the columns."""
    column = {node: j for j, node in enumerate(inputs)}
    rows: dict[int, dict[int, int]] = {}
    none: dict[int, int] = {}
    for node in g.reachable(outputs):
        if node in column:
            rows[node] = {column[node]: g.one}
        else:
            rows[node] = _chain(g, node, rows) if any([rows[a] for a in g.args[node]]) else none
    return [rows[node] for node in outputs]


def _chain(g: Graph, node: int, rows: dict[int, dict[int, int]]) -> dict[int, int]:
    op, args = g.op[node], g.args[node]
    if op == "select":
        yes, no = rows[args[1]], rows[args[2]]
        return {j: g.select(args[0], yes.get(j, g.zero), no.get(j, g.zero)) for j in sorted({*yes, *no})}
    total: dict[int, int] = {}
    for a, slope in zip(args, partials(g, node), strict=True):
        if slope is None:
            continue
        for j, inner in rows[a].items():
            term = g.mul(slope, inner)
            total[j] = g.add(total[j], term) if j in total else term
    return {j: d for j, d in total.items() if d != g.zero}


def gradient(g: Graph, seeds: dict[int, int], inputs: list[int]) -> list[int]:
    """The derivative of Σ seed·node over {node: seed} with respect to each input, backward over the graph."""
    flow = dict(seeds)
    for node in reversed(g.reachable(seeds)):
        if node not in flow or not g.args[node]:
            continue
        for a, slope in zip(g.args[node], partials(g, node), strict=True):
            if slope is not None and (term := g.mul(slope, flow[node])) != g.zero:
                flow[a] = g.add(flow[a], term) if a in flow else term
    return [flow.get(node, g.zero) for node in inputs]


def directional(g: Graph, outputs: list[int], tangents: dict[int, int]) -> list[int]:
    """The derivative of each output along {input: tangent}."""
    rows = {}
    for node in g.reachable(outputs):
        if node in tangents:
            rows[node] = {0: tangents[node]}
        else:
            rows[node] = _chain(g, node, rows) if any(rows[a] for a in g.args[node]) else {}
    return [rows[node].get(0, g.zero) for node in outputs]
