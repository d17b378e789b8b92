"""The discrete Dirac structures of discrete Lagrangians on Q × Q for a manifold Q, in charts at its points ([RL] §6)."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from dirax.numerics.arrays import Data
from dirax.schemes.discrete_structure import AbstractStepForm, Claim, DifferentiatedStep
from dirax.schemes.discrete_structure_pairs import AbstractPairs, LagrangianPairs
from dirax.schemes.lagrangian_in_charts import LagrangianInCharts
from dirax.schemes.step_forms import ChartedForm
from dirax.schemes.two_form_on_pairs import FormOnPairs
from dirax.systems.shape import Shape


class PairsInCharts(AbstractPairs):
    """The structure of three points in a row of a manifold: that of `LagrangianPairs` in the chart at the point in the middle.

    There the chart has r = 0, and is compatible with the retraction: the finite differences (r1 − r0)/h and (r2 − r1)/h of the
    (±)-discrete Dirac structures of [PY] are −R⁻¹_{q1}(q0)/h and R⁻¹_{q1}(q2)/h, and D2 L_d + D1 L_d, Δ° and the momenta are
    those of T*_{q1}Q. The chart in which the step was solved is another one, and is not looked at.
    """

    local: LagrangianInCharts
    step: Any
    shape: Shape = eqx.field(static=True)
    sign: str | None = eqx.field(static=True, default=None)
    share: float = eqx.field(static=True, default=0.0)

    @property
    def default_sign(self) -> str:
        return self.sign or "+"

    @property
    def pairs(self) -> LagrangianPairs:
        """The structure in coordinates."""
        local = self.local
        forced = None if local.system.forces is None else local.impulses
        shape = Shape(local.manifold.dimension, self.shape.m, redundant=self.shape.redundant)
        return LagrangianPairs(
            local.local_system, local.local_rule, local.local_constraint, self.step, shape, self.sign, self.share, forced
        )

    def in_coordinates(self, rows: Data, centre: int, params: Any) -> tuple[LagrangianPairs, Data, Any]:
        here = self.local.chart(rows["q"][centre])
        found = dict(rows)
        if "p" in rows:
            local = [here.momentum_to_local(q, p) for q, p in zip(rows["q"], rows["p"], strict=True)]
            found |= {"q": jnp.stack([r for r, _ in local]), "p": jnp.stack([p for _, p in local])}
        else:
            found["q"] = jnp.stack([here.to_local(q) for q in rows["q"]])
        if "along" in rows:
            found["along"] = here.components(rows["along"])
        return self.pairs, found, (params, here.base)

    @property
    def points(self) -> int:
        return 3

    @property
    def reads(self) -> tuple[str, ...]:
        return self.pairs.reads

    @property
    def claims(self) -> tuple[Claim, ...]:
        return self.pairs.claims

    @property
    def given(self) -> tuple[str, ...]:
        return self.pairs.given

    @property
    def own_states(self) -> bool:
        return self.local.system.forces is None

    @property
    def step_form(self) -> AbstractStepForm:
        return FormInCharts(self) if self.shape.m else ChartedForm(self.local.system, self.step)

    @property
    def counts(self) -> tuple[int, ...]:
        return self.pairs.counts

    def membership_terms(self, rows: Data, params: Any) -> Float[Array, "2 numbers"]:
        """As that in coordinates, in roundings of the numbers that the rows hold."""
        pairs, local, where = self.in_coordinates(rows, 1, params)
        frame = jnp.abs(self.local.chart(rows["q"][1]).frame)
        size = (jnp.abs(rows["q"]) @ frame) / jnp.sum(frame**2, axis=0)[None]
        return pairs.defects(local, where, jnp.ravel(size))


class FormInCharts(AbstractStepForm):
    """φ*Ω = Ω + dβ, as `FormOnPairs` has it, on the pairs of a manifold, in the chart at the second point of a pair."""

    pairs: PairsInCharts

    @property
    def name(self) -> str:
        return FormOnPairs(self.pairs.pairs).name

    @property
    def points(self) -> int:
        return 2

    @property
    def reads(self) -> tuple[str, ...]:
        return ("q",)

    def told(self, numbers: Any, place: str) -> str:
        return FormOnPairs(self.pairs.pairs).told(numbers, place)

    def begins(self, equation: Any, rows: Data, params: Any) -> tuple[Float[Array, " s"], Float[Array, " k"]]:
        pairs, local, where = self.pairs.in_coordinates(rows, 1, params)
        state, guess = FormOnPairs(pairs).begins(equation, local, where)
        return jnp.concatenate([where[1], state]), guess

    def terms(self, step: DifferentiatedStep, equation: Any, rows: Data, params: Any) -> Float[Array, "numbers 2 s s"]:
        pairs, local, where = self.pairs.in_coordinates(rows, 1, params)
        size, d = where[1].shape[0], self.pairs.local.manifold.dimension
        here = self.pairs.local.chart(where[1])

        def coordinates(state):
            """Those of the new point in the chart that the step began in."""
            return here.to_local(self.pairs.local.chart(state[:size]).to_manifold(state[size : size + d]))

        after, jacobian, condition = step
        moved = jax.jacfwd(coordinates)(after) @ jacobian[:, size:]
        return FormOnPairs(pairs).terms(DifferentiatedStep(coordinates(after), moved, condition), equation, local, where)
