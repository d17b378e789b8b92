"""Runs written as C: compiled by whatever C compiler there is, the rows have the bits of the run."""

import shutil
import subprocess

import numpy as np
import pytest
from typer.testing import CliRunner

import dirax as dx
from dirax import gallery
from dirax.cli.commands import app
from dirax.program import machine_code as llvm

COMPILER = shutil.which("cc")
needs_compiler = pytest.mark.skipif(COMPILER is None, reason="there is no C compiler")


def rows_of(path, *arguments):
    """The columns that the program prints, by name; and its exit status."""
    flags = [
        "-O0",
        "-ffp-contract=off",
        "-Werror=unused-label",
        *["-mfma"] * (llvm.has_fma() and llvm.host()[0].startswith("x86_64")),
    ]
    program = path.with_suffix("")
    subprocess.run([COMPILER, *flags, "-o", program, path, "-lm"], check=True)
    run = subprocess.run([program, *arguments], capture_output=True, text=True)
    lines = run.stdout.splitlines()
    numbers = np.array([[float(x) for x in line.split(",")] for line in lines[1:]])
    return dict(zip(lines[0].split(","), numbers.T, strict=True)), run.returncode


def columns(found, name):
    return np.stack([values for key, values in found.items() if key.startswith(name) and key[len(name) :].isdigit()], axis=1)


@needs_compiler
@pytest.mark.parametrize(
    "name, scheme",
    [
        ("double-pendulum", dx.LagrangeDAlembert()),
        ("rolling-disk", dx.PlusLagrangeDirac()),
        ("kepler", dx.Composition(dx.LagrangeDAlembert(), "suzuki4")),
        ("chaplygin-sphere", dx.LagrangeDAlembert()),
        ("kepler", dx.Collocation(3)),
        ("kepler", dx.EnergyCollocation(2)),
        ("kepler", dx.VariableSteps(dx.LagrangeDAlembert(), lambda q: (q @ q) ** -0.75)),
    ],
)
@pytest.mark.soak_of(but=["kepler-scheme2", "kepler-scheme6"])
def test_the_rows_have_the_bits_of_the_run(tmp_path, name, scheme):
    example, path = gallery.get(name), tmp_path / "run.c"
    settings = {**example.initial, "params": example.params, "step": example.step, "steps": 200, "save_every": 9}
    sol = dx.export_c(path, example.system, scheme, **settings)
    found, status = rows_of(path)
    assert status == 0 and np.array_equal(found["t"], sol.t)
    assert np.array_equal(columns(found, "q"), sol.q) and np.array_equal(columns(found, "p"), sol.p)


@needs_compiler
@pytest.mark.parametrize("scheme", [dx.LagrangeDAlembert(), dx.Collocation(4)])
@pytest.mark.soak_of("scheme0")
def test_trajectories_of_a_batch_stand_one_after_the_other(tmp_path, scheme):
    import jax.numpy as jnp

    system = dx.LagrangeDirac(lambda q, v, k: v @ v / 2 + k * jnp.sum(jnp.cos(q)))
    start = {"q": [[0.1, 3.0e6], [1.2, 0.4], [-0.7, 0.3]], "v": [[0.2, 0.0], [0.0, 0.1], [1.0, 2.0]]}
    rates = {"params": np.array([1.0, 0.5, 2.0]), "batch_params": True}
    sol = dx.export_c(tmp_path / "batch.c", system, scheme, **start, **rates, step=0.1, steps=30, save_every=7)
    found, status = rows_of(tmp_path / "batch.c")
    rows = len(sol.t)
    assert status == 0 and np.array_equal(found["trajectory"], np.repeat(np.arange(3.0), rows))
    assert np.array_equal(found["t"].reshape(3, rows)[1], sol.t)
    assert np.array_equal(columns(found, "q").reshape(3, rows, 2), sol.q)


@needs_compiler
def test_angles_far_out_are_reduced_alike(tmp_path):
    """Sines of arguments beyond 2²⁰ take the slow way."""
    system = dx.LagrangeDirac(lambda q, v: v @ v / 2 + 1e-3 * np.float64(1.0) * _cosine(q))
    start = {"q": [3.0e6, -7.0e9], "v": [4.0e5, 3.0e14]}
    sol = dx.export_c(tmp_path / "far.c", system, dx.LagrangeDAlembert(), **start, step=0.1, steps=40)
    found, _ = rows_of(tmp_path / "far.c", "40", "1")
    assert np.array_equal(columns(found, "q"), sol.q) and np.abs(sol.q).max() > 1e15


def _cosine(q):
    import jax.numpy as jnp

    return jnp.sum(jnp.cos(q))


def test_what_is_not_written_says_why(tmp_path):
    example = gallery.get("pendulum")
    run = {**example.initial, "params": example.params, "step": 0.01, "steps": 5}
    with pytest.raises(ValueError, match=r"must end in \.c"):
        dx.export_c(tmp_path / "run", example.system, example.scheme, **run)
    stiff = {"q": [1.0], "v": [0.0], "step": 1.0, "steps": 5}
    with pytest.raises(ValueError, match="fixed-point iteration of its stages does not converge"):
        dx.export_c(tmp_path / "run.c", dx.LagrangeDirac(lambda q, v: v @ v / 2 - 1e4 * q @ q), dx.Collocation(3), **stiff)
    with pytest.raises(ValueError, match="starts from q and v"):
        free, points = dx.LagrangeDirac(lambda q, v: v @ v / 2), {"q0": [0.1], "q1": [0.2]}
        dx.export_c(tmp_path / "run.c", free, dx.PlusLagrangeDirac(), **points, step=0.01, steps=5)
    assert not (tmp_path / "run.c").exists()


def test_the_command_writes_a_file(tmp_path):
    path = tmp_path / "pendulum.c"
    command = ["export", "c", "pendulum", "--out", str(path), "--set", "steps=3"]
    assert CliRunner().invoke(app, command).exit_code == 0
    assert "int main(" in path.read_text("utf-8")
    again = CliRunner().invoke(app, command)
    assert again.exit_code != 0 and "--overwrite" in again.output


def test_events_and_other_engines_are_refused(tmp_path):
    """The program printed rows without them, and ended well."""
    ball, start = dx.LagrangeDirac(lambda q, v: v @ v / 2 - q[0]), {"q": [1.0], "v": [0.0], "step": 0.1, "steps": 20}
    for event in (dx.Impact(lambda q: q[0]), dx.Event(lambda q: q[0], terminal=True)):
        with pytest.raises(ValueError, match="events and walls are not written as C"):
            dx.export_c(tmp_path / "ball.c", ball, dx.LagrangeDAlembert(), events=[event], **start)
    with pytest.raises(ValueError, match=r"engine must be \"native\", whose code is written, but 'xla' was given"):
        dx.export_c(tmp_path / "ball.c", ball, dx.LagrangeDAlembert(), engine="xla", **start)
    assert not list(tmp_path.iterdir())
    dx.export_c(tmp_path / "ball.c", ball, dx.LagrangeDAlembert(), title="a */ b", engine="auto", **start)
    assert "a * / b" in (tmp_path / "ball.c").read_text(encoding="utf-8")
