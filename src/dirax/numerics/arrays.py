"""The arrays that signatures name: of NumPy where the numbers are known, of JAX where they are traced; whether two agree, whether
a type has the numbers of one, and whether a value is a whole number."""

from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from jaxtyping import Array

if TYPE_CHECKING:
    AnyArray: TypeAlias = Array | np.ndarray
    Numbers: TypeAlias = Array  # what both have in common is what JAX's arrays have, and that is all that is used of them
else:
    AnyArray = Array | np.ndarray | np.generic  # a number from which NumPy took the axes is an array without any
    Numbers = AnyArray
"""Numbers that are known (numpy) or traced (JAX): `AnyArray` in functions that tell the two apart, `Numbers` in those that treat
them alike."""

Data: TypeAlias = dict[str, Numbers]
"""Initial data of one trajectory by name, or the fields of one saved row."""


def agree(a: np.ndarray, b: np.ndarray, tolerance: float, axis: int | None = None) -> bool:
    """Whether two arrays of one shape are closer than `tolerance` times the largest entry of the second, or the largest along
    `axis`, whatever units that is in. Entries that are not finite must be the same."""
    largest = np.max(np.abs(b), axis=axis, keepdims=True, initial=0.0, where=np.isfinite(b))
    return a.shape == b.shape and np.allclose(a, b, rtol=0.0, atol=tolerance * largest, equal_nan=True)


def as_type(array: np.ndarray, dtype: np.dtype) -> np.ndarray | None:
    """The same numbers in another type; None where that does not have all of them."""
    if np.can_cast(array.dtype, dtype, "safe"):
        return array.astype(dtype)
    with np.errstate(all="ignore"):
        found = array.astype(dtype)
    return found if np.array_equal(found, array, equal_nan=array.dtype.kind == dtype.kind == "f") else None


def is_whole(value: Any) -> bool:
    """Whether it is a whole number of Python or NumPy."""
    return isinstance(value, int | np.integer) and not isinstance(value, bool)
