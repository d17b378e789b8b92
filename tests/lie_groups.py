"""What the tests of mechanics on Lie groups share: runs, orders, and the unreduced discrete equations solved on matrices."""

import jax
import jax.numpy as jnp
import numpy as np
from scipy.integrate import solve_ivp

import dirax as dx


def run(system, scheme="exp", step=0.1, steps=100, **settings):
    sol = dx.simulate(system, dx.DiscreteEulerPoincare(scheme), step=step, steps=steps, **settings)
    assert np.all(sol.ok), sol.message
    return sol


def hat(w):
    return np.array([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]])


def matrices(group, g):
    return np.squeeze(jax.vmap(group.matrix)(jnp.atleast_2d(jnp.asarray(g))))


def orders(errors):
    return -np.diff(np.log2(errors))


def integrate(field, y, end):
    return solve_ivp(field, (0.0, end), y, method="DOP853", rtol=1e-13, atol=1e-14).y[:, -1]


SPACE_TURNS = np.stack([hat(e) for e in np.eye(3)])


def basis_of(group):
    """The matrices of the algebra's basis, translations first, written out here."""
    k = 3 if group.dimension in (3, 6) and group.double_cover else 2
    turns = SPACE_TURNS if k == 3 else np.array([[[0.0, -1.0], [1.0, 0.0]]])
    if not group.translations:
        return turns
    basis = np.zeros((group.dimension, k + 1, k + 1))
    basis[np.arange(k), np.arange(k), k] = 1.0
    basis[k:, :k, :k] = turns
    return basis


def unreduced(group, l, h, start, a0, steps, forms=None):
    """g_k (steps + 1, …) of the discrete Euler–Lagrange equations of L_d(g0, g1) on the group, with Cayley's map.

    Solved on matrices, by the derivative of L_d along curves in the group and Newton's method; `start` is the first ξ and
    `forms` the A of constraints A ξ_k = 0, with forces Aᵀλ on the left-trivialized equations.
    """
    basis = jnp.asarray(basis_of(group))
    size, d = basis.shape[1], len(basis)
    A = jnp.zeros((0, d)) if forms is None else jnp.asarray(forms)
    one, square = jnp.eye(size), np.sum(np.asarray(basis) ** 2, axis=(1, 2))
    algebra = lambda xi: jnp.tensordot(xi, basis, axes=1)
    k = 3 if group.double_cover else 2

    def discrete_lagrangian(g0, g1):
        f = jnp.linalg.solve(g0, g1)
        zeta = 2 * jnp.linalg.solve((f + one).T, (f - one).T).T
        xi = jnp.einsum("aij,ij->a", basis, zeta) / square / h
        seen = lambda g: g[:k, :k].T @ a0 if len(a0) else a0
        return h / 2 * (l(xi, seen(g0)) + l(xi, seen(g1)))

    def following(g, xi):
        return g @ jnp.linalg.solve(one - h / 2 * algebra(xi), one + h / 2 * algebra(xi))

    def step(carry, _):
        before, g, xi = carry

        def equations(u):
            after = following(g, u[:d])
            curve = lambda eta: g @ (one + algebra(eta))
            action = lambda eta: discrete_lagrangian(before, curve(eta)) + discrete_lagrangian(curve(eta), after)
            return jnp.concatenate([jax.grad(action)(jnp.zeros(d)) + A.T @ u[d:], A @ u[:d]])

        better = lambda _, u: u - jnp.linalg.solve(jax.jacfwd(equations)(u), equations(u))
        u = jax.lax.fori_loop(0, 5, better, jnp.concatenate([xi, jnp.zeros(len(A))]))
        return (g, following(g, u[:d]), u[:d]), (following(g, u[:d]), u)

    first = following(one, start)
    _, (rest, unknowns) = jax.jit(lambda s: jax.lax.scan(step, (one, following(one, s), s), None, length=steps - 1))(start)
    return np.concatenate([[one, first], rest]), np.asarray(unknowns)
