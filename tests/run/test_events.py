"""Events: found to the last digits, none is missed, both engines, batches, ends, and what is refused."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dirax as dx
from dirax.gallery import poincare_section
from dirax.run import event_search

OSCILLATOR = dx.LagrangeDirac(lambda q, v: v @ v / 2 - q @ q / 2)
START = {"q": [1.0], "v": [0.0], "step": 0.1, "steps": 300}


def position(q):
    return q[0]


@pytest.mark.parametrize("engine", ["native", "xla"])
@pytest.mark.soak_of("xla")
def test_zeros_are_found_inside_the_steps(engine):
    events = [dx.Event(position), dx.Event(lambda t, v: v[0] + 0.0 * t, direction=-1), dx.Event(lambda q: q[0] - 0.99999)]
    sol = dx.simulate(OSCILLATOR, dx.Collocation(8), engine=engine, events=events, **START)
    first, second, third = (sol.events.of(i) for i in range(3))
    assert np.max(np.abs(first.t - np.pi * (np.arange(10) + 0.5)[: len(first)])) <= 1e-13
    assert len(first) == 10 and np.array_equal(first.direction, [-1, 1] * 5)
    assert np.max(np.abs(first.q)) <= 1e-15 and np.max(np.abs(np.abs(first.p) - 1.0)) <= 1e-13
    # v = −sin t, which is zero at the first row, falls through zero at 2π, 4π, …
    assert np.max(np.abs(second.t - 2 * np.pi * np.arange(1, 5))) <= 1e-13
    # 9·10⁻³ apart, inside one step of .1: around every maximum, and once after the start
    assert len(third) == 9 and np.max(np.abs(third.q - 0.99999)) <= 1e-15
    plain = dx.simulate(OSCILLATOR, dx.Collocation(8), engine=engine, **START)
    assert np.array_equal(plain.q, sol.q) and np.array_equal(plain.p, sol.p) and set(sol.fields) == set(plain.fields)


def test_schemes_without_a_polynomial_have_them_on_their_cubic():
    sol = dx.simulate(OSCILLATOR, dx.LagrangeDAlembert(), events=[dx.Event(position)], **START)
    assert np.max(np.abs(sol.events.q)) <= 1e-15
    assert np.max(np.abs(sol.at(sol.events.t).q)) <= 1e-13
    angle = 2 * np.arctan(0.05) / 0.1  # of the midpoint rule, a rotation
    assert np.max(np.abs(sol.events.t * angle - np.pi * (np.arange(len(sol.events)) + 0.5))) <= 1e-4


def test_a_terminal_event_ends_a_trajectory_and_no_other():
    ends = dx.Event(lambda q: q[0] - 0.7, terminal=True)
    many = {"q": np.array([[1.0], [2.0], [0.5]]), "v": np.zeros((3, 1)), "step": 0.1, "steps": 700}
    batch = dx.simulate(OSCILLATOR, dx.Collocation(4), events=[dx.Event(position), ends], **many)
    assert np.all(batch.ok) and [bool(text) for text in batch.message] == [True, True, False]
    assert np.max(np.abs(batch.events.of(1).t - np.arccos([0.7, 0.35]))) <= 1e-9
    assert list(batch.events.of(1).lane) == [0, 1] and set(batch.events.of(0).lane) == {2}
    for lane, amplitude in enumerate([1.0, 2.0, 0.5]):
        one = dx.simulate(
            OSCILLATOR, dx.Collocation(4), q=[amplitude], v=[0.0], step=0.1, steps=700, events=[dx.Event(position), ends]
        )
        assert one.ok and np.array_equal(one.q, batch[lane].q) and np.array_equal(one.events.t, batch[lane].events.t)
        assert (lane == 2) == (one.message == "") and one.t[-1] == batch[lane].t[-1]
        assert one.extend(5).t[-1] == pytest.approx(one.t[-1] + 0.5 * (lane == 2))


def test_rows_are_thinned_and_longer_runs_have_more_events():
    short = dx.simulate(OSCILLATOR, dx.Collocation(4), save_every=70, events=[dx.Event(position)], **START)
    assert np.allclose(short.t, [0.0, 7.0, 14.0, 21.0, 28.0, 30.0])
    longer = short.extend(100)
    assert np.array_equal(longer.events.t[: len(short.events)], short.events.t) and len(longer.events) == 13
    assert longer.t[-1] == pytest.approx(40.0) and longer.t[1] == pytest.approx(7.0)


def test_a_prepared_run_has_them():
    run = dx.prepare(OSCILLATOR, dx.Collocation(4), events=[dx.Event(position)], **START)
    assert np.array_equal(run(q=[2.0]).events.t, run().events.t)  # the frequency does not depend on the amplitude
    assert np.max(np.abs(run(q=[2.0]).events.p)) == pytest.approx(2.0)


def test_the_section_of_henon_and_heiles():
    events = poincare_section.section(orbits=6, steps=200).events
    finer = poincare_section.section(orbits=6, steps=400, step=0.25).events
    assert len(events) == len(finer) and np.max(np.abs(events.q[:, 0])) <= 1e-15
    soon = events.t < 30
    assert np.max(np.abs(events.t - finer.t)[soon]) <= 1e-6
    energy = np.sum(events.p**2 + events.q**2, axis=1) / 2 + events.q[:, 0] ** 2 * events.q[:, 1] - events.q[:, 1] ** 3 / 3
    assert np.max(np.abs(energy - 1 / 8)) <= 1e-7 and np.all(events.p[:, 0] > 0)


def test_the_picture_of_a_section(tmp_path):
    poincare_section.picture(tmp_path / "section.png", orbits=3, steps=50)
    assert (tmp_path / "section.png").stat().st_size > 5000


@pytest.mark.parametrize(
    ("events", "error", "text"),
    [
        ([position], TypeError, "write dx.Event"),
        (3, TypeError, "list of dx.Event"),
        ([dx.Event(lambda q: q)], ValueError, r"one number, but it returned shape \(1,\)"),
        ([dx.Event(lambda x: x[0])], TypeError, r"asks for x, but a run .* knows t, q, p, v, params"),
        ([dx.Event(lambda q: np.log(q))], TypeError, r"events\[0\] could not be traced"),
        ([dx.Event(lambda q: jax.numpy.log(q[0] - 2.0))], ValueError, "must be a number, but it is none at the start"),
    ],
)
def test_bad_events_are_refused(events, error, text):
    with pytest.raises(error, match=text):
        dx.simulate(OSCILLATOR, dx.Collocation(2), events=events, **START)


def test_where_a_function_is_no_number_what_is_known_is_kept():
    """Of two free particles one leaves the domain of the function at t = 0.5: the whole batch was refused for it."""
    free, start = dx.LagrangeDirac(lambda q, v: v @ v / 2), {"q": [[1.0], [1.0]], "v": [[-1.0], [1.0]], "step": 0.15, "steps": 10}
    root = lambda q: jax.numpy.sqrt(q[0] - 0.5) - np.sqrt(0.1)
    run = lambda *events: dx.simulate(free, dx.LagrangeDAlembert(), **start, events=[*events, dx.Event(lambda q: q[0] - 1.3)])
    with pytest.warns(RuntimeWarning, match=r"events\[0\] is no number at t = 0\..* in trajectory 0: its events after that"):
        both = run(dx.Event(root))
    np.testing.assert_allclose(both.events.of(0).t, [0.4], rtol=1e-12)
    np.testing.assert_allclose(both.events.of(1).t, [0.3], rtol=1e-12)
    assert np.all(both.ok) and "events after that are not known" in both.message[0] and both.message[1] == ""
    with pytest.warns(RuntimeWarning):
        ended = run(dx.Event(lambda q: jax.numpy.sqrt(q[0] - 0.5) + 1.0, terminal=True))
    assert list(ended.ok) == [False, True] and "ended where the function of events[0] is no number" in ended.message[0]
    assert np.all(np.isfinite(ended.q[0, :4])) and np.all(np.isnan(ended.q[0, 4:])) and np.all(np.isfinite(ended.q[1]))
    walls = run(dx.Impact(lambda q: jax.numpy.sqrt(q[0] - 0.5) + 1.0))
    assert list(walls.ok) == [False, True] and "ended where the gap of events[0] is nan, at t = 0." in walls.message[0]
    assert np.all(np.isfinite(walls.q[0, :4])) and np.all(np.isnan(walls.q[0, 4:])) and np.all(np.isfinite(walls.q[1]))


def test_bad_arguments_of_an_event_are_refused():
    with pytest.raises(ValueError, match="rising"):
        dx.Event(position, direction=2)
    with pytest.raises(TypeError, match="it takes angle"):
        dx.Event(lambda angle: angle)
    with pytest.raises(TypeError, match="but 3 was given"):
        dx.Event(3)


@pytest.mark.parametrize("scheme", [dx.LagrangeDAlembert(), dx.Collocation(3)], ids=lambda s: type(s).__name__)
@pytest.mark.soak_of("LagrangeDAlembert")
def test_many_steps_are_looked_through_as_few_are(scheme, monkeypatch):
    system = dx.LagrangeDirac(
        lambda t, q, v: v @ v / 2 - q @ q / 2 - q[0] ** 2 * q[1] + q[1] ** 3 / 3 + 0.01 * jax.numpy.cos(t) * q[0]
    )
    events = [dx.Event(lambda q: q[0]), dx.Event(lambda t, q, v: v[1] - 0.35 + 0.0 * t), dx.Event(lambda q: q[1] + 9.0)]
    start = {"q": [[0.0, 0.1], [0.1, 0.0]], "v": [[0.4, 0.1], [0.3, 0.2]], "step": 0.3, "steps": 1000, "events": events}
    few, many = found_by_both(system, scheme, start, monkeypatch)
    assert len(few) > 200 and np.array_equal(few.t, many.t) and np.array_equal(few.q, many.q)
    assert np.array_equal(few.index, many.index) and np.array_equal(few.lane, many.lane)


def found_by_both(system, scheme, start, monkeypatch):
    """The events of a run whose steps are looked at first by machine code, and of one of which each is looked into."""
    for fewest in (1, 10**9):
        monkeypatch.setattr(event_search, "FEWEST", fewest)
        yield dx.simulate(system, scheme, **start).events


def test_large_steps_of_a_composition_are_looked_into(monkeypatch):
    """Where the step says nothing of its inside, and the cubic through rows and velocities is off by what matters: the
    difference of the velocities, with zeros a third of a step apart."""
    system = dx.LagrangeDirac(lambda q, v: v @ v / 2 - q[0] ** 2 / 2 - 1.7 * q[1] ** 2 / 2 - 0.3 * q[0] * q[1] ** 2)
    apart = [dx.Event(lambda v: v[0] - v[1])]
    places = np.random.default_rng(0).normal(size=(8, 2)) / 10
    start = {"q": np.array([0.8, 0.3]) + places, "v": np.array([0.1, 0.4]) - places, "step": 0.9, "steps": 120, "events": apart}
    few, many = found_by_both(system, dx.Composition(dx.LagrangeDAlembert(), "suzuki4"), start, monkeypatch)
    assert len(few) > 170 and np.array_equal(few.t, many.t)


def test_an_entry_that_there_is_not_is_refused_and_one_looked_up_is_not():
    free = dx.LagrangeDirac(lambda q, v: v @ v / 2)
    start = {"q": [1.0, 0.0], "v": [0.0, 1.0], "step": 0.1, "steps": 5}
    for event in (dx.Event(lambda q: q[7]), dx.Impact(lambda q: 2.0 + q[7])):
        with pytest.raises(ValueError, match=r"events\[0\] reads an entry that its arguments do not have"):
            dx.simulate(free, dx.LagrangeDAlembert(), events=[event], **start)
    looked_up = dx.Event(lambda q: q[jnp.argmax(q)] - 0.5 + jnp.array([0.0, 1.0])[jnp.int64(q[0] > 7)])
    assert not len(dx.simulate(free, dx.LagrangeDAlembert(), events=[looked_up], **start).events)


@pytest.mark.parametrize(
    "scheme",
    [
        dx.PlusLagrangeDirac(),
        dx.MinusLagrangeDirac("midpoint"),
        dx.DiscreteDirac(dx.Theta(0.0)),
        dx.DiscreteDirac(dx.Theta(1.0), constraints="resolve"),
    ],
)
def test_schemes_of_first_order_have_no_bend_of_the_velocity_of_their_own(scheme):
    """Rows have velocities of half a step before or after: a cubic through them crossed zero two or three times."""
    stiffening = dx.LagrangeDirac(lambda q, v: v @ v / 2 - q @ q / 2 - q[0] ** 4)
    events = [dx.Event(lambda p: p[0]), dx.Event(lambda v: v[0])]
    sol = dx.simulate(stiffening, scheme, q=[1.0], v=[0.3], step=0.02, steps=400, events=events)
    crossings = np.flatnonzero(np.diff(np.sign(sol.p[:, 0])))
    for number in (0, 1):
        found = sol.events.t[sol.events.index == number]
        assert len(found) == 6 and np.all(np.floor(found / 0.02) == crossings)
    rows = sol.at(sol.t)
    np.testing.assert_allclose(rows.p, sol.p, atol=1e-14)
    inside = sol.at(np.linspace(0.0, 8.0, 4001))
    slope, mean = np.diff(inside.q[:, 0]) / 0.002, (inside.p[1:, 0] + inside.p[:-1, 0]) / 2
    assert np.max(np.abs(slope - mean)) < 0.06  # half a step of the largest force


def test_a_long_run_of_rows_without_velocities():
    """It ended in a KeyError, of a reduced system from 20 000 steps on."""
    inertia = np.array([1.0, 2.0, 3.5])
    body = dx.EulerPoincare(dx.SO3(), lambda xi: xi @ (inertia * xi) / 2)
    crosses = dx.Event(lambda x: x[1])
    run = lambda steps: dx.simulate(body, dx.DiscreteEulerPoincare(), x=[0.1, 2.0, 0.05], step=0.5, steps=steps, events=[crosses])
    long, short = run(20_000), run(2_000)
    assert len(short.events) > 80 and np.array_equal(long.events.t[: len(short.events)], short.events.t)
