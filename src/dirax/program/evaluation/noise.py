"""Arithmetic in which every operation is off at random: how far rounding moves what comes out of a computation."""

from collections.abc import Callable
from typing import Any

import numpy as np

from dirax.program.operations import BOOLEAN, NUMPY

EXACT = BOOLEAN | {"select", "neg", "abs", "sign", "max", "min"}
"""The operations that do not round."""

ALIKE = 64.0
"""Numbers that differ by so many times what an operation is off are taken for the same where they are compared."""


class Noise:
    """Arithmetic in which the result of every operation is off at random, by up to `size` of itself (Vignes 1978): what
    happens to the numbers that come out is what rounding does to them, ε/2 in place of `size`.

    Where a function jumps, numbers that are nearly the place of it are taken to be there: t/h is a whole number at every row for
    a control that is held for a step, and which one it holds is not asked of the noise. Whole numbers are added and multiplied as
    they are, for they count and index."""

    def __init__(self, size: float, seed: int):
        self.size, self._draw = size, np.random.default_rng(seed)
        self.table = {name: function if name in EXACT else self._off(function) for name, function in NUMPY.items()}
        self.table |= {
            **{name: lambda x, y, name=name: self._unless_whole(NUMPY[name](x, y), x, y) for name in ("add", "sub", "mul")},
            **{name: lambda x, name=name: NUMPY[name](self._whole(x)) for name in ("floor", "ceil", "trunc")},
            "rem": lambda x, y: self.off(NUMPY["rem"](self._whole(x / y), 1.0) * y),
            "eq": lambda x, y: (x == y) | self._alike(x, y),
            "ne": lambda x, y: (x != y) & ~self._alike(x, y),
            "lt": lambda x, y: (x < y) & ~self._alike(x, y),
            "le": lambda x, y: (x <= y) | self._alike(x, y),
        }

    def _whole(self, x: Any) -> Any:
        """The same, but whole numbers where they nearly are."""
        whole = np.rint(x)
        return np.where(self._alike(x, whole), whole, x)

    def _unless_whole(self, result: Any, x: Any, y: Any) -> Any:
        """The result of two numbers, off but where these are whole."""
        return np.where((x == np.rint(x)) & (y == np.rint(y)), result, self.off(result))

    def _alike(self, x: Any, y: Any) -> Any:
        if np.asarray(x).dtype == bool:
            return np.equal(x, y)
        return np.abs(x - y) <= ALIKE * self.size * np.maximum(np.abs(x), np.abs(y))

    def draw(self, shape: tuple[int, ...]) -> np.ndarray:
        """Numbers at random, from 0 to 1."""
        return self._draw.random(shape)

    def off(self, values: Any) -> Any:
        """Numbers as they would be if they had been rounded."""
        return values * (1.0 + self.size * (2.0 * self.draw(np.shape(values)) - 1.0))

    def _off(self, function: Callable) -> Callable:
        return lambda *operands: self.off(function(*operands))
