"""Equations that do not say how a step is resumed, and whose start does not do it, or that say it wrongly: a sum of theirs would
begin again."""

from typing import Any

import jax.numpy as jnp
import numpy as np

from dirax.program.outside_values import package_of
from dirax.program.user_functions import constant_entries
from dirax.schemes.step import StepEquation
from dirax.solution.trajectory import last_rows

RESUMED = 1e-6
"""How near, relative to the largest of its numbers, a step that is resumed must come to what was saved."""

FEW = 100
"""Steps between two rows up to which this is looked at."""


def refuse_restarting(again: Any) -> None:
    """Raise `ValueError` where steps from the last row but one do not lead to the last one, by an equation that is a user's own,
    or of a system that was given to `dx.load`; `again` are the steps of a run once more, a `StepsAgain`."""
    sol, (first, _) = again.sol, again.equation.stages[0]
    own = resumes_in_its_own_way(first)
    if not (own or sol.supplied) or sol.impacts is not None:
        return
    nodes = {name: np.asarray(a) for name, a in sol.fields.items() if sol.field_info[name].place == "node"}
    nodes = nodes if sol.batch is not None else {name: a[None] for name, a in nodes.items()}
    lane, row = np.zeros(1, int), int(last_rows(list(nodes.values()))[0]) - 1
    if row < 1 or (count := int(again.counts[row + 1] - again.counts[row])) > FEW:
        return
    h, number = np.full(1, float(sol.step)), again.counts[row : row + 1]
    state, u = again.begun_at(lane, np.array([row]), again.time(number))
    for _ in range(count):
        (state, u), number = again.step(lane, state, u, again.time(number), h), number + 1
    for name, made in again.row(lane, state, u, again.time(number), h).items():
        if name not in nodes or sol.field_info[name].chosen or name == "energy_defect":  # which is roundoff
            continue
        there, size = nodes[name][0, row + 1], np.nanmax(np.abs(nodes[name][0]), initial=0.0)
        if not np.all(np.abs(made[0] - there) <= RESUMED * size):
            came, expected = (np.array2string(a, precision=6) for a in (made[0], there))
            if not own:
                raise ValueError(
                    f"a step of the system that dx.load was given leads from row {row} to {name} = {came}, where the run has "
                    f"{expected}: give the system, scheme, params and inputs of the run, dx.load(path, system=…, inputs=…)."
                )
            silent = first.resume is first.start
            says = f"{'does not say' if silent else 'says'} how the step that leaves a saved row begins"
            raise ValueError(
                f"the equation of {sol.scheme!r} {says}, {'and its start()' if silent else 'but its resume()'} leads "
                f"from row {row} to {name} = {came}, where the run has {expected}: give dx.StepEquation(resume=…), a function of "
                f"(data, h, params) that makes the state of what is saved, such as data[{name!r}]."
            )


def resumes_in_its_own_way(equation: StepEquation) -> bool:
    """Whether steps that leave rows begin by a user's function."""
    return package_of(equation.resume) != "dirax"


def refuse_sums(equation: StepEquation, params: Any) -> None:
    """Raise `ValueError` where an equation without `resume` starts a part of its state with the same numbers everywhere, which
    steps change: all that is known of one whose values JAX traces."""
    names = ("q", "v", "p") if "q" in equation.fields else ("x", "velocity")
    if equation.resume is not equation.start or names[0] not in equation.fields:
        return
    data = dict.fromkeys(names, np.zeros(equation.fields[names[0]].shape)) | {"t": np.zeros(())}
    number, x, u = np.ones(()), np.zeros(equation.state_size), np.zeros(equation.unknowns)
    try:
        begins = constant_entries(lambda *given: equation.start(*given)[0], data, number, params)
    except KeyError:  # it starts from something else
        return
    if begins is None or not np.any(fixed := np.isfinite(begins)):
        return
    goes_on = lambda x, u, *given: equation.advance(u, jnp.where(fixed, begins, x), *given)[np.flatnonzero(fixed)]
    after = constant_entries(goes_on, x, u, number, number, params)
    if after is None or not np.array_equal(after, begins[fixed]):
        names = ", ".join(name for name in equation.state_layout if np.any(fixed[equation.state_layout.place(name)]))
        raise ValueError(
            f"the equation does not say how the step that leaves a row or a wall begins, and its start() has the same {names} "
            "everywhere: give dx.StepEquation(resume=…), a function of (data, h, params) that makes the state of what is saved."
        )
