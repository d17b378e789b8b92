"""MkDocs hook: the pages' programs run, side by side in processes, and what they print and draw is shown below each block.

A line `::: cards` becomes the gallery: a card of every system with its moving picture.
"""

import logging
import multiprocessing
import os
import sys
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

HERE = str(Path(__file__).parent)
sys.path.insert(0, HERE)
import pages

log = logging.getLogger("mkdocs.hooks.execute")
CARDS = "::: cards"
FOLDER = "made"
"""Where the pictures lie in the site."""

QUICK = "--xla_backend_optimization_level=0 --xla_cpu_use_fusion_emitters=false"
"""What is compiled for a page runs once: less optimization, as in the tests, takes half the time."""

outcomes: dict[str, list[pages.Outcome]] = {}
cards: list[str] = []
WORKERS = min(4, os.cpu_count() or 1)


def on_files(files: Any, config: Any) -> Any:
    from mkdocs.structure.files import File

    from dirax import gallery

    sources = {f.src_uri: Path(f.abs_src_path).read_text("utf-8") for f in files.documentation_pages()}
    programs = {uri: text for uri, text in sources.items() if pages.blocks(text)}
    names = gallery.names() if any(CARDS in text for text in sources.values()) else ()
    if HERE not in sys.path:  # MkDocs takes it back; the processes need it
        sys.path.insert(0, HERE)
    os.environ.setdefault("XLA_FLAGS", QUICK)
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(WORKERS, mp_context=context) as pool:
        longest_first = sorted(programs, key=lambda uri: -len(programs[uri]))
        ran = {uri: pool.submit(pages.outcomes, programs[uri], f"docs/{uri}") for uri in longest_first}
        made = [pool.submit(pages.card, name, f"{FOLDER}/gallery") for name in names]
        for uri, future in ran.items():
            try:
                outcomes[uri] = future.result()
            except Exception as error:
                log.warning("the code of %s fails: %s: %s", uri, type(error).__name__, error)
                outcomes[uri] = []
            for outcome in outcomes[uri]:
                for name, content in outcome.pictures:
                    files.append(File.generated(config, f"{FOLDER}/{stem(uri)}/{name}", content=content))
        cards.clear()
        for future in made:
            name, html, picture = future.result()
            cards.append(html)
            files.append(File.generated(config, f"{FOLDER}/gallery/{name}.webp", content=picture))
    return files


def stem(uri: str) -> str:
    """The folder of a page's pictures."""
    return uri.removesuffix(".md").replace("/", "-")


def on_page_markdown(markdown: str, page: Any, config: Any, **_: Any) -> str:
    up = "../" * page.file.src_uri.count("/")
    original = page.file.content_string
    begin = len(original) - len(markdown)  # front matter is gone by now
    for outcome in reversed(outcomes.get(page.file.src_uri, [])):
        at = outcome.end - begin
        markdown = markdown[:at] + pages.shown(outcome, f"{up}{FOLDER}/{stem(page.file.src_uri)}") + markdown[at:]
    if CARDS in markdown:
        markdown = markdown.replace(CARDS, '<div class="systems">' + "".join(cards) + "</div>")
    return markdown
