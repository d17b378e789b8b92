"""The command line, as a user types it."""

import json

import numpy as np
import pytest
from typer.testing import CliRunner

import dirax as dx
from dirax.cli import app
from dirax.cli_input import InputError, parse_scheme, parse_settings

OWN_FILE = """
import jax.numpy as jnp
import dirax as dx
system = dx.LagrangeDirac(lambda q, v, params: v @ v / 2 - params["k"] * q @ q / 2)
initial = dict(q=[1.0], v=[0.0])
params = {"k": 4.0}
step, steps = 0.05, 40
"""


def call(*arguments):
    return CliRunner().invoke(app, [str(a) for a in arguments])


def test_list_names_every_system():
    text = call("list").stdout
    names = [row["name"] for row in json.loads(call("list", "--json").stdout)]
    assert "rolling-disk" in names and all(name in text for name in names)


def test_run_prints_the_report_and_saves(tmp_path):
    path = tmp_path / "kepler.zarr"
    result = call("run", "kepler", "--set", "steps=200", "--out", path)
    assert result.exit_code == 0, result.output
    assert "symplecticity" in result.stdout and "angular momentum" in result.stdout
    assert dx.load(path).q.shape == (201, 2)
    again = call("run", "kepler", "--set", "steps=200", "--out", path)
    assert again.exit_code == 1 and "exists already" in again.stderr


def test_run_a_file_with_settings_as_json(tmp_path):
    path = tmp_path / "spring.py"
    path.write_text(OWN_FILE, encoding="utf-8")
    out = tmp_path / "spring.nc"
    result = call("run", path, "--set", "k=1", "--set", "q=[2.0]", "--scheme", "plus", "--json", "--out", out)
    assert result.exit_code == 0, result.output
    assert json.loads(result.stdout)["report"]["ok"] in (True, False)
    q = dx.load(out).q[:, 0]  # leapfrog of q̈ = −q from 2: the symplectic Euler recursion by hand
    x, p = 2.0, 0.0
    for value in q:
        assert value == pytest.approx(x, abs=1e-12)
        p -= 0.05 * x
        x += 0.05 * p
    assert len(q) == 41


def test_compare(tmp_path):
    path = tmp_path / "spring.py"
    path.write_text(OWN_FILE, encoding="utf-8")
    result = call("compare", path, "--scheme", "plus", "--scheme", "midpoint", "--json")
    assert result.exit_code == 0, result.output
    orders = {row["scheme"]: row["order"] for row in json.loads(result.stdout)["schemes"]}
    assert orders == pytest.approx({"plus": 1, "midpoint": 2}, abs=0.1)


@pytest.mark.parametrize(
    "arguments, message",
    [
        (("run", "keplr"), "did you mean 'kepler'"),
        (("run", "nowhere.py"), "there is no file"),
        (("run", "kepler", "--set", "steps"), "name=value"),
        (("run", "kepler", "--set", "stpes=3"), "did you mean 'steps'"),
        (("run", "kepler", "--set", "steps=0"), "steps must be a whole number"),
        (("run", "kepler", "--scheme", "plsu"), "did you mean 'plus'"),
        (("run", "kepler", "--scheme", "__import__('os')"), "dirax has no class"),
        (("reproduce", "XY"), "choose one of"),
    ],
)
def test_mistakes_end_with_a_sentence_and_a_status(arguments, message):
    result = call(*arguments)
    assert result.exit_code == 1
    assert message in result.stderr and "Traceback" not in result.output
    assert len(result.stderr.splitlines()) <= 3


def test_a_trajectory_that_fails_has_a_status_and_its_message(tmp_path):
    path = tmp_path / "falling.py"
    path.write_text(
        "import jax.numpy as jnp\nimport dirax as dx\n"
        "system = dx.LagrangeDirac(lambda q, v: v @ v / 2 + jnp.sqrt(q[0]) - 2 * q[0])\n"
        "initial = dict(q=[0.1], v=[-1.0])\nscheme = dx.PlusLagrangeDirac()\n",
        encoding="utf-8",
    )
    result = call("run", path)
    assert result.exit_code == 1 and "kept up to step" in result.stderr


def test_schemes_and_settings_are_parsed_without_evaluation():
    scheme = parse_scheme("DiscreteDirac(map=Theta(0.25), constraints='resolve')")
    assert scheme.map.theta == 0.25 and scheme.constraints == "resolve"
    assert parse_scheme("Composition(LagrangeDAlembert(), 'yoshida4')").coefficients[0] == pytest.approx(1.3512071919596578)
    for bad in ("print(1)", "Theta(0.5)", "(lambda: 0)()", "LagrangeDAlembert(**{})", "dx.Theta(0.5)"):
        with pytest.raises(InputError):
            parse_scheme(bad)
    assert parse_settings(["q=[1, 2.5]", "m=-3"]) == {"q": [1, 2.5], "m": -3}
    assert np.isclose(parse_settings(["h=1e-3"])["h"], 0.001)
