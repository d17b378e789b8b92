"""Tables: one row a time, one column a component, exact numbers."""

import csv

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dirax as dx

SKATE = dx.LagrangeDirac(lambda q, v: v @ v / 2, lambda q: jnp.array([[jnp.sin(q[2]), -jnp.cos(q[2]), 0.0]]))
START = {"q": np.zeros((2, 3)), "v": [[0.5, 0.0, 1.0], [-1.0, 0.0, 0.3]]}


@pytest.fixture(scope="module")
def batch():
    return dx.simulate(SKATE, dx.PlusLagrangeDirac(), **START, step=0.1, steps=4)


def test_one_row_a_time_and_one_column_a_component(batch):
    table = batch.to_dataframe()
    assert list(table) == [
        *("trajectory", "t", "q0", "q1", "q2", "p0", "p1", "p2", "multipliers0", "constraint_residual0", "energy"),
    ]
    assert table.trajectory.tolist() == [0] * 5 + [1] * 5
    np.testing.assert_array_equal(table.t, np.tile(batch.t, 2))
    np.testing.assert_array_equal(table[["p0", "p1", "p2"]], np.asarray(batch.p).reshape(10, 3))
    np.testing.assert_array_equal(table.energy, batch.energy().ravel())
    np.testing.assert_array_equal(table.multipliers0[5:9], batch.multipliers[1, :, 0])
    assert np.isnan(table.multipliers0[[4, 9]]).all() and table.multipliers0.isna().sum() == 2
    one = batch[1].to_dataframe()
    assert "trajectory" not in one and len(one) == 5
    np.testing.assert_array_equal(one.q2, batch.q[1, :, 2])


def test_coordinates_give_the_names(batch):
    named = batch.to_dataframe(coordinates=["x", "y", "φ"])
    assert list(named)[2:8] == ["x", "y", "φ", "p_x", "p_y", "p_φ"]
    batch.metadata["coordinates"] = ["a", "b", "c"]
    try:
        assert list(batch.to_dataframe())[2:5] == ["a", "b", "c"]
    finally:
        del batch.metadata["coordinates"]
    with pytest.raises(ValueError, match="names 'x' twice"):
        batch.to_dataframe(coordinates=["x", "x", "y"])
    with pytest.raises(ValueError, match="two columns would be called 'energy'"):
        batch.to_dataframe(coordinates=["x", "y", "energy"])
    with pytest.raises(ValueError, match="one name for each of 3"):
        batch.to_dataframe(coordinates=["x"])


def test_csv_files_hold_every_digit(batch, tmp_path):
    path = batch.to_csv(tmp_path / "run.csv", coordinates=["x", "y", "φ"])
    with open(path, encoding="utf-8", newline="") as file:
        header, *rows = csv.reader(file)
    table = batch.to_dataframe(coordinates=["x", "y", "φ"])
    assert header == list(table) and len(rows) == 10
    read = np.array([[float(cell or "nan") for cell in row] for row in rows])
    np.testing.assert_array_equal(read, table.to_numpy(float))
    assert rows[4][header.index("multipliers0")] == ""
    with pytest.raises(FileExistsError, match="overwrite=True"):
        batch.to_csv(path)
    batch[0].to_csv(path, overwrite=True)
    assert len(path.read_text("utf-8").splitlines()) == 6 and [p.name for p in tmp_path.iterdir()] == ["run.csv"]


def test_long_tables_are_written_in_blocks(batch, tmp_path, monkeypatch):
    from dirax.solution import export

    whole = batch.to_csv(tmp_path / "whole.csv").read_bytes()
    monkeypatch.setattr(export, "BLOCK", 3)
    assert batch.to_csv(tmp_path / "blocks.csv").read_bytes() == whole


def test_scalars_and_matrices(tmp_path):
    info = {"x": dx.Field((2,)), "work": dx.Field(()), "matrix": dx.Field((2, 2), dims=("a", "b"))}
    fields = {"x": np.zeros((3, 2)), "work": np.arange(3.0), "matrix": np.arange(12.0).reshape(3, 2, 2)}
    sol = dx.Solution(t=np.arange(3.0), fields=fields, field_info=info, step=1.0, save_every=1, stats={})
    table = sol.to_dataframe()
    assert list(table) == ["t", "x0", "x1", "work", "matrix0_0", "matrix0_1", "matrix1_0", "matrix1_1"]
    assert table.matrix1_0.tolist() == [2.0, 6.0, 10.0]


def test_traced_solutions_have_no_table():
    def run(q):
        sol = dx.simulate(SKATE, dx.PlusLagrangeDirac(), q=q, v=jnp.zeros(3), step=0.1, steps=2)
        with pytest.raises(ValueError, match="traced values"):
            sol.to_dataframe()
        return sol.q[-1, 0]

    jax.eval_shape(run, jnp.zeros(3))


def test_what_is_no_path_no_units_and_no_solution_is_named(tmp_path):
    sol = dx.simulate(
        dx.LagrangeDirac(lambda q, v: v @ v / 2), dx.LagrangeDAlembert(), q=[1.0, 0.0], v=[0.0, 1.0], step=0.1, steps=2
    )
    for call in (sol.report, sol.animate, sol.to_csv):
        with pytest.raises(TypeError, match=r'path must be a text or a pathlib.Path such as "run\..*", but 3 was given'):
            call(3)
    for call in (sol.to_xarray, lambda **more: sol.save(tmp_path / "run.nc", **more)):
        with pytest.raises(TypeError, match=r"units must be a dict by the names of fields"):
            call(units="m")
    with pytest.raises(TypeError, match=r"solution must be a dirax Solution .*, but 3 was given"):
        dx.reconstruct(3)
    for nothing, said in (([], r"\[\]"), ([3], "3 in it")):
        with pytest.raises(TypeError, match=f"or a list of them, but got {said}"):
            dx.report(nothing, tmp_path / "run.html")
