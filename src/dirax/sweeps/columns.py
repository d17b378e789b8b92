"""NumPy code that was written for numbers, run on many at once: a number that stands for a column of them."""

from typing import Any

import numpy as np


class Column(np.lib.mixins.NDArrayOperatorsMixin):
    """A number at every point, `values` (B,): arithmetic and NumPy's functions go entry by entry. It is no number that can be
    compared in an `if` or handed to `math`, which raises `TypeError`."""

    def __init__(self, values: np.ndarray):
        self.values = values

    def __array_ufunc__(self, ufunc: Any, method: str, *inputs: Any, **options: Any) -> Any:
        if method != "__call__" or options:
            return NotImplemented
        if any(isinstance(given, np.ndarray) and given.ndim for given in inputs):
            # an array of numbers and columns together: entry by entry
            return np.frompyfunc(ufunc, len(inputs), ufunc.nout)(*map(_as_objects, inputs))
        found = ufunc(*(given.values if isinstance(given, Column) else given for given in inputs))
        return tuple(map(Column, found)) if isinstance(found, tuple) else Column(found)

    def __getattr__(self, name: str) -> Any:
        """What NumPy's functions of arrays of objects call: `.sin()` and others."""
        ufunc = getattr(np, name, None)
        if isinstance(ufunc, np.ufunc) and ufunc.nin == 1:
            return lambda: ufunc(self)
        raise AttributeError(name)

    def __bool__(self) -> bool:
        raise TypeError("a column of numbers has no one truth value")

    __float__ = __int__ = __index__ = __complex__ = __bool__


def _as_objects(given: Any) -> Any:
    if isinstance(given, Column):
        boxed = np.empty((), object)
        boxed[()] = given
        return boxed
    return given


def spread(value: Any, size: int) -> np.ndarray:
    """A value made of columns and numbers as an array (B, …). Raises `TypeError` for anything else in it."""
    if isinstance(value, Column):
        return np.broadcast_to(value.values, (size,))
    array = np.asarray(value)
    if array.dtype != object:
        return np.broadcast_to(array, (size, *array.shape))
    entries = []
    for entry in array.ravel():
        if not isinstance(entry, Column | int | float | np.number):
            raise TypeError(f"{type(entry).__name__} is no number")
        entries.append(np.broadcast_to(entry.values if isinstance(entry, Column) else entry, (size,)))
    return np.stack(entries, axis=1).reshape(size, *array.shape)
