"""Geometric integrators from discrete Dirac mechanics: state a system, get the integrator, have it measured.

Importing dirax turns on 64-bit floats in JAX (`jax_enable_x64`): structure is preserved to roundoff, and roundoff is float64's.
Papers are cited as [PY] Peng and Yoshimura, [RL] Rodríguez Abella and Leok, [BLM] Barbero-Liñán and Martín de Diego. The folders
are rooms, each of which imports only from those below it: text, numerics, program, geometry, systems, reduction, schemes,
engines, solution, run, diagnostics, sweeps, show, bodies, gallery, cli. The public names are those of `dirax.public`. They, and
JAX with them, are imported where the first of them is used.
"""

from importlib import import_module
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

from dirax.float64 import turn_on_in_jax

if TYPE_CHECKING:
    from dirax.public import *  # noqa: F403
    from dirax.public import __all__ as __all__

__version__ = "0.1.0"

turn_on_in_jax()


def __getattr__(name: str) -> Any:
    """A room of the package, a public name, or the list of these."""
    if not name.startswith("_") and find_spec(f"dirax.{name}"):
        return import_module(f"dirax.{name}")
    if not name.startswith("_") or name == "__all__":
        public = import_module("dirax.public")
        if name == "__all__" or name in public.__all__:
            globals()[name] = getattr(public, name)
            return globals()[name]
    raise AttributeError(f"module 'dirax' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *import_module("dirax.public").__all__})
