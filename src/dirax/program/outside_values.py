"""Values outside of a function, as they are read without computing anything, and where they come from."""

import functools
import pickle
import sys
import types
from typing import Any

import jax

from dirax.program.code_reads import reads

LARGEST_WRITTEN = 2**20
"""Bytes of an object up to which it is written to be compared."""

LIBRARIES = {"jax", "jaxlib", "numpy", "scipy", "equinox", "jaxtyping", "optax", *sys.stdlib_module_names} - {"__main__"}
"""Packages whose functions and modules are taken not to change."""

NOT_TO_READ = {*("__init__", "__new__", "__del__", "__repr__", "__str__", "__hash__", "__eq__", "__setitem__", "__setattr__")}
"""Methods of objects that are not called where one reads them."""

NOT_OF_VALUES = {"dirax", "jax", "jaxlib", "equinox"}
"""Packages whose objects are not asked for what they are written as."""

IN_PYTHON = 1 << 9
"""The flag of classes that are stated in Python (Py_TPFLAGS_HEAPTYPE). One of code that `exec` runs in globals without a
`__name__` says that its module is builtins; a function there has none."""

ABSENT = object()


def item(holder: Any, key: Any) -> Any:
    """An entry; `ABSENT` where there is none."""
    try:
        return holder[key]
    except (KeyError, IndexError):
        return ABSENT


def attribute(value: Any, name: str) -> Any:
    """As it is stored: nothing is computed, but what an object keeps from the first time on, which is asked for here so that
    JAX does not trace it."""
    own = getattr(value, "__dict__", {})
    if name in own:
        return own[name]
    kinds = value.__mro__ if isinstance(value, type) else type(value).__mro__
    found = next((kind.__dict__[name] for kind in kinds if name in kind.__dict__), ABSENT)
    if isinstance(found, functools.cached_property) and not isinstance(value, type):
        with jax.ensure_compile_time_eval():
            try:
                return getattr(value, name)
            except Exception:  # it is for the function to raise it, where it asks
                return ABSENT
    return getattr(value, name, ABSENT) if isinstance(found, types.MemberDescriptorType) else found


def read_by(value: Any) -> frozenset[str]:
    """The methods by which an object is read, as a user's class says them."""
    kinds = [kind for kind in type(value).__mro__ if not (is_of_library(kind) or is_installed(kind))]
    special = (name for kind in kinds for name in kind.__dict__ if name.startswith("__") and name.endswith("__"))
    return frozenset(special) - NOT_TO_READ


def written(value: Any) -> bytes:
    """An object as bytes. Raises `ValueError` for one that is large."""
    if sys.getsizeof(value) > LARGEST_WRITTEN:
        raise ValueError
    return pickle.dumps(value, pickle.HIGHEST_PROTOCOL)


def with_methods(value: Any, names: frozenset[str]) -> frozenset[str]:
    """The names of attributes, with those that methods among them read."""
    found, new = names, names
    while new:
        methods = (inner(attribute(value, name)) for name in new)
        codes = [method.__code__ for method in methods if isinstance(method, types.FunctionType)]
        new = frozenset().union(*(reads(code).others for code in codes)) - found
        found = found | new
    return found


def inner(value: Any) -> Any:
    """The function that a property, a class method or what a library makes of one, as `functools.cache`, `jax.jit` and `jax.grad`
    do, stands for; else the value itself."""
    if isinstance(value, property):
        return value.fget
    if isinstance(value, functools.cached_property):
        return value.func
    if isinstance(value, classmethod | staticmethod | types.MethodType):
        return value.__func__
    if callable(value) and not isinstance(value, type) and package_of_code(value) in LIBRARIES:
        wrapped = getattr(value, "__wrapped__", value)
        return value if wrapped is value else inner(wrapped)
    return value


def keeps_traces(value: Any) -> bool:
    """Whether JAX keeps what it traced of a function that was made by `jax.jit`, `jax.checkpoint` or `eqx.filter_jit`, whatever
    that reads is now."""
    if isinstance(value, types.FunctionType):
        return any(code in _checkpoint() for code in _codes_inside(value))
    return package_of_code(value) in ("jax", "jaxlib", "equinox") and hasattr(value, "lower")


@functools.cache
def _checkpoint() -> frozenset[types.CodeType]:
    """The code inside of what `jax.checkpoint` makes."""
    sample = lambda: None
    return frozenset(_codes_inside(jax.checkpoint(sample))) - {sample.__code__}


def _codes_inside(function: types.FunctionType) -> list[types.CodeType]:
    held = map(contents, function.__closure__ or ())
    return [part.__code__ for part in held if isinstance(part, types.FunctionType)]


def beside_inner(value: Any) -> list[types.FunctionType]:
    """The functions of a user that a library's object holds besides the one that it stands for, as rules of derivatives."""
    return [part for part in getattr(value, "__dict__", {}).values() if isinstance(part, types.FunctionType)]


def contents(cell: types.CellType) -> Any:
    """What a cell of a closure holds; `ABSENT` for one that is not filled yet."""
    try:
        return cell.cell_contents
    except ValueError:
        return ABSENT


def is_of_library(value: Any) -> bool:
    """Whether a module, a class or an object is one of those that do not change."""
    file = getattr(value, "__file__", None) or "" if isinstance(value, types.ModuleType) else ""
    known = LIBRARIES | {"builtins"} | ({"dirax"} if isinstance(value, type) else set())
    return root_of(value) in known or "site-packages" in file


def is_installed(kind: type) -> bool:
    """Whether a class is one of an installed package."""
    return "site-packages" in (getattr(sys.modules.get(kind.__module__ or ""), "__file__", None) or "")


def package_of(function: Any) -> str:
    """The package that a function, or the class of an object that is called, is written in, as it says."""
    of_kind = "" if isinstance(function, types.FunctionType) else type(function).__module__
    return (getattr(function, "__module__", None) or of_kind or "").partition(".")[0]


def package_of_code(function: Any) -> str:
    """The package whose code is called: where a library wraps a function of someone else, it says that it is from there."""
    of_globals = function.__globals__.get("__name__") if isinstance(function, types.FunctionType) else type(function).__module__
    return (of_globals or "").partition(".")[0]


def root_of(value: Any) -> str:
    """The package of a module, of a class, or of that of an object."""
    if isinstance(value, types.ModuleType):
        return value.__name__.partition(".")[0]
    kind = value if isinstance(value, type) else type(value)
    nameless = kind.__module__ == "builtins" and kind.__flags__ & IN_PYTHON
    return "" if nameless else (kind.__module__ or "").partition(".")[0]
