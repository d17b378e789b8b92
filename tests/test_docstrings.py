"""Everything public says what it is: the names of `dirax` and their methods, and what the rooms at the ground offer to others.

A method that implements one of an interface has the docstring of the interface where it has none of its own.
"""

import importlib
import inspect
from pathlib import Path

import pytest

import dirax
from dirax import public

SOURCE = Path(dirax.__file__).parent
ROOMS = ("numerics", "geometry", "systems", "reduction", "engines", "solution", "run", "diagnostics")
MODULES = [
    ".".join(("dirax", *path.relative_to(SOURCE).with_suffix("").parts)).removesuffix(".__init__")
    for room in ROOMS
    for path in sorted((SOURCE / room).glob("*.py"))
]


def methods(cls: type) -> list[str]:
    """The public methods and properties of a class that are written in dirax, in whichever of its bases."""
    kinds = property | classmethod | staticmethod
    return sorted(
        {
            name
            for base in cls.__mro__
            if base.__module__.startswith("dirax")
            for name, value in vars(base).items()
            if not name.startswith("_") and (inspect.isfunction(value) or isinstance(value, kinds))
        }
    )


def bare(item: object) -> list[str]:
    """What of a function, or of a class and its methods, has no docstring."""
    found = [] if item.__doc__ else [item.__qualname__]
    if inspect.isclass(item):
        found += [f"{item.__name__}.{name}" for name in methods(item) if not inspect.getdoc(getattr(item, name))]
    return found


@pytest.mark.parametrize("name", public.__all__)
def test_a_public_name_and_its_methods_have_docstrings(name):
    item = getattr(dirax, name)
    if inspect.isclass(item) or inspect.isroutine(item):
        assert bare(item) == []


@pytest.mark.parametrize("name", MODULES)
def test_a_module_and_what_it_offers_have_docstrings(name):
    module = importlib.import_module(name)
    own = [
        item
        for key, item in vars(module).items()
        if not key.startswith("_") and getattr(item, "__module__", None) == name and hasattr(item, "__qualname__")
    ]
    assert module.__doc__ or not own, f"{name} does not say what it is"
    assert [missing for item in own for missing in bare(item)] == []
