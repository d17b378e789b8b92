"""User functions: plain JAX-traceable callables, with or without a trailing `params`, checked once and called uniformly."""

import inspect
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

POSITIONAL = (inspect.Parameter.POSITIONAL_ONLY, inspect.Parameter.POSITIONAL_OR_KEYWORD)


class UserFunction(eqx.Module):
    """A user's function under a name, called as `f(*arguments, params)` whether or not the user wrote `params`.

    Raises `TypeError` at construction when the function is not callable or its signature takes neither the named
    arguments nor the named arguments and `params`.
    """

    function: Callable = eqx.field(static=True)
    name: str = eqx.field(static=True)
    arguments: tuple[str, ...] = eqx.field(static=True)
    takes_params: bool = eqx.field(static=True)

    def __init__(self, function: Callable, name: str, arguments: tuple[str, ...]):
        expected = f"{name}({', '.join(arguments)}[, params])"
        if not callable(function):
            raise TypeError(
                f"{name} must be a function {expected}, but a {type(function).__name__} was given: "
                "wrap the value in a function, e.g. a lambda."
            )
        self.function, self.name, self.arguments = function, name, tuple(arguments)
        self.takes_params = _takes_params(function, name, expected, len(arguments))

    def __call__(self, *values: Any):
        *args, params = values
        return self.function(*args, params) if self.takes_params else self.function(*args)

    def shape(self, *values: Any) -> jax.ShapeDtypeStruct:
        """Shape and dtype of the result, by abstract evaluation; `TypeError` if it is not one array of real numbers."""
        try:
            out = jax.eval_shape(lambda *v: self(*v), *values)
        except Exception as error:
            raise TypeError(
                f"{self.name}({', '.join(self.arguments)}) could not be traced by JAX on float64 arrays of shapes "
                f"{[jnp.shape(v) for v in values[:-1]]}: {type(error).__name__}: {str(error).splitlines()[0]}"
            ) from error
        if not hasattr(out, "shape") or not jnp.issubdtype(out.dtype, jnp.floating):
            what = f"dtype {out.dtype}" if hasattr(out, "dtype") else f"a {type(out).__name__}"
            raise TypeError(f"{self.name} must return one array of real numbers (float64), but it returned {what}.")
        return out


def _takes_params(function: Callable, name: str, expected: str, count: int) -> bool:
    try:
        parameters = list(inspect.signature(function).parameters.values())
    except (TypeError, ValueError):
        return False
    if any(p.kind is p.VAR_POSITIONAL for p in parameters):
        return False
    positional = [p for p in parameters if p.kind in POSITIONAL]
    required = [p for p in positional if p.default is p.empty]
    if len(required) == count + 1:
        return True
    if len(required) <= count <= len(positional):
        return len(positional) > count and positional[count].name == "params"
    raise TypeError(
        f"{name} must have the signature {expected}, but {getattr(function, '__name__', 'it')} takes "
        f"{len(required)} argument{'s' if len(required) != 1 else ''}"
        f" ({', '.join(p.name for p in required) or 'none'})."
    )


def is_traced(*trees: Any) -> bool:
    """Whether any leaf is a JAX tracer: then values cannot be inspected and value checks are skipped."""
    return any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(trees))


def check_finite(name: str, value: Any) -> None:
    """Raise `ValueError` when a concrete numerical leaf of `value` holds NaN or infinity."""
    for leaf in jax.tree.leaves(value):
        if is_traced(leaf) or not np.issubdtype(np.asarray(leaf).dtype, np.number):
            continue
        array = np.asarray(leaf)
        if not np.all(np.isfinite(array)):
            where = tuple(int(i) for i in np.argwhere(~np.isfinite(array))[0])
            raise ValueError(
                f"{name} must be finite, but it holds {array[where]} at index {where}: "
                "remove or replace the entry before the run."
            )
