"""simulate(): what a user calls to run a scheme on a system."""

import time
from dataclasses import replace
from typing import Any

from dirax.engines.engine import AbstractEngine
from dirax.run.carry_out import carried_out
from dirax.run.settings import stated
from dirax.run.step_search import step_for, tolerable
from dirax.schemes.step import AbstractScheme
from dirax.solution.solution import Solution
from dirax.systems.system import AbstractSystem


def simulate(
    system: AbstractSystem,
    scheme: AbstractScheme,
    *,
    step: float | None = None,
    steps: int,
    tolerance: float | None = None,
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
    engine: str | AbstractEngine = "auto",
    progress: Any = False,
    project: bool = False,
    check_initial: bool = True,
    t0: float = 0.0,
    max_iterations: int = 50,
    compensated: bool = False,
    events: Any = (),
    to: Any = None,
) -> Solution:
    """Run `scheme` on `system` for `steps` steps of size `step` and return the Solution.

    Initial data: `q=, v=` · `q=, p=` · `q0=, q1=` (rows 0 and 1 as they are) · `x=`; each of shape (n,), or (B, n) for a
    batch of B trajectories. `params` is handed to user functions that take it, a pytree of numbers and arrays, in which
    dataclasses count as pytrees; with `batch_params` its leaves have the batch axis too. Rows are saved every `save_every`
    steps, the last one always. `step` and `t` have the user's unit of time, and `t0` is the time of the first row.
    `inputs(t, x[, params])` drives an open port-Hamiltonian system.
    `tolerance` in place of `step`: the step is found whose error over its first eight steps, by two half steps each, is
    between a quarter of the tolerance and the tolerance, relative to the largest entry of q, p or x there, of a batch in its
    worst trajectory; the error of a whole run grows beyond. It is `sol.step`, and `sol.stats` has `tolerance_error` and
    `tolerance_trials`.
    `progress`: True for a bar, or a function of (steps done, steps in all). `project` moves initial data onto the
    constraint; `check_initial=False` accepts data off it as they are. `max_iterations` bounds Newton's iterations a step.
    `compensated` keeps what rounding takes from the state and gives it back at the next step (Kahan), so that conserved
    quantities do not drift over very long runs.
    `events`: a list of `dx.Event`, whose zeros are found inside the steps and stand in `sol.events`; a terminal one ends the
    trajectory there, which is no failure: `sol.ok` stays true, and `sol.message` says so. Every row is held while they are
    looked for.
    `to`: the path of a zarr store ("run.zarr") that rows are written to while the run goes on, so that memory does not grow with
    their number. Fields of the Solution are arrays there, of which what is indexed is read. Whatever ends the run, the store
    keeps it up to the last five seconds, `dx.load` opens it, and the same call, or one of more steps, goes on with the bits of
    one run; one that is complete is opened. `sol.extend` goes on, too.

    Under `jax.grad`, `jit` or `vmap` the run is differentiable on both engines, and values are not checked.

    Constraints of a Lagrangian system that follow from others where the run begins are left out of its equations:
    `sol.stats["redundant_constraints"]` numbers them in the order of `sol.multipliers`, where theirs are zero, and their
    residual is saved with the others. Under a JAX transformation they are found from the numbers that JAX knows: under `jax.grad`
    always, under `jit` and `vmap` where the constraints depend on no traced value. A run whose redundant constraints are not
    found fails.

    Raises `ValueError` or `TypeError`, naming the argument, for wrong shapes, dtypes and arities, values that are not
    finite, `step` ≤ 0, `step` and `tolerance` both or neither, `steps` < 1, data off the constraints, constraints that
    contradict each other, that are dependent at the initial point alone, a Lagrangian singular together with its constraints
    ([PY] (21)), data off the final manifold of a singular Lagrangian, and compositions of steps that leave it.
    With `to`, `OSError` where the store cannot be written, `ValueError` for that of another run, and with `events`.
    A run that fails midway, or is stopped by Ctrl-C, raises nothing: what was computed is
    kept, and `Solution.ok` and `.message` say what happened.
    """
    entered = time.perf_counter()
    found: dict[str, Any] = {}
    if (step is None) == (tolerance is None):
        raise ValueError(
            "one of step= and tolerance= must be given, " + ("and both were." if step is not None else "and none was.")
        )
    settings, case, steps, save_every = stated(
        system, scheme, 1.0 if step is None else step, steps, {"q": q, "v": v, "p": p, "q0": q0, "q1": q1, "x": x}, inputs,
        params, batch_params, save_every, engine, project, check_initial, t0, max_iterations, compensated, events, to,
    )  # fmt: skip
    if tolerance is not None:
        h, found = step_for(carried_out, settings, case, tolerable(tolerance))
        case = replace(case, h=h)
    sol = carried_out(settings, case, steps, save_every, progress, entered=entered)
    sol.stats |= found
    return sol
