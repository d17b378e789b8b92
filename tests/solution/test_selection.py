"""Parts of a solution: trajectories of a batch, rows, stretches of time."""

import jax.numpy as jnp
import numpy as np
import pytest

import dirax as dx

SPRING = dx.LagrangeDirac(lambda q, v, params: (v @ v - params["k"] * (q @ q)) / 2)
SCHEME = dx.LagrangeDAlembert("midpoint")
START = {"q": [[1.0, 0.0], [0.0, 1.0], [2.0, 0.0]], "v": [[0.0, 1.0], [1.0, 1.0], [0.0, 0.0]]}


@pytest.fixture(scope="module")
def batch():
    params = {"k": np.array([1.0, 2.0, 3.0])}
    sol = dx.simulate(SPRING, SCHEME, **START, params=params, batch_params=True, step=0.1, steps=12)
    sol.energy()
    return sol


@pytest.fixture(scope="module")
def one():
    return dx.simulate(SPRING, SCHEME, q=[1.0], v=[0.0], params={"k": 1.0}, step=0.1, steps=20)


def test_a_trajectory_of_a_batch_is_that_of_a_single_run(batch):
    alone = dx.simulate(SPRING, SCHEME, q=START["q"][1], v=START["v"][1], params={"k": 2.0}, step=0.1, steps=12)
    part = batch[1]
    assert type(part) is dx.Solution and part.batch is None and part.rows == 13 and not part.batch_params
    for name in alone.fields:
        np.testing.assert_array_equal(part.fields[name], alone.fields[name])
    assert part.params["k"] == 2.0 and part.ok is True and part.message == ""
    np.testing.assert_array_equal(part.initial["q"], START["q"][1])
    np.testing.assert_array_equal(part.derived["energy"], batch.energy()[1])
    assert len(batch) == 3 and [float(sol.params["k"]) for sol in batch] == [1.0, 2.0, 3.0]
    np.testing.assert_array_equal(batch[-1].q, batch.q[2])
    for name in ("newton_iterations", "max_residual"):
        assert part.stats[name] == alone.stats[name]
        each = [sol.stats[name] for sol in batch[1:]]
        assert batch[1:].stats[name] == (sum(each) if name == "newton_iterations" else max(each))


def test_a_file_holds_the_iterations_of_the_whole_batch(batch, tmp_path):
    loaded = dx.load(batch.save(tmp_path / "run.nc"))
    assert loaded.stats["newton_iterations"] == batch.stats["newton_iterations"]
    assert "newton_iterations" not in loaded[1].stats and loaded[1].stats["engine"] == "native"


def test_several_trajectories_stay_a_batch(batch):
    for part in (batch[1:], batch[[1, 2]], batch[np.array([False, True, True])]):
        assert part.batch == len(part) == 2
        np.testing.assert_array_equal(part.q, batch.q[1:])
        np.testing.assert_array_equal(part.params["k"], [2.0, 3.0])
    np.testing.assert_array_equal(batch[batch.ok].p, batch.p)
    with pytest.raises(IndexError, match="the numbers 0 to 2, but 3 was asked for"):
        batch[3]


@pytest.mark.parametrize("which", ["q", (0, 1), True, [0.5], [True, False], None])
def test_what_names_no_trajectories_is_refused(batch, which):
    with pytest.raises(TypeError, match="one truth value for each of the 3 trajectories"):
        batch[which]


def test_a_failed_trajectory_ends_at_its_last_good_row():
    falling = dx.LagrangeDirac(lambda q, v: v @ v / 2 - jnp.log(q[0]))
    start = {"q": [[1.0], [1.0]], "v": [[9.0], [0.0]], "step": 0.1, "steps": 40}
    sol = dx.simulate(falling, dx.PlusLagrangeDirac(), **start)
    assert sol.ok.tolist() == [True, False]
    alone = dx.simulate(falling, dx.PlusLagrangeDirac(), q=[1.0], v=[0.0], step=0.1, steps=40)
    np.testing.assert_array_equal(sol[1].q, alone.q)
    assert sol[1].ok is False and sol[1].message == sol.message[1] and sol[0].rows == 41


def test_a_stretch_of_time_has_both_ends(one, batch):
    part = one[0.5:1.2]
    np.testing.assert_array_equal(part.t, one.t[5:13])  # .1·12 is 1.2000000000000002
    np.testing.assert_array_equal(part.q, one.q[5:13])
    np.testing.assert_array_equal(part.initial["q"], one.q[5])
    np.testing.assert_array_equal(part.energy(), one.energy()[5:13])
    assert len(part) == part.rows == 8 and one[:0.95].rows == 10 and one[1.95:].rows == 1
    assert one[0:1.0].rows == 11  # one float makes both bounds times
    assert batch[0.3:0.6].q.shape == (3, 4, 2) and batch[0.3:0.6].derived["energy"].shape == (3, 4)
    np.testing.assert_array_equal(one[:1.0].initial["q"], one.initial["q"])


def test_step_fields_keep_the_steps_between_the_rows():
    rod = dx.LagrangeDirac(lambda q, v: v @ v / 2 - q[1], holonomic=lambda q: jnp.array([q @ q - 1]))
    sol = dx.simulate(rod, SCHEME, q=[0.0, -1.0], v=[1.0, 0.0], step=0.1, steps=10)
    part = sol[2:6]
    assert part.rows == 4 and part.multipliers.shape == (3, 1)
    np.testing.assert_array_equal(part.multipliers, sol.multipliers[2:5])
    np.testing.assert_array_equal(part.constraint_residual(), sol.constraint_residual()[2:5])
    again = dx.simulate(rod, SCHEME, **part.initial, step=0.1, steps=3)
    np.testing.assert_allclose(again.q, part.q, atol=1e-12)  # the part says where it starts


@pytest.mark.parametrize(
    "which, error, words",
    [
        (3, TypeError, "a row"),
        ("q", TypeError, "one trajectory"),
        (slice("a", None), TypeError, "two floats"),
        (slice(0.0, 1.0, 2), TypeError, "no stride"),
        (slice(None, None, 2), TypeError, "without a stride"),
        (slice(5.0, 6.0), ValueError, "no saved time"),
        (slice(9, 3), ValueError, "no row"),
    ],
)
def test_what_is_no_part_is_explained(which, error, words, one):
    with pytest.raises(error, match=words):
        one[which]


def test_one_trajectory_is_not_gone_through(one):
    with pytest.raises(TypeError, match="not a batch"):
        list(one)
    assert one and len(one) == 21


def test_parts_go_into_files(batch, tmp_path):
    part = batch[1][0.2:0.8]
    loaded = dx.load(part.save(tmp_path / "part.nc"))
    np.testing.assert_array_equal(loaded.q, batch.q[1, 2:9])
    assert repr(loaded.scheme) == repr(SCHEME)
