"""simulate(): validate → discretize → start → engine → Solution, each once."""

from typing import Any

import jax
import jax.numpy as jnp

from dirax.engines.contract import Problem
from dirax.engines.engine import AbstractEngine
from dirax.program.user_functions import is_traced
from dirax.run.final_manifold import (
    is_singular,
    projected_onto_manifold,
    refuse_leaving_final_manifold,
    refuse_off_final_manifold,
)
from dirax.run.progress import reporting
from dirax.run.redundancy import redundant_constraints
from dirax.run.refused_start import refuse_bad_start
from dirax.run.result import solution_of
from dirax.run.start import begun, completed
from dirax.run.validate import (
    MOST_ITERATIONS,
    check_kinds,
    count,
    engine_from,
    refuse_clock_that_stands,
    refuse_more_than_memory,
    validated_case,
)
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
    engine: str | AbstractEngine = "auto",
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
    the initial point alone, a Lagrangian singular together with its constraints ([PY] (21)), data off the final manifold of a
    singular Lagrangian, and compositions of steps that leave it.
    A run that fails midway, or is stopped by Ctrl-C, raises nothing: what was computed is
    kept, and `Solution.ok` and `.message` say what happened.
    """
    # validate
    check_kinds(system, scheme)
    on, steps, save_every = engine_from(engine), count(steps, "steps"), count(save_every, "save_every")
    max_iterations = count(max_iterations, "max_iterations", MOST_ITERATIONS)
    case = validated_case({"q": q, "v": v, "p": p, "q0": q0, "q1": q1, "x": x}, params, batch_params, step, t0)
    refuse_clock_that_stands(case.t0, case.h, steps)
    system = system if inputs is None else system.with_inputs(inputs)
    data, own = case.first
    # discretize: constraints that follow from others at the completed data are left out of the equation
    shape, redundant, singular = Shape(*system.sizes(data, own)), (), False
    initial = completed(system, case, project, on.compiles_start)
    if not (traced := case.traced or is_traced(initial)):
        redundant = redundant_constraints(system, initial.constraints, data, own, case.t0)
        if (
            (singular := is_singular(system, shape, case, initial))
            and project
            and (moved := projected_onto_manifold(system, case, initial))
        ):
            case, initial = moved, completed(system, moved, False, on.compiles_start)
    shape = Shape(shape.n, shape.m, shape.c, redundant=redundant) if redundant else shape
    equation = make_step_equation(scheme, system, shape)
    # start
    start = begun(equation, case, initial, on.compiles_start)
    # user functions that close over a traced value make the start traced although nothing that was passed is
    if not (traced := traced or is_traced(start)):
        for stage in dict.fromkeys(stage.check for stage, _ in equation.stages):
            stage(data, case.h, own)
        refuse_bad_start(system, initial, start, equation.stages[0][0].labels, check_initial, singular)
        if check_initial and singular:
            refuse_off_final_manifold(system, case, initial)
        if check_initial:
            refuse_leaving_final_manifold(system, equation, shape, case, initial, start, singular)
    problem = Problem(
        equation=equation,
        state=start.state,
        guess=start.guess,
        h=case.h,
        t0=case.t0,
        steps=steps - int(case.two_points),
        save_every=min(save_every, max(1, steps - int(case.two_points))),
        first_step=int(case.two_points),
        params=jax.tree.map(jnp.asarray, case.params) if traced else case.params,
        batch=case.batch,
        batch_params=batch_params,
        max_iterations=max_iterations,
        compensated=bool(compensated),
    )
    refuse_more_than_memory(problem)
    # engine
    with reporting(False if traced else progress, steps) as report:
        outcome = on.run_traced(problem) if traced else on.run(problem, report)
    if redundant:
        outcome.notes["redundant_constraints"] = list(redundant)
    return solution_of(system, scheme, case, problem, outcome, start.row0, traced)
