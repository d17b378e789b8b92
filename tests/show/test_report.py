"""Reports as files: what is in them, and what is refused. What they do in a browser is in test_in_browser.py."""

import hashlib
import json
import re
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dirax as dx
from dirax import gallery
from dirax.diagnostics.report import Line, Report
from dirax.show import frames, page
from dirax.show.report import fingerprint

ASSETS = Path(page.__file__).parent / "assets"


@pytest.fixture(scope="module")
def sol():
    return gallery.get("kepler").simulate(steps=60)


@pytest.fixture(scope="module")
def text(sol, tmp_path_factory):
    path = sol.report(tmp_path_factory.mktemp("report") / "kepler.html", verdicts=False)
    return path.read_text("utf-8")


def test_the_page_stands_alone(text):
    assert not re.findall(r"""(?:src|href)\s*=\s*["']?(?!data:|#)[a-z]+:""", text)
    assert "default-src 'none'" in text
    assert text.count("</script>") == 3
    assert len(text) < 1.0e6


def test_numbers_of_the_text_are_those_of_the_solution(sol, text):
    assert f">{float(sol.energy()[0])!r}<" in text
    assert fingerprint(sol) in text
    assert "Hairer, Lubich &amp; Wanner" in text


def test_the_fingerprint_is_of_the_numbers(sol):
    again = gallery.get("kepler").simulate(steps=60)
    assert fingerprint(again) == fingerprint(sol) != fingerprint(gallery.get("kepler").simulate(steps=61))


def test_what_a_user_names_is_inert(tmp_path):
    evil = "</script><script>alert(1)</script><b>&\u2028"
    sol = gallery.get("pendulum").simulate(steps=5)
    sol.metadata.update(title=evil, coordinates=[evil, "<i>"])
    report = Report(evil, (Line(evil, 1.0, None, "ok", evil),))
    text = dx.report(sol, tmp_path / "evil.html", names=[evil], verdicts=report).read_text("utf-8")
    assert text.count("</script>") == 3
    assert "<script>alert" not in text and "<b>&" not in text


def test_verdicts_lead_to_their_worst_times(sol, tmp_path):
    said = Line("constraint", 1.0, None, "VIOLATED", "worst at t = 0.25")
    energy = Line("energy", 1.0, None, "bounded", "within a band")
    text = dx.report(sol, tmp_path / "r.html", verdicts=Report("all", (said, energy))).read_text("utf-8")
    worst = float(sol.t[np.argmax(np.abs(sol.energy() - sol.energy()[0]))])
    assert 'data-time="0.25"' in text and f'data-time="{worst!r}"' in text
    assert "! constraint VIOLATED" in text


def test_scenes_take_their_places_by_name(sol, tmp_path):
    parts = [dx.scene.point(lambda q: q), dx.scene.arrow(lambda q: q, lambda p, params: params["mu"] * p)]
    parts += [dx.scene.disk(lambda t: jnp.stack([t, t]), lambda q: jnp.eye(3)), dx.scene.point(lambda q: np.asarray(q).tolist())]
    assert dx.report(sol, tmp_path / "a.html", scene=parts, verdicts=False).exists()
    with pytest.raises(ValueError, match="takes v"):
        sol.report(tmp_path / "b.html", scene=[dx.scene.point(lambda v, q: v)], verdicts=False)
    with pytest.raises(ValueError, match=r"shape \(1,\)"):
        sol.report(tmp_path / "b.html", scene=[dx.scene.point(lambda q: q[:1])], verdicts=False)
    with pytest.raises(ValueError, match="view must be one of"):
        dx.scene.Scene(parts, view="behind")
    with pytest.raises(TypeError, match="one is a int"):
        dx.scene.Scene([1])


@pytest.mark.parametrize(
    "change, error, match",
    [
        ({"path": "x.pdf"}, ValueError, r"must end in \.html"),
        ({"path": "none/x.html"}, FileNotFoundError, "does not exist"),
        ({"path": "x" * 300 + ".html"}, ValueError, "has 305 bytes: choose one of at most 255"),
        ({"solutions": 3}, TypeError, "got 3"),
        ({"solutions": []}, TypeError, r"got \[\]"),
        ({"names": ["a", "b"]}, ValueError, "one string for each of 1"),
        ({"verdicts": []}, ValueError, "one report for each of 1"),
    ],
)
def test_what_is_refused(sol, tmp_path, change, error, match):
    arguments = {"solutions": sol, "path": "x.html", "verdicts": False} | change
    arguments["path"] = tmp_path / arguments["path"]
    with pytest.raises(error, match=match):
        dx.report(arguments.pop("solutions"), arguments.pop("path"), **arguments)
    assert not list(tmp_path.iterdir())


def test_a_file_is_kept_where_that_is_asked_for(sol, tmp_path):
    path = tmp_path / "x.html"
    path.write_text("old")
    with pytest.raises(FileExistsError, match="overwrite=True"):
        sol.report(path, overwrite=False)
    assert path.read_text() == "old"


@pytest.mark.parametrize("name", gallery.names())
@pytest.mark.soak_of(
    "bicycle", "andrews-squeezer", "four-bar", "bricard", "flyball-governor", "n-four-bar", "trikke", "n-trailer", "robot-arm"
)
def test_every_scene_of_the_gallery_has_places_of_the_right_shapes(name):
    example = gallery.get(name)
    row = {key: np.asarray(value, float) for key, value in example.initial.items() if key in ("q", "x")} | {"t": np.zeros(())}
    if example.scene.fields is not None:
        rows = {key: np.stack([value, value]) for key, value in row.items()}
        row |= {key: values[0] for key, values in example.scene.fields(rows, example.params).items()}
    for part in example.scene.parts:
        for place, function in part.places.items():
            if callable(function):
                names = frames._names(function, row)
                assert names is not None
                found = jax.eval_shape(function, *((row | {"params": example.params})[name] for name in names))
                assert found.shape in (((4,), (3, 3)) if place == "turn" else ((2,), (3,)))


def test_the_bundle_belongs_to_the_sources():
    said = json.loads((ASSETS / "report.json").read_text())
    digest = lambda name: hashlib.sha256((ASSETS / name).read_bytes()).hexdigest()
    sources = ["build.mjs", "package.json", *(f"src/{path.name}" for path in (ASSETS / "src").iterdir())]
    mend = "the sources of the script changed: run `make vendor` and commit what it made"
    assert {name: digest(name) for name in sources} == said["sources"], mend
    assert {name: digest(name) for name in said["made"]} == said["made"], mend
    wanted = json.loads((ASSETS / "package.json").read_text())["devDependencies"]
    assert said["packages"] == {name: wanted[name] for name in said["packages"]}
    licences = (ASSETS / "LICENSES.txt").read_text()
    assert all(f"{name} {number}" in licences for name, number in said["packages"].items())


def test_in_a_notebook_it_is_a_small_page_in_a_frame_of_its_own(sol):
    shown = sol._repr_html_()
    frame = re.match(r'<iframe srcdoc="([^"]*)" title="The motion of Kepler problem" sandbox="allow-scripts"', shown)
    assert frame is not None and "&lt;html lang=&quot;en&quot; class=&quot;small&quot;&gt;" in frame[1]
    assert "<table>" in shown[frame.end() :]
    assert sol[0:1]._repr_html_().startswith("<table>")


@pytest.mark.parametrize("group", [[0], [0, 1]])
def test_shapes_of_one_and_of_no_coordinate(group, tmp_path):
    """The page asked for places of a scene that the user had not named."""
    system = dx.LagrangeDirac(lambda q, v: v @ v / 2 - (q[1] ** 2 if group == [0] else 0.0))
    run = {"q": [0.0, 1.0], "v": [0.4, 0.2], "step": 0.1, "steps": 5}
    sol = dx.simulate(dx.reduce(system, dx.LinearConnection(group)), dx.LagrangeDAlembert(), **run)
    sol.report(tmp_path / "page.html")
    text = (tmp_path / "page.html").read_text()
    assert '"kind": "phase"' not in text and '"kind":"phase"' not in text and "structure holds" in text
    sol.animate(tmp_path / "motion.gif")
