"""SparseEquations: equations r(u, …) = 0 of many unknowns whose Jacobian is sparse; its entries, and solutions with it, in JAX."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse as sp
from jaxtyping import Array, Float

from dirax.numerics.sparse.colours import column_colours
from dirax.numerics.sparse.elimination import elimination
from dirax.program.sparsity import pattern_of

MOST_OPERATIONS = 0.02
"""Multiplications of an elimination, relative to those of the dense one (k³/3), from which on it is not worth its while: LAPACK
does some 20 of them in the time of one that follows indices."""


class NotSparse(Exception):
    """Raised where equations are not sparse enough; says why, in words that go on after "because"."""


class SparseEquations(eqx.Module):
    """What is known of the Jacobian of equations without its values: where entries are, and how it is factored.

    Values are those of one product with the sum of each colour's columns, (colours·k,). On a CPU.
    """

    pattern: Any = eqx.field(static=True)
    elimination: Any = eqx.field(static=True)
    count: int = eqx.field(static=True)
    """How many colours there are."""
    colours: Array
    tables: tuple[Array, ...]
    solve_tables: tuple[Array, ...]
    size: Array

    @classmethod
    def of(cls, function: Callable, unknowns: Any, *others: Any) -> "SparseEquations":
        """Those of `function(unknowns, *others)`, arguments as `pattern_of` takes them. Raises `Dense`, `NotSparse` and
        `StructurallySingular`."""
        pattern = pattern_of(function, unknowns, *others)
        pattern.sort_indices()
        return cls._of_pattern(pattern)

    @classmethod
    def _of_pattern(cls, pattern: sp.csr_matrix) -> "SparseEquations":
        size = pattern.shape[0]
        colours = column_colours(pattern)
        count = int(np.max(colours, initial=-1)) + 1
        if 3 * count > size:
            raise NotSparse(f"{count} products are needed to find the Jacobian of {size} equations")
        made = elimination(pattern)
        if made.operations > MOST_OPERATIONS * size**3 / 3:
            raise NotSparse(f"elimination takes {made.operations} operations, of {size} equations")
        entries = pattern.tocoo()
        numbers = 1 + colours[entries.col].astype(np.int64) * size + entries.row
        places = sp.csr_matrix((numbers, pattern.indices, pattern.indptr), pattern.shape)
        with jax.ensure_compile_time_eval():
            arrays = lambda given: tuple(map(jnp.asarray, given))
            return cls(
                _Static(pattern), made, count, jnp.asarray(colours), arrays(made.tables(places)), arrays(made.solve_tables),
                jnp.asarray([size], np.int64),
            )  # fmt: skip

    @property
    def stats(self) -> dict[str, Any]:
        """What `Solution.stats` says of it."""
        return {"unknowns": self.elimination.size, "entries": self.pattern.value.nnz, "colours": self.count} | self.elimination.stats

    def values(self, function: Callable, u: Float[Array, " k"]) -> Float[Array, " colours*k"]:
        """The values of the Jacobian of `function` at u."""
        _, linear = jax.linearize(function, u)
        sums = jnp.where(self.colours[None, :] == jnp.arange(self.count, dtype=self.colours.dtype)[:, None], 1.0, 0.0)
        return jax.vmap(linear)(sums).ravel()

    def matrix(self, values: np.ndarray) -> sp.csr_matrix:
        """The Jacobian with these values."""
        pattern = self.pattern.value
        entries, size = pattern.tocoo(), pattern.shape[0]
        data = np.asarray(values)[np.asarray(self.colours)[entries.col].astype(np.int64) * size + entries.row]
        return sp.csr_matrix((data, pattern.indices, pattern.indptr), pattern.shape)

    def factorise(self, values: Float[Array, " colours*k"]) -> Any:
        """The factors of the Jacobian with these values."""
        made = self.elimination
        shapes = [jax.ShapeDtypeStruct(shape, kind) for shape, kind in made.factor_shapes]
        return tuple(made.kernels[0].in_jax(shapes, *self.tables, values, self.size))[made.work_of_factor :]

    def solve(self, factors: Any, right: Float[Array, " k"], transposed: bool = False) -> Float[Array, " k"]:
        """x with J x = right, or Jᵀ x = right."""
        made = self.elimination
        shapes = [jax.ShapeDtypeStruct((n,), np.float64) for n in (*made.work, made.size)]
        return made.kernels[1 + transposed].in_jax(shapes, *self.solve_tables, *factors, right, self.size)[-1]


class _Static:
    """Holds a value that is compared by identity."""

    def __init__(self, value: Any):
        self.value = value
