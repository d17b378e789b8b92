"""A step that looks where it goes: with walls in its way it ends, or says which one is hit first and about where."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import reduce
from typing import Any

import jax.numpy as jnp

from dirax.program.legendre import constrained_velocity
from dirax.program.rounding import rounding
from dirax.schemes.abstract_step import AbstractStep
from dirax.schemes.hermite import cubic
from dirax.schemes.layout import Layout
from dirax.schemes.step import CLOCK, Field, StepEquation

PARTS = 4
"""Places of a step at which gaps are looked at."""

EARLY = 16
"""Parts of the first of them at which it is seen whether a motion that begins on a wall goes behind it."""

ON_WALL = 1e-13
"""Gaps below this are none, relative to their terms at coordinates as large as they are in the step (`gap_terms`)."""

NONE, UNSURE = -1.0, -2.0
"""What stands for a wall where none is hit, and where the gaps do not say which one or whether one is."""


@dataclass(frozen=True, eq=False)
class WatchedStep(AbstractStep):
    """The step of `inner`, whose state is that of `inner` with

    - `alert`: 1, and a step in which a wall may be hit has no solution; 0, and it has the one of `inner`;
    - `wall`: the number of the one that is hit first in the step before, NONE or UNSURE;
    - `place`: about where in that step, from 0 to 1.

    The gaps are looked at on the polynomial of the scheme, where it has one, else on the cubic through both ends.
    """

    inner: StepEquation
    system: Any
    gaps: Callable
    """(t, q, params) ↦ (walls,)."""

    @property
    def state(self) -> Layout:
        return Layout(**self.inner.state_layout, alert=(), wall=(), place=())

    @property
    def unknowns(self) -> Layout:
        return self.inner.unknown_layout

    @property
    def fields(self) -> dict[str, Field]:
        return self.inner.fields

    @property
    def labels(self) -> Sequence[str]:
        return self.inner.labels

    def residual(self, u, state, t, h, params):
        return self.inner.residual(u, state[:-3], t, h, params)

    def unpack(self, state, u, t, h, params):
        return self.inner.unpack(state[:-3], u, t, h, params)

    def guess(self, state, previous, h, params):
        return self.inner.guess(state[:-3], previous, h, params)

    def start(self, data, h, params):
        state, u = self.inner.start(data, h, params)
        return jnp.concatenate([state, jnp.array([1.0, NONE, 0.0])]), u

    def advance(self, u, state, t, h, params):
        own, alert = state[:-3], state[-3]
        after = self.inner.advance(u, own, t, h, params)
        wall, place = self.seen(u, own, after, t, h, params)
        free = (wall == NONE) | (alert == 0.0)
        return jnp.concatenate([after, jnp.stack([jnp.where(free, alert, jnp.nan), wall, place])])

    # ------------------------------------------------------------------------------------------ what is in the way

    def seen(self, u, state, after, t, h, params) -> tuple[Any, Any]:
        """(wall, place) of the step from one state of `inner` to another."""
        places = [k / PARTS for k in range(-1, PARTS + 2)]  # one before the step and one after it, for dips at its ends
        inside = self.inside(u, state, after, t, h, params)
        gaps, early = [self.gaps(*inside(x), params) for x in places], self.gaps(*inside(1 / (PARTS * EARLY)), params)
        ends, (begins, q) = [vector[self.inner.state_layout.place("q")] for vector in (state, after)], inside(0.0)
        small = ON_WALL * gap_terms(self.gaps, begins, q, ends, params)
        count, far = gaps[0].shape[0], jnp.asarray(jnp.inf)
        wall, place, doubt = jnp.asarray(NONE), far, far
        for i in range(count):
            g = [gap[i] for gap in gaps]
            first = far
            for k in range(PARTS + 1, 1, -1):
                share = jnp.where(g[k - 1] > 0.0, g[k - 1] / (g[k - 1] - g[k]), 0.0)
                first = jnp.where(g[k] < 0.0, places[k - 1] + share / PARTS, first)
            doubt = jnp.where((g[1] <= small[i]) & ((g[2] < 0.0) | (early[i] < 0.0)), -1.0, doubt)  # it begins on the wall
            for k in range(1, PARTS + 2):
                doubt = jnp.where(jnp.isfinite(g[k]), doubt, -1.0)
                near = (g[k] >= 0.0) & (g[k] <= g[k - 1]) & (g[k] <= g[k + 1]) & (3.0 * g[k] <= g[k - 1] + g[k + 1])
                doubt = jnp.where(near & (places[k] < doubt), places[k], doubt)
            wall, place = jnp.where(first < place, float(i), wall), jnp.where(first < place, first, place)
        return jnp.where(doubt < place, UNSURE, wall), jnp.where(place < far, place, 0.0)

    def inside(self, u, state, after, t, h, params) -> Callable:
        """x ↦ (t, q) at a part x of the step."""
        if (interpolate := self.inner.interpolate) is not None:

            def by_polynomial(x):
                row = interpolate(x, u, state, t, h, params)
                return row.get(CLOCK, t + x * h), row["q"]

            return by_polynomial
        layout = self.inner.state_layout
        split = lambda vector: layout.split(vector)._asdict()
        first, last = split(state), split(after)
        begins, ends = first.get(CLOCK, t), last.get(CLOCK, t + h)
        length = ends - begins
        about = (last["q"] - first["q"]) / length
        v, v_after = (velocity(self.system, row["q"], row["p"], s, about, params) for row, s in ((first, begins), (last, ends)))
        return lambda x: (begins + x * length, cubic(x, first["q"], last["q"], v, v_after, length))


def gap_terms(gaps: Callable, t: Any, q: Any, places: Iterable, params: Any) -> Any:
    """The sizes of the terms of all gaps (walls,) at (t, q), for coordinates that are as large as at any of the `places`: a q
    that is zero at a wall is known to the roundoff of what it was in the step."""
    errors = reduce(jnp.maximum, map(jnp.abs, places), jnp.abs(q))
    t = jnp.asarray(t, float)
    return rounding(lambda t, q: gaps(t, q, params), t, q, errors=(jnp.abs(t), errors))


def velocity(system: Any, q, p, t, about, params):
    """The velocity on the constraints of a momentum, which may have a part of their forces; `about` is nearly it."""
    form = system.lagrangian_form()
    rows = form.constraints.matrix(t, q, params)
    offset = form.constraints.velocity_defect(t, q, jnp.zeros_like(q), params)
    return constrained_velocity(lambda v: form.lagrangian.at(t, q, v, params), p, rows, offset, about)[0]
