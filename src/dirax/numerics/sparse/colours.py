"""Colours of the columns of a sparse matrix, so that one product with each colour's sum gives all its entries."""

from typing import Any

import numpy as np

from dirax.numerics.loops.kernel import Kernel
from dirax.numerics.sparse import kernels

_greedy = Kernel(kernels.greedy_colours, 2)


def column_colours(pattern: Any) -> np.ndarray:
    """A colour (columns,) for each column such that no row has two columns of one colour."""
    whole = lambda a: np.ascontiguousarray(a, np.int32)
    by_columns = pattern.tocsc()
    size = pattern.shape[1]
    colours, last = np.zeros(size, np.int32), np.zeros(size + 1, np.int32)
    _greedy(
        *map(whole, (pattern.indptr, pattern.indices, by_columns.indptr, by_columns.indices)), np.array([size]), last, colours
    )
    return colours
