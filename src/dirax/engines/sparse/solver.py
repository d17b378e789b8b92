"""The linear solver of sparse steps."""

from collections.abc import Callable
from typing import Any

from dirax.engines.linear_solver import AbstractLinearSolver
from dirax.program.sparse_equations import SparseEquations


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
        return self.equations.factorise(matrix)

    def solve(self, factors: Any, right: Any) -> Any:
        return self.equations.solve(factors, right)

    def solve_transposed(self, factors: Any, right: Any) -> Any:
        return self.equations.solve(factors, right, transposed=True)

    def in_units(self, matrix: Any, sizes: Any) -> tuple[Any, Any]:
        return matrix, 1.0
