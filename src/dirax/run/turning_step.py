"""Where the solutions of a step end: its unknowns followed from short steps on by pseudo-arclength (Keller 1977)."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

BEGIN = 1 / 32
"""The part of the step at which following begins."""

MOST = 200
"""Points on the branch of solutions."""

FIRST, LONGEST, SHORTEST = 0.05, 0.3, 1e-5
"""Distances between them, in unknowns relative to their sizes and in parts of the step."""

FOUND, UPDATES = 1e-9, 8
"""The relative update of Newton's method at which a point is found, and how many there may be."""


class Followed(NamedTuple):
    """How far the solutions go that begin with short steps: the longest `step`, and whether it is the whole one."""

    step: float
    whole: bool


def follow(linearized: Callable, unknowns: np.ndarray, sizes: np.ndarray, h: float) -> Followed | None:
    """The solutions u(h') of an equation of a step, 0 < h' ≤ h, from `unknowns` (k,) near that of a short one, with unknowns of
    these `sizes`. `linearized(u, h')` is the residual and its Jacobian. None where they cannot be followed.

    At a turning point two solutions meet, and longer steps have none near.
    """
    scale = np.append(np.abs(unknowns) + sizes, h)
    scale = np.where(scale != 0.0, scale, 1.0)

    def slopes(y):
        """Residual and (k, k + 1) derivatives by the scaled unknowns and the part of the step."""
        u, step = (y * scale)[:-1], y[-1] * h
        residual, jacobian = linearized(u, step)
        ahead, behind = (linearized(u, step * (1.0 + off))[0] for off in (1e-6, -1e-6))
        return residual, np.column_stack([jacobian, (ahead - behind) / (2e-6 * step)]) * scale

    def corrected(y, normal):
        """The point of the branch on the plane through y."""
        start = y
        for _ in range(UPDATES):
            residual, matrix = slopes(y)
            change = np.linalg.solve(np.vstack([matrix, normal]), np.append(residual, normal @ (y - start)))
            y = y - change
            if np.max(np.abs(change)) < FOUND:
                return y
        return None

    try:
        with np.errstate(all="ignore"):
            return _followed(slopes, corrected, np.append(unknowns / scale[:-1], BEGIN), h)
    except np.linalg.LinAlgError:
        return None


def _followed(slopes: Callable, corrected: Callable, y: np.ndarray, h: float) -> Followed | None:
    along_step = np.append(np.zeros(len(y) - 1), 1.0)
    y, direction, distance, longest = corrected(y, along_step), along_step, FIRST, 0.0
    if y is None:
        return None
    for _ in range(MOST):
        direction = np.linalg.solve(np.vstack([slopes(y)[1], direction]), along_step)
        direction /= np.linalg.norm(direction)
        new = corrected(y + distance * direction, direction)
        if new is None or not np.linalg.norm(new - y) < 2.0 * distance:
            distance /= 2.0
            if distance < SHORTEST:
                return None
            continue
        y, distance = new, min(1.5 * distance, LONGEST)
        if y[-1] >= 1.0:
            return Followed(h, True)
        if y[-1] < 0.98 * longest:
            return Followed(longest * h, False)
        longest = max(longest, y[-1])
    return None
