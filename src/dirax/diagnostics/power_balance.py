"""The books of a system with ports: what is stored is what was supplied less what was dissipated ([BLM] §7.1)."""

from typing import Any

import equinox as eqx
import numpy as np

from dirax.diagnostics.replay_lines import moved_numbers
from dirax.diagnostics.report import NOT_CHECKED, OK, VIOLATED, Line
from dirax.diagnostics.rows import energy_of, over_rows
from dirax.diagnostics.verdicts import relative_to, roundoff_limit
from dirax.schemes.step import CLOCK
from dirax.solution.solution import Solution

PORTS = 2
"""Entries of `work` where it keeps books: energy supplied, energy dissipated."""


def keeps_books(sol: Solution) -> bool:
    """Whether the run carries the energy supplied and dissipated since the start, as `dx.DiscreteGradient` does."""
    return "work" in sol.fields and sol.field_info["work"].shape == (PORTS,)


def has_power(sol: Solution) -> bool:
    """Whether the run saves the power stored, supplied and dissipated in every step."""
    return "power" in sol.fields and sol.field_info["power"].dims == ("power",)


def balances(sol: Solution, energy_scale: float, tolerance: float | None) -> list[Line]:
    """The power balance of every step, and the books over the whole run, where the solution has them.

    `energy_scale`: what one unit of roundoff of the rows is to H, in units of ε. A batch is judged by its worst trajectory.
    """
    limit = roundoff_limit(tolerance, 1)
    lines = []
    if has_power(sol):
        lines.append(_step_balance(sol, energy_scale, limit))
    if keeps_books(sol):
        lines.append(_whole_balance(sol, energy_scale, limit))
    return lines


def _step_balance(sol: Solution, energy_scale: float, limit: float) -> Line:
    """stored − supplied + dissipated of every saved step; with a discrete gradient, stored·h is the change of H."""
    name = "power balance of every step"
    stored, supplied, dissipated = np.moveaxis(np.asarray(sol.fields["power"]), -1, 0)
    if stored.size == 0:
        return Line(name, None, None, NOT_CHECKED, "no step was saved")
    h = _lengths(sol)
    sizes = np.abs(stored) + np.abs(supplied) + np.abs(dissipated) + energy_scale / h + _flow(sol)
    missed = np.abs(stored - supplied + dissipated)
    text = "power stored ⟨dH, ẋ⟩ less supplied plus dissipated, at the base points"
    if keeps_books(sol):
        text = "power stored less supplied plus dissipated"
        if sol.save_every == 1 and np.all(sol.ok):
            change = np.diff(energy_of(sol), axis=-1) / h
            missed = np.maximum(missed, np.abs(change - stored))
            text += "; stored is the change of H"
    if np.any(missed > limit * sizes):  # a difference quotient of H over a small Δx is off by more
        sizes = np.maximum(sizes, np.sum(moved_numbers(sol, "power")[0]))
    return _line(name, float(np.nanmax(relative_to(missed, sizes))), limit, text)


def _lengths(sol: Solution) -> Any:
    """The length of a step, or the lengths (…, rows − 1) of those that leave the rows, where each has its own."""
    if CLOCK not in sol.fields:
        return float(sol.step)
    return np.diff(np.asarray(sol.fields[CLOCK]), axis=-1) / sol.save_every


def _flow(sol: Solution) -> float:
    """The largest sum of the sizes of the terms of ⟨dH, ẋ⟩, which may cancel, at the saved rows."""
    return float(np.nanmax(over_rows(eqx.Partial(_flow_size, sol.system), sol, (np.asarray(sol.fields["x"]),))))


def _flow_size(system: Any, x, params: Any):
    return system.flow_size(x, params)


def _whole_balance(sol: Solution, energy_scale: float, limit: float) -> Line:
    """H − H(0) − supplied + dissipated at every saved row, since the first one."""
    energy, work = energy_of(sol), np.asarray(sol.fields["work"])
    supplied, dissipated = np.moveaxis(work - work[..., :1, :], -1, 0)
    missing = np.abs(energy - energy[..., :1] - supplied + dissipated)
    sizes = energy_scale + np.abs(supplied) + np.abs(dissipated)
    worst = float(np.nanmax(relative_to(missing, sizes)))
    line = _line("books of the energy", worst, limit, "H − H(0) less supplied plus dissipated")
    line.details.update(
        imbalance=float(np.nanmax(missing)),
        supplied=float(np.ravel(supplied[..., -1])[0]),
        dissipated=float(np.ravel(dissipated[..., -1])[0]),
    )
    return line


def _line(name: str, value: float, limit: float, text: str) -> Line:
    return Line(name, value, limit, OK if value <= limit else VIOLATED, text)
