"""Newton's method for the small equations around a run: a step that is shortened, a search for the nearest zero.

The Newton iteration of a step is that of the engines (`dirax.engines.stopping` says when it stops).
"""

from collections.abc import Callable
from dataclasses import dataclass
from types import ModuleType
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import lax

from dirax.numerics.equilibration import largest_of_few
from dirax.numerics.tolerances import EPSILON, ON_MANIFOLD

SHORTEST = 2.0**-30
"""Smallest fraction of a Newton step that is tried."""

AT_FLOOR = 4.0 * EPSILON
"""A step of this size relative to the point is roundoff."""

NEAR = 1e-6
"""A step of this size relative to the point is in the domain, and one that contracts."""

FAR = 1e3
"""A zero at this distance, relative to 1 + |start|, is none near the start."""


def damped_step(change: Any, update: Callable, u: Any, units: Any, sizes: Any, xp: ModuleType = np) -> tuple[Any, Any, Any]:
    """(u, whether to go on, whether the step is near zero) after a Newton step that is halved until the next one would be
    shorter: so neither the units of the equations nor those of the unknowns matter, and the domain of the equations is not left.

    `update(u)` (…, k) is A⁻¹ r(u), with one A for all u, and `change` its value at the given u; `units` (…, k) are what steps are
    measured in, and `sizes` (…, k) how large the unknowns are: steps that are NEAR zero in both go on until neither of them
    improves. With NumPy, leading axes hold equations side by side; where no shorter step above the roundoff of u is an
    improvement, u stays.
    """
    largest_of = largest_of_few if xp is np else lambda v: xp.max(v, axis=-1)
    size = lambda v: largest_of(xp.abs(v) / units)
    of_each = lambda v: largest_of(xp.abs(v) / sizes)
    here, largest, of_one = size(change), size(u), of_each(change)
    floor, near = AT_FLOOR * largest, (of_one <= NEAR) & (here <= NEAR * largest)
    at_floor = (of_one <= AT_FLOOR) & (here <= floor)

    def improves(fraction):
        following = update(u - fraction[..., None] * change)
        better = size(following) <= (1.0 - fraction / 4.0) * here
        better = better | near & (of_each(following) <= of_one / 2.0)
        # not left to the comparison: XLA's vectorized maximum of NaNs can be −∞ on a CPU
        return xp.all(xp.isfinite(following), axis=-1) & better

    def halve(carry):
        searching, (fraction, better) = unfinished(carry), carry
        fraction = xp.where(searching, fraction / 2.0, fraction)
        return fraction, better | searching & improves(fraction)

    def unfinished(carry):
        fraction, better = carry
        return ~better & ((fraction > 1.0) | (fraction > SHORTEST) & (fraction * here > floor) & ~near)

    with np.errstate(all="ignore"):  # begun at twice the step, so that XLA compiles `improves` once
        fraction, better = _repeated(xp, lambda carry: xp.any(unfinished(carry)), halve, (xp.full(here.shape, 2.0), at_floor))
        u = xp.where(better[..., None], u - xp.minimum(fraction, 1.0)[..., None] * change, u)
        return u, better & ~at_floor, near | at_floor


def sizes_of_unknowns(matrix: Any, inverse: Any, u: Any, residual: Any, xp: ModuleType = np) -> Any:
    """How large the unknowns (…, l) of r(u) = 0 with the derivative A (…, k, l) and its inverse (…, l, k) are,
    |A⁻¹|(|A||u| + |r|): the ε-th part of it is their roundoff (Skeel 1979), in whatever units. 1 where it is zero."""
    applied = lambda matrix, vector: xp.sum(xp.abs(matrix) * vector[..., None, :], axis=-1)
    sizes = applied(inverse, applied(matrix, xp.abs(u)) + xp.abs(residual))
    return xp.where(sizes > 0.0, sizes, 1.0)


def _repeated(xp: ModuleType, unfinished: Callable, step: Callable, carry: Any) -> Any:
    if xp is jnp:
        return lax.while_loop(unfinished, step, carry)
    while unfinished(carry):
        carry = step(carry)
    return carry


@dataclass(frozen=True)
class GaussNewton:
    """The zero nearest to a point of equations that may be dependent or fewer than the unknowns: steps of least length, run to
    the floor.

    - `rank`: singular values of the derivative below this, relative to the largest, are left alone.
    - `floor`: a step of this size, relative to 1 + |point|, is the last.
    - `least_slope`: values are compared with the largest derivative met, or with this where that is more.
    """

    rank: float
    floor: float
    least_slope: float
    max_steps: int = 80

    def zero_near(self, function: Callable, start: np.ndarray, moved: Any = 1.0) -> tuple[np.ndarray | None, float]:
        """(the zero, or None where there is none; the largest value left there, NaN where the function is not finite).

        `function(x)` (n,) ↦ value (k,) and derivative (k, n), arrays; `moved` (n,): 0 for entries that stay as they are.
        """
        x, largest_slope = start, 0.0
        for _ in range(self.max_steps):
            value, slope = map(np.asarray, function(x))
            if not value.size:
                return x, 0.0
            if not (np.all(np.isfinite(value)) and np.all(np.isfinite(slope))):
                return None, np.nan
            largest_slope = max(largest_slope, np.abs(slope).max(initial=0.0))
            change = np.linalg.lstsq(slope * moved, value, rcond=self.rank)[0]
            x = x - change
            if np.linalg.norm(x - start) > FAR * (1.0 + np.linalg.norm(start)):
                left = np.abs(np.asarray(function(x)[0])).max()
                return None, float(left) if np.isfinite(left) else np.inf
            if np.abs(change).max(initial=0.0) <= self.floor * (1.0 + np.abs(x).max()):
                break
        left = np.abs(np.asarray(function(x)[0])).max()
        on = left <= ON_MANIFOLD * max(largest_slope, self.least_slope) * (1.0 + np.abs(x).max())
        return (x if on else None), float(left) if np.isfinite(left) else np.nan
