"""The fixed-point iterations of a collocation step in IR: for the rates at the nodes, for the accelerations, or by means."""

from abc import ABC, abstractmethod
from dataclasses import dataclass

from dirax.engines.native.ir.emitter import Emitter
from dirax.engines.native.ir.lower import Region
from dirax.engines.native.loops.collocation_nodes import Nodes, lanes_for
from dirax.engines.native.loops.collocation_plan import CollocationPlan, MeanPlan


@dataclass
class Sweep(ABC):
    """What both kinds of iteration share: the state of a step as numbers and over the nodes."""

    nodes: Nodes
    here: Region
    state: list[str]
    time: str

    def __post_init__(self):
        k = self.nodes
        e, n = k.all, len(k.plan.relation.first)
        self.first = [e.splat(value) for value in self.state[:n]]
        self.second = [e.splat(value) for value in self.state[n:]]
        self.clock = e.add(e.splat(self.time), k.times)

    def region(self, points: list[str], rates: list[str] | None) -> Region:
        """The relation's inputs a and y at the nodes."""
        k, r = self.nodes, self.nodes.plan.relation
        region = Region(k.all, k.plan.graph, k.known)
        region.bind(k.plan.shared.t, self.clock)
        for node, value in zip(r.first, points, strict=True):
            region.bind(node, value)
        for node, value in zip(r.unknowns, rates or [], strict=False):
            region.bind(node, value)
        return region

    @abstractmethod
    def start(self, before: list[str]) -> list[str]:
        """The iterates with which the first step begins; `before` is what the record holds."""

    def guess(self, before: list[str], later: str, first: str) -> list[str]:
        """The iterates at the nodes of this step: those of the step before continued where there is one, in the `first` attempt
        as a polynomial, then as constants."""
        k, out = self.nodes, []
        choose = lambda condition, yes, no: k.body.put(f"select i1 {condition}, {k.all.real} {yes}, {k.all.real} {no}")
        for vector, start in zip(before, self.start(before), strict=True):
            constant = k.everywhere(vector, k.stages - 1)
            out.append(choose(later, choose(first, k.product(k.extrapolation, vector), constant), start))
        return out

    @abstractmethod
    def sweep(self, old: list[str]) -> tuple[list[str], str]:
        """The iterates after one more sweep, and whether it was stable, node by node."""

    @abstractmethod
    def increments(self, iterates: list[str]) -> list[str]:
        """What the step adds to the state by sums over the nodes."""

    def settled(self, iterates: list[str], after: list[str]) -> list[str]:
        """What is added at the end, to the state after these sums: nothing."""
        return []

    def _ends(self, region: Region) -> list[str]:
        """h Σ b_i ḃ_i."""
        k, r = self.nodes, self.nodes.plan.relation
        region.require(r.rates)
        return [k.total(k.all.mul(k.weights, region.value(node))) for node in r.rates]


class AtEveryNode(Sweep):
    """An iteration whose relation couples nodes by sums alone."""

    @property
    def plan(self) -> CollocationPlan:
        """The plan, which is one of a stage relation."""
        assert isinstance(self.nodes.plan, CollocationPlan)
        return self.nodes.plan


class FirstOrder(AtEveryNode):
    """The iterates are the rates y at the nodes."""

    def start(self, before: list[str]) -> list[str]:
        """Where the first step begins: what the record holds."""
        return before

    def sweep(self, old: list[str]) -> tuple[list[str], str]:
        """Newton's method at each node, once; whether the elimination was stable."""
        k, plan = self.nodes, self.plan
        region = self.region([k.along(y, a) for y, a in zip(old, self.first, strict=True)], old)
        region.require([plan.relation.rates[i] for i in plan.carried])
        for i in plan.carried:
            rate = region.value(plan.relation.rates[i])
            region.bind(plan.relation.second[i], k.along(rate, self.second[i]))
        region.require([*plan.solved, plan.stable])
        return [region.value(node) for node in plan.solved], region.value(plan.stable)

    def increments(self, iterates: list[str]) -> list[str]:
        """h Σ b_i y_i and h Σ b_i ḃ_i."""
        k = self.nodes
        first = [k.total(k.all.mul(k.weights, y)) for y in iterates]
        if not self.second:
            return first
        return first + self._ends(self.region([k.along(y, a) for y, a in zip(iterates, self.first, strict=True)], iterates))


class SecondOrder(AtEveryNode):
    """The iterates are ä at the nodes, the gain times ḃ."""

    def __post_init__(self):
        super().__post_init__()
        k, plan = self.nodes, self.plan
        start = Region(k.one, plan.graph, self.here)
        start.require(plan.solved)
        self.rates = [start.value(node) for node in plan.solved]
        self.lines = [k.all.fma(k.times, k.all.splat(v), a) for v, a in zip(self.rates, self.first, strict=True)]

    def start(self, before: list[str]) -> list[str]:
        """Where the first step begins: at uniform motion."""
        return [self.nodes.all.const(0.0) for _ in before]

    def sweep(self, old: list[str]) -> tuple[list[str], str]:
        """The same."""
        k, plan = self.nodes, self.plan
        region = self.region([k.product(k.second, f, line) for f, line in zip(old, self.lines, strict=True)], None)
        region.require([plan.relation.rates[i] for i in plan.carried])
        return [self._gained(region, row) for row in plan.gain or []], k.all.true

    def _gained(self, region: Region, row: dict[int, int]) -> str:
        k, total = self.nodes, None
        for i, node in sorted(row.items()):
            rate, slope = region.value(self.plan.relation.rates[i]), region.value(node)
            if total is None:
                total = rate if node == k.plan.graph.one else k.all.mul(slope, rate)
            else:
                total = k.all.fma(slope, rate, total)
        return k.all.const(0.0) if total is None else total

    def increments(self, iterates: list[str]) -> list[str]:
        """Those of two more sweeps, in halves whose coefficients are symplectic to the last bit: with those of A² alone the
        energy drifts by some 10⁻¹⁹ a step."""
        k, e = self.nodes, self.nodes.all
        rates, region = self._half_steps(iterates)
        region.require([self.plan.relation.rates[i] for i in self.plan.carried])
        rates, region = self._half_steps([self._gained(region, row) for row in k.plan.gain or []])
        return [k.total(e.mul(k.weights, v)) for v in rates] + self._ends(region)

    def _half_steps(self, forces: list[str]) -> tuple[list[str], Region]:
        """The rates and the points at the nodes that belong to these ä."""
        k = self.nodes
        rates = [k.along(f, k.all.splat(v)) for f, v in zip(forces, self.rates, strict=True)]
        return rates, self.region([k.along(v, a) for v, a in zip(rates, self.first, strict=True)], rates)


class Means(Sweep):
    """The iterates are the rates y at the nodes, of means over the step."""

    @property
    def plan(self) -> MeanPlan:
        """The plan, which is one of means."""
        assert isinstance(self.nodes.plan, MeanPlan)
        return self.nodes.plan

    def __post_init__(self):
        super().__post_init__()
        k, table = self.nodes, self.plan.quadrature
        self.many = e = Emitter(k.body, lanes_for(len(table.points)))
        self.constants = k.constants(e)
        vector = lambda values: k.vector(values, e.width)
        self.matrix = [e.mul(vector(column), e.splat("%h")) for column in table.matrix.T]
        self.values = [vector(column) for column in table.values.T]
        self.means = [k.vector(column) for column in table.means.T]
        self.instants = e.add(e.splat(self.time), e.mul(vector(table.points), e.splat("%h")))

    def start(self, before: list[str]) -> list[str]:
        """What the record holds."""
        return before

    def sweep(self, old: list[str]) -> tuple[list[str], str]:
        rates = self._rates(old)
        return rates[: len(old)], self.nodes.all.true

    def increments(self, iterates: list[str]) -> list[str]:
        k = self.nodes
        return [k.total(k.all.mul(k.weights, value)) for value in self._rates(iterates)]

    def _rates(self, old: list[str]) -> list[str]:
        """(ȧ, ḃ) at the nodes."""
        k, e, r = self.nodes, self.many, self.plan.relation
        points = Region(e, k.plan.graph, self.constants)
        points.bind(k.plan.shared.t, self.instants)
        for node, y, a in zip(r.first, old, self.state, strict=False):
            points.bind(node, k.product(self.matrix, y, e.splat(a), k.all, e))
        for node, y in zip(r.unknowns, old, strict=True):
            points.bind(node, k.product(self.values, y, None, k.all, e))
        points.require(r.slopes)
        inside = self.region([k.along(y, a) for y, a in zip(old, self.first, strict=False)], None)
        for mean, slope in zip(r.means, r.slopes, strict=True):
            inside.bind(mean, k.product(self.means, points.value(slope), None, e, k.all))
        inside.require(r.rates)
        return [inside.value(node) for node in r.rates]

    def settled(self, iterates: list[str], after: list[str]) -> list[str]:
        k, plan = self.nodes, self.plan
        region, end = Region(k.one, plan.graph, self.here), k.vector(plan.quadrature.end)
        for node, value in zip(plan.relation.after, after, strict=True):
            region.bind(node, value)
        for node, rate in zip(plan.relation.unknowns, iterates, strict=True):
            region.bind(node, k.total(k.all.mul(end, rate)))
        region.require(plan.relation.settled)
        return [region.value(node) for node in plan.relation.settled]
