"""Discrete principal connections for abelian groups acting by addition on Q = Σ × G ([RL] §3)."""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float


class LinearConnection(eqx.Module):
    """The linear connection ω_d(q0, q1) = g1 − g0 − A(x1 − x0) with horizontal lift h_d(q0, x1) = g0 + A(x1 − x0).

    `fibre`: the indices of q that are the group G = R^k (or a torus, by addition of angles); the others, in order, are
    the shape x ∈ Σ. `horizontal`: the matrix A (k, n − k) of h_{d,Σ}(x1) = A x1, zero by default. Then
    h_{d,Q}(q0) = g0 − A x0 and h⁰_d(x0, x1) = A(x1 − x0) ([RL] §3.2).

        connection = dx.LinearConnection(fibre=[3])

    Raises `ValueError` for repeated or negative indices, or A of a wrong shape (as soon as n is known).
    """

    fibre: tuple[int, ...] = eqx.field(static=True)
    horizontal: tuple[tuple[float, ...], ...] | None = eqx.field(static=True)

    def __init__(self, fibre: Sequence[int], horizontal: Any = None):
        indices = tuple(int(i) for i in np.atleast_1d(np.asarray(fibre)))
        if not indices or len(set(indices)) != len(indices) or min(indices) < 0:
            raise ValueError(f"fibre must hold different non-negative indices of coordinates, but {fibre!r} was given.")
        self.fibre = indices
        self.horizontal = None
        if horizontal is not None:
            matrix = np.asarray(horizontal, dtype=float)
            if matrix.ndim != 2 or matrix.shape[0] != len(indices) or not np.all(np.isfinite(matrix)):
                raise ValueError(
                    f"horizontal must be a finite matrix of shape (k, n − k) with k = {len(indices)} rows, one a group "
                    f"coordinate, but its shape is {matrix.shape}."
                )
            self.horizontal = tuple(map(tuple, matrix.tolist()))

    def check(self, n: int) -> None:
        """Raise `ValueError` where the indices or A do not fit n coordinates."""
        if max(self.fibre) >= n or len(self.fibre) > n:
            raise ValueError(f"fibre {list(self.fibre)} does not fit a system of {n} coordinates, numbered 0 to {n - 1}.")
        if self.horizontal is not None and len(self.horizontal[0]) != n - len(self.fibre):
            raise ValueError(
                f"horizontal must have shape ({len(self.fibre)}, {n - len(self.fibre)}) for {n} coordinates with fibre "
                f"{list(self.fibre)}, but it has {len(self.horizontal[0])} columns."
            )

    def shape_indices(self, n: int) -> np.ndarray:
        """The indices of q that are the shape coordinates x."""
        return np.setdiff1d(np.arange(n), self.fibre)

    def split(self, q: Float[Array, " n"]) -> tuple[Float[Array, " n-k"], Float[Array, " k"]]:
        """q (or p, or v) as its (x, g) parts."""
        return q[self.shape_indices(q.shape[-1])], q[np.array(self.fibre)]

    def join(self, x: Float[Array, " n-k"], g: Float[Array, " k"]) -> Float[Array, " n"]:
        """The inverse of `split`."""
        n = x.shape[-1] + g.shape[-1]
        order = np.argsort(np.concatenate([self.shape_indices(n), self.fibre]))
        return jnp.concatenate([x, g])[order]

    def matrix(self, n: int) -> Float[Array, "k n-k"]:
        """A."""
        k = len(self.fibre)
        return jnp.zeros((k, n - k)) if self.horizontal is None else jnp.asarray(self.horizontal)

    def one_form(self, q0: Float[Array, " n"], q1: Float[Array, " n"]) -> Float[Array, " k"]:
        """ω_d(q0, q1) = g1 − g0 − A(x1 − x0): e on the diagonal, and ω_d(g q0, g' q1) = g' ω_d(q0, q1) g⁻¹."""
        (x0, g0), (x1, g1) = self.split(q0), self.split(q1)
        return g1 - g0 - self.matrix(q0.shape[-1]) @ (x1 - x0)

    def horizontal_lift(self, q0: Float[Array, " n"], x1: Float[Array, " n-k"]) -> Float[Array, " k"]:
        """h_d(q0, x1) = g0 + A(x1 − x0): the group coordinate of the point over x1 that is horizontal from q0."""
        x0, g0 = self.split(q0)
        return g0 + self.matrix(q0.shape[-1]) @ (x1 - x0)

    def lift_of_point(self, q0: Float[Array, " n"]) -> Float[Array, " k"]:
        """h_{d,Q}(q0) = g0 − A x0."""
        x0, g0 = self.split(q0)
        return g0 - self.matrix(q0.shape[-1]) @ x0

    def lift_of_shape(self, x1: Float[Array, " n-k"]) -> Float[Array, " k"]:
        """h_{d,Σ}(x1) = A x1."""
        return self.matrix(x1.shape[-1] + len(self.fibre)) @ x1

    def lift_of_shapes(self, x0: Float[Array, " n-k"], x1: Float[Array, " n-k"]) -> Float[Array, " k"]:
        """h⁰_d(x0, x1) = h_d((x0, 0), x1)."""
        return self.lift_of_shape(x1 - x0)

    def trivialize_pair(self, q0: Float[Array, " n"], q1: Float[Array, " n"]) -> tuple[Array, Array, Array]:
        """λ_d(q0, q1) = (q0, x1, g1 − h_d(q0, x1)), the vertical part being ω_d(q0, q1)."""
        return q0, self.split(q1)[0], self.one_form(q0, q1)

    def trivialize_covector(self, q0: Float[Array, " n"], p0: Float[Array, " n"]) -> tuple[Array, Array, Array]:
        """λ̂_d(q0, p0) = (q0, w0 + h*_{d,Σ}(r0), r0) for p0 = (w0, r0); r0 is the momentum map."""
        w0, r0 = self.split(p0)
        return q0, w0 + self.matrix(q0.shape[-1]).T @ r0, r0

    def untrivialize_covector(self, w: Float[Array, " n-k"], mu: Float[Array, " k"]) -> Float[Array, " n"]:
        """p0 = (w − h*_{d,Σ}(μ), μ): the inverse of `trivialize_covector` at a point."""
        return self.join(w - self.matrix(w.shape[-1] + mu.shape[-1]).T @ mu, mu)
