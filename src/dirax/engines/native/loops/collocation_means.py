"""The fixed-point iteration of a collocation step by means over the step in IR."""

from collections.abc import Callable

from dirax.engines.native.ir.lower import Region
from dirax.engines.native.loops.collocation_plan import MeanPlan
from dirax.engines.native.loops.collocation_sweeps import Found, Sweep


class Means(Sweep):
    """The iterates are the rates y at the nodes, of means over the step."""

    @property
    def plan(self) -> MeanPlan:
        """The plan, which is one of means."""
        assert isinstance(self.nodes.plan, MeanPlan)
        return self.nodes.plan

    def start(self, before: str, node: str) -> str:
        """What the record holds."""
        return self.nodes.all.load(before, node)

    def sweep(self, found: Found) -> None:
        n, true = self.pair.count, self.nodes.all.emitter.true
        self._rates(lambda node, rates: found(node, rates[:n], true))

    def increments(self, found: Found) -> list[str]:
        k, n = self.nodes, self.pair.count
        rooms = k.all.rooms(len(self.plan.relation.rates))

        def summed(node: str, rates: list[str]) -> None:
            k.all.filled(rooms, k.weighted(rates, node), node)
            found(node, rates[:n], k.all.emitter.true)

        self._rates(summed)
        return k.totals(rooms)

    def _rates(self, found: Callable[[str, list[str]], None]) -> None:
        """(ȧ, ḃ) at the nodes."""
        k, many, m, r = self.nodes, self.nodes.points, self.nodes.of_points, self.plan.relation
        weighted, slopes = self._weighted_iterates(), many.rooms(len(r.slopes))
        iterates = self.iterates
        with many.at() as node:
            points = many.product(m.matrix, iterates, node, [many.splat(a) for a in self.first], k.all)
            rates = many.product(m.values, iterates, node, [None] * self.pair.count, k.all)
            region = self._region(many, m.known, m.instants, points, node, r.unknowns, rates)
            region.require(r.slopes)
            many.filled(slopes, [region.value(slope) for slope in r.slopes], node)
        with k.all.at() as node:
            region = self.region(k.along(weighted, node, self.first), [], node)
            means = k.all.product(m.means, slopes, node, [None] * len(slopes), many)
            for input_, mean in zip(r.means, means, strict=True):
                region.bind(input_, mean)
            region.require(r.rates)
            found(node, [region.value(rate) for rate in r.rates])

    def settled(self, iterates: list[str], after: list[str]) -> list[str]:
        k, plan, over = self.nodes, self.plan, self.nodes.all
        region, ends = Region(k.one, plan.graph, self.here), over.rooms(self.pair.count)
        with over.at() as node:
            of_end = over.of(k.of_points.end, node)
            over.filled(ends, [over.emitter.mul(of_end, over.load(room, node)) for room in iterates], node)
        for input_, value in zip([*plan.relation.after, *plan.relation.unknowns], [*after, *k.totals(ends)], strict=True):
            region.bind(input_, value)
        region.require(plan.relation.settled)
        return [region.value(node) for node in plan.relation.settled]
