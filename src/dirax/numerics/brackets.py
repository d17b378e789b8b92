"""Roots of many functions of one number at once, each in a bracket."""

from collections.abc import Callable

import numpy as np

SMALLEST = 1e-15
"""How far from a root its place may be, where the bracket is of the size 1."""

MOST = 200
"""Evaluations after which a bracket is as small as floats allow, even if every one has only halved it."""


def bracketed_roots(function: Callable, a: np.ndarray, b: np.ndarray, fa: np.ndarray, fb: np.ndarray) -> np.ndarray:
    """x (k,) between a and b (k,), where `function(x, which)` (j,) of the brackets of numbers `which` (j,) changes its sign.

    `fa` and `fb` are its values at both ends, of which one is negative and the other is not, or one positive and the other not
    (Chandrupatla 1997: inverse quadratic interpolation where it is safe, else bisection).
    """
    a, b, fa, fb = (np.array(x, float) for x in (b, a, fb, fa))
    found = np.where(fa == 0.0, a, b)
    on = np.flatnonzero((fa != 0.0) & (fb != 0.0))
    a, b, fa, fb = a[on], b[on], fa[on], fb[on]
    c, fc, part = a.copy(), fa.copy(), np.full(len(on), 0.5)
    for _ in range(MOST):
        if not len(on):
            break
        x = a + part * (b - a)
        fx = function(x, on)
        same = np.sign(fx) == np.sign(fa)
        c, fc = np.where(same, a, b), np.where(same, fa, fb)
        b, fb = np.where(same, b, a), np.where(same, fb, fa)
        a, fa = x, fx
        best = np.where(np.abs(fa) < np.abs(fb), a, b)
        found[on] = best
        with np.errstate(all="ignore"):
            least = (np.finfo(float).eps * np.abs(best) + SMALLEST) / np.abs(b - a)
            xi, phi = (a - b) / (c - b), (fa - fb) / (fc - fb)
            safe = (phi**2 < xi) & ((1.0 - phi) ** 2 < 1.0 - xi)
            inverse = fa / (fb - fa) * fc / (fb - fc) + (c - a) / (b - a) * fa / (fc - fa) * fb / (fc - fb)
        part = np.clip(np.where(safe, inverse, 0.5), least, 1.0 - least)
        go = (least < 0.5) & (fa != 0.0)
        on, a, b, c, fa, fb, fc, part = (array[go] for array in (on, a, b, c, fa, fb, fc, part))
    return found
