"""What is kept of each trajectory: its saved rows, or what the user's `keep` makes of them where they were computed.

`keep` is written for the Solution of one trajectory. For a million it is called with many at once, in the first of these ways
that agrees with single calls for some trajectories: with the Solution of a batch; in NumPy, with columns in place of arrays;
compiled by JAX; or else one by one.
"""

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np

from dirax.numerics.arrays import agree, as_type
from dirax.program.memo import Memo, Same
from dirax.solution.description import layout_of
from dirax.solution.energy_code import energy_of, is_quick
from dirax.solution.solution import Solution
from dirax.solution.stored import TYPES
from dirax.solution.sweep_store import MESSAGE, STATUS
from dirax.solution.trajectory import BLOCK
from dirax.sweeps.axes import PointError, described
from dirax.sweeps.case import Values, in_words
from dirax.sweeps.columns import Column, spread
from dirax.sweeps.layout import Layout

NAME = re.compile(r"\w[\w \-+.,()\[\]=%]{0,99}")
"""What kept arrays, which are folders of a store, may be called."""

SAME = 1e-9
"""How far two ways may be from each other, relative to the largest number of an array."""

DERIVED = ("energy", "constraint_residual")
"""Quantities of a solution that are computed for all trajectories at once."""

Mode = Literal["rows", "batch", "columns", "jax", "singles"]


@dataclass(frozen=True, eq=False)
class Keep:
    """`function(sol)`, a dict of numbers and arrays of the Solution of one trajectory. `mode` is how it is called, `like` its
    value for one trajectory, `derived` the quantities that it asks for, and `quick` says that the energy is had by compiled code.
    Without a function the saved rows are kept."""

    function: Callable | None
    mode: Mode = "rows"
    like: Any = None
    derived: tuple[str, ...] = ()
    quick: bool = False

    @classmethod
    def of(cls, function: Any) -> "Keep":
        """A user's function, or None. Raises `TypeError` for anything else."""
        if function is not None and not callable(function):
            raise TypeError(f"keep must be a function of a solution that returns a dict, but {function!r:.60} was given.")
        return cls(function, "rows" if function is None else "singles")

    def typed(self, layout: Layout) -> "Keep":
        """The same with the types that a store has."""
        if self.function is None:
            return self
        return replace(self, like={name: np.zeros(like.shape, layout.arrays[name].dtype) for name, like in self.like.items()})

    def chosen(self, sol: Solution, values: Values) -> "Keep":
        """The same as it is to be called, by the trajectories of a batch at these points. Raises `PointError`."""
        if self.function is None:
            return self
        first = self._of_one(sol, 0, values)
        settled = replace(self, like=first, derived=self._asked_for(sol))
        settled = replace(settled, quick="energy" in settled.derived and is_quick(sol))
        ones = settled._each(sol, values)
        wide = {name: np.result_type(like, *(one[name] for one in ones if name in one)) for name, like in first.items()}
        settled = replace(settled, like={name: like.astype(wide[name]) for name, like in first.items()})
        each = settled._stacked(sol, ones, values)
        modes: tuple[Mode, ...] = ("batch", "columns", "jax")
        for mode in modes:
            tried = replace(settled, mode=mode)
            try:
                found = tried._together(sol)
            except Exception:
                continue
            if found.keys() == each.keys() and all(_close(found[name], each[name]) for name in each):
                return tried
        return settled

    def at(self, sol: Solution, values: Values) -> dict[str, np.ndarray]:
        """What is kept of a batch, arrays (B, …) by name. Raises `PointError`."""
        if self.mode == "rows":
            return {entry["variable"]: np.asarray(sol.fields[entry["name"]]) for entry in layout_of(sol.field_info)}
        if self.mode == "singles":
            return self._stacked(sol, self._each(sol, values), values)
        if self.quick:
            sol.derived["energy"] = energy_of(sol)
        size, most = sol.batch or 0, lanes_together(sol.rows)
        parts = []
        for low in range(0, size, most):
            try:
                parts.append(self._together(sol if size <= most else sol[low : low + most]))
            except Exception as error:
                raise PointError(
                    f"keep fails for the trajectories from {described(values, low)} on: {in_words(error)}"
                ) from error
        found = {name: as_type(np.concatenate([part[name] for part in parts]), like.dtype) for name, like in self.like.items()}
        if any(a is None or a.shape != (size, *self.like[name].shape) for name, a in found.items()):  # `q[:10]` of at most ten
            return replace(self, mode="singles").at(sol, values)
        return found  # type: ignore[return-value]

    # ------------------------------------------------------------------ many at once

    def _together(self, sol: Solution) -> dict[str, np.ndarray]:
        if self.mode == "batch":
            return {name: np.asarray(value) for name, value in self.function(sol).items()}  # type: ignore[misc]
        if self.mode == "columns":
            found = self.function(_as_columns(sol))  # type: ignore[misc]
            return {name: spread(value, sol.batch or 0) for name, value in found.items()}
        return self._in_jax(sol)

    def _in_jax(self, sol: Solution) -> dict[str, np.ndarray]:
        """Compiled for one number of trajectories, up to which the last repeats itself, so that no result depends on it."""
        size, most = sol.batch or 0, lanes_together(sol.rows)
        at = np.minimum(np.arange(most), size - 1)
        params = jax.tree.map(lambda leaf: np.asarray(leaf)[at], sol.given_params) if sol.batch_params else sol.given_params
        arrays = {name: np.asarray(a)[at] for name, a in sol.fields.items()}
        derived = {name: np.asarray(getattr(sol, name)())[at] for name in self.derived}
        bare = sol.replace(t=jnp.asarray(sol.axis), fields={}, derived={}, params=None, message="", initial={}, ok=True)

        def one(fields: Any, derived: Any, params: Any) -> Any:
            return dict(self.function(bare.replace(fields=fields, derived=derived, params=params, batch_params=False)))  # type: ignore[misc]

        def make() -> Callable:
            return jax.jit(jax.vmap(one, in_axes=(0, 0, 0 if sol.batch_params and params is not None else None)))

        key = Same(self.function), Same(sol.equation), sol.rows, sol.step, sol.batch_params
        found = _jitted.get(key, make)(arrays, derived, params)
        return {name: np.asarray(value)[:size] for name, value in found.items()}

    # ------------------------------------------------------------------ one by one

    def _each(self, sol: Solution, values: Values) -> list[dict[str, np.ndarray]]:
        if self.quick:
            sol.derived["energy"] = energy_of(sol)
        return [self._of_one(sol, lane, values) for lane in range(sol.batch or 0)]

    def _of_one(self, sol: Solution, lane: int, values: Values) -> dict[str, np.ndarray]:
        try:
            found = self.function(single(sol, lane))  # type: ignore[misc]
        except Exception as error:
            if self.like is not None and not np.asarray(sol.ok)[lane]:
                return {}
            raise PointError(f"keep fails for the trajectory at {described(values, lane)}: {in_words(error)}") from error
        if not isinstance(found, Mapping) or not found or not all(isinstance(name, str) for name in found):
            raise PointError(f"keep must return a dict of numbers and arrays, but it returned {found!r:.60}.")
        wrong = [name for name in found if name in (STATUS, MESSAGE) or not NAME.fullmatch(name)]
        if wrong:
            raise PointError(
                f"keep returned an array named {wrong[0]!r:.60}, but names are folders of the store: a letter or digit, then "
                f"letters, digits, spaces and _-+.,()[]=%, and neither {STATUS} nor {MESSAGE}, which it has itself."
            )
        return {name: _storable(name, value) for name, value in found.items()}

    def _stacked(self, sol: Solution, ones: list[dict[str, np.ndarray]], values: Values) -> dict[str, np.ndarray]:
        form = lambda one: {name: array.shape for name, array in one.items()}
        typed: list[Any] = []
        for lane, one in enumerate(ones):
            found = {name: as_type(one[name], like.dtype) for name, like in self.like.items() if name in one}
            same, other = form(one) == form(self.like), next((name for name, array in found.items() if array is None), None)
            if np.asarray(sol.ok)[lane] and not same:
                raise PointError(
                    f"keep must return arrays of one shape for all trajectories, but at {described(values, lane)} it returned "
                    f"{form(one)}, and {form(self.like)} elsewhere."
                )
            if np.asarray(sol.ok)[lane] and other is not None:
                raise PointError(
                    f"keep must return {other} in one type for all trajectories, but at {described(values, lane)} it returned "
                    f"{one[other]}, which {self.like[other].dtype}, the type elsewhere, does not have: let it return floats, 0.0 "
                    "in place of 0."
                )
            typed.append(found if same and other is None else {name: _nothing(like) for name, like in self.like.items()})
        return {name: np.stack([one[name] for one in typed]) for name in self.like}

    def _asked_for(self, sol: Solution) -> tuple[str, ...]:
        """The derived quantities that a call for one trajectory computes."""
        one = single(sol, 0)
        self.function(one)  # type: ignore[misc]
        return tuple(name for name in DERIVED if name in one.derived)


_jitted: Memo[Callable] = Memo(8)


def lanes_together(rows: int) -> int:
    """Trajectories for which `keep` is called at once: a power of two, and no more rows than are computed in one way."""
    return 1 << max(0, (BLOCK // rows).bit_length() - 1)


class _Together(Solution):
    """A batch as if it were one trajectory, with columns in place of arrays."""

    together: Solution

    def energy(self) -> Any:
        return Column(self.together.energy())

    def constraint_residual(self) -> Any:
        return Column(self.together.constraint_residual())

    def momentum_map(self, generator: Callable) -> Any:
        return Column(np.asarray(self.together.momentum_map(generator)))

    def map_rows(self, function: Callable) -> Any:
        return jax.tree.map(lambda a: Column(np.asarray(a)), self.together.map_rows(function))


def _as_columns(sol: Solution) -> Solution:
    given = {name: getattr(sol, name) for name in ("field_info", "step", "save_every", "system", "scheme", "equation")}
    params = jax.tree.map(lambda leaf: Column(np.asarray(leaf)), sol.given_params) if sol.batch_params else sol.given_params
    shown = _Together(
        **given,
        stats=sol.stats | {name: Column(each) for name, each in (sol.counts or {}).items()},
        t=Column(np.broadcast_to(sol.t, (sol.batch or 0, sol.rows))),
        fields={name: Column(np.asarray(a)) for name, a in sol.fields.items()},
        params=params,
        ok=Column(np.asarray(sol.ok)),
        initial={name: Column(a) for name, a in sol.initial.items()},
    )
    shown.together = sol
    return shown


def single(sol: Solution, lane: int) -> Solution:
    """One trajectory of a batch, with NaN in the rows after its last good one, as in the batch."""
    part = sol[lane : lane + 1]
    return part.replace(
        fields={name: array[0] for name, array in part.fields.items()},
        derived={name: array[0] for name, array in part.derived.items()},
        ok=bool(np.asarray(part.ok)[0]),
        message=part.message[0] if part.message else "",
        params=part.params_of_one,
        batch_params=False,
        initial={name: array[0] if np.ndim(array) == 2 else array for name, array in part.initial.items()},
    )


def _storable(name: str, value: Any) -> np.ndarray:
    """The value as an array, in the next type that stores hold where they do not hold its own. Raises `PointError`."""
    try:
        array = np.asarray(value)
    except Exception as error:
        raise PointError(f"keep must return numbers and arrays, but {name} is none: {in_words(error)}") from error
    if array.dtype.name in TYPES:
        return array
    wider = [kind for kind in ("int64", "float32", "float64") if np.can_cast(array.dtype, kind)]
    if not wider or array.dtype.kind == "c":
        raise PointError(f"keep must return real numbers, but {name} has the dtype {array.dtype}.")
    return array.astype(wider[0])


def _nothing(like: np.ndarray) -> np.ndarray:
    return np.full_like(like, np.nan if like.dtype.kind == "f" else 0)


def _close(a: np.ndarray, b: np.ndarray) -> bool:
    return a.dtype.kind == b.dtype.kind and np.can_cast(a.dtype, b.dtype, "safe") and agree(a, b, SAME)
