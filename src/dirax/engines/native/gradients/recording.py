"""A run as a function of arrays: what its derivatives are derivatives of, and the equation that saves what they need."""

import dataclasses
from typing import Any

import jax.numpy as jnp

from dirax.engines.contract import Problem
from dirax.engines.parameters import Parameters
from dirax.engines.xla.lane import parts_of_row
from dirax.program.memo import Memo, Same
from dirax.schemes.step import Field, StepEquation, StepSequence

KEPT = 128
"""Equations kept in memory."""

INPUTS = 5
"""State (B, s), guess (B, stages, k), parameters (B, m), t0 and h (B,): what a recorded run is a function of."""


class Recorded:
    """A run as a function of arrays, the five inputs. Its results are (B, rows, parts·s) and (B, rows, parts·k): states and
    unknowns of the first stage, or of every one where a row takes them; then good steps, status, Newton updates and largest
    residual (B, 4), and the last unknowns (B, k)."""

    def __init__(self, problem: Problem, leaves: Parameters):
        p = problem
        self.parts = parts_of_row(p.equation)
        self.equation, self.unknowns = recording(p.equation, leaves, self.parts > 1)
        self.every_stage, _ = recording(p.equation, leaves, len(p.equation.stages) > 1)
        self.state_size, self.rows, self.steps = p.equation.stages[0][0].state_size, p.rows, p.steps
        self.numbers: dict[str, Any] = {
            "steps": p.steps,
            "save_every": p.save_every,
            "first_step": p.first_step,
            "max_iterations": p.max_iterations,
            "compensated": p.compensated,
        }

    def problem(self, state, guess, c, t0, h, *, every_stage: bool = False) -> Problem:
        """The run of equal t0 and h; with `every_stage` its rows have every stage."""
        equation = self.every_stage if every_stage else self.equation
        guesses = tuple(guess[:, i, : stage.unknowns] for i, (stage, _) in enumerate(self.equation.stages))
        h, t0, batch = h[0], t0[0], state.shape[0]
        return Problem(equation, state, guesses, h, t0, params=c, batch=batch, batch_params=True, **self.numbers)


_recordings: Memo[tuple[Any, int]] = Memo(KEPT)


def recording(equation: Any, leaves: Parameters, each: bool) -> tuple[Any, int]:
    """The equation with parameters as one array (m,), whose rows are the state and the unknowns, of the first stage or of
    `each` one, and their number, 1 at least; the same object for the same arguments."""
    return _recordings.get((Same(equation), leaves.key, each), lambda: _recording(equation, leaves, "each" if each else "first"))


def _recording(equation: Any, leaves: Parameters, composed: str) -> tuple[Any, int]:
    size, split = max(1, *(stage.unknowns for stage, _ in equation.stages)), leaves.split

    def one(stage: StepEquation) -> StepEquation:
        def unpack(state, u, t, h, c):
            return {"state": state, "unknowns": jnp.concatenate([u, jnp.zeros(size - stage.unknowns)])}

        return dataclasses.replace(
            stage,
            guess=lambda state, previous, h, c: stage.guess(state, previous, h, split(c)),
            residual=lambda u, state, t, h, c: stage.residual(u, state, t, h, split(c)),
            advance=lambda u, state, t, h, c: stage.advance(u, state, t, h, split(c)),
            unpack=unpack,
            fields={
                "state": Field((stage.state_size,), composed=composed),
                "unknowns": Field((size,), composed=composed),
            },
        )

    made = {id(stage): one(stage) for stage, _ in equation.stages}
    return StepSequence(tuple((made[id(stage)], fraction) for stage, fraction in equation.stages)), size
