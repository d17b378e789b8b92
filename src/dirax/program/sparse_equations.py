"""SparseEquations: equations r(u, …) = 0 of many unknowns with a sparse Jacobian: its entries, and solutions with it, in JAX."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse as sp
from jaxtyping import Array, Float

from dirax.numerics.loops.kernel import Kernel
from dirax.numerics.sparse import kernels
from dirax.numerics.sparse.border import full_lines
from dirax.numerics.sparse.colours import column_colours
from dirax.numerics.sparse.elimination import elimination, numbered, places
from dirax.numerics.sparse.orders import whole
from dirax.program.sparsity import pattern_of

DENSE_OPERATION, DENSE_ENTRY = 0.05, 4.0
SPARSE_OPERATION, SPARSE_ROW = 1.2, 60.0
"""Nanoseconds that elimination takes: LAPACK for each of its k³/3 multiplications, and the columns of a dense Jacobian for each
entry; elimination that follows indices for each multiplication, and each equation."""


_in_units = Kernel(kernels.in_units, 2)


class SparseEquations(eqx.Module):
    """What is known of the Jacobian of equations without its values: where entries are, and how it is factored.

    Values are those of one product with the sum of each colour's columns, and of one from the left with each full row,
    (products·k,); or of the entries alone, in the order in which they were given. On a CPU.
    """

    pattern: Any = eqx.field(static=True)
    """Where entries are, with the numbers of their values, from 1."""
    length: int = eqx.field(static=True)
    """How many values there are."""
    elimination: Any = eqx.field(static=True)
    count: int = eqx.field(static=True)
    """How many colours there are."""
    full_rows: tuple[int, ...] = eqx.field(static=True)
    """The rows with far more entries than others, which colours do not regard."""
    colours: Array
    tables: tuple[Array, ...]
    solve_tables: tuple[Array, ...]
    size: Array
    entries: tuple[Array, ...]
    """Rows and columns of the entries, where they are among the values, and how many of all there are."""

    @classmethod
    def of(cls, function: Callable, unknowns: Any, *others: Any) -> "SparseEquations":
        """Those of `function(unknowns, *others)`, arguments as `pattern_of` takes them. Raises `Dense` and
        `StructurallySingular`."""
        return cls._of_pattern(pattern_of(function, unknowns, *others))

    @classmethod
    def of_entries(cls, size: int, rows: np.ndarray, columns: np.ndarray) -> "SparseEquations":
        """Those of a Jacobian (size, size) whose values are the entries at these rows and columns, each once. Raises
        `StructurallySingular`."""
        return cls._of_pattern(numbered(size, rows, columns), len(rows))

    @property
    def products(self) -> int:
        """How many products with vectors have all the values."""
        return self.count + len(self.full_rows)

    @classmethod
    def _of_pattern(cls, pattern: Any, length: int | None = None) -> "SparseEquations":
        """With values in the order of `pattern`, which is numbers from 1 to `length`, or by colours."""
        pattern.sort_indices()
        size = pattern.shape[0]
        full_rows, _ = full_lines(pattern)
        colours = column_colours(pattern[np.setdiff1d(np.arange(size), full_rows)] if len(full_rows) else pattern)
        count = int(np.max(colours, initial=-1)) + 1
        full, made = tuple(full_rows.tolist()), elimination(places(pattern))
        total = (count + len(full)) * size if length is None else length
        if length is None:
            entries = pattern.tocoo()
            numbers = 1 + _places(size, colours, count, full, entries.row, entries.col)
            pattern = sp.csr_matrix((numbers, pattern.indices, pattern.indptr), pattern.shape)
        entries = pattern.tocoo()
        of_entries = *(whole(a) for a in (entries.row, entries.col, entries.data - 1)), np.array([size, pattern.nnz, total])
        with jax.ensure_compile_time_eval():
            put = jax.device_put  # `jnp.asarray` compiles a program of its own for each shape, of which XLA keeps a megabyte
            arrays = lambda given: tuple(map(put, given))
            return cls(
                _Static(pattern), total, made, count, full, put(colours), arrays(made.tables(pattern)),
                arrays(made.solve_tables), put(np.array([size], np.int64)), arrays(of_entries),
            )  # fmt: skip

    @property
    def slower(self) -> str | None:
        """Why elimination as of a dense matrix is quicker, where it is."""
        made, size = self.elimination, self.elimination.size
        sparse = size * (SPARSE_ROW + DENSE_ENTRY * self.products) + SPARSE_OPERATION * made.operations
        if sparse < size**2 * (DENSE_OPERATION * size / 3 + DENSE_ENTRY):
            return None
        return f"the Jacobian of {size} equations takes {self.products} products, and {made.operations} multiplications to factor"

    @property
    def stats(self) -> dict[str, Any]:
        """What `Solution.stats` says of it."""
        return {
            "unknowns": self.elimination.size,
            "entries": self.pattern.value.nnz,
            "colours": self.count,
        } | self.elimination.stats

    def values(self, function: Callable, u: Float[Array, " k"]) -> Float[Array, " values"]:
        """The values of the Jacobian of `function` at u, by colours."""
        assert self.length == self.products * self.elimination.size, "values of entries have another order"
        _, linear = jax.linearize(function, u)
        sums = jnp.where(self.colours[None, :] == jnp.arange(self.count, dtype=self.colours.dtype)[:, None], 1.0, 0.0)
        columns = jax.vmap(linear)(sums).ravel()
        if not self.full_rows:
            return columns
        transposed = jax.linear_transpose(linear, u)
        rows = [transposed(jnp.zeros_like(u).at[row].set(1.0))[0] for row in self.full_rows]
        return jnp.concatenate([columns, *rows])

    def matrix(self, values: np.ndarray) -> Any:
        """The Jacobian with these values."""
        pattern = self.pattern.value
        return sp.csr_matrix((np.asarray(values)[pattern.data - 1], pattern.indices, pattern.indptr), pattern.shape)

    def values_of(self, matrix: Any) -> np.ndarray:
        """The values of a matrix of this pattern."""
        entries, pattern = matrix.tocoo(), self.pattern.value
        values = np.zeros(self.length)
        values[np.asarray(pattern[entries.row, entries.col]).ravel() - 1] = entries.data
        return values

    def in_units(self, values: Any, sizes: Any, xp: Any = jnp) -> tuple[Any, Any]:
        """The values of the Jacobian for unknowns of the size 1, where they have these sizes, with its rows in units of their
        terms; and what the rows are multiplied with."""
        shapes = [((self.elimination.size,), np.float64), ((self.length,), np.float64)]
        entries = self.entries if xp is jnp else tuple(map(np.asarray, self.entries))
        units, scaled = _in_units.by(xp, shapes, *entries[:3], values, sizes, entries[3])
        return scaled, units

    def factorise(self, values: Float[Array, " values"]) -> Any:
        """The factors of the Jacobian with these values."""
        return self.elimination.factors(jnp, self.tables, values, self.size)

    def solve(self, factors: Any, right: Float[Array, " k"], transposed: bool = False) -> Float[Array, " k"]:
        """x with J x = right, or Jᵀ x = right."""
        return self.elimination.solution(jnp, self.solve_tables, factors, right, self.size, transposed)

    def solved(self, values: Any, right: Any, xp: Any) -> Any:
        """x with J x = right for the Jacobian with these values, by NumPy or by JAX."""
        return self.in_numpy(values)(right) if xp is np else self.solve(self.factorise(values), right)

    def root(self, function: Callable, root: Float[Array, " k"]) -> Float[Array, " k"]:
        """`root`, with its derivatives as the function of what `function` captures that function(root) = 0 makes of it."""

        def solved(linear, right):
            factors = self.factorise(jax.lax.stop_gradient(self.values(function, root)))
            of_factors = lambda transposed: lambda _, b: self.solve(factors, b, transposed)
            return jax.lax.custom_linear_solve(linear, right, of_factors(False), of_factors(True))

        return jax.lax.custom_root(function, root, lambda _, u: u, solved)

    def in_numpy(self, values: np.ndarray) -> Callable[..., np.ndarray]:
        """(right, transposed=False) ↦ the solution with the Jacobian of these values, in NumPy."""
        made, size = self.elimination, np.asarray(self.size)
        tables, solve_tables = (tuple(map(np.asarray, arrays)) for arrays in (self.tables, self.solve_tables))
        factors = made.factors(np, tables, np.ascontiguousarray(values, float), size)

        def solve(right: np.ndarray, transposed: bool = False) -> np.ndarray:
            return made.solution(np, solve_tables, factors, np.ascontiguousarray(right, float), size, transposed)

        return solve


def _places(size: int, colours: np.ndarray, count: int, full_rows: tuple, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """Where the entries at these rows and columns are among the values."""
    places = colours[columns].astype(np.int64) * size + rows
    for number, row in enumerate(full_rows):
        places = np.where(rows == row, (count + number) * size + columns, places)
    return places


class _Static:
    """Holds a value that is compared by identity."""

    def __init__(self, value: Any):
        self.value = value
