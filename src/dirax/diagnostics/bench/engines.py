"""The engines of dirax, and the same step in JAX as one would write it."""

import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dirax.diagnostics.bench.subject import Program, Skipped, Subject
from dirax.engines.contract import Outcome, Problem
from dirax.engines.engine import AbstractEngine
from dirax.engines.native import Native
from dirax.engines.xla import Xla
from dirax.program.interpreter import UnsupportedPrimitive
from dirax.schemes.collocation import Collocation

BATCH, BATCH_STEPS = 1024, 50
"""Size of the batches and the steps that each of their trajectories takes."""

STAGES, MOST_HALVINGS = (4, 8), 16
"""Stages of collocation that are tried, each with 2, 4, 8, … steps."""

TOLERANCE, MOST_UPDATES = 1e-14, 20


def native_one(subject: Subject) -> Program:
    """One trajectory in one lane of the native engine."""
    return _one(subject, Native())


def xla_one(subject: Subject) -> Program:
    """One trajectory on the xla engine."""
    return _one(subject, Xla())


def native_batch(subject: Subject) -> Program:
    """A batch on the native engine, in all its lanes and threads."""
    return _batch(subject, Native())


def xla_batch(subject: Subject) -> Program:
    """A batch on the xla engine."""
    return _batch(subject, Xla())


def _one(subject: Subject, engine: AbstractEngine) -> Program:
    problem, last = subject.one.with_numbers(often=True), {}

    def run() -> float:
        last["outcome"] = outcome = engine.run(problem)
        _refuse_failure(outcome, problem)
        return outcome.run_seconds

    run_once(run)
    return Program(run, lambda: np.asarray(last["outcome"].fields[subject.shown][0, -1]), {})


def _batch(subject: Subject, engine: AbstractEngine) -> Program:
    problem, share = _many(subject)

    def run() -> float:
        outcome = engine.run(problem)
        _refuse_failure(outcome, problem)
        return outcome.run_seconds * share

    run_once(run)
    return Program(run, lambda: None, {"trajectories": BATCH, "steps": BATCH_STEPS})


def _many(subject: Subject) -> tuple[Problem, float]:
    """A batch from points along the trajectory, and the share of its time that is that of one run of the subject."""
    rows = Native().run(subject.one.with_numbers(save_every=max(1, subject.steps // BATCH)))
    return subject.batch(rows, BATCH, BATCH_STEPS).with_numbers(often=True), subject.steps / (BATCH * BATCH_STEPS)


def collocation(subject: Subject, reference: np.ndarray, wanted: float) -> Program:
    """`dx.Collocation` on one trajectory, with the stages and the step that reach the wanted error at the end soonest."""
    engine, found = Native(), []
    for stages in STAGES:
        try:
            problem = replace(subject, scheme=Collocation(stages)).one.with_numbers(often=True)
        except (TypeError, ValueError) as error:
            raise Skipped(f"it does not step this system: {str(error).split(':')[0]}") from None
        for steps in (2**k for k in range(1, MOST_HALVINGS)):
            last = replace(problem, h=subject.span / steps, steps=steps, save_every=steps)
            outcome = engine.run(last)
            ended = bool(np.all(np.asarray(outcome.completed) == steps))
            if ended and end_error(np.asarray(outcome.fields[subject.shown][0, -1]), reference) <= wanted:
                found.append((min(engine.run(last).run_seconds for _ in range(3)), stages, last))
                break
    if not found:
        raise Skipped(f"does not reach the error {wanted:.1e}")
    _, stages, chosen = min(found, key=lambda one: one[0])
    last_run: dict[str, Outcome] = {}

    def run() -> float:
        last_run["outcome"] = engine.run(chosen)
        return last_run["outcome"].run_seconds

    run()
    settings = {"stages": stages, "steps": chosen.steps}
    return Program(run, lambda: np.asarray(last_run["outcome"].fields[subject.shown][0, -1]), settings)


def end_error(end: np.ndarray, reference: np.ndarray) -> float:
    """Largest difference, relative to the largest entry of the reference where that is above 1."""
    return float(np.max(np.abs(end - reference)) / max(1.0, float(np.max(np.abs(reference)))))


def run_once(run: Callable[[], float]) -> None:
    """Compile, or raise `Skipped` with the reason why it cannot be."""
    try:
        run()
    except UnsupportedPrimitive as error:
        raise Skipped(str(error)) from None


def _refuse_failure(outcome: Outcome, problem: Problem) -> None:
    if np.any(np.asarray(outcome.completed) < problem.steps):
        raise Skipped("a trajectory ended early")


def plain_jax(subject: Subject) -> Program:
    """`plain_run` of the subject, timed."""
    run, last = plain_run(subject.one), {}

    def timed() -> float:
        tick = time.perf_counter()
        last["end"] = run()
        return time.perf_counter() - tick

    timed()
    return Program(timed, lambda: subject.position(*last["end"]), {"stops at": TOLERANCE})


def plain_jax_batch(subject: Subject) -> Program:
    """The same under `vmap`."""
    problem, share = _many(subject)
    run = plain_run(problem)

    def timed() -> float:
        tick = time.perf_counter()
        run()
        return (time.perf_counter() - tick) * share

    timed()
    return Program(timed, lambda: None, {"stops at": TOLERANCE, "trajectories": BATCH, "steps": BATCH_STEPS})


def plain_run(p: Problem, save: bool = False) -> Callable[[], Any]:
    """A run as one would write it in JAX: `scan`, Newton with `jacfwd` and `jnp.linalg.solve`, linear extrapolation.

    Returns a function to the state and the unknowns at the end (and the states on the way with `save`), for one trajectory
    or, under `vmap`, a batch. Newton stops where an update is 1e-14, or below 1e-9 and no longer halved.
    """
    equation, h, params = p.equation, p.h, p.params

    def newton(state, guess, t):
        residual = lambda u: equation.residual(u, state, t, h, params)

        def body(carry):
            u, update, _, k = carry
            change = jnp.linalg.solve(jax.jacfwd(residual)(u), residual(u))
            return u - change, jnp.max(jnp.abs(change) / (jnp.abs(u) + 1)), update, k + 1

        def going(carry):
            _, update, before, k = carry
            stalled = (update < 1e-9) & (update > before / 2)
            return (update > TOLERANCE) & ~stalled & (k < MOST_UPDATES)

        return jax.lax.while_loop(going, body, (guess, jnp.array(1.0), jnp.array(jnp.inf), 0))[0]

    def step(carry, k):
        state, last, older = carry
        t = p.t0 + h * (k + p.first_step)
        guess = equation.guess(state, 2 * last - older, h, params)
        u = newton(state, guess, t) if equation.unknowns else guess
        return (equation.advance(u, state, t, h, params), u, last), (state if save else None)

    def one(state, guess):
        (state, u, _), states = jax.lax.scan(step, (state, guess, guess), jnp.arange(p.steps, dtype=float))
        return (state, u, states) if save else (state, u)

    compiled = jax.jit(one if p.batch is None else jax.vmap(one))
    state, guess = jnp.asarray(p.state), jnp.asarray(p.guess[0])
    return lambda: jax.block_until_ready(compiled(state, guess))
