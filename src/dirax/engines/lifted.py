"""Roots inside of a step as unknowns of it, each with its equation: then every engine has them, and none iterates within.

A step may ask for the root of equations of its own: the velocity of a momentum, the voltages of a circuit, the point that a map
leads to. As a loop within the loop of Newton's method it has no scalar program. Here the root becomes unknowns of the step, what
it is the root of becomes equations, and Newton's method takes all of them at once (the lifted Newton method: Albersmeyer and
Diehl, SIAM J. Optim. 20 (2010)). The first guess is the root itself where the step begins, later that of the step before.
"""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax.core import Tracer

from dirax.engines.parameters import Parameters, parameters
from dirax.engines.policy import LARGEST_NATIVE
from dirax.engines.step_jaxpr import step_jaxpr
from dirax.program.interpreter import UnsupportedPrimitive
from dirax.program.lifted_roots import LiftedJaxpr, Part, Unliftable, has_roots
from dirax.program.memo import Memo, Same
from dirax.schemes.labels import Labels
from dirax.schemes.layout import Layout
from dirax.schemes.step import StepEquation, StepSequence, first_of_each

GUESS, RESIDUAL, ADVANCE, ROWS = range(4)
"""The results of the jaxpr of a step, the rows from the last one on."""

PREVIOUS = 2
"""The number of the operand of it that the residual does not have: the unknowns of the step before."""

SHORT = 2.0**-10
"""Part of a step that hardly moves."""

_lifted: Memo[StepEquation | StepSequence] = Memo(128)


def lifted(equation: Any, params: Any, batch_params: bool) -> Any:
    """The equation of the same step with the roots inside of it among its unknowns; itself where there is none, where they are
    many, not determined by their equations, or in loops or branches, and where its functions read values that JAX traces."""
    try:
        p = parameters(params, batch_params)
    except UnsupportedPrimitive:
        return equation
    stages = (equation.stages[k][0] for k in first_of_each(equation.stages))
    if not any(has_roots(step_jaxpr(stage, p).jaxpr) for stage in stages):
        return equation
    return _lifted.get((Same(equation), p.key), lambda: _made(equation, p))


def _made(equation: Any, p: Parameters) -> Any:
    if isinstance(equation, StepEquation):
        return _of_stage(equation, p)
    made = {id(equation.stages[k][0]): _of_stage(equation.stages[k][0], p) for k in first_of_each(equation.stages)}
    if all(made[id(stage)] is stage for stage, _ in equation.stages):
        return equation
    return StepSequence(tuple((made[id(stage)], fraction) for stage, fraction in equation.stages))


def _of_stage(stage: StepEquation, p: Parameters) -> StepEquation:
    closed = step_jaxpr(stage, p)
    if not has_roots(closed.jaxpr) or any(isinstance(c, Tracer) for c in closed.consts):
        return stage
    try:
        inside = LiftedJaxpr(closed)
    except Unliftable:
        return stage
    if stage.unknowns + inside.size > LARGEST_NATIVE:
        return stage
    step = LiftedStep(stage, p, inside)
    return stage if step.looks_back or not inside.are_regular else step.equation()


class LiftedStep:
    """The functions of a step whose unknowns are those of `stage` and then the roots in it."""

    def __init__(self, stage: StepEquation, p: Parameters, inside: LiftedJaxpr):
        self.stage, self.p, self.inside = stage, p, inside
        rows = range(ROWS, inside.results)
        self._guess, self._advance, self._rows = inside.part(GUESS), inside.part(ADVANCE), inside.part(*rows)
        self._residual = inside.part(RESIDUAL, inside.results)

    @property
    def looks_back(self) -> bool:
        """Whether a root depends on the step before, and not on this one alone."""
        return len(self.inside.kinds) + PREVIOUS in self._residual.used

    def equation(self) -> StepEquation:
        """The equation of the lifted step."""
        stage, kinds, inner = self.stage, self.inside.kinds, self.stage.interpolate
        layout = Layout(**stage.unknown_layout, **{f"root_{j}": a.shape for j, a in enumerate(kinds)})
        labels = (Labels.numbered(f"equation {{}} of root {j} inside of the step", a.size) for j, a in enumerate(kinds))
        interpolate = None if inner is None else lambda theta, u, *others: inner(theta, u[: stage.unknowns], *others)
        return dataclasses.replace(
            stage,
            start=self.start,
            resume=self.start if stage.resume is stage.start else self.resume,
            residual=self.residual,
            advance=self.advance,
            unpack=self.unpack,
            guess=self.guess,
            interpolate=interpolate,
            unknowns=layout.size,
            unknown_layout=layout,
            labels=[*stage.labels, *(name for names in labels for name in names)],
            collocation=None,
            weak=(),
        )

    def start(self, data, h, params):
        """The state and the unknowns where a run begins, the roots found at them."""
        return self._begun(self.stage.start, data, h, params)

    def resume(self, data, h, params):
        """The same where a run goes on."""
        return self._begun(self.stage.resume, data, h, params)

    def _begun(self, begin: Callable, data, h, params):
        state, u = begin(data, h, params)
        # a long step by the guess may lead to where there is no root, as behind a diode
        roots = self.inside.roots(self._step(u, state, data.get("t", 0.0), SHORT * h, params))
        return state, jnp.concatenate([u, *map(jnp.ravel, roots)])

    def guess(self, state, previous, h, params):
        """The guess of the step, with the roots of the step before."""
        (u,) = self._of(self._guess, previous, state, 0.0, h, params)
        return jnp.concatenate([u, previous[self.stage.unknowns :]])

    def residual(self, u, state, t, h, params):
        """What vanishes: the equations of the step, then those of the roots."""
        return jnp.concatenate(self._of(self._residual, u, state, t, h, params))

    def advance(self, u, state, t, h, params):
        """The state after the step."""
        return self._of(self._advance, u, state, t, h, params)[0]

    def unpack(self, state, u, t, h, params):
        """The fields of a row."""
        return dict(zip(sorted(self.stage.fields), self._of(self._rows, u, state, t, h, params), strict=True))

    def _of(self, part: Part, unknowns, state, t, h, params) -> list:
        first = self.stage.unknowns
        return part([*self.inside.split(unknowns[first:]), *self._step(unknowns[:first], state, t, h, params)])

    def _step(self, u, state, t, h, params) -> list:
        """The operands of the jaxpr of the step; the unknowns are those before as well."""
        number = lambda x: jnp.asarray(x, float)
        leaves = zip(jax.tree.leaves(params), self.p.dynamic, strict=True)
        return [u, state, u, number(t), number(h), *(number(leaf) for leaf, moves in leaves if moves)]
