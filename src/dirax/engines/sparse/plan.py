"""What is known of the Jacobians of a step before it is run: a solver for each of its stages, or why there is none."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from dirax.engines.sparse.solver import SparseSolver
from dirax.numerics.sparse.elimination import StructurallySingular
from dirax.program.memo import Memo, Same
from dirax.program.sparse_equations import SparseEquations
from dirax.program.sparsity import Dense

KEPT = 64
"""Plans kept in memory."""

_plans: Memo[tuple[SparseSolver, ...] | str] = Memo(KEPT)


def sparse_plan(equation: Any, params: Any, batch_params: bool) -> tuple[SparseSolver, ...] | str:
    """A solver for each stage of the step, the same objects for the same equation and parameters of one kind; or why the step
    is not one for sparse elimination, in words that go on after "because"."""
    leaves, structure = jax.tree.flatten(params)
    whole = [leaf for leaf in leaves if not _is_float(leaf) and not isinstance(leaf, Tracer)]
    key = Same(equation), structure, batch_params, *map(np.shape, leaves), *(np.asarray(leaf).tobytes() for leaf in whole)
    return _plans.get(key, lambda: _planned(equation, params, batch_params))


def _is_float(leaf: Any) -> bool:
    return bool(jnp.issubdtype(jnp.result_type(leaf), jnp.floating))


def _planned(equation: Any, params: Any, batch_params: bool) -> tuple[SparseSolver, ...] | str:
    def shaped(leaf: Any) -> Any:
        if batch_params or _is_float(leaf) or isinstance(leaf, Tracer):
            return jax.ShapeDtypeStruct(np.shape(leaf)[batch_params:], jnp.result_type(leaf))
        return leaf

    numbers, scalar = lambda n: jax.ShapeDtypeStruct((n,), jnp.float64), jax.ShapeDtypeStruct((), jnp.float64)
    params, found = jax.tree.map(shaped, params), {}
    for stage, _ in equation.stages:
        if not stage.unknowns:
            return "a stage of the step has nothing to solve"
        if id(stage) in found:
            continue
        shapes = numbers(stage.unknowns), numbers(stage.state_size), scalar, scalar, params
        try:
            found[id(stage)] = SparseSolver(SparseEquations.of(stage.residual, *shapes))
        except Dense as error:
            return str(error)
        except StructurallySingular as error:
            return f"the equations {', '.join(stage.labels[int(row)] for row in error.rows[:4])} have too few unknowns"
    return tuple(found[id(stage)] for stage, _ in equation.stages)
