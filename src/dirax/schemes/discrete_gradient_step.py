"""One step with an exact energy balance: the discrete gradient, and the balance that is carried along."""

from dataclasses import dataclass
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from dirax.numerics.sparse import FEWEST_SPARSE
from dirax.numerics.tolerances import EPSILON
from dirax.program.tracing import jacobian, once
from dirax.schemes.abstract_step import AbstractStep
from dirax.schemes.layout import Layout
from dirax.schemes.step import Field
from dirax.systems.forms import EnergyForm, RelationForm

NOISE = 5e-14
"""How much of dH the correction may be, relative, where it is roundoff of H only. For steps so short that it would be more, the
change of H is found from dH: dividing roundoff of H by such a step would push a system that comes to rest."""
FADED = 1e-6
"""Of a step for which |dH||Δx| is less than this of what roundoff blurs, the correction is below one rounding of dH."""
STRAIGHT = 2.0**-30
"""Where dH changes by less than this of itself within a step, its mean is dH(x̄), by far more than roundoff."""
FINER = 5
"""Points of Gauss' rule for the change of H of short steps; with three, steps of .2 beside a constant of 1e4 miss 1e-9."""
TINY = 1e-150
"""Squares below this leave the range of double precision where they are divided by, and derivatives of that are taken."""


@dataclass(frozen=True, eq=False)
class DiscreteGradientStep(AbstractStep):
    """ẋ_d = (J − R)(x̄) ∇̄H + B(x̄) ū: state (x, supplied, dissipated, their lost digits, H(x_0)), unknowns ẋ_d and the inputs
    of closed ports, or the multipliers of constraints.

    ∇̄H is the mean of dH at the `points` of the step (0 to 1) with these `weights`, corrected along the step in the metric of the
    second derivatives of H. That is a number times Δx which depends on all of x: of many coordinates it is an unknown with an
    equation of its own, and the other equations are sparse, in the Euclidean metric, since a diagonal of second derivatives costs
    as many gradients as there are coordinates. What is corrected is the change of H less ⟨mean, Δx⟩, of short steps, where the
    roundoff of H hides it, by a finer quadrature of dH.
    """

    relation: RelationForm
    energy: EnergyForm
    n: int
    points: tuple[float, ...]
    weights: tuple[float, ...]

    @property
    def state(self) -> Layout:
        return Layout(x=self.n, supplied=(), dissipated=(), lost_supplied=(), lost_dissipated=(), first=())

    @property
    def unknowns(self) -> Layout:
        correction = {"correction": 1} if self.sparse else {}
        return Layout(velocity=self.n, multipliers=self.relation.multipliers, **correction)

    @property
    def sparse(self) -> bool:
        """Whether the factor of the correction of ∇̄H is an unknown: all else in an equation is near it then."""
        return self.n >= FEWEST_SPARSE

    @property
    def fields(self) -> dict[str, Field]:
        fields = {
            "x": Field((self.n,)),
            "work": Field((2,), "node", ("work",), "energy supplied and energy dissipated since the start"),
            "power": Field((3,), "step", ("power",), "power stored, supplied and dissipated"),
        }
        if self.relation.saved:
            closed = self.relation.axis == "closed_port"
            about = "inputs that keep the closed ports closed" if closed else "multipliers of the constraints"
            fields["multipliers"] = Field((self.relation.saved,), "step", (self.relation.axis,), about)
        return fields

    @property
    def labels(self) -> tuple[str, ...]:
        factor = ("the correction of the discrete gradient",) if self.sparse else ()
        return tuple(f"component {i} of the discrete balance" for i in range(self.n)) + self.relation.labels + factor

    # ------------------------------------------------------------------------------------------------------ the gradient

    @once
    def discrete_gradient(self, u, state, h, params):
        """∇̄H, with ⟨∇̄H, Δx⟩ = H(x + Δx) − H(x), and x̄."""
        mean, middle, change = self._mean(u, state, h, params)
        if self.sparse:
            return mean + self.unknowns.split(u).correction * change, middle
        missing, blurred = self._missing(u, state, h, params)
        along = _Along.of(change, self._metric(middle, params), mean, blurred)
        instead = _Along.of(change, jnp.ones(self.n), mean, blurred)
        finer = self._finer(u, state, h, params, jnp.where(along.seen, along.steepest, instead.steepest))
        by_dh = jnp.where(along.seen, along.direction, instead.direction)
        by_h = jnp.where(along.seen, along.share * along.direction, instead.share * instead.direction)
        return mean + finer * by_dh + (missing - finer) * by_h, middle

    @once
    def _mean(self, u, state, h, params):
        """The mean of dH over the step, x̄, and Δx."""
        x, change = self.state.split(state).x, h * self.unknowns.split(u).velocity
        at = lambda s: self.energy.differential(x + s * change, params)
        mean = jnp.stack([w * at(s) for s, w in zip(self.points, self.weights, strict=True)]).sum(axis=0)
        return mean, x + change / 2, change

    @once
    def _missing(self, u, state, h, params):
        """H(x + Δx) − H(x) less ⟨mean, Δx⟩, and what of it roundoff blurs, over NOISE.

        H(x) is what it has to be by the balance: H(x_0) + supplied − dissipated.
        """
        mean, _, change = self._mean(u, state, h, params)
        state = self.state.split(state)
        gained = (state.supplied - state.dissipated) + (state.lost_supplied - state.lost_dissipated)
        stored = (self.energy.hamiltonian(state.x + change, params) - state.first) - gained
        return stored - mean @ change, EPSILON * (jnp.abs(state.first) + jnp.abs(gained)) / NOISE

    def _finer(self, u, state, h, params, steepest):
        """∫⟨dH, Δx⟩ over the step less ⟨mean, Δx⟩, up to the error of a quadrature and the roundoff of dH; 0 where dH hardly
        changes (STRAIGHT), with ⟨dH, Δx⟩ at most `steepest`."""
        if len(self.points) + 1 >= FINER:  # as fine by itself
            return jnp.zeros(())
        mean, middle, change = self._mean(u, state, h, params)
        points, weights = np.polynomial.legendre.leggauss(FINER)
        rule = [(s / 2, w / 2) for s, w in zip(points.tolist(), weights.tolist(), strict=True) if s / 2 + 0.5 not in self.points]
        more = jnp.stack([w * ((self.energy.differential(middle + s * change, params) - mean) @ change) for s, w in rule])
        bent = jnp.sum(jnp.abs(more))
        on = (bent > TINY) & (bent > STRAIGHT**2 * steepest)  # which a change of roundoff is not
        straight = (STRAIGHT * jnp.where(on, steepest, 0.0) / jnp.where(on, bent, 1.0)) ** 2
        return jnp.where(on, jnp.sum(more), 0.0) / (1.0 + straight * straight)

    def _factor(self, u, state, h, params):
        """What the mean of dH is corrected by, over Δx: the correction in the Euclidean metric."""
        mean, _, change = self._mean(u, state, h, params)
        missing, blurred = self._missing(u, state, h, params)
        along = _Along.of(change, jnp.ones(self.n), mean, blurred)
        finer = self._finer(u, state, h, params, along.steepest)
        whole = finer + (missing - finer) * (along.share * (2.0 - along.share))
        return jnp.where(along.seen, whole, 0.0) / along.squared

    def _metric(self, x, params):
        """|∂²H/∂x_i²|, shape (n,): in this metric charges and fluxes do not mix, whatever their units."""
        return jnp.abs(jnp.diagonal(jacobian(lambda x: self.energy.differential(x, params))(x)))

    @once
    def ports(self, u, state, t, h, params):
        """(ū, ȳ, dissipated power) of the step."""
        gradient, middle = self.discrete_gradient(u, state, h, params)
        if self.energy.ports is None:
            return jnp.zeros(0), jnp.zeros(0), jnp.zeros(())
        return self.energy.ports(t + h / 2, middle, gradient, params)

    # ------------------------------------------------------------------------------------------------------ the step

    def residual(self, u, state, t, h, params):
        gradient, middle = self.discrete_gradient(u, state, h, params)
        parts = self.unknowns.split(u)
        relation = self.energy.residual(middle, parts.velocity, parts.multipliers, t + h / 2, params, gradient)
        if not self.sparse:
            return relation
        return jnp.concatenate([relation, parts.correction - self._factor(u, state, h, params)])

    def advance(self, u, state, t, h, params):
        driven, outputs, loss = self.ports(u, state, t, h, params)
        now = self.state.split(state)
        supplied, lost_supplied = _add(now.supplied, now.lost_supplied, h * (driven @ outputs))
        dissipated, lost_dissipated = _add(now.dissipated, now.lost_dissipated, h * loss)
        return self.state.join(
            x=now.x + h * self.unknowns.split(u).velocity,
            supplied=supplied,
            dissipated=dissipated,
            lost_supplied=lost_supplied,
            lost_dissipated=lost_dissipated,
            first=now.first,
        )

    def unpack(self, state, u, t, h, params):
        gradient, _ = self.discrete_gradient(u, state, h, params)
        driven, outputs, loss = self.ports(u, state, t, h, params)
        now, parts = self.state.split(state), self.unknowns.split(u)
        power = jnp.stack([gradient @ parts.velocity, driven @ outputs, loss])
        work = jnp.stack([now.supplied + now.lost_supplied, now.dissipated + now.lost_dissipated])
        row = {"x": now.x, "work": work, "power": power}
        return row | {"multipliers": self.relation.spread(parts.multipliers)} if self.relation.saved else row

    def start(self, data, h, params):
        if "x" not in data:
            raise ValueError("this scheme starts from x=.")
        state = self.state.join(x=data["x"], first=self.energy.hamiltonian(data["x"], params))
        return state, self.unknowns.join(velocity=data["velocity"])

    def resume(self, data, h, params):
        """With the books since the start, which say what H was there."""
        supplied, dissipated = data["work"]
        first = self.energy.hamiltonian(data["x"], params) - (supplied - dissipated)
        state = self.state.join(x=data["x"], supplied=supplied, dissipated=dissipated, first=first)
        return state, self.unknowns.join(velocity=data["velocity"])


class _Along(NamedTuple):
    """The direction of a step in a diagonal metric G: |Δx|², GΔx/|Δx|² (⟨·, Δx⟩ = 1), whether G sees Δx, |∇̄H||Δx|, which ⟨∇̄H, Δx⟩
    is at most, and the share φ of the roundoff of H that may be divided by Δx: 1, and less where |∇̄H||Δx| is lost in it.

    Zero for Δx → 0, where what is missing is of higher order than |Δx|: a system at rest has the discrete gradient dH.
    """

    squared: Array
    direction: Array
    seen: Array
    steepest: Array
    share: Array

    @staticmethod
    def of(change, metric, gradient, blurred) -> "_Along":
        """Of a step Δx, with what is `blurred` by the roundoff of H."""
        diagonal = metric > TINY
        squared = metric @ (change * change)
        steep = (gradient * gradient) @ jnp.where(diagonal, 1.0 / jnp.where(diagonal, metric, 1.0), 0.0)
        seen = (squared > TINY) & (steep > TINY)
        squared, steep = jnp.where(seen, squared, 1.0), jnp.where(seen, steep, 1.0)
        steepest = jnp.sqrt(squared) * jnp.sqrt(steep)
        clear = seen & (steepest > FADED * blurred)
        hidden = jnp.where(clear, blurred, 0.0) / steepest
        share = jnp.where(clear, 1.0, 0.0) / jnp.sqrt(1.0 + (hidden * hidden) ** 2)
        return _Along(squared, jnp.where(seen, metric * change, 0.0) / squared, seen, jnp.where(seen, steepest, 0.0), share)


def _add(total, lost, term):
    """A running sum and its lost digits after one more term (Neumaier's compensated summation)."""
    new = total + term
    small = jnp.where(jnp.abs(total) >= jnp.abs(term), (total - new) + term, (term - new) + total)
    return new, lost + small
