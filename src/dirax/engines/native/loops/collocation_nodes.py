"""Vectors over the nodes of a collocation step in IR: a node a lane, products with the matrices of the tableau, sums."""

import numpy as np

from dirax.engines.native.ir.emitter import Body, Emitter
from dirax.engines.native.ir.lower import Region
from dirax.engines.native.loops.collocation_plan import CollocationPlan

SHAPES = (2, 4, 8, 16)
"""Numbers of lanes: nodes that are missing to the next of them are empty, with weights of zero."""


class Nodes:
    """The writer of vectors over the nodes, `all`, and of numbers, `one`, with what does not change from step to step: the
    tableau times h, and what depends on the parameters alone, of numbers in `scalar`, over the nodes in `known`."""

    def __init__(self, plan: CollocationPlan, body: Body):
        self.plan, self.body, tableau = plan, body, plan.tableau
        self.stages = tableau.stages
        self.lanes = next(n for n in SHAPES if n >= self.stages)
        self.one, self.all = Emitter(body, 1), Emitter(body, self.lanes)
        e = self.all
        self.scalar, self.known = Region(self.one, plan.graph), Region(e, plan.graph)
        for i, node in enumerate(plan.shared.params):
            value = body.load("double", body.at("double", "%params", i))
            self.scalar.bind(node, value)
            self.known.bind(node, e.splat(value))
        self.scalar.bind(plan.shared.h, "%h")
        self.known.bind(plan.shared.h, e.splat("%h"))
        self.times = e.mul(self.vector(tableau.nodes), e.splat("%h"))
        self.weights = e.mul(self.vector(tableau.weights), e.splat("%h"))
        self.shares = [self.vector(column) for column in tableau.shares.T]
        self.extrapolation = [self.vector(column) for column in tableau.extrapolation.T]
        square = e.splat(self.one.mul("%h", "%h"))
        self.second = [e.mul(self.vector(column), square) for column in tableau.second.T] if plan.gain is not None else []
        self.known.require([node for row in plan.gain or [] for node in row.values()])

    def vector(self, values: np.ndarray) -> str:
        """A constant with one entry a node, zero in the lanes that have none."""
        padded = [*values.tolist(), *[0.0] * (self.lanes - len(values))]
        return f"<{', '.join(f'double {self.one.const(x)}' for x in padded)}>"

    def everywhere(self, x: str, lane: int) -> str:
        """One entry of a vector in every lane."""
        e, mask = self.all, ", ".join([f"i32 {lane}"] * self.lanes)
        return self.body.put(f"shufflevector {e.real} {x}, {e.real} poison, <{self.lanes} x i32> <{mask}>")

    def product(self, columns: list[str], x: str, start: str | None = None) -> str:
        """start + matrix·x for a vector over the nodes."""
        e = self.all
        ways = 4 if len(columns) >= 8 else 2 if len(columns) >= 4 else 1
        parts: list[str | None] = [start, *[None] * (ways - 1)]
        for j, column in enumerate(columns):
            entry = self.everywhere(x, j)
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
