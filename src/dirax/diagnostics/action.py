"""Discrete action sums, their variations, and discrete energies of trajectories on Q × Q ([PY] §7, [RL] §2)."""

from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from dirax.diagnostics.report import NOT_CHECKED, Line
from dirax.diagnostics.rounding import moved_by_rounding
from dirax.diagnostics.rows import LARGE, consecutive, over_rows, row_numbers, sampled_rows
from dirax.diagnostics.structure_lines import structure_of
from dirax.diagnostics.verdicts import judged, roundoff_limit
from dirax.schemes.discrete_structure_pairs import AbstractPairs
from dirax.solution.solution import Solution

NAME = "action sum stationary"


class Variation(NamedTuple):
    """The derivative of an action sum along a variation of the path, and the sum of the sizes of its terms, to which it is
    relative: numbers, or arrays (B,) of a batch."""

    value: Any
    size: Any


def action_sum(solution: Solution) -> Any:
    """S_d = Σ_k L_d(q_k, q_{k+1}), the discrete action sum of a run ([PY] Definition 7.1; [RL] Theorem 2.9): a float, or (B,).

    At solutions the sum of the Pontryagin principle, Σ L_d(q_k, v_k) + ⟨p_{k+1}, q_{k+1} − v_k⟩ with v_k = q_{k+1}, has the same
    value. Takes runs of schemes with a discrete Lagrangian on Q × Q, every step saved; raises `TypeError` and `ValueError` for
    others.
    """
    pairs = _pairs(solution)
    return _plain(solution, _over_steps(_lagrangian, pairs, solution).sum(axis=1))


def action_variation(solution: Solution, variation: Any) -> Variation:
    """The derivative of the action sum, and of the virtual work of the forces, along an admissible variation δq of the path:

        Σ_k ⟨D2 L_d(q_{k−1}, q_k) + D1 L_d(q_k, q_{k+1}) + f_d^+ + f_d^−, δq_k⟩,   δq_k ∈ Δ(q_k),   δq_0 = δq_N = 0,

    zero for every δq along a solution ([PY] Theorem 7.4: the discrete Lagrange–d'Alembert–Pontryagin principle, which varies q
    alone where v_k = q_{k+1}). `variation` (rows, n), or (B, rows, n): its part in Δ at the inner rows is taken. Raises as
    `action_sum`, and `ValueError` for another shape.
    """
    pairs = _pairs(solution)
    q = np.asarray(solution.q)
    if np.shape(variation) != q.shape:
        raise ValueError(f"variation must have the shape of q, {q.shape}, but it has shape {np.shape(variation)}.")
    varied, items = _varied_items(pairs, solution, variation)
    found = over_rows(varied, solution, items).sum(axis=1)
    return Variation(_plain(solution, found[:, 0]), _plain(solution, found[:, 1]))


def discrete_energy(solution: Solution, sign: str | None = None) -> np.ndarray:
    """The discrete generalized energies of the steps ([PY] Definition 7.3; [RL] §2), of shape (steps,) or (B, steps):

        E⁺ = ⟨p_{k+1}, q_{k+1} − q_k⟩ − L_d(q_k, q_{k+1}),   p_{k+1} = D2 L_d(q_k, q_{k+1}),
        E⁻ = ⟨p_k, q_{k+1} − q_k⟩ − L_d(q_k, q_{k+1}),       p_k = −D1 L_d(q_k, q_{k+1}),

    on a manifold −R⁻¹_{q_{k+1}}(q_k) in E⁺ and R⁻¹_{q_k}(q_{k+1}) in E⁻ taking the place of q_{k+1} − q_k with its retraction R:
    h times an energy each, and not the energy of the system at a node, which is `solution.energy()`. `sign`: "+" or "-"; by
    default that of the scheme, "+" for one that is neither. Raises as `action_sum`, and `ValueError` for another sign.
    """
    pairs = _pairs(solution)
    chosen = sign or pairs.default_sign
    if chosen not in ("+", "-"):
        raise ValueError(f'sign must be "+" or "-", but {sign!r} was given.')
    energies = _over_steps(_plus_energy if chosen == "+" else _minus_energy, pairs, solution)
    return energies if solution.batch is not None else energies[0]


def stationary_action(solution: Solution, structure: Any, tolerance: float | None) -> Line | None:
    """The line of the variational principle: the derivative of the action sum along a variation at random, relative to the sum
    of the sizes of its terms; None for runs of other schemes, of which `membership` says why."""
    if not isinstance(structure, AbstractPairs) or solution.save_every != 1 or solution.rows < 3:
        return None
    if row_numbers(solution) > LARGE and not structure.without_matrix:
        return Line(NAME, None, None, NOT_CHECKED, "which variations are admissible is a matrix, of a large system")
    inner, axis = sampled_rows(solution, solution.rows - 2), int(solution.batch is not None)
    items = consecutive(solution, ("q",), 3, inner)
    moved = np.abs(np.diff(items["q"], axis=axis + 1))
    moved = np.nanmax(moved, axis=tuple(range(moved.ndim - 1)), initial=0.0)  # the units of each coordinate
    units = np.where(moved > 0.0, moved, 1.0)
    along = units * np.random.default_rng(0).normal(size=np.take(items["q"], 1, axis=axis + 1).shape)
    varied, items = eqx.Partial(_varied, structure), (items, along, np.broadcast_to(units, along.shape))
    terms, limit = over_rows(varied, solution, items), roundoff_limit(tolerance, 1)
    value, size = np.nansum(terms, axis=1).T
    if np.any(np.abs(value) > limit * size):  # what cancels inside of D L_d, as differences of q over h, may be much larger
        moved = np.sum(moved_by_rounding(terms, varied, solution, items)[..., 0], axis=2)
        size = np.maximum(size, np.max(np.abs(moved), axis=0))
    relative = np.abs(value) / np.where(size > 0, size, 1.0)
    text = "Σ⟨D₂L_d + D₁L_d, δq⟩ along a variation δq ∈ Δ at random, relative to its terms"
    if len(inner) < solution.rows - 2:
        text += f", which is zero but at {len(inner)} of {solution.rows - 2} rows"
    return judged(solution, NAME, relative, limit, text)


def _varied_items(structure: AbstractPairs, solution: Solution, variation: Any) -> tuple[eqx.Partial, tuple]:
    """The function of (the term, the sum of its sizes) of each inner row, for `over_rows`, and its items."""
    inner = np.arange(solution.rows - 2)
    items = consecutive(solution, ("q",), 3, inner)
    along = np.take(np.asarray(variation, float), inner + 1, axis=np.ndim(solution.q) - 2)
    return eqx.Partial(_varied, structure), (items, along, np.ones_like(along))


def _pairs(solution: Solution) -> AbstractPairs:
    if not isinstance(solution, Solution):
        raise TypeError(f"solution must be a dirax Solution, but a {type(solution).__name__} was given.")
    pairs = structure_of(solution)
    if not isinstance(pairs, AbstractPairs):
        raise TypeError(
            "action sums are of schemes with a discrete Lagrangian on Q × Q, such as dx.LagrangeDAlembert and "
            f"dx.PlusLagrangeDirac, but this run was by {solution.scheme!r}."
        )
    if solution.save_every != 1 or solution.rows < 3:
        raise ValueError(
            f"action sums need every step of two at least, but {solution.rows} rows were saved with save_every = "
            f"{solution.save_every}: run again with save_every=1."
        )
    return pairs


def _over_steps(function: Any, pairs: AbstractPairs, solution: Solution) -> np.ndarray:
    """(B, steps)."""
    return over_rows(eqx.Partial(function, pairs), solution, (consecutive(solution, ("q",), 2, np.arange(solution.rows - 1)),))


def _plain(solution: Solution, values: np.ndarray) -> Any:
    return values if solution.batch is not None else float(values[0])


def _lagrangian(of, rows, params):
    pairs, rows, params = of.in_coordinates(rows, 0, params)
    return pairs.lagrangian(rows["t"][0], *rows["q"], params)


def _plus_energy(of, rows, params):
    pairs, rows, params = of.in_coordinates(rows, 1, params)
    q0, q1 = rows["q"]
    return pairs.slots(rows["t"][0], q0, q1, params)[1] @ (q1 - q0) - _lagrangian(pairs, rows, params)


def _minus_energy(of, rows, params):
    pairs, rows, params = of.in_coordinates(rows, 0, params)
    q0, q1 = rows["q"]
    return -pairs.slots(rows["t"][0], q0, q1, params)[0] @ (q1 - q0) - _lagrangian(pairs, rows, params)


def _varied(of, rows, along, units, params):
    """(the term of the inner row, the sum of its sizes); the variation is put on the constraints in these units of q."""
    pairs, rows, params = of.in_coordinates(rows | {"along": along}, 1, params)
    along, t, (q0, q1, q2) = rows["along"], rows["t"], rows["q"]
    arriving, leaving = pairs.slots(t[0], q0, q1, params)[1], pairs.slots(t[1], q1, q2, params)[0]
    units = units if pairs is of else jnp.ones_like(along)  # of charts they are others
    admissible = pairs.admissible(t[1], q1, along, units, params)
    sizes = (jnp.abs(arriving) + jnp.abs(leaving)) @ jnp.abs(admissible)
    return jnp.stack([(arriving + leaving) @ admissible, sizes])
