"""The final constraint manifold of a singular Lagrangian, as a premise: initial data on it, and steps that stay on it."""

import dataclasses
import warnings
from collections.abc import Callable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dirax.numerics.equilibration import equilibrated
from dirax.numerics.ranks import rank_of_equations
from dirax.numerics.tolerances import MANIFOLD_RANK, ON_MANIFOLD
from dirax.program.memo import Memo, Same, by_value
from dirax.program.tracing import jacobian
from dirax.program.user_functions import evaluated
from dirax.run.start import Initial, completed
from dirax.run.validate import Case
from dirax.systems.constraint_algorithm import constraint_algorithm, final_manifold_needed
from dirax.systems.constraint_chain import EMPTY, GAUGE, IRREGULAR, ConstraintChain
from dirax.systems.shape import Shape
from dirax.systems.system import AbstractSystem

UPDATES = 30
"""Updates of Newton's method in the step that is tried."""

MOVED = 2.0**-17
"""By how much of itself a velocity is changed to see whether its momentum follows."""

MOST = 200
"""Coordinates up to which it is asked: the matrix of all of them is not for a chain of thousands."""

SEVERAL = 64
"""Trajectories of a batch that are asked, evenly spread."""

DOUBTFUL = 1e-4
"""Smallest singular value of that change, rows and columns scaled to 1, that leaves no doubt of a regular Lagrangian: larger than
what p that is not linear in v makes of the change, of the order of MOVED."""

_chains: Memo[ConstraintChain | None] = Memo(64)


def is_singular(system: AbstractSystem, shape: Shape, case: Case, initial: Initial) -> bool:
    """Whether ∂²L/∂v² is singular at the data of a trajectory, of a system that does not say its final manifold itself.

    Asked first is how p follows v, or v follows p, in numbers of the program that completes the data; the Hessian where that
    leaves a doubt. What is regular once is not asked again. Of a batch SEVERAL trajectories are asked, the first and the last
    among them.
    """
    if len(case.data) < 2 or not case.data.keys() & {"q", "q0"}:
        return False
    given = tuple(np.asarray(leaf).tobytes() for leaf in jax.tree.leaves(case.params))
    ask = lambda: _is_singular(system, shape, *(_at_either_point(system, case)[0] if case.two_points else (case, initial)))
    return _singular.get((by_value(system), given, case.batch, *case.data), ask)


def _at_either_point(system: AbstractSystem, case: Case) -> list[tuple[Case, Initial]]:
    """What starts at each of two points with the velocity between them, and its initial data."""
    v = (case.data["q1"] - case.data["q0"]) / case.h
    times = case.t0, case.t0 + case.h
    cases = [dataclasses.replace(case, data={"q": q, "v": v}, t0=t) for q, t in zip(case.data.values(), times, strict=True)]
    return [(near, completed(system, near, False)) for near in cases]


_singular: Memo[bool] = Memo(256)


def _is_singular(system: AbstractSystem, shape: Shape, case: Case, initial: Initial) -> bool:
    if system.metric_form() is not None or system.lagrangian_form() is None or system.final_relation(shape) is not None:
        return False
    lanes = lanes_asked(case.batch or 1)
    arrays = {name: np.atleast_2d(np.asarray(a, float)) for name, a in case.data.items()}
    data = {name: np.broadcast_to(a, (case.batch or 1, a.shape[1]))[lanes] for name, a in arrays.items()}
    count, n = data["q"].shape
    if n > MOST:
        return False
    moved, answers = ("v", "p") if "v" in data else ("p", "v")
    sizes = np.max(np.abs(data[moved]), axis=1)
    changes = MOVED * np.where(sizes > 0, sizes, 1.0)[:, None, None] * np.eye(n + 1, n, -1)
    near = {"q": np.repeat(data["q"], n + 1, axis=0), moved: (data[moved][:, None] + changes).reshape(-1, n)}
    own = lambda leaf: np.repeat(np.asarray(leaf)[lanes], n + 1, axis=0)
    params = jax.tree.map(own, case.params) if case.batch_params else case.params
    varied = Case(near, params, case.h, case.t0, count * (n + 1), case.batch_params)
    answer = np.asarray(completed(system, varied, False).data[answers]).reshape(count, n + 1, n)
    response = equilibrated(answer[:, 1:] - answer[:, :1], rounds=1)[0]
    finite = np.all(np.isfinite(response), axis=(1, 2))
    smallest = np.linalg.svd(np.where(finite[:, None, None], response, 0.0), compute_uv=False)[:, -1]
    of_lane = lambda a, lane: np.asarray(a)[lane] if case.batch is not None else np.asarray(a)
    for lane in lanes[smallest <= DOUBTFUL].tolist():
        at = [of_lane(initial.data[name], lane) for name in ("q", "v")]
        params = jax.tree.map(lambda leaf, lane=lane: leaf[lane], case.params) if case.batch_params else case.params
        hessian = np.asarray(evaluated(system.velocity_hessian, np.asarray(case.t0), *at, params))
        if np.all(np.isfinite(hessian)) and rank_of_equations(hessian[None], MANIFOLD_RANK)[0][0] < n:
            return True
    return False


def lanes_asked(batch: int) -> np.ndarray:
    """The trajectories of a batch that are asked for their Hessian."""
    return np.unique(np.linspace(0, batch - 1, SEVERAL).astype(int))


def chain_at(system: AbstractSystem, q: Any, v: Any, t: float, params: Any) -> ConstraintChain | None:
    """The constraint chain around (q, v); None where the algorithm does not take the system, or ends irregular."""
    given = tuple(np.asarray(leaf).tobytes() for leaf in (q, v, t, *jax.tree.leaves(params)))

    def found() -> ConstraintChain | None:
        try:
            chain = constraint_algorithm(system, {"q": np.asarray(q), "v": np.asarray(v), "t": float(t)}, params)
        except (TypeError, ValueError):
            return None
        return None if chain.verdict == IRREGULAR else chain

    return _chains.get((by_value(system), given, jax.tree.structure(params)), found)


def needed_at(system: AbstractSystem, case: Case, initial: Initial) -> str:
    """What a scheme for regular Lagrangians says it needs at the data of the first trajectory, where this one is singular."""
    near, complete = _at_either_point(system, case)[0] if case.two_points else (case, initial)
    q, _, v, params = next(lanes_of(near, complete))
    return final_manifold_needed(system, {"q": q, "v": v, "t": float(case.t0)}, params)


def on_chain(chain: ConstraintChain, q: Any, p: Any, v: Any, t: Any, params: Any, q_alone: bool = False) -> Any:
    """The point x of the chain with these q and p; where v is among its coordinates, the nearest one that the chain admits.
    With `q_alone` the nearest p that it admits as well."""
    q, p, v = map(np.asarray, (q, p, v))
    n, time = len(q), [float(t)] if chain.clock else []
    without_v = len(chain.coordinates) - chain.clock == 2 * n
    x = np.concatenate([q, p, time] if without_v else [q, v, p, time])
    return moved_onto(chain, x, slice(n, len(x) - chain.clock if q_alone else n if without_v else 2 * n), params)


def moved_onto(chain: ConstraintChain, x: np.ndarray, moved: slice, params: Any) -> np.ndarray:
    """The point x with some of its coordinates moved, by least squares, to where the chain admits it."""
    for _ in range(UPDATES if x[moved].size else 0):
        value = np.asarray(chain.constraints(jnp.asarray(x), params))
        slope = np.asarray(evaluated(slope_of(chain), x, params)) * chain.units
        change = np.linalg.lstsq(slope[:, moved], value, rcond=1e-10)[0]
        x[moved] -= change * chain.units[moved]
        if np.max(np.abs(change), initial=0.0) <= 1e-15 * (1 + np.max(np.abs(x / chain.units))):
            break
    return x


_slopes: Memo[Callable] = Memo(64)


def slope_of(chain: ConstraintChain) -> Callable:
    """The derivative of the constraints of a chain as a function of (x, params)."""
    return _slopes.get(Same(chain), lambda: lambda x, params: jacobian(lambda x: chain.constraints(x, params))(x))


def projected_onto_manifold(system: AbstractSystem, case: Case, initial: Initial) -> Case | None:
    """The case with q, p and v on the final manifold, those nearest to the data; None where no chain says what it is."""
    if case.two_points:
        return None
    found = []
    for q, p, v, params in lanes_of(case, initial):
        chain = chain_at(system, q, v, case.t0, params)
        if chain is None or chain.empty:
            return None
        x, n = np.asarray(chain.project(on_chain(chain, q, p, v, case.t0, params), params)), len(q)
        found.append((x[:n], x[len(x) - chain.clock - n : len(x) - chain.clock]))
    points = [np.stack(a) if case.batch is not None else a[0] for a in zip(*found, strict=True)]
    return Case({"q": points[0], "p": points[1]}, case.params, case.h, case.t0, case.batch, case.batch_params)


def refuse_off_final_manifold(system: AbstractSystem, case: Case, initial: Initial) -> None:
    """Raise `ValueError` for data of a singular Lagrangian that are off its final manifold, which the scheme would not find:
    its steps would jump between solutions of the discrete equations that belong to no motion. Of two points each needs a point
    of the manifold over it."""
    if not case.two_points:
        return _refuse_off(system, case, initial, "they are", "pass project=True to project them")
    for name, (near, complete) in zip(case.data, _at_either_point(system, case), strict=True):
        _refuse_off(system, near, complete, f"{name}= is", "start from q= and v= with project=True")


def _refuse_off(system: AbstractSystem, case: Case, initial: Initial, are: str, way: str) -> None:
    q_alone = are != "they are"
    for lane, (q, p, v, params) in enumerate(lanes_of(case, initial)):
        if _on_known_manifold(system, q, p, v, case.t0, params):
            continue
        chain = chain_at(system, q, v, case.t0, params)
        if chain is None:
            continue
        which = f" of trajectory {lane}" if case.batch is not None else ""
        singular = f"the Lagrangian is singular at the initial data{which} (∂²L/∂v²), and"
        if chain.verdict == EMPTY:
            raise ValueError(f"{singular} no motion passes through them: {chain.explanation[:-1].split(': ')[0]}.")
        if chain.verdict == GAUGE:
            raise ValueError(
                f"{singular} they do not determine a motion: {chain.explanation[:-1]}. Steps through them, where they have a "
                "unique solution at all, are made of errors of the discretization: state the Lagrangian of a given "
                "parametrization, L(t, q, v) of one with regular ∂²L/∂v², or fix the gauge by a constraint."
            )
        if off := chain.off_level(on_chain(chain, q, p, v, case.t0, params, q_alone), params):
            raise ValueError(
                f"{singular} {are} off its final constraint manifold: {off}; {way}, or check_initial=False to take them as "
                "they are."
            )


def _on_known_manifold(system: AbstractSystem, q: Any, p: Any, v: Any, t: float, params: Any) -> bool:
    """Whether a point is on the final manifold beyond doubt, by the chain that was first found for the system, elsewhere: in no
    units but those of the point, since those of the chain belong to other data. Zeros among params may make it another one."""
    leaves = [np.asarray(leaf) for leaf in jax.tree.leaves(params)]
    key = by_value(system), jax.tree.structure(params), *((leaf.shape, (leaf != 0).tobytes()) for leaf in leaves)
    chain = _chains.get(key, lambda: chain_at(system, q, v, t, params))
    if chain is None or chain.empty or chain.verdict == GAUGE:
        return False
    x = on_chain(chain, q, p, v, t, params)
    value, slope = np.asarray(chain.constraints(x, params)), np.asarray(evaluated(slope_of(chain), x, params))
    terms = np.abs(slope) @ np.abs(x)
    return value.size > 0 and bool(np.all(np.abs(value) <= ON_MANIFOLD * terms))  # none says nothing of other points


def lanes_of(case: Case, initial: Initial) -> Iterator[tuple[Any, Any, Any, Any]]:
    """(q, p, v, params) of every trajectory."""
    data = initial.data
    arrays = [np.asarray(data[name]) for name in ("q", "p", "v")]
    for lane in range(case.batch or 1):
        params = jax.tree.map(lambda leaf, lane=lane: leaf[lane], case.params) if case.batch_params else case.params
        q, p, v = (a[lane] if case.batch is not None else a for a in arrays)
        yield q, p, v, params


LOOKED_AT, FEWEST_ROWS = 64, 16
"""Rows of a trajectory that are looked at, evenly spread, and how many a trajectory must have."""

FAR, GROWN, VISIBLE = 0.3, 30.0, 1e-3
"""A trajectory has left M_f where in its last quarter the constraints are off by `FAR` of their terms and more than in its first
quarter, or by `GROWN` times as much and visibly."""


def left_manifold(chain: ConstraintChain, t: np.ndarray, q: np.ndarray, p: np.ndarray, v: Any, params: Any) -> str:
    """In words, that the rows (rows, n) of a trajectory leave the final manifold; "" where they do not."""
    if len(t) < FEWEST_ROWS:
        return ""
    rows = np.unique(np.linspace(0, len(t) - 1, LOOKED_AT).astype(int))
    x = [on_chain(chain, q[i], p[i], v, t[i], params) for i in rows]
    slope = np.max([np.abs(np.asarray(evaluated(slope_of(chain), point, params)) * chain.units) for point in x[:2]], axis=(0, 2))
    size = slope * max(float(np.max(np.abs(point / chain.units))) for point in x[:2])
    values = np.abs([np.asarray(chain.constraints(jnp.asarray(point), params)) for point in x])
    off = np.max(values / np.where(size > 0, size, 1.0), axis=1, initial=0.0)
    few = len(rows) // 4
    early, late = float(np.nanmax(off[:few])), float(np.nanmax(off[-few:]))
    if not (late > max(FAR, 3.0 * early) or late > max(VISIBLE, GROWN * early)):
        return ""
    return (
        f"the trajectory leaves the final manifold of its singular Lagrangian: the constraints of M_f are off by {early:.2g} of "
        f"their terms at first, and by {late:.2g} at t = {t[-1]:.6g}. Steps of T*Q have motions off M_f that are none of the "
        "system, and here they grow, whatever the step: simulate dx.constraint_algorithm(system, near=…).resolved() by "
        "dx.DiscreteDirac() instead"
    )


def warn_of_leaving(sol: Any) -> None:
    """Warn of the first trajectory of a run with a singular Lagrangian that leaves its final manifold."""
    if not {"q", "p"} <= sol.fields.keys() or sol.q.shape[-1] > MOST or sol.rows < FEWEST_ROWS:
        return
    chain = None
    for lane in lanes_asked(sol.batch or 1).tolist():
        one = sol if sol.batch is None else sol[lane]
        q, p, t = np.asarray(one.q), np.asarray(one.p), np.asarray(one.t)
        v = one.initial.get("v", np.zeros_like(q[0]))
        if chain is None or sol.batch_params:  # that of one trajectory serves all with its params: to find one takes a while
            chain = chain_at(sol.system, q[0], v, float(t[0]), one.params)
        if chain is None or chain.empty or len(chain.coordinates) - chain.clock != 2 * q.shape[1]:
            continue
        if text := left_manifold(chain, t, q, p, v, one.params):
            warnings.warn(text + (f" (trajectory {lane})." if sol.batch is not None else "."), RuntimeWarning, stacklevel=4)
            return
