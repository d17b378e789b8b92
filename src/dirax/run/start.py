"""Where a run begins: initial data made complete by the system, then the first state and the first step of the equation."""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from dirax.program.compiled import compiled
from dirax.program.evaluation.in_floats import Floats
from dirax.program.interpreter import UnsupportedPrimitive
from dirax.program.memo import Same
from dirax.program.roots import FEWEST_SPARSE
from dirax.program.scalar_program import ScalarProgram
from dirax.program.side_by_side import side_by_side
from dirax.program.user_functions import is_traced
from dirax.run.validate import Case, spread

LARGEST_MATRIX = 2**18
"""Entries of a matrix up to which the start of a run makes it whole."""

FEWEST_ARRAYS = 97
"""Numbers of a state from which on a start is not found by scalars."""


class Initial(NamedTuple):
    """Initial data as the system completes them, each entry with a leading batch axis in a batch.

    All that a scheme may start from, by name; how far the data are off the constraints, and the sizes of their terms (of two
    points, followed by those of the constraints of their step); the
    Lagrangian and the matrix [W; ∂g/∂q] of the constraints at the data, if the system has them and it is not too large.
    """

    data: dict[str, Any]
    defect: Any
    size: Any
    lagrangian: Any
    constraints: Any


class Start(NamedTuple):
    """Where an equation begins, each entry with a leading batch axis in a batch.

    First state and the first guess of every stage; the given row 0 of a two-point start; the residual and the Jacobian of the
    first step, None for an explicit one: an array, or of many unknowns the `SparseJacobians`.
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
    return _of_every(_Completion(system, case.two_points, project), (system,), case, _data_of(case), by_jax)


def _data_of(case: Case) -> dict[str, Any]:
    """The data of every trajectory: the batch axis can be that of the parameters alone."""
    return {name: a if case.batch is None else spread(a, case.batch) for name, a in case.data.items()}


def begun(equation: Any, case: Case, initial: Initial, by_jax: bool = False) -> Start:
    """The first state of every trajectory, and the first step at the first guess; `by_jax` as above."""
    if case.two_points and len(equation.stages) > 1:
        raise ValueError("a composition cannot start from q0= and q1=, which belong to one step: give q= with v= or p=.")
    start = _of_every(_Beginning(equation, case.two_points), (equation,), case, initial.data, by_jax)
    if not equation.stages[0][0].unknowns or case.traced or is_traced(start):  # what is traced cannot be checked
        return start
    unknowns, few_coordinates = equation.stages[0][0].unknowns, not begins_by_arrays(case)
    if unknowns >= FEWEST_SPARSE and not (few_coordinates and unknowns**2 <= LARGEST_MATRIX):
        return _with_sparse_first_step(equation, case, start)
    first = None if by_jax else _first_step_in_numbers(equation, case, start)
    if first is None:
        first = _of_every(_FirstStep(equation, case.two_points), (equation,), case, start._replace(row0=None), True)
    return start._replace(residual=first[0], jacobian=first[1])


def _with_sparse_first_step(equation: Any, case: Case, start: Start) -> Start:
    """The start with the first step's Jacobian as a sparse one, or a dense one where it is not too large."""
    from dirax.engines.sparse.plan import Unsolvable, quicker_plan  # imported when it is used

    plan = quicker_plan(equation, case.params, case.batch_params)
    if isinstance(plan, Unsolvable):
        raise ValueError(
            f"the first step has no unique solution, whatever the initial data: {plan}. The Lagrangian is singular together with "
            "its constraints: remove the coordinates that it does not determine, or choose another discrete Lagrangian."
        )
    known = None if isinstance(plan, str) else plan.solvers[0]
    if known is None and equation.stages[0][0].unknowns ** 2 > LARGEST_MATRIX:
        return start
    written = None if isinstance(plan, str) else plan.equation.stages[0][0]
    first = _of_every(_FirstStep(equation, case.two_points, known, written), (equation,), case, start._replace(row0=None), True)
    if known is None:
        return start._replace(residual=first[0], jacobian=first[1])
    residual, *found = (np.asarray(a) if case.batch is not None else np.asarray(a)[None] for a in first)
    return start._replace(residual=residual[:, 0], jacobian=SparseJacobians(known.equations, *found))


class SparseJacobians(NamedTuple):
    """Sparse Jacobians of every trajectory at the first guess and near it: what is known of them all, `values` (B, 2, …), the
    products (B, 2, k) with `direction(k)`, and by how much the residual as it is run differs from that of the scheme (B, 2, k),
    relative to the largest numbers in it."""

    equations: Any
    values: np.ndarray
    product: np.ndarray
    missed: np.ndarray


AWAY = 1e-3
"""How far from the first guess, relative to it, Jacobians are compared: an entry may be zero at it by symmetry."""


def direction(size: int) -> np.ndarray:
    """A vector without zeros in which no entries of a row cancel but by chance."""
    return np.random.default_rng(size).uniform(0.5, 1.5, size)


class _Completion(eqx.Module):
    """(data, params, h, t0) ↦ the Initial of one trajectory."""

    system: Any
    two_points: bool
    project: bool

    def __call__(self, data, params, h, t0) -> Initial:
        system, complete = self.system, self.system.complete({**data, "t": t0}, params, self.project)
        defect = system.initial_defect({**complete, "t": t0}, params)
        q, v = (data["q0"], (data["q1"] - data["q0"]) / h) if self.two_points else (complete.get("q"), complete.get("v"))
        size = defect
        if defect.size or (self.two_points and system.constraints.any):
            known = {**complete, **({} if v is None else {"v": v}), "t": t0}
            size = system.initial_terms(*jax.tree.map(jax.lax.stop_gradient, (known, params)))
        lagrangian = None if q is None or v is None else system.lagrangian_value(t0, q, v, params)
        constraints = None
        if system.constraints.any and defect.size * system.point(complete).size <= LARGEST_MATRIX:
            constraints = system.constraints.matrix(t0, system.point(complete), params)
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
    sparse: Any = None
    written: Any = None
    """The stage as it is run."""

    def __call__(self, start: Start, params, h, t0):
        stage, fraction = self.equation.stages[0]
        t = t0 + int(self.two_points) * h
        given = start.state, t, fraction * h, params
        solved = lambda u: stage.residual(u, *given)
        if self.sparse is not None:
            u, along = start.guess[0], jnp.asarray(direction(start.guess[0].shape[0]))

            def at(u):
                residual, product = jax.jvp(solved, (u,), (along,))
                size = lambda a: jnp.max(jnp.abs(a), initial=0.0)
                large = size(u) + size(residual) + size(start.state) * (1.0 + size(product) / jnp.abs(h))
                missed = jnp.abs(self.written.residual(u, *given) - residual) / jnp.where(large > 0, large, 1.0)
                return residual, self.sparse.jacobian_of(stage.residual)(u, *given), product, missed

            return jax.lax.map(at, jnp.stack([u, u + AWAY * (1.0 + jnp.max(jnp.abs(u))) * along]))
        return solved(start.guess[0]), jax.jacfwd(solved)(start.guess[0])


def _of_every(one: Any, kept: tuple, case: Case, given: Any, by_jax: bool) -> Any:
    """`one(given, params, h, t0)` of every trajectory; what is traced for NumPy is remembered by the objects `kept`."""
    if not by_jax and not begins_by_arrays(case):
        traced = is_traced(given, case.params, case.h, case.t0)
        found = (_on_host if traced else _in_numpy)(one, kept, case, given)
        if found is not None:
            return found
    axes = None if case.batch is None else (0, 0 if case.batch_params else None, None, None)
    return _compiled(one, (given, case.params, jnp.asarray(case.h, float), jnp.asarray(case.t0, float)), axes)


def begins_by_arrays(case: Case) -> bool:
    """Whether a case has so many numbers that JAX finds its start."""
    return max(np.shape(leaf)[-1] for leaf in case.data.values()) >= FEWEST_ARRAYS


@functools.partial(compiled, seldom=True)
def _compiled(one: Any, arguments: tuple, axes: tuple | None) -> Any:
    """One compiled function for all of it, reused by later runs of equal systems and schemes."""
    return (one if axes is None else side_by_side(one, axes))(*arguments)


def _in_numpy(one: Any, kept: tuple, case: Case, given: Any) -> Any:
    """The same from the scalar program of `one`; None where it has none."""
    leaves, found = _program(one, kept, case, given)
    if found is None:
        return None
    return _of_case(jax.tree.unflatten(found[1], found[0].in_numpy(leaves)), case)


def _on_host(one: Any, kept: tuple, case: Case, given: Any) -> Any:
    """The same under JAX's transformations."""
    from dirax.program.on_host import on_host  # imported when it is used

    found = on_host(*_in_entries(one, kept, case, given, jnp))
    return None if found is None else _of_case(found, case)


def _of_case(entries: Any, case: Case) -> Any:
    return entries if case.batch is not None else jax.tree.map(lambda leaf: leaf[0], entries)


def _in_entries(one: Any, kept: tuple, case: Case, given: Any, xp: Any = np) -> tuple[Callable, list, tuple]:
    """`one` as a function of leaves, the leaves (entries, …) for every trajectory, and a key of that function."""
    lead = lambda leaf: xp.asarray(leaf) if case.batch is not None else xp.asarray(leaf)[None]
    repeated = lambda leaf: xp.broadcast_to(xp.asarray(leaf), (case.batch or 1, *np.shape(leaf)))
    params = jax.tree.map(lead if case.batch_params else repeated, case.params)
    leaves, structure = jax.tree.flatten((jax.tree.map(lead, given), params, repeated(case.h), repeated(case.t0)))
    options = type(one), case.two_points, getattr(one, "project", None), structure
    return lambda *leaves: one(*jax.tree.unflatten(structure, leaves)), leaves, (*map(Same, kept), options)


def _program(one: Any, kept: tuple, case: Case, given: Any) -> tuple[list[np.ndarray], Any]:
    """The arguments of `one` for every trajectory, and its scalar program with the structure of its results, or None."""
    from dirax.program.evaluation.functions import program_of  # imported when it is used

    function, leaves, key = _in_entries(one, kept, case, given)
    shapes = [jax.ShapeDtypeStruct(leaf.shape[1:], leaf.dtype) for leaf in leaves]
    return leaves, program_of(function, shapes, key)


def program_of_completion(system: Any, case: Case, project: bool) -> tuple[ScalarProgram, Any] | None:
    """The program (data by their names, params, h, t0) ↦ Initial, of one trajectory, and the structure of its results; None
    where there is none."""
    return _program(_Completion(system, case.two_points, project), (system,), case, _data_of(case))[1]


def program_of_beginning(equation: Any, case: Case, complete: dict[str, Any]) -> tuple[ScalarProgram, Any] | None:
    """The same of (complete data by their names, params, h, t0) ↦ Start without the first step."""
    return _program(_Beginning(equation, case.two_points), (equation,), case, complete)[1]


def program_of_first_step(equation: Any, case: Case) -> tuple[Floats | None, tuple[bool, ...]]:
    """(unknowns, state, t, fraction of h, params that move) ↦ the numbers of the residual and of the Jacobian of the first
    stage, None as above; and which of the params move."""
    from dirax.engines.step_program import step_program  # imported when it is used

    try:
        step = step_program(equation, case.params, case.batch_params)
    except UnsupportedPrimitive:
        return None, ()
    return step.first_in_floats, step.parameters.dynamic


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
