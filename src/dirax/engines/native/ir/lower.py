"""From graph nodes to instructions: which nodes are computed where, and in what order.

A `Region` is a stretch of the kernel with the values that are known in it; regions nest, and an inner one sees the outer
one's values. What an operation is in instructions stands in `dirax.engines.native.functions`. The instructions and their order
depend on the graph alone, never on the width, so that every lane of every width rounds alike: products are fused into sums
here and not by LLVM.
"""

from collections import Counter
from collections.abc import Callable, Iterable

from dirax.engines.native.functions import MACHINE_CODE, trigonometric
from dirax.engines.native.ir.emitter import Emitter
from dirax.program.graph import Graph
from dirax.program.operations import OPERATIONS

CIRCULAR = tuple(trigonometric.MACHINE_CODE)
"""Operations that are made together, for all arguments that are known at the same time."""


class Region:
    """Values of graph nodes in a stretch of the kernel."""

    def __init__(self, emitter: Emitter, graph: Graph, parent: "Region | None" = None):
        self.emitter, self.graph, self.parent = emitter, graph, parent
        self._values: dict[int, str] = {}

    def bind(self, node: int, value: str) -> None:
        self._values[node] = value

    @property
    def values(self) -> dict[int, str]:
        """What was bound or emitted in this region itself."""
        return self._values

    def operands_of(self, outputs: Iterable[int]) -> list[int]:
        """The nodes of this region itself from which the outputs follow, with the inputs that are not known yet."""
        outputs = list(outputs)
        asked = {a for node in self._missing(outputs) for a in self.graph.args[node]}
        return sorted(node for node in asked.union(outputs) if node in self._values)

    def known(self, node: int) -> str | None:
        """The value of a node, if this region or one around it has it."""
        region: Region | None = self
        while region is not None:
            if node in region._values:
                return region._values[node]
            region = region.parent
        return None

    def value(self, node: int) -> str:
        """The value of a node that `require` has made known, or of a constant."""
        g = self.graph
        if g.op[node] == "const":
            return self.emitter.const(float(g.value[node]))
        if g.op[node] == "bool":
            return self.emitter.boolean(bool(g.value[node]))
        found = self.known(node)
        assert found is not None, f"node {node} ({g.op[node]} {g.value.get(node, '')}) is not known here"
        return found

    def require(self, outputs: Iterable[int]) -> None:
        """Emit what is still missing of the outputs."""
        outputs = list(outputs)
        missing = self._missing(outputs)
        g, uses, members = self.graph, Counter(outputs), set(missing)
        for node in missing:
            uses.update(g.args[node])
        single = lambda node, op: g.op[node] == op and uses[node] == 1 and self.known(node) is None
        divisions, fused = {}, set()
        for node in missing:
            if g.op[node] == "mul":
                for k, a in enumerate(g.args[node]):
                    if single(a, "recip") and a in members:
                        divisions[node] = (g.args[node][1 - k], g.args[a][0])
                        fused.add(a)
                        break
        products = {}
        for node in missing:
            if g.op[node] in ("add", "sub"):
                for k, a in enumerate(g.args[node]):
                    if single(a, "mul") and a in members and a not in divisions:
                        products[node] = k
                        fused.add(a)
                        break
        depth = self._depths(missing)
        waiting = sorted((n for n in missing if n not in fused), key=lambda n: (depth[n], g.op[n] not in CIRCULAR, n))
        done_circular = 0
        for node in waiting:
            self.emitter.body.go_on()
            if g.op[node] in CIRCULAR:
                if depth[node] > done_circular:
                    done_circular = depth[node]
                    self._together([n for n in waiting if g.op[n] in CIRCULAR and depth[n] == done_circular])
            elif node in divisions:
                a, b = divisions[node]
                self.bind(node, self.emitter.div(self.value(a), self.value(b)))
            elif node in products:
                self.bind(node, self._fused(node, products[node]))
            else:
                self.bind(node, self._instruction(node))

    def _missing(self, outputs: list[int]) -> list[int]:
        seen, stack = set(), list(outputs)
        while stack:
            node = stack.pop()
            if node in seen or self.graph.is_constant(node) or self.known(node) is not None:
                continue
            seen.add(node)
            stack.extend(self.graph.args[node])
        return sorted(seen)

    def _depths(self, missing: list[int]) -> dict[int, int]:
        """How many sines and cosines lie one inside the other below a node."""
        depth: dict[int, int] = {}
        for node in missing:
            below = max((depth.get(a, 0) for a in self.graph.args[node]), default=0)
            depth[node] = below + (self.graph.op[node] in CIRCULAR)
        return depth

    def _fused(self, node: int, k: int) -> str:
        e, g = self.emitter, self.graph
        a, b = (self.value(x) for x in g.args[g.args[node][k]])
        other = self.value(g.args[node][1 - k])
        if g.op[node] == "add":
            return e.fma(a, b, other)
        return e.fma(e.neg(a), b, other) if k == 1 else e.fma(a, b, e.neg(other))

    def _instruction(self, node: int) -> str:
        op, args = self.graph.op[node], [self.value(a) for a in self.graph.args[node]]
        formula = OPERATIONS[op].formula
        return by_formula(self.emitter, formula, args) if formula else MACHINE_CODE[op](self.emitter, *args)

    def _together(self, nodes: list[int]) -> None:
        """The sines, cosines and tangents of one depth."""
        g = self.graph
        arguments = sorted({g.args[n][0] for n in nodes})
        wanted = {(g.args[n][0], g.op[n]): n for n in nodes}
        names = [{op for a, op in wanted if a == argument} for argument in arguments]
        made = trigonometric.together(self.emitter, names, [self.value(a) for a in arguments])
        for argument, results in zip(arguments, made, strict=True):
            for op, value in results.items():
                self.bind(wanted[argument, op], value)


def by_formula(e: Emitter, formula: Callable[..., int], operands: list[str]) -> str:
    """The value of a formula of operations that have machine code."""
    g = Graph()
    inputs = [g.input(f"x{i}") for i in range(len(operands))]
    region = Region(e, g)
    for node, value in zip(inputs, operands, strict=True):
        region.bind(node, value)
    result = formula(g, *inputs)
    region.require([result])
    return region.value(result)
