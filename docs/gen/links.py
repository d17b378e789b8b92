"""MkDocs hook: every link and picture of the built pages leads to something that is there; nothing is loaded from elsewhere."""

import logging
from functools import cache
from html.parser import HTMLParser
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit

log = logging.getLogger("mkdocs.hooks.links")
LOADING = ("img", "script", "iframe", "source", "video")


class Links(HTMLParser):
    """(tag, address) of what a page points to, and the anchors that it has."""

    def __init__(self, text: str):
        super().__init__()
        self.found: list[tuple[str, str]] = []
        self.anchors: set[str] = set()
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = dict(attrs)
        self.anchors |= {value for name in ("id", "name") if (value := given.get(name))}
        if tag == "link" and given.get("rel") not in ("stylesheet", "icon"):
            return
        self.found += [(tag, value) for name in ("href", "src") if (value := given.get(name))]


def broken(site: Path) -> list[str]:
    """One line for every address that leads nowhere, and for everything that would be loaded from a network."""

    @cache
    def read(page: Path) -> Links:
        return Links(page.read_text("utf-8"))

    lines = []
    for page in sorted(site.rglob("*.html")):
        if page.name == "404.html" or "made" in page.relative_to(site).parts:
            continue
        for tag, address in read(page).found:
            parts = urlsplit(address)
            if parts.scheme in ("data", "mailto", "javascript"):
                continue
            if parts.scheme or parts.netloc:
                if tag in (*LOADING, "link"):
                    lines.append(f"{page.relative_to(site)} loads {address}")
                continue
            target = (page.parent / unquote(parts.path)).resolve() if parts.path else page
            if not target.is_file():
                lines.append(f"{page.relative_to(site)} points to {address}, which is not there")
            elif parts.fragment and target.suffix == ".html" and unquote(parts.fragment) not in read(target).anchors | {"__top"}:
                lines.append(f"{page.relative_to(site)} points to {address}, a place that the page has not")
    return lines


def on_post_build(config: Any) -> None:
    for line in broken(Path(config.site_dir)):
        log.warning(line)
