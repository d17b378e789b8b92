"""A stage of sites: its residual, its Jacobian and its advance as loops over sites; their derivatives as JAX has them."""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax

from dirax.engines.sparse.site_loops import Loops, loops
from dirax.engines.sparse.solver import SparseSolver
from dirax.program.graph import GraphTooLarge
from dirax.program.sites.courses import NotBySites
from dirax.program.sites.jacobian import entries_of_jacobian
from dirax.program.sites.walk import sites_of
from dirax.program.sparse_equations import SparseEquations


def by_sites(stage: Any, shapes: tuple) -> tuple[Any, SparseSolver] | str:
    """The stage with loops in place of its functions, of arguments of these `shapes`, and its solver; why not, where its arrays
    are not the same expressions at many places. Raises `StructurallySingular`."""
    count = len(jax.tree.leaves(shapes))
    try:
        residual = sites_of(stage.residual, *shapes)
        entries, rows, columns = entries_of_jacobian(residual)
        advance = sites_of(stage.advance, *shapes)
        of_residual = loops(residual, count, residual.results, residual.sizes)
        of_advance = loops(advance, count, advance.results, advance.sizes)
        values = loops(residual, count, [entries], [len(rows)])
    except (NotBySites, GraphTooLarge) as error:
        return str(error)
    equations = SparseEquations.of_entries(stage.unknowns, rows, columns)
    functions = {"residual": _written(stage.residual, of_residual), "advance": _written(stage.advance, of_advance)}
    of_arguments = lambda *arguments: values(*jax.tree.leaves(arguments))[0]
    return dataclasses.replace(stage, **functions), SparseSolver(equations, of_arguments, True)


def _written(function: Callable, made: Loops) -> Callable:
    """The function by its loops, with its own derivatives."""

    @jax.custom_jvp
    def by_loops(*arguments: Any) -> Any:
        return made(*jax.tree.leaves(arguments))[0]

    @by_loops.defjvp
    def _(arguments: tuple, tangents: tuple) -> tuple:
        return by_loops(*arguments), jax.jvp(function, arguments, tangents)[1]

    def of_either(*arguments: Any) -> Any:
        given = jax.tree.leaves(arguments)
        return made(*given)[0] if made.in_numpy(given) else by_loops(*arguments)

    return of_either
