"""Derivatives through impacts against differences of runs that nothing traces, and against a closed form."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dirax as dx

BALL = dx.LagrangeDirac(lambda q, v, params: v @ v / 2 - params["g"] * q[1])
FLOOR = dx.Impact(lambda q, params: q[1] - params["floor"], restitution=0.8)


def measured(given, start=(0.0, 0.3)):
    """Places, momenta and times of impacts of two balls, as they depend on height, speed, gravity and the floor."""
    height, speed, g, floor = given
    xp = jnp if isinstance(given, jax.core.Tracer) else np
    q = xp.stack([xp.stack([start[0] + 0.0 * height, height]), xp.stack([start[0] + 0.0 * height, 1.5 * height])])
    v = xp.stack([xp.stack([start[1] + 0.0 * speed, speed])] * 2)
    params = {"g": g, "floor": floor}
    sol = dx.simulate(BALL, dx.LagrangeDAlembert(), q=q, v=v, params=params, step=0.07, steps=72, events=[FLOOR], save_every=4)
    of_lane = lambda lane: sol.events.t[sol.events.lane == lane][:2]
    if xp is jnp:
        half = len(sol.events) // 2
        of_lane = lambda lane: sol.events.t[lane * half : lane * half + 2]
    return xp.concatenate([sol.q[:, -1].ravel(), sol.p[:, -1].ravel(), of_lane(0), of_lane(1)])


def test_derivatives_of_two_bounces():
    at = np.array([1.0, 0.1, 1.0, -0.2])
    values, jacobian = jax.jit(lambda a: (measured(a), jax.jacfwd(measured)(a)))(at)
    np.testing.assert_allclose(values, measured(at), rtol=0, atol=1e-12)
    d = 1e-4
    for i, unit in enumerate(np.eye(4)):
        change = lambda step, unit=unit: measured(at + step * unit) - measured(at - step * unit)
        near = (8 * change(d) - change(2 * d)) / (12 * d)
        np.testing.assert_allclose(jacobian[:, i], near, rtol=1e-8, atol=1e-9)
    fall = lambda y, v, g, floor: (v + jnp.sqrt(v * v + 2 * g * (y - floor))) / g
    np.testing.assert_allclose(jacobian[8], jax.grad(lambda a: fall(*a))(jnp.asarray(at)), rtol=1e-11)


def test_the_last_row_of_a_pendulum_is_as_of_runs_that_nothing_traces():
    """Its momentum, which takes the step that leaves it, was off by h²."""
    pendulum = dx.LagrangeDirac(lambda q, v, params: v @ v / 2 - params * q[1], holonomic=lambda q: jnp.array([(q @ q - 1) / 2]))
    wall = dx.Impact(lambda q: q[0] + 0.2)

    def run(g):
        start = {"q": [0.6, -0.8], "v": [-0.4, -0.3], "step": 0.1, "steps": 20}
        sol = dx.simulate(pendulum, dx.LagrangeDAlembert(), **start, events=[wall], params=g)
        assert len(sol.events)
        return sol.q, sol.p, sol.multipliers, sol.energy()

    for traced, plain in zip(jax.jit(run)(1.0), run(1.0), strict=True):
        np.testing.assert_allclose(traced, plain, rtol=0, atol=1e-12)
    _, slopes = jax.jvp(lambda g: run(g)[1][-1], (1.0,), (1.0,))
    np.testing.assert_allclose(slopes, (run(1 + 1e-5)[1][-1] - run(1 - 1e-5)[1][-1]) / 2e-5, atol=1e-8)


@pytest.mark.soak
def test_reverse_mode_and_second_derivatives():
    """A ball falls from height y onto a floor at 0, e = .8: y(T) = .8 u s − s²/2 with u = √(2y) = t₁ and s = T − t₁."""
    ball = dx.LagrangeDirac(lambda q, v: v @ v / 2 - q[0])
    wall, end = dx.Impact(lambda q: q[0], restitution=0.8), 2.0

    def height(y):
        run = dx.simulate(ball, dx.LagrangeDAlembert(), q=y[None], v=jnp.zeros(1), step=0.1, steps=20, events=[wall])
        return run.q[-1, 0]

    exact = lambda y: 0.8 * jnp.sqrt(2 * y) * (end - jnp.sqrt(2 * y)) - (end - jnp.sqrt(2 * y)) ** 2 / 2
    found = jax.jit(lambda y: jax.jvp(jax.grad(height), (y,), (1.0,)))(1.1)
    np.testing.assert_allclose(found, (jax.grad(exact)(1.1), jax.grad(jax.grad(exact))(1.1)), rtol=1e-10)


def test_the_step_is_in_one_place_however_many_walls_there_are():
    """XLA compiles every copy of it, which took half a minute."""
    ball, scheme = dx.LagrangeDirac(lambda q, v: v @ v / 2 - q[0]), dx.LagrangeDAlembert()

    def loops(*walls):
        run = lambda q: dx.simulate(ball, scheme, q=q, v=jnp.zeros(1), step=0.1, steps=2, events=list(walls)).q
        return jax.jit(run).lower(jnp.ones(1)).as_text().count("stablehlo.while")

    low, high = dx.Impact(lambda q: q[0]), dx.Impact(lambda q: 2.0 - q[0])
    assert loops(low) == loops(low, high) < 12
