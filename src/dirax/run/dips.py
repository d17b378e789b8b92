"""Changes of sign of functions of one number: between values of them, and beside places where they come near to zero."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

FINER, LEVELS = 8, 4
"""Around a place where a function comes near to zero, the points are as many times closer, again and again."""


class Changes(NamedTuple):
    """Places a and b between which functions of the numbers `which` change their signs, and their values there."""

    which: np.ndarray
    a: np.ndarray
    b: np.ndarray
    fa: np.ndarray
    fb: np.ndarray


def changes(before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Where the sign changes; a zero belongs to what comes before it."""
    return ((before < 0.0) & (after >= 0.0)) | ((before > 0.0) & (after <= 0.0))


def dips(before: np.ndarray, middle: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Where a function of one sign is nearest to zero in the middle, and bends so much that it may reach zero beside it, four
    times as much as a parabola has to."""
    sign = np.sign(middle)
    before, middle, after = sign * before, sign * middle, sign * after
    bend = before - 2.0 * middle + after
    return (middle > 0.0) & (middle <= before) & (middle <= after) & (middle <= bend / 2.0)


def changes_beside_dips(value: Callable, low: np.ndarray, high: np.ndarray) -> Changes:
    """The changes of sign of `value(x, which)` between two places (k,) around each of those where it is nearest to zero."""
    found, parts, which = [], np.arange(2 * FINER + 1) / (2 * FINER), np.arange(len(low))
    for _ in range(LEVELS):
        x = low[:, None] + (high - low)[:, None] * parts
        values = value(x.ravel(), np.repeat(which, x.shape[1])).reshape(x.shape) if len(which) else x
        change = changes(values[:, :-1], values[:, 1:])
        some, at = np.nonzero(change)
        found.append(Changes(which[some], x[some, at], x[some, at + 1], values[some, at], values[some, at + 1]))
        left = np.flatnonzero(~change.any(axis=1))
        lowest = np.clip(np.argmin(np.abs(values[left]), axis=1), 1, x.shape[1] - 2)
        near = dips(*(values[left, lowest + i] for i in (-1, 0, 1)))
        left, lowest = left[near], lowest[near]
        which, low, high = which[left], x[left, lowest - 1], x[left, lowest + 1]
    return Changes(*map(np.concatenate, zip(*found, strict=True)))
