"""What is known of the Jacobians of a step before it is run: a solver for each of its stages, or why there is none."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from dirax.engines import policy
from dirax.engines.contract import size_of
from dirax.engines.in_jax import joined, replaced
from dirax.engines.sparse.by_sites import by_sites
from dirax.engines.sparse.solver import SparseSolver
from dirax.engines.step_program import FULL, step_program
from dirax.numerics.sparse.elimination import StructurallySingular
from dirax.program.counts import array_operations
from dirax.program.graph import GraphTooLarge
from dirax.program.interpreter import UnsupportedPrimitive
from dirax.program.memo import Memo, Same
from dirax.program.sparse_equations import SparseEquations
from dirax.program.sparsity import Dense

KEPT = 64
"""Plans kept in memory."""


class Unsolvable(str):
    """Why the equations of a step have no unique solution, whatever the numbers in them."""


class SparsePlan(NamedTuple):
    """The equation as it is run, a solver for each of its stages, and why it is not run by sites, "" where it is."""

    equation: Any
    solvers: tuple[SparseSolver, ...]
    not_by_sites: str = ""

    @property
    def stats(self) -> dict[str, Any]:
        """What `Solution.stats` says of it: of the first stage's matrix, and how all are evaluated."""
        not_by_sites = {"not_by_sites": self.not_by_sites} if self.not_by_sites else {}
        return self.solvers[0].equations.stats | {"by_sites": not self.not_by_sites} | not_by_sites


_plans: Memo[SparsePlan | str] = Memo(KEPT)


def sparse_plan(equation: Any, params: Any, batch_params: bool) -> SparsePlan | str:
    """How the step is run, the same objects for the same equation and parameters of one kind; or why the step is not one for
    sparse elimination, in words that go on after "because"."""
    leaves, structure = jax.tree.flatten(params)
    whole = [leaf for leaf in leaves if not _is_float(leaf) and not isinstance(leaf, Tracer)]
    key = Same(equation), structure, batch_params, *map(np.shape, leaves), *(np.asarray(leaf).tobytes() for leaf in whole)
    return _plans.get(key, lambda: _planned(equation, params, batch_params))


def quicker_plan(equation: Any, params: Any, batch_params: bool) -> SparsePlan | str:
    """The same where sparse elimination is quicker than that of dense matrices; why it is not, where it is not."""
    if full := _full(equation, params, batch_params):
        return full
    plan = sparse_plan(equation, params, batch_params)
    return plan if isinstance(plan, str) else next(filter(None, (solver.equations.slower for solver in plan.solvers)), plan)


def _full(equation: Any, params: Any, batch_params: bool) -> str | None:
    """Why a step of moderate size is not sparse, which its scalar program says at once; None where it does not."""
    if size_of(equation) > policy.LARGEST_SCALARS:
        return None
    try:
        full = step_program(equation, params, batch_params).full
    except UnsupportedPrimitive:
        return None
    unknowns = max(stage.unknowns for stage, _ in equation.stages)
    if 2 * full <= unknowns:
        return None
    return f"{full} equations of {unknowns} need each other's unknowns, in more than one entry of {FULL} of their matrix"


def _is_float(leaf: Any) -> bool:
    return bool(jnp.issubdtype(jnp.result_type(leaf), jnp.floating))


def _planned(equation: Any, params: Any, batch_params: bool) -> SparsePlan | str:
    def shaped(leaf: Any) -> Any:
        if batch_params or _is_float(leaf) or isinstance(leaf, Tracer):
            return jax.ShapeDtypeStruct(np.shape(leaf)[batch_params:], jnp.result_type(leaf))
        return leaf

    numbers, scalar = lambda n: jax.ShapeDtypeStruct((n,), jnp.float64), jax.ShapeDtypeStruct((), jnp.float64)
    given, found, not_by_sites = jax.tree.map(shaped, params), {}, ""
    for stage, _ in equation.stages:
        if not stage.unknowns:
            return "a stage of the step has nothing to solve"
        if id(stage) in found:
            continue
        shapes = numbers(stage.unknowns), numbers(stage.state_size), scalar, scalar, given
        try:
            if isinstance(made := by_sites(stage, shapes), str):
                not_by_sites, made = made, _by_levels(equation, stage, shapes, params, batch_params)
            if made is None:
                made = stage, SparseSolver(SparseEquations.of(stage.residual, *shapes))
        except Dense as error:
            return str(error)
        except StructurallySingular as error:
            named = ", ".join(stage.labels[int(row)] for row in error.rows[:4])
            return Unsolvable(f"the equations {named} have too few unknowns beside the others")
        found[id(stage)] = made
    stages = tuple((found[id(stage)][0], fraction) for stage, fraction in equation.stages)
    return SparsePlan(joined(equation, stages), tuple(found[id(stage)][1] for stage, _ in equation.stages), not_by_sites)


def _by_levels(equation: Any, stage: Any, shapes: tuple, params: Any, batch_params: bool) -> tuple[Any, SparseSolver] | None:
    """A stage of many operations on small arrays, as one of machines of many bodies is, by the levels of its scalar program, and
    a solver with the entries of its Jacobian; None where it is better left in arrays, or has no such program."""
    if array_operations(jax.make_jaxpr(stage.residual)(*shapes).jaxpr) <= policy.MOST_ARRAY_OPERATIONS:
        return None
    try:
        made = step_program(equation, params, batch_params).differentiable
        index = next(index for (index, _), (other, _) in zip(made.stages, equation.stages, strict=True) if other is stage)
        jacobian = made.jacobians[index]
    except (UnsupportedPrimitive, GraphTooLarge):
        return None
    rows, columns = np.array([(i, j) for i, row in enumerate(jacobian) for j in row], np.int64).reshape(-1, 2).T
    equations = SparseEquations.of_entries(stage.unknowns, rows, columns)
    entries = made.in_levels(index, [node for row in jacobian for node in row.values()])
    return replaced(stage, made, index, made.in_levels), SparseSolver(equations, jax.jit(entries))
