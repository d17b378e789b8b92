"""Several schemes in one table: each number against what is known of the scheme."""

import jax.numpy as jnp
import numpy as np
import pytest

import dirax as dx
from dirax import gallery


def check_work_and_precision(found):
    """A curve a scheme, of the errors over the time of their runs, the compared step marked."""
    ax = found.plot()
    assert (ax.get_xscale(), ax.get_yscale(), ax.get_xlabel()) == ("log", "log", "time of the run (µs)")
    for k, entry in enumerate(found.entries):
        curve, mark = ax.lines[2 * k : 2 * k + 2]
        work, errors = curve.get_data()
        assert curve.get_label() == entry.scheme and list(errors) == [error for _, error in entry.precision]
        assert work == pytest.approx([64 * 2**i * entry.microseconds_per_step for i in range(4)])
        assert mark.get_data()[1] == [entry.error] == [errors[0]]


def test_the_disk_by_three_schemes():
    disk = gallery.get("rolling-disk")
    schemes = {"plus": dx.PlusLagrangeDirac(), "minus": dx.MinusLagrangeDirac(), "midpoint": dx.LagrangeDAlembert()}
    found = dx.compare(disk.system, schemes, step=0.01, steps=4000, repeats=1, params=disk.params, **disk.initial)
    assert [found[name].order for name in schemes] == pytest.approx([1, 1, 2], abs=0.05)
    assert [found[name].drift for name in schemes] == ["drifts", "drifts", "bounded"]
    assert found["plus"].slope > 0 > found["minus"].slope
    assert found["midpoint"].error < found["plus"].error / 50
    assert all(entry.constraint < 1e-13 and entry.microseconds_per_step > 0 for entry in found.entries)
    text = str(found)
    assert "midpoint" in text and "µs/step" in text and "<table" in found._repr_html_()
    assert found.to_dict()["schemes"][2]["scheme"] == "midpoint"
    check_work_and_precision(found)


def test_a_list_is_named_by_class_and_failures_have_a_row():
    falling = dx.LagrangeDirac(lambda q, v: v @ v / 2 + jnp.sqrt(q[0]) - 2 * q[0])
    schemes = [dx.PlusLagrangeDirac(), dx.PlusLagrangeDirac("right")]
    found = dx.compare(falling, schemes, step=0.01, steps=100, repeats=1, q=[0.1], v=[-1.0])
    assert [entry.scheme for entry in found.entries] == ["PlusLagrangeDirac", "PlusLagrangeDirac 2"]
    assert found["PlusLagrangeDirac"].ended.startswith("stopped at t = 0.1")
    with pytest.raises(KeyError, match="there are"):
        found["minus"]
    with pytest.raises(ValueError, match="at least one scheme"):
        dx.compare(falling, {}, step=0.01, steps=100, q=[0.1], v=[-1.0])


def test_what_cannot_be_compared_is_said():
    system, start = dx.LagrangeDirac(lambda q, v: v @ v / 2 - q @ q), {"q": [[1.0], [2.0]], "v": [[0.0], [0.0]]}
    schemes = {"midpoint": dx.LagrangeDAlembert()}
    with pytest.raises(ValueError, match=r"one trajectory, but a batch of 2 was given"):
        dx.compare(system, schemes, step=0.1, steps=8, **start)
    one = {"q": [1.0], "v": [0.0]}
    rows = dx.compare(system, schemes, step=0.1, steps=40, save_every=10, **one)["midpoint"]
    assert rows.order == pytest.approx(2.0, abs=0.02) and rows.ended == "ok"
    with pytest.raises(ValueError, match=r"rows where they meet: leave out save_every\."):
        dx.convergence(system, dx.LagrangeDAlembert(), step_sizes=[0.1, 0.05, 0.025], time=1.0, save_every=2, **one)
    with pytest.raises(ValueError, match=r"dx\.convergence compares steps that are given"):
        dx.convergence(system, dx.LagrangeDAlembert(), step_sizes=[0.1, 0.05, 0.025], time=1.0, tolerance=1e-3, **one)


@pytest.mark.parametrize("measure", ["compare", "convergence"])
def test_ctrl_c_in_one_run_ends_the_measurement(measure):
    def interrupt(done, total):
        raise KeyboardInterrupt

    kepler = gallery.get("kepler")
    run = {"params": kepler.params, "progress": interrupt, **kepler.initial}
    with pytest.raises(KeyboardInterrupt):
        if measure == "compare":
            dx.compare(kepler.system, [dx.LagrangeDAlembert()], step=0.05, steps=200_000, **run)
        else:
            dx.convergence(kepler.system, dx.LagrangeDAlembert(), step_sizes=[0.05, 0.025, 0.0125], time=2000.0, **run)


def test_the_energy_of_open_systems_is_less_what_came_in_where_books_are_kept():
    system = dx.PortHamiltonian(lambda x: x @ x / 2 + x[0] ** 4, [[0.0, 1.0], [-1.0, 0.0]], [[0.0], [1.0]], np.diag([0.0, 0.1]))
    run = {"x": [1.0, 0.0], "inputs": lambda t, x: 5 * jnp.sin(1.3 * t)[None], "step": 0.05, "steps": 100}
    (entry,) = dx.compare(system, dx.DiscreteGradient(), **run).entries
    assert entry.scheme == "DiscreteGradient" and entry.energy_band < 1e-11
