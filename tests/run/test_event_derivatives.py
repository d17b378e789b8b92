"""Derivatives of events by data and params: against the closed form of a fall, and against differences of plain runs."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dirax as dx

BALL = dx.LagrangeDirac(lambda q, v, params: v @ v / 2 - params["g"] * q[1])
EVENTS = [
    dx.Event(lambda q, params: q[1] - params["height"]),
    dx.Event(lambda q: q[1], direction=-1, terminal=True),
]


DIRECTIONS = np.array([[0.6, -0.3, 0.5, 0.4], [0.2, 0.7, -0.4, 0.5]])
"""Along which derivatives are compared with differences."""


def run(given, **more):
    """A ball thrown upwards, through a height on its way up and down, to the ground."""
    y, speed, g, height = given
    xp = jnp if isinstance(given, jax.core.Tracer) else np
    q, v = xp.stack([0.0 * y, y]), xp.stack([0.3 + 0.0 * speed, speed])
    params = {"g": g, "height": height}
    return dx.simulate(BALL, dx.LagrangeDAlembert(), q=q, v=v, params=params, step=0.07, steps=40, events=EVENTS, **more)


def measured(given):
    """Times, places and momenta of the three events, and a row before the end; and all there is to look at."""
    sol = run(given)
    xp = jnp if isinstance(given, jax.core.Tracer) else np
    numbers = xp.concatenate([sol.events.t[:3], sol.events.q[:3].ravel(), sol.events.p[:3].ravel(), sol.q[20]])
    return numbers, (numbers, sol.events.t, sol.events.index, sol.events.direction, sol.q)


def exact(given):
    """The times."""
    y, speed, g, height = given
    falls = lambda to: (speed + jnp.array([-1.0, 1.0]) * jnp.sqrt(speed**2 + 2 * g * (y - to))) / g
    up, down = falls(height)
    return jnp.stack([up, down, falls(0.0)[1]])


@pytest.mark.soak
def test_times_and_places_of_events():
    at = np.array([0.5, 1.0, 1.0, 0.8])
    jacobian, (values, *whole) = jax.jit(jax.jacfwd(measured, has_aux=True))(at)
    np.testing.assert_allclose(values, measured(at)[0], rtol=0, atol=1e-13)
    np.testing.assert_allclose(values[:3], exact(at), rtol=1e-13)
    np.testing.assert_allclose(jacobian[:3], jax.jacfwd(exact)(at), rtol=0, atol=1e-11)
    d = 1e-3
    for direction in DIRECTIONS:
        change = lambda step, along=direction: measured(at + step * along)[0] - measured(at - step * along)[0]
        np.testing.assert_allclose(jacobian @ direction, (8 * change(d) - change(2 * d)) / (12 * d), rtol=0, atol=1e-8)
    # what comes after the end is not there
    t, index, direction, q = map(np.asarray, whole)
    assert np.array_equal(index[:3], [0, 0, 1]) and np.array_equal(direction[:3], [1, -1, -1]) and np.all(np.isnan(t[3:]))
    assert np.array_equal(np.isfinite(q).all(axis=1), np.arange(41) * 0.07 <= t[2])


SWING = dx.LagrangeDirac(lambda q, v, params: v @ v / 2 - params["k"] * q @ q / 2 - q[0] ** 4 / 4)
PASSES = [dx.Event(lambda t, q, v, params: q[0] - params["c"] * (1 + t / 50) + v[0] / 30)]


def swung(a, step=0.1, steps=40, events=PASSES):
    params = {"k": 1.2, "c": a[1]}
    return dx.simulate(SWING, dx.LagrangeDAlembert(), q=[a[0]], v=[0.3], params=params, step=step, steps=steps, events=events)


@pytest.mark.soak
def test_events_are_those_of_plain_runs_and_nothing_is_lost_by_vmap():
    """Dips between the points at which a function is looked at, functions that close over what is traced, several steps."""
    at, lowest = jnp.array([1.0, 0.2]), dx.simulate(
        SWING, dx.LagrangeDAlembert(), q=[1.0], v=[0.3], params={"k": 1.2, "c": 0.0}, step=0.1, steps=40
    ).at(np.linspace(0, 4, 40001)).q.min()  # fmt: skip
    graze = dx.Event(lambda q: q[0] - (lowest + 1e-6))
    plain = swung(at, events=[graze])
    traced = jax.jit(lambda a: swung(a, events=[graze]).events.t)(at)
    assert len(plain.events.t) == 2 and np.ptp(plain.events.t) < 0.02
    np.testing.assert_allclose(traced[:2], plain.events.t, rtol=0, atol=1e-13)
    assert np.all(np.isnan(traced[2:]))

    def closing(a):
        return swung(a, events=[dx.Event(lambda t, q, v: q[0] - a[1] * (1 + t / 50) + v[0] / 30)]).events.t[:2]

    ways = [jax.jacrev(f) for f in (lambda a: swung(a).events.t[:2], closing)]
    np.testing.assert_allclose(*jax.jit(lambda a: [way(a) for way in ways])(at), rtol=1e-11)
    slope = jax.grad(lambda h: swung(at, h, 60).events.t[0])
    steps, alone = jnp.array([0.1, 0.05, 0.1]), jax.jit(slope)
    np.testing.assert_array_equal(jax.jit(jax.vmap(slope))(steps), [alone(h) for h in steps])


@pytest.mark.soak
def test_second_derivatives_of_an_event():
    def cost(a):
        events = swung(a).events
        return jnp.sin(events.t[1]) * events.p[0, 0] + events.q[1, 0] ** 2

    at, d = jnp.array([1.0, 0.2]), 1e-3
    both = jax.jit(jax.jacfwd(lambda a: (jax.grad(cost)(a),) * 2, has_aux=True))
    hessian, slope = both(at)[0], lambda a: both(a)[1]
    for i, unit in enumerate(np.eye(2)):
        change = lambda step, unit=unit: slope(at + step * unit) - slope(at - step * unit)
        np.testing.assert_allclose(hessian[i], (8 * change(d) - change(2 * d)) / (12 * d), rtol=0, atol=1e-7)


@pytest.mark.parametrize(
    "scheme",
    [
        dx.Collocation(4),
        dx.Composition(dx.LagrangeDAlembert(), "yoshida4"),
        dx.VariableSteps(dx.Collocation(3), lambda q: 1 + q @ q / 3),
    ],
    ids=lambda s: type(s).__name__,
)
@pytest.mark.soak_of("VariableSteps")
def test_every_kind_of_dense_output(scheme):
    swing = dx.LagrangeDirac(lambda q, v, params: v @ v / 2 - params["k"] * q @ q / 2)
    event = dx.Event(lambda t, q, v, params: q[0] - params["c"] * (1 + t / 50) + v[0] / 30, direction=-1)

    def found(a):
        xp = jnp if isinstance(a, jax.core.Tracer) else np
        given = {"q": xp.stack([a[0]]), "v": xp.stack([a[1]]), "params": {"k": a[2], "c": a[3]}}
        events = dx.simulate(swing, scheme, step=0.1, steps=90, events=[event], **given).events
        return xp.stack([events.t[1], events.q[1, 0], events.p[1, 0]])

    at, d = np.array([1.0, 0.3, 1.2, 0.2]), 1e-3
    gradient = jax.jit(jax.jacrev(found))(at)
    for direction in DIRECTIONS:
        change = lambda step, along=direction: found(at + step * along) - found(at - step * along)
        np.testing.assert_allclose(gradient @ direction, (8 * change(d) - change(2 * d)) / (12 * d), rtol=0, atol=1e-8)
