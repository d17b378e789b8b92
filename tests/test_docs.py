"""The documentation runs: the Python blocks of every page in order, in one namespace, in an empty folder."""

import sys
from pathlib import Path

import matplotlib
import pytest

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT / "docs" / "gen"))
import links
import pages

PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
TEXTS = {str(page.relative_to(ROOT)): page.read_text("utf-8") for page in PAGES}


@pytest.mark.parametrize("page", [page for page, text in TEXTS.items() if pages.blocks(text)])
def test_page_runs(page, tmp_path):
    matplotlib.use("Agg")
    try:
        pages.run(TEXTS[page], str(ROOT / page), tmp_path)
    finally:
        from matplotlib import pyplot

        pyplot.close("all")


def code(text):
    return [(block.line, block.code) for block in pages.blocks(text)]


def test_blocks_of_a_page_have_the_lines_of_the_page():
    tab = "=== tab\n\n    ```python title='x'\n    b = a + 1\n    ```\n"
    page = f"# Title\n\n```python\na = 1\n```\n\n{tab}\n```sh\nls\n```\n"
    assert code(page) == [(3, "a = 1\n"), (9, "b = a + 1\n")]


def test_what_a_table_shows_is_asserted():
    page = "```python\na = 1\n```\n\n| in the paper | shown by |\n|---|---|\n| one | `a == 1` |\n"
    assert code(page) == [(1, "a = 1\n"), (6, "assert a == 1")]


def test_marked_blocks_and_pages_are_left_out():
    block = "```python\nraise SystemExit\n```\n"
    assert code(f"{pages.SKIP}\n\n# Page\n\n{block}") == []
    assert code(f"text\n\n{pages.SKIP}\n{block}\n```python\nc = 3\n```\n") == [(8, "c = 3\n")]


def test_a_block_is_followed_by_what_it_prints_and_draws(tmp_path):
    page = "```python\nprint(1 < 2)\nfrom pathlib import Path\nPath('a.svg').write_text('<svg/>')\n```\n\n```python\nx = 1\n```\n"
    first, second = pages.run(page, "page", tmp_path)
    assert first.pieces == [("text", "True\n")] and first.pictures == [("a.svg", b"<svg/>")]
    assert pages.shown(first, "made") == (
        '\n\n<div class="output"><pre>True</pre></div>\n\n'
        '<div class="output picture"><img src="made/a.svg" alt="a" loading="lazy"></div>\n'
    )
    assert pages.shown(second, "made") == ""


def test_a_page_that_fails_says_its_own_line(tmp_path):
    with pytest.raises(ZeroDivisionError) as error:
        pages.run("text\n\n```python\n1 / 0\n```\n", "page.md", tmp_path)
    assert error.traceback[-1].lineno == 3 and str(error.traceback[-1].path).endswith("page.md")


def test_links_that_lead_nowhere_are_named(tmp_path):
    (tmp_path / "a.html").write_text('<a href="b.html#there">1</a><a href="b.html#not">2</a><a href="c.html">3</a>')
    (tmp_path / "b.html").write_text('<h1 id="there"></h1><img src="https://x.org/y.png"><a href="https://x.org">4</a>')
    assert links.broken(tmp_path) == [
        "a.html points to b.html#not, a place that the page has not",
        "a.html points to c.html, which is not there",
        "b.html loads https://x.org/y.png",
    ]


def test_words_are_spelt_right(capsys, monkeypatch):
    codespell = pytest.importorskip("codespell_lib", reason="the documentation's packages are not installed")
    monkeypatch.chdir(ROOT)
    assert codespell.main(*map(str, [*ROOT.glob("*.md"), ROOT / "docs", ROOT / "src"])) == 0, capsys.readouterr().out
