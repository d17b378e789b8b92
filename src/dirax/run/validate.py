"""The arguments of a run, checked: each mistake is one error that names the argument, what came and what was expected."""

import functools
import math
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dirax.engines.engine import AbstractEngine
from dirax.engines.policy import ENGINES, engine_of
from dirax.program.user_functions import check_finite, is_traced
from dirax.run.params import params_of_case, plain_floats, refuse_masked
from dirax.run.scalars import finite, is_real, positive
from dirax.schemes.step import AbstractScheme
from dirax.solution.atomic_files import checked_name
from dirax.systems.system import AbstractSystem

ROOM = 4
"""How many times the rows of a run should fit into memory."""

MOST_ITERATIONS = 1_000_000
"""Of Newton's method in a step: what has not converged by then goes round in circles, and a compiled loop hears no Ctrl-C."""

TINIEST = float(np.finfo(float).tiny)
"""The smallest number with all its digits."""

EXACT_STEPS = 2**53
"""Steps up to which a float tells each from the next. Nobody waits for the end of a longer run: of such the start alone is
looked at."""

KINDS = ({"q", "v"}, {"q", "p"}, {"q0", "q1"}, {"x"}, {"q"})


@dataclass(frozen=True)
class Case:
    """What a run begins with: initial data (n,) or (B, n) by name, parameters (with a leading axis B if `batch_params`), the
    step h and the time t0 of the first row. Arrays are NumPy's where no value is traced; `batch` is B, or None."""

    data: Mapping[str, Any]
    params: Any
    h: Any
    t0: Any
    batch: int | None = None
    batch_params: bool = False
    redundant: tuple[int, ...] = ()
    """Of a case with traced values: the constraints that are known to follow from others."""

    @property
    def leaves(self) -> list[Any]:
        """The leaves of the params."""
        return [] if self.params is None else jax.tree.leaves(self.params)

    @property
    def first(self) -> tuple[dict[str, Any], Any]:
        """Data and parameters of the first trajectory."""
        return self.of(0)

    def begins(self, lane: int = 0) -> tuple[dict[str, Any], Any]:
        """Data with the time t0, and parameters, of one trajectory: what the checks of a system and of a step are asked of."""
        data, params = self.of(lane)
        return {**data, "t": np.asarray(self.t0)}, params

    def of(self, lane: int) -> tuple[dict[str, Any], Any]:
        """Data and parameters of one trajectory."""
        params = jax.tree.map(lambda leaf: leaf[lane], self.params) if self.batch_params else self.params
        return {name: a[lane] if a.ndim == 2 else a for name, a in self.data.items()}, params

    @property
    def two_points(self) -> bool:
        """Whether rows 0 and 1 are given, so that the first step leaves row 1."""
        return "q0" in self.data

    @property
    def plain(self) -> bool:
        """Whether all values are numbers and NumPy's arrays."""
        leaves = (*self.data.values(), *self.leaves)
        numbers = type(self.h) is type(self.t0) is float
        return numbers and all([type(leaf) is np.ndarray for leaf in leaves])

    @property
    def traced(self) -> bool:
        """Whether any value is traced by JAX."""
        return is_traced(self.data, self.params, self.h, self.t0)


def validated_case(given: dict[str, Any], params: Any, batch_params: bool, step: Any, t0: Any) -> Case:
    """The case of initial data by name, None for those that were not given."""
    h, t0 = positive(step, "step"), finite(t0, "t0")
    data, batch = initial_data({name: a for name, a in given.items() if a is not None})
    params = params_of_case(params)
    return Case(data, params, h, t0, batch_size(batch, params, batch_params), batch_params)


def first_time(system: AbstractSystem, data: Mapping[str, Any], t0: Any) -> Any:
    """The time of the first row: `t0`, and where the time is a coordinate of the system what that is. Raises `ValueError` where
    both are given and differ."""
    if not system.has_clock or is_traced(clock := system.clock(data), t0):
        return t0
    times = np.ravel(clock)
    if np.any(wrong := times != t0) and t0 != 0.0:
        raise ValueError(
            f"t0 is {t0:.9g}, but the time is a coordinate of this system, and {times[wrong][0]:.9g} at the start: leave t0 out."
        )
    if np.any(other := times != times[0]):
        raise ValueError(
            "trajectories of a batch have the same times, but the time is a coordinate of this system, "
            f"{times[0]:.9g} in the first one and {times[other][0]:.9g} in another: run them one by one."
        )
    return float(times[0])


def check_kinds(system: Any, scheme: Any) -> None:
    """Raise `TypeError` for a system or a scheme that is none."""
    for value, kind, name, example in (
        (system, AbstractSystem, "system", "dx.LagrangeDirac(…)"),
        (scheme, AbstractScheme, "scheme", "dx.PlusLagrangeDirac()"),
    ):
        if not isinstance(value, kind):
            came = f"the class {value.__name__} itself" if isinstance(value, type) else f"{value!r:.80}"
            hint = ": add parentheses" if isinstance(value, type) else ""
            raise TypeError(f"{name} must be a dirax {name} such as {example}, but {came} was given{hint}.")


def engine_from(engine: str | AbstractEngine) -> AbstractEngine:
    """The engine that is meant by its name, or itself."""
    if isinstance(engine, AbstractEngine):
        return engine
    if isinstance(engine, str) and engine in ENGINES:
        return engine_of(engine)
    if isinstance(engine, type) and issubclass(engine, AbstractEngine):
        raise TypeError(f"engine must be a name or an engine, but the class {engine.__name__} itself was given: add parentheses.")
    names = ", ".join(map(repr, ENGINES))
    raise ValueError(f"engine must be one of {names}, or a dx.AbstractEngine, but {engine!r} was given.")


def initial_data(given: dict[str, Any]) -> tuple[dict[str, Any], int | None]:
    """The initial data as float64 arrays of shape (n,) or (B, n), NumPy's where no value is traced, and B (None for one
    trajectory)."""
    if set(given) not in KINDS:
        came = ", ".join(f"{name}=" for name in sorted(given)) + (" alone" if len(given) == 1 else "")
        raise ValueError(
            f"initial data must be one of q=, v= · q=, p= · q0=, q1= · x=, but {came if given else 'none'} was given."
        )
    arrays = {name: _real_array(name, value) for name, value in given.items()}
    if len({array.shape for array in arrays.values()}) == 1 and next(iter(arrays.values())).ndim == 1:
        return arrays, None
    shapes = {name: array.shape for name, array in arrays.items()}
    if len({shape[-1] for shape in shapes.values()}) > 1:
        a, b = shapes
        raise ValueError(f"{a} and {b} must have the same length n, but their shapes are {shapes[a]} and {shapes[b]}.")
    batches = {shape[0] for shape in shapes.values() if len(shape) == 2}
    if len(batches) > 1:
        a, b = shapes
        raise ValueError(
            f"{a} and {b} must hold the same number of trajectories, but their shapes are {shapes[a]} and {shapes[b]}."
        )
    batch = batches.pop() if batches else None
    if batch is not None:
        arrays = {name: spread(a, batch) for name, a in arrays.items()}
    return arrays, batch


def spread(array: Any, batch: int) -> Any:
    """With an axis of the batch."""
    return (jnp if is_traced(array) else np).broadcast_to(array, (batch, array.shape[-1]))


def _real_array(name: str, value: Any) -> Any:
    if (array := plain_floats(value)) is not None and array.ndim in (1, 2) and array.size:
        return array
    try:
        array = jnp.asarray(value) if is_traced(value) else np.asarray(value)
    except ValueError as error:
        reason = str(error).split(". ")[0].rstrip(".")
        raise ValueError(f"{name} must be an array of numbers, but it could not be made one: {reason}.") from error
    refuse_masked(value, name)
    if not is_real(array.dtype):
        raise TypeError(f"{name} must hold real numbers, but its dtype is {array.dtype}.")
    if array.ndim not in (1, 2) or 0 in array.shape:
        raise ValueError(f"{name} must have shape (n,), or (B, n) for a batch of B trajectories, but its shape is {array.shape}.")
    check_finite(name, array)
    return array.astype(np.float64)


def refuse_more_than_memory(problem: Any) -> None:
    """Raise `ValueError` for a run whose saved rows are more than this machine can hold."""
    there, row = _memory(), 8 * (problem.batch or 1) * problem.row_size
    if there and problem.rows * row > there:
        every = -(-problem.steps * row * ROOM // there)
        raise ValueError(
            f"the {problem.rows} rows of this run would take {problem.rows * row / 2**30:.3g} GiB, and this machine has "
            f"{there / 2**30:.3g} GiB: save fewer of them, with save_every={max(every, 2)} for instance."
        )


def checked_store(to: Any, events: Any, traced: bool) -> Path | None:
    """The path of a store to write, None where there is to be none. Raises `TypeError` for what is no path, `ValueError` for
    another ending, and with events and values that JAX traces."""
    if to is None:
        return None
    if not isinstance(to, str | os.PathLike):
        raise TypeError(f'to must be the path of a zarr store such as "run.zarr", but {to!r:.80} was given.')
    path = Path(to)
    checked_name(path)
    if path.suffix != ".zarr":
        raise ValueError(f"to must be the path of a zarr store that ends in .zarr, but {str(to)!r} was given.")
    if events:
        raise ValueError(
            "events= need every row in memory while they are looked for, and to= keeps none: leave one of them out, and save a "
            "run with events by sol.save."
        )
    if traced:
        raise ValueError("under jax.grad, jit and vmap nothing can be written to the disk: leave to= out.")
    return path


@functools.cache
def _memory() -> int:
    """The bytes of memory of this machine; 0 where they are not known."""
    try:
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (AttributeError, OSError, ValueError):
        return 0


def refuse_clock_that_stands(t0: Any, h: Any, steps: int) -> None:
    """Raise `ValueError` for a step that is no normal number, and for one that is less than the times of the run are apart in
    floats: t + h = t, or another step."""
    if not (type(t0) is type(h) is float) and is_traced(t0, h):
        return
    if h < TINIEST:
        raise ValueError(
            f"step must be at least {TINIEST:.3g}, the smallest number with all its digits, but {h!r} was given: "
            "choose a larger unit of time."
        )
    end = t0 + steps * h if steps < EXACT_STEPS else t0
    if not math.isfinite(end):
        raise ValueError(f"the run would end at t = t0 + steps·step = {end}: take fewer steps, smaller ones, or another t0.")
    at = end if abs(end) > abs(t0) else t0
    if math.ulp(at) > h:
        raise ValueError(
            f"the times of this run are as large as {at:.6g}, where floats are {np.spacing(abs(at)):.3g} apart, and a step of "
            f"{h:.3g} is lost in them (t + h = t, or another step): take a larger step, or count time from a t0 near 0."
        )


def batch_size(batch: int | None, params, batch_params: bool) -> int | None:
    """The number of trajectories, of the data and of the params; None for one. Raises `ValueError` where they differ."""
    if not batch_params:
        return batch
    shapes = [np.shape(leaf) for leaf in jax.tree.leaves(params)]
    if not shapes or () in shapes or len({shape[0] for shape in shapes}) > 1:
        raise ValueError(
            "with batch_params=True every leaf of params needs the same leading batch axis, but "
            + (f"their shapes are {', '.join(map(str, shapes))}." if shapes else "params has no leaves.")
        )
    size = shapes[0][0]
    if batch not in (None, size):
        raise ValueError(
            f"the initial data are a batch of {batch} and the leaves of params a batch of {size}: they must be equal."
        )
    return size
