"""The fixed-point iterations of a collocation step in IR: for the rates at the nodes, for the accelerations, or by means."""

from abc import ABC, abstractmethod
from dataclasses import dataclass

from dirax.engines.native.ir.lower import Region
from dirax.engines.native.loops.collocation_nodes import Nodes
from dirax.engines.native.loops.collocation_plan import CollocationPlan, MeanPlan
from dirax.engines.native.loops.over_nodes import Over, Regions


@dataclass
class Sweep(ABC):
    """What both kinds of iteration share: the state of a step as numbers and over the nodes."""

    nodes: Nodes
    here: Region
    state: list[str]
    time: str

    later = 0
    """Sweeps that `increments` does besides."""

    def __post_init__(self):
        k = self.nodes
        e, n = k.all, len(k.plan.relation.first)
        self.first = [e.splat(value) for value in self.state[:n]]
        self.second = [e.splat(value) for value in self.state[n:]]
        self.clock = e.add(e.splat(self.time), k.times)

    def region(self, points: list[Over], rates: list[Over] | None) -> Region | Regions:
        """The relation's inputs a and y at the nodes."""
        k, r = self.nodes, self.nodes.plan.relation
        region = k.all.region(k.plan.graph, k.known)
        region.bind(k.plan.shared.t, self.clock)
        for node, value in zip(r.first, points, strict=True):
            region.bind(node, value)
        for node, value in zip(r.unknowns, rates or [], strict=False):
            region.bind(node, value)
        return region

    @abstractmethod
    def start(self, before: list[Over]) -> list[Over]:
        """The iterates with which the first step begins; `before` is what the record holds."""

    def guess(self, before: list[Over], later: str, polynomial: bool) -> list[Over]:
        """The iterates at the nodes of this step: those of the step before continued where there is one, as a polynomial or as
        constants."""
        k, e, out = self.nodes, self.nodes.all, []
        for vector, start in zip(before, self.start(before), strict=True):
            on = e.product(k.extrapolation, vector) if polynomial else e.entry(vector, e.count - 1, e)
            out.append(e.chosen(later, on, start))
        return out

    @abstractmethod
    def sweep(self, old: list[Over]) -> tuple[list[Over], Over]:
        """The iterates after one more sweep, and whether it was stable, node by node."""

    @abstractmethod
    def increments(self, iterates: list[Over]) -> tuple[list[str], list[Over]]:
        """What the step adds to the state by sums over the nodes, and the iterates after the last sweep."""

    def settled(self, iterates: list[Over], after: list[str]) -> list[str]:
        """What is added at the end, to the state after these sums: nothing."""
        return []

    def _ends(self, region: Region | Regions) -> list[str]:
        """h Σ b_i ḃ_i."""
        k, r = self.nodes, self.nodes.plan.relation
        region.require(r.rates)
        return [k.all.total(k.all.mul(k.weights, region.value(node))) for node in r.rates]


class AtEveryNode(Sweep):
    """An iteration whose relation couples nodes by sums alone."""

    @property
    def plan(self) -> CollocationPlan:
        """The plan, which is one of a stage relation."""
        assert isinstance(self.nodes.plan, CollocationPlan)
        return self.nodes.plan


class FirstOrder(AtEveryNode):
    """The iterates are the rates y at the nodes."""

    def start(self, before: list[Over]) -> list[Over]:
        """Where the first step begins: what the record holds."""
        return before

    def sweep(self, old: list[Over]) -> tuple[list[Over], Over]:
        """Newton's method at each node, once; whether the elimination was stable."""
        k, plan = self.nodes, self.plan
        region = self.region([k.along(y, a) for y, a in zip(old, self.first, strict=True)], old)
        region.require([plan.relation.rates[i] for i in plan.carried])
        for i in plan.carried:
            rate = region.value(plan.relation.rates[i])
            region.bind(plan.relation.second[i], k.along(rate, self.second[i]))
        region.require([*plan.solved, plan.stable])
        return [region.value(node) for node in plan.solved], region.value(plan.stable)

    def increments(self, iterates: list[Over]) -> tuple[list[str], list[Over]]:
        """h Σ b_i y_i and h Σ b_i ḃ_i."""
        k = self.nodes
        sums = [k.all.total(k.all.mul(k.weights, y)) for y in iterates]
        if self.second:
            sums += self._ends(self.region([k.along(y, a) for y, a in zip(iterates, self.first, strict=True)], iterates))
        return sums, iterates


class SecondOrder(AtEveryNode):
    """The iterates are ä at the nodes, the gain times ḃ."""

    later = 1

    def __post_init__(self):
        super().__post_init__()
        k, plan = self.nodes, self.plan
        start = Region(k.one, plan.graph, self.here)
        start.require(plan.solved)
        self.rates = [start.value(node) for node in plan.solved]
        self.lines = [k.all.fma(k.times, k.all.splat(v), a) for v, a in zip(self.rates, self.first, strict=True)]

    def start(self, before: list[Over]) -> list[Over]:
        """Where the first step begins: at uniform motion."""
        return [self.nodes.all.const(0.0) for _ in before]

    def sweep(self, old: list[Over]) -> tuple[list[Over], Over]:
        """The same."""
        k, plan = self.nodes, self.plan
        region = self.region([k.all.product(k.second, f, line) for f, line in zip(old, self.lines, strict=True)], None)
        region.require([plan.relation.rates[i] for i in plan.carried])
        return [self._gained(region, row) for row in plan.gain or []], k.all.splat_of(k.all.emitter.true)

    def _gained(self, region: Region | Regions, row: dict[int, int]) -> Over:
        k, total = self.nodes, None
        for i, node in sorted(row.items()):
            rate, slope = region.value(self.plan.relation.rates[i]), region.value(node)
            if total is None:
                total = rate if node == k.plan.graph.one else k.all.mul(slope, rate)
            else:
                total = k.all.fma(slope, rate, total)
        return k.all.const(0.0) if total is None else total

    def increments(self, iterates: list[Over]) -> tuple[list[str], list[Over]]:
        """Those of one more sweep, in halves whose coefficients are symplectic to the last bit: with those of A² alone the
        energy drifts by some 10⁻¹⁹ a step."""
        k, e, plan = self.nodes, self.nodes.all, self.plan
        rates = [k.along(f, e.splat(v)) for f, v in zip(iterates, self.rates, strict=True)]
        region = self.region([k.along(v, a) for v, a in zip(rates, self.first, strict=True)], rates)
        region.require([plan.relation.rates[i] for i in plan.carried])
        found = [self._gained(region, row) for row in plan.gain or []]
        return [k.all.total(e.mul(k.weights, v)) for v in rates] + self._ends(region), found


class Means(Sweep):
    """The iterates are the rates y at the nodes, of means over the step."""

    later = 1

    @property
    def plan(self) -> MeanPlan:
        """The plan, which is one of means."""
        assert isinstance(self.nodes.plan, MeanPlan)
        return self.nodes.plan

    def __post_init__(self):
        super().__post_init__()
        k, table = self.nodes, self.plan.quadrature
        self.many = e = k.over(len(table.points))
        self.constants = e.constants(k.plan.graph, k.scalar)
        step = e.splat(k.h)
        self.matrix = [e.mul(e.vector(column), step) for column in table.matrix.T]
        self.values = [e.vector(column) for column in table.values.T]
        self.means = [k.all.vector(column) for column in table.means.T]
        self.instants = e.add(e.splat(self.time), e.mul(e.vector(table.points), step))

    def start(self, before: list[Over]) -> list[Over]:
        """What the record holds."""
        return before

    def sweep(self, old: list[Over]) -> tuple[list[Over], Over]:
        rates = self._rates(old)
        return rates[: len(old)], self.nodes.all.splat_of(self.nodes.all.emitter.true)

    def increments(self, iterates: list[Over]) -> tuple[list[str], list[Over]]:
        k, rates = self.nodes, self._rates(iterates)
        return [k.all.total(k.all.mul(k.weights, value)) for value in rates], rates[: len(iterates)]

    def _rates(self, old: list[Over]) -> list[Over]:
        """(ȧ, ḃ) at the nodes."""
        k, e, r = self.nodes, self.many, self.plan.relation
        points = e.region(k.plan.graph, self.constants)
        points.bind(k.plan.shared.t, self.instants)
        for node, y, a in zip(r.first, old, self.state, strict=False):
            points.bind(node, e.product(self.matrix, y, e.splat(a), k.all))
        for node, y in zip(r.unknowns, old, strict=True):
            points.bind(node, e.product(self.values, y, None, k.all))
        points.require(r.slopes)
        inside = self.region([k.along(y, a) for y, a in zip(old, self.first, strict=False)], None)
        for mean, slope in zip(r.means, r.slopes, strict=True):
            inside.bind(mean, k.all.product(self.means, points.value(slope), None, e))
        inside.require(r.rates)
        return [inside.value(node) for node in r.rates]

    def settled(self, iterates: list[Over], after: list[str]) -> list[str]:
        k, plan = self.nodes, self.plan
        region, end = Region(k.one, plan.graph, self.here), k.all.vector(plan.quadrature.end, weights=True)
        for node, value in zip(plan.relation.after, after, strict=True):
            region.bind(node, value)
        for node, rate in zip(plan.relation.unknowns, iterates, strict=True):
            region.bind(node, k.all.total(k.all.mul(end, rate)))
        region.require(plan.relation.settled)
        return [region.value(node) for node in plan.relation.settled]
