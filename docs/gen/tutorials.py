"""MkDocs hook: pages of docs/tutorials that mkdocs.yml does not place stand at the end of the tutorials, by their file names."""

from pathlib import Path
from typing import Any


def on_config(config: Any) -> Any:
    section = next(entry for entry in config.nav if isinstance(entry, dict) and "Tutorials" in entry)["Tutorials"]
    placed = {next(iter(entry.values())) if isinstance(entry, dict) else entry for entry in section}
    pages = (page.relative_to(config.docs_dir).as_posix() for page in sorted(Path(config.docs_dir, "tutorials").glob("*.md")))
    section += [page for page in pages if page not in placed]
    return config
