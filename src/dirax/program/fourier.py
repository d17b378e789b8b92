"""Discrete Fourier transforms in real numbers, as products with the matrices of their cosines and sines."""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jax.lax import FftType

Parts = tuple[Any, Any]
"""The real and the imaginary part of an array."""


def fourier(kind: FftType, lengths: tuple[int, ...], re: Any, im: Any) -> Any:
    """What `jax.lax.fft` does with the last axes: the parts of the result, or the result where that is real."""
    axes = list(range(re.ndim - len(lengths), re.ndim))
    if kind == FftType.IRFFT:
        for axis in axes[:-1]:
            re, im = _along(axis, re, im, 1.0)
        return _to_real(re, im, lengths[-1])
    forward = kind in (FftType.FFT, FftType.RFFT)
    for axis in reversed(axes):
        re, im = _along(axis, re, im, -1.0 if forward else 1.0)
        if kind == FftType.RFFT and axis == axes[-1]:
            half = lengths[-1] // 2 + 1
            re, im = re[..., :half], im[..., :half]
    return re, im


def _waves(n: int, rows: int) -> tuple[np.ndarray, np.ndarray]:
    """cos(2πjk/n) and sin(2πjk/n), (rows, n), with those that are zero so to the last bit."""
    turn = np.outer(np.arange(rows), np.arange(n)) % n
    angle = 2 * np.pi * turn / n
    cosine, sine = np.cos(angle), np.sin(angle)
    cosine[4 * turn % (2 * n) == n] = 0.0
    sine[2 * turn % n == 0] = 0.0
    return cosine, sine


def _along(axis: int, re: Any, im: Any, way: float) -> Parts:
    """Σ_j x_j exp(±2πi jk/n) along an axis, over n for the way back."""
    n = re.shape[axis]
    cosine, sine = _waves(n, n)
    scale = 1.0 if way < 0 else 1.0 / n
    by = lambda table, x: jnp.moveaxis(jnp.moveaxis(x, axis, -1) @ jnp.asarray(scale * table), -1, axis)
    return by(cosine, re) - by(way * sine, im), by(cosine, im) + by(way * sine, re)


def _to_real(re: Any, im: Any, n: int) -> Any:
    """The real array of n entries whose transform begins with these n//2 + 1."""
    half = n // 2 + 1
    cosine, sine = _waves(n, half)
    both = np.where((np.arange(half) == 0) | (2 * np.arange(half) == n), 1.0, 2.0)[:, None] / n
    return re[..., :half] @ jnp.asarray(both * cosine) - im[..., :half] @ jnp.asarray(both * sine)
