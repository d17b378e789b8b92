"""simulate(): check what was given, begin, pick the engine, run, and hand back a Solution."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dirax.engines import xla
from dirax.engines.result import OK, Outcome, Problem, saved_steps
from dirax.failures import explain
from dirax.functions import check_finite, is_traced
from dirax.initial import initial_data, prepared, refuse_off_constraint, refuse_singular_start
from dirax.progress import reporting
from dirax.schemes.step import AbstractScheme, Shape, make_step_equation
from dirax.solution import Solution
from dirax.systems.system import AbstractSystem

ENGINES = ("auto", "xla")


def simulate(
    system: AbstractSystem,
    scheme: AbstractScheme,
    *,
    step: float,
    steps: int,
    q: Any = None,
    v: Any = None,
    p: Any = None,
    q0: Any = None,
    q1: Any = None,
    x: Any = None,
    params: Any = None,
    batch_params: bool = False,
    save_every: int = 1,
    engine: str = "auto",
    progress: Any = False,
    project: bool = False,
    check_initial: bool = True,
    t0: float = 0.0,
    max_iterations: int = 50,
) -> Solution:
    """Run `scheme` on `system` for `steps` steps of size `step` and return the Solution.

    Initial data: `q=, v=` · `q=, p=` · `q0=, q1=` (rows 0 and 1 as they are) · `x=`; each of shape (n,), or (B, n) for a
    batch of B trajectories. `params` is handed to user functions that take it; with `batch_params` its leaves have the
    batch axis too. Rows are saved every `save_every` steps, the last one always. `step` and `t` have the user's unit of
    time. `progress`: True for a bar, or a function of (steps done, steps in all). `project` moves initial data onto the
    constraint; `check_initial=False` accepts data off it as they are.

    Under `jax.grad`, `jit` or `vmap` the run is one differentiable scan, and values are not checked.

    Raises `ValueError` or `TypeError`, naming the argument, for wrong shapes, dtypes and arities, values that are not
    finite, `step` ≤ 0, `steps` < 1, data off the constraint, dependent one-forms, and a Lagrangian singular together with
    its constraints ([PY] (21)). A run that fails midway raises nothing: see `Solution.ok` and `.message`.
    """
    _check_kinds(system, scheme, engine)
    h, steps, save_every = _positive(step, "step"), _count(steps, "steps"), _count(save_every, "save_every")
    given = {"q": q, "v": v, "p": p, "q0": q0, "q1": q1, "x": x}
    data, batch = initial_data({k: a for k, a in given.items() if a is not None})
    params = jax.tree.map(lambda leaf: jnp.asarray(leaf) if _is_number(leaf) else leaf, params)
    check_finite("params", params)
    batch = _batch_size(batch, params, batch_params)
    traced = is_traced(data, params, step)

    one = {k: a[0] if a.ndim == 2 else a for k, a in data.items()}
    one_params = jax.tree.map(lambda leaf: leaf[0], params) if batch_params else params
    shape = Shape(*system.sizes(one, one_params))
    equation = make_step_equation(scheme, system, shape)
    start = prepared(system, equation, data, params, h, batch, batch_params, project)
    if not traced:
        if check_initial:
            refuse_off_constraint(start, project)
        refuse_singular_start(equation, start, h, t0, params, batch, batch_params)
    problem = Problem(
        equation=equation,
        state=start.state,
        guess=(start.guess,) * len(equation.stages),
        h=h,
        t0=t0,
        steps=steps - start.first_step,
        save_every=save_every,
        first_step=start.first_step,
        params=params,
        batch=batch,
        batch_params=batch_params,
        max_iterations=max_iterations,
    )
    if traced:
        outcome = xla.run_traced(problem)
    else:
        with reporting(progress, steps) as report:
            outcome = xla.run(problem, report)
    return _solution(system, scheme, problem, outcome, start, data, traced)


def _solution(system, scheme, problem: Problem, outcome: Outcome, start, data, traced: bool) -> Solution:
    p = problem
    info = p.equation.stages[0][0].fields
    fields, numbers = dict(outcome.fields), saved_steps(p)
    ok, message = True, ""
    if not traced:
        good = np.asarray(outcome.completed)
        failed = np.asarray(outcome.status) != OK
        messages = [
            explain(p, outcome, lane) if failed[lane] or outcome.interrupted else "" for lane in range(len(good))
        ]
        incomplete = good < p.steps
        if p.batch is None:
            ok, message = not incomplete[0], messages[0]
            if incomplete[0]:
                fields, numbers = _truncated(fields, outcome.closing, info, numbers, int(good[0]))
        else:
            ok, message = ~incomplete, messages
            _blank(fields, info, numbers, good)
    numbers = numbers + p.first_step
    if start.row0 is not None:  # a two-point start: row 0 is given, not computed
        fields = {k: _prepend(a, start.row0[k], traced) for k, a in fields.items()}
        numbers = np.concatenate([[0], numbers])
    if p.batch is None:
        fields = {k: a[0] for k, a in fields.items()}
    array = jnp.asarray if is_traced(p.h) else np.asarray
    stats = {
        "engine": outcome.engine,
        "steps": p.steps + p.first_step,
        "newton_iterations": _reduced(outcome.iterations, jnp.sum, traced),
        "max_residual": _reduced(outcome.max_residual, jnp.max, traced),
        "compile_seconds": outcome.compile_seconds,
        "run_seconds": outcome.run_seconds,
        **outcome.notes,
    }
    return Solution(
        t=p.t0 + array(numbers * p.h),
        fields=fields,
        field_info=info,
        step=p.h,
        save_every=p.save_every,
        stats=stats,
        ok=ok,
        message=message,
        system=system,
        scheme=scheme,
        equation=p.equation,
        params=p.params,
        batch_params=p.batch_params,
        initial=data,
    )


def _truncated(fields, closing, info, numbers, completed: int):
    """One trajectory cut after its last good step, which is added as a row if it was not to be saved."""
    rows = int(np.searchsorted(numbers, completed, side="right"))
    off_grid = numbers[rows - 1] != completed
    cut = {}
    for name, values in fields.items():
        node = info[name].place == "node"
        kept = values[:, : rows if node or off_grid else rows - 1]
        if node and not off_grid:
            kept = np.concatenate([kept[:, :-1], closing[name][:, None]], axis=1)
        elif node:
            kept = np.concatenate([kept, closing[name][:, None]], axis=1)
        cut[name] = kept
    return cut, np.append(numbers[:rows], completed) if off_grid else numbers[:rows]


def _blank(fields, info, numbers, completed) -> None:
    """NaN in the rows of a batch that lie after a trajectory's last good step."""
    for name, values in fields.items():
        reached = numbers if info[name].place == "node" else numbers[1:]
        values[completed[:, None] < reached[None, :]] = np.nan


def _prepend(values, first, traced: bool):
    join = jnp.concatenate if traced else np.concatenate
    return join([first[:, None], values], axis=1)


def _reduced(values, reduce, traced: bool):
    return reduce(values) if traced else float(reduce(np.asarray(values))) if reduce is jnp.max else int(np.sum(values))


def _check_kinds(system, scheme, engine) -> None:
    if not isinstance(system, AbstractSystem):
        raise TypeError(
            f"system must be a dirax system such as dx.LagrangeDirac(…), but a {type(system).__name__} was given."
        )
    if not isinstance(scheme, AbstractScheme):
        hint = " (a class, not an instance: add parentheses)" if isinstance(scheme, type) else ""
        raise TypeError(
            f"scheme must be a dirax scheme such as dx.PlusLagrangeDirac(), but {scheme!r} was given{hint}."
        )
    if engine not in ENGINES:
        raise ValueError(f"engine must be one of {', '.join(map(repr, ENGINES))}, but {engine!r} was given.")


def _positive(value, name: str):
    if is_traced(value):
        return value
    if not _is_number(value) or np.ndim(value) != 0 or not np.isfinite(value) or value <= 0:
        raise ValueError(f"{name} must be a positive finite number, but {value!r} was given.")
    return float(value)


def _count(value, name: str) -> int:
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < 1:
        raise ValueError(f"{name} must be a whole number ≥ 1, but {value!r} was given.")
    return int(value)


def _is_number(leaf) -> bool:
    return isinstance(leaf, int | float | np.ndarray | np.generic | jax.Array) and not isinstance(leaf, bool)


def _batch_size(batch: int | None, params, batch_params: bool) -> int | None:
    if not batch_params:
        return batch
    sizes = {np.shape(leaf)[:1] for leaf in jax.tree.leaves(params)}
    if len(sizes) != 1 or sizes == {()}:
        raise ValueError(
            "with batch_params=True every leaf of params needs the same leading batch axis, but their shapes are "
            f"{[np.shape(leaf) for leaf in jax.tree.leaves(params)]}."
        )
    (size,) = sizes.pop()
    if batch not in (None, size):
        raise ValueError(
            f"the initial data are a batch of {batch} and the leaves of params a batch of {size}: they must be equal."
        )
    return size
