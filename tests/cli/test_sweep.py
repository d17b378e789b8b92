"""`dirax sweep`, as a user types it."""

import json

import pytest
from typer.testing import CliRunner

import dirax as dx
from dirax.cli.commands import app

STUDY = """
import numpy as np
import dirax as dx

system = dx.LagrangeDirac(lambda q, v, params: v @ v / 2 - params["k"] * (q @ q) / 2)
over = {"k": np.linspace(1.0, 4.0, 5), "start": np.linspace(0.0, 1.0, 4)}
step, steps, save_every = 0.05, 40, 10


def case(k, start):
    return {"q": [start], "v": [0.0], "params": {"k": k}}
"""


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "study.py"
    path.write_text(STUDY, encoding="utf-8")
    return path


def call(*arguments):
    return CliRunner().invoke(app, ["sweep", *map(str, arguments)])


def test_a_file_is_swept_and_its_status_shown(file, tmp_path):
    path = tmp_path / "study.zarr"
    first = call(file, "--to", path, "--json")
    assert first.exit_code == 0, first.stderr
    found = json.loads(first.stdout)
    assert found["points"] == found["ok"] == 20 and found["not run"] == 0 and found["axes"] == {"k": 5, "start": 4}
    assert dx.load(path).q.dims == ("k", "start", "time", "coordinate")
    removed = next(path.glob("status/c.*"))
    removed.unlink()
    left = json.loads(call("--status", path, "--json").stdout)["not run"]
    assert left > 0
    again = call(file, "--to", path)
    assert again.exit_code == 0 and "not run    0" in again.stdout


def test_mistakes_are_one_sentence(file, tmp_path):
    (tmp_path / "no_case.py").write_text(STUDY.replace("def case", "def other"), encoding="utf-8")
    for arguments, text in (
        ((), "needs a Python file"),
        ((file,), "pass --to STORE.zarr"),
        ((tmp_path / "no_case.py", "--to", tmp_path / "a.zarr"), "does not define case"),
        ((file, "--to", tmp_path / "a.zarr", "--workers", 1, "--scheduler", "tcp://x:1"), "exclude each other"),
        (("--status", tmp_path / "none.zarr"), "is not the store of a sweep"),
    ):
        result = call(*arguments)
        assert result.exit_code == 1 and text in result.stderr, result.stderr
