"""What a kernel of collocation steps knows beforehand: the tableau times h over the nodes, and what depends on parameters alone."""

from dirax.engines.native.ir.emitter import Body
from dirax.engines.native.ir.lower import Region
from dirax.engines.native.loops.collocation_plan import CollocationPlan, MeanPlan
from dirax.engines.native.loops.over_nodes import Apart, InLanes, Over, OverNodes


class Nodes:
    """The writer of values over the nodes, `all`, and of numbers, `one`, with what does not change from step to step: the
    tableau times h, and what depends on the parameters alone, of numbers in `scalar`, over the nodes in `known`."""

    def __init__(self, plan: CollocationPlan | MeanPlan, body: Body, trajectories: int):
        self.plan, self.body, self.trajectories, tableau = plan, body, trajectories, plan.tableau
        self.all = e = self.over(tableau.stages)
        self.one = e.one
        self.scalar = Region(self.one, plan.graph)
        for i, node in enumerate(plan.shared.params):
            self.scalar.bind(node, body.load(self.one.real, body.at(self.one.real, "%params", i)))
        h = self.one.splat("%h")
        self.scalar.bind(plan.shared.h, h)
        self.known = e.constants(plan.graph, self.scalar)
        self.h, step = h, e.splat(h)
        self.times = e.mul(e.vector(tableau.nodes), step)
        self.weights = e.mul(e.vector(tableau.weights, weights=True), step)
        self.shares = [e.vector(column) for column in tableau.shares.T]
        self.extrapolation = [e.vector(column) for column in tableau.extrapolation.T]
        square = e.splat(self.one.mul(h, h))
        self.second = [e.mul(e.vector(column), square) for column in tableau.second.T] if plan.gain is not None else []
        self.known.require([node for row in plan.gain or [] for node in row.values()])

    def over(self, count: int) -> OverNodes:
        """The writer of values over so many nodes."""
        return InLanes(self.body, count) if self.trajectories == 1 else Apart(self.body, count, self.trajectories)

    def along(self, rates: Over, start: Over) -> Over:
        """The points at the nodes, start + Σ_j μ_ij (h b_j rate_j)."""
        return self.all.product(self.shares, self.all.mul(self.weights, rates), start)
