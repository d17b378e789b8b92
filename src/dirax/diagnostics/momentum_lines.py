"""Lines of `dx.verify` on the momentum maps of the symmetries that the user names."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from dirax.diagnostics.replay_lines import moved_numbers
from dirax.diagnostics.report import NOT_CHECKED, Line
from dirax.diagnostics.rows import initial_of_one, over_rows
from dirax.diagnostics.verdicts import judged, of_lane, relative_changes, roundoff_limit, steps_of
from dirax.numerics.arrays import is_whole
from dirax.solution.solution import Solution

Symmetries = Mapping[str, Callable] | Sequence[int] | None
"""{name: generator(q) -> (n,)}, or the numbers of cyclic coordinates."""


def generators_of(sol: Solution, symmetries: Symmetries) -> dict[str, Callable]:
    """The generators q ↦ ξ_Q(q) by name, from what `verify` was given; raises `TypeError` for anything else."""
    if symmetries is None:
        return {}
    if isinstance(symmetries, Mapping):
        for name, generator in symmetries.items():
            if not callable(generator):
                raise TypeError(
                    f"symmetries[{name!r}] must be a function generator(q) -> (n,), but a {type(generator).__name__} was given."
                )
            if "q" in sol.fields:
                _check_generator(name, generator, np.shape(sol.q)[-1])
        return {str(name): generator for name, generator in symmetries.items()}
    if isinstance(symmetries, (str, bytes)) or not isinstance(symmetries, Sequence | np.ndarray):
        raise TypeError(
            "symmetries must be a dict {name: generator(q)} or a list of coordinate numbers, but a "
            f"{type(symmetries).__name__} was given."
        )
    if "q" not in sol.fields:
        raise ValueError(f"symmetries need a solution with q and p, but this one holds {', '.join(sol.fields)}.")
    n, found = np.shape(sol.q)[-1], {}
    for index in symmetries:
        if not is_whole(index) or not 0 <= index < n:
            raise ValueError(f"symmetries must name coordinates by whole numbers from 0 to {n - 1}, but {index!r} was given.")
        found[f"p[{int(index)}]"] = eqx.Partial(_translation, int(index))
    return found


def _translation(index: int, q):
    return jnp.zeros_like(q).at[index].set(1.0)


def _check_generator(name: str, generator: Callable, n: int) -> None:
    try:
        out = jax.eval_shape(generator, jax.ShapeDtypeStruct((n,), jnp.float64))
    except Exception as error:
        raise TypeError(
            f"symmetries[{name!r}](q) could not be traced by JAX for q of shape ({n},): "
            f"{type(error).__name__}: {str(error).splitlines()[0]}"
        ) from error
    if getattr(out, "shape", None) != (n,):
        raise ValueError(f"symmetries[{name!r}](q) must return shape ({n},), but it returned {getattr(out, 'shape', out)}.")


def momentum(sol: Solution, name: str, generator: Callable, tolerance: float | None) -> Line:
    """The line of the momentum map ⟨p, ξ_Q(q)⟩ of one generator."""
    title = f"momentum map {name}"
    if "p" not in sol.fields or "q" not in sol.fields:
        return Line(title, None, None, NOT_CHECKED, "the solution has no q and p")
    terms, limit = eqx.Partial(_momentum_terms, generator), roundoff_limit(tolerance, steps_of(sol))
    values = over_rows(terms, sol, (np.asarray(sol.q), np.asarray(sol.p)))
    scale = np.nanmax(values[..., 1], axis=1)
    change, relative = relative_changes(values[..., :1], scale)
    if np.any(relative > limit):  # a momentum near zero is a sum of terms that may be large
        moved = np.broadcast_to(moved_numbers(sol, "p")[0], np.shape(sol.p))
        moved = np.nanmax(over_rows(terms, sol, (np.asarray(sol.q), moved))[..., 1], axis=1)
        change, relative = relative_changes(values[..., :1], np.maximum(scale, moved))
    lane = int(np.argmax(relative))
    text = f"⟨p, ξ⟩ = {values[lane, 0, 0]:.6g} changed by at most {change[lane]:.2g}{of_lane(sol, lane)}"
    return judged(sol, title, relative, limit, text)


def quotient_momentum(sol: Solution, tolerance: float | None) -> list[Line]:
    """μ of a run on the quotient by an abelian symmetry, relative to the largest momentum, w and μ."""
    quotient = None if sol.system is None else sol.system.quotient_form()
    if quotient is None:
        return []
    rows = {name: np.asarray(sol.fields[name]) for name in quotient.own_fields}
    title, mu = "momentum map μ", over_rows(eqx.Partial(_momentum_of_row, quotient), sol, (rows,))
    w = np.asarray(sol.fields["w"]).reshape(*mu.shape[:2], -1)
    scale = np.nanmax(np.abs(np.concatenate([mu, w], axis=2)), axis=(1, 2))
    change, relative = relative_changes(mu, scale)
    lane = int(np.argmax(change))
    text = f"{np.array2string(mu[lane, 0], precision=6)} changed by at most {change[lane]:.2g}{of_lane(sol, lane)}"
    if moves := quotient.moves_momentum(initial_of_one(sol), sol.params_of_one):
        what = moves.split(":")[0]  # whose forces move
        return [Line(title, float(change[lane]), None, NOT_CHECKED, f"{what} it, which have a part along the group; {text}")]
    return [judged(sol, title, relative, roundoff_limit(tolerance, steps_of(sol)), text)]


def _momentum_of_row(quotient: Any, row: dict, params: Any):
    return quotient.momentum_map(row)


def _momentum_terms(generator: Callable, q, p, params: Any):
    terms = p * generator(q)
    return jnp.stack([jnp.sum(terms), jnp.sum(jnp.abs(terms))])
