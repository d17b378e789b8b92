"""What was run, as plain data that goes into a file: parameters and schemes. Reading it back executes nothing but dirax."""

import dataclasses
from collections.abc import Callable
from importlib import import_module
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dirax.geometry.manifolds import AbstractManifold
from dirax.geometry.maps import AbstractDiscretizationMap
from dirax.schemes.step import AbstractScheme

DTYPES = ("float64", "float32", "int64", "int32", "uint64", "uint32", "bool", "complex128")
RECORDS = (AbstractScheme, AbstractDiscretizationMap, AbstractManifold)
"""What a scheme and its settings may be made of, besides plain data."""

PLAIN = (str, bool, int, float, type(None))


class NotPlain(Exception):
    """Raised for a value that has no plain form, such as a function; it carries the value's text."""


def encode_params(value: Any) -> Any:
    """A tree of numbers and arrays as JSON data, what is of another class than dict, list and tuple by the names of its fields;
    `NotPlain` for anything in it that is none."""
    return _encode(value, _encode_fields)


def _encode(value: Any, encode_other: Callable[[Any], Any]) -> Any:
    if isinstance(value, np.ndarray | np.generic | jax.Array):
        array = np.asarray(value)
        if array.dtype.name not in DTYPES or array.dtype.kind == "c":
            raise NotPlain(repr(value))
        return {"array": array.tolist(), "dtype": array.dtype.name, "shape": list(array.shape)}
    if type(value) in PLAIN:
        return {"plain": value}
    if type(value) in (list, tuple):
        return {type(value).__name__: [_encode(v, encode_other) for v in value]}
    if type(value) is dict and all(type(key) is str for key in value):
        return {"dict": {key: _encode(v, encode_other) for key, v in value.items()}}
    return encode_other(value)


def _encode_fields(value: Any) -> Any:
    """A dataclass, a NamedTuple or any other tree that JAX knows, by the names of what it holds."""
    children = jax.tree_util.tree_flatten_with_path(value, is_leaf=lambda part: part is not value)[0]
    named = {jax.tree_util.keystr(path, simple=True): child for path, child in children}
    if len(named) < len(children) or any(not path for path, _ in children):
        raise NotPlain(repr(value))
    return {"fields": {name: encode_params(child) for name, child in named.items()}, "of": type(value).__qualname__}


def code_of_params(record: Any) -> str:
    """The first class in the data of `encode_params`, which are without its code; "" where they are whole."""
    match record:
        case {"fields": dict(), "of": str(name)}:
            return name
        case {"list": list(parts)} | {"tuple": list(parts)}:
            return next(filter(None, map(code_of_params, parts)), "")
        case {"dict": dict(parts)}:
            return next(filter(None, map(code_of_params, parts.values())), "")
    return ""


def decode_params(record: Any) -> Any:
    """The tree that `encode_params` described, with JAX arrays, and dicts for other classes; `ValueError` for another record."""
    match record:
        case {"array": values, "dtype": str(dtype), "shape": list(shape)} if dtype in DTYPES:
            return jnp.asarray(np.array(values, dtype=dtype).reshape(shape))
        case {"plain": value} if type(value) in PLAIN:
            return value
        case {"list": list(values)}:
            return [decode_params(v) for v in values]
        case {"tuple": list(values)}:
            return tuple(decode_params(v) for v in values)
        case {"dict": dict(values)} | {"fields": dict(values)}:
            return {key: decode_params(v) for key, v in values.items()}
    raise ValueError("a parameter has an unknown form")


def encode_scheme(scheme: Any) -> Any:
    """A scheme as its class and settings; what has no plain form there, such as a user's function, as text."""
    return _encode_setting(scheme) if isinstance(scheme, AbstractScheme) else None


def _encode_setting(value: Any) -> Any:
    if isinstance(value, RECORDS):
        settings = {field.name: _encode_setting(getattr(value, field.name)) for field in dataclasses.fields(value)}
        return {"class": type(value).__name__, "module": type(value).__module__, "settings": settings}
    if type(value) is tuple:
        return {"settings": [_encode_setting(v) for v in value]}
    try:
        return _encode(value, _refused)
    except NotPlain as text:
        return {"text": str(text)}


def _refused(value: Any) -> Any:
    raise NotPlain(repr(value))


def decode_scheme(record: Any) -> AbstractScheme | None:
    """The scheme, if it and all its settings are of dirax or plain data; None otherwise."""
    if record is None:
        return None
    try:
        import_module("dirax.public")  # every class that a file may name is known then, whatever was used before
        scheme = _decode_setting(record, _classes(RECORDS))
    except NotPlain:
        return None
    if not isinstance(scheme, AbstractScheme):
        raise ValueError("its scheme has an unknown form")
    return scheme


def _decode_setting(record: Any, known: dict[str, type]) -> Any:
    match record:
        case {"class": str(name), "module": str(module), "settings": dict(settings)}:
            if name not in known or not module.startswith("dirax."):
                raise NotPlain(f"{module}.{name}")
            return _record(known[name], {k: _decode_setting(v, known) for k, v in settings.items()})
        case {"settings": list(values)}:
            return tuple(_decode_setting(v, known) for v in values)
        case {"text": str(text)}:
            raise NotPlain(text)
    return decode_params(record)


def _record(cls: type, settings: dict[str, Any]) -> Any:
    """The frozen record with these fields; one that the file is too old for has its default. No constructor is called."""
    fields = {field.name: field.default for field in dataclasses.fields(cls)}
    settings = {name: value for name, value in fields.items() if value is not dataclasses.MISSING} | settings
    if settings.keys() != fields.keys():
        raise ValueError(f"{cls.__name__} has other settings: the file is of another version of dirax")
    made = object.__new__(cls)
    for name, value in settings.items():
        object.__setattr__(made, name, value)
    return made


def _classes(bases: tuple[type, ...]) -> dict[str, type]:
    """The classes of dirax that are kinds of `bases`, by name: a file may be older than the module that a class is in."""
    found = {}
    for base in bases:
        for cls in base.__subclasses__():
            found |= _classes((cls,))
            if cls.__module__.startswith("dirax."):
                found[cls.__name__] = cls
    return found
