"""A function of one row at all rows that arrays hold."""

import math
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from dirax.program.evaluation.functions import in_numpy
from dirax.program.user_functions import is_traced


def each_row(rows: dict[str, Any], function: Callable) -> dict[str, Any]:
    """`function(row)` of every row, in NumPy where it has a scalar program; the first of the arrays is one number a coordinate,
    with the axes of the rows in front."""
    names, lead = tuple(rows), np.shape(next(iter(rows.values())))[:-1]
    if not is_traced(rows) and math.prod(lead):
        entries = [np.asarray(a).reshape(math.prod(lead), *np.shape(a)[len(lead) :]) for a in rows.values()]
        found = in_numpy(lambda *values: function(dict(zip(names, values, strict=True))), entries, (function, names))
        if found is not None:
            return {name: a.reshape(*lead, *a.shape[1:]) for name, a in found.items()}
    for _ in lead:
        function = jax.vmap(function)
    return plain(function(rows))


def plain(fields: dict[str, Any]) -> dict[str, Any]:
    """Fields as NumPy's arrays, but for those that JAX traces."""
    return {name: np.asarray(a) if not is_traced(a) else a for name, a in fields.items()}
