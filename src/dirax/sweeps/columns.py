"""NumPy code that was written for one point, run for many at once: arrays that stand for one array at every point."""

from collections.abc import Callable
from typing import Any

import numpy as np

ALONG = ("max", "min", "sum", "mean", "prod", "any", "all", "argmax", "argmin", "std", "var", "ptp", "median")
ALONG_NAN = ("nanmax", "nanmin", "nansum", "nanmean", "nanargmax", "nanargmin")
REDUCTIONS = {*ALONG, *ALONG_NAN, "amax", "amin", "count_nonzero"}
"""Functions of NumPy that take whole arrays, or one axis, to one number."""

ALONG_AXIS = {"cumsum", "cumprod", "diff", "flip", "sort", "gradient", "unwrap"}
"""Functions of NumPy that work along one axis, the last one by default."""


class Column(np.lib.mixins.NDArrayOperatorsMixin):
    """An array (…) at every point, `values` (B, …). Arithmetic, indices, and the functions of NumPy above act at each point;
    anything else raises `TypeError`, as what is no number does in an `if` or in `math`."""

    def __init__(self, values: np.ndarray):
        self.values = np.asarray(values)

    @property
    def shape(self) -> tuple[int, ...]:
        """The shape of the array at a point."""
        return self.values.shape[1:]

    @property
    def ndim(self) -> int:
        """The number of its axes."""
        return self.values.ndim - 1

    @property
    def size(self) -> int:
        """The number of its entries."""
        return int(np.prod(self.shape))

    @property
    def dtype(self) -> np.dtype:
        """The type of its entries."""
        return self.values.dtype

    @property
    def T(self) -> "Column":
        """The array with its axes the other way round."""
        return Column(self.values.transpose(0, *range(self.ndim, 0, -1)))

    def __len__(self) -> int:
        if not self.ndim:
            raise TypeError("len() of a number")
        return self.shape[0]

    def __iter__(self) -> Any:
        return (self[k] for k in range(len(self)))

    def __getitem__(self, which: Any) -> "Column":
        parts = which if isinstance(which, tuple) else (which,)
        if isinstance(parts[0], Column) and parts[0].ndim == 0 and parts[0].dtype.kind in "iu":
            return Column(self.values[np.arange(len(self.values)), parts[0].values])[parts[1:] or ...]
        if any(isinstance(part, Column | np.ndarray | list) or part is None for part in parts):
            raise TypeError("a column is indexed by numbers, slices, … and, first, a column of whole numbers")
        return Column(self.values[(slice(None), *parts)])

    def __array_ufunc__(self, ufunc: Any, method: str, *inputs: Any, **options: Any) -> Any:
        if method != "__call__" or options:
            return NotImplemented
        if any(isinstance(given, np.ndarray) and given.dtype == object for given in inputs):
            return np.frompyfunc(ufunc, len(inputs), ufunc.nout)(*map(_as_object, inputs))
        most = max(np.ndim(given) if not isinstance(given, Column) else given.ndim for given in inputs)
        found = ufunc(*(_aligned(given, most) for given in inputs))
        return tuple(map(Column, found)) if isinstance(found, tuple) else Column(found)

    def __array_function__(self, function: Any, types: Any, args: tuple, kwargs: dict) -> Any:
        name = function.__name__
        first, *rest = args
        if name in REDUCTIONS and isinstance(first, Column) and not rest[1:]:
            return first._reduced(function, *rest, **kwargs)
        if name in ALONG_AXIS and isinstance(first, Column) and not rest:
            return first._along(function, **kwargs)
        if name == "where" and len(args) == 3:
            most = max(given.ndim if isinstance(given, Column) else np.ndim(given) for given in args)
            return Column(np.where(*(_aligned(given, most) for given in args)))
        if name in ("stack", "concatenate") and not rest and kwargs.keys() <= {"axis"}:
            size = next(len(part.values) for part in first if isinstance(part, Column))
            axis = kwargs.get("axis", 0)
            return Column(function([spread(part, size) for part in first], axis=axis + (axis >= 0)))
        if name == "norm" and isinstance(first, Column) and not rest and kwargs.keys() <= {"axis"}:
            return Column(np.sqrt(np.square(first)._reduced(np.sum, **kwargs).values))
        return NotImplemented

    def _reduced(self, function: Callable, axis: Any = None, **options: Any) -> "Column":
        flat = self.values.reshape(len(self.values), -1)
        return Column(
            function(flat, axis=1, **options) if axis is None else function(self.values, axis=self._axis(axis), **options)
        )

    def _along(self, function: Callable, axis: Any = -1, **options: Any) -> "Column":
        if axis is None or not self.ndim:
            raise TypeError("it has no axis")
        return Column(function(self.values, axis=self._axis(axis), **options))

    def _axis(self, axis: Any) -> Any:
        if isinstance(axis, tuple):
            return tuple(map(self._axis, axis))
        if not -self.ndim <= axis < self.ndim:
            raise TypeError(f"it has {self.ndim} axes")
        return axis if axis < 0 else axis + 1

    def __getattr__(self, name: str) -> Any:
        """The methods of arrays, and what NumPy's functions call for arrays of objects: `.max(axis=0)`, `.sin()`."""
        if name in ALONG:
            return lambda *args, **options: self._reduced(getattr(np, name), *args, **options)
        ufunc = getattr(np, name, None)
        if isinstance(ufunc, np.ufunc) and ufunc.nin == 1:
            return lambda: ufunc(self)
        raise AttributeError(name)

    def __bool__(self) -> bool:
        raise TypeError("a column of numbers has no one truth value")

    __float__ = __int__ = __index__ = __complex__ = __bool__


def _aligned(given: Any, most: int) -> Any:
    """The numbers of a column with so many axes behind the first, so that NumPy broadcasts them at each point."""
    if not isinstance(given, Column):
        return given
    values = given.values
    return values.reshape(len(values), *(1,) * (most - given.ndim), *given.shape)


def _as_object(given: Any) -> Any:
    if isinstance(given, Column):
        boxed = np.empty((), object)
        boxed[()] = given
        return boxed
    return given


def spread(value: Any, size: int) -> np.ndarray:
    """A value made of columns and numbers as an array (B, …). Raises `TypeError` for anything else in it."""
    if isinstance(value, Column):
        return np.broadcast_to(value.values, (size, *value.shape))
    if isinstance(value, list | tuple):
        return np.stack([spread(entry, size) for entry in value], axis=1)
    array = np.asarray(value)
    if array.dtype != object:
        return np.broadcast_to(array, (size, *array.shape))
    entries = [spread(entry if isinstance(entry, Column) else float(entry), size) for entry in array.ravel()]
    return np.stack(entries, axis=1).reshape(size, *array.shape)
