"""Derivatives of nodes of the scalar graph, as nodes of it."""

import math

from dirax.program.graph import Graph
from dirax.program.operations import BOOLEAN, STEPWISE


def partials(g: Graph, node: int) -> list[int | None]:
    """The derivative of a node with respect to each of its operands; None where there is none."""
    op, args = g.op[node], g.args[node]
    x = args[0]
    match op:
        case "add":
            return [g.one, g.one]
        case "sub":
            return [g.one, g.constant(-1.0)]
        case "mul":
            return [args[1], x]
        case "neg":
            return [g.constant(-1.0)]
        case "recip":
            return [g.neg(g.mul(node, node))]
        case "abs":
            return [g.select(g.make("lt", x, g.zero), g.constant(-1.0), g.one)]
        case "sqrt":
            return [g.mul(g.constant(0.5), g.recip(node))]
        case "max" | "min":
            first = g.make("le", *(args[::-1] if op == "max" else args))
            return [g.select(first, g.one, g.zero), g.select(first, g.zero, g.one)]
        case "rem":
            return [g.one, g.neg(g.make("trunc", g.div(x, args[1])))]
        case "select":
            return [None, g.select(x, g.one, g.zero), g.select(x, g.zero, g.one)]
        case "pow":
            y = args[1]
            by_x = g.mul(y, g.make("pow", x, g.sub(y, g.one)))
            positive = g.make("lt", g.zero, x)
            by_y = g.select(positive, g.mul(node, g.make("log", g.select(positive, x, g.one))), g.zero)
            return [by_x, None if g.is_constant(y) else by_y]
        case "opaque":
            return list(g.slopes[node])
        case "atan2":
            r = g.recip(g.add(g.mul(x, x), g.mul(args[1], args[1])))
            return [g.mul(args[1], r), g.neg(g.mul(x, r))]
        case _ if op in STEPWISE or op in BOOLEAN:
            return [None] * len(args)
        case _:
            return [_elementary(g, op, x, node)]


def _elementary(g: Graph, op: str, x: int, f: int) -> int:
    """f' of f = op(x)."""
    square = lambda a: g.mul(a, a)
    root = lambda a: g.make("sqrt", a)
    one = g.one
    match op:
        case "sin":
            return g.make("cos", x)
        case "cos":
            return g.neg(g.make("sin", x))
        case "tan":
            return g.add(one, square(f))
        case "asin":
            return g.recip(root(g.sub(one, square(x))))
        case "acos":
            return g.neg(g.recip(root(g.sub(one, square(x)))))
        case "atan":
            return g.recip(g.add(one, square(x)))
        case "sinh":
            return g.make("cosh", x)
        case "cosh":
            return g.make("sinh", x)
        case "tanh":
            return g.sub(one, square(f))
        case "asinh":
            return g.recip(root(g.add(square(x), one)))
        case "acosh":
            return g.recip(root(g.sub(square(x), one)))
        case "atanh":
            return g.recip(g.sub(one, square(x)))
        case "exp":
            return f
        case "exp2":
            return g.mul(g.constant(math.log(2)), f)
        case "expm1":
            return g.add(f, one)
        case "log":
            return g.recip(x)
        case "log1p":
            return g.recip(g.add(one, x))
        case "cbrt":
            return g.recip(g.mul(g.constant(3.0), square(f)))
        case "erf" | "erfc":
            slope = 2 / math.sqrt(math.pi) * (1 if op == "erf" else -1)
            return g.mul(g.constant(slope), g.make("exp", g.neg(square(x))))
    raise AssertionError(f"{op} has no derivative rule")


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
