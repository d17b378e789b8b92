"""Newton's method for all nodes of a collocation step together, with one Jacobian, in the eigenbasis of A: for each pair of
eigenvalues of A a complex linear system of the size of one node."""

from abc import abstractmethod

from dirax.engines.native.ir.lower import Region
from dirax.engines.native.loops.collocation_means import Means
from dirax.engines.native.loops.collocation_nodes import Nodes
from dirax.engines.native.loops.collocation_plan import CollocationPlan, MeanPlan
from dirax.engines.native.loops.collocation_sweeps import Found, OfRates, Sweep
from dirax.engines.native.loops.complex_inverse import padded

MOST_ROOM = 2**20
"""Bytes of a thread's stack that the matrices may take."""

FEW = 4
"""Unknowns of a step up to which an elimination of them all, written out, is faster."""


def pays(plan: CollocationPlan | MeanPlan) -> bool:
    """Whether the systems of one node are faster than one of all unknowns, and fit."""
    n = len(plan.relation.first)
    room = 16 * len(plan.tableau.eigenbasis.values) * n * 2 * padded(n)
    return n * plan.tableau.stages > FEW and room <= MOST_ROOM


class Eigenbasis:
    """The memory of the systems and the tables of the eigenbasis, once for all steps."""

    def __init__(self, nodes: Nodes, plan: CollocationPlan | MeanPlan):
        b, one, basis = nodes.body, nodes.one, plan.tableau.eigenbasis
        self.n, n = len(plan.relation.first), len(plan.relation.first)
        self.into, self.back = nodes.all.matrix(basis.into), nodes.all.matrix(basis.back)
        self.shifts = [[one.mul(nodes.h, one.const(part)) for part in (z.real, z.imag)] for z in basis.values.tolist()]
        self.squares = []
        for re, im in self.shifts:
            square = one.sub(one.mul(re, re), one.mul(im, im)), one.mul(one.const(2.0), one.mul(re, im))
            self.squares.append(square)
        self.matrices = [[b.alloca("double", n * 2 * padded(n)) for _ in range(2)] for _ in basis.values]
        self.right = [[b.alloca("double", padded(n)) for _ in range(2)] for _ in basis.values]
        self.solution = [[b.alloca("double", padded(n)) for _ in range(2)] for _ in basis.values]
        for part in self.right:
            with b.loop(0, padded(n)) as i:
                for base in part:  # the imaginary part that belongs to a real eigenvalue stays zero
                    b.store("double", one.const(0.0), b.at("double", base, i))
        self.pencil = [b.alloca("double", n * n) for _ in range(3)]
        with b.loop(0, n * n) as i:
            for base in self.pencil:
                b.store("double", one.const(0.0), b.at("double", base, i))

    def of_lanes(self, parts: list[list[str]], i: int, body) -> list[str]:
        """Where entry i of the vectors stands, real and imaginary parts in the order of the lanes."""
        return [body.at("double", base, i) for both in parts for base in both]


class InEigenbasis(Sweep):
    """What iterations with one Jacobian for all nodes share: its systems in the eigenbasis, and the sizes of the rates."""

    continued = False, True
    together = True

    def __post_init__(self):
        super().__post_init__()
        basis = self.nodes.eigenbasis
        assert isinstance(basis, Eigenbasis)
        self.basis = basis
        self.rates = self._write_pencil()
        self._invert()

    @abstractmethod
    def _write_pencil(self) -> list[str]:
        """The matrices with 1, z and z² of the Jacobian into memory; returns the rates where the step begins."""

    def _keep(self, pencil: tuple[list[dict[int, int]], ...], middle: Region) -> None:
        b = self.nodes.body
        entries = [(base, i, j, node) for base, rows in zip(self.basis.pencil, pencil, strict=True)
                   for i, row in enumerate(rows) for j, node in row.items()]  # fmt: skip
        middle.require([node for *_, node in entries])
        for base, i, j, node in entries:  # transposed, so that products with the inverse go along its rows
            b.store("double", middle.value(node), b.at("double", base, j * self.basis.n + i))

    def _invert(self) -> None:
        b, one, n = self.nodes.body, self.nodes.one, self.basis.n
        with b.loop(0, n) as i, b.loop(0, n) as j:
            place = b.put(f"add i64 {b.put(f'mul i64 {i}, {n}')}, {j}")
            target = b.put(f"add i64 {b.put(f'mul i64 {i}, {2 * padded(n)}')}, {j}")
            constant, linear, square = (b.load("double", b.at("double", base, place)) for base in self.basis.pencil)
            for (re, im), (re2, im2), (real, imaginary) in zip(
                self.basis.shifts, self.basis.squares, self.basis.matrices, strict=True
            ):
                b.store("double", one.fma(re2, square, one.fma(re, linear, constant)), b.at("double", real, target))
                b.store("double", one.fma(im2, square, one.mul(im, linear)), b.at("double", imaginary, target))
        for real, imaginary in self.basis.matrices:
            b.line(f"call void @complex_inverse(ptr {real}, ptr {imaginary})")

    def _changes(self, defects: list[str], node: str) -> list[str]:
        """J⁻¹ times the defects of all nodes, which stand in these rooms."""
        over, b, basis, stages = self.nodes.all, self.nodes.body, self.basis, self.nodes.plan.tableau.stages
        none = [None] * len(defects)
        over.filled(defects, over.product(basis.into, defects, node, none, over), node)
        for i, room in enumerate(defects):
            over.write(room, basis.of_lanes(basis.right, i, b)[:stages])
        for matrix, right, solution in zip(basis.matrices, basis.right, basis.solution, strict=True):
            pointers = ", ".join(f"ptr {base}" for base in (*matrix, *right, *solution))
            b.line(f"call void @complex_product({pointers})")
        for i, room in enumerate(defects):
            over.read(basis.of_lanes(basis.solution, i, b)[:stages], room)
        return over.product(basis.back, defects, node, none, over)

    def sizes(self, known: list[str]) -> list[str]:
        """Those that are known, the rates where the step begins, and the largest iterates of all nodes: what is roundoff at
        one of them is so at all."""
        over, one, found = self.nodes.all, self.nodes.one, []
        for rate, size, room in zip(self.rates, super().sizes(known), self.iterates, strict=True):
            peak = over.peak()
            over.raised(peak, over.emitter.abs(over.load(room, "")))
            found.append(one.add(one.max(over.highest(peak), one.abs(rate)), size))
        return found


class SimplifiedNewton(InEigenbasis, OfRates):
    """With δ the changes of the rates, (ρ_y + z (ρ_a + ρ_b ∂ḃ/∂y) + z² ρ_b ∂ḃ/∂a) δ = −ρ for z = hλ and every eigenvalue λ of A,
    where the derivatives are those in the middle of the step, on a straight line from its beginning."""

    def _write_pencil(self) -> list[str]:
        k, plan, r = self.nodes, self.plan, self.plan.relation
        begin = Region(k.one, plan.graph, self.here)
        for node, room in zip(r.unknowns, self.iterates, strict=True):
            begin.bind(node, k.all.final(room))
        begin.require(plan.solved)
        rates = [begin.value(node) for node in plan.solved]
        moving, middle = Region(k.one, plan.graph, self.here), Region(k.one, plan.graph, k.scalar)
        for region in (moving, middle):
            for node, rate in zip(r.unknowns, rates, strict=True):
                region.bind(node, rate)
        moving.require(r.rates)
        slopes = [*rates, *(moving.value(node) for node in r.rates)]
        half = k.one.mul(k.one.const(0.5), k.h)
        middle.bind(plan.shared.t, k.one.add(self.time, half))
        for node, value, slope in zip([*r.first, *r.second], self.state, slopes, strict=True):
            middle.bind(node, k.one.fma(half, slope, value))
        self._keep(plan.pencil, middle)
        return rates

    def terms(self) -> list[str]:
        """Those of the rates, also where the plan has accelerations."""
        found, one = super().terms(), self.nodes.one
        return found if self.plan.gain is None else [one.mul(term, one.abs(self.nodes.h)) for term in found]

    def sweep(self, found: Found) -> None:
        k, over, plan = self.nodes, self.nodes.all, self.plan
        weighted, n, r = self._weighted_iterates(), self.basis.n, self.plan.relation
        rooms, defects = over.rooms(len(plan.carried)), over.rooms(n)
        with over.at() as node:
            region, own = self._at(weighted, node)
            carried = [r.rates[i] for i in plan.carried]
            region.require(carried)
            over.filled(rooms, k.weighted([region.value(rate) for rate in carried], node), node)
            points = k.along(rooms, node, [self.second[i] for i in plan.carried])
            for i, value in zip(plan.carried, points, strict=True):
                region.bind(r.second[i], value)
            region.require(r.relation)
            over.filled(defects, [region.value(defect) for defect in r.relation], node)
            changes = self._changes(defects, node)
            e = over.emitter
            found(node, [e.sub(y, change) for y, change in zip(own, changes, strict=True)], e.true)


class SimplifiedNewtonOfMeans(InEigenbasis, Means):
    """The same for rates by means of slopes: (1 − φ_m σ_y − z (φ_a + φ_m σ_a)) δ = φ − y, with the rates φ at a node as a
    function of a and of the means m there, and the slopes σ as one of a and y.

    The mean of the integral of a polynomial is its value at the node, since what the projection takes away vanishes at Gauss
    nodes: so the matrix of the means is A too."""

    def _write_pencil(self) -> list[str]:
        k, plan, r = self.nodes, self.plan, self.plan.relation
        rates, middle = [k.all.final(room) for room in self.iterates], Region(k.one, plan.graph, k.scalar)
        half = k.one.mul(k.one.const(0.5), k.h)
        middle.bind(plan.shared.t, k.one.add(self.time, half))
        for input_, value, rate in zip(r.first, self.first, rates, strict=True):
            middle.bind(input_, k.one.fma(half, rate, value))
        for input_, rate in zip(r.unknowns, rates, strict=True):
            middle.bind(input_, rate)
        middle.require(r.slopes)
        for mean, slope in zip(r.means, r.slopes, strict=True):
            middle.bind(mean, middle.value(slope))
        self._keep(plan.pencil, middle)
        return rates

    def sweep(self, found: Found) -> None:
        over, n, iterates = self.nodes.all, self.pair.count, self.iterates
        defects, e = over.rooms(n), over.emitter

        def corrected(node: str, rates: list[str]) -> None:
            own = [over.load(room, node) for room in iterates]
            over.filled(defects, [e.sub(y, rate) for y, rate in zip(own, rates[:n], strict=True)], node)
            changes = self._changes(defects, node)
            found(node, [e.sub(y, change) for y, change in zip(own, changes, strict=True)], e.true)

        self._rates(corrected)
