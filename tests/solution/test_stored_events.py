"""Events and impacts in files: what comes out is what went in, and what is made of it."""

import numpy as np
import pytest

import dirax as dx
from dirax.solution.stored_events import shapes_in

BALL = dx.LagrangeDirac(lambda q, v: v @ v / 2 - q[1])
WATCHED = [dx.Impact(lambda q: q[1]), dx.Event(lambda q: q[0] - 1.0)]


@pytest.mark.parametrize("ending", [".zarr", ".nc"])
@pytest.mark.parametrize("q", [[0.0, 1.0], [[0.0, 1.0], [0.0, 2.0]], [0.0, 1000.0]])
@pytest.mark.soak_of("q0-.zarr", "q0-.nc", "q1-.nc")
def test_round_trip(tmp_path, ending, q):
    sol = dx.simulate(BALL, dx.LagrangeDAlembert(), q=q, v=[0.3, 0.0], step=0.05, steps=90, events=WATCHED)
    sol.save(tmp_path / f"run{ending}")
    loaded = dx.load(tmp_path / f"run{ending}", system=BALL)
    for kind in ("events", "impacts"):
        before, after = getattr(sol, kind), getattr(loaded, kind)
        assert len(before) == len(after) and list(before.fields) == list(after.fields)
        for name in ("t", "index", "direction", "lane", *before.fields):
            assert np.array_equal(getattr(before, name), getattr(after, name)) and getattr(after, name).dtype.kind in "fi"
    assert np.array_equal(loaded.at(1.45).q, sol.at(1.45).q)  # inside a step that the floor divides
    assert [line.quantity for line in dx.verify(loaded).lines] == [line.quantity for line in dx.verify(sol).lines]
    assert dict(sol.to_xarray().sizes).get("events", 0) == len(sol.events)


def test_runs_without_events_say_nothing_of_them(tmp_path):
    sol = dx.simulate(BALL, dx.LagrangeDAlembert(), q=[0.0, 1.0], v=[0.3, 0.0], step=0.05, steps=3)
    sol.save(tmp_path / "run.zarr")
    assert dx.load(tmp_path / "run.zarr").events is None and "events" not in sol.to_xarray().attrs


@pytest.mark.parametrize(
    "said", [{"others": {"count": 1, "fields": {}}}, {"events": {}}, {"events": {"count": -1, "fields": {}}}]
)
def test_records_of_another_form(said):
    with pytest.raises(ValueError, match="unknown form"):
        shapes_in(said)
