"""Derivatives of nodes of the scalar graph, as nodes of it; those of one operation are in `operations/`."""

import functools

from dirax.program.graph import CONSTANT, Graph
from dirax.program.operations import OPERATIONS, WITH_EDGE


def partials(g: Graph, node: int) -> list[int | None]:
    """The derivative of a node with respect to each of its operands; None where there is none."""
    op, args = g.op[node], g.args[node]
    if op == "opaque":
        return list(g.slopes[node])
    rule = OPERATIONS[op].derivative
    return [None] * len(args) if rule is None else rule(g, node, *args)


def slopes(g: Graph, node: int) -> list[tuple[int, int]]:
    """The nodes on which a node depends, each with the derivative by it; by which it has none is left out.

    No ∞·0 is made at an edge of the domain: a power xⁿ·√x, which is a product, is a power here, and where an operand does not
    move, the derivative by it is zero.
    """
    if (power := g.half_power(node)) is not None:
        root, x, n = power
        return [(x, g.mul(g.constant(n + 0.5), g.mul(g.power(x, n - 1), root)))]
    found = [(a, slope) for a, slope in zip(g.args[node], partials(g, node), strict=True) if slope is not None]
    if g.op[node] in WITH_EDGE:
        return [(a, g.select(at_rest(g, a), g.zero, slope)) for a, slope in found]
    return found


def at_rest(g: Graph, node: int) -> int:
    """The condition, a node, that a node is on a branch, of a choice or a maximum, where it is constant."""
    known = g.at_rest
    for a in g.reachable([node], known):
        op, args = g.op[a], g.args[a]
        if op in CONSTANT:
            known[a] = g.true
        elif op in ("select", "max", "min"):
            x, y = args[-2:]
            first = args[0] if op == "select" else g.make("le", *((y, x) if op == "max" else (x, y)))
            known[a] = g.select(first, known[x], known[y]) if known[x] != known[y] else known[x]
        else:
            known[a] = functools.reduce(functools.partial(g.make, "and"), (known[x] for x in args), g.true if args else g.false)
    return known[node]


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
    for a, slope in slopes(g, node):
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
        for a, slope in slopes(g, node):
            if (term := g.mul(slope, flow[node])) != g.zero:
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
