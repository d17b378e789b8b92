"""The motion by explicit equations, solved by extrapolation: a reference that shares nothing with schemes but the system.

The equations of motion are those of `diagnostics/bench/ode.py`, solved for the derivatives with the multipliers eliminated, and
integrated by Gragg's midpoint rule with extrapolation in h² (Hairer, Nørsett, Wanner I, §II.9).
"""

import functools
import itertools
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dirax.diagnostics.bench.ode import ExplicitODE, completed, explicit_ode
from dirax.diagnostics.bench.subject import Skipped
from dirax.program.evaluation.functions import in_numpy
from dirax.program.memo import Same
from dirax.run.event import Event, checked_events
from dirax.run.impact import Impact
from dirax.systems.phase_space import PhaseSpaceLagrangian
from dirax.systems.system import AbstractSystem

TOLERANCE = 1e-13
"""Error of a step, relative to the largest value of each component so far."""

COLUMNS = 9
"""Of the extrapolation: orders up to 18."""

MOST_EVALUATIONS = 3_000_000
"""Of the derivative, a few seconds. Equations that need more are stiff, or go on for long."""

FIRST_EVALUATIONS = 20_000
"""After so many it is foreseen how many the whole takes."""

MOST_COMPILED = 10_000
"""Operations of the derivative from which on XLA is sooner ready, which has products of matrices."""

MOST_BY_JAX = 200_000
"""The same where XLA evaluates it."""

GIVEN = ("q", "v", "p", "x")


@dataclass(frozen=True)
class ExplicitSolution:
    """t (rows,) ↦ {"q": …, "p": …} or {"x": …}, arrays (rows, n), of one system with initial data at t0."""

    system: AbstractSystem
    ode: ExplicitODE
    params: Any
    t0: float
    label: str = "the explicit equations of motion"

    def __call__(self, t: np.ndarray) -> dict[str, np.ndarray]:
        """Raises `Skipped` where the equations cannot be solved in reasonable time."""
        times = np.asarray(t, float).tobytes()
        if times not in self._found:  # those of a comparison are asked for once for each scheme
            self._found[times] = self._solved(t)
        return dict(self._found[times])

    @functools.cached_property
    def _found(self) -> dict[bytes, dict[str, np.ndarray]]:
        return {}

    @functools.cached_property
    def _field(self) -> Callable[[float, np.ndarray], np.ndarray]:
        try:
            from dirax.diagnostics.bench.ode_solvers import compiled_field  # imported when it is used
        except ImportError:
            raise Skipped("needs llvmlite") from None
        try:
            return compiled_field(self.ode, MOST_COMPILED)
        except Skipped:  # a root in it, a decomposition, or large matrices
            return _field_by_jax(self.ode)

    def _solved(self, t: np.ndarray) -> dict[str, np.ndarray]:
        y = extrapolated(self._field, self.t0, self.ode.start, t)
        n, params = self.ode.shown, self.params
        lagrangian = self.system.lagrangian_form()
        if lagrangian is not None and len(self.ode.start) == 2 * n:
            momentum = lambda t, q, v: lagrangian.legendre(q, v, params, t)
            rows = [np.asarray(t, float), y[:, :n], y[:, n:]]
            p = in_numpy(momentum, rows, (Same(self), "p"))
            return {"q": y[:, :n], "p": np.asarray(jax.vmap(momentum)(*rows)) if p is None else p}
        return {"q": y} if isinstance(self.system, PhaseSpaceLagrangian) else {"x": y[:, :n]}


def _field_by_jax(ode: ExplicitODE) -> Callable[[float, np.ndarray], np.ndarray]:
    """(t, y) ↦ ẏ compiled by XLA, each evaluation of which takes some 20 µs. Raises `Skipped` after MOST_BY_JAX of them."""
    derivative, evaluations = jax.jit(ode.derivative), itertools.count()

    def field(t: float, y: np.ndarray) -> np.ndarray:
        if next(evaluations) > MOST_BY_JAX:
            raise Skipped(f"they take more than {MOST_BY_JAX} evaluations")
        return np.asarray(derivative(t, y))

    return field


def explicit_solution(system: AbstractSystem, run: Mapping[str, Any]) -> ExplicitSolution:
    """That of a run with these keywords of `dx.simulate`. Raises `Skipped`, with the reason, where there is none."""
    data = {name: jnp.asarray(run[name], float) for name in GIVEN if run.get(name) is not None}
    if run.get("batch_params") or any(a.ndim != 1 for a in data.values()):
        raise Skipped("there are several trajectories")
    if any(isinstance(event, Impact) for event in checked_events(run.get("events") or (), (Event, Impact))):
        raise Skipped("the equations of motion know nothing of walls")
    inputs, params = run.get("inputs"), jax.tree.map(jnp.asarray, run.get("params"))
    system, t0 = system if inputs is None else system.with_inputs(inputs), float(run.get("t0", 0.0))
    if run.get("project"):
        complete = completed(system, {**data, "t": jnp.asarray(t0)}, params, True)
        data = {name: complete[name] for name in ("q", "v", "x") if name in complete and (name != "v" or "q" in complete)}
    try:
        ode = explicit_ode(system, {**data, "t": jnp.asarray(t0)}, params)
    except (KeyError, ValueError, TypeError) as error:
        raise Skipped(f"no explicit equations: {error}") from None
    return ExplicitSolution(system, ode, params, t0)


def extrapolated(field: Callable, t0: float, start: np.ndarray, times: np.ndarray) -> np.ndarray:
    """The solution (times, d) of y' = field(t, y). Raises `Skipped` after MOST_EVALUATIONS, or once they are foreseen: where the
    rounding of the field is above TOLERANCE, no step is short enough for it."""
    t, y, found, evaluations = float(t0), np.array(start, float), [], 0
    largest = np.abs(y)
    step = _first_step(field(t, y), largest, float(times[-1]) - t0)
    for end in np.asarray(times, float):
        while (left := end - t) > 0:
            h = left if step > left / 1.01 else min(step, left / 2)
            new, error, count = _step(field, t, y, h, largest)
            evaluations += count
            share = max((t - t0) / (float(times[-1]) - t0), 1e-300) if evaluations > FIRST_EVALUATIONS else 1.0
            if evaluations > MOST_EVALUATIONS * share or h < 1e-14 * max(abs(t), abs(float(times[-1]))):
                raise Skipped("its explicit equations are stiff, or run into a singularity")
            step = h * min(4.0, max(0.1, 0.9 * (TOLERANCE / max(error, 1e-300)) ** (1 / (2 * COLUMNS - 1))))
            if error <= TOLERANCE:
                t, y = (end if h == left else t + h), new
                largest = np.maximum(largest, np.abs(y))
        found.append(y)
    return np.stack(found)


def _first_step(slope: np.ndarray, sizes: np.ndarray, span: float) -> float:
    """A time in which nothing changes by more than a tenth of the largest component."""
    rate, size = float(np.max(np.abs(slope), initial=0.0)), float(np.max(sizes, initial=0.0))
    return min(span, 0.1 * size / rate) if rate > 0 and size > 0 else span / 100


def _step(field: Callable, t: float, y: np.ndarray, h: float, largest: np.ndarray) -> tuple[np.ndarray, float, int]:
    """(y after h, the error of it, evaluations), with as many columns as the tolerance needs."""
    slope, table, count, error, best = field(t, y), [], 1, np.inf, y
    sizes = np.maximum(np.maximum(largest, h * np.abs(slope)), 1e-16 * np.max(largest, initial=1e-300))
    for column in range(1, COLUMNS + 1):
        n = 2 * column
        before, now = y, y + h / n * slope
        for i in range(1, n):
            before, now = now, before + 2 * h / n * field(t + i * h / n, now)
        count += n - 1
        row = [now]
        for j, (last, low) in enumerate(zip(table, range(column - 1, 0, -1), strict=True)):
            row.append(row[j] + (row[j] - last) / ((column / low) ** 2 - 1.0))
        if column > 1:
            with np.errstate(all="ignore"):
                error = float(np.max(np.abs(row[-1] - row[-2]) / sizes))
            error, best = (error if np.isfinite(error) else np.inf), row[-1]
            if error <= TOLERANCE:
                return best, error, count
        table = row
    return best, error, count
