"""What a kernel of collocation steps knows beforehand: the tableau times h, and what depends on the parameters alone."""

from typing import Any

from dirax.engines.native.ir.emitter import Body
from dirax.engines.native.ir.lower import Region
from dirax.engines.native.loops.apart import Apart
from dirax.engines.native.loops.collocation_plan import CollocationPlan, MeanPlan
from dirax.engines.native.loops.in_lanes import InLanes
from dirax.engines.native.loops.over_nodes import OverNodes


class Nodes:
    """The writer of values over the nodes, `all`, and of numbers, `one`, with what does not change from step to step: the
    tableau times h, and what depends on the parameters alone, of numbers in `scalar`, at the nodes in `known`."""

    def __init__(self, plan: CollocationPlan | MeanPlan, body: Body, trajectories: int):
        self.plan, self.body, self.trajectories, tableau = plan, body, trajectories, plan.tableau
        self.all = e = self.over(tableau.stages)
        one = self.one = e.one
        self.scalar = Region(one, plan.graph)
        for i, node in enumerate(plan.shared.params):
            self.scalar.bind(node, body.load(one.real, body.at(one.real, "%params", i)))
        self.h = one.splat("%h")
        self.scalar.bind(plan.shared.h, self.h)
        self.known = e.constants(self.scalar)
        self.times, self.weights = e.table(tableau.nodes, "%h"), e.table(tableau.weights, "%h", weights=True)
        self.shares, self.extrapolation = e.matrix(tableau.shares), e.matrix(tableau.extrapolation)
        if plan.gain is not None:
            self.second = e.matrix(tableau.second, body.put("fmul double %h, %h"))
        self.known.require([node for row in plan.gain or [] for node in row.values()])
        self.eigenbasis: Any = None
        """What Newton's method in the eigenbasis of A has for all steps."""
        if isinstance(plan, MeanPlan):
            self.points = self.over(len(plan.quadrature.points))
            self.of_points = OfPoints(self, plan)

    def over(self, count: int) -> OverNodes:
        """The writer of values over so many nodes."""
        return InLanes(self.body, count) if self.trajectories == 1 else Apart(self.body, count, self.trajectories)

    def weighted(self, values: list[str], node: str) -> list[str]:
        """Values at a node times h b."""
        weight = self.all.of(self.weights, node)
        return [self.all.emitter.mul(weight, value) for value in values]

    def along(self, rooms: list[str], node: str, starts: list[str]) -> list[str]:
        """The points at a node, start + Σ_j μ_ij (h b_j rate_j); the weighted rates stand in rooms."""
        return self.all.product(self.shares, rooms, node, [self.all.splat(start) for start in starts], self.all)

    def totals(self, rooms: list[str]) -> list[str]:
        """Sums over the nodes."""
        return [self.all.total(room) for room in rooms]


class OfPoints:
    """The tables of a quadrature, and what is known at its points."""

    def __init__(self, nodes: Nodes, plan: MeanPlan):
        table, points = plan.quadrature, nodes.points
        self.known = points.constants(nodes.scalar)
        self.matrix, self.values = points.matrix(table.matrix, "%h"), points.matrix(table.values)
        self.means = nodes.all.matrix(table.means)
        self.end = nodes.all.table(table.end, weights=True)
        self.instants = points.table(table.points, "%h")
