"""Reduction by stages beside reduction by the product, and beside the twice reduced discrete Lagrangian by hand."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dirax as dx

H, STEPS = 0.05, 40
START = {"q": [0.2, 0.4, 1.0, 0.2, -0.3], "v": [0.5, -0.3, 0.8, 0.6, 0.2], "step": H, "steps": STEPS}
A1 = np.array([[0.3, -0.2, 0.5, 0.1]])  # by (q0, q1, q2, q4): q2 is reduced in the second stage
A2 = np.array([[0.4, -0.1, 0.2]])  # by (q0, q1, q4)
FIRST, SECOND = dx.LinearConnection([3], A1), dx.LinearConnection([2], A2)


def lagrangian(q, v):
    """Free of q[2] and q[3]; regular, not a product."""
    rotor = (v[3] + q[1] * v[2] - 0.3 * v[0]) ** 2 / 2
    other = (
        (1 + q[1] ** 2) * v[2] ** 2 / 2 + v[0] * v[2] * jnp.sin(q[1]) / 2 + v[0] ** 2 + v[1] ** 2 + v[4] ** 2 * (1 + q[0] ** 2)
    )
    return rotor + other - jnp.cos(q[0] - q[1]) - q[4] ** 2 / 2


SYSTEM = dx.LagrangeDirac(lagrangian)


def close(sol, other, tolerance=1e-13):
    for name in ("x", "w", "g", "mu"):
        np.testing.assert_allclose(sol.fields[name], other.fields[name], atol=tolerance)


@pytest.mark.parametrize(
    "scheme",
    [dx.PlusLagrangeDirac("midpoint"), pytest.param(dx.MinusLagrangeDirac("left"), marks=pytest.mark.soak), dx.DiscreteRouth()],
)
@pytest.mark.soak_of("scheme2")
def test_two_stages_are_the_product_in_either_order(scheme):
    staged = dx.reduce(dx.reduce(SYSTEM, FIRST), SECOND)
    assert staged.connection.fibre == (3, 2)
    by_hand = np.array([A1[0, [0, 1, 3]] + A1[0, 2] * A2[0], A2[0]])
    product = dx.reduce(SYSTEM, dx.LinearConnection([3, 2], by_hand))
    first, second = (dx.simulate(system, scheme, **START) for system in (staged, product))
    close(first, second)
    whole = dx.simulate(SYSTEM, dx.LagrangeDAlembert() if isinstance(scheme, dx.DiscreteRouth) else scheme, **START)
    np.testing.assert_allclose(dx.reconstruct(first).q, whole.q, atol=1e-12)
    # the other order, with the same horizontal vectors: first q2 by (q0, q1, q3, q4), then q3 by (q0, q1, q4)
    other = dx.reduce(SYSTEM, dx.LinearConnection([2], [[*A2[0, :2], 0.0, A2[0, 2]]]))
    other = dx.simulate(dx.reduce(other, dx.LinearConnection([2], by_hand[:1])), scheme, **START)
    for name in ("x", "w"):
        np.testing.assert_allclose(other.fields[name], first.fields[name], atol=1e-13)
    for name in ("g", "mu"):
        np.testing.assert_allclose(other.fields[name][:, ::-1], first.fields[name], atol=1e-13)


def test_rows_satisfy_the_equations_of_the_twice_reduced_discrete_lagrangian():
    """l₂(y0, y1, γ₂, γ₁) from l₁(x0, x1, γ₁) by [RL] (4.5) twice; the group parts of both stages are conserved."""
    sol = dx.simulate(dx.reduce(dx.reduce(SYSTEM, FIRST), SECOND), dx.PlusLagrangeDirac("midpoint"), **START)
    ld = lambda q0, q1: H * lagrangian((q0 + q1) / 2, (q1 - q0) / H)
    on_q = lambda x, g: jnp.stack([x[0], x[1], x[2], g, x[3]])
    l1 = lambda x0, x1, g: ld(on_q(x0, 0.0), on_q(x1, g + A1[0] @ (x1 - x0)))
    on_x = lambda y, g: jnp.stack([y[0], y[1], g, y[2]])
    l2 = lambda y0, y1, g2, g1: l1(on_x(y0, 0.0), on_x(y1, g2 + A2[0] @ (y1 - y0)), g1)
    slopes = jax.jit(jax.vmap(jax.grad(l2, argnums=(0, 1, 2, 3))))
    y, (g1, g2) = sol.x, sol.g.T
    part2 = np.diff(g2) - np.diff(y, axis=0) @ A2[0]
    x = np.stack([y[:, 0], y[:, 1], g2, y[:, 2]], axis=1)
    part1 = np.diff(g1) - np.diff(x, axis=0) @ A1[0]
    d0, d1, of_g2, of_g1 = slopes(y[:-1], y[1:], part2, part1)
    np.testing.assert_allclose(-d0, sol.w[:-1], atol=1e-13)
    np.testing.assert_allclose(d1, sol.w[1:], atol=1e-13)
    np.testing.assert_allclose(of_g1, sol.mu[:-1, 0], atol=1e-13)
    # the momentum of the second stage is that of the horizontal lift of the first
    np.testing.assert_allclose(of_g2, sol.mu[:-1, 1] + A1[0, 2] * sol.mu[:-1, 0], atol=1e-13)


def test_connections_that_are_not_linear():
    bent = dx.DiscreteConnection(lambda q0, q1: (q1[3:4] - q0[3:4]) - (q0[1:2] + q1[1:2]) / 2 * (q1[0:1] - q0[0:1]), fibre=[3])
    second = dx.DiscreteConnection(lambda x0, x1: (x1[2:3] - x0[2:3]) - jnp.sin(x1[:1]) + jnp.sin(x0[:1]), fibre=[2])
    both = lambda q0, q1: jnp.concatenate([bent.function(q0, q1, None), (q1 - q0)[2:3] - jnp.sin(q1[:1]) + jnp.sin(q0[:1])])
    sols = [
        dx.simulate(system, dx.PlusLagrangeDirac("midpoint"), **START)
        for system in (dx.reduce(dx.reduce(SYSTEM, bent), second), dx.reduce(SYSTEM, dx.DiscreteConnection(both, [3, 2])))
    ]
    close(*sols, tolerance=1e-12)


def test_three_stages_leave_nothing():
    free = dx.LagrangeDirac(lambda q, v: v @ jnp.diag(jnp.array([1.0, 2.0, 3.0])) @ v / 2 + v[0] * v[2] / 4)
    system = free
    for _ in range(2):
        system = dx.reduce(system, dx.LinearConnection([0]))
    sol = dx.simulate(system, dx.PlusLagrangeDirac(), q=np.zeros(3), v=[1.0, 2.0, 3.0], step=0.1, steps=10)
    assert system.connection.fibre == (0, 1) and np.ptp(sol.mu, axis=0).max() == 0.0
    np.testing.assert_allclose(dx.reconstruct(sol).q[-1], [1.0, 2.0, 3.0], rtol=1e-13)


def se2_sleigh(q, v):
    """½|R(θ)ᵀẋ|²_M + θ̇²/2 in (cos θ, sin θ, x, y): left-invariant on SE(2)."""
    forward, side = q[0] * v[2] + q[1] * v[3], q[0] * v[3] - q[1] * v[2]
    spin = q[0] * v[1] - q[1] * v[0]
    return forward**2 / 2 + side**2 + spin**2 / 2 + 0.3 * forward * spin


@pytest.mark.soak
def test_translations_and_then_rotations_are_the_motions():
    holonomic = lambda q: jnp.array([q[:2] @ q[:2] - 1.0])
    system = dx.LagrangeDirac(se2_sleigh, holonomic=holonomic)
    body = dx.reduce(dx.reduce(system, dx.LinearConnection([2, 3])), dx.SO2())
    q, v = np.array([np.cos(0.3), np.sin(0.3), 1.0, 2.0]), np.array([-np.sin(0.3) * 0.7, np.cos(0.3) * 0.7, 0.4, -0.2])
    sols = [
        dx.simulate(one, dx.DiscreteEulerPoincare(), q=q, v=v, step=0.02, steps=50) for one in (body, dx.reduce(system, dx.SE2()))
    ]
    np.testing.assert_array_equal(sols[0].x, sols[1].x)
    # the momentum of the translations, which the first stage conserves, seen from space
    first = dx.simulate(
        dx.reduce(system, dx.LinearConnection([2, 3])), dx.PlusLagrangeDirac("midpoint"), q=q, v=v, step=0.02, steps=50
    )
    lifted = dx.reconstruct(sols[0])
    turned = np.einsum("kij,kj->ki", np.asarray(jax.vmap(dx.SE2().matrix)(lifted.q))[:, :2, :2], sols[0].x[:, :2])
    np.testing.assert_allclose(turned, np.broadcast_to(first.mu[0], turned.shape), atol=1e-12)


def test_mistakes():
    once = dx.reduce(SYSTEM, FIRST)
    with pytest.raises(ValueError, match="of a second stage"):
        dx.simulate(
            dx.reduce(dx.reduce(SYSTEM, dx.LinearConnection([3])), dx.LinearConnection([4])), dx.PlusLagrangeDirac(), **START
        )
    with pytest.raises(ValueError, match="horizontal must have shape"):
        dx.reduce(once, dx.LinearConnection([2], [[1.0, 2.0]]))
    with pytest.raises(ValueError, match=r"takes dx\.SO2\(\) or dx\.SO3\(\) after the translations"):
        dx.reduce(once, dx.SE3())
    with pytest.raises(TypeError, match="the symmetry must be a connection"):
        dx.reduce(once, [2])
    with pytest.raises(ValueError, match=r"not invariant under translation of q\[1\]"):
        dx.simulate(dx.reduce(once, dx.LinearConnection([1])), dx.PlusLagrangeDirac(), **START)
    bent = dx.DiscreteConnection(lambda q0, q1: (q1[3:4] - q0[3:4]) - (q0[2:3] + q1[2:3]) / 2 * (q1[0:1] - q0[0:1]), fibre=[3])
    with pytest.raises(ValueError, match="the second stage does not act on the connection of the first"):
        dx.simulate(dx.reduce(dx.reduce(SYSTEM, bent), dx.LinearConnection([2])), dx.PlusLagrangeDirac(), **START)
    holonomic = lambda q: jnp.array([q[:2] @ q[:2] - 1.0])
    tilted = dx.LagrangeDirac(lambda q, v: se2_sleigh(q, v) - q[0], holonomic=holonomic)
    with pytest.raises(ValueError, match="not left-invariant on SE2"):
        dx.reduce(dx.reduce(tilted, dx.LinearConnection([2, 3])), dx.SO2())
