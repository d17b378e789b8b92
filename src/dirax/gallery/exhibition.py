"""One page of everything that `make demo` makes: the papers' figures and tables, and the systems of the gallery in motion."""

from collections.abc import Callable, Sequence
from html import escape
from pathlib import Path
from string import Template

from dirax import gallery
from dirax.gallery.cards import card
from dirax.gallery.picture import SCHEMES
from dirax.gallery.reproduction import DIFFERS, HEADER, WRONG, Reproduction
from dirax.show.page import asset
from dirax.show.report import report
from dirax.solution.atomic_files import made_folder, write_text
from dirax.text.tables import html_table

SHOWPIECE = "rolling-disk.html"


def write_index(results: Sequence[Reproduction], folder: Path, tell: Callable[[float, str], None]) -> Path:
    """Write `index.html`, beside the figures that are in `folder` already, and the report of the rolling disk.

    `tell(fraction, text)` hears of the progress.
    """
    disk = gallery.get("rolling-disk")
    tell(0.0, "the rolling disk by several methods")
    runs = [disk.simulate(scheme, step=0.01, steps=2000) for scheme, *_ in SCHEMES.values()]
    report(runs, folder / SHOWPIECE, names=list(SCHEMES), verdicts=False)
    pictures = folder / "gallery"
    made_folder(pictures)
    names, cards = gallery.names(), []
    for k, name in enumerate(names):
        tell((k + 1) / (len(names) + 1), f"{name} in motion")
        cards.append(card(name, pictures).html(pictures.name))
    contents = [f'<a href="#{result.paper}">[{result.paper}] {escape(result.title)}</a>' for result in results]
    text = Template(asset("exhibition.html")).substitute(
        contents="".join([*contents, '<a href="#systems">The gallery in motion</a>']),
        showpiece=SHOWPIECE,
        papers="".join(map(_paper, results)),
        systems="".join(cards),
    )
    path = folder / "index.html"
    write_text(path, text)
    return path


def _paper(result: Reproduction) -> str:
    marks, notes = result.notes()
    rows = [(row.quantity, row.paper, row.computed, row.verdict, mark) for row, mark in zip(result.rows, marks, strict=True)]
    table = html_table((*HEADER, "note"), rows, bold=(DIFFERS, WRONG))
    figures = "".join(
        f'<a href="{file}"><img src="{file}" alt="{escape(name.replace("_", " "))}" loading="lazy"></a>'
        for name in result.figures
        for file in [f"{result.paper}/{name}.png"]
    )
    noted = "".join(f"<li>{escape(note)}</li>" for note in notes)
    return (
        f'<h2 id="{result.paper}">[{result.paper}] {escape(result.title)}</h2><div class="figures">{figures}</div>'
        f'<div class="table">{table}</div><ul class="notes">{noted}</ul>'
    )
