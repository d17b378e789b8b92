"""simulate(): check what was given, begin, pick the engine, run, and hand back a Solution."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dirax.engines.policy import ENGINES, run_on, run_traced_on
from dirax.engines.result import Outcome, Problem, saved_steps
from dirax.program.tracing import once
from dirax.program.user_functions import check_finite, is_traced
from dirax.run.failures import explain
from dirax.run.progress import reporting
from dirax.run.redundancy import redundant_constraints
from dirax.run.start import Start, initial_data, prepared, refuse_bad_start
from dirax.schemes.step import AbstractScheme, Shape, make_step_equation
from dirax.solution.solution import Solution
from dirax.systems.system import AbstractSystem


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
    inputs: Any = None,
    params: Any = None,
    batch_params: bool = False,
    save_every: int = 1,
    engine: str = "auto",
    progress: Any = False,
    project: bool = False,
    check_initial: bool = True,
    t0: float = 0.0,
    max_iterations: int = 50,
    compensated: bool = False,
) -> Solution:
    """Run `scheme` on `system` for `steps` steps of size `step` and return the Solution.

    Initial data: `q=, v=` · `q=, p=` · `q0=, q1=` (rows 0 and 1 as they are) · `x=`; each of shape (n,), or (B, n) for a
    batch of B trajectories. `params` is handed to user functions that take it; with `batch_params` its leaves have the
    batch axis too. Rows are saved every `save_every` steps, the last one always. `step` and `t` have the user's unit of
    time, and `t0` is the time of the first row. `inputs(t, x[, params])` drives an open port-Hamiltonian system.
    `progress`: True for a bar, or a function of (steps done, steps in all). `project` moves initial data onto the
    constraint; `check_initial=False` accepts data off it as they are. `max_iterations` bounds Newton's iterations a step.
    `compensated` keeps what rounding takes from the state and gives it back at the next step (Kahan), so that conserved
    quantities do not drift over very long runs.

    Under `jax.grad`, `jit` or `vmap` the run is differentiable on both engines, and values are not checked.

    Constraints of a Lagrangian system that follow from others where the run begins are left out of its equations:
    `sol.stats["redundant_constraints"]` numbers them in the order of `sol.multipliers`, where theirs are zero, and their
    residual is saved with the others. Under a JAX transformation none are looked for.

    Raises `ValueError` or `TypeError`, naming the argument, for wrong shapes, dtypes and arities, values that are not
    finite, `step` ≤ 0, `steps` < 1, data off the constraints, constraints that contradict each other, that are dependent at
    the initial point alone, and a Lagrangian singular together with its constraints ([PY] (21)).
    A run that fails midway, or is stopped by Ctrl-C, raises nothing: what was computed is
    kept, and `Solution.ok` and `.message` say what happened.
    """
    _check_kinds(system, scheme, engine)
    h, steps, save_every = _positive(step, "step"), _count(steps, "steps"), _count(save_every, "save_every")
    t0, max_iterations = _finite(t0, "t0"), _count(max_iterations, "max_iterations")
    given = {"q": q, "v": v, "p": p, "q0": q0, "q1": q1, "x": x}
    data, batch = initial_data({k: a for k, a in given.items() if a is not None})
    params = _arrays(params)
    check_finite("params", params)
    batch = _batch_size(batch, params, batch_params)
    system = system if inputs is None else system.with_inputs(inputs)

    one: dict[str, Any] = {k: a[0] if a.ndim == 2 else a for k, a in data.items()}
    one_params = jax.tree.map(lambda leaf: leaf[0], params) if batch_params else params

    def begin(shape: Shape):
        equation = make_step_equation(scheme, system, shape)
        return equation, prepared(system, equation, data, params, h, t0, batch, batch_params, project)

    with once():
        shape = Shape(*system.sizes(one, one_params))
        equation, start = begin(shape)
        # user functions that close over a traced value make the start traced although nothing that was passed is
        traced, redundant = is_traced(data, params, h, t0, start), ()
        if not traced:
            equation.stages[0][0].check(one, h, one_params)
            redundant = redundant_constraints(system, start.constraints, one, one_params, t0)
            if redundant:
                equation, start = begin(Shape(shape.n, shape.m, shape.c, redundant=redundant))
            refuse_bad_start(system, start, equation.stages[0][0].labels, check_initial)
    problem = Problem(
        equation=equation,
        state=start.state,
        guess=start.guess,
        h=h,
        t0=t0,
        steps=steps - start.first_step,
        save_every=save_every,
        first_step=start.first_step,
        params=jax.tree.map(jnp.asarray, params) if traced else params,
        batch=batch,
        batch_params=batch_params,
        max_iterations=max_iterations,
        compensated=bool(compensated),
    )
    if traced:
        outcome = run_traced_on(engine, problem)
    else:
        with reporting(progress, steps) as report:
            outcome = run_on(engine, problem, report)
    if redundant:
        outcome.notes["redundant_constraints"] = list(redundant)
    return _solution(system, scheme, problem, outcome, start, data, traced)


def _solution(system, scheme, problem: Problem, outcome: Outcome, start: Start, data, traced: bool) -> Solution:
    p = problem
    info, numbers = p.equation.stages[0][0].fields, saved_steps(p)
    fields: dict[str, Any] = outcome.fields
    closing = outcome.closing
    if traced:
        ok, message = outcome.completed == p.steps, ""
        good = outcome.completed.astype(float)
        fields = {k: _blanked(a, info[k], closing[k], numbers, good, jnp.where) for k, a in fields.items()}
        ok = ok if p.batch is not None else ok[0]
    else:
        good = np.asarray(outcome.completed)
        ended = [lane for lane in range(len(good)) if good[lane] < p.steps]
        last_row = numbers[np.searchsorted(numbers, good, side="right") - 1] if p.batch is not None else good
        message = [""] * len(good)
        for lane in ended:
            message[lane] = explain(p, outcome, lane, kept=int(last_row[lane]))
        ok = good == p.steps
        if p.batch is None:
            ok, message = bool(ok[0]), message[0]
            if ended:
                fields, numbers = _truncated(fields, closing, info, numbers, int(good[0]))
        elif ended:
            for k, a in fields.items():
                a[ended] = _blanked(a[ended], info[k], closing[k][ended], numbers, good[ended], np.where)
    if start.row0 is not None:  # a two-point start: row 0 is given, not computed
        join = jnp.concatenate if traced else np.concatenate
        for k in list(fields):  # one after the other, so that only one array is in memory twice
            fields[k] = join([start.row0[k][:, None], fields.pop(k)], axis=1)
        numbers = np.concatenate([[-1.0], numbers])
    if p.batch is None:
        fields = {k: a[0] for k, a in fields.items()}
    return Solution(
        t=_times(p, numbers, traced),
        fields={k: fields[k] for k in info},
        field_info=info,
        step=p.h,
        save_every=p.save_every,
        stats=_stats(p, outcome, traced),
        ok=ok,
        message=message,
        system=system,
        scheme=scheme,
        equation=p.equation,
        params=p.params,
        batch_params=p.batch_params,
        initial=data,
    )


def _times(p: Problem, numbers, traced: bool):
    """The times of the steps of the given numbers, in the same array where nothing that is traced can hold it."""
    if traced:
        return p.t0 + (numbers + p.first_step) * p.h
    numbers += p.first_step
    numbers *= p.h
    numbers += p.t0
    return numbers


def _truncated(fields, closing, info, numbers, completed: int):
    """One trajectory cut after its last good step, which is added as a row if it was not to be saved."""
    rows = int(np.searchsorted(numbers, completed, side="left"))  # rows before the last good step
    cut = {}
    for name, values in fields.items():
        kept = values[:, :rows]
        cut[name] = np.concatenate([kept, closing[name][:, None]], axis=1) if info[name].place == "node" else kept
    return cut, np.append(numbers[:rows], completed)


def _blanked(values, info, closing, numbers, completed, where):
    """Rows (B, rows, …) of a batch with NaN after each trajectory's last good step, and its closing row there."""
    at = numbers if info.place == "node" else numbers[:-1]
    column = (slice(None), slice(None), *(None,) * (values.ndim - 2))
    if info.place != "node":
        return where((at[None, :] < completed[:, None])[column], values, np.nan)
    kept = where((at[None, :] == completed[:, None])[column], closing[:, None], values)
    return where((at[None, :] <= completed[:, None])[column], kept, np.nan)


def _stats(p: Problem, outcome: Outcome, traced: bool) -> dict[str, Any]:
    xp = jnp if traced else np
    total, worst = xp.sum(outcome.iterations), xp.max(outcome.max_residual)
    return {
        "engine": outcome.engine,
        "steps": p.steps + p.first_step,
        "newton_iterations": total if traced else int(total),
        "max_residual": worst if traced else float(worst),
        "compile_seconds": outcome.compile_seconds,
        "run_seconds": outcome.run_seconds,
        **outcome.notes,
    }


def _check_kinds(system, scheme, engine) -> None:
    for value, kind, name, example in (
        (system, AbstractSystem, "system", "dx.LagrangeDirac(…)"),
        (scheme, AbstractScheme, "scheme", "dx.PlusLagrangeDirac()"),
    ):
        if not isinstance(value, kind):
            came = f"the class {value.__name__} itself" if isinstance(value, type) else f"{value!r:.80}"
            hint = ": add parentheses" if isinstance(value, type) else ""
            raise TypeError(f"{name} must be a dirax {name} such as {example}, but {came} was given{hint}.")
    if engine not in ENGINES:
        raise ValueError(f"engine must be one of {', '.join(map(repr, ENGINES))}, but {engine!r} was given.")


def _finite(value, name: str):
    if is_traced(value):
        return value
    if not _is_number(value) or np.ndim(value) != 0 or not np.isfinite(value):
        raise ValueError(f"{name} must be a finite number, but {value!r} was given.")
    return float(value)


def _positive(value, name: str):
    if not is_traced(value) and (not _is_number(value) or np.ndim(value) != 0 or not 0 < value < np.inf):
        raise ValueError(f"{name} must be a positive finite number, but {value!r} was given.")
    return value if is_traced(value) else float(value)


def _count(value, name: str) -> int:
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < 1:
        raise ValueError(f"{name} must be a whole number ≥ 1, but {value!r} was given.")
    return int(value)


def _is_number(leaf) -> bool:
    if isinstance(leaf, np.ndarray | np.generic | jax.Array):
        return jnp.issubdtype(leaf.dtype, jnp.number)
    return isinstance(leaf, int | float) and not isinstance(leaf, bool)


def _is_boolean(leaf) -> bool:
    return isinstance(leaf, bool) or jnp.issubdtype(getattr(leaf, "dtype", object), jnp.bool_)


def _arrays(params):
    """The pytree with arrays for its leaves: NumPy's where they can be, for JAX's start JAX and compile what takes a part."""
    for path, leaf in jax.tree_util.tree_leaves_with_path(params):
        if not _is_number(leaf) and not _is_boolean(leaf):
            raise TypeError(
                f"params must be a pytree of numbers and arrays, but params{jax.tree_util.keystr(path)} is {leaf!r:.60}: "
                "use such a value in the system's functions directly."
            )
    return jax.tree.map(lambda leaf: jnp.asarray(leaf) if is_traced(leaf) else np.array(leaf), params)


def _batch_size(batch: int | None, params, batch_params: bool) -> int | None:
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
