"""The fixed-point iterations of a collocation step in IR: for the rates at the nodes, for the accelerations, or by means."""

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

from dirax.engines.native.ir.lower import Region
from dirax.engines.native.loops.collocation_nodes import Nodes
from dirax.engines.native.loops.collocation_plan import CollocationPlan, MeanPlan
from dirax.engines.native.loops.over_nodes import OverNodes, Pair

Found = Callable[[str, list[str], str], None]
"""What is done with the new iterates at a node, and whether they are stable."""


@dataclass
class Sweep(ABC):
    """What the kinds of iteration share: the state of a step in numbers, and a pair of rooms for the iterates."""

    nodes: Nodes
    here: Region
    state: list[str]
    time: str
    pair: Pair

    later = 0
    """Sweeps that `increments` does besides, and on which the iteration counts."""

    of_accelerations = False
    """Whether the iterates are accelerations, not rates."""

    continued: ClassVar[tuple[bool, bool]] = True, False
    """Whether the first attempt and the second one begin with the polynomial of the step before, or with its last values."""

    together = False
    """Whether all entries of the iterates change together, so that the largest change says when to stop; else each by itself."""

    def __post_init__(self):
        n = len(self.nodes.plan.relation.first)
        self.first, self.second = self.state[:n], self.state[n:]

    @property
    def iterates(self) -> list[str]:
        """The rooms of the iterates."""
        return self.pair.now()

    def region(self, points: list[str], rates: list[str], node: str) -> Region:
        """The relation's inputs a and y at a node."""
        k, r = self.nodes, self.nodes.plan.relation
        return self._region(k.all, k.known, k.times, points, node, [*r.unknowns[: len(rates)]], rates)

    def _region(self, over: OverNodes, known: Region, times, points, node, more: list[int], values: list[str]) -> Region:
        k, r, region = self.nodes, self.nodes.plan.relation, Region(over.emitter, self.nodes.plan.graph, known)
        region.bind(k.plan.shared.t, over.emitter.add(over.splat(self.time), over.of(times, node)))
        for input_, value in zip([*r.first, *more], [*points, *values], strict=True):
            region.bind(input_, value)
        return region

    @abstractmethod
    def start(self, before: str, node: str) -> str:
        """The iterate at a node with which the first step begins; the room `before` has what the record holds."""

    def guess(self, before: list[str], later: str, polynomial: bool, node: str) -> list[str]:
        """The iterates at a node of this step: those of the step before continued where there is one, as a polynomial or as
        constants."""
        k, e = self.nodes, self.nodes.all
        if polynomial:
            on = e.product(k.extrapolation, before, node, [None] * len(before), e)
        else:
            on = [e.last(room) for room in before]
        return [e.chosen(later, value, self.start(room, node)) for value, room in zip(on, before, strict=True)]

    @abstractmethod
    def sweep(self, found: Found) -> None:
        """One more sweep: new iterates from those in the rooms, which `found` is called with at every node."""

    def terms(self) -> list[str]:
        """How large what the iterates are made of is, at the state where the step begins and with the last iterates."""
        plan, over = self.nodes.plan, self.nodes.all
        region = Region(self.nodes.one, plan.graph, self.here)
        for input_, room in zip(plan.relation.unknowns, self.iterates, strict=True):
            region.bind(input_, over.final(room))
        if isinstance(plan, MeanPlan):  # slopes at one point in the place of means
            region.require(plan.relation.slopes)
            for mean, slope in zip(plan.relation.means, plan.relation.slopes, strict=True):
                region.bind(mean, region.value(slope))
        region.require(plan.terms)
        return [region.value(node) for node in plan.terms]

    @abstractmethod
    def increments(self, found: Found) -> list[str]:
        """What the step adds to the state by sums over the nodes; `found` is called with the iterates of a last sweep, if there
        is one."""

    def sizes(self, known: list[str]) -> list[str]:
        """How large the iterates of a kind are, of all nodes, beside what each of them is: what stands in memory."""
        return [self.nodes.body.load(self.nodes.one.real, size) for size in known]

    def settled(self, iterates: list[str], after: list[str]) -> list[str]:
        """What is added at the end, with the last iterates, to the state after these sums: nothing."""
        return []

    def _weighted_iterates(self) -> list[str]:
        """Rooms with h b times the iterates."""
        k, iterates = self.nodes, self.iterates
        rooms = k.all.rooms(len(iterates))
        with k.all.at() as node:
            k.all.filled(rooms, k.weighted([k.all.load(room, node) for room in iterates], node), node)
        return rooms


class AtEveryNode(Sweep):
    """An iteration whose relation couples nodes by sums alone."""

    @property
    def plan(self) -> CollocationPlan:
        """The plan, which is one of a stage relation."""
        assert isinstance(self.nodes.plan, CollocationPlan)
        return self.nodes.plan

    def _weighted_rates(self, region: Region, rooms: list[str], node: str) -> None:
        """h b ḃ into rooms."""
        region.require(self.plan.relation.rates)
        values = [region.value(rate) for rate in self.plan.relation.rates]
        self.nodes.all.filled(rooms, self.nodes.weighted(values, node), node)


class OfRates(AtEveryNode):
    """The iterates are the rates y at the nodes."""

    def start(self, before: str, node: str) -> str:
        """What the record holds."""
        return self.nodes.all.load(before, node)

    def _at(self, weighted: list[str], node: str) -> tuple[Region, list[str]]:
        """The relation at a node and the iterates there."""
        own = [self.nodes.all.load(room, node) for room in self.iterates]
        return self.region(self.nodes.along(weighted, node, self.first), own, node), own

    def increments(self, found: Found) -> list[str]:
        """h Σ b_i y_i and h Σ b_i ḃ_i."""
        weighted, ends = self._weighted_iterates(), self.nodes.all.rooms(len(self.second))
        if ends:
            with self.nodes.all.at() as node:
                self._weighted_rates(self._at(weighted, node)[0], ends, node)
        return self.nodes.totals([*weighted, *ends])


class FirstOrder(OfRates):
    """The fixed-point iteration of the rates."""

    def sweep(self, found: Found) -> None:
        """Newton's method at each node, once; whether the elimination was stable."""
        k, plan, over = self.nodes, self.plan, self.nodes.all
        weighted, outputs = self._weighted_iterates(), [*plan.solved, plan.stable]
        carried = [plan.relation.rates[i] for i in plan.carried]
        rooms = over.rooms(len(carried))
        again: Callable[[str], Region] | None = None
        if carried:
            with over.at() as node:
                region, _ = self._at(weighted, node)
                region.require(carried)
                over.filled(rooms, k.weighted([region.value(rate) for rate in carried], node), node)
                again = over.handed_on(region, outputs, node)
        with over.at() as node:
            region = again(node) if again else self._at(weighted, node)[0]
            points = k.along(rooms, node, [self.second[i] for i in plan.carried])
            for i, value in zip(plan.carried, points, strict=True):
                region.bind(plan.relation.second[i], value)
            region.require(outputs)
            found(node, [region.value(y) for y in plan.solved], region.value(plan.stable))


class SecondOrder(AtEveryNode):
    """The iterates are ä at the nodes, the gain times ḃ."""

    later = 1
    of_accelerations = True

    def __post_init__(self):
        super().__post_init__()
        k, plan, over = self.nodes, self.plan, self.nodes.all
        start = Region(k.one, plan.graph, self.here)
        start.require(plan.solved)
        self.rates = [start.value(node) for node in plan.solved]
        self.lines = over.rooms(len(self.rates))
        with over.at() as node:
            for room, v, a in zip(self.lines, self.rates, self.first, strict=True):
                over.store(over.emitter.fma(over.of(k.times, node), over.splat(v), over.splat(a)), room, node)

    def start(self, before: str, node: str) -> str:
        """Where the first step begins: at uniform motion."""
        return self.nodes.all.emitter.const(0.0)

    def sweep(self, found: Found) -> None:
        """The same."""
        over, iterates = self.nodes.all, self.iterates
        with over.at() as node:
            lines = [over.load(room, node) for room in self.lines]
            region = self.region(over.product(self.nodes.second, iterates, node, lines, over), [], node)
            found(node, self._gained(region), over.emitter.true)

    def _gained(self, region: Region) -> list[str]:
        """The gain times ḃ."""
        plan, e, found = self.plan, region.emitter, []
        region.require([plan.relation.rates[i] for i in plan.carried])
        for row in plan.gain or []:
            total = None
            for i, node in sorted(row.items()):
                rate, slope = region.value(plan.relation.rates[i]), region.value(node)
                alone = rate if node == plan.graph.one else None
                total = e.fma(slope, rate, total) if total is not None else alone or e.mul(slope, rate)
            found.append(e.const(0.0) if total is None else total)
        return found

    def increments(self, found: Found) -> list[str]:
        """Those of two more sweeps, in halves whose coefficients are symplectic to the last bit: with those of A² alone, or after
        one such sweep, the energy drifts by some 10⁻¹⁹ a step; and it does where the iteration counts on both."""
        k, over, ends = self.nodes, self.nodes.all, self.nodes.all.rooms(len(self.second))
        speeds, forces = self._speeds(self._weighted_iterates()), over.rooms(len(self.rates))
        with over.at() as node:
            region = self.region(k.along(speeds, node, self.first), [], node)
            over.filled(forces, k.weighted(self._gained(region), node), node)
        speeds = self._speeds(forces)
        with over.at() as node:
            rates = k.along(forces, node, self.rates)  # which the work of forces depends on, as accelerations do not
            region = self.region(k.along(speeds, node, self.first), rates, node)
            found(node, self._gained(region), over.emitter.true)
            self._weighted_rates(region, ends, node)
        return k.totals([*speeds, *ends])

    def _speeds(self, forces: list[str]) -> list[str]:
        """Rooms with h b times the rates that belong to weighted ä."""
        k, over = self.nodes, self.nodes.all
        speeds = over.rooms(len(self.rates))
        with over.at() as node:
            over.filled(speeds, k.weighted(k.along(forces, node, self.rates), node), node)
        return speeds
