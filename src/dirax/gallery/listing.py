"""The gallery's names, titles and sources, read from the files without running them: that would import JAX."""

import ast
from pathlib import Path

from dirax import gallery


def listing() -> list[tuple[str, str, str]]:
    """(name, title, source) of every system, in the order of the gallery."""
    return [_entry(name, module) for name, module in gallery.modules().items()]


def _entry(name: str, module: str) -> tuple[str, str, str]:
    for node in ast.parse((Path(__file__).parent / f"{module}.py").read_text("utf-8")).body:
        if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "EXAMPLE" and isinstance(node.value, ast.Call):
            texts = {word.arg: word.value.value for word in node.value.keywords if isinstance(word.value, ast.Constant)}
            texts |= zip(
                ("name", "title", "source"), (a.value for a in node.value.args if isinstance(a, ast.Constant)), strict=False
            )
            if {"title", "source"} <= texts.keys():
                return name, str(texts["title"]), str(texts["source"])
    example = gallery.get(name)
    return name, example.title, example.source
