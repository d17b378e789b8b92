"""Orders of the unknowns of a sparse matrix in which elimination makes little fill, and how much it is."""

from typing import Any

import numpy as np
import scipy.sparse as sp
from scipy.sparse import csgraph
from scipy.sparse.linalg import spilu

from dirax.numerics.loops.kernel import Kernel
from dirax.numerics.sparse import kernels

_count, _list = Kernel(kernels.count_fill, 3), Kernel(kernels.list_fill, 6)


def whole(array: Any, kind: type = np.int32) -> np.ndarray:
    """Whole numbers as loops take them."""
    return np.ascontiguousarray(array, kind)


def minimum_degree(both: Any) -> np.ndarray:
    """An order for a symmetric pattern, as SuperLU finds it before it factors anything."""
    return _by_superlu(both, "MMD_AT_PLUS_A", {"SymmetricMode": True})


def least_fill(pattern: Any, rows: np.ndarray) -> tuple[np.ndarray, int]:
    """An order of the columns, whatever rows are exchanged, of a pattern whose diagonal is full with its `rows` so; and how many
    entries there are at most below the diagonal of L, and as many above that of U.

    These patterns are in that of the factor of AᵀA (A. George, E. Ng, SIAM J. Sci. Stat. Comput. 8 (1987) 877).
    """
    turned = pattern[rows]
    both = sp.csr_matrix(turned + turned.T)
    orders = (
        minimum_degree(both),
        csgraph.reverse_cuthill_mckee(both, symmetric_mode=True).astype(int),
        _by_superlu(turned, "COLAMD", {}),
    )
    ones = sp.csr_matrix((np.ones(pattern.nnz, np.int32), pattern.indices, pattern.indptr), pattern.shape)
    square = sp.csr_matrix(ones.T @ ones)
    found = [(order, int(np.sum(fill_counts(square, order)[-1]))) for order in orders]
    return min(found, key=lambda choice: choice[1])


def fill_counts(both: Any, order: np.ndarray) -> tuple[Any, np.ndarray, np.ndarray]:
    """A symmetric pattern in an order, its elimination tree, and how many entries each column of L has below the diagonal."""
    turned = both[order][:, order].tocsr()
    turned.sort_indices()
    n = turned.shape[0]
    parent, mark, counts = np.zeros(n, np.int32), np.zeros(n, np.int32), np.zeros(n, np.int64)
    _count(whole(turned.indptr), whole(turned.indices), np.array([n]), parent, mark, counts)
    return turned, parent, counts


def fill(both: Any, order: np.ndarray) -> tuple[np.ndarray, ...]:
    """Where the columns of L begin, the rows of their entries; the same by rows, and where these are among those by columns."""
    turned, parent, counts = fill_counts(both, order)
    n, starts = len(order), np.concatenate([[0], np.cumsum(counts)])
    total = int(starts[-1])
    rows, left = np.zeros(total, np.int32), np.zeros(total, np.int32)
    left_starts, left_places = np.zeros(n + 1, np.int64), np.zeros(total, np.int64)
    _list(
        whole(turned.indptr), whole(turned.indices), parent, starts, np.array([n]), np.zeros(n, np.int32), np.zeros(n, np.int64),
        rows, left_starts, left, left_places,
    )  # fmt: skip
    return starts, rows, left_starts, left, left_places


def _by_superlu(pattern: Any, name: Any, options: Any) -> np.ndarray:
    size, columns = pattern.shape[0], sp.csc_matrix(pattern)
    numbers = sp.csc_matrix((np.ones(columns.nnz), columns.indices, columns.indptr), columns.shape)
    numbers = sp.csc_matrix(numbers + 1e3 * sp.identity(size, format="csc"))
    found = spilu(numbers, 1.0, 1.0, permc_spec=name, diag_pivot_thresh=0.0, options=options)
    order = np.empty(size, int)
    order[found.perm_c] = np.arange(size)
    return order
