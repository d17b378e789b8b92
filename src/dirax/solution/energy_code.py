"""The energy at many rows by compiled code: a velocity that belongs to a momentum takes a decomposition of a matrix in NumPy, and
a loop in XLA, which for some rows would take longer than the steps between them."""

from collections.abc import Callable
from typing import Any

import jax
import numpy as np

import dirax.program.rules  # noqa: F401  (registers the rules)
from dirax.numerics.arrays import agree
from dirax.program.graph import NODE_LIMIT, Graph, GraphTooLarge
from dirax.program.interpreter import Interpreter, Nodes, Unsupported, UnsupportedPrimitive
from dirax.program.memo import Memo, by_value
from dirax.program.rules.linear_algebra import solve_blocks
from dirax.program.scalar_program import ScalarProgram
from dirax.program.tracing import jacobian, of_one_result

SAME = 1e-9
"""How far it may be from `Solution.energy`, relative to the largest energy."""

ROUNDINGS = 1e-13
"""The same for what is to have no more than roundoff of its own."""

AT_ONCE = 2**18
"""Rows of all trajectories whose numbers are put side by side at a time."""

COMPARED = 8
"""Rows of a long run, evenly spread, at which compiled code is compared with what is found without it."""


def energy_of(sol: Any) -> np.ndarray:
    """`sol.energy()` (B, rows) of a batch: by compiled code, and as it is where that has no answer."""
    made = _compiled(sol)
    if made is None:
        return np.asarray(sol.energy())
    found = made(sol)
    if len(lost := np.flatnonzero(_lost(sol, found))):
        found[lost] = sol[lost].energy()
    return found


def _lost(sol: Any, found: np.ndarray) -> np.ndarray:
    """Which trajectories (B,) have rows without an energy (B, rows), though they were computed: where a matrix is singular."""
    nodes = [np.asarray(a).reshape(*found.shape, -1) for k, a in sol.fields.items() if sol.field_info[k].place == "node"]
    there = np.logical_and.reduce([np.all(np.isfinite(a), axis=-1) for a in nodes])
    return np.any(there & ~np.isfinite(found), axis=1)


def energies_of(sol: Any, at_rows: Callable[[list[int]], np.ndarray | None]) -> np.ndarray | None:
    """The energy (…, rows) of a long run by compiled code, if it agrees with that `at_rows` of a few numbers, (…, COMPARED); None
    where it has no answer."""
    try:
        made = _compiled(sol)
    except (ImportError, OSError, RuntimeError):
        return None
    rows = np.linspace(0, sol.rows - 1, COMPARED).astype(int).tolist()
    if made is None or (expected := at_rows(rows)) is None:
        return None
    found = made(sol)
    if np.any(_lost(sol, found)):
        return None
    found = found[0] if sol.batch is None else found
    return found if agree(found[..., rows], expected, ROUNDINGS) else None


def is_quick(sol: Any) -> bool:
    """Whether the compiled code gives the energy of these trajectories."""
    try:
        made = _compiled(sol)
        return made is not None and agree(made(sol), np.asarray(sol.energy()), SAME)
    except (ImportError, OSError, RuntimeError):
        return False


_functions: Memo[Callable | None] = Memo(16)


def _compiled(sol: Any) -> Callable[[Any], np.ndarray] | None:
    """The energies (B, rows) of solutions like this one; None where their system has no scalar program."""
    names = tuple(k for k in sol.fields if sol.field_info[k].place == "node")
    leaves, structure = jax.tree.flatten(sol.given_params)
    shapes = tuple(np.shape(leaf)[1:] if sol.batch_params else np.shape(leaf) for leaf in leaves)
    kinds = tuple(np.asarray(leaf).dtype for leaf in leaves)
    if any(kind.kind not in "fiub" for kind in kinds):
        return None
    key = by_value(sol.system), names, structure, shapes, tuple(kind.str for kind in kinds)

    def make() -> Callable | None:
        row = [jax.ShapeDtypeStruct(sol.field_info[name].shape, np.float64) for name in names]
        given = [*row, jax.ShapeDtypeStruct((), np.float64), *map(jax.ShapeDtypeStruct, shapes, kinds)]

        def one(*values: Any) -> Any:
            fields = dict(zip((*names, "t"), values, strict=False))
            return sol.system.energy_at(fields, jax.tree.unflatten(structure, values[len(names) + 1 :]))

        return _function(one, given)

    run = _functions.get(key, make)
    return None if run is None else lambda sol: _run(run, sol, names)


def _function(one: Callable, given: list[Any]) -> Callable | None:
    """A compiled function (numbers, entries) → (1, entries); None where there is none."""
    closed = jax.make_jaxpr(one)(*given)
    made = ScalarProgram(Graph(NODE_LIMIT), [])
    made.inputs = [made.fresh(kind.shape) for kind in given]
    try:
        made.run(closed, {"dirax_root": _affine_root})
    except (UnsupportedPrimitive, GraphTooLarge):
        return None
    inputs = [node for nodes in made.inputs for node in nodes.ravel().tolist()]
    from dirax.engines.native.ir.compiled_function import compiled
    from dirax.program import machine_code as llvm  # imported when they are used

    return compiled(made.graph, inputs, made.results[0].ravel().tolist(), llvm.vector_width())


def _affine_root(interpreter: Interpreter, equation: Any, *operands: Nodes) -> list[Nodes]:
    """The root of equations that are affine in their unknowns, such as p = ∂L/∂v for a kinetic energy: by one elimination, and
    once more for what rounding left."""
    closed, g = equation.params["residual"], interpreter.graph
    if equation.params["axes"]:
        raise Unsupported("is one of many side by side")
    *captured, root = operands
    slope = jax.make_jaxpr(jacobian(of_one_result(closed), len(captured)))(*closed.in_avals)
    first = len(g)
    unknowns = np.array([g.input(f"u{first + k}") for k in range(root.size)], np.int64).reshape(root.shape)
    matrix = interpreter.run(slope, *captured, unknowns)[0]
    if not isinstance(matrix, np.ndarray) or np.any(np.isin(unknowns, g.reachable(matrix.ravel().tolist()))):
        raise Unsupported("is not affine in its unknowns")
    for _ in range(2):
        residual = interpreter.run(closed, *captured, root)[0]
        change = solve_blocks(g, matrix, residual[:, None])[:, 0]
        root = np.array([g.sub(a, b) for a, b in zip(root.tolist(), change.tolist(), strict=True)], np.int64)
    return [root]


def _run(run: Callable, sol: Any, names: tuple[str, ...]) -> np.ndarray:
    lanes, rows = 1 if sol.batch is None else sol.batch, sol.rows
    fields = [np.asarray(sol.fields[name]).reshape(lanes * rows, -1) for name in names]
    times, params = np.asarray(sol.t), [np.asarray(leaf, np.float64) for leaf in jax.tree.leaves(sol.given_params)]
    found = np.empty(lanes * rows)
    for low in range(0, lanes * rows, AT_ONCE):
        entries = np.arange(low, min(low + AT_ONCE, lanes * rows))
        lane, row = entries // rows, entries % rows
        columns = [values[entries].T for values in fields]
        columns.append((times[row] if times.ndim == 1 else times[lane, row])[None])
        for values in params:
            own = values.reshape(lanes, -1)[lane].T if sol.batch_params else values.reshape(-1, 1)
            columns.append(np.broadcast_to(own, (len(own), len(entries))))
        found[entries] = run(np.concatenate(columns))[0]
    return found.reshape(lanes, rows)
