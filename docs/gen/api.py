"""MkDocs hook: a line `::: room systems` on a page becomes the documentation of every public name of that room.

The public names are those that `dirax/public.py` imports; each must find its place on one page.
"""

import ast
import logging
import re
from pathlib import Path
from typing import Any

log = logging.getLogger("mkdocs.hooks.api")
ROOM = re.compile(r"^::: room (\w+)$", re.MULTILINE)
ENTRY = """::: {path}
    options:
      heading: {name}
      toc_label: {name}
"""

undocumented: dict[str, str] = {}


def public_names(init: Path) -> dict[str, str]:
    """Public name → where it is defined, in the order of the file."""
    names = {}
    for node in ast.parse(init.read_text("utf-8")).body:
        if isinstance(node, ast.ImportFrom) and node.level == 0 and (node.module or "").startswith("dirax"):
            for alias in node.names:
                names[alias.asname or alias.name] = f"{node.module}.{alias.name}"
    return {name: path for name, path in names.items() if not name.startswith("_")}


def on_config(config: Any) -> None:
    undocumented.clear()
    undocumented.update(public_names(Path(config.config_file_path).parent / "src" / "dirax" / "public.py"))


def on_page_markdown(markdown: str, **_: Any) -> str:
    def documentation(room: re.Match) -> str:
        here = {name: path for name, path in undocumented.items() if path.split(".")[1] == room[1]}
        for name in here:
            del undocumented[name]
        return "\n".join(ENTRY.format(name=f"dirax.{name}", path=path) for name, path in here.items())

    return ROOM.sub(documentation, markdown)


def on_post_build(**_: Any) -> None:
    if undocumented:
        log.warning("these public names are on no API page: %s", ", ".join(undocumented.values()))
