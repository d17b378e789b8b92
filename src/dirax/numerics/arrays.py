"""The arrays that signatures name: of NumPy where the numbers are known, of JAX where they are traced."""

from typing import TYPE_CHECKING, TypeAlias

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
