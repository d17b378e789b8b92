"""Units in which samples near a point are drawn and derivatives there are compared: of the coordinates and of the time.

As in `dirax.systems.constraint_units`, from the numbers of L at one point: its value and derivatives of the first and the second
order by q and v, the entries of the one-forms, the slopes of holonomic constraints, q and v themselves. In other units by powers
of two they are the same samples. What no number says is near 1.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from dirax.program.tracing import gradient, jacobian, once
from dirax.program.user_functions import evaluated
from dirax.systems.constraint_units import MOST, Terms


class SampleUnits(NamedTuple):
    """Sizes of the coordinates (n,) and of the time."""

    q: np.ndarray
    time: float

    @property
    def v(self) -> np.ndarray:
        """Those of velocities (n,)."""
        return self.q / self.time

    @classmethod
    def plain(cls, size: int) -> "SampleUnits":
        """1 for everything."""
        return cls(np.ones(size), 1.0)


def sample_units(value: Callable, constraints: Any, t: Any, q: np.ndarray, v: np.ndarray, params: Any) -> SampleUnits:
    """Those of a function value(t, q, v, params), a Lagrangian in coordinates or a discrete one, and of constraints, from their
    numbers at (t, q, v). Equal functions and constraints are traced once."""
    n = q.size
    if n > MOST:
        return SampleUnits.plain(n)

    size, slope, bend, rows = (
        np.asarray(a) for a in evaluated(once(_numbers, value, constraints), np.asarray(t, float), q, v, params)
    )
    if not all(np.all(np.isfinite(a)) for a in (size, slope, bend, rows)):
        return SampleUnits.plain(n)
    time, energy, first = n, n + 1, n + 2
    places, rates = np.tile(np.arange(n), 2), np.repeat([0.0, 1.0], n)
    terms = Terms(first + len(rows))
    one = np.zeros(1, int)
    if size != 0.0:
        terms.add(size[None], one, (energy + one, 1.0))
    i = np.flatnonzero(slope)
    terms.add(slope[i], 0 * i, (energy + 0 * i, 1.0), (places[i], -1.0), (time + 0 * i, rates[i]))
    i, j = np.nonzero(bend)
    terms.add(bend[i, j], 0 * i, (energy + 0 * i, 1.0), (places[i], -1.0), (places[j], -1.0), (time + 0 * i, rates[i] + rates[j]))
    i, j = np.nonzero(rows)
    terms.add(rows[i, j], 1 + i, (first + i, 1.0), (j, -1.0))
    for values, power in ((q, 0.0), (v, -1.0)):
        there = np.flatnonzero(values)
        terms.add(values[there], None, (there, 1.0), (time + 0 * there, power))
    units = terms.units((slice(0, n), tuple(f"q{i}" for i in range(n))))
    return SampleUnits(units[:n], float(units[time]))


def _numbers(value: Callable, constraints: Any, t: Any, q: Any, v: Any, params: Any) -> tuple:
    """value(t, q, v, params), its first and second derivatives by (q, v), and the rows of the constraints."""
    n = q.size
    of_both = lambda both: value(t, both[:n], both[n:], params)
    by_both, both = gradient(of_both), jnp.concatenate([q, v])
    rows = [jnp.zeros((0, n))]
    if constraints is not None and constraints.any:
        rows.append(constraints.matrix(t, q, params))
    return of_both(both), by_both(both), jacobian(by_both)(both), jnp.concatenate(rows)
