"""Vectors over the nodes of a collocation step in IR: a node a lane, products with the matrices of the tableau, sums."""

import numpy as np

from dirax.engines.native.ir.emitter import Body, Emitter
from dirax.engines.native.ir.lower import Region
from dirax.engines.native.loops.collocation_plan import CollocationPlan, MeanPlan

SHAPES = (2, 4, 8, 16)
"""Numbers of lanes: nodes that are missing to the next of them are empty, with weights of zero."""


class Nodes:
    """The writer of vectors over the nodes, `all`, and of numbers, `one`, with what does not change from step to step: the
    tableau times h, and what depends on the parameters alone, of numbers in `scalar`, over the nodes in `known`."""

    def __init__(self, plan: CollocationPlan | MeanPlan, body: Body):
        self.plan, self.body, tableau = plan, body, plan.tableau
        self.stages = tableau.stages
        self.lanes = lanes_for(self.stages)
        self.one, self.all = Emitter(body, 1), Emitter(body, self.lanes)
        e = self.all
        self.params = [body.load("double", body.at("double", "%params", i)) for i in range(len(plan.shared.params))]
        self.scalar, self.known = self.constants(self.one), self.constants(e)
        self.times = e.mul(self.vector(tableau.nodes), e.splat("%h"))
        self.weights = e.mul(self.vector(tableau.weights), e.splat("%h"))
        self.shares = [self.vector(column) for column in tableau.shares.T]
        self.extrapolation = [self.vector(column) for column in tableau.extrapolation.T]
        square = e.splat(self.one.mul("%h", "%h"))
        self.second = [e.mul(self.vector(column), square) for column in tableau.second.T] if plan.gain is not None else []
        self.known.require([node for row in plan.gain or [] for node in row.values()])

    def constants(self, e: Emitter) -> Region:
        """The parameters and h, in every lane of an emitter."""
        region = Region(e, self.plan.graph)
        for node, value in zip([*self.plan.shared.params, self.plan.shared.h], [*self.params, "%h"], strict=True):
            region.bind(node, e.splat(value))
        return region

    def vector(self, values: np.ndarray, lanes: int = 0) -> str:
        """A constant with one entry a node, zero in the lanes that have none; or for other lanes."""
        padded = [*values.tolist(), *[0.0] * ((lanes or self.lanes) - len(values))]
        return f"<{', '.join(f'double {self.one.const(x)}' for x in padded)}>"

    def everywhere(self, x: str, lane: int, of: Emitter | None = None, to: Emitter | None = None) -> str:
        """One entry of a vector in every lane."""
        e, lanes = of or self.all, (to or self.all).width
        mask = ", ".join([f"i32 {lane}"] * lanes)
        return self.body.put(f"shufflevector {e.real} {x}, {e.real} poison, <{lanes} x i32> <{mask}>")

    def product(
        self, columns: list[str], x: str, start: str | None = None, of: Emitter | None = None, to: Emitter | None = None
    ) -> str:
        """start + matrix·x for a vector over the nodes; or of one that `of` writes, for `to`."""
        e = to or self.all
        ways = 4 if len(columns) >= 8 else 2 if len(columns) >= 4 else 1
        parts: list[str | None] = [start, *[None] * (ways - 1)]
        for j, column in enumerate(columns):
            entry = self.everywhere(x, j, of, to)
            part = parts[j % ways]
            parts[j % ways] = e.mul(column, entry) if part is None else e.fma(column, entry, part)
        sums = [part for part in parts if part is not None]
        while len(sums) > 1:
            sums = [e.add(a, b) for a, b in zip(sums[0::2], sums[1::2], strict=True)]
        return sums[0]

    def along(self, rates: str, start: str) -> str:
        """The points at the nodes, start + Σ_j μ_ij (h b_j rate_j)."""
        return self.product(self.shares, self.all.mul(self.weights, rates), start)

    def total(self, value: str) -> str:
        """The sum over the nodes, a number."""
        width = self.lanes
        while width > 1:
            half = width // 2
            kind = f"<{width} x double>"
            low, high = (
                self.body.put(
                    f"shufflevector {kind} {value}, {kind} poison, <{half} x i32> "
                    f"<{', '.join(f'i32 {i}' for i in range(first, first + half))}>"
                )
                for first in (0, half)
            )
            value = self.body.put(f"fadd <{half} x double> {low}, {high}")
            width = half
        return self.body.put(f"extractelement <1 x double> {value}, i64 0")


def lanes_for(count: int) -> int:
    """Lanes of a vector with so many entries."""
    return next(n for n in SHAPES if n >= count)
