"""Impacts: times, energy, momenta and constraints through walls, accumulation, and what is refused."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dirax as dx
from dirax.gallery import rolling_ball
from dirax.run.flight import Flight

BALL = dx.LagrangeDirac(lambda q, v: v @ v / 2 - q[1])
FLOOR = dx.Impact(lambda q: q[1])
DROP = {"q": [0.0, 1.0], "v": [0.3, 0.0]}
FALL = np.sqrt(2.0)


@pytest.mark.parametrize("engine", ["native", "xla"])
@pytest.mark.soak_of("native")
def test_a_ball_bounces_at_the_right_times_and_keeps_its_energy(engine):
    sol = dx.simulate(BALL, dx.LagrangeDAlembert(), step=0.05, steps=200, events=[FLOOR], engine=engine, **DROP)
    events = sol.events
    assert len(events) == 4 and np.max(np.abs(events.t - FALL * (1 + 2 * np.arange(4)))) <= 1e-13
    assert np.max(np.abs(sol.energy() - sol.energy()[0])) <= 1e-14 and np.ptp(sol.p[:, 0]) <= 1e-15
    assert np.max(np.abs(events.q[:, 1])) <= 1e-14 and np.all(events.p[:, 1] > 0)
    t = np.linspace(1.3, 1.5, 9)
    assert np.max(np.abs(sol.at(t).q[:, 1] - np.where(t < FALL, 1 - t**2 / 2, FALL * (t - FALL) - (t - FALL) ** 2 / 2))) <= 1e-14
    assert sol.ok and sol.message == "" and dx.verify(sol).ok


def test_events_stand_beside_walls():
    sol = dx.simulate(
        BALL, dx.Collocation(2), step=0.3, steps=20, events=[FLOOR, dx.Event(lambda q: q[1] - 0.5, direction=-1)], **DROP
    )
    assert np.array_equal(sol.events.index, [1, 0, 1, 0][: len(sol.events)])
    assert np.max(np.abs(sol.events.of(1).t - [1.0, 1.0 + 2 * FALL])) <= 1e-13


@pytest.mark.soak
def test_events_beside_walls_of_a_system_that_takes_whole_numbers():
    """JAX computes the states there, for there is no scalar program."""
    heavy = dx.LagrangeDirac(lambda q, v, params: v @ v / 2 - params.astype(float) * q[1])
    events = [FLOOR, dx.Event(lambda q: q[1] - 0.5, direction=-1)]
    sol = dx.simulate(heavy, dx.LagrangeDAlembert(), params=1, step=0.3, steps=6, events=events, **DROP)
    assert np.array_equal(sol.events.index, [1, 0]) and abs(sol.events.of(0).t[0] - FALL) <= 1e-13


@pytest.mark.parametrize("scheme", [dx.Collocation(2), dx.VariableSteps(dx.Collocation(2), lambda q: 1.0 + 0.0 * q[0])])
def test_events_beside_walls_stay_in_a_run_that_is_extended(scheme):
    given = {"events": [FLOOR, dx.Event(lambda v: v[1], direction=-1)], "step": 0.05, **DROP}
    whole = dx.simulate(BALL, scheme, steps=140, **given)
    longer = dx.simulate(BALL, scheme, steps=70, **given).extend(70)
    assert np.array_equal(whole.events.index, [0, 1, 0, 1]) and np.array_equal(longer.events.index, whole.events.index)
    assert np.array_equal(longer.events.t, whole.events.t)


def test_a_stretch_of_time_has_its_own_events():
    sol = dx.simulate(
        BALL, dx.Collocation(2), step=0.05, steps=160, events=[FLOOR, dx.Event(lambda v: v[1], direction=-1)], **DROP
    )
    part = sol[2.0:5.0]
    assert np.array_equal(part.events.t, sol.events.t[1:3]) and np.array_equal(part.impacts.t, sol.impacts.t[1:2])
    assert len(sol[:160].impacts) == len(sol.impacts) and dx.verify(part).ok
    assert np.array_equal(part.at(4.26).q, sol.at(4.26).q)


def test_what_comes_after_a_terminal_event_is_no_impact_of_the_run():
    apex = dx.Event(lambda v: v[1], direction=-1, terminal=True)
    sol = dx.simulate(BALL, dx.Collocation(2), step=0.05, steps=160, events=[FLOOR, apex], **DROP)
    assert len(sol.events) == 2 and np.max(np.abs(sol.impacts.t - FALL)) <= 1e-13 and len(sol.impacts) == 1
    assert dx.verify(sol)["impacts"].value == 1


def test_a_batch_has_the_bits_of_single_runs():
    q, v = np.array([[0.0, 1.0], [0.0, 2.0]]), np.array([[0.3, 0.0], [0.1, 0.0]])
    batch = dx.simulate(BALL, dx.LagrangeDAlembert(), q=q, v=v, step=0.05, steps=60, events=[FLOOR])
    for lane in range(2):
        one = dx.simulate(BALL, dx.LagrangeDAlembert(), q=q[lane], v=v[lane], step=0.05, steps=60, events=[FLOOR])
        assert np.array_equal(one.q, batch[lane].q) and np.array_equal(one.events.t, batch[lane].events.t)


def test_many_impacts_leave_the_energy_where_it_is():
    box = dx.LagrangeDirac(lambda q, v: v @ v / 2)
    walls = [dx.Impact(lambda q: q[0]), dx.Impact(lambda q: 1 - q[0]), dx.Impact(lambda q: q[1]), dx.Impact(lambda q: 1 - q[1])]
    sol = dx.simulate(box, dx.LagrangeDAlembert(), q=[0.1, 0.2], v=[1.0, 0.7], step=0.05, steps=1000, events=walls)
    folded = lambda x: np.abs((x + 1) % 2 - 1)
    assert len(sol.events) == 85 and np.max(np.abs(sol.q[:, 1] - folded(0.2 + 0.7 * sol.t))) <= 1e-12
    assert np.max(np.abs(sol.energy() - sol.energy()[0])) <= 1e-14


def quaternion_ball():
    """A ball that rolls on a plane, its attitude a unit quaternion (w, x, y, z): no chart of angles ends. I = .4."""
    turn = lambda e: 2 * jnp.array([[-e[1], e[0], -e[3], e[2]], [-e[2], e[3], e[0], -e[1]]])  # ω_x and ω_y of ė
    return dx.LagrangeDirac(
        lambda q, v: (v[0] ** 2 + v[1] ** 2) / 2 + 0.8 * (v[2:] @ v[2:]),
        lambda q: jnp.concatenate([jnp.eye(2), jnp.stack([-turn(q[2:])[1], turn(q[2:])[0]])], axis=1),
        holonomic=lambda q: jnp.array([(q[2:] @ q[2:] - 1) / 2]),
    )


def spin(q, p):
    """I ω_z of that ball, which neither constraints nor upright walls change."""
    w, x, y, z = np.moveaxis(q[..., 2:], -1, 0)
    return np.sum(np.stack([-z, -y, x, w], axis=-1) * p[..., 2:], axis=-1) / 2


LONG = {  # system, scheme, wall, data, steps for an impact, (energy, momentum) at impacts
    "particle": (
        BALL, dx.LagrangeDAlembert(), FLOOR, DROP | {"step": 0.5}, 5.66,
        lambda q, p: (np.sum(p**2, axis=1) / 2 + q[:, 1], p[:, 0]),
    ),
    "ellipse": (
        dx.LagrangeDirac(lambda q, v: (v[0] ** 2 + v[1] ** 2 + 0.3 * v[2] ** 2) / 2 - q[1]), dx.LagrangeDAlembert(),
        dx.Impact(lambda q: q[1] - jnp.sqrt(jnp.sin(q[2]) ** 2 + 0.25 * jnp.cos(q[2]) ** 2)),
        {"q": [0.0, 2.0, 0.4], "v": [0.1, 0.0, 0.3], "step": 0.2}, 10.6,
        lambda q, p: ((p[:, 0] ** 2 + p[:, 1] ** 2 + p[:, 2] ** 2 / 0.3) / 2 + q[:, 1], p[:, 0]),
    ),
    "rolling ball": (
        quaternion_ball(), dx.LagrangeDAlembert(), dx.Impact(lambda q: 4.0 - q[0] ** 2 - q[1] ** 2),
        {"q": [0.3, 0.0, 1.0, 0.0, 0.0, 0.0], "v": [0.9, 0.4, 0.0, -0.2, 0.45, 0.15], "step": 0.5}, 8.2,
        lambda q, p: (np.sum(p[:, :2] ** 2, axis=1) / 2 + np.sum(p[:, 2:] ** 2, axis=1) / 3.2, spin(q, p)),
    ),
}  # fmt: skip


@pytest.mark.parametrize("impacts", [300, pytest.param(10**6, marks=pytest.mark.soak)])
@pytest.mark.parametrize("name", ["particle", "ellipse", pytest.param("rolling ball", marks=pytest.mark.soak)])
@pytest.mark.soak_of("ellipse-300")
def test_a_million_impacts_leave_energy_and_momentum_where_they_are(name, impacts):
    system, scheme, wall, given, steps, kept = LONG[name]
    sol = dx.simulate(system, scheme, events=[wall], steps=int(steps * impacts), **given)
    energy, momentum = kept(sol.events.q, sol.events.p)
    assert sol.ok and len(sol.events) >= 0.95 * impacts  # how many there are hangs on roundoff
    assert np.max(np.abs(energy - energy[0])) <= (1e-10 if impacts > 300 else 1e-13)
    assert np.ptp(momentum) <= (1e-10 if impacts > 300 else 1e-13)
    if name == "rolling ball":  # all chords are of one length, as in a round billiard
        assert np.ptp(np.hypot(*np.diff(sol.events.q[:, :2], axis=0).T)) <= 1e-11


@pytest.mark.soak
def test_a_rolling_ball_in_a_cylinder():
    """A ball that rolls on a plane inside an upright cylinder. Between walls the centre goes straight on; at them it is reflected
    and the ball goes on rolling, so that all chords are one length, as in a round billiard, up to the O(h²) of the scheme."""
    system, params = rolling_ball.EXAMPLE.system, rolling_ball.PARAMS | {"g": 0.0}
    start = {"q": [0.0, 0.0, 0.2, 1.2, 0.0], "v": [0.9, 0.4, 0.7, 0.1, 0.2], "params": params, "project": True}
    wall, errors = dx.Impact(lambda q: 4.0 - q[0] ** 2 - q[1] ** 2), []
    for h in (0.04, 0.02):
        sol = dx.simulate(system, dx.DiscreteDirac(constraints="resolve"), step=h, steps=round(30 / h), events=[wall], **start)
        chords = np.hypot(*np.diff(sol.events.q[:, :2], axis=0).T)
        assert len(chords) >= 4 and np.max(np.abs(sol.constraint_residual())) <= 1e-12
        errors.append(np.ptp(chords))
        energy = lambda q, p: float(system.energy_at({"q": jnp.asarray(q), "p": jnp.asarray(p), "t": 0.0}, params))
        before = sol.at(sol.events.t[:4] - 1e-10)
        for i in range(4):
            assert abs(energy(sol.events.q[i], sol.events.p[i]) - energy(before.q[i], before.p[i])) <= 1e-12
    assert errors[0] < 1e-2 and errors[1] < 0.35 * errors[0]


@pytest.mark.parametrize(
    "scheme",
    [
        dx.DiscreteDirac(),
        *(pytest.param(scheme, marks=pytest.mark.soak) for scheme in (dx.LagrangeDAlembert(), dx.Collocation(2))),
    ],
    ids=lambda s: type(s).__name__,
)
def test_an_ellipse_bounces(scheme):
    system = dx.LagrangeDirac(lambda q, v: (v[0] ** 2 + v[1] ** 2 + 0.3 * v[2] ** 2) / 2 - q[1])
    wall = dx.Impact(lambda q: q[1] - jnp.sqrt(jnp.sin(q[2]) ** 2 + 0.25 * jnp.cos(q[2]) ** 2))
    sol = dx.simulate(system, scheme, q=[0.0, 2.0, 0.4], v=[0.1, 0.0, 0.3], step=0.02, steps=1000, events=[wall])
    gaps = sol.q[:, 1] - np.sqrt(np.sin(sol.q[:, 2]) ** 2 + 0.25 * np.cos(sol.q[:, 2]) ** 2)
    assert len(sol.events) >= 8 and np.min(gaps) >= -1e-13 and np.ptp(sol.p[:, 0]) <= 1e-15
    assert np.max(np.abs(sol.energy() - sol.energy()[0])) <= 2e-14


@pytest.mark.soak
def test_a_blade_stays_on_its_line_through_impacts():
    blade = dx.LagrangeDirac(
        lambda q, v: (v[0] ** 2 + v[1] ** 2 + 0.5 * v[2] ** 2) / 2, lambda q: jnp.array([[jnp.sin(q[2]), -jnp.cos(q[2]), 0.0]])
    )
    start = {"q": [0.0, 0.0, 0.2], "v": [np.cos(0.2), np.sin(0.2), 0.3]}
    rink = dx.Impact(lambda q: 1.0 - q[0] ** 2 - q[1] ** 2)
    sol = dx.simulate(blade, dx.DiscreteDirac(constraints="resolve"), step=0.02, steps=600, events=[rink], **start)
    after = sol.events
    assert len(after) >= 5 and np.max(np.abs(np.sum(after.q[:, :2] ** 2, axis=1) - 1)) <= 1e-13
    assert np.max(np.abs(np.sin(after.q[:, 2]) * after.p[:, 0] - np.cos(after.q[:, 2]) * after.p[:, 1])) <= 1e-15
    assert np.max(np.abs(sol.energy() - sol.energy()[0])) <= 1e-14


@pytest.mark.parametrize("scheme", [dx.LagrangeDAlembert(), dx.Collocation(3, nodes="lobatto")], ids=lambda s: type(s).__name__)
@pytest.mark.soak_of("LagrangeDAlembert")
def test_a_rod_is_as_long_after_an_impact(scheme):
    rod = dx.LagrangeDirac(lambda q, v: v @ v / 2 - 9.81 * q[1], holonomic=lambda q: jnp.array([(q @ q - 1) / 2]))
    wall = dx.Impact(lambda q: q[0] + 0.2)
    sol = dx.simulate(rod, scheme, q=[0.6, -0.8], v=[0.8, 0.6], step=0.01, steps=500, events=[wall])
    assert sol.ok and len(sol.events) >= 3 and np.max(np.abs(np.sum(sol.q**2, axis=1) - 1)) <= 1e-13
    assert np.max(np.abs(np.sum(sol.events.q * sol.events.p, axis=1))) <= 1e-13
    assert np.max(np.abs(sol.energy() - sol.energy()[0])) <= 2e-3


SLOPE = dx.LagrangeDirac(lambda q, v: v @ v / 2 - q[1] - 0.1 * q[0] ** 2)


@pytest.mark.parametrize(
    "scheme",
    [dx.EnergyCollocation(2), dx.VariableSteps(dx.Collocation(4), lambda q: 1 + q @ q), dx.Collocation(4)],
    ids=lambda s: type(s).__name__,
)
@pytest.mark.soak_of(but=["Collocation"])
def test_schemes_with_more_in_their_state(scheme):
    """q₁ is a fall onto the floor, exactly; q₀ swings in between, and there is energy at every impact."""
    sol = dx.simulate(SLOPE, scheme, step=0.1, steps=120, events=[FLOOR], **DROP)
    count = len(sol.events)
    assert count >= 2 and np.max(np.abs(sol.events.t - FALL * (1 + 2 * np.arange(count)))) <= 1e-12
    assert np.max(np.abs(sol.energy() - sol.energy()[0])) <= (1e-14 if type(scheme).__name__ == "EnergyCollocation" else 1e-8)
    t = np.linspace(1.3, 1.5, 9)
    fallen = np.where(t < FALL, 1 - t**2 / 2, FALL * (t - FALL) - (t - FALL) ** 2 / 2)
    assert np.max(np.abs(sol.at(t).q[:, 1] - fallen)) <= 1e-13
    assert np.array_equal(sol.at(sol.events.t).p[:, 1] > 0, np.ones(count, bool))
    q, v = np.array([[0.0, 1.0], [0.0, 1.7]]), np.array([[0.3, 0.0], [0.1, 0.2]])
    batch = dx.simulate(SLOPE, scheme, step=0.1, steps=120, events=[FLOOR], q=q, v=v)
    assert np.array_equal(batch[0].q, sol.q) and np.array_equal(batch[0].events.t, sol.events.t) and dx.verify(batch).ok


ODD = {
    "relativistic": lambda q, v: -jnp.sqrt(1 - v @ v) - 0.2 * q[1],
    "without symmetry": lambda q, v: v @ v / 2 + 0.3 * v[0] * v[1] ** 2 + (v @ v) ** 2 / 10 - 0.2 * q[1],
}


@pytest.mark.parametrize("name", ["relativistic", pytest.param("without symmetry", marks=pytest.mark.soak)])
def test_lagrangians_that_are_not_quadratic(name):
    system = dx.LagrangeDirac(ODD[name])
    sol = dx.simulate(system, dx.Collocation(3), step=0.05, steps=400, events=[FLOOR], **DROP)
    assert sol.ok and len(sol.events) >= 3
    assert np.max(np.abs(sol.energy() - sol.energy()[0])) <= 1e-14 and np.ptp(sol.p[:, 0]) <= 1e-14


@pytest.mark.soak
def test_restitution_is_that_of_the_velocity():
    fast = dx.LagrangeDirac(ODD["relativistic"])
    loses = dx.simulate(fast, dx.Collocation(3), step=0.05, steps=100, events=[dx.Impact(lambda q: q[1], 0.7)], **DROP)
    velocity = lambda p: p[1] / np.sqrt(1 + p @ p)
    before = loses.at(loses.events.t[0] - 1e-9).p
    assert velocity(loses.events.p[0]) == pytest.approx(-0.7 * velocity(before), abs=1e-8)


def test_the_search_and_the_step_onto_the_wall_agree(monkeypatch):
    system, scheme, wall, given, *_ = LONG["ellipse"]
    run = lambda: dx.simulate(system, scheme, events=[wall], steps=250, **given)
    fast = run()
    monkeypatch.setattr(Flight, "_onto", lambda *_: False)
    slow = run()
    assert len(fast.events) >= 20  # the motion is chaotic
    assert np.max(np.abs(fast.events.t[:4] - slow.events.t[:4])) <= 1e-11


@pytest.mark.soak
def test_walls_that_are_far_away_are_not_searched_for(monkeypatch):
    searched, search = [], Flight._searched
    monkeypatch.setattr(Flight, "_searched", lambda *at: searched.append(at) or search(*at))
    pendulum = dx.LagrangeDirac(lambda q, v: v @ v / 2 - q[1], holonomic=lambda q: jnp.array([q @ q - 1.0]))
    start = {"q": [1e-3, -np.sqrt(1 - 1e-6)], "v": [0.0, 0.0], "step": 0.01, "steps": 100}  # 0.001 is known to 1e-16 of a length
    sol = dx.simulate(pendulum, dx.LagrangeDAlembert(), events=[dx.Impact(lambda q: q[0] + 0.1)], **start)
    assert sol.ok and not len(sol.events) and len(searched) <= 12


def test_a_wall_that_moves_gives_its_velocity():
    free = dx.LagrangeDirac(lambda q, v: v @ v / 2)
    piston = dx.Impact(lambda t, q, params: q[0] - params["u"] * t)
    sol = dx.simulate(free, dx.LagrangeDAlembert(), q=[0.5], v=[-1.0], step=0.05, steps=40, params={"u": 0.1}, events=[piston])
    assert sol.events.t == pytest.approx([0.5 / 1.1], abs=1e-14) and sol.p[-1] == pytest.approx([1.2], abs=1e-14)


def test_impacts_that_accumulate_end_the_run():
    wall = dx.Impact(lambda q: q[1], restitution=0.5)
    sol = dx.simulate(BALL, dx.LagrangeDAlembert(), step=0.05, steps=200, events=[wall], **DROP)
    assert not sol.ok and "accumulate at t = 4.24264 (Zeno)" in sol.message
    assert sol.events.t[-1] == pytest.approx(FALL * 3, abs=1e-8) and sol.t[-1] <= FALL * 3
    slow = sol.events.p[:5, 1]
    assert np.max(np.abs(slow - FALL * 0.5 ** np.arange(1, 6))) <= 1e-13
    dead = dx.simulate(BALL, dx.LagrangeDAlembert(), step=0.05, steps=200, events=[dx.Impact(lambda q: q[1], 0.0)], **DROP)
    assert not dead.ok and "Zeno" in dead.message and dead.t[-1] <= FALL


@pytest.mark.soak
def test_many_walls_at_one_moment_are_no_accumulation():
    balls = dx.LagrangeDirac(lambda q, v: v @ v / 2 - jnp.sum(q))
    walls = [dx.Impact(gap) for gap in (
        lambda q: q[0], lambda q: q[1], lambda q: q[2], lambda q: q[3], lambda q: q[4],
    )]  # fmt: skip
    sol = dx.simulate(balls, dx.LagrangeDAlembert(), q=[1.0] * 5, v=[0.0] * 5, step=0.1, steps=20, events=walls)
    assert sol.ok and len(sol.events) == 5


@pytest.mark.parametrize(("v", "step", "steps"), [((3.0, -3.0), 0.1, 100), ((-0.5 / 2.1, 0.5 / 2.1), 0.7, 40)])
@pytest.mark.soak_of("v0-0.1-100")
def test_a_corner_is_two_walls(v, step, steps):
    """It is hit at the end of a step, of which roundoff is left: too little to come off a wall that was passed by roundoff."""
    free = dx.LagrangeDirac(lambda q, v: v @ v / 2)
    box = [dx.Impact(lambda q: q[0]), dx.Impact(lambda q: 1 - q[0]), dx.Impact(lambda q: q[1]), dx.Impact(lambda q: 1 - q[1])]
    sol = dx.simulate(free, dx.LagrangeDAlembert(), q=[0.5, 0.5], v=v, step=step, steps=steps, events=box)
    exact = 1 - np.abs(np.mod(0.5 + np.outer(sol.t, v), 2) - 1)
    assert sol.ok and np.max(np.abs(sol.q - exact)) <= 1e-11


def test_what_was_run_before_an_interrupt_is_kept(monkeypatch):
    run = lambda **more: dx.simulate(BALL, dx.LagrangeDAlembert(), step=0.05, steps=400, events=[FLOOR], **DROP | more)
    whole, noted = run(), Flight._noted

    def interrupted(flight, *given):
        if len(flight.hits) == 3:
            raise KeyboardInterrupt
        return noted(flight, *given)

    monkeypatch.setattr(Flight, "_noted", interrupted)
    sol = run()
    assert not sol.ok and "interrupted by the user; kept up to step 197" in sol.message
    assert np.array_equal(sol.q, whole.q[:198]) and np.array_equal(sol.events.t, whole.events.t[:3])
    both = run(q=[[0.0, 1.0], [0.0, 2.0]], v=[[0.3, 0.0], [0.3, 0.0]])
    assert "step 0" in both.message[1] and np.array_equal(both.q[1, 0], [0.0, 2.0]) and np.all(np.isnan(both.q[1, 1:]))


def test_longer_runs_have_the_bits_of_one_run():
    run = lambda steps: dx.simulate(
        BALL, dx.LagrangeDAlembert(), step=0.05, steps=steps, save_every=7, events=[FLOOR, dx.Event(lambda q: q[0] - 1)], **DROP
    )
    longer, whole = run(60).extend(90), run(150)
    assert np.array_equal(longer.q, whole.q) and np.array_equal(longer.events.t, whole.events.t) and len(whole.events) == 4


def test_what_is_refused():
    run = lambda wall, scheme=None, **start: dx.simulate(
        BALL, scheme or dx.LagrangeDAlembert(), step=0.05, steps=20, events=[wall], **{**DROP, **start}
    )
    with pytest.raises(ValueError, match=r"must not be negative at the start, but it is -1"):
        run(FLOOR, q=[0.0, -1.0])
    with pytest.raises(ValueError, match="at the start of trajectory 1"):
        run(FLOOR, q=[[0.0, 1.0], [0.0, -1.0]])
    with pytest.raises(ValueError, match="one number"):
        run(dx.Impact(lambda q: q))
    with pytest.raises(TypeError, match="with a composition"):
        run(FLOOR, dx.Composition(dx.LagrangeDAlembert(), "suzuki4"))
    with pytest.raises(TypeError, match=r"this is PortHamiltonian with a state of x\."):
        system = dx.PortHamiltonian(lambda x: x @ x / 2, J=np.array([[0.0, 1.0], [-1.0, 0.0]]))
        dx.simulate(system, dx.DiscreteDirac(), x=[1.0, 0.0], step=0.05, steps=20, events=[FLOOR])
    with pytest.raises(ValueError, match="from 0 to 1"):
        dx.Impact(lambda q: q[0], restitution=1.5)
    assert (
        "the restitution from 0 to 1" in run(dx.Impact(lambda q: q[1], restitution=lambda t: 1.5 + 0 * t), v=[0.3, -2.0]).message
    )
    with pytest.raises(TypeError, match="it takes v"):
        dx.Impact(lambda q, v: q[0])
    with pytest.raises(ValueError, match=r"under jax\.grad"):
        run_both = {"step": 0.05, "steps": 20, "events": [FLOOR, dx.Event(lambda q: q[0])]}
        jax.grad(lambda x: dx.simulate(BALL, dx.LagrangeDAlembert(), q=[0.0, x], v=[0.3, 0.0], **run_both).q[-1, 1])(1.0)


WALL = 0.3


@pytest.mark.parametrize(
    ("forces", "gap", "restitution"),
    [
        (lambda t, q, v: -0.1 * v, lambda q: WALL - q[0], 1.0),
        (None, lambda q: WALL - q[0], 0.9),
        (None, lambda t, q: WALL + 0.1 * jnp.sin(3 * t) - q[0], 1.0),
    ],
    ids=["forces", "a wall that takes energy", "a wall that moves"],
)
@pytest.mark.soak
def test_what_impacts_do_to_energy_and_multipliers_is_no_violation(forces, gap, restitution):
    rod = dx.LagrangeDirac(lambda q, v: v @ v / 2 - q[1], holonomic=lambda q: jnp.array([q @ q - 1.0]), forces=forces)
    sol = dx.simulate(
        rod, dx.LagrangeDAlembert(), q=[0.0, -1.0], v=[1.0, 0.0], step=0.02, steps=100, events=[dx.Impact(gap, restitution)]
    )
    assert len(sol.events) and dx.verify(sol).ok
    q = np.asarray(sol.q).copy()
    q[:, 0] += 1e-9
    assert not dx.verify(sol.replace(fields=sol.fields | {"q": q})).ok


@pytest.mark.parametrize("save_every", [1, 5])
@pytest.mark.soak_of("1")
def test_all_flights_are_replayed_but_for_the_steps_that_walls_divide(save_every):
    wall = dx.Impact(lambda q: q[1], restitution=0.8)
    start = {"q": [[0.0, 1.0], [0.0, 2.0]], "v": [[0.3, 0.0], [0.3, 0.0]], "step": 0.05, "steps": 100}
    sol = dx.simulate(BALL, dx.LagrangeDAlembert(), save_every=save_every, events=[wall], **start)
    replayed = lambda sol: dx.verify(sol)["steps replayed"]
    assert len(sol.events) == 3 and replayed(sol).verdict == "ok"
    last = np.array(sol.p)
    last[0, -2] += 1e-9  # the longest flight is another one
    assert replayed(sol.replace(fields=sol.fields | {"p": last})).verdict == "VIOLATED"


def test_verify_sees_an_energy_that_a_wall_at_rest_has_changed():
    sol = dx.simulate(BALL, dx.LagrangeDAlembert(), step=0.05, steps=80, events=[FLOOR], **DROP)
    after = sol.t > sol.events.t[0]
    p = np.asarray(sol.p) + np.outer(after, [0.1, 0.0])
    assert dx.verify(sol.replace(fields=sol.fields | {"p": p}))["energy"].verdict == "VIOLATED"


@pytest.mark.parametrize("row", [0, 1])
@pytest.mark.parametrize("name", ["q", "p", "work"])
@pytest.mark.soak_of("q-0")
def test_the_rows_beside_a_wall_are_looked_at_too(row, name):
    """The one before ends a step of the scheme, and from the one after another begins."""
    driven = dx.LagrangeDirac(
        lambda q, v: v @ v / 2 - q[1] - q[0] ** 4, forces=lambda t, q, v: jnp.stack([jnp.sin(t), -0.1 * v[1]])
    )
    wall = dx.Impact(lambda q: q[1], restitution=0.9)
    sol = dx.simulate(driven, dx.LagrangeDAlembert(), q=[0.5, 0.3], v=[0.1, 0.0], step=0.02, steps=120, events=[wall])
    assert len(sol.events) >= 2 and dx.verify(sol)["steps replayed"].verdict == "ok"
    values = np.array(sol.fields[name])
    values[int(np.searchsorted(sol.t, sol.events.t[0])) - 1 + row] += 1e-6
    assert dx.verify(sol.replace(fields=sol.fields | {name: values}))["steps replayed"].verdict == "VIOLATED"


def test_walls_that_close_in_on_a_motion_end_it():
    """After half a million impacts, and as a motion on one of the walls."""
    free, walls = dx.LagrangeDirac(lambda q, v: v @ v / 2), [dx.Impact(lambda t, q: q[0] - 0.2 * t)]
    walls.append(dx.Impact(lambda t, q: 1.0 - 0.2 * t - q[0]))
    sol = dx.simulate(free, dx.LagrangeDAlembert(), q=[0.5], v=[1.0], step=0.05, steps=60, events=walls)
    assert not sol.ok and "walls close in on the motion" in sol.message and 2.4 < sol.t[-1] < 2.5


@pytest.mark.parametrize("scheme", [dx.LagrangeDAlembert(), dx.Collocation(2)], ids=lambda s: type(s).__name__)
@pytest.mark.soak_of("LagrangeDAlembert")
def test_thin_pegs_are_hit_wherever_they_are_in_a_step(scheme):
    """A free particle and round pegs of a tenth of a step across, at the row and on it too: four of forty were passed through."""
    free, centres = dx.LagrangeDirac(lambda q, v, c: v @ v / 2 + 0.0 * c), np.append(2.0 + 0.8 * np.arange(32) / 32, [2.02, 2.42])
    peg = dx.Impact(lambda q, params: (q[0] - params) ** 2 + q[1] ** 2 - 0.02**2)
    given = {"q": np.zeros((34, 2)), "v": np.tile([1.0, 1e-9], (34, 1)), "params": centres, "batch_params": True}
    sol = dx.simulate(free, scheme, **given, step=0.4, steps=8, events=[peg])
    assert np.array_equal(sol.events.lane, np.arange(34))
    np.testing.assert_allclose(sol.events.t, centres - 0.02, rtol=0, atol=1e-12)


@pytest.mark.soak
def test_a_thin_peg_is_hit_after_a_wall_in_the_same_step():
    free, wall = dx.LagrangeDirac(lambda q, v, c: v @ v / 2 + 0.0 * c[0]), dx.Impact(lambda q: 1.1 - q[0] - 0.2 * q[1])
    normal = np.array([1.0, 0.2]) / np.hypot(1.0, 0.2)
    back = np.array([1.0, 0.0]) - 2 * normal[0] * normal
    distances = np.array([0.12, 0.2, 0.28, 0.42, 0.61])
    places = np.array([1.1, 0.0]) + distances[:, None] * back
    peg = dx.Impact(lambda q, params: (q[0] - params[0]) ** 2 + (q[1] - params[1]) ** 2 - 0.02**2)
    given = {"q": np.zeros((5, 2)), "v": np.tile([1.0, 0.0], (5, 1)), "params": places, "batch_params": True}
    sol = dx.simulate(free, dx.LagrangeDAlembert(), **given, step=0.4, steps=8, events=[wall, peg])
    second = [sol.events.t[(sol.events.lane == lane) & (sol.events.index == 1)][0] for lane in range(5)]
    np.testing.assert_allclose(second, 1.1 + distances - 0.02, rtol=0, atol=1e-12)


def test_an_exact_corner_is_the_limit_of_near_ones():
    """Seven reflections at one moment were called Zeno, with a restitution of 1 too."""
    metric = np.array([[1.0, 0.9], [0.9, 1.0]])
    system, walls = dx.LagrangeDirac(lambda q, v: v @ metric @ v / 2), [dx.Impact(lambda q: q[0]), dx.Impact(lambda q: q[1])]
    run = lambda off: dx.simulate(
        system, dx.LagrangeDAlembert(), q=[1.0, 1.0 + off], v=[-1.0, -1.0], step=0.3, steps=8, events=walls
    )
    exact, near = run(0.0), run(1e-8)
    assert exact.ok and len(exact.events) == len(near.events) == 7
    np.testing.assert_allclose(exact.p[-1], near.p[-1], rtol=1e-7)
    np.testing.assert_allclose(exact.energy()[-1], exact.energy()[0], rtol=1e-13)


@pytest.mark.parametrize(
    "scheme", [dx.LagrangeDAlembert(), dx.DiscreteDirac(), dx.VariableSteps(dx.LagrangeDAlembert(), lambda q: 1.0 + 0.0 * q[0])]
)
def test_the_step_that_ends_at_an_impact_is_known_inside(scheme):
    """A ball let go from (k h)²/2 hits the floor at row k, which has the momentum after the impact."""
    ball = dx.LagrangeDirac(lambda q, v: v @ v / 2 - q[0])
    events = [dx.Impact(lambda q: q[0]), dx.Event(lambda v: v[0])]
    sol = dx.simulate(ball, scheme, q=[1.125], v=[0.0], step=0.05, steps=40, events=events)
    t = np.linspace(1.451, 1.549, 12)
    after = np.maximum(t - 1.5, 0.0)
    before = np.minimum(t, 1.5)
    there = sol.at(t)
    np.testing.assert_allclose(there.q[:, 0], 1.125 - before**2 / 2 + 1.5 * after - after**2 / 2, atol=1e-13)
    np.testing.assert_allclose(there.p[:, 0], np.where(t < 1.5, -t, 1.5 - after), atol=1e-13)
    np.testing.assert_allclose(sol.events.t[sol.events.index == 1], 1.5, atol=1e-12)
    assert dx.verify(sol).ok


@pytest.mark.parametrize("k", [5, 16])
def test_an_impact_at_a_row_is_in_no_flight(k):
    ball = dx.LagrangeDirac(lambda q, v: v @ v / 2 - q[1])
    run = {"q": [0.0, (k * 0.05) ** 2 / 2], "v": [0.3, 0.0], "step": 0.05, "steps": 70, "events": [dx.Impact(lambda q: q[1])]}
    report = dx.verify(dx.simulate(ball, dx.DiscreteDirac(), **run))
    assert report.ok and report["discretization-map Dirac structure"].value < 1e-14
