"""Arithmetic in which every operation is off at random: how far rounding moves what comes out of a computation."""

from collections.abc import Callable

import numpy as np

from dirax.program.operations import BOOLEAN, NUMPY

EXACT = BOOLEAN | {"select", "neg", "abs", "sign", "max", "min", "floor", "ceil"}
"""The operations that do not round."""


class Noise:
    """Arithmetic in which the result of every operation is off at random, by up to `size` of itself (Vignes 1978): what
    happens to the numbers that come out is what rounding does to them, ε/2 in place of `size`."""

    def __init__(self, size: float, seed: int):
        self.size, self._draw = size, np.random.default_rng(seed)
        self.table = {name: function if name in EXACT else self._off(function) for name, function in NUMPY.items()}

    def off(self, values: np.ndarray) -> np.ndarray:
        """Numbers as they would be if they had been rounded."""
        return values * (1.0 + self.size * self._draw.uniform(-1.0, 1.0, np.shape(values)))

    def _off(self, function: Callable) -> Callable:
        return lambda *operands: self.off(function(*operands))
