"""Geometric integrators from discrete Dirac mechanics: state a system, get the integrator, have it measured.

Importing dirax turns on 64-bit floats in JAX (`jax_enable_x64`): structure is preserved to roundoff, and roundoff is float64's.
Papers are cited as [PY] Peng and Yoshimura, [RL] Rodríguez Abella and Leok, [BLM] Barbero-Liñán and Martín de Diego. The folders
are rooms, each of which imports only from those below it: text, numerics, program, geometry, systems, reduction, schemes,
engines, solution, run, diagnostics, sweeps, show, bodies, gallery, cli. The public names are those of `dirax.public`. They, and
JAX with them, are imported where the first of them is used.
"""

from dirax.interruption import end_where_program

end_where_program()

import ast
from functools import cache
from importlib import import_module
from importlib.util import find_spec
from pkgutil import get_data
from typing import TYPE_CHECKING, Any

from dirax.float64 import turn_on_in_jax

if TYPE_CHECKING:
    from dirax.public import *  # noqa: F403
    from dirax.public import __all__ as __all__

__version__ = "0.1.0"

turn_on_in_jax()


def __getattr__(name: str) -> Any:
    """A public name, a room of the package, or the list of the public names."""
    if name == "__all__":
        globals()[name] = import_module("dirax.public").__all__
    elif home := _homes().get(name):
        import_module("dirax.show")  # puts into solutions how they show themselves, for whatever the name leads to
        globals()[name] = _imported(home, name)
    elif not name.startswith("_") and find_spec(f"dirax.{name}"):
        return import_module(f"dirax.{name}")
    else:
        raise AttributeError(f"module 'dirax' has no attribute {name!r}")
    return globals()[name]


def _imported(home: str, name: str) -> Any:
    """What `from home import name` binds: a room and a module of one too."""
    module = import_module(home)
    if hasattr(module, "__path__") and find_spec(f"{home}.{name}"):
        return import_module(f"{home}.{name}")
    return getattr(module, name)


def __dir__() -> list[str]:
    return sorted({*_homes(), *(name for name in globals() if name.startswith("__"))})


@cache
def _homes() -> dict[str, str]:
    """The module of every public name: what `dirax.public` says, read without its imports, of which a program needs few."""
    source = get_data(__name__, "public.py") or b""
    said = (statement for statement in ast.parse(source).body if isinstance(statement, ast.ImportFrom))
    return {name.name: str(statement.module) for statement in said for name in statement.names}
