"""Points of the constraint algorithm: the nearest one on which conditions vanish, and samples around it."""

from collections.abc import Callable

import numpy as np

from dirax.numerics.newton import GaussNewton
from dirax.numerics.tolerances import EQUATION_RANK, TINY

SAMPLES = 6
"""Points around the given one at which ranks are compared."""

STARTS = 24
"""Points around the given one from which the nearest zero is looked for, where the first that was found is not near."""

NEARER = 40
"""Most steps along the manifold towards the nearest point."""

ONTO = GaussNewton(rank=EQUATION_RANK, floor=1e-15, least_slope=TINY)
"""The conditions are in any units, and differentiated exactly."""

Function = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]
"""x (N,) ↦ values (k,) and their derivative (k, N)."""


class Points:
    """Points in a neighbourhood of `radius`; `moved` (N,) is 0 for the coordinates that no search moves."""

    def __init__(self, radius: float, moved: np.ndarray):
        self.radius, self.moved = radius, moved
        self.rng = np.random.default_rng(0)

    def sample(self, x: np.ndarray) -> np.ndarray:
        """A point near x."""
        return x + self.radius * self.rng.normal(size=x.size)

    def around(self, x: np.ndarray, function: Function | None = None) -> list[np.ndarray]:
        """The point and samples around it, put on the zeros of `function` if it is given."""
        samples = [self.sample(x) for _ in range(SAMPLES)]
        found = samples if function is None else [ONTO.zero_near(function, y, self.moved)[0] for y in samples]
        return [x, *(y for y in found if y is not None)]

    def nearest(self, function: Function, x: np.ndarray) -> tuple[np.ndarray | None, bool]:
        """The zero of `function` nearest to x, None where none is found; whether the function was singular on the way to one.

        Where that of Gauss–Newton from x is further away than the neighbourhood, it is looked for from points around too.
        """
        zero, left = ONTO.zero_near(function, x, self.moved)
        if zero is None:
            return None, bool(np.isnan(left))
        zeros = [self._nearer(function, x, zero)]
        far = _distance(x, zeros[0])
        if far > self.radius * np.sqrt(x.size):
            for _ in range(STARTS):
                start = x + far * self.rng.uniform() * _direction(self.rng, x.size) * self.moved
                found, _ = ONTO.zero_near(function, start, self.moved)
                if found is not None and _distance(x, found) < 0.9 * far:
                    zeros.append(self._nearer(function, x, found))
        return min(zeros, key=lambda y: _distance(x, y)), False

    def _nearer(self, function: Function, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """A zero near y that is no further from x, where the way to x is normal to the zeros."""
        for _ in range(NEARER):
            slope = function(y)[1] * self.moved
            along = (x - y) * self.moved
            along = along - np.linalg.pinv(slope, rcond=EQUATION_RANK) @ (slope @ along)
            if np.linalg.norm(along) <= 1e-12 * (1.0 + np.abs(y).max()):
                break
            closer, _ = ONTO.zero_near(function, y + along, self.moved)
            if closer is None or not _distance(x, closer) < _distance(x, y):
                break
            y = closer
        return y


def _distance(x: np.ndarray, y: np.ndarray) -> float:
    return float(np.linalg.norm(x - y))


def _direction(rng: np.random.Generator, size: int) -> np.ndarray:
    direction = rng.normal(size=size)
    return direction / np.linalg.norm(direction)
