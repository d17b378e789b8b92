"""Mechanics on SO(3), SE(2) and SE(3) reduced by the group, against Euler's equations, closed forms and the unreduced motion."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.special import ellipj

import dirax as dx

I = np.array([1.0, 2.0, 3.0])
MAPS = ("exp", "cayley")
SO3 = dx.SO3()
BODY = dx.EulerPoincare(SO3, lambda xi: xi @ (jnp.asarray(I) * xi) / 2)
OMEGA = np.array([0.3, 1.0, 0.4])


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


# -------------------------------------------------------------------------------------------------------- the free body


def euler(t, y):
    """(μ, R)˙ = (μ × ω, R ω^), by hand."""
    w = y[:3] / I
    return np.concatenate([np.cross(y[:3], w), (y[3:].reshape(3, 3) @ hat(w)).ravel()])


@pytest.mark.parametrize("map", MAPS)
def test_momentum_and_attitude_of_the_free_body_are_of_second_order(map):
    exact = integrate(euler, [*(I * OMEGA), *np.eye(3).ravel()], 4.0)
    momenta, attitudes = [], []
    for steps in (40, 80, 160):
        sol = run(BODY, map, 4.0 / steps, steps, x=BODY.state(OMEGA))
        momenta.append(np.abs(sol.x[-1] - exact[:3]).max())
        attitudes.append(np.abs(matrices(SO3, dx.reconstruct(sol).q[-1]) - exact[3:].reshape(3, 3)).max())
    assert orders(momenta) == pytest.approx([2, 2], abs=0.05)
    assert orders(attitudes) == pytest.approx([2, 2], abs=0.05)


def test_the_free_body_is_that_of_jacobi():
    """ω = (a cn, b sn, c dn) of the closed form, Richardson extrapolated."""
    order = I[::-1].copy()  # A > B > C
    A, B, C = order
    w = np.array([1.0, 0.0, 0.2])  # at a time when sn = 0
    L2, T2 = np.sum((order * w) ** 2), np.sum(order * w**2)
    assert L2 > B * T2  # around the axis of largest inertia: dn there
    rate = np.sqrt((A - B) * (L2 - T2 * C) / (A * B * C))
    modulus = (B - C) * (T2 * A - L2) / ((A - B) * (L2 - T2 * C))
    top = dx.EulerPoincare(SO3, lambda xi: xi @ (jnp.asarray(order) * xi) / 2)
    t = 3.0
    sn, cn, dn, _ = ellipj(rate * t, modulus)
    amplitude = np.sqrt((T2 * A - L2) / (B * (A - B)))
    exact = np.array([w[0] * dn, -amplitude * sn, w[2] * cn])
    ends = [run(top, "exp", t / n, n, x=top.state(w)).x[-1] / order for n in (150, 300, 600)]
    first, second = (4 * ends[1] - ends[0]) / 3, (4 * ends[2] - ends[1]) / 3
    assert np.abs((16 * second - first) / 15 - exact).max() < 1e-10


@pytest.mark.parametrize("map", MAPS)
def test_engines_agree_and_momentum_stays(map):
    x = BODY.state(OMEGA)
    sols = [run(BODY, map, steps=500, x=x, engine=engine) for engine in ("xla", "native")]
    for name in ("x", "g", "xi"):
        assert np.abs(sols[0].fields[name] - sols[1].fields[name]).max() < 1e-11
    for sol in sols:
        lifted = dx.reconstruct(sol)
        assert np.ptp(np.linalg.norm(sol.x, axis=1)) < 1e-14
        assert np.abs(lifted.spatial_momentum - I * OMEGA).max() < 5e-14
        assert np.abs(np.linalg.norm(lifted.q, axis=1) - 1).max() < 1e-15
        assert np.ptp(sol.energy()) < 2e-3


def test_reduced_is_unreduced():
    """L_d of the exponential is left-invariant on SO(3) × SO(3): its discrete Euler–Lagrange equations, in charts."""
    unreduced = dx.ManifoldLagrangian(lambda q, v: BODY.value(SO3.to_algebra(q, v), jnp.zeros(0)), SO3)
    q0 = np.array([np.cos(0.4), 0.0, np.sin(0.4), 0.0])
    v0 = np.asarray(SO3.left_translate(jnp.asarray(q0), jnp.asarray(OMEGA)))
    whole = dx.simulate(unreduced, dx.InCharts(dx.LieGroupExp(SO3, 0.5)), q=q0, v=v0, step=0.05, steps=500)
    lifted = dx.reconstruct(run(BODY, "exp", 0.05, 500, x=BODY.state(OMEGA)), g0=q0)
    assert np.abs(matrices(SO3, lifted.q) - matrices(SO3, whole.q)).max() < 1e-10
    assert np.abs(np.abs(np.sum(lifted.p * whole.p, axis=1)) - np.sum(whole.p**2, axis=1)).max() < 1e-10


def bivector_defect(system, scheme, x, step):
    """DΦ Λ DΦᵀ − Λ∘Φ of one step Φ, differentiated by the engine."""
    after = lambda x: dx.simulate(system, scheme, step=step, steps=1, x=x).x[-1]
    derivative = np.asarray(jax.jit(jax.jacfwd(after))(x))
    before, end = (np.asarray(system.space.bivector(x)) for x in (x, after(x)))
    return np.abs(derivative @ before @ derivative.T - end).max()


@pytest.mark.parametrize("map", MAPS)
def test_one_step_is_a_poisson_map(map):
    assert bivector_defect(BODY, dx.DiscreteEulerPoincare(map), BODY.state(OMEGA), 0.2) < 1e-13
