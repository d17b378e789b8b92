"""Single numbers among the arguments of a run, checked."""

import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dirax.numerics.arrays import is_whole
from dirax.program.user_functions import is_traced

MOST_COUNTED = 2**63 - 1
"""The largest number of steps: engines count them in 64 bits."""


def finite(value, name: str):
    """The number, or the traced value as it is; raises `ValueError` for anything that is not one finite number."""
    if type(value) is float and math.isfinite(value):
        return value
    if is_traced(value):
        return value
    if not math.isfinite(number := _float(value)):
        raise ValueError(f"{name} must be a finite number, but {_shown(value)} was given.")
    return number


def positive(value, name: str):
    """The same for a positive number."""
    if type(value) is float and 0.0 < value < math.inf:
        return value
    if is_traced(value):
        return value
    if not 0.0 < (number := _float(value)) < math.inf:
        raise ValueError(f"{name} must be a positive finite number, but {_shown(value)} was given.")
    return number


def _float(value: Any) -> float:
    """A number as a float, infinite where it is too large for one; NaN for what is no real number."""
    if not is_number(value) or np.ndim(value) != 0 or not (isinstance(value, int | float) or is_real(value.dtype)):
        return math.nan
    try:
        return float(value)
    except OverflowError:
        return math.inf


def count(value, name: str, most: int = MOST_COUNTED) -> int:
    """The whole number; raises `ValueError` for anything else, below 1 and above `most`."""
    if type(value) is int and 1 <= value <= most:
        return value
    if not is_whole(value) or value < 1:
        raise ValueError(f"{name} must be a whole number ≥ 1, but {_shown(value)} was given.")
    if value > most:
        bound = "2⁶³ − 1, which is what 64 bits count" if most == MOST_COUNTED else f"{most}"
        raise ValueError(f"{name} must be at most {bound}, but {_shown(int(value))} was given.")
    return int(value)


def whole_number(value, name: str) -> int:
    """The whole number; raises `TypeError` for anything else."""
    if not is_whole(value):
        raise TypeError(f"{name} must be a whole number, but {value!r:.80} was given.")
    return int(value)


def flag(value, name: str) -> bool:
    """True or False; raises `TypeError` for anything else."""
    if not isinstance(value, bool | np.bool_):
        raise TypeError(f"{name} must be True or False, but {value!r:.80} was given.")
    return bool(value)


def _shown(value: Any) -> str:
    large = type(value) is int and abs(value) >= 10**21
    return f"a number of {value.bit_length()} bits" if large else f"{value!r:.80}"


def is_number(leaf: Any) -> bool:
    """Whether a value is a number or an array of them; times are none."""
    if isinstance(leaf, np.ndarray | np.generic | jax.Array):
        return jnp.issubdtype(leaf.dtype, jnp.number) and leaf.dtype.kind not in "mM"
    return isinstance(leaf, int | float) and not isinstance(leaf, bool)


def is_real(dtype: Any) -> bool:
    """Whether an array holds real numbers; those of times are whole ones for NumPy."""
    return jnp.issubdtype(dtype, jnp.floating) or dtype.kind in "iu"
