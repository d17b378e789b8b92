"""A page as one program: its Python blocks run in order, in one namespace, and what each prints and draws is kept.

The tests run the pages by this, and so does the build of the documentation, which shows the outcome below each block.
"""

import contextlib
import io
import os
import re
import sys
import tempfile
import textwrap
import types
from collections.abc import Iterator
from dataclasses import dataclass, field
from html import escape
from pathlib import Path
from typing import Any

SKIP = "<!-- no-test -->"
"""A whole page is left out if it begins with this comment, one block if the comment is the last thing before it."""

BLOCK = re.compile(
    r"^(?P<indent>[ \t]*)(?P<fence>`{3,})python\b[^\n]*\n(?P<code>.*?)^(?P=indent)(?P=fence)[ \t]*$",
    re.DOTALL | re.MULTILINE,
)

SHOWN = re.compile(r"^\|[^\n]*\| `(?P<code>[^`\n]+)` \|$", re.MULTILINE)
"""A row of a table whose last column is headed "shown by" and holds one expression: it must be true."""

PICTURES = (".png", ".svg", ".gif", ".webp", ".html")


@dataclass(frozen=True)
class Block:
    """Python on a page: `code` begins in line `line` (from 0); `end` is the position in the text behind the block."""

    line: int
    code: str
    end: int
    indent: str


@dataclass
class Outcome:
    """What a block printed, as pieces of text and of HTML, and the pictures it left: (name, bytes)."""

    end: int
    indent: str
    pieces: list[tuple[str, str]] = field(default_factory=list)
    pictures: list[tuple[str, bytes]] = field(default_factory=list)


def blocks(text: str) -> list[Block]:
    """The Python of a page, and what its tables show, in order."""
    if text.lstrip().startswith(SKIP):
        return []
    found = []
    for block in BLOCK.finditer(text):
        if not text[: block.start()].rstrip().endswith(SKIP):
            line = text.count("\n", 0, block.start("code"))
            found.append(Block(line, textwrap.dedent(block["code"]), block.end(), block["indent"]))
    if "| shown by |" in text:
        for row in SHOWN.finditer(text):
            found.append(Block(text.count("\n", 0, row.start()), f"assert {row['code']}", row.end(), ""))
    return sorted(found, key=lambda block: block.line)


def run(text: str, name: str, folder: Path, tables: bool = False) -> list[Outcome]:
    """Run a page in an empty folder; `name` is what tracebacks call it, with the page's own lines.

    `tables`: what is printed and knows itself as an HTML table is kept as one.
    """
    module = types.ModuleType("documentation_page")
    outcomes = []
    with _inside(folder), _registered(module):
        for block in blocks(text):
            outcome = Outcome(block.end, block.indent)
            if tables:
                module.__dict__["print"] = _printer(outcome)
            before = _states(folder)
            said = io.StringIO()
            with contextlib.redirect_stdout(said):
                exec(compile("\n" * block.line + block.code, name, "exec"), module.__dict__)
            if said.getvalue().strip():
                outcome.pieces.append(("text", said.getvalue()))
            for path, state in _states(folder).items():
                if before.get(path) != state:
                    outcome.pictures.append((path.name, path.read_bytes()))
            outcomes.append(outcome)
    return outcomes


def outcomes(text: str, name: str) -> list[Outcome]:
    """A page run in a process of its own."""
    import matplotlib

    matplotlib.use("Agg")
    with tempfile.TemporaryDirectory() as folder:
        return run(text, name, Path(folder), tables=True)


def card(name: str, url: str) -> tuple[str, str, bytes]:
    """(name, HTML, moving picture) of a system of the gallery; the picture will be under `url`."""
    from dirax.gallery.cards import card

    with tempfile.TemporaryDirectory() as folder:
        made = card(name, Path(folder))
        return name, made.html(url), made.picture.read_bytes()


def _printer(outcome: Outcome) -> Any:
    def show(*values: Any, sep: str = " ", end: str = "\n", **other: Any) -> None:
        html = values[0]._repr_html_() if len(values) == 1 and hasattr(values[0], "_repr_html_") and not other else ""
        if html.startswith("<table"):
            outcome.pieces.append(("html", html))
            notes = getattr(values[0], "notes", ())
            if notes and not callable(notes):
                outcome.pieces.append(("text", "\n".join(notes) + "\n"))
        elif other:
            print(*values, sep=sep, end=end, **other)
        else:
            text = sep.join(map(str, values)) + end
            if outcome.pieces and outcome.pieces[-1][0] == "text":
                text = outcome.pieces.pop()[1] + text
            outcome.pieces.append(("text", text))

    return show


def shown(outcome: Outcome, url: str) -> str:
    """Markdown to be put behind a block: the pieces in order, then the pictures, which are under `url`."""
    lines = []
    for kind, piece in outcome.pieces:
        if kind == "html":
            table = " ".join(piece.splitlines()).replace("<table>", '<table class="outcome">', 1)
            lines.append(f'<div class="output">{table}</div>')
        else:
            wide = max(map(len, piece.splitlines()), default=0)
            size = " wide" if wide > 88 else ""
            body = escape(piece.rstrip()).replace("\n", "&#10;")
            lines.append(f'<div class="output{size}"><pre>{body}</pre></div>')
    for name, _ in outcome.pictures:
        stem = Path(name).stem.replace("_", " ")
        if name.endswith(".html"):
            frame = f'<iframe src="{url}/{name}" title="{stem}" loading="lazy"></iframe>'
            lines.append(f'<div class="output page">{frame}<p><a href="{url}/{name}">{name} by itself</a></p></div>')
        else:
            lines.append(f'<div class="output picture"><img src="{url}/{name}" alt="{stem}" loading="lazy"></div>')
    if not lines:
        return ""
    return "\n\n" + "\n\n".join(outcome.indent + line for line in lines) + "\n"


def _states(folder: Path) -> dict[Path, tuple[int, int]]:
    """When the pictures of a folder were written."""
    found = (path for path in sorted(folder.iterdir()) if path.suffix in PICTURES)
    return {path: (path.stat().st_mtime_ns, path.stat().st_size) for path in found}


@contextlib.contextmanager
def _inside(folder: Path) -> Iterator[None]:
    here = Path.cwd()
    os.chdir(folder)
    try:
        yield
    finally:
        os.chdir(here)


@contextlib.contextmanager
def _registered(module: types.ModuleType) -> Iterator[None]:
    """The page as a module, as classes and pickles want it."""
    before = sys.modules.get(module.__name__)
    sys.modules[module.__name__] = module
    try:
        yield
    finally:
        del sys.modules[module.__name__]
        if before is not None:
            sys.modules[module.__name__] = before
