"""From graph nodes to instructions: emits what a set of nodes needs, where it is first needed.

A `Region` is a stretch of the kernel with the values that are known in it; regions nest, and an inner one sees the outer
one's values. The instructions and their order depend on the graph alone, never on the width, so that every lane of every
width rounds alike: products are fused into sums here and not by LLVM.
"""

from collections import Counter
from collections.abc import Iterable

from dirax.engines.native.functions import exponential, inverse_trigonometric, logarithmic, trigonometric
from dirax.engines.native.functions.trigonometric import Reduced
from dirax.engines.native.ir.emitter import Body, Emitter
from dirax.program.graph import Graph

CIRCULAR = ("sin", "cos", "tan")
COMPARISONS = {"lt": "olt", "le": "ole", "eq": "oeq", "ne": "une"}
INTRINSICS = {"abs": "fabs", "sqrt": "sqrt", "floor": "floor", "ceil": "ceil", "round": "roundeven", "trunc": "trunc"}
FUNCTIONS = {
    "exp": exponential.exp,
    "exp2": exponential.exp2,
    "expm1": exponential.expm1,
    "sinh": exponential.sinh,
    "cosh": exponential.cosh,
    "tanh": exponential.tanh,
    "erf": exponential.erf,
    "erfc": exponential.erfc,
    "log": logarithmic.log,
    "log1p": logarithmic.log1p,
    "pow": logarithmic.power,
    "cbrt": logarithmic.cbrt,
    "asinh": logarithmic.asinh,
    "acosh": logarithmic.acosh,
    "atanh": logarithmic.atanh,
    "atan": inverse_trigonometric.atan,
    "atan2": inverse_trigonometric.atan2,
    "asin": inverse_trigonometric.asin,
    "acos": inverse_trigonometric.acos,
}


class Region:
    """Values of graph nodes in a stretch of the kernel."""

    def __init__(self, emitter: Emitter, graph: Graph, parent: "Region | None" = None):
        self.emitter, self.graph, self.parent = emitter, graph, parent
        self._values: dict[int, str] = {}

    def bind(self, node: int, value: str) -> None:
        self._values[node] = value

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
            if g.op[node] in CIRCULAR:
                if depth[node] > done_circular:
                    done_circular = depth[node]
                    self._circular([n for n in waiting if g.op[n] in CIRCULAR and depth[n] == done_circular])
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
        e, g, op = self.emitter, self.graph, self.graph.op[node]
        args = [self.value(a) for a in g.args[node]]
        match op:
            case "add" | "sub" | "mul" | "neg" | "rem":
                return getattr(e, op)(*args)
            case "recip":
                return e.div(e.const(1.0), args[0])
            case "max" | "min":
                larger = e.compare("ogt" if op == "max" else "olt", *args)
                return e.select(e.either(larger, e.compare("uno", args[0], args[0])), *args)
            case "sign":
                x, zero = args[0], e.const(0.0)
                below = e.select(e.compare("olt", x, zero), e.const(-1.0), x)
                return e.select(e.compare("ogt", x, zero), e.const(1.0), below)
            case "finite":
                return e.compare("olt", e.abs(args[0]), e.const(float("inf")))
            case "select":
                return e.select(*args)
            case "and":
                return e.both(*args)
            case "or":
                return e.either(*args)
            case "not":
                return e.invert(*args)
            case _ if op in COMPARISONS:
                if g.is_boolean(g.args[node][0]):
                    raise AssertionError("booleans are compared by logic")
                return e.compare(COMPARISONS[op], *args)
            case _ if op in INTRINSICS:
                return e.intrinsic(INTRINSICS[op], *args)
        return FUNCTIONS[op](e, *args)

    # ------------------------------------------------------------------ sines and cosines, a group at a time

    def _circular(self, nodes: list[int]) -> None:
        """The sines, cosines and tangents of one depth; in scalar code their arguments share vectors."""
        g, e = self.graph, self.emitter
        arguments = sorted({g.args[n][0] for n in nodes})
        values = [self.value(a) for a in arguments]
        group = Emitter(e.body, _group_width(len(values))) if e.width == 1 else e
        packed = values
        if group.width > 1 and e.width == 1:
            padded = values + values[:1] * (-len(values) % group.width)
            packed = [group.pack(padded[i : i + group.width]) for i in range(0, len(padded), group.width)]
        reductions = reduce_all(group, packed)
        wanted = {(g.op[n], g.args[n][0]): n for n in nodes}
        for i, r in enumerate(reductions):
            here = arguments[i * group.width : (i + 1) * group.width] if e.width == 1 else arguments[i : i + 1]
            needed = {op for op, a in wanted if a in here}
            s = trigonometric.sine_kernel(group, r) if needed & {"sin", "cos"} else ""
            c = trigonometric.cosine_kernel(group, r) if needed & {"sin", "cos"} else ""
            makers = {
                "sin": lambda r=r, s=s, c=c: trigonometric.sine(group, r, s, c),
                "cos": lambda r=r, s=s, c=c: trigonometric.cosine(group, r, s, c),
                "tan": lambda r=r: trigonometric.tangent(group, r),
            }
            for op in sorted(needed):
                result = makers[op]()
                for lane, a in enumerate(here):
                    if (op, a) in wanted:
                        single = group.extract(result, lane) if e.width == 1 else result
                        self.bind(wanted[op, a], single)


def _group_width(count: int) -> int:
    return 1 if count == 1 else 2 if count == 2 else 4 if count <= 4 else 8


def reduce_all(e: Emitter, values: list[str]) -> list[Reduced]:
    """The reductions of several arguments, with one branch for all of them to the slow way."""
    body: Body = e.body
    near = [trigonometric.reduce_near(e, x) for x in values]
    far = e.false
    for x in values:
        far = e.either(far, trigonometric.is_far(e, x))
    before, slow, join = body.block, body.fresh(), body.fresh()
    body.branch_if(e.any(far), slow, join)
    body.label(slow)
    count = len(values)
    columns = [values, *([getattr(r, part) for r in near] for part in ("high", "low", "quadrant"))]
    kinds = (e.real, e.real, e.real, e.int)
    memory = [body.alloca(kind, count) for kind in kinds]
    for kind, place, column in zip(kinds, memory, columns, strict=True):
        for i, value in enumerate(column):
            body.store(kind, value, body.at(kind, place, i))
    pointers = ", ".join(f"ptr {m}" for m in memory)
    body.line(f"call void @{trigonometric.FAR_NAME}({pointers}, i64 {count * e.width})")
    after = [
        [body.load(kind, body.at(kind, place, i)) for i in range(count)]
        for kind, place in zip(kinds[1:], memory[1:], strict=True)
    ]
    body.branch(join)
    body.label(join)
    merged = [
        [body.put(f"phi {kind} [ {old}, %{before} ], [ {new}, %{slow} ]") for old, new in zip(column, changed, strict=True)]
        for kind, column, changed in zip(kinds[1:], columns[1:], after, strict=True)
    ]
    return [Reduced(*parts) for parts in zip(*merged, strict=True)]
