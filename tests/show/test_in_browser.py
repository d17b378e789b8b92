"""Reports in a real browser."""

import hashlib
import itertools

import numpy as np
import pytest
from browser import CHROMIUM, Browser

import dirax as dx
from dirax import gallery
from dirax.diagnostics.report import Line, Report

pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="no chromium is installed: apt-get install chromium")

LINES = (Line("energy", 1.0, None, "bounded", "within a band"), Line("constraint", 0.0, None, "ok", "worst at t = 0.125"))


@pytest.fixture(scope="module")
def solutions():
    example = gallery.get("rolling-disk")
    schemes = (dx.PlusLagrangeDirac(), dx.MinusLagrangeDirac())
    return [example.simulate(scheme, step=0.01, steps=400) for scheme in schemes]


@pytest.fixture(scope="module")
def pages(solutions, tmp_path_factory):
    folder = tmp_path_factory.mktemp("pages")
    one = solutions[0].report(folder / "one.html", verdicts=Report("what holds", LINES))
    return {"one": one, "two": dx.report(solutions, folder / "two.html", verdicts=False)}


@pytest.fixture(scope="module")
def browser():
    made = Browser()
    yield made
    made.close()


def picture(browser) -> str:
    """A digest of what the canvas of the motion shows now."""
    return hashlib.sha256(browser.evaluate("(dirax.stage.draw(), dirax.stage.canvas.toDataURL())").encode()).hexdigest()


def different_colours(browser) -> int:
    return browser.evaluate(
        """(() => { dirax.stage.draw(); const c = document.createElement('canvas'); c.width = c.height = 200;
        const g = c.getContext('2d'); g.drawImage(dirax.stage.canvas, 0, 0, 200, 200);
        return new Set(new Uint32Array(g.getImageData(0, 0, 200, 200).data.buffer)).size; })()"""
    )


@pytest.mark.parametrize(("dark", "width"), [(False, 390), (True, 1280), (False, 1920)])
def test_it_draws_at_every_size_in_light_and_dark_asks_for_nothing_and_says_nothing(browser, pages, width, dark):
    browser.open(pages["two"], width=width, dark=dark)
    assert different_colours(browser) > 50
    assert browser.evaluate("document.documentElement.scrollWidth") == width
    assert browser.evaluate("dirax.plots.every((p) => p.plot.ctx.getImageData(0, 0, 60, 60).data.some((x) => x > 0))")
    assert int(browser.evaluate("document.documentElement.dataset.firstFrame")) < 3000  # a busy machine; .2 s by itself
    assert browser.problems == [] and browser.requests == [pages["two"].as_uri()]


def test_it_plays_by_button_and_by_keys(browser, pages):
    browser.open(pages["one"])
    still = picture(browser)
    assert picture(browser) == still
    browser.evaluate("document.querySelector('.play').click()")
    browser.wait("dirax.clock.time > 0.02")
    assert browser.evaluate("document.querySelector('.play').textContent") == "Pause"
    assert picture(browser) != still
    browser.evaluate("document.activeElement.blur()")
    browser.key(" ")
    browser.wait("!dirax.clock.playing")
    browser.key("End")
    assert browser.evaluate("dirax.clock.time") == 4.0
    browser.key("ArrowLeft")
    assert browser.evaluate("dirax.clock.time") == pytest.approx(3.99)
    browser.key("Home")
    assert picture(browser) == still
    browser.key("+")
    assert picture(browser) != still
    browser.key("r")
    assert picture(browser) == still
    browser.key("]")
    assert browser.evaluate("dirax.clock.speed") == 2
    assert browser.problems == []


def test_its_numbers_are_those_of_the_solution(browser, pages, solutions):
    sol = solutions[0]
    browser.open(pages["one"])
    shown = browser.evaluate("Array.from(dirax.data.runs[0].tables.energy.values[0])")
    np.testing.assert_array_equal(shown, sol.energy())
    np.testing.assert_array_equal(browser.evaluate("Array.from(dirax.data.runs[0].t)"), sol.t)
    state = browser.evaluate("dirax.data.runs[0].tables.state.values.map((column) => Array.from(column))")
    np.testing.assert_array_equal(np.array(state).T, np.concatenate([sol.q, sol.p], axis=1))
    browser.evaluate("(dirax.plots[0].pick({mode: 'value'}), dirax.clock.seek(1.23))")
    caption = browser.evaluate("dirax.plots[0].caption.textContent")
    assert caption == f"t = 1.23E {sol.energy()[123]:.15g}"
    place = browser.evaluate("(dirax.stage.draw(), dirax.stage.actors[0].bodies[0].body.object.position.toArray())")
    np.testing.assert_allclose(place, [*sol.q[123, :2], 1.0], atol=1e-5)


def test_a_verdict_leads_to_its_time(browser, pages, solutions):
    browser.open(pages["one"])
    browser.evaluate("[...document.querySelectorAll('#verdicts .seek')].find((b) => b.textContent === 'constraint').click()")
    assert browser.evaluate("dirax.clock.time") == 0.125
    energy = solutions[0].energy()
    browser.evaluate("[...document.querySelectorAll('#verdicts .seek')].find((b) => b.textContent === 'energy').click()")
    assert browser.evaluate("dirax.clock.time") == solutions[0].t[np.argmax(np.abs(energy - energy[0]))]


def test_plots_zoom_and_never_hide_an_extremum(browser, pages):
    browser.open(pages["one"], width=390)
    kept = """(() => { const n = 200000, x = Float64Array.from({length: n}, (_, i) => Math.sin(i / 900));
        x[77777] = 9; x[123456] = -9; const p = dirax.plots[0], run = dirax.data.runs[0], table = run.tables.energy;
        table.t = Float64Array.from({length: n}, (_, i) => 4 * i / n); table.values[0] = x; p.pick({mode: 'value'});
        const y = p.plot.data[1]; return [y.length < 5000, Math.max(...y), Math.min(...y)]; })()"""
    assert browser.evaluate(kept) == [True, 9, -9]
    browser.evaluate("dirax.plots[0].zoom([1.5, 1.6])")
    assert browser.evaluate("[dirax.plots[0].plot.scales.x.min, dirax.plots[0].plot.scales.x.max]") == [1.5, 1.6]
    browser.evaluate("dirax.plots[0].whole.click()")
    assert browser.evaluate("dirax.plots[0].plot.scales.x.max") == 4
    browser.evaluate("dirax.plots.forEach((p) => p.chart.modes?.forEach((mode) => p.pick({mode})))")
    assert browser.problems == []


def test_it_is_told_to_those_who_do_not_see_it(browser, pages):
    browser.open(pages["two"])
    nodes = browser.call("Accessibility.getFullAXTree")["nodes"]
    nameless = [
        node["role"]["value"]
        for node in nodes
        if node.get("role", {}).get("value") in ("button", "combobox", "slider", "checkbox", "image", "region", "link")
        and not node["ignored"]
        and not node.get("name", {}).get("value")
    ]
    assert nameless == []
    named = {node.get("name", {}).get("value", "") for node in nodes}
    assert any(name.startswith("Energy against time: ") for name in named)
    order = browser.evaluate("[...document.querySelectorAll('h1, h2, h3')].map((h) => Number(h.tagName[1]))")
    assert order[0] == 1 and all(b - a <= 1 for a, b in itertools.pairwise(order))


def test_it_prints_on_a_few_pages(browser, pages):
    browser.open(pages["one"], dark=True)
    pdf = browser.call("Page.printToPDF")["data"]
    assert len(pdf) > 30_000
    assert browser.problems == []


def test_without_webgl_the_rest_is_complete(pages):
    made = Browser("--disable-3d-apis")
    try:
        made.open(pages["one"])
        assert "no WebGL" in made.evaluate("document.getElementById('stage').textContent")
        assert made.evaluate("dirax.plots.length") > 3
        made.key("End")
        assert made.evaluate("dirax.clock.time") == 4.0
        assert made.problems == [] or all("WebGL" in problem for problem in made.problems)
    finally:
        made.close()
