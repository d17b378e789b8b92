"""The user's `case`: initial data and parameters of a point, evaluated for all points of a task at once where it can be.

It is written for one point. Three ways of evaluating it give one result: its scalar program in NumPy, where JAX can trace it;
NumPy with columns in place of numbers; and one call a point. The first that agrees with single calls at some
points is taken, by the caller of the sweep, for all tasks.
"""

import inspect
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np

from dirax.numerics.arrays import agree, as_type
from dirax.program.memo import Memo, Same
from dirax.run.params import arrays_of_params, register_dataclasses
from dirax.sweeps.axes import PointError, described, identities
from dirax.sweeps.columns import Column, spread

DATA = ("q", "v", "p", "q0", "q1", "x")
RANDOM = ("key", "rng")
"""Arguments of `case` that stand for the random numbers of its point: a key of JAX, a generator of NumPy."""

BLOCK = 1024
"""Points for which a function of JAX is compiled; the last of a task are filled up, so that no result depends on their number."""

SAME = 1e-12
"""How far two ways of evaluation may differ, relative to the largest number of that entry at the points."""

Values = Mapping[str, np.ndarray]
Mode = Literal["scalars", "jax", "columns", "points"]


@dataclass(frozen=True, eq=False)
class Case:
    """`function(**values)` of a point; `names` are those of its arguments, `mode` how it is evaluated, `like` its value at one
    point, which has the types and shapes of all."""

    function: Callable
    names: tuple[str, ...]
    seed: int
    mode: Mode = "points"
    like: Any = None

    @classmethod
    def of(cls, function: Callable, axes: Sequence[str], seed: int) -> "Case":
        """A user's function. Raises `TypeError` for one that does not take the axes' names, all of them unless it is random."""
        if not callable(function):
            raise TypeError(f"case must be a function of {', '.join(axes)}, but {function!r:.60} was given.")
        known = (*axes, *RANDOM)
        parameters = inspect.signature(function).parameters.values()
        if any(p.kind is p.VAR_KEYWORD for p in parameters):
            return cls(function, tuple(axes), seed)
        named = [p for p in parameters if p.kind is not p.VAR_POSITIONAL]
        if unknown := [p.name for p in named if p.name not in known and p.default is p.empty]:
            raise TypeError(
                f"case takes {', '.join(unknown)}, but the axes in over are {', '.join(axes)}; it may take key or rng, too, for "
                "random numbers of its point."
            )
        names = tuple(p.name for p in named if p.name in known)
        idle = ", ".join(name for name in axes if name not in names)
        if idle and not set(RANDOM).intersection(names):
            raise TypeError(
                f"case takes {', '.join(names) or 'nothing'}, and not {idle}, so that all points along {idle} would be the same: "
                f"let case take {idle} too, or leave {idle} out of over."
            )
        return cls(function, names, seed)

    def chosen(self, values: Values) -> "Case":
        """The same with the fastest way that agrees with single calls at these points. Raises `PointError`."""
        ones = [self._one(values, number) for number in range(_size(values))]
        settled = replace(self, like=_widest(ones))
        each = _stacked(ones, values, settled.like)
        for mode in ("scalars", "jax", "columns"):
            if mode == "jax" and "key" not in self.names:
                continue  # what is not random and has no scalar program is compiled in every worker: columns are tried first
            if _same(replace(settled, mode=mode)._tried(values), each):
                return replace(settled, mode=mode)
        again = self._one(values, 0)
        if not _same(_stacked([again], values, again), _stacked(ones[:1], values, ones[0])):
            raise ValueError(
                "case gives other data when it is called again with the same point: let it take an argument rng (a generator of "
                "NumPy) or key (of JAX), which belong to the point, for its random numbers."
            )
        return settled

    def at(self, values: Values) -> tuple[dict[str, Any], Any]:
        """Initial data (B, n) by name and the params, None or a pytree whose leaves have the axis of the points, too, at points
        with these values (B,). Raises `PointError`."""
        register_dataclasses(self.like)  # in a process that has not called the function yet
        found = self._one_by_one(values) if self.mode == "points" else self._tried(values)
        if found is None:
            found = self._one_by_one(values)
        for path, leaf in jax.tree_util.tree_leaves_with_path(found):
            if leaf.dtype.kind == "f" and not np.all(np.isfinite(leaf)):
                bad = int(np.argmin(np.all(np.isfinite(leaf.reshape(len(leaf), -1)), axis=1)))
                raise PointError(
                    f"case must return finite numbers, but its {_place(path)} is {leaf[bad]} at {described(values, bad)}."
                )
        data = {name: array for name, array in found.items() if name != "params"}
        return data, found.get("params")

    def in_jax(self, *leaves: Any) -> dict[str, Any]:
        """The value at one point, given the arguments in order, for JAX to trace."""
        given = dict(zip(self.names, leaves, strict=True))
        if "key" in given:
            given["key"] = jax.random.wrap_key_data(given["key"])
        return _normal(self.function(**given), jnp)

    # ------------------------------------------------------------------ one point

    def _one(self, values: Values, number: int) -> dict[str, Any]:
        """The normal form of the value at one point."""
        given = {name: axis[number].item() if axis.dtype.kind == "U" else axis[number] for name, axis in values.items()}
        one = {name: axis[number : number + 1] for name, axis in values.items()}
        if "rng" in self.names:
            given["rng"] = np.random.Generator(np.random.Philox(key=int(identities(one, self.seed)[0])))
        if "key" in self.names:
            given["key"] = jax.random.wrap_key_data(jnp.asarray(_key_data(one, self.seed)[0]))
        try:
            return _normal(self.function(**{name: given[name] for name in self.names}), np)
        except Exception as error:
            if isinstance(error, PointError):
                raise PointError(f"{error} at {described(values, number)}.") from None
            raise PointError(f"case fails at {described(values, number)}: {in_words(error)}") from error

    def _one_by_one(self, values: Values) -> dict[str, Any]:
        return _stacked([self._one(values, number) for number in range(_size(values))], values, self.like)

    # ------------------------------------------------------------------ many at once

    def _tried(self, values: Values) -> dict[str, Any] | None:
        """The value at all points in the chosen way; None where that way does not take the function."""
        if "rng" in self.names or any(values[name].dtype.kind == "U" for name in self.names if name in values):
            return None
        try:
            found = {"scalars": self._scalars, "jax": self._jax, "columns": self._columns}[self.mode](values)
        except Exception:
            return None
        if found is None or jax.tree.structure(found) != jax.tree.structure(self.like):
            return None
        typed = jax.tree.map(lambda like, leaf: as_type(np.asarray(leaf), like.dtype), self.like, found)
        return typed if jax.tree.structure(typed) == jax.tree.structure(self.like) else None  # None is no leaf

    def _scalars(self, values: Values) -> Any:
        from dirax.program.evaluation.functions import in_numpy  # imported when it is used

        if "key" in self.names:
            return None
        if not self.names:
            return None
        return in_numpy(self.in_jax, [values[name] for name in self.names], ("case of a sweep", Same(self.function), self.names))

    def _jax(self, values: Values) -> Any:
        columns = [_key_data(values, self.seed) if name == "key" else values[name] for name in self.names]
        size = len(columns[0])
        parts = []
        for low in range(0, size, BLOCK):
            part = [column[low : low + BLOCK] for column in columns]
            filled = [np.concatenate([p, np.repeat(p[-1:], BLOCK - len(p), axis=0)]) for p in part]
            parts.append(jax.tree.map(lambda a, n=len(part[0]): np.asarray(a)[:n], _compiled(self)(*filled)))
        return jax.tree.map(lambda *pieces: np.concatenate(pieces), *parts)

    def _columns(self, values: Values) -> Any:
        size = _size(values)
        given = {name: Column(values[name]) for name in self.names}
        found = dict(self.function(**given))
        _check_keys(found)
        params = {"params": jax.tree.map(lambda leaf: spread(leaf, size), found.pop("params"))} if "params" in found else {}
        return {name: spread(value, size) for name, value in found.items()} | params


_jitted: Memo[Callable] = Memo(8)


def _compiled(case: Case) -> Callable:
    """The function of columns in JAX, compiled once."""

    return _jitted.get((Same(case.function), case.names), lambda: jax.jit(jax.vmap(case.in_jax)))


def _key_data(values: Values, seed: int) -> np.ndarray:
    """The two words (B, 2) of the key of JAX of every point."""
    return identities(values, seed).view(np.uint32).reshape(-1, 2)


def _check_keys(found: Any) -> None:
    if not isinstance(found, Mapping) or not found:
        raise PointError(f"case must return a dict of initial data and params, but it returned {found!r:.80}")
    if unknown := [str(name) for name in found if name not in (*DATA, "params")]:
        raise PointError(
            f"case returned {', '.join(unknown)}, but it may return {', '.join(DATA)} and params; what all points have in common "
            "is an argument of sweep"
        )


def _normal(found: Any, xp: Any) -> dict[str, Any]:
    """What `case` returned, its lists as arrays."""
    _check_keys(found)
    register_dataclasses(found.get("params"))
    normal = {}
    for name in sorted(found):
        value = found[name]
        normal[name] = xp.asarray(value) if name != "params" else arrays_of_params(value)
        if name != "params":
            if normal[name].dtype.kind not in "fiub" or normal[name].ndim != 1:
                raise PointError(
                    f"case must return {name} as a row of real numbers, but it has the shape {normal[name].shape} and the dtype "
                    f"{normal[name].dtype}"
                )
            normal[name] = normal[name].astype(np.float64)
    return normal


def _widest(ones: list[dict[str, Any]]) -> dict[str, Any]:
    """The first of the values at single points, in types that have the numbers of all; as it is where they differ in form."""
    if any(jax.tree.structure(one) != jax.tree.structure(ones[0]) for one in ones):
        return ones[0]
    return jax.tree.map(lambda leaf, *others: leaf.astype(np.result_type(leaf, *others)), *ones)


def _stacked(ones: list[dict[str, Any]], values: Values, first: Any) -> dict[str, Any]:
    """Values at single points as one, with an axis in front and the form and types of the `first`. Raises `PointError`."""
    form = lambda one: (jax.tree.structure(one), [leaf.shape for leaf in jax.tree.leaves(one)])
    wanted = form(first)
    for number, one in enumerate(ones):
        if form(one) != wanted:
            raise PointError(
                f"case must return data of one form at all points, but at {described(values, number)} it returned "
                f"{_shapes(one)}, and {_shapes(first)} elsewhere."
            )
    typed = [jax.tree.map(lambda like, leaf: as_type(leaf, like.dtype), first, one) for one in ones]
    for number, one in enumerate(typed):
        if jax.tree.structure(one) != jax.tree.structure(first):
            pairs = zip(jax.tree_util.tree_leaves_with_path(ones[number]), jax.tree.leaves(first), strict=True)
            path, leaf, dtype = next((p, leaf, to.dtype) for (p, leaf), to in pairs if as_type(leaf, to.dtype) is None)
            raise PointError(
                f"case must return data of one type at all points, but at {described(values, number)} its {_place(path)} is "
                f"{leaf}, which {dtype}, the type elsewhere, does not have: let it return floats, 1.0 in place of 1."
            )
    return jax.tree.map(lambda *leaves: np.stack(leaves), *typed)


def _shapes(one: Any) -> str:
    return ", ".join(f"{_place(path)} of shape {leaf.shape}" for path, leaf in jax.tree_util.tree_leaves_with_path(one))


def _place(path: Any) -> str:
    first, *rest = path
    return f"{first.key}{jax.tree_util.keystr(tuple(rest))}"


def _same(a: Any, b: Any) -> bool:
    if a is None or jax.tree.structure(a) != jax.tree.structure(b):
        return False
    return all(agree(x, y, SAME, axis=0) for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True))


def in_words(error: BaseException) -> str:
    """The kind of an error and the first line of its message."""
    return f"{type(error).__name__}: {(str(error).splitlines() or ['no message'])[0].rstrip('.')}."


def _size(values: Values) -> int:
    return len(next(iter(values.values())))
