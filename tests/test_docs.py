"""The documentation runs: the Python blocks of every page in order, in one namespace, in an empty folder."""

import re
import sys
import textwrap
import types
from pathlib import Path

import matplotlib
import pytest

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]

# A whole page is left out if it begins with this comment, one block if the comment is the last thing before it.
SKIP = "<!-- no-test -->"
BLOCK = re.compile(
    r"^(?P<indent>[ \t]*)(?P<fence>`{3,})python\b[^\n]*\n(?P<code>.*?)^(?P=indent)(?P=fence)[ \t]*$",
    re.DOTALL | re.MULTILINE,
)


# A row of a table whose last column is headed "shown by" and holds one expression: it must be true.
SHOWN = re.compile(r"^\|[^\n]*\| `(?P<code>[^`\n]+)` \|$", re.MULTILINE)


def program(text: str) -> str:
    """The Python blocks of a page, and what its tables show, as one program whose lines keep their numbers on the page."""
    if text.lstrip().startswith(SKIP):
        return ""
    found = {}
    for block in BLOCK.finditer(text):
        if not text[: block.start()].rstrip().endswith(SKIP):
            found[text.count("\n", 0, block.start("code"))] = textwrap.dedent(block["code"]).splitlines()
    if "| shown by |" in text:
        for row in SHOWN.finditer(text):
            found[text.count("\n", 0, row.start())] = [f"assert {row['code']}"]
    lines: list[str] = []
    for first, code in sorted(found.items()):
        lines += [""] * (first - len(lines)) + code
    return "\n".join(lines)


PROGRAMS = {str(page.relative_to(ROOT)): program(page.read_text("utf-8")) for page in PAGES}


@pytest.mark.parametrize("page", [page for page, code in PROGRAMS.items() if code.strip()])
def test_page_runs(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    matplotlib.use("Agg")
    module = types.ModuleType("documentation_page")
    monkeypatch.setitem(sys.modules, module.__name__, module)
    try:
        exec(compile(PROGRAMS[page], str(ROOT / page), "exec"), module.__dict__)
    finally:
        from matplotlib import pyplot

        pyplot.close("all")


def test_blocks_of_a_page_are_one_program_with_the_lines_of_the_page():
    tab = "=== tab\n\n    ```python title='x'\n    b = a + 1\n    ```\n"
    page = f"# Title\n\n```python\na = 1\n```\n\n{tab}\n```sh\nls\n```\n"
    assert program(page).split("\n") == ["", "", "", "a = 1", "", "", "", "", "", "b = a + 1"]


def test_what_a_table_shows_is_asserted():
    page = "```python\na = 1\n```\n\n| in the paper | shown by |\n|---|---|\n| one | `a == 1` |\n"
    assert program(page).split("\n") == ["", "a = 1", "", "", "", "", "assert a == 1"]


def test_marked_blocks_and_pages_are_left_out():
    block = "```python\nraise SystemExit\n```\n"
    assert program(f"{SKIP}\n\n# Page\n\n{block}") == ""
    assert program(f"text\n\n{SKIP}\n{block}\n```python\nc = 3\n```\n").strip() == "c = 3"
