"""Which reads of entries have to be inside their arrays: those for which nobody has said what to read outside."""

from typing import Any

import numpy as np
from jax.extend.core import jaxprs_in_params
from jax.lax import GatherScatterMode

INDEXING = ("dynamic_slice", "gather")
"""What JAX turns an index into when it is not known to be inside the array."""

BY_BRACKETS = "_getitem"
"""The function of JAX that `x[i]` calls: the same read, clamped into the array, is what other functions document."""


def unguarded(equation: Any) -> bool:
    """Whether an equation reads at an index that was meant to be inside the array: without `mode="clip"`, a value for
    `mode="fill"`, or a function that documents that it clamps, as `jax.lax.dynamic_slice` does."""
    if equation.primitive.name not in INDEXING:
        return False
    mode, trace = equation.params.get("mode", GatherScatterMode.CLIP), equation.source_info.traceback
    if mode == GatherScatterMode.FILL_OR_DROP:
        return _is_default(equation.params["fill_value"], equation.outvars[0].aval.dtype)
    if mode != GatherScatterMode.CLIP or trace is None:
        return True
    return any(frame.function_name == BY_BRACKETS for frame in trace.frames)


def _is_default(value: Any, dtype: np.dtype) -> bool:
    """Whether a value is what JAX fills in where none is given."""
    if value is None or not np.issubdtype(dtype, np.integer):
        return value is None or bool(np.isnan(value))
    limits = np.iinfo(dtype)
    return int(value) == (limits.min if limits.min else limits.max)


def indexes(jaxpr: Any) -> bool:
    """Whether an index occurs that has to be inside its array, and that JAX could not see to be so."""
    inner = [sub for equation in jaxpr.eqns for sub in jaxprs_in_params(equation.params)]
    return any(map(unguarded, jaxpr.eqns)) or any(map(indexes, inner))


def clamps(jaxpr: Any) -> bool:
    """Whether an index occurs that may be outside."""
    inner = [sub for equation in jaxpr.eqns for sub in jaxprs_in_params(equation.params)]
    return any(e.primitive.name in INDEXING and not unguarded(e) for e in jaxpr.eqns) or any(map(clamps, inner))
