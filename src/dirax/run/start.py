"""Where a run begins: initial data made complete by the system, then the first state and the first step of the equation."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from dirax.program.compiled import compiled
from dirax.program.memo import Same
from dirax.program.user_functions import is_traced
from dirax.run.validate import Case, spread


class Initial(NamedTuple):
    """Initial data as the system completes them, each entry with a leading batch axis in a batch.

    All that a scheme may start from, by name; how far the data are off the constraints, and the sizes of their terms (of two
    points, followed by those of the constraints of their step); the
    Lagrangian and the matrix [W; ∂g/∂q] of the constraints at the data, if the system has them.
    """

    data: dict[str, Any]
    defect: Any
    size: Any
    lagrangian: Any
    constraints: Any


class Start(NamedTuple):
    """Where an equation begins, each entry with a leading batch axis in a batch.

    First state and the first guess of every stage; the given row 0 of a two-point start; the residual and the Jacobian of the
    first step, None for an explicit one.
    """

    state: Any
    guess: tuple
    row0: dict | None
    residual: Any = None
    jacobian: Any = None


def completed(system: Any, case: Case, project: bool, by_jax: bool = False) -> Initial:
    """The initial data of every trajectory, moved onto the constraints with `project`.

    They are found in NumPy from the scalar program of the system's functions, for a compiler takes longer than all that has to
    be computed; by JAX where values are traced, where there is no such program, and with `by_jax`.
    """
    data: dict[str, Any] = dict(case.data)
    if case.batch is not None:  # the batch axis can be that of the parameters alone
        data = {name: spread(a, case.batch) for name, a in data.items()}
    return _of_every(_Completion(system, case.two_points, project), (system,), case, data, by_jax)


def begun(equation: Any, case: Case, initial: Initial, by_jax: bool = False) -> Start:
    """The first state of every trajectory, and the first step at the first guess; `by_jax` as above."""
    if case.two_points and len(equation.stages) > 1:
        raise ValueError("a composition cannot start from q0= and q1=, which belong to one step: give q= with v= or p=.")
    start = _of_every(_Beginning(equation, case.two_points), (equation,), case, initial.data, by_jax)
    if not equation.stages[0][0].unknowns:
        return start
    first = None
    if not by_jax and not case.traced and not is_traced(start):
        first = _first_step_in_numbers(equation, case, start)
    if first is None:
        first = _of_every(_FirstStep(equation, case.two_points), (equation,), case, start._replace(row0=None), True)
    return start._replace(residual=first[0], jacobian=first[1])


class _Completion(eqx.Module):
    """(data, params, h, t0) ↦ the Initial of one trajectory."""

    system: Any
    two_points: bool
    project: bool

    def __call__(self, data, params, h, t0) -> Initial:
        system, complete = self.system, self.system.complete({**data, "t": t0}, params, self.project)
        defect = system.initial_defect({**complete, "t": t0}, params)
        q, v = (data["q0"], (data["q1"] - data["q0"]) / h) if self.two_points else (complete.get("q"), complete.get("v"))
        size, form = jnp.ones(defect.shape), system.lagrangian_form()
        if form is not None and v is not None and form.constraints.any:
            size = form.initial_terms({**complete, "v": v, "t": t0}, params)
        lagrangian = None if q is None or v is None else system.lagrangian_value(t0, q, v, params)
        constraints = system.constraints.matrix(t0, system.point(complete), params) if system.constraints.any else None
        return Initial(complete, defect, size, lagrangian, constraints)


class _Beginning(eqx.Module):
    """(complete data, params, h, t0) ↦ the Start of one trajectory, without the first step."""

    equation: Any
    two_points: bool

    def __call__(self, data, params, h, t0) -> Start:
        complete = {**data, "t": t0}
        (stage, fraction), *others = self.equation.stages
        state, u = stage.start(complete, fraction * h, params)
        guess = (u, *(other.start(complete, part * h, params)[1] for other, part in others))
        if not self.two_points:
            return Start(state, guess, None)
        return Start(stage.advance(u, state, t0, h, params), guess, stage.unpack(state, u, t0, h, params))


class _FirstStep(eqx.Module):
    """(start, params, h, t0) ↦ the residual and the Jacobian of the first step of one trajectory."""

    equation: Any
    two_points: bool

    def __call__(self, start: Start, params, h, t0):
        stage, fraction = self.equation.stages[0]
        t = t0 + int(self.two_points) * h
        solved = lambda u: stage.residual(u, start.state, t, fraction * h, params)
        return solved(start.guess[0]), jax.jacfwd(solved)(start.guess[0])


def _of_every(one: Any, kept: tuple, case: Case, given: Any, by_jax: bool) -> Any:
    """`one(given, params, h, t0)` of every trajectory; what is traced for NumPy is remembered by the objects `kept`."""
    if not by_jax and not is_traced(given, case.params, case.h, case.t0):
        found = _in_numpy(one, kept, case, given)
        if found is not None:
            return found
    axes = None if case.batch is None else (0, 0 if case.batch_params else None, None, None)
    return _compiled(one, (given, case.params, jnp.asarray(case.h, float), jnp.asarray(case.t0, float)), axes)


@compiled
def _compiled(one: Any, arguments: tuple, axes: tuple | None) -> Any:
    """One compiled function for all of it, reused by later runs of equal systems and schemes."""
    return (one if axes is None else jax.vmap(one, in_axes=axes))(*arguments)


def _in_numpy(one: Any, kept: tuple, case: Case, given: Any) -> Any:
    """The same from the scalar program of `one`; None where it has none."""
    from dirax.program.evaluation.functions import in_numpy  # imported when it is used

    lead = lambda leaf: np.asarray(leaf) if case.batch is not None else np.asarray(leaf)[None]
    repeated = lambda leaf: np.broadcast_to(np.asarray(leaf), (case.batch or 1, *np.shape(leaf)))
    params = jax.tree.map(lead if case.batch_params else repeated, case.params)
    leaves, structure = jax.tree.flatten((jax.tree.map(lead, given), params, repeated(case.h), repeated(case.t0)))
    options = type(one), case.two_points, getattr(one, "project", None), structure
    found = in_numpy(lambda *leaves: one(*jax.tree.unflatten(structure, leaves)), leaves, (*map(Same, kept), options))
    return found if case.batch is not None or found is None else jax.tree.map(lambda leaf: leaf[0], found)


def _first_step_in_numbers(equation: Any, case: Case, start: Start) -> tuple[np.ndarray, np.ndarray] | None:
    """The residual and the Jacobian of the first step from the scalar program of the step; None where it has none."""
    from dirax.engines.step_program import linearized  # imported when it is used

    lead = lambda leaf: leaf if case.batch is not None else leaf[None]
    each = lambda number: np.broadcast_to(np.asarray(number), (case.batch or 1,))
    fraction = equation.stages[0][1]
    t = each(case.t0 + int(case.two_points) * case.h)
    key = equation, case.params, case.batch_params
    found = linearized(*key, lead(start.guess[0]), lead(start.state), t, each(fraction * case.h))
    return found if case.batch is not None or found is None else (found[0][0], found[1][0])
