"""The params of a run: any pytree of numbers and arrays, with dataclasses in it as they are, checked."""

import dataclasses
import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dirax.program.user_functions import check_finite, is_traced
from dirax.run.scalars import is_number

FEW = 32
"""Numbers up to which Python is quicker than NumPy to see whether they are finite."""


def params_of_case(params: Any) -> Any:
    """The params with arrays for leaves; dataclasses in them become pytrees. Raises `TypeError` and `ValueError` for leaves that
    are no finite numbers, for dictionaries whose keys have no order, and for classes that change what they are made of."""
    register_dataclasses(params)
    leaves, structure = jax.tree.flatten(params)
    plain = [plain_floats(leaf) for leaf in leaves]
    if not any([leaf is None for leaf in plain]):
        return _made(params, structure, plain)
    made = arrays_of_params(params)
    check_finite("params", made)
    return made


def _made(params: Any, structure: Any, leaves: list[Any]) -> Any:
    """The params with these leaves. Raises `ValueError` for those that are other ones then."""
    made = jax.tree.unflatten(structure, leaves)
    again = jax.tree.leaves(made)
    if len(again) != len(leaves) or any([a is not b for a, b in zip(again, leaves, strict=True)]):
        _refuse_changed(params, made, leaves)
    return made


def _refuse_changed(params: Any, made: Any, leaves: list[Any]) -> None:
    """Raise `ValueError` for params that have other numbers when JAX makes them of their own, as it does all the time."""
    places = [jax.tree_util.keystr(path) for path, _ in jax.tree_util.tree_leaves_with_path(params)]
    found = {jax.tree_util.keystr(path): leaf for path, leaf in jax.tree_util.tree_leaves_with_path(made)}
    for place, leaf in zip(places, leaves, strict=True):
        other = found.get(place)
        if not is_traced(other, leaf) and (other is None or not np.array_equal(np.asarray(other), leaf)):
            raise ValueError(
                f"params{place} is {np.asarray(leaf).tolist()!r:.40}, but {np.asarray(other).tolist()!r:.40} when the params are "
                "made anew of their own numbers, as JAX makes them wherever it goes through them: their class changes what it is "
                "given, in __post_init__ for instance. Do not register it with JAX, for dirax takes a plain dataclass as it is, "
                "or have it keep what it is given."
            )


def register_dataclasses(params: Any) -> None:
    """Have JAX look into the dataclasses in params. Raises `TypeError` for dictionaries whose keys have no order."""
    try:
        _register_dataclasses(params)
    except (TypeError, ValueError):
        if (keys := _without_order(params)) is None:
            raise
        text = f"params has a dictionary with the keys {keys:.60}, which have no order: name all of them by texts."
        raise TypeError(text) from None


def _without_order(params: Any) -> str | None:
    """The keys of a dictionary in params that cannot be sorted, as JAX has to; None where there is none."""
    inside = params.values() if isinstance(params, dict) else params if isinstance(params, list | tuple) else ()
    if isinstance(params, dict):
        try:
            sorted(params)
        except TypeError:
            return ", ".join(map(repr, params))
    return next((keys for part in inside if (keys := _without_order(part)) is not None), None)


def _register_dataclasses(params: Any) -> None:
    """Have JAX look into dataclasses, all attributes of which are taken for pytrees; into those that it knows it does already."""
    for leaf in jax.tree.leaves(params):
        if dataclasses.is_dataclass(leaf) and not isinstance(leaf, type):
            _register(type(leaf))
            for name in _attributes(leaf):
                _register_dataclasses(getattr(leaf, name))


def _register(kind: type) -> None:
    """Have JAX take objects of a dataclass apart, and put them together without `__init__`: what `__post_init__` asks of the
    numbers that a user gives is not asked of those that JAX traces, and what it makes of them is not made twice."""

    def apart(value: Any) -> tuple[list[Any], tuple[str, ...]]:
        names = _attributes(value)
        return [getattr(value, name) for name in names], names

    def apart_with_names(value: Any) -> tuple[list[tuple[Any, Any]], tuple[str, ...]]:
        parts, names = apart(value)
        return [(jax.tree_util.GetAttrKey(name), part) for name, part in zip(names, parts, strict=True)], names

    def together(names: tuple[str, ...], parts: Any) -> Any:
        value = object.__new__(kind)
        for name, part in zip(names, parts, strict=True):
            object.__setattr__(value, name, part)
        return value

    jax.tree_util.register_pytree_with_keys(kind, apart_with_names, together, apart)


def _attributes(value: Any) -> tuple[str, ...]:
    """The names of all that a dataclass holds: its fields, and what it has made of them."""
    fields = [field.name for field in dataclasses.fields(value) if hasattr(value, field.name)]
    return *fields, *sorted(set(getattr(value, "__dict__", ())) - set(fields))


def arrays_of_params(params: Any) -> Any:
    """The pytree with arrays for its leaves: NumPy's where they can be, for JAX's start JAX and compile what takes a part.
    Raises `TypeError` and `ValueError` for leaves that are no numbers."""
    for path, leaf in jax.tree_util.tree_leaves_with_path(params):
        place = f"params{jax.tree_util.keystr(path)}"
        if not is_number(leaf) and not _is_boolean(leaf):
            found = f"{leaf!r:.60}: use such a value in the system's functions directly"
            if callable(leaf):
                found += " (of an equinox module give eqx.filter(module, eqx.is_array), and join it there by eqx.combine)"
            if jnp.issubdtype(getattr(leaf, "dtype", object), jax.dtypes.prng_key):
                found = "a key of JAX: pass jax.random.key_data(key), and have jax.random.wrap_key_data in the system's functions"
            raise TypeError(f"params must be a pytree of numbers and arrays, but {place} is {found}.")
        refuse_masked(leaf, place)
        if isinstance(leaf, int) and not -(2**63) <= leaf < 2**63:
            raise ValueError(f"{place} is a whole number of {leaf.bit_length()} bits, and arrays hold 64: write it as a float.")
    leaves, structure = jax.tree.flatten(params)
    return _made(params, structure, [jnp.asarray(leaf) if is_traced(leaf) else _native(np.array(leaf)) for leaf in leaves])


def _native(array: np.ndarray) -> np.ndarray:
    """The array in the byte order of this machine, in double precision where it has more."""
    if array.dtype in (np.longdouble, np.clongdouble):
        return array.astype(complex if array.dtype.kind == "c" else float)
    return array if array.dtype.isnative else array.astype(array.dtype.newbyteorder("="))


def _is_boolean(leaf: Any) -> bool:
    return isinstance(leaf, bool) or jnp.issubdtype(getattr(leaf, "dtype", object), jnp.bool_)


def refuse_masked(value: Any, name: str) -> None:
    """Raise `ValueError` for an array of NumPy's some numbers of which are masked."""
    if isinstance(value, np.ma.MaskedArray) and np.any(np.ma.getmaskarray(value)):
        where = np.argwhere(np.ma.getmaskarray(value))[0].tolist()
        raise ValueError(f"{name} has no number at {where}, where it is masked: give one, by {name}.filled(…) for instance.")


def plain_floats(value: Any) -> np.ndarray | None:
    """A copy of finite float64 numbers that need no further look; None for anything else."""
    if type(value) not in (list, tuple, np.ndarray, float):
        return None
    try:
        array = np.array(value)
    except Exception:  # values that JAX traces among them, or what is no array
        return None
    if array.dtype.char != "d" or not array.dtype.isnative:
        return None
    finite = all(map(math.isfinite, array.ravel().tolist())) if array.size <= FEW else np.isfinite(array).all()
    return array if finite else None
