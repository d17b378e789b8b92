"""What is kept of each trajectory: its saved rows, or what the user's `keep` makes of them where they were computed."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from dirax.solution.solution import Solution
from dirax.solution.stored import TYPES
from dirax.solution.trajectory import BLOCK
from dirax.sweeps.axes import PointError, described
from dirax.sweeps.case import Values, in_words

SAME = 1e-9
"""How far the result for several trajectories may be from those for each, relative to the size of the numbers."""


@dataclass(frozen=True, eq=False)
class Keep:
    """`function(sol)` of the Solution of one trajectory, a dict of numbers and arrays; `together` where it gives the same, with
    an axis in front, for that of a batch. Without a function the saved rows are kept."""

    function: Callable | None
    together: bool = False
    like: Any = None

    @classmethod
    def of(cls, function: Any) -> "Keep":
        """A user's function, or None. Raises `TypeError` for anything else."""
        if function is not None and not callable(function):
            raise TypeError(
                f"keep must be a function of a solution that returns a dict of arrays, but {function!r:.60} was given."
            )
        return cls(function)

    def chosen(self, sol: Solution, values: Values) -> "Keep":
        """The same as it is to be called, by the trajectories of a batch at these points. Raises `PointError`."""
        if self.function is None:
            return self
        ones = [self._of_one(sol, lane, values) for lane in range(sol.batch or 0)]
        like = ones[0]
        settled = replace(self, like=like)
        each = settled._stacked(sol, ones, values)
        try:
            found = self.function(sol)
            arrays = {name: np.asarray(value) for name, value in found.items()}
        except Exception:
            return settled
        together = arrays.keys() == each.keys() and all(_close(arrays[name], each[name]) for name in each)
        return replace(settled, together=together)

    def at(self, sol: Solution, values: Values) -> dict[str, np.ndarray]:
        """What is kept of a batch, arrays (B, …) by name. Raises `PointError`."""
        if self.function is None:
            return {name: np.asarray(array) for name, array in sol.fields.items()}
        size = sol.batch or 0
        if not self.together:
            return self._stacked(sol, [self._of_one(sol, lane, values) for lane in range(size)], values)
        most = max(1, BLOCK // sol.rows)  # up to here a quantity is computed in the same way, whatever the size of the batch
        parts = [sol if size <= most else sol[low : low + most] for low in range(0, size, most)]
        found = [self._of_batch(part, values, k * most) for k, part in enumerate(parts)]
        return {name: np.concatenate([part[name] for part in found]) for name in self.like}

    def _of_batch(self, sol: Solution, values: Values, first: int) -> dict[str, np.ndarray]:
        try:
            found = self.function(sol)  # type: ignore[misc]
            return {name: np.asarray(found[name]).astype(like.dtype) for name, like in self.like.items()}
        except Exception as error:
            raise PointError(f"keep fails for the trajectories from {described(values, first)} on: {in_words(error)}") from error

    def _of_one(self, sol: Solution, lane: int, values: Values) -> dict[str, np.ndarray]:
        try:
            found = self.function(single(sol, lane))  # type: ignore[misc]
        except Exception as error:
            if self.like is not None and not np.asarray(sol.ok)[lane]:
                return {}
            raise PointError(f"keep fails for the trajectory at {described(values, lane)}: {in_words(error)}") from error
        if not isinstance(found, Mapping) or not found or not all(isinstance(name, str) for name in found):
            raise PointError(f"keep must return a dict of numbers and arrays, but it returned {found!r:.60}.")
        arrays = {name: np.asarray(value) for name, value in found.items()}
        for name, array in arrays.items():
            if array.dtype.name not in TYPES:
                raise PointError(f"keep must return numbers, but {name} has the dtype {array.dtype}.")
        return arrays

    def _stacked(self, sol: Solution, ones: list[dict[str, np.ndarray]], values: Values) -> dict[str, np.ndarray]:
        form = lambda one: {name: array.shape for name, array in one.items()}
        for lane, one in enumerate(ones):
            if form(one) == form(self.like):
                continue
            if np.asarray(sol.ok)[lane]:
                raise PointError(
                    f"keep must return arrays of one shape for all trajectories, but at {described(values, lane)} it returned "
                    f"{form(one)}, and {form(self.like)} elsewhere."
                )
            ones[lane] = {name: _nothing(like) for name, like in self.like.items()}
        return {name: np.stack([one[name] for one in ones]).astype(like.dtype) for name, like in self.like.items()}


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


def _nothing(like: np.ndarray) -> np.ndarray:
    return np.full_like(like, np.nan if like.dtype.kind == "f" else 0)


def _close(a: np.ndarray, b: np.ndarray) -> bool:
    return a.shape == b.shape and a.dtype.kind == b.dtype.kind and bool(np.allclose(a, b, rtol=SAME, atol=SAME, equal_nan=True))
