"""Derivatives through impacts against differences of runs that nothing traces, and against a closed form."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dirax as dx

BALL = dx.LagrangeDirac(lambda q, v, params: v @ v / 2 - params["g"] * q[1])
FLOOR = dx.Impact(lambda q, params: q[1] - params["floor"], restitution=0.8)
FITTED = dx.Impact(FLOOR.function, restitution=lambda params: params["e"])

DIRECTIONS = np.array([[0.6, -0.3, 0.5, 0.4, -0.3], [0.2, 0.7, -0.4, 0.5, 0.4]])
"""Along which derivatives are compared with differences."""


def measured(given, start=(0.0, 0.3)):
    """Places, momenta and times of impacts of two balls, as they depend on height, speed, gravity, the floor and its
    restitution."""
    height, speed, g, floor, e = given
    xp = jnp if isinstance(given, jax.core.Tracer) else np
    q = xp.stack([xp.stack([start[0] + 0.0 * height, height]), xp.stack([start[0] + 0.0 * height, 1.5 * height])])
    v = xp.stack([xp.stack([start[1] + 0.0 * speed, speed])] * 2)
    params = {"g": g, "floor": floor, "e": e}
    sol = dx.simulate(BALL, dx.LagrangeDAlembert(), q=q, v=v, params=params, step=0.07, steps=72, events=[FITTED], save_every=4)
    of_lane = lambda lane: sol.events.t[sol.events.lane == lane][:2]
    if xp is jnp:
        half = len(sol.events) // 2
        of_lane = lambda lane: sol.events.t[lane * half : lane * half + 2]
    return xp.concatenate([sol.q[:, -1].ravel(), sol.p[:, -1].ravel(), of_lane(0), of_lane(1)])


@pytest.mark.soak
def test_derivatives_of_two_bounces():
    at = np.array([1.0, 0.1, 1.0, -0.2, 0.8])
    jacobian, values = jax.jit(jax.jacfwd(lambda a: (measured(a),) * 2, has_aux=True))(at)
    np.testing.assert_allclose(values, measured(at), rtol=0, atol=1e-12)
    d = 1e-4
    for direction in DIRECTIONS:
        change = lambda step, along=direction: measured(at + step * along) - measured(at - step * along)
        near = (8 * change(d) - change(2 * d)) / (12 * d)
        np.testing.assert_allclose(jacobian @ direction, near, rtol=1e-8, atol=1e-9)
    fall = lambda y, v, g, floor: (v + jnp.sqrt(v * v + 2 * g * (y - floor))) / g
    np.testing.assert_allclose(jacobian[8], jax.grad(lambda a: fall(*a[:4]))(jnp.asarray(at)), rtol=1e-11, atol=1e-15)


def test_the_last_row_of_a_pendulum_is_as_of_runs_that_nothing_traces():
    """Its momentum, which takes the step that leaves it, was off by h²."""
    pendulum = dx.LagrangeDirac(lambda q, v, params: v @ v / 2 - params * q[1], holonomic=lambda q: jnp.array([(q @ q - 1) / 2]))
    wall = dx.Impact(lambda q: q[0] + 0.2)

    def run(g):
        start = {"q": [0.6, -0.8], "v": [-0.4, -0.3], "step": 0.1, "steps": 20}
        sol = dx.simulate(pendulum, dx.LagrangeDAlembert(), **start, events=[wall], params=g)
        assert len(sol.events)
        return sol.q, sol.p, sol.multipliers, sol.energy()

    def last(g):
        rows = run(g)
        return rows[1][-1], rows

    _, slopes, rows = jax.jit(lambda g: jax.jvp(last, (g,), (1.0,), has_aux=True))(1.0)
    for traced, plain in zip(rows, run(1.0), strict=True):
        np.testing.assert_allclose(traced, plain, rtol=0, atol=1e-12)
    np.testing.assert_allclose(slopes, (run(1 + 1e-5)[1][-1] - run(1 - 1e-5)[1][-1]) / 2e-5, atol=1e-8)


def numbers(x):
    return jnp if isinstance(x, jax.core.Tracer) else np


def falling(x, start, walls, **more):
    """A ball from its place, `start` + (x₀, 0), with the velocity (x₁, x₂) and g = x₃."""
    xp = numbers(x)
    q, v = xp.stack([start[0] + x[0], start[1] + 0.0 * x[0]]), xp.stack([x[1], x[2]])
    params = {"g": x[3], "floor": 0.0}
    return dx.simulate(BALL, dx.LagrangeDAlembert(), q=q, v=v, params=params, step=0.1, events=walls, **more)


def rows(x, *args, **more):
    sol = falling(x, *args, **more)
    return numbers(x).concatenate([sol.q[-1], sol.p[-1], sol.q[9]])


PEG = dx.Impact(lambda q: jnp.sum((q - jnp.array([0.93, 0.466])) ** 2) - 0.01**2)
"""In the way for a tenth of a quarter of a step."""


@pytest.mark.parametrize(
    "case",
    [
        ((0.0, 1.0), [PEG, FLOOR], [0.0, 0.9, 0.0, 1.0]),
        ((0.0, 0.0), [FLOOR], [0.0, 0.5, 0.3, 1.0]),
        ((0.0, 0.0), [FLOOR], [0.0, 0.5, -0.4, 1.0]),
    ],
    ids=["a thin peg", "up from a wall", "onto a wall at once"],
)
@pytest.mark.soak_of(but=["up from a wall"])
def test_impacts_are_those_of_other_runs(case):
    start, walls, x = case
    x = np.array(x)
    slopes, found = jax.jit(jax.jacrev(lambda x: (rows(x, start, walls, steps=24),) * 2, has_aux=True))(x)
    plain = falling(x, start, walls, steps=24)
    assert len(plain.events) and plain.events.index[0] == 0
    np.testing.assert_array_equal(found, rows(x, start, walls, steps=24))
    d = 1e-7
    for i, unit in enumerate(np.eye(4)):
        change = (rows(x + d * unit, start, walls, steps=24) - rows(x - d * unit, start, walls, steps=24)) / (2 * d)
        np.testing.assert_allclose(slopes[:, i], change, rtol=1e-6, atol=1e-6 * np.max(np.abs(slopes)))


@pytest.mark.parametrize("engine", ["auto", "xla"])
@pytest.mark.soak
def test_a_ball_may_begin_at_rest(engine):
    """All unknowns of its first step were without a size by JAX alone: it stayed where it was for that step."""
    g = 1.3
    run = lambda g: falling(jnp.stack([0.0, 0.0, 0.0, g]), (0.0, 1.1), [FLOOR], steps=20, engine=engine).events.t[0]
    t, slope = jax.jit(lambda g: jax.jvp(run, (g,), (1.0,)))(g)
    np.testing.assert_allclose((t, slope), (np.sqrt(2.2 / g), -np.sqrt(2.2 / g) / (2 * g)), rtol=1e-12)


class Verlet(dx.AbstractScheme):
    """Of v²/2 − g q, with an h of its own: explicit."""

    def step_equation(self, system, shape):
        n = shape.n
        force = lambda q, params: jax.grad(lambda q: system.lagrangian(q, jnp.zeros(n), params))(q)

        def start(data, h, params):
            return jnp.concatenate([data["q"], data["p"]]), jnp.zeros(0)

        def advance(u, state, t, h, params):
            q, p = jnp.split(state, 2)
            middle = p + h / 2 * force(q, params)
            after = q + h * middle
            return jnp.concatenate([after, middle + h / 2 * force(after, params)])

        return dx.StepEquation(
            start=start,
            residual=lambda u, state, t, h, params: jnp.zeros(0),
            advance=advance,
            unpack=lambda state, u, t, h, params: {"q": state[:n], "p": state[n:]},
            fields={"q": dx.Field((n,)), "p": dx.Field((n,))},
            state_layout=dx.Layout(q=(n,), p=(n,)),
            unknowns=0,
        )


@pytest.mark.parametrize(
    ("scheme", "step", "order"),
    [
        (dx.LagrangeDAlembert(), 0.25, 2),
        (dx.LagrangeDAlembert(), 0.13, 2),
        (Verlet(), 0.25, 2),
        (dx.EnergyCollocation(3), 0.25, 1),
    ],
)
@pytest.mark.soak_of(but=["scheme2-0.25-2"])
def test_an_impact_on_a_row_has_the_derivatives_of_others(scheme, step, order):
    """From 1 with g = 2 the first one is at t = √(2/g) = 1; a step of 0.25 ends there."""
    ball = dx.LagrangeDirac(lambda q, v, params: v @ v / 2 - params * q[0])
    wall, steps = dx.Impact(lambda q: q[0], restitution=0.9), round(1.5 / step)

    def times(g):
        given = {"q": jnp.ones(1), "v": jnp.zeros(1), "params": g}
        return dx.simulate(ball, scheme, **given, step=step, steps=steps, events=[wall]).events.t[0]

    along = lambda g: jax.jvp(times if order == 1 else jax.value_and_grad(times), (g,), (1.0,))
    found = jax.jit(along)(2.0)  # of order 2 ((t, t′), (t′, t″))
    np.testing.assert_allclose(np.ravel(found), [1.0, -0.25, -0.25, 0.1875] if order == 2 else [1.0, -0.25], rtol=1e-11)


def test_trajectories_that_end_under_jit():
    """Impacts accumulate; one begins behind the floor. What is before the end has its derivatives."""
    dead = dx.Impact(lambda q: q[1], restitution=0.3)
    x = np.array([0.1, 0.9, 0.0, 1.0])
    plain = falling(x, (0.0, 1.0), [dead], steps=60)
    run = lambda x: falling(x, (0.0, 1.0), [dead], steps=60)

    def good(x):
        sol = run(x)
        return sol.q[: plain.rows], (sol.q, sol.ok, sol.events.t)

    slopes, (q, ok, times) = jax.jit(jax.jacrev(good, has_aux=True))(x)
    assert not plain.ok and not ok
    np.testing.assert_array_equal(q[: plain.rows], plain.q)
    assert np.all(np.isnan(q[plain.rows :]))
    np.testing.assert_array_equal(times[: len(plain.events)], plain.events.t)
    assert np.all(np.isnan(times[len(plain.events) :]))
    t = (plain.rows - 1) * 0.1
    np.testing.assert_allclose(slopes[-1, 0], [1.0, t, 0.0, 0.0], atol=1e-12)
    assert np.all(np.isfinite(slopes))
    behind = jax.jit(lambda x: falling(x, (0.0, -1.0), [dead], steps=3).q)(x)
    assert np.all(np.isfinite(behind[0])) and np.all(np.isnan(behind[1:]))


@pytest.mark.soak
def test_reverse_mode_and_second_derivatives():
    """A ball falls from height y onto a floor at 0: y(T) = e u s − s²/2 with u = √(2y) = t₁ and s = T − t₁."""
    ball, end = dx.LagrangeDirac(lambda q, v: v @ v / 2 - q[0]), 2.0

    def height(x):
        wall = dx.Impact(lambda q: q[0], restitution=x[1])
        run = dx.simulate(ball, dx.LagrangeDAlembert(), q=x[:1], v=jnp.zeros(1), step=0.1, steps=20, events=[wall])
        return run.q[-1, 0]

    def exact(x):
        fall = jnp.sqrt(2 * x[0])
        return x[1] * fall * (end - fall) - (end - fall) ** 2 / 2

    at, along = jnp.array([1.1, 0.8]), jnp.array([1.0, 0.5])
    found = jax.jit(lambda x: jax.jvp(jax.grad(height), (x,), (along,)))(at)
    np.testing.assert_allclose(found, jax.jvp(jax.grad(exact), (at,), (along,)), rtol=1e-10)


class Summing(dx.AbstractScheme):
    """Free flight, and on the side a sum of q over the steps, with which a step that leaves a row goes on if it is `resumed`."""

    resumed: bool | None = True

    def step_equation(self, system, shape):
        layout, nothing = dx.Layout(q=1, p=1, sum=()), jnp.zeros(0)

        def resume(data, h, params):
            return layout.join(q=data["q"], p=data["p"], sum=data["sum"] if self.resumed else 0.0), nothing

        def advance(u, x, t, h, params):
            q, p, so_far = layout.split(x)
            return layout.join(q=q + h * p, p=p, sum=so_far + h * q[0])

        return dx.StepEquation(
            start=lambda data, h, params: (layout.join(q=data["q"], p=data["p"], sum=0.0), nothing),
            resume=None if self.resumed is None else resume,
            residual=lambda u, x, t, h, params: nothing,
            advance=advance,
            unpack=lambda x, u, t, h, params: layout.split(x)._asdict(),
            state_layout=layout,
            unknowns=0,
            fields={"q": dx.Field((1,)), "p": dx.Field((1,)), "sum": dx.Field(())},
        )


def test_own_fields_of_a_scheme_go_through_a_wall():
    """q begins at 1 with the velocity −v; of four steps the third one is divided by the wall at 0, which is hit at 1/v."""
    free, wall = dx.LagrangeDirac(lambda q, v: v @ v / 2), dx.Impact(lambda q: q[0])

    def summed(v, scheme=Summing()):
        run = dx.simulate(free, scheme, q=jnp.ones(1), v=-v[None], step=0.5, steps=4, events=[wall])
        return run.fields["sum"][-1]

    def exact(v):
        onto, after = 1 / v - 1.0, 1.5 - 1 / v  # lengths of the parts of the third step
        return 0.5 + 0.5 * (1 - v / 2) + onto * (1 - v) + 0.5 * after * v

    at = jnp.array(0.75)
    np.testing.assert_allclose(jax.value_and_grad(summed)(at), jax.value_and_grad(exact)(at), rtol=1e-12)
    says = "how the step that leaves .* begins"
    between = lambda v, scheme: dx.simulate(free, scheme, q=jnp.ones(1), v=-v[None], step=0.5, steps=4).at(0.3).q[0]
    for run in (summed, jax.grad(summed), jax.grad(between)):
        with pytest.raises(ValueError, match=rf"does not say {says}.* start\(\) .*sum.*resume="):
            run(at, Summing(resumed=None))
    with pytest.raises(ValueError, match=rf"says {says}.* but its resume\(\) leads .* to sum = 0\.125"):
        summed(at, Summing(resumed=False))


def test_the_step_is_in_one_place_however_many_walls_there_are():
    """XLA compiles every copy of it, which took half a minute."""
    ball, scheme = dx.LagrangeDirac(lambda q, v: v @ v / 2 - q[0]), dx.LagrangeDAlembert()

    def loops(*walls):
        given = {"v": jnp.zeros(1), "step": 0.1, "steps": 2, "engine": "xla"}
        run = lambda q: dx.simulate(ball, scheme, q=q, events=list(walls), **given).q
        return jax.jit(run).lower(jnp.ones(1)).as_text().count("stablehlo.while")

    low, high = dx.Impact(lambda q: q[0]), dx.Impact(lambda q: 2.0 - q[0])
    assert loops(low) == loops(low, high) < 12
