"""What was run, as plain data that goes into a file: parameters and schemes. Reading it back executes nothing but dirax."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dirax.functions import UserFunction
from dirax.schemes.step import AbstractScheme

DTYPES = ("float64", "float32", "int64", "int32", "uint64", "uint32", "bool", "complex128")
PLAIN = (str, bool, int, float, type(None))


class NotPlain(Exception):
    """Raised for a value that has no plain form, such as a function; it carries the value's text."""


def encode_params(value: Any) -> Any:
    """A tree of dicts, lists, tuples, numbers and arrays as JSON data; `NotPlain` for anything else in it."""
    if isinstance(value, np.ndarray | np.generic | jax.Array):
        array = np.asarray(value)
        if array.dtype.name not in DTYPES or array.dtype.kind == "c":
            raise NotPlain(repr(value))
        return {"array": array.tolist(), "dtype": array.dtype.name, "shape": list(array.shape)}
    if type(value) in PLAIN:
        return {"plain": value}
    if type(value) in (list, tuple):
        return {type(value).__name__: [encode_params(v) for v in value]}
    if type(value) is dict and all(type(key) is str for key in value):
        return {"dict": {key: encode_params(v) for key, v in value.items()}}
    raise NotPlain(repr(value))


def decode_params(record: Any) -> Any:
    """The tree that `encode_params` described, arrays as JAX arrays; `ValueError` for a record of another form."""
    match record:
        case {"array": values, "dtype": str(dtype), "shape": list(shape)} if dtype in DTYPES:
            return jnp.asarray(np.array(values, dtype=dtype).reshape(shape))
        case {"plain": value} if type(value) in PLAIN:
            return value
        case {"list": list(values)}:
            return [decode_params(v) for v in values]
        case {"tuple": list(values)}:
            return tuple(decode_params(v) for v in values)
        case {"dict": dict(values)}:
            return {key: decode_params(v) for key, v in values.items()}
    raise ValueError("a parameter has an unknown form")


def encode_scheme(scheme: Any) -> Any:
    """A scheme of dirax as its class name and settings, what has no plain form (a user's function, a map) as text."""
    if not isinstance(scheme, AbstractScheme):
        return None
    settings = {field.name: _encode_setting(getattr(scheme, field.name)) for field in dataclasses.fields(scheme)}
    return {"class": type(scheme).__name__, "module": type(scheme).__module__, "settings": settings}


def _encode_setting(value: Any) -> Any:
    if isinstance(value, AbstractScheme):
        return {"scheme": encode_scheme(value)}
    if isinstance(value, UserFunction):
        return {"text": value.signature}
    try:
        return encode_params(value)
    except NotPlain as text:
        return {"text": str(text)}


def decode_scheme(record: Any) -> AbstractScheme | None:
    """The scheme, if it is one of dirax whose settings are plain data; None otherwise."""
    known = {cls.__name__: cls for cls in AbstractScheme.__subclasses__() if cls.__module__.startswith("dirax.schemes.")}
    match record:
        case {"class": str(name), "module": str(module), "settings": dict(settings)} if name in known:
            if known[name].__module__ != module or any("text" in setting for setting in settings.values()):
                return None
            arguments = {k: _decode_setting(v) for k, v in settings.items()}
            nested = any("scheme" in setting and arguments[k] is None for k, setting in settings.items())
            return None if nested else known[name](**arguments)
    return None


def _decode_setting(record: Any) -> Any:
    return decode_scheme(record["scheme"]) if "scheme" in record else decode_params(record)


def plain(value: Any) -> Any:
    """Dicts, lists and numbers as JSON can hold them, everything else as text; for information only."""
    if isinstance(value, np.generic | np.ndarray | jax.Array):
        return plain(np.asarray(value).tolist())
    if isinstance(value, dict):
        return {str(k): plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [plain(v) for v in value]
    return value if type(value) in PLAIN else str(value)
