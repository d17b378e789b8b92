"""The linear solver of sparse steps."""

from collections.abc import Callable
from typing import Any, NamedTuple

from dirax.engines.linear_solver import AbstractLinearSolver
from dirax.program.sparse_equations import SparseEquations


class InUnits(NamedTuple):
    """The values of a matrix, or its factors, for unknowns in units of these sizes: pivots are found small or large beside
    entries of their row and of their column."""

    values: Any
    sizes: Any


class SparseSolver(AbstractLinearSolver):
    """Solves with the sparse Jacobian of one equation, whose matrices are the values that `jacobian_of` gives; `values` is that
    function of (u, state, t, h, params) where it is known."""

    equations: SparseEquations
    values: Callable | None = None
    by_loops: bool = False
    """Whether `values` and the functions of the stage are compiled loops, which NumPy's arrays can be given to."""

    def jacobian_of(self, residual: Callable) -> Callable:
        """(u, *args) ↦ the values of the Jacobian of `residual(u, *args)`."""
        return self.values or (lambda u, *args: self.equations.values(lambda u: residual(u, *args), u))

    def factorise(self, matrix: Any) -> Any:
        if isinstance(matrix, InUnits):
            return InUnits(self.equations.factorise(matrix.values), matrix.sizes)
        return self.equations.factorise(matrix)

    def solve(self, factors: Any, right: Any) -> Any:
        if isinstance(factors, InUnits):
            return factors.sizes * self.equations.solve(factors.values, right)
        return self.equations.solve(factors, right)

    def solve_transposed(self, factors: Any, right: Any) -> Any:
        if isinstance(factors, InUnits):
            return self.equations.solve(factors.values, factors.sizes * right, transposed=True)
        return self.equations.solve(factors, right, transposed=True)

    def in_units(self, matrix: Any, sizes: Any) -> tuple[Any, Any]:
        scaled, units = self.equations.in_units(matrix, sizes)
        return InUnits(scaled, sizes), units
