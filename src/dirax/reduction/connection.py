"""Discrete principal connections for abelian groups acting by addition on Q = Σ × G ([RL] §3)."""

from abc import abstractmethod
from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from dirax.numerics.tolerances import STRUCTURE_DEFECT
from dirax.program.user_functions import UserFunction, evaluated

SAMPLES = 8


class AbstractConnection(eqx.Module):
    """A discrete principal connection ω_d(q0, q1) = g1 − g0 − h⁰_d(x0, x1) on Q = Σ × G ([RL] Definition 2.1).

    `fibre`: the indices of q that are the group G = R^k (or a torus, by addition of angles); the others, in order, are
    the shape x ∈ Σ = R^r, r = n − k. Any h⁰_d with h⁰_d(x, x) = 0 gives one.
    """

    fibre: eqx.AbstractVar[tuple[int, ...]]

    @abstractmethod
    def check(self, n: int, nearest: Callable | None = None) -> None:
        """Raise `ValueError` where the connection does not fit n coordinates, or is none; looked at where points are random
        ones, or `nearest(q)` on a manifold."""

    @abstractmethod
    def lift_of_shapes(self, x0: Float[Array, " r"], x1: Float[Array, " r"]) -> Float[Array, " k"]:
        """h⁰_d(x0, x1) = h_d((x0, 0), x1)."""

    @abstractmethod
    def matrix_at(self, x: Float[Array, " r"]) -> Float[Array, "k r"]:
        """A(x) = D2 h⁰_d(x, x): the horizontal subspace at x is ġ = A(x) ẋ."""

    @abstractmethod
    def momentum_shift(self, x: Float[Array, " r"], mu: Float[Array, " k"]) -> Float[Array, " r"]:
        """h*_{d,Σ}(μ) = A(x)ᵀ μ."""

    def shape_indices(self, n: int) -> np.ndarray:
        """The indices of q that are the shape coordinates x."""
        return np.setdiff1d(np.arange(n), self.fibre)

    def split(self, q: Float[Array, " n"]) -> tuple[Float[Array, " r"], Float[Array, " k"]]:
        """q (or p, or v) as its (x, g) parts."""
        return picked(q, self.shape_indices(q.shape[-1])), picked(q, np.array(self.fibre))

    def join(self, x: Float[Array, " r"], g: Float[Array, " k"]) -> Float[Array, " n"]:
        """The inverse of `split`."""
        n = x.shape[-1] + g.shape[-1]
        order = np.argsort(np.concatenate([self.shape_indices(n), self.fibre]))
        return picked(jnp.concatenate([x, g]), order)

    def one_form(self, q0: Float[Array, " n"], q1: Float[Array, " n"]) -> Float[Array, " k"]:
        """ω_d(q0, q1): e on the diagonal, and ω_d(g q0, g' q1) = g' ω_d(q0, q1) g⁻¹."""
        (x0, g0), (x1, g1) = self.split(q0), self.split(q1)
        return g1 - g0 - self.lift_of_shapes(x0, x1)

    def horizontal_lift(self, q0: Float[Array, " n"], x1: Float[Array, " r"]) -> Float[Array, " k"]:
        """h_d(q0, x1) = g0 + h⁰_d(x0, x1): the group coordinate of the point over x1 that is horizontal from q0."""
        x0, g0 = self.split(q0)
        return g0 + self.lift_of_shapes(x0, x1)

    def trivialize_pair(self, q0: Float[Array, " n"], q1: Float[Array, " n"]) -> tuple[Array, Array, Array]:
        """λ_d(q0, q1) = (q0, x1, g1 − h_d(q0, x1)), the vertical part being ω_d(q0, q1) ([RL] (3.2))."""
        return q0, self.split(q1)[0], self.one_form(q0, q1)

    def untrivialize_pair(self, q0: Float[Array, " n"], x1: Float[Array, " r"], g1: Float[Array, " k"]) -> Float[Array, " n"]:
        """q1 = (x1, g1 + h_d(q0, x1)): the inverse of `trivialize_pair` ([RL] (3.3))."""
        return self.join(x1, g1 + self.horizontal_lift(q0, x1))

    def trivialize_pair_backward(self, q0: Float[Array, " n"], q1: Float[Array, " n"]) -> tuple[Array, Array, Array]:
        """λ̃_d(q0, q1) = (x0, g0 − h_d(q1, x0), q1): the (−) counterpart of `trivialize_pair` ([RL] Remark 3.1)."""
        return self.split(q0)[0], self.one_form(q1, q0), q1

    def untrivialize_pair_backward(
        self, x0: Float[Array, " r"], g0: Float[Array, " k"], q1: Float[Array, " n"]
    ) -> Float[Array, " n"]:
        """q0 = (x0, g0 + h_d(q1, x0)): the inverse of `trivialize_pair_backward`."""
        return self.join(x0, g0 + self.horizontal_lift(q1, x0))

    def trivialize_covector(self, q0: Float[Array, " n"], p0: Float[Array, " n"]) -> tuple[Array, Array, Array]:
        """λ̂_d(q0, p0) = (q0, w0 + h*_{d,Σ}(r0), r0) for p0 = (w0, r0); r0 is the momentum map ([RL] (3.6), Lemma 2.2)."""
        w0, r0 = self.split(p0)
        return q0, w0 + self.momentum_shift(self.split(q0)[0], r0), r0

    def untrivialize_covector(self, x: Float[Array, " r"], w: Float[Array, " r"], mu: Float[Array, " k"]) -> Float[Array, " n"]:
        """p0 = (w − h*_{d,Σ}(μ), μ): the inverse of `trivialize_covector` at a point over x ([RL] (3.7))."""
        return self.join(w - self.momentum_shift(x, mu), mu)


class LinearConnection(AbstractConnection):
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
        self.fibre = indices = fibre_indices(fibre)
        self.horizontal = None
        if horizontal is not None:
            matrix = np.asarray(horizontal, dtype=float)
            if matrix.ndim != 2 or matrix.shape[0] != len(indices) or not np.all(np.isfinite(matrix)):
                raise ValueError(
                    f"horizontal must be a finite matrix of shape (k, n − k) with k = {len(indices)} rows, one a group "
                    f"coordinate, but its shape is {matrix.shape}."
                )
            self.horizontal = tuple(map(tuple, matrix.tolist()))

    def check(self, n: int, nearest: Callable | None = None) -> None:
        """Raise `ValueError` where the indices or A do not fit n coordinates."""
        check_fibre(self.fibre, n)
        if self.horizontal is not None and len(self.horizontal[0]) != n - len(self.fibre):
            raise ValueError(
                f"horizontal must have shape ({len(self.fibre)}, {n - len(self.fibre)}) for {n} coordinates with fibre "
                f"{list(self.fibre)}, but it has {len(self.horizontal[0])} columns."
            )

    def matrix(self, n: int) -> Float[Array, "k r"]:
        """A."""
        k = len(self.fibre)
        return jnp.zeros((k, n - k)) if self.horizontal is None else jnp.asarray(self.horizontal)

    def matrix_at(self, x: Float[Array, " r"]) -> Float[Array, "k r"]:
        """A, at every x."""
        return self.matrix(x.shape[-1] + len(self.fibre))

    def momentum_shift(self, x: Float[Array, " r"], mu: Float[Array, " k"]) -> Float[Array, " r"]:
        """Aᵀ μ."""
        return jnp.zeros_like(x) if self.horizontal is None else self.matrix_at(x).T @ mu

    def lift_of_shapes(self, x0: Float[Array, " r"], x1: Float[Array, " r"]) -> Float[Array, " k"]:
        """h⁰_d(x0, x1) = A(x1 − x0)."""
        return self.matrix_at(x1) @ (x1 - x0)

    def lift_of_point(self, q0: Float[Array, " n"]) -> Float[Array, " k"]:
        """h_{d,Q}(q0) = g0 − A x0."""
        x0, g0 = self.split(q0)
        return g0 - self.matrix_at(x0) @ x0

    def lift_of_shape(self, x1: Float[Array, " r"]) -> Float[Array, " k"]:
        """h_{d,Σ}(x1) = A x1."""
        return self.matrix_at(x1) @ x1

    def adjoint_of_point(self, x: Float[Array, " r"], mu: Float[Array, " k"]) -> Float[Array, " n"]:
        """h*_{d,Q}(μ) = (−Aᵀμ, μ), with ⟨h*_{d,Q}(μ), q⟩ = ⟨μ, h_{d,Q}(q)⟩; h*_{d,Σ} is `momentum_shift` ([RL] (2.4))."""
        return self.join(-self.momentum_shift(x, mu), mu)


class DiscreteConnection(AbstractConnection):
    """A discrete principal connection given by its form, `one_form(q0, q1)` of shape (k,): ω_d ([RL] Definition 2.1).

    The axioms are ω_d(q, q) = 0 and ω_d(q0 + g0, q1 + g1) = ω_d(q0, q1) + g1 − g0 for translations in the `fibre`; they
    are checked at random points as soon as n is known, and `ValueError` names the one that fails, with its defect. The
    horizontal lift is h_d(q0, x1) = g0 − ω_d((x0, 0), (x1, 0)), linear or not.

        dx.DiscreteConnection(lambda q0, q1: (q1[3:] - q0[3:]) - (q0[:1] + q1[:1]) / 2 * (q1[1:2] - q0[1:2]), fibre=[3])
    """

    function: UserFunction
    fibre: tuple[int, ...] = eqx.field(static=True)

    def __init__(self, one_form: Callable, fibre: Sequence[int]):
        self.function = UserFunction(one_form, "one_form", ("q0", "q1"))
        if self.function.takes_params:
            raise TypeError("one_form takes (q0, q1) alone: a connection has no parameters.")
        self.fibre = fibre_indices(fibre)

    def check(self, n: int, nearest: Callable | None = None) -> None:
        """Raise `ValueError` where the axioms fail, with the defect and where."""
        check_fibre(self.fibre, n)
        k, random = len(self.fibre), np.random.default_rng(0)
        shape = self.function.shape(jnp.zeros(n), jnp.zeros(n), None).shape
        if shape != (k,):
            raise ValueError(f"one_form(q0, q1) must return shape ({k},), one entry a group coordinate, but it returned {shape}.")
        of_points = lambda a, b: self.function(a, b, None)
        form = lambda a, b: np.asarray(evaluated(of_points, np.asarray(a), np.asarray(b)))
        with jax.ensure_compile_time_eval():
            for _ in range(SAMPLES):
                q0, q1 = random.normal(size=n), random.normal(size=n)
                if nearest is not None:
                    q0, q1 = nearest(q0), nearest(q1)
                move = np.zeros((2, n))
                move[:, list(self.fibre)] = random.normal(size=(2, k))
                expected = form(q0, q1) + (move[1] - move[0])[list(self.fibre)]
                for axiom, found, wanted, where in (
                    ("ω_d(q, q) = 0", form(q0, q0), np.zeros(k), f"q = {q0}"),
                    ("ω_d(q0 + g0, q1 + g1) = ω_d(q0, q1) + g1 − g0", form(q0 + move[0], q1 + move[1]), expected,
                     f"q0 = {q0}, q1 = {q1}"),
                ):  # fmt: skip
                    defect = float(np.max(np.abs(np.asarray(found) - np.asarray(wanted))))
                    if not np.isfinite(defect):
                        raise ValueError(f"one_form is no discrete connection on all of Q: it is not finite at {where}.")
                    if not defect <= STRUCTURE_DEFECT * (1 + float(np.max(np.abs(np.asarray(wanted))))):
                        raise ValueError(f"one_form is no discrete connection: {axiom} fails by {defect:.3g} at {where}.")

    def lift_of_shapes(self, x0: Float[Array, " r"], x1: Float[Array, " r"]) -> Float[Array, " k"]:
        """h⁰_d(x0, x1) = −ω_d((x0, 0), (x1, 0))."""
        nothing = jnp.zeros(len(self.fibre))
        return -self.function(self.join(x0, nothing), self.join(x1, nothing), None)

    def matrix_at(self, x: Float[Array, " r"]) -> Float[Array, "k r"]:
        """D2 h⁰_d(x, x)."""
        return jax.jacfwd(self.lift_of_shapes, argnums=1)(x, x)

    def momentum_shift(self, x: Float[Array, " r"], mu: Float[Array, " k"]) -> Float[Array, " r"]:
        """A(x)ᵀ μ."""
        return jax.vjp(lambda x1: self.lift_of_shapes(x, x1), x)[1](mu)[0]


def picked(a: Float[Array, " n"], indices: np.ndarray) -> Float[Array, " r"]:
    """a[indices] by slices of neighbours: XLA is slow with gathers of a few numbers, and slower with their derivatives."""
    starts = [0, *(i for i in range(1, len(indices)) if indices[i] != indices[i - 1] + 1)]
    runs = zip(starts, [*starts[1:], len(indices)], strict=True)
    parts = [a[int(indices[first]) : int(indices[last - 1]) + 1] for first, last in runs if last > first]
    if not parts:
        return a[:0]
    return parts[0] if len(parts) == 1 else jnp.concatenate(parts)


def fibre_indices(fibre: Any) -> tuple[int, ...]:
    """Indices of group coordinates; raises `ValueError` for repeated or negative ones."""
    given = np.atleast_1d(np.asarray(list(fibre) if isinstance(fibre, range | set) else fibre))
    indices = tuple(int(i) for i in given) if np.issubdtype(given.dtype, np.integer) and given.ndim == 1 else ()
    if not indices or len(set(indices)) != len(indices) or min(indices) < 0:
        raise ValueError(f"fibre must hold different non-negative indices of coordinates, such as [0], but {fibre!r} was given.")
    return indices


def check_fibre(fibre: tuple[int, ...], n: int) -> None:
    """Raise `ValueError` where the indices are not those of n coordinates."""
    if max(fibre) >= n:
        raise ValueError(
            f"fibre {list(fibre)} does not fit a system of {n} coordinates, numbered 0 to {n - 1}; that of a second stage of "
            "dx.reduce counts the shape coordinates x of the first."
        )
