"""User functions: plain JAX-traceable callables, with or without a leading `t` and a trailing `params`, checked once and
called uniformly."""

import copy
import re
import threading
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.experimental import checkify

from dirax.program.captured import Captured, ReadsChanged, refuse_changed
from dirax.program.compiled import compiled
from dirax.program.derivatives_by_jax import differentiated
from dirax.program.hoisted import hoisted, split
from dirax.program.indexed import clamps, indexes
from dirax.program.memo import Memo
from dirax.program.signatures import parameters_of, refuse_other_places, signature, takes_params, takes_time
from dirax.program.stated import as_stated
from dirax.program.tracing import once
from dirax.text.representation import value_text

NO_MULTIPLIERS = (
    "forces that see the multipliers are for dx.LagrangeDAlembert, its (+) and (−) cases and their compositions, and for "
    'dx.DiscreteDirac(constraints="resolve")'
)
INDEX = re.compile(r"\bind(ex|ices|exing|exed)\b")
"""What the messages of Python and of JAX have that are about an index."""

_shapes: Memo[tuple[jax.ShapeDtypeStruct, Any]] = Memo(512)

_noting = threading.local()


@contextmanager
def values_matter() -> Iterator[list[bool]]:
    """Within, the list that is given becomes longer where a check of a user's function depends on the values of its arguments,
    and not on their shapes alone."""
    before, _noting.found = getattr(_noting, "found", None), []
    try:
        yield _noting.found
    finally:
        _noting.found = before


def note_values_matter() -> None:
    """Say to `values_matter` that a check depends on values."""
    if getattr(_noting, "found", None) is not None:
        _noting.found.append(True)


class UserFunction(eqx.Module):
    """A user's function under a name, called as `f(*arguments, params)` whether or not the user wrote `params`.

    A `timed` function may have the time as its first argument, which is then called `t`: `at(t, *arguments, params)` calls
    it either way, and `f(t, *arguments, params)` is its call where it takes time.
    Raises `TypeError` at construction when the function is not callable, its signature takes neither the named
    arguments nor the named arguments and `params`, or it has these names in other places.
    """

    function: Callable = eqx.field(static=True)
    name: str = eqx.field(static=True)
    arguments: tuple[str, ...] = eqx.field(static=True)
    takes_params: bool = eqx.field(static=True)
    takes_time: bool = eqx.field(static=True)
    captured: Captured = eqx.field(static=True)
    held: Captured = eqx.field(static=True)
    places: tuple[int, ...] | None = eqx.field(static=True)
    """Where the traced values that it closes over are, once they are taken out (`hoisted`)."""

    def __init__(self, function: Callable, name: str, arguments: tuple[str, ...], timed: bool = False):
        if isinstance(function, UserFunction):  # of a system that is made of another
            vars(self).update(vars(function))
            self.name = name
            return
        expected = f"{name}({', '.join(arguments)}[, params])"
        expected += f" or {name}(t, {', '.join(arguments)}[, params])" * timed
        if not callable(function):
            raise TypeError(
                f"{name} must be a function {expected}, but {value_text(function)} was given: "
                "wrap the value in a function, e.g. a lambda."
            )
        if "multipliers" not in arguments and "multipliers" in parameters_of(function):
            raise TypeError(
                f"{name} cannot see the multipliers here, where it is {expected}: {NO_MULTIPLIERS} of a dx.LagrangeDirac."
            )
        self.takes_time = timed and takes_time(function, len(arguments))
        self.arguments = ("t", *arguments) if self.takes_time else tuple(arguments)
        self.takes_params = takes_params(function, name, expected, len(self.arguments))
        refuse_other_places(function, name, expected, self.arguments)
        self.name, (self.captured, self.held, self.function) = name, as_stated(_hashable(function))
        self.places = None

    def __call__(self, *values: Any):
        *args, params = values
        if len(args) != len(self.arguments):
            raise TypeError(
                f"{self._call} is not called with its {len(self.arguments)} arguments here, but with {len(args)}"
                + (f": {NO_MULTIPLIERS}." if "multipliers" in self.arguments else "; params, which may be None, come last.")
            )
        own = () if is_traced(values) else ((self.name, self.captured),)
        refuse_changed(((self.name, self.held), *own))
        params, first = split(params, self.function, self.places)
        with differentiated(self._call, values):
            return once(self.function)(*first, *args, *((params,) if self.takes_params else ()))

    def hoisted(self, values: list[Tracer]) -> "UserFunction":
        """The same function of params that hold what it closes over and JAX traces, which is added to `values`."""
        if (found := hoisted(self.function, values)) is None:
            return self
        other, (function, places) = copy.copy(self), found
        vars(other).update(function=function, places=places, captured=function.outside, held=function.outside)
        return other

    def at(self, t: Any, *values: Any):
        """The function of `(*arguments, params)` at time t, which is passed on where the function takes it."""
        return self(*self.given(t, *values))

    def given(self, t: Any, *values: Any) -> tuple:
        """What the function is called with at time t: `(t, *values)` or `values`."""
        return (t, *values) if self.takes_time else values

    @property
    def signature(self) -> str:
        """The function's own name with the arguments it is called with, e.g. `pendulum(q, v, params)`."""
        return signature(self.function, (*self.arguments, "params") if self.takes_params else self.arguments)

    def shape(self, *values: Any) -> jax.ShapeDtypeStruct:
        """Shape and dtype of the result, by abstract evaluation on `(*arguments, params)`.

        Raises `TypeError` if the function cannot be traced or does not return one array of float64, and `ValueError` if
        it reads an entry that its arguments do not have (JAX itself would silently read another one).
        """
        if is_traced(values):
            out, jaxpr = self._shape(values)
        else:
            leaves, structure = jax.tree.flatten(values)
            kinds = tuple((np.shape(leaf), getattr(leaf, "dtype", type(leaf))) for leaf in leaves)
            out, jaxpr = _shapes.get((self.function, *self.signed, structure, kinds), lambda: self._shape(values))
        if jaxpr is not None and not is_traced(values, jaxpr.consts):
            note_values_matter()
            if outside := self._outside(jaxpr, values):
                raise ValueError(
                    f"{self._call} reads an entry that its arguments, of shapes {_shapes_of(values)}, do not have "
                    f"({outside}): check the length of the initial data and the indices."
                )
        return out

    def _shape(self, values: tuple) -> tuple[jax.ShapeDtypeStruct, Any]:
        """Shape and dtype of the result; and the jaxpr of a function whose indices may leave their arrays, at other values at
        least, else None."""
        try:
            jaxpr, out = jax.make_jaxpr(lambda *v: self(*v), return_shape=True)(*values)
        except ReadsChanged:  # of a function that this one calls
            raise
        except Exception as error:
            why = why_untraced(error, values[-1] if self.takes_params else None)
            raise TypeError(f"{self._call} could not be traced by JAX{self._on(values)}: {why}") from error
        if not isinstance(out, jax.ShapeDtypeStruct) or out.dtype != jnp.float64:
            what = f"dtype {out.dtype}: convert it with .astype(float)" if hasattr(out, "dtype") else type(out).__name__
            raise TypeError(f"{self._call} must return one array of real numbers (float64), but it returned {what}.")
        traced = is_traced(values, jaxpr.consts)
        return out, jaxpr if indexes(jaxpr.jaxpr) and (traced or not _reads_inside(jaxpr, None)) else None

    def _outside(self, jaxpr: Any, values: tuple) -> str | None:
        """Which index is outside of its array at these values."""
        inside = _reads_inside(jaxpr, values)
        if clamps(jaxpr.jaxpr):  # JAX would report an index, too, that may be outside
            return "an index is out of bounds" if inside is False else None
        outside = None if inside else compiled(_Indexing(self))(*values)[0].get()
        return outside and _first_line(outside)

    @property
    def signed(self) -> tuple:
        """What it is called with, and in whose name."""
        return self.name, self.arguments, self.takes_params, self.takes_time

    @property
    def _call(self) -> str:
        return f"{self.name}({', '.join(self.arguments)})"

    def returning(self, shape: tuple[int, ...]) -> Callable:
        """The same function, which raises `ValueError` when it is traced and its result does not have this shape."""

        def checked(*values):
            result = self(*values)
            if jnp.shape(result) != shape:
                what = "a scalar" if shape == () else f"an array of shape {shape}"
                raise ValueError(
                    f"{self.name}({', '.join(self.arguments)}) must return {what}, but it returned shape "
                    f"{jnp.shape(result)}{': sum or index its result' if shape == () else ''}."
                )
            return result

        return checked

    def __repr__(self) -> str:
        return self.signature

    def _on(self, values) -> str:
        """What it was traced on, in words."""
        arrays = f" on float64 arrays of shapes {_shapes_of(values)}" if self.arguments else ""
        if not self.takes_params or values[-1] is not None:
            return arrays
        last = parameters_of(self.function)[len(self.arguments) :][:1]
        takes = f"its argument {last[0]} stands for" if last and last[0] != "params" else "it takes"
        seen = "; those of constraints are called multipliers" if self.arguments == ("t", "q", "v") else ""
        way = f"{takes} params, which were not given: pass params=…{seen}"
        return f"{arrays} {'and' if arrays else 'with'} params=None ({way})"


def evaluated(function: Callable, *values: Any) -> Any:
    """`function(*values)` for checks of concrete values: in NumPy where that can be, else by one compiled program instead of
    one an operation; either is kept for later calls with equal functions."""
    from dirax.program.evaluation.functions import at_values  # imported when it is used, here and below

    found = None if is_traced(values) else at_values(function, values)
    return compiled(function, seldom=True)(*values) if found is None else found[0]


def scalar_program(function: Callable, *values: Any) -> Any:
    """`function(*values)` for traced values by the operations of its scalar program where it has one: far fewer than those of
    derivatives in one another."""
    from dirax.program.evaluation.functions import in_scalars

    found = in_scalars(function, values)
    return function(*values) if found is None else found[0]


def constant_entries(function: Callable, *values: Any) -> np.ndarray | None:
    """The array `function(*values)`, or the first of several, with NaN for the entries that depend on the values; None where that
    is not found."""
    from dirax.program.evaluation.functions import constants

    return constants(function, values)


class _Indexing(eqx.Module):
    """A user's function with its indices checked: (error, result)."""

    function: UserFunction

    def __call__(self, *values: Any):
        return checkify.checkify(lambda *v: self.function(*v), errors=checkify.index_checks)(*values)


def _hashable(function: Callable) -> Callable:
    """The function, under another identity if it has no hash (an object that holds arrays, say)."""
    try:
        hash(function)
    except TypeError:
        return lambda *values: function(*values)
    return function


def reads_outside(jaxpr: Any) -> bool:
    """Whether an index of a closed jaxpr is outside of its array whatever the values are: JAX would read another entry."""
    from dirax.program.evaluation.indices import reads_outside

    return indexes(jaxpr.jaxpr) and reads_outside(jaxpr)


def _reads_inside(jaxpr, values) -> bool | None:
    from dirax.program.evaluation.indices import reads_inside

    return reads_inside(jaxpr, values)


def _shapes_of(values: tuple) -> str:
    return ", ".join(str(jnp.shape(v)) for v in values[:-1])


def _first_line(message: Any) -> str:
    return (str(message).splitlines() or ["no message"])[0].split(" (`")[0].rstrip(". ")


def why_untraced(error: Exception, params: Any) -> str:
    """What a function of params that JAX does not trace has raised, and the way out."""
    return f"{type(error).__name__}: {_first_line(error)}{_way_out(error, params)}"


def _way_out(error: Exception, params: Any) -> str:
    if params is not None and _of_entries(error, params):
        return f"; params {_what_it_is(params)}."
    if isinstance(error, jax.errors.TracerArrayConversionError):
        return "; write it with jax.numpy instead of numpy."
    if isinstance(error, jax.errors.ConcretizationTypeError):
        if maker := _maker_in(error):
            return (
                f"; {maker} asks for the values of fields, and JAX makes params of what has none: check them before they are "
                "made, or only where isinstance(value, float)."
            )
        return "; write it without Python's if and float(), e.g. with jnp.where."
    return "."


def _maker_in(error: Exception) -> str:
    """The name of the method that makes an object in which an error was raised; "" where it was another one."""
    names = [frame.f_code.co_qualname for frame, _ in traceback.walk_tb(error.__traceback__)]
    return next((name.split("<locals>.")[-1] for name in names if name.endswith("__post_init__")), "")


def _of_entries(error: Exception, params: Any) -> bool:
    """Whether an error may be about an entry that params do not have."""
    if isinstance(error, KeyError):
        return isinstance(params, dict)
    said, kind = str(error), f"'{type(params).__name__}'"
    return isinstance(error, IndexError) or (
        isinstance(error, TypeError | AttributeError) and (INDEX.search(said) is not None or kind in said)
    )


def _what_it_is(params: Any) -> str:
    if isinstance(params, dict):
        return f"has the keys {', '.join(map(repr, params))}" if params else "has no keys"
    if isinstance(params, list | tuple):
        return f"is a {type(params).__name__} of length {len(params)}"
    if not hasattr(params, "shape"):
        return f"is a {type(params).__name__}"
    return f"is an array of shape {params.shape}" if params.shape else "is a number"


def is_traced(*trees: Any) -> bool:
    """Whether any leaf is a JAX tracer: then values cannot be inspected and value checks are skipped."""
    return any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(trees))


def refuse_traced(what: str, *trees: Any) -> None:
    """Raise `ValueError` where a leaf is a JAX tracer, for `what` looks at numbers."""
    if is_traced(*trees):
        raise ValueError(
            f"{what} looks at numbers, but was given values that JAX traces: call it outside of jax.grad, jit and vmap."
        )


def check_finite(name: str, value: Any) -> None:
    """Raise `ValueError`, naming the entry, when a concrete numerical leaf of `value` holds NaN or infinity."""
    for path, leaf in jax.tree_util.tree_leaves_with_path(value):
        if is_traced(leaf) or not np.issubdtype(np.asarray(leaf).dtype, np.number):
            continue
        array = np.asarray(leaf)
        if not np.all(np.isfinite(array)):
            index = [int(i) for i in np.argwhere(~np.isfinite(array))[0]]
            entry = f"{name}{jax.tree_util.keystr(path)}{index if index else ''}"
            raise ValueError(
                f"{name} must be finite, but {entry} is {array[tuple(index)]}: remove or replace the entry before the run."
            )
