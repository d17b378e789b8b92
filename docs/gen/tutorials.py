"""MkDocs hook: the pages of docs/tutorials enter the navigation by themselves, in the order of their file names."""

from pathlib import Path
from typing import Any


def on_config(config: Any) -> Any:
    pages = sorted(Path(config.docs_dir, "tutorials").glob("*.md"))
    section = next(entry for entry in config.nav if isinstance(entry, dict) and "Tutorials" in entry)
    section["Tutorials"] = [page.relative_to(config.docs_dir).as_posix() for page in pages]
    if not pages:
        config.nav.remove(section)
    return config
