"""Lines of `dx.verify` on the discrete Dirac structure of every step, and on the derivative of single steps."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from dirax.diagnostics.one_step import differentiated_steps
from dirax.diagnostics.power_balance import keeps_books
from dirax.diagnostics.replay_lines import moved_numbers
from dirax.diagnostics.report import NOT_CHECKED, VIOLATED, Line
from dirax.diagnostics.rounding import differences_by_rounding, with_moved_rows, with_rounding
from dirax.diagnostics.rows import consecutive, over_rows, sampled_rows, shape_of
from dirax.diagnostics.symplecticity_of_many import symplecticity_of_many
from dirax.diagnostics.verdicts import judged, of_lane, roundoff_limit, spread, where_reached, worst_place
from dirax.engines.steps_in_numbers import StepsInNumbers
from dirax.numerics.tolerances import SMALLEST
from dirax.program.evaluation.noise import Noise
from dirax.program.memo import Same
from dirax.schemes.discrete_structure import AbstractDiscreteStructure, AbstractStepForm
from dirax.schemes.step import StepSequence
from dirax.solution.solution import Solution

SAMPLED_STEPS, SAMPLED_CUBED = 8, 2e7
"""Steps of a trajectory at which the derivative of the step is taken, unless the cubes of all their unknowns are more than this:
then as many as have, and two at least."""

LARGEST_STATE = 1000
"""Numbers of a state, or of a row, up to which the derivative of a step and the distribution at a row, matrices, are taken."""

UNDISTURBED = 8.0
"""How much more a step may miss whose operations cannot be disturbed one by one to see what rounding does to it: those with a
decomposition of a matrix or a Fourier transform in them, which round by several last places."""

LEFT_OUT = (
    "; only the constraints that were left out are missed: they follow from the others where all holonomic ones hold, and the "
    "places at which this scheme takes them are off that"
)
WORDS = {2: "two", 3: "three"}


def structure_of(sol: Solution) -> AbstractDiscreteStructure | str:
    """The discrete structure of a run, from its scheme; or why there is none."""
    if sol.lacks:
        return sol.lacks
    return sol.scheme.discrete_structure(sol.system, shape_of(sol), sol.step)


def membership(sol: Solution, structure: AbstractDiscreteStructure | str, tolerance: float | None) -> list[Line]:
    """One line a claim of the structure."""
    if isinstance(structure, str):
        return [Line("discrete Dirac structure", None, None, NOT_CHECKED, structure)]
    name, points = structure.claims[0].quantity, structure.points
    if unsaved := _unsaved(structure.reads, sol):
        return [Line(name, None, None, NOT_CHECKED, unsaved)]
    size = sum(int(np.prod(sol.field_info[key].shape)) for key in structure.reads)
    if size > LARGEST_STATE and not structure.without_matrix:
        return [Line(name, None, None, NOT_CHECKED, f"its distribution is a matrix, and a row has {size} numbers")]
    if sol.save_every != 1:
        return [Line(name, None, None, NOT_CHECKED, f"needs every step, but save_every = {sol.save_every}")]
    if sol.rows < points:
        return [Line(name, None, None, NOT_CHECKED, f"needs {WORDS[points]} points, but only {sol.rows} were saved")]
    rows = sampled_rows(sol, sol.rows - points + 1)
    items = consecutive(sol, structure.reads, points, rows)
    of_rows, limit = eqx.Partial(_terms, structure), roundoff_limit(tolerance, 1)
    terms = where_reached(over_rows(of_rows, sol, (items,)), items)
    parts, middle, lines, first = [part for claim in structure.claims for part in claim.parts], (points - 1) // 2, [], 0
    follow = _redundant(sol, parts, structure.counts)
    values = _relative(terms, structure.counts, follow)
    if np.any(values > limit):
        terms = with_rounding(terms, np.max(values, axis=(0, 2)), of_rows, sol, (items,))
        values = _relative(terms, structure.counts, follow)
    if np.any(values > limit):  # what a step solves for may be made of differences, and be off by more than a rounding
        by = dict(zip(structure.reads, moved_numbers(sol, *structure.reads), strict=True))
        terms = with_moved_rows(terms, np.max(values, axis=(0, 2)), of_rows, sol, (items,), by)
        values = _relative(terms, structure.counts, follow)
    own = terms.copy()
    own[:, :, 0, follow] = 0.0
    without = _relative(own, structure.counts, follow)
    if "q0" in sol.initial:
        values[:, 0, [parts.index(part) for part in structure.given]] = 0.0  # the first pair was given, not computed
    for claim in structure.claims:
        parts_of_claim = slice(first, first + len(claim.parts))
        of_claim, first = values[..., parts_of_claim], parts_of_claim.stop
        lane, row = worst_place(np.max(of_claim, axis=-1))
        text = f"{claim.statement}; worst at t = {sol.time_of(rows[row] + middle, lane):.6g}{of_lane(sol, lane)}"
        if len(rows) < sol.rows - points + 1:
            text += f", of {len(rows)} of {sol.rows - points + 1} steps"
        if len(claim.parts) > 1:
            each = zip(claim.parts, of_claim[lane, row], strict=True)
            text += ": " + ", ".join(f"{part} {value:.2g}" for part, value in each)
        if np.max(of_claim) > limit >= np.max(without[..., parts_of_claim]):
            text += LEFT_OUT
        allowed = roundoff_limit(tolerance, _unknowns(sol)) if claim.solved else limit
        lines.append(judged(sol, claim.quantity, np.max(of_claim, axis=(1, 2)), allowed, text))
    return lines


def _unknowns(sol: Solution) -> int:
    """How many a step solves for."""
    return 1 if sol.equation is None else max(stage.unknowns for stage, _ in sol.equation.stages)


def _terms(structure: AbstractDiscreteStructure, rows, params):
    return structure.membership_terms(rows, params)


def _redundant(sol: Solution, parts: list[str], counts: tuple[int, ...]) -> np.ndarray:
    """The numbers of the constraints that follow from the others."""
    left_out = np.array(sol.stats.get("redundant_constraints", ()), int)
    return left_out + sum(counts[: parts.index("constraint")]) if left_out.size and "constraint" in parts else left_out[:0]


def _relative(values: np.ndarray, counts: tuple[int, ...], follow: np.ndarray) -> np.ndarray:
    """By how much each part is missed, (B, rows, parts), of (B, rows, 2, numbers): each number relative to the largest size of
    its terms over the trajectory, and those that `follow` from others, whose roundoff they have, to the largest of all."""
    missed, sizes = values[:, :, 0], values[:, :, 1]
    largest = np.max(np.where(np.isfinite(sizes), sizes, 0.0), axis=1, keepdims=True)
    largest[..., follow] = np.max(largest, axis=-1, keepdims=True)
    relative = np.divide(missed, largest, out=np.where(missed > 0.0, np.inf, 0.0), where=largest > 0.0)
    ends = np.cumsum(counts)[:-1]
    return np.stack([np.max(part, axis=2, initial=0.0) for part in np.split(relative, ends, axis=2)], axis=2)


def symplecticity(sol: Solution, tolerance: float | None) -> Line:
    """The line of the form on the states whose change in one step is known."""
    constrained = any(info.place == "step" and name == "multipliers" for name, info in sol.field_info.items())
    name = "structural relation φ*Ω = Ω + dβ" if constrained else "symplecticity of one step"
    if sol.lacks:
        return Line(name, None, None, NOT_CHECKED, sol.lacks)
    if max(stage.state_size for stage, _ in sol.equation.stages) > LARGEST_STATE:
        return symplecticity_of_many(sol, name, tolerance)
    form = sol.scheme.step_form(sol.system, shape_of(sol), sol.step)
    if isinstance(form, str):
        return Line(name, None, None, NOT_CHECKED, form)
    if "work" in sol.fields and not keeps_books(sol):
        return Line(name, None, None, NOT_CHECKED, "the forces change the two-form")
    if unsaved := _unsaved(form.reads, sol):
        return Line(name, None, None, NOT_CHECKED, unsaved)
    if form.points > 1 and sol.save_every != 1:
        return Line(name, None, None, NOT_CHECKED, f"needs every step, but save_every = {sol.save_every}")
    rows = _sampled(sol)
    if len(rows) == 0:
        return Line(name, None, None, NOT_CHECKED, "no two rows were computed")
    items = consecutive(sol, form.reads, form.points, rows)
    one = {key: values[(0,) * (1 + (sol.batch is not None))] for key, values in items.items()}
    if reason := form.refusal(sol.equation, one, sol.params_of_one):
        return Line(name, None, None, NOT_CHECKED, reason)
    same = Same(sol.equation)
    begun = over_rows(eqx.Partial(_begun, form, same), sol, (items,), few=True)
    size, t = sol.equation.stages[0][0].state_size, np.atleast_2d(items["t"][..., -1])
    counts = [stage.unknowns for stage, _ in sol.equation.stages]
    guesses = np.split(begun[..., size:], np.cumsum(counts)[:-1], axis=-1)

    def stepped(noise: Noise | None = None) -> tuple[np.ndarray, np.ndarray]:
        """The terms (B, rows, numbers, 2, entries) of the form, and the condition of the steps."""
        step = differentiated_steps(sol, begun[..., :size], guesses, t, noise)
        taken = step if sol.batch is not None else jax.tree.map(lambda a: a[0], step)
        terms = over_rows(eqx.Partial(_terms_of_form, form, same), sol, (items, taken), few=True, noise=noise)
        return np.array(terms.reshape(*terms.shape[:-2], -1)), step.condition

    terms, conditions = stepped()
    condition = float(np.max(conditions, where=np.isfinite(conditions), initial=1.0))
    limit = roundoff_limit(tolerance, size * condition)
    values = of_terms(terms)
    if np.any(values[..., 0] > limit):
        moved = differences_by_rounding(terms, lambda noise: stepped(noise)[0])
        limit *= 1.0 if StepsInNumbers.found(sol.equation, sol.given_params, sol.batch_params) is not None else UNDISTURBED
        terms[..., 1, :] = np.maximum(terms[..., 1, :], np.max(np.abs(moved), axis=0)[..., 0, :])
        values = of_terms(terms)
    defect = values[..., 0]
    if not np.any(np.isfinite(defect)):
        return Line(name, None, None, NOT_CHECKED, "the step could not be solved again from the saved rows")
    lane, row = worst_place(defect)
    text = form.told(
        values[lane, row], f"worst of {len(rows)} steps at t = {sol.time_of(rows[row], lane):.6g}{of_lane(sol, lane)}"
    )
    line = judged(sol, name, np.max(np.where(np.isfinite(defect), defect, 0.0), axis=1), limit, text)
    if line.verdict == VIOLATED and (excuse := form.excuse(values[lane, row])):
        line = Line(name, line.value, limit, NOT_CHECKED, text + excuse)
    line.details["condition"] = condition
    return line


def _begun(form: AbstractStepForm, same: Same, rows, params):
    """The first state, and a first guess for each part, equal ones for equal equations."""
    state, first = form.begins(same.object, rows, params)
    stages, guesses = same.object.stages, {id(same.object.stages[0][0]): first}
    for stage, fraction in stages:
        if id(stage) not in guesses:
            guesses[id(stage)] = form.begins(StepSequence(((stage, fraction),)), rows, params)[1]
    return jnp.concatenate([state, *(guesses[id(stage)] for stage, _ in stages)])


def _terms_of_form(form: AbstractStepForm, same: Same, rows, step, params):
    return form.terms(step, same.object, rows, params)


def of_terms(terms: np.ndarray) -> np.ndarray:
    """The numbers (B, rows, numbers) of terms: the largest of what is missed, each relative to the size of its terms."""
    missed, sizes = np.abs(terms[..., 0, :]), terms[..., 1, :]
    return np.max(np.divide(missed, sizes, out=missed.copy(), where=sizes > SMALLEST), axis=-1)


def _unsaved(reads: tuple[str, ...], sol: Solution) -> str:
    """What is read and was not saved, in words; empty where all was."""
    unsaved = [name for name in reads if name not in sol.fields]
    return f"needs {', '.join(unsaved)}, but the rows hold {', '.join(sol.fields)} alone" if unsaved else ""


def _sampled(sol: Solution) -> np.ndarray:
    """Numbers of a few rows that have a successor, spread over the shortest and over the longest trajectory."""
    values = np.asarray(sol.fields["q" if "q" in sol.fields else "x"])
    reached = np.sum(np.all(np.isfinite(values), axis=-1), axis=-1)
    most = max(2, min(SAMPLED_STEPS, int(SAMPLED_CUBED / max(1, _unknowns(sol)) ** 3)))
    half = most // 2 if np.min(reached) < np.max(reached) else most
    return np.union1d(spread(int(np.min(reached)) - 1, half), spread(int(np.max(reached)) - 1, half)).astype(int)
