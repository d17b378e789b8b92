"""Runs under JAX's transformations: one compiled function for all of a kind, which JAX differentiates and maps.

Without it `jax.grad(f)(q)` would compile every operation between the arguments and the engine by itself, a hundred and more.
"""

from collections.abc import Callable, Hashable
from dataclasses import dataclass, replace
from typing import Any

import jax
import numpy as np
from jax.core import Tracer

from dirax.engines.contract import Outcome, Problem
from dirax.program.memo import Memo
from dirax.run.settings import Settings
from dirax.run.validate import Case

KEPT = 32
"""Kinds of runs whose functions are kept."""

COMPUTED = ("fields", "closing", "completed", "status", "iterations", "max_residual", "last_state", "last_unknowns")
"""What is computed of an Outcome; the rest is known once it has been traced."""

Carried = tuple[Problem, Outcome, Any]
"""The problem of a run, its outcome, and other arrays: the given row 0 of two points."""


@dataclass
class Kind:
    """The compiled function of runs of one kind, and what was known besides arrays when it was traced."""

    arrays: Callable[[list], tuple[dict[str, Any], Any]]
    problem: Any = None
    outcome: Any = None


_kinds: Memo[Kind] = Memo(KEPT)


def moves(leaf: Any) -> bool:
    """Whether a leaf is an argument of what JAX compiles: numbers with a point are, and all that JAX traces. Users' functions may
    count or index by others."""
    return isinstance(leaf, Tracer) or np.asarray(leaf).dtype.kind == "f"


def carried_by_jax(carried: Callable[[Case], Carried], settings: Settings, case: Case, *others: Hashable) -> Carried:
    """`carried(case)` of a case with traced values. It must do the same for equal settings, kinds of values, and others.

    What `moves` is an argument of the compiled function, the rest is part of it.
    """
    leaves, structure = jax.tree.flatten((case.data, case.params, case.h, case.t0))
    moving = tuple(map(moves, leaves))
    value = lambda leaf: (np.asarray(leaf).dtype.char, np.asarray(leaf).tobytes())
    kept = tuple(() if m else value(leaf) for m, leaf in zip(moving, leaves, strict=True))
    shapes = tuple(map(np.shape, leaves)), case.batch, case.batch_params, case.redundant
    kind = _kinds.get((settings.key, structure, moving, kept, shapes, others), lambda: _kind(carried, case, leaves, moving))
    arrays, more = kind.arrays([leaf for leaf, m in zip(leaves, moving, strict=True) if m])
    problem = kind.problem.with_numbers(params=case.params, h=case.h, t0=case.t0)
    return problem, replace(kind.outcome, **arrays, notes=dict(kind.outcome.notes)), more


def _kind(carried: Callable[[Case], Carried], case: Case, leaves: list, moves: tuple[bool, ...]) -> Kind:
    structure = jax.tree.structure((case.data, case.params, case.h, case.t0))
    still = [None if m else leaf for leaf, m in zip(leaves, moves, strict=True)]

    def run(moving: list) -> tuple[dict[str, Any], Any]:
        rest = iter(moving)
        data, params, h, t0 = jax.tree.unflatten(structure, [next(rest) if m else s for s, m in zip(still, moves, strict=True)])
        problem, outcome, more = carried(replace(case, data=data, params=params, h=h, t0=t0))
        kind.problem = problem.with_numbers(state=None, guess=None, params=None, h=None, t0=None)
        nothing: dict[str, Any] = dict.fromkeys(COMPUTED)
        kind.outcome = replace(outcome, **nothing)
        return {name: getattr(outcome, name) for name in COMPUTED}, more

    kind = Kind(jax.jit(run))
    return kind
