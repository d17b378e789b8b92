"""Functions of the saved rows of a solution, evaluated at many of them: by their scalar graph in NumPy, else compiled."""

import math
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from dirax.program.compiled import compiled
from dirax.program.evaluation.functions import in_numpy
from dirax.program.evaluation.noise import Noise
from dirax.program.side_by_side import of_one, side_by_side, waits
from dirax.schemes.step import Shape
from dirax.solution.solution import Solution
from dirax.solution.trajectory import MANY, SavedRow
from dirax.systems.system import AbstractSystem

CHUNK, CHUNK_NUMBERS = 4096, 2**22
"""Rows that go through a compiled function at once, and the numbers in them, at most."""

LARGE = 1000
"""Numbers of a row above which it is one of a large system: no matrix of all of them is formed, and rows are sampled."""

SAMPLED_NUMBERS = 2**21
"""Numbers of the rows that are sampled of a large system, unless four rows are more."""


def over_rows(function: eqx.Partial, sol: Solution, items: tuple, few: bool = False, noise: Noise | None = None) -> np.ndarray:
    """function(*item, params) for every row of `items`, whose leaves have the shape (rows, …) or (B, rows, …).

    The result is (B, rows, …), with B = 1 for one trajectory. Nothing is compiled where the scalar graph can say the function;
    else rows go through in pieces, so that memory stays bounded. A function of a module, with what it is of, is traced once.
    `few`: it is asked for at these rows alone, a handful. `noise`: of the arithmetic; of the numbers of the rows alone, where the
    function is compiled.
    """
    if sol.batch is None:
        items = jax.tree.map(lambda a: np.asarray(a)[None], items)
    found = _by_graph(function, sol, items, few, noise)
    if found is not None:
        return found
    return _compiled(function, sol, jax.tree.map(noise.off, items) if noise else items)


def _by_graph(function: eqx.Partial, sol: Solution, items: tuple, few: bool, noise: Noise | None) -> np.ndarray | None:
    """The values by the scalar graph, without a compiler; None where it cannot say them."""
    leaves, structure = jax.tree.flatten(items)
    lanes, rows = np.shape(leaves[0])[:2]
    of_params, params_structure = jax.tree.flatten(sol.given_params)
    if not all(isinstance(leaf, bool | int | float | np.ndarray | np.generic | jax.Array) for leaf in of_params):
        return None

    def entries(leaf: Any, batched: bool) -> np.ndarray:
        leaf = np.asarray(leaf)
        spread = leaf[:, None] if batched else leaf[None, None]
        return np.broadcast_to(spread, (lanes, rows, *spread.shape[2:])).reshape(lanes * rows, *spread.shape[2:])

    arrays = [np.asarray(leaf).reshape(lanes * rows, *np.shape(leaf)[2:]) for leaf in leaves]
    arrays += [entries(leaf, sol.batch_params) for leaf in of_params]

    def flat(*values):
        item = jax.tree.unflatten(structure, values[: len(leaves)])
        return function(*item, jax.tree.unflatten(params_structure, values[len(leaves) :]))

    found = in_numpy(flat, arrays, (function.func, function.args, structure, params_structure), few, noise)
    return None if found is None else found.reshape(lanes, rows, *found.shape[1:])


def _compiled(function: Callable, sol: Solution, items: tuple) -> np.ndarray:
    rows = jax.tree.leaves(items)[0].shape[1]
    width = 1 + sum(math.prod(np.shape(a)[2:]) for a in jax.tree.leaves(items))
    most = max(1, min(CHUNK, CHUNK_NUMBERS // width) // (sol.batch or 1))
    size = min(most, rows)
    axis = 0 if sol.batch_params and sol.given_params is not None else None
    found = []
    for start in range(0, rows, size):
        numbers = np.minimum(np.arange(start, start + size), rows - 1)  # the last piece repeats its last row
        piece = jax.tree.map(lambda a, numbers=numbers: jnp.asarray(a[:, numbers]), items)
        found.append(np.asarray(_piece(function, piece, sol.given_params, axis))[:, : rows - start])
    return np.concatenate(found, axis=1)


def _of_pieces(function, items, params, axis):
    one = lambda item, params: function(*item, params)
    waiting = waits(one, of_one(items, 2), of_one(params, axis is not None))
    return side_by_side(side_by_side(one, (0, None), waiting), (0, axis), waiting)(items, params)


_piece = compiled(_of_pieces, seldom=True)


def row_numbers(sol: Solution) -> int:
    """The numbers of a row of one trajectory."""
    return sum(math.prod(info.shape) for info in sol.field_info.values() if info.place == "node")


def sampled_rows(sol: Solution, count: int) -> np.ndarray:
    """Numbers below `count` of the rows that are looked at: all of them, or of a large system some, evenly spread."""
    size = row_numbers(sol)
    if size <= LARGE:
        return np.arange(count)
    most = max(4, SAMPLED_NUMBERS // (size * (sol.batch or 1)))
    return np.unique(np.linspace(0, count - 1, min(most, count)).astype(int))


def energy_of(sol: Solution) -> np.ndarray:
    """`sol.energy()`, found here where it was not before. Raises as it does."""
    own = sol.system is not None and row_numbers(sol) <= LARGE and sol.rows * (sol.batch or 1) <= MANY
    return _of_nodes(sol, "energy", energy_at) if own else np.asarray(sol.energy())


def constraint_of(sol: Solution) -> np.ndarray:
    """`sol.constraint_residual()`, found here where it was not before. Raises as it does."""
    if sol.system is None or "constraint" in sol.fields or row_numbers(sol) > LARGE:
        return np.asarray(sol.constraint_residual())
    return _of_nodes(sol, "constraint_residual", constraint_at)


def _of_nodes(sol: Solution, name: str, function: Callable) -> np.ndarray:
    if name in sol.derived:
        return np.asarray(sol.derived[name])
    nodes = {key: np.asarray(a) for key, a in sol.row_fields.items()}
    found = over_rows(at_rows(sol, function), sol, (nodes,))
    return found if sol.batch is not None else found[0]


def at_rows(sol: Solution, function: Callable, system: AbstractSystem | None = None) -> eqx.Partial:
    """function(system, row, params) as one of rows, of the system of the run or another."""
    return eqx.Partial(_at_row, function, sol.system if system is None else system)


def _at_row(function: Callable, system: AbstractSystem, row: dict, params: Any):
    return function(system, SavedRow(row), params)


def energy_at(system: AbstractSystem, row: dict, params: Any):
    """The energy of a row."""
    return system.energy_at(row, params)


def power_at(system: AbstractSystem, row: dict, params: Any):
    """The rate of the energy at a row, and the size of its terms."""
    return system.power_at(row, params)


def constraint_at(system: AbstractSystem, row: dict, params: Any):
    """The constraint of a row."""
    return system.constraint_at(row, params)


def times_at(sol: Solution, rows: np.ndarray) -> np.ndarray:
    """The times of rows, (…, rows)."""
    t = np.asarray(sol.t)[..., rows]
    return t if sol.batch is None else np.broadcast_to(t, (sol.batch, len(rows)))


def consecutive(sol: Solution, names: tuple[str, ...], points: int, rows: np.ndarray) -> dict[str, np.ndarray]:
    """The saved arrays of these names at `points` rows from each of `rows` on, those of steps at the steps between, and the
    times "t": (…, rows, points, …)."""
    found = {"t": np.stack([times_at(sol, rows + i) for i in range(points)], axis=-1)}
    axis = int(sol.batch is not None)
    for name in names:
        values, lead = sol.fields[name], (slice(None),) * axis
        count = points if sol.field_info[name].place == "node" else points - 1
        found[name] = np.stack([np.asarray(values[(*lead, rows + i)]) for i in range(count)], axis=axis + 1)
    return found


def initial_of_one(sol: Solution) -> dict[str, Any]:
    """The initial data of a run, of the first trajectory of a batch, with the time."""
    data = {name: np.asarray(a)[0] if np.ndim(a) == 2 else np.asarray(a) for name, a in sol.initial.items()}
    return {**data, "t": np.asarray(sol.time_of(0))}


def shape_of(sol: Solution) -> Shape:
    """The sizes of the system of a run."""
    redundant = tuple(sol.stats.get("redundant_constraints", ()))
    return Shape(*sol.system.sizes(initial_of_one(sol), sol.params_of_one), redundant=redundant)
