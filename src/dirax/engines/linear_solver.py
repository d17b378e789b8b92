"""AbstractLinearSolver: what solves the linear equations of Newton's method."""

from abc import abstractmethod
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float


class AbstractLinearSolver(eqx.Module):
    """Solves J x = b for the Jacobian J of a step: `Xla(linear_solver=…)`, of your own as one class.

        class QR(dx.AbstractLinearSolver):
            def factorise(self, matrix):
                return jnp.linalg.qr(matrix)

            def solve(self, factors, right):
                q, r = factors
                return jax.scipy.linalg.solve_triangular(r, q.T @ right)

    Both act on one trajectory and are traced by JAX. Derivatives of a run need no more: they solve with J and its transpose, and
    nothing is differentiated through. What is known of all matrices, a pattern and what follows from it alone, belongs in the
    fields of the solver.
    """

    @abstractmethod
    def factorise(self, matrix: Float[Array, "k k"]) -> Any:
        """What has to be done once for a matrix: any pytree of arrays, the matrix itself for an iterative method."""

    @abstractmethod
    def solve(self, factors: Any, right: Float[Array, " k"]) -> Float[Array, " k"]:
        """x with matrix·x = right."""

    def solve_transposed(self, factors: Any, right: Float[Array, " k"]) -> Float[Array, " k"]:
        """x with matrixᵀ·x = right, which reverse mode needs: JAX transposes `solve`, unless a solver knows better, or has to
        say it because its `solve` is a loop or a call of a library."""
        return jax.linear_transpose(lambda b: self.solve(factors, b), right)(right)[0]

    def in_units(self, matrix: Any, sizes: Float[Array, " k"]) -> tuple[Any, Any]:
        """The matrix with its rows in units of the terms of their equations, among which pivots are chosen, where the unknowns
        have these sizes, and what the rows are multiplied with. A solver that chooses pivots in another way leaves them."""
        unit = 1.0 / (jnp.abs(matrix) @ sizes)
        return unit[:, None] * matrix, unit
