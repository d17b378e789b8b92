"""The step that ends on a wall, its length an unknown of it, and what happens to the momentum there."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp

from dirax.program.legendre import moves
from dirax.program.linear_solves import scaled_pseudo_inverse, solve
from dirax.program.tracing import gradient, once
from dirax.schemes.abstract_step import AbstractStep
from dirax.schemes.labels import Labels
from dirax.schemes.layout import Layout
from dirax.schemes.step import CLOCK, STEP_DENSITY, Field, RowAtState, StepEquation
from dirax.schemes.watched_step import ON_WALL, gap_terms, velocity

SUMS = ("work", "energy_defect")
"""Parts of a state that are sums since the start."""

LEAVING = "leaving"
"""The field with a guess of the unknowns of the step that leaves the wall."""

UPDATES = 8
"""Updates of Newton's method for the jump of a Lagrangian that is not quadratic in v."""

HELD = 1e-12
"""Part of a wall's normal that constraints must leave."""


@dataclass(frozen=True, eq=False)
class CollisionStep(AbstractStep):
    """The first αh of a step of `inner` and the jump after it (Fetecau, Marsden, Ortiz, West 2003, §2.3): α is the last unknown,
    for the equation gap(t + αh, q) = 0 of the wall whose number is the state's `wall`, as of `WatchedStep`.

    After the step, `wall` is that wall and `place` is α. There is no solution where another wall is in the way before it, where
    the motion does not go towards the wall, and where constraints keep it from bouncing.
    """

    inner: StepEquation
    system: Any
    gaps: Callable
    restitutions: Callable
    """(t, q, params) ↦ (walls,), like the gaps."""

    @property
    def state(self) -> Layout:
        return Layout(**self.inner.state_layout, alert=(), wall=(), place=())

    @property
    def unknowns(self) -> Layout:
        return Layout(**self.inner.unknown_layout, part_of_step=())

    @property
    def fields(self) -> dict[str, Field]:
        return {**self.inner.fields, LEAVING: Field((self.inner.unknowns,), "step", ("unknown",))}

    @property
    def labels(self) -> Labels:
        return Labels.numbered("equation {}", self.inner.unknowns) + Labels.numbered("gap {}", 1)

    def start(self, data, h, params):
        state, u = self.inner.start(data, h, params)
        return jnp.concatenate([state, jnp.zeros(3)]), jnp.append(u, 0.5)

    def guess(self, state, previous, h, params):
        return jnp.append(self.inner.guess(state[:-3], previous[:-1], h * previous[-1], params), previous[-1])

    @once
    def at_wall(self, u, state, t, h, params) -> tuple[Any, Any, Any]:
        """(state of `inner`, time, gaps) at the wall."""
        after, layout = self.inner.advance(u[:-1], state[:-3], t, u[-1] * h, params), self.inner.state_layout
        time = layout.split(after)._asdict().get(CLOCK, t + u[-1] * h)
        return after, time, self.gaps(time, after[layout.place("q")], params)

    def residual(self, u, state, t, h, params):
        gap = self._own(state[-2], self.at_wall(u, state, t, h, params)[2])
        return jnp.append(self.inner.residual(u[:-1], state[:-3], t, u[-1] * h, params), gap)

    def advance(self, u, state, t, h, params):
        there, time, gaps = self.at_wall(u, state, t, h, params)
        after, _, speed, share = self._jumped(u, state, there, time, h, params)
        begun, end = (vector[self.inner.state_layout.place("q")] for vector in (state, there))
        small = ON_WALL * gap_terms(self.gaps, time, end, [begun], params)
        good = (u[-1] > 0.0) & (u[-1] <= 1.0) & (speed < 0.0) & (share > HELD)
        for i in range(gaps.shape[0]):
            good = good & ((state[-2] == i) | (gaps[i] >= -small[i]))
        return jnp.concatenate([jnp.where(good, after, jnp.nan), jnp.stack([state[-3], state[-2], u[-1]])])

    def unpack(self, state, u, t, h, params):
        row = self.inner.unpack(state[:-3], u[:-1], t, u[-1] * h, params)
        there, time, _ = self.at_wall(u, state, t, h, params)
        return {**row, LEAVING: self._jumped(u, state, there, time, h, params)[1]}

    @once
    def _jumped(self, u, state, there, time, h, params):
        now = self.inner.state_layout.split(there)
        restitution = self._own(state[-2], self.restitutions(time, now.q, params))
        begun = self.inner.state_layout.split(state[:-3])
        about = (now.q - begun.q) / (u[-1] * h)
        gap = lambda t, q: self._own(state[-2], self.gaps(t, q, params))
        v = velocity(self.system, now.q, now.p, time, about, params)
        return bounced(self.system, self.inner, gap, restitution, there, v, time, h, params, solve)

    def _own(self, wall, values):
        """The entry of a wall's number."""
        return sum(jnp.where(wall == i, values[i], 0.0) for i in range(values.shape[0]))


def least_squares(matrix: Any, right: Any) -> Any:
    """The smallest x for which matrix x is nearest to the right-hand side, of constraints that may depend on each other."""
    return scaled_pseudo_inverse(matrix) @ right


def bounced(
    system: Any, stage: StepEquation, gap: Callable, restitution: Any, state: Any, v: Any, t: Any, h: Any, params: Any,
    solution: Callable = least_squares,
) -> tuple[Any, Any, Any, Any]:  # fmt: skip
    """(state⁺, u, speed, share): the state after an impact at `state`, on the wall of `gap(t, q)`, and a guess of the unknowns of
    the step of h that leaves it; how fast the gap grew before; and the part of the wall's normal that constraints leave.

    Its momentum is p⁻ + λn + Cᵀμ on the constraints C v + b = 0, with λ such that v⁺·n = −e v⁻·n, relative to a wall that moves;
    at e = 1 and a wall at rest such that the energy is that before, which is the same where L is quadratic in v: then, with
    M = ∂²L/∂v² and d the projection of M⁻¹n onto ker C in the metric M, v⁺ = v⁻ − (1 + e)(n·v⁻ + ∂gap/∂t)/(n·d) d.
    """
    now = stage.state_layout.split(state)._asdict()
    q, form = now["q"], system.lagrangian_form()
    normal, rate = gradient(lambda q, t: gap(t, q), (0, 1))(q, jnp.asarray(t, float))
    rows = form.constraints.matrix(t, q, params) if system.constraints.any else None

    def projected(metric, covector):
        free = solve(metric, covector)
        if rows is None:
            return free
        forces = solve(metric, rows.T)
        return free - forces @ solution(rows @ forces, rows @ free)

    momentum = lambda v: form.legendre(q, v, params, t)
    quadratic = not moves(jax.hessian(lambda v: form.lagrangian.at(t, q, v, params)), v)
    metric = system.velocity_hessian(t, q, v if quadratic else jnp.zeros_like(v), params)
    lifted, speed = projected(metric, normal), normal @ v + rate
    strength = -(1.0 + restitution) * speed / (normal @ lifted)
    after = v + strength * lifted
    if not quadratic:
        after = _with_momentum(system, momentum, projected, (t, q, params), normal, rate, restitution, v, after, strength)
    data = {"q": q, "p": momentum(after), "v": after, "t": t}
    data |= {name: now[name] for name in (STEP_DENSITY, CLOCK) if name in now}
    row = lambda: stage.unpack(state, jnp.zeros(stage.unknowns), t, h, params)
    own, u = stage.resume(RowAtState(data, row), h, params)
    kept = {name: now[name] for name in SUMS if name in now}
    return stage.state_layout.replace(own, **kept), u, speed, (normal @ lifted) / (normal @ solve(metric, normal))


def _with_momentum(system, momentum, projected, at, normal, rate, restitution, before, after, strength):
    """v⁺ of a Lagrangian that is not quadratic in v, by Newton's method for it and λ from what they nearly are."""
    t, q, params = at
    energy = lambda v: momentum(v) @ v - system.lagrangian_form().lagrangian.at(t, q, v, params)
    keeps, start, kept = (restitution == 1.0) & (rate == 0.0), momentum(before), energy(before)
    speed = normal @ before + rate
    for _ in range(UPDATES):
        metric = system.velocity_hessian(t, q, after, params)
        missed = projected(metric, start + strength * normal - momentum(after))
        lifted, slope = projected(metric, normal), metric @ after
        by_energy = (kept - energy(after) - slope @ missed) / (slope @ lifted)
        by_speed = (-restitution * speed - rate - normal @ (after + missed)) / (normal @ lifted)
        change = jnp.where(keeps, by_energy, by_speed)
        after, strength = after + missed + change * lifted, strength + change
    return after
