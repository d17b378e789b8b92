"""What `verify` says of runs with walls: every row and impact of the run once more."""

import numpy as np
import pytest

import dirax as dx
from dirax.diagnostics import flights
from dirax.diagnostics.flights import run_again

BALL = dx.LagrangeDirac(lambda q, v: v @ v / 2 - q[1])
BOX = [dx.Impact(lambda q: q[1], restitution=0.9), dx.Impact(lambda q: 0.5 - q[0]), dx.Impact(lambda q, t: q[0] + 0.5 + 0.1 * t)]
ROOM = {"q": [0.0, 1.0], "v": [0.7, 0.0], "events": BOX}
LINE = "run once more"


def changed(sol, name, place, by):
    """The solution with a number of a field, or of all of its impacts, that is another one."""
    other = sol.replace(fields=dict(sol.fields))
    other.impacts, other.events, other.again = sol.impacts[:], sol.events, sol.again
    held = other.impacts.fields if place is None else other.fields
    if name == "t":
        other.impacts.t = other.impacts.t + by
    else:
        held[name] = np.array(held[name])
        held[name][place] += by
    return other


@pytest.fixture(scope="module")
def sol():
    return dx.simulate(BALL, dx.LagrangeDAlembert(), step=0.05, steps=120, **ROOM)


@pytest.mark.soak
def test_the_run_once_more_has_the_same_bits(sol):
    assert len(sol.impacts) >= 5
    again = run_again(sol)
    assert again.quantity == LINE and again.value == 0.0 and run_again(sol.extend(20)).value == 0.0
    batch = dx.simulate(BALL, dx.Collocation(2), step=0.05, steps=121, save_every=3, **ROOM | {"q": [[0.0, 1.0], [0.1, 1.3]]})
    report = dx.verify(batch)
    assert report[LINE].value == 0.0 and report.ok


def test_what_was_changed_is_found_beside_walls_and_at_impacts(sol):
    row = int(sol.impacts.t[2] / 0.05)
    for name, place in [("q", (row, 0)), ("p", (row + 1, 1)), ("q", (-1, 1)), ("q", (0, 0)), ("t", None), ("p", None)]:
        line = dx.verify(changed(sol, name, place, 1e-8))[LINE]
        assert line.verdict == "VIOLATED" and line.explanation, (name, place)
    assert f"q at t = {0.05 * row:.6g}" in dx.verify(changed(sol, "q", (row, 0), 1e-8))[LINE].explanation
    lost = sol.replace()
    lost.again, lost.impacts, lost.events = sol.again, sol.impacts[1:], sol.events
    assert dx.verify(lost)[LINE].verdict == "VIOLATED"


def test_impacts_are_those_that_a_user_is_given(sol):
    other = changed(sol, "q", (0, 0), 0.0)
    other.events = sol.events[:]
    other.events.t = other.events.t + 1e-6
    assert dx.verify(other)[LINE].verdict == "VIOLATED"


def test_a_trajectory_that_an_event_ends_has_no_impacts_after_it():
    apart = [dx.Impact(lambda q: q[1]), dx.Event(lambda q: q[0] - 0.6, terminal=True)]
    batch = {"q": [[0.0, 1.0], [0.0, 1.0]], "v": [[0.1, 0.0], [1.0, 0.0]], "step": 0.05, "steps": 60}
    assert dx.verify(dx.simulate(BALL, dx.LagrangeDAlembert(), events=apart, **batch))[LINE].value == 0.0


@pytest.mark.parametrize("step, steps", [(1.1, 10), (0.5, 1)])
@pytest.mark.soak_of("1.1-10")
def test_walls_may_divide_every_step(step, steps):
    """It raised NumPy's ValueError."""
    free = dx.LagrangeDirac(lambda q, v: v @ v / 2)
    tube = [dx.Impact(lambda q: q[0]), dx.Impact(lambda q: 1.0 - q[0])]
    for scheme in (dx.LagrangeDAlembert(), dx.Collocation(2)):
        report = dx.verify(dx.simulate(free, scheme, q=[0.5], v=[1.3], step=step, steps=steps, events=tube))
        assert report.ok and report[LINE].verdict == "ok" and "walls divide every" in report["steps replayed"].explanation


def test_a_whole_motion_after_a_wall_that_is_another_one_is_found(sol):
    """Every step of it is one of the scheme, but the wall gave it all of its energy back."""
    other = dx.simulate(
        BALL, dx.LagrangeDAlembert(), step=0.05, steps=120, **ROOM | {"events": [dx.Impact(BOX[0].function), *BOX[1:]]}
    )
    other.again = sol.again
    report = dx.verify(other)
    assert report["steps replayed"].verdict == "ok" and report[LINE].verdict == "VIOLATED"


def test_roundoff_of_another_machine_is_none(sol):
    line = dx.verify(changed(sol, "q", (40, 0), 1e-15))[LINE]
    assert line.verdict == "ok" and "roundoff" in line.explanation


def test_of_a_long_run_the_first_part_is_run_once_more(sol, monkeypatch):
    monkeypatch.setattr(flights, "LONGEST", sol.stats["run_seconds"] / 2.0)
    line = dx.verify(sol)[LINE]
    assert line.value == 0.0 and "up to t = 2.95" in line.explanation
    assert dx.verify(changed(sol, "q", (30, 0), 1e-8))[LINE].verdict == "VIOLATED"


def test_parts_of_a_run_do_not_know_its_walls(sol):
    assert dx.verify(sol[:60])[LINE].verdict == "not checked" and dx.verify(sol[:60]).ok
