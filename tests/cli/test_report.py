"""`dirax report`: of a system, of a user's file, of a saved solution."""

from typer.testing import CliRunner

from dirax import gallery
from dirax.cli.commands import app


def run(*arguments):
    return CliRunner().invoke(app, ["report", *map(str, arguments)])


def test_a_saved_solution_of_the_gallery_becomes_a_page_with_its_scene(tmp_path):
    gallery.get("kepler").simulate(steps=30).save(tmp_path / "orbit.zarr")
    out = tmp_path / "orbit.html"
    result = run(tmp_path / "orbit.zarr", "--out", out)
    assert result.exit_code == 0 and str(out) in result.output
    text = out.read_text("utf-8")
    assert "Kepler problem" in text and '"kind": "plane"' in text and "symplecticity" in text
    again = run(tmp_path / "orbit.zarr", "--out", out)
    assert again.exit_code == 1 and "--overwrite" in again.output
    assert run(tmp_path / "orbit.zarr", "--out", out, "--overwrite", "--set", "step=1").exit_code == 1


def test_a_file_of_a_user_may_define_its_scene(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "spring.py").write_text(
        "import jax.numpy as jnp, dirax as dx\n"
        "system = dx.LagrangeDirac(lambda q, v: v @ v / 2 - q @ q / 2)\n"
        "initial, step, steps = dict(q=[1.0], v=[0.0]), 0.1, 20\n"
        "scene = [dx.scene.spring([0.0, 0.0], lambda q: jnp.stack([2 + q[0], jnp.zeros(())]))]\n"
    )
    result = run("spring.py", "--scheme", "plus", "--scheme", "minus")
    assert result.exit_code == 0
    text = (tmp_path / "spring.html").read_text("utf-8")
    assert '"kind": "spring"' in text and "2 solutions side by side" in text


def test_an_unknown_system_is_an_error():
    result = run("keppler")
    assert result.exit_code == 1
    assert "kepler" in result.output
