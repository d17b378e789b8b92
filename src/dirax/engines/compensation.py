"""What a step adds to each component of the state, for compensated summation.

A new state that is written as the old one plus something small gives that something away. A momentum is not: in
p_{k+1} = D2 L_d with p_k + D1 L_d = 0 the old one is in the residual. There p_{k+1} − p_k = D2 L_d + D1 L_d at the
solution, where the large parts cancel on the graph, exactly.
"""

from collections import Counter

from dirax.engines.step_program import TracedEquation
from dirax.program.graph import Graph


def terms(g: Graph, node: int) -> dict[int, float]:
    """A node as a sum of nodes that are no sums, each with its coefficient."""
    found: Counter[int] = Counter()
    stack = [(node, 1.0)]
    while stack:
        node, factor = stack.pop()
        a, b = (*g.args[node], -1, -1)[:2]
        match g.op[node]:
            case "add":
                stack += [(a, factor), (b, factor)]
            case "sub":
                stack += [(a, factor), (b, -factor)]
            case "neg":
                stack.append((a, -factor))
            case "mul" if (c := g.number(a)) is not None and g.op[b] not in ("add", "sub"):
                found[b] += factor * c  # type: ignore[assignment]
            case _:
                found[node] += factor  # type: ignore[assignment]
    return {n: float(c) for n, c in found.items() if c and n != g.zero}


def total(g: Graph, parts: dict[int, float]) -> int:
    """The node of Σ coefficient·node, in the order of the nodes."""
    out = g.zero
    for node, coefficient in sorted(parts.items()):
        out = g.add(out, g.mul(g.constant(coefficient), node))
    return out


def increments(g: Graph, equation: TracedEquation) -> list[int | None]:
    """For each component of the state the node of new minus old, without the old in it; None where it is not found."""
    rows = [terms(g, r) for r in equation.residual]
    out: list[int | None] = []
    for old, new in zip(equation.state, equation.advance, strict=True):
        valid = g.true
        if g.op[new] == "select" and _is_nan(g, g.args[new][2]):  # a scheme marks its domain so
            valid, new, _ = g.args[new]
        parts = terms(g, new)
        if parts.get(old) == 1:
            del parts[old]
            found = total(g, parts)
        else:
            found = _through_residual(g, old, parts, rows)
        out.append(found if found is None else g.select(valid, found, g.constant(float("nan"))))
    return out


def _is_nan(g: Graph, node: int) -> bool:
    value = g.number(node)
    return value is not None and value != value


def _through_residual(g: Graph, old: int, parts: dict[int, float], rows: list[dict[int, float]]) -> int | None:
    for row in rows:
        sign = row.get(old, 0.0)
        if sign not in (1.0, -1.0):
            continue
        combined = {n: parts.get(n, 0.0) + sign * row.get(n, 0.0) for n in {*parts, *row}}
        combined[old] -= 1.0
        left = {n: c for n, c in combined.items() if c}
        if old not in left and len(left) < len(parts) + len(row) - 1:  # something has cancelled
            return total(g, left)
    return None
