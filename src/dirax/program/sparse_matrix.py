"""SparseMatrix: a constant matrix with few entries, where a function would else return an array."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np


class SparseMatrix:
    """A constant sparse matrix in functions that JAX traces: `matrix @ vector`, its transpose, columns, sums and absolute values.

    Anything else takes it as the dense array that it stands for.
    """

    def __init__(self, matrix: Any, shape: tuple[int, int] | None = None):
        from scipy.sparse import csr_matrix  # imported when it is used

        self.matrix: Any = csr_matrix(matrix, shape, dtype=float)
        self.matrix.sum_duplicates()

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, columns)."""
        return self.matrix.shape

    @property
    def T(self) -> "SparseMatrix":
        """The transpose."""
        return SparseMatrix(self.matrix.T)

    def __matmul__(self, vector: Any) -> Any:
        if np.ndim(vector) != 1:
            return jnp.asarray(self) @ vector
        entries = self.matrix.tocoo()
        terms = jnp.asarray(entries.data) * vector[entries.col]
        return jax.ops.segment_sum(terms, entries.row, self.shape[0], indices_are_sorted=True)

    def __rmatmul__(self, vector: Any) -> Any:
        return self.T @ vector

    def __add__(self, other: Any) -> Any:
        return SparseMatrix(self.matrix + other.matrix) if isinstance(other, SparseMatrix) else jnp.asarray(self) + other

    def __sub__(self, other: Any) -> Any:
        return SparseMatrix(self.matrix - other.matrix) if isinstance(other, SparseMatrix) else jnp.asarray(self) - other

    def __neg__(self) -> "SparseMatrix":
        return SparseMatrix(-self.matrix)

    def __abs__(self) -> "SparseMatrix":
        return SparseMatrix(abs(self.matrix))

    def __getitem__(self, index: Any) -> "SparseMatrix":
        return SparseMatrix(self.matrix[index])

    def __jax_array__(self) -> jax.Array:
        return jnp.asarray(self.matrix.toarray())

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> np.ndarray:
        return self.matrix.toarray().astype(dtype or float)

    def __repr__(self) -> str:
        return f"SparseMatrix{self.shape} with {self.matrix.nnz} entries"
