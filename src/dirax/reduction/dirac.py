"""Reduced discrete Dirac structures, Dirac differentials, Lagrangians and generalized energies, in a trivialization
([RL] §§3–5).

A pair of reduced states is (x0, w0, μ0, q1, w1, μ1) for (+), with q1 = (x1, g1), and (q0, w0, μ0, x1, w1, μ1) for (−),
where the group coordinate of the other point is 0. h_d is linear here, as it is in the paper.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from dirax.reduction.connection import LinearConnection

Tuple = tuple[Array, ...]


def plus_structure(connection: LinearConnection, pair: Tuple) -> Tuple:
    """The covector (x0, w1, μ1, p, x1, ξ) that belongs to a pair in the (+) structure ([RL] Proposition 3.8)."""
    x0, w0, mu0, q1, w1, mu1 = pair
    x1, g1 = connection.split(q1)
    return x0, w1, mu1, connection.untrivialize_covector(x0, w0, mu0), x1, g1 - connection.lift_of_shape(x1)


def minus_structure(connection: LinearConnection, pair: Tuple) -> Tuple:
    """The covector (w0, μ0, x1, −x0, ξ, p) that belongs to a pair in the (−) structure ([RL] Proposition 3.10)."""
    q0, w0, mu0, x1, w1, mu1 = pair
    x0, g0 = connection.split(q0)
    return w0, mu0, x1, -x0, connection.lift_of_shape(x0) - g0, -connection.untrivialize_covector(x1, w1, mu1)


def plus_differential(connection: LinearConnection, ld: Callable, x0: Array, x1: Array, g1: Array) -> Tuple:
    """[D̂⁺L_d](x0, x1, g1) for `ld(q0, q1)`, a scalar ([RL] Proposition 4.3)."""
    q0 = connection.join(x0, jnp.zeros_like(g1))
    q1 = connection.join(x1, g1 + connection.lift_of_shapes(x0, x1))
    d0, d1 = jax.grad(ld, argnums=(0, 1))(q0, q1)
    _, w, mu = connection.trivialize_covector(q1, d1)
    return x0, w, mu, -d0, x1, g1 + connection.lift_of_point(q0)


def minus_differential(connection: LinearConnection, ld: Callable, x0: Array, g0: Array, x1: Array) -> Tuple:
    """[D̂⁻L_d](x0, g0, x1) for `ld(q0, q1)`, a scalar ([RL] Proposition 4.4)."""
    q0 = connection.join(x0, g0 + connection.lift_of_shapes(x1, x0))
    q1 = connection.join(x1, jnp.zeros_like(g0))
    d0, d1 = jax.grad(ld, argnums=(0, 1))(q0, q1)
    _, w, mu = connection.trivialize_covector(q0, -d0)
    return w, mu, x1, -x0, -g0 - connection.lift_of_point(q1), -d1


def plus_lagrangian(connection: LinearConnection, ld: Callable, x0: Array, x1: Array, g1: Array) -> Float[Array, ""]:
    """l_{d+}(x0, x1, g1) = L_d((x0, 0), (x1, g1 + h⁰_d(x0, x1))) ([RL] (4.5))."""
    q0 = connection.join(x0, jnp.zeros_like(g1))
    return ld(q0, connection.untrivialize_pair(q0, x1, g1))


def minus_lagrangian(connection: LinearConnection, ld: Callable, x0: Array, g0: Array, x1: Array) -> Float[Array, ""]:
    """l_{d−}(x0, g0, x1) = L_d((x0, g0 + h⁰_d(x1, x0)), (x1, 0)) ([RL] (4.7))."""
    q1 = connection.join(x1, jnp.zeros_like(g0))
    return ld(connection.untrivialize_pair_backward(x0, g0, q1), q1)


def plus_energy(
    connection: LinearConnection, ld: Callable, x0: Array, x_plus: Array, g_plus: Array, q1: Array, w1: Array, mu1: Array
) -> Float[Array, ""]:
    """e_{d+}(x0, x0⁺, g0⁺, q1, w1, μ1) = l_{d+} + ⟨w1 − h*μ1, x1 − x0⁺⟩ + ⟨μ1, g1 − g0⁺ − h⁰_d(x0, x0⁺)⟩ ([RL] Lemma 5.1)."""
    there = connection.join(x_plus, g_plus + connection.lift_of_shapes(x0, x_plus))
    along = connection.untrivialize_covector(connection.split(q1)[0], w1, mu1) @ (q1 - there)
    return plus_lagrangian(connection, ld, x0, x_plus, g_plus) + along


def minus_energy(
    connection: LinearConnection, ld: Callable, x_minus: Array, g_minus: Array, x1: Array, w0: Array, mu0: Array, q0: Array
) -> Float[Array, ""]:
    """e_{d−}(x0⁻, g0⁻, x1, w0, μ0, q0) = l_{d−} + ⟨w0 − h*μ0, x0 − x0⁻⟩ + ⟨μ0, g0 − g0⁻ − h⁰_d(x1, x0⁻)⟩ ([RL] Lemma 5.4)."""
    there = connection.join(x_minus, g_minus + connection.lift_of_shapes(x1, x_minus))
    along = connection.untrivialize_covector(connection.split(q0)[0], w0, mu0) @ (q0 - there)
    return minus_lagrangian(connection, ld, x_minus, g_minus, x1) + along
