"""Fingerprints: what a store on the disk belongs to, by digests of functions, by their program or their code, and of values."""

import hashlib
import json
import re
import types
from collections.abc import Callable, Mapping
from typing import Any

import equinox as eqx
import jax
import numpy as np
from jax.extend.core import ClosedJaxpr, Jaxpr

from dirax.program.captured import Captured
from dirax.program.code_reads import reads
from dirax.solution.plain_forms import encode_scheme

ADDRESS = re.compile(r"0x[0-9a-fA-F]+")
SHOWN = 16
"""Digits of a digest."""


def of_functions(functions: list[tuple[Callable, tuple]]) -> str:
    """A digest of functions at arguments of these kinds, by what JAX traces of them: names and layout of the code do not
    matter."""
    digest = hashlib.sha256()
    for function, arguments in functions:
        closed = jax.make_jaxpr(function)(*arguments)
        _add_jaxpr(digest.update, closed)
    return digest.hexdigest()[:SHOWN]


def of_steps(system: Any, equation: Any, initial: Mapping[str, Any], params: Any, h: float, t: float, project: bool) -> str:
    """A digest of the system's functions as a scheme uses them, of one trajectory: the completion of the initial data and every
    step."""
    h, t = np.float64(h), np.float64(t)
    complete = lambda data, t, params: system.complete({**data, "t": t}, params, project)
    completed = jax.eval_shape(complete, initial, t, params)
    functions: list[tuple[Callable, tuple]] = [(complete, (initial, t, params))]
    for stage, fraction in equation.stages:
        state, u = jax.ShapeDtypeStruct((stage.state_size,), np.float64), jax.ShapeDtypeStruct((stage.unknowns,), np.float64)
        step = np.float64(fraction)
        functions += [
            (lambda data, h, params, stage=stage: stage.start(data, h, params), ({**completed, "t": t}, h * step, params)),
            (stage.residual, (u, state, t, h * step, params)),
            (stage.advance, (u, state, t, h * step, params)),
            (stage.unpack, (state, u, t, h * step, params)),
            (stage.guess, (state, u, h * step, params)),
        ]
    return of_functions(functions)


def of_scheme(scheme: Any) -> str:
    """A scheme in words, with its settings."""
    return f"{ADDRESS.sub('', repr(scheme))} {of_value(encode_scheme(scheme))}"


def of_code(function: Any) -> str:
    """A digest of the code of a function, or of an object that is called, with the values and functions that it refers to."""
    digest = hashlib.sha256()
    seen: set[int] = set()
    _add_code(digest.update, function, seen)
    for words, _, value in Captured(function).watched:
        digest.update(words.encode())
        _add_code(digest.update, value, seen)
    return digest.hexdigest()[:SHOWN]


def of_value(value: Any) -> str:
    """A digest of numbers, texts, arrays, functions and containers of them."""
    digest = hashlib.sha256()
    _add_code(digest.update, value, set())
    return digest.hexdigest()[:SHOWN]


def differences(there: Mapping[str, Any], here: Mapping[str, Any]) -> list[str]:
    """What differs between two fingerprints, in words."""
    found = []
    for name in sorted({*there, *here}):
        a, b = there.get(name), here.get(name)
        if a != b:
            found.append(f"{name} ({_short(a)} there, {_short(b)} here)")
    return found


def _short(value: Any) -> str:
    text = json.dumps(value, ensure_ascii=False) if not isinstance(value, str) else value
    return text if len(text) <= 60 else f"{text[:59]}…"


# ------------------------------------------------------------------------------------------------------------ programs


def _add_jaxpr(add: Callable[[bytes], None], jaxpr: Any) -> None:
    """The equations of a jaxpr with its variables numbered as they occur."""
    consts: list[Any] = []
    if isinstance(jaxpr, ClosedJaxpr):
        jaxpr, consts = jaxpr.jaxpr, list(jaxpr.consts)
    numbers: dict[Any, int] = {}

    def variable(v: Any) -> bytes:
        if hasattr(v, "val"):
            return b"=" + _plain(v.val)
        return f"{numbers.setdefault(v, len(numbers))}:{v.aval.str_short()}".encode()

    for const in consts:
        add(_plain(const))
    for v in (*jaxpr.constvars, *jaxpr.invars):
        add(variable(v) + b",")
    for equation in jaxpr.eqns:
        add(b"\n" + equation.primitive.name.encode() + b"(")
        for v in equation.invars:
            add(variable(v) + b",")
        for name in sorted(equation.params.keys() - {"name"}):
            add(name.encode() + b"=")
            _add_parameter(add, equation.params[name])
        add(b")")
        for v in equation.outvars:
            add(variable(v) + b",")
    add(b"\n->")
    for v in jaxpr.outvars:
        add(variable(v) + b",")


def _add_parameter(add: Callable[[bytes], None], value: Any) -> None:
    if isinstance(value, ClosedJaxpr | Jaxpr):
        _add_jaxpr(add, value)
    elif isinstance(value, tuple | list):
        for entry in value:
            _add_parameter(add, entry)
    elif isinstance(value, np.ndarray | np.generic | jax.Array):
        add(_plain(value))
    elif callable(value) and not isinstance(value, type):
        add(getattr(value, "__qualname__", type(value).__name__).encode())
    else:
        add(ADDRESS.sub("", repr(value)).encode())


def _plain(value: Any) -> bytes:
    array = np.asarray(value)
    return f"{array.dtype.str}{array.shape}".encode() + hashlib.sha256(np.ascontiguousarray(array).tobytes()).digest()


# ---------------------------------------------------------------------------------------------------------------- code


def _add_code(add: Callable[[bytes], None], value: Any, seen: set[int]) -> None:
    """A value and what it refers to; functions by their code, not by where they are."""
    add(type(value).__name__.encode() + b"(")
    if isinstance(value, np.ndarray | np.generic | jax.Array):
        add(_plain(value))
    elif value is None or isinstance(value, bool | int | float | complex | str | bytes):
        add(repr(value).encode())
    elif isinstance(value, types.ModuleType):
        add(value.__name__.encode())
    elif id(value) in seen:
        add(b"again")
    elif isinstance(value, types.CodeType):
        _add_instructions(add, value, seen)
    elif isinstance(value, types.FunctionType):
        seen.add(id(value))
        if (value.__module__ or "").partition(".")[0] in ("jax", "numpy", "dirax", "scipy", "equinox"):
            add(f"{value.__module__}.{value.__qualname__}".encode())
        else:
            _add_function(add, value, seen)
    elif isinstance(value, Mapping):
        seen.add(id(value))
        for key in sorted(value, key=repr):
            _add_code(add, key, seen)
            _add_code(add, value[key], seen)
    elif isinstance(value, tuple | list):
        for entry in value:
            _add_code(add, entry, seen)
    elif isinstance(value, set | frozenset):
        for entry in sorted(value, key=repr):
            _add_code(add, entry, seen)
    elif isinstance(value, eqx.Module) or hasattr(value, "__dataclass_fields__"):
        seen.add(id(value))
        for name in sorted(value.__dataclass_fields__):
            _add_code(add, getattr(value, name, None), seen)
    elif callable(value) and hasattr(value, "__qualname__"):
        add(f"{getattr(value, '__module__', '')}.{value.__qualname__}".encode())
    else:
        add(ADDRESS.sub("", repr(value)).encode())
    add(b")")


def _add_function(add: Callable[[bytes], None], function: types.FunctionType, seen: set[int]) -> None:
    code = function.__code__
    _add_code(add, code, seen)
    _add_code(add, [function.__defaults__, function.__kwdefaults__], seen)
    for cell in function.__closure__ or ():
        try:
            _add_code(add, cell.cell_contents, seen)
        except ValueError:  # not yet filled
            add(b"empty")
    for name in sorted(reads(code).globals):
        if name in function.__globals__:
            add(name.encode())
            _add_code(add, function.__globals__[name], seen)


def _add_instructions(add: Callable[[bytes], None], code: types.CodeType, seen: set[int]) -> None:
    add(code.co_code)
    for part in (code.co_names, code.co_varnames, code.co_freevars, code.co_cellvars):
        add(repr(part).encode())
    for const in code.co_consts:
        if not (isinstance(const, str) and const == (code.co_consts[0] if code.co_consts else None)):  # the docstring
            _add_code(add, const, seen)
