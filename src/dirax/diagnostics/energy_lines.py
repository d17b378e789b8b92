"""Lines of `dx.verify` on the energy and on the books of ports."""

from functools import partial
from typing import Any

import numpy as np

from dirax.diagnostics.drift import judge
from dirax.diagnostics.energy_jumps import NOTICED, energy_jump
from dirax.diagnostics.power_balance import balances, has_power, keeps_books
from dirax.diagnostics.report import BOUNDED, DRIFTS, NOT_CHECKED, VIOLATED, Line
from dirax.diagnostics.rows import LARGE, at_rows, energy_at, energy_of, over_rows, power_at, row_numbers
from dirax.diagnostics.verdicts import ROUNDINGS, of_lane, sampled, sampled_terms, spread, steps_of
from dirax.numerics.tolerances import EPSILON
from dirax.schemes.energy_collocation_step import NOTICED as DEFECT
from dirax.schemes.step import CLOCK
from dirax.solution.solution import Solution

BY_WALLS = 10.0
"""A change in a step that a wall divides is one by the wall where it is so many times that of any other step."""

FAR, SUDDEN, BALANCED = 1000.0, 10.0, 0.1
"""An energy has blown up that moves by so many times its terms at the start in a run, or from one row to the next, and by such a
part of its terms in the run."""

POWER = 1e-9
"""The rate of an energy is none that is such a part of its terms."""

SITES = 64
"""Numbers of each field that show how fast a large system moves."""

PARTS_AT = 2000
"""Rows, evenly spread, at which the parts of an energy are looked at."""


def energy_less_work(sol: Solution) -> tuple[np.ndarray, bool, str]:
    """The energy less the work of the forces, (…, rows), whether there are forces, and why the system changes it all the
    same ("" if it does not)."""
    energy = energy_of(sol)
    forced = "work" in sol.fields and not keeps_books(sol)
    if forced:
        energy = energy - np.asarray(sol.fields["work"])
    return energy, forced, "" if sol.system is None else sol.system.energy_changes


def energy_line(sol: Solution) -> Line:
    """The line of the energy, less the work of forces: bounded or drifting, or why it was not checked."""
    name = "energy"
    try:
        energy, forced, changes = energy_less_work(sol)
    except ValueError as error:
        return Line(name, None, None, NOT_CHECKED, str(error))
    energy = energy.reshape(-1, energy.shape[-1])
    if not np.any(np.isfinite(energy)):
        return Line(name, None, None, NOT_CHECKED, "the system states no energy")
    if outside := _outside(sol, energy):
        return outside
    changes = changes or _unbooked(sol) or _power(sol)
    size = energy_scale(sol, energy)
    roundoff = ROUNDINGS * EPSILON * steps_of(sol) * size
    if jump := energy_jump(sol, energy, size):
        return jump
    if not changes and (kicked := _changed_by_walls(sol, energy, size)):
        return kicked
    if changes:
        change = float(np.nanmax(np.abs(energy - energy[:, :1])))
        text = f"the system {changes}; {'less sol.work ' * forced}it changed by {change:.3g}"
        return Line(name, change, None, NOT_CHECKED, text)
    if broken := _blown_up(sol, energy, size) or _not_kept(sol):
        return broken
    times, found = sol.times, []
    for lane, series in enumerate(energy):
        good = np.isfinite(series)
        parts = partial(energy_parts, sol, int(np.sum(good)), lane)
        found.append(judge(times[lane][good], series[good], _motion(sol, lane)[good], roundoff, size, parts))
    order = (NOT_CHECKED, BOUNDED, DRIFTS)
    lane = max(range(len(found)), key=lambda i: (order.index(found[i].verdict), abs(found[i].drift)))
    worst = found[lane]
    details: dict[str, Any] = {**worst.details, "roundoff": roundoff}
    if sol.batch is not None:
        details["per_trajectory"] = [f.drift for f in found]
        details["verdicts"] = [f.verdict for f in found]
    text = "less the work of the forces: " * forced + worst.text + of_lane(sol, lane)
    others = sorted({f.verdict for f in found} - {worst.verdict})
    text += "".join(f"; {details['verdicts'].count(other)} of {len(found)} {other}" for other in others)
    return Line(name, abs(worst.drift), worst.told, worst.verdict, text, details)


def _unbooked(sol: Solution) -> str:
    """Why forces change the energy by what nothing that was saved says; "" where there are none, or their work was saved."""
    form = None if sol.system is None or "work" in sol.fields else sol.system.lagrangian_form()
    return "" if form is None or form.forces is None else "has forces, whose work this scheme does not save"


def _power(sol: Solution) -> str:
    """Why the equations of the system change its energy along this run, where they alone say whether they do; "" where they do
    not."""
    if sol.system is None or not sol.system.has_power:
        return ""
    rate, size = np.moveaxis(sampled(sol, at_rows(sol, power_at)), -1, 0)
    largest = np.nanmax(np.abs(rate), initial=0.0)
    moves = largest > POWER * np.nanmax(size, initial=0.0)
    return f"changes its energy by its own equations, at a rate of up to {largest:.3g}" if moves else ""


def _outside(sol: Solution, energy: np.ndarray) -> Line | None:
    """The line of a run with rows (B, rows) that have no energy, though they were computed; None for others."""
    missing = ~np.isfinite(energy)
    if not np.any(missing) or np.all(missing[:, 0]):
        return None
    place = np.asarray(sol.fields["q" if "q" in sol.fields else "x"]).reshape(*energy.shape, -1)
    missing &= np.all(np.isfinite(place), axis=2)
    if not np.any(missing):
        return None
    lane, row = np.argwhere(missing)[0].tolist()
    count, where = int(np.sum(missing)), f"t = {sol.time_of(row, lane):.6g}{of_lane(sol, lane)}"
    text = (
        f"it is not finite in {count} of {energy.size} rows, first at {where}: the trajectory has left the domain of the "
        "system's functions, whose derivatives may go on as if nothing were there"
    )
    return Line("energy", None, None, VIOLATED, text)


def _not_kept(sol: Solution) -> Line | None:
    """The line of a run by a scheme that keeps the energy, and did not in a step; None for others."""
    defect = float(np.nanmax(sol.fields["energy_defect"], initial=0.0)) if "energy_defect" in sol.fields else 0.0
    if defect <= DEFECT:
        return None
    text = (
        "changes by so much of its terms in a step, less its work: the quadrature is not exact for such steps, or one of them "
        "passed a place where the equations are nearly singular; take smaller steps, or more points="
    )
    return Line("energy", defect, DEFECT, VIOLATED, text)


def _blown_up(sol: Solution, energy: np.ndarray, size: float) -> Line | None:
    """The line of a run whose energy (B, rows) goes FAR beyond its terms at the start and the work of forces, or does so all of a
    SUDDEN, and is not exchanged with others; None for other runs."""
    moved = np.nanmax(np.abs(energy - energy[:, :1]), axis=1)
    if sol.system is None or not np.any(moved > BALANCED * size):
        return None
    at_once = np.nanmax(np.abs(np.diff(energy, axis=1)), axis=1)
    start = np.abs(energy[:, 0]) + np.ravel(sampled_terms(sol, at_rows(sol, energy_at))[:, 0])
    if "work" in sol.fields:  # by which energy has come in
        start = start + np.nanmax(np.abs(np.asarray(sol.fields["work"]).reshape(*energy.shape, -1)), axis=(1, 2))
    far = np.where(at_once > np.maximum(SUDDEN * start, BALANCED * size), SUDDEN, FAR)
    lane = int(np.argmax(np.where(start > 0.0, moved / far / np.where(start > 0.0, start, 1.0), 0.0)))
    if not moved[lane] > max(far[lane] * start[lane], BALANCED * size):
        return None
    row = int(np.nanargmax(np.abs(energy[lane] - energy[lane, 0])))
    text = (
        f"it moved by {moved[lane]:.2g} up to t = {sol.time_of(row, lane):.6g}{of_lane(sol, lane)}, and its terms at the start, "
        f"with the work done, are {start[lane]:.2g}: the steps are too long for this motion"
    )
    return Line("energy", float(moved[lane]), float(far[lane] * start[lane]), VIOLATED, text)


def _changed_by_walls(sol: Solution, energy: np.ndarray, size: float) -> Line | None:
    """The line of a run whose energy (B, rows) is another one after a wall, that does no work, than before; None for others."""
    if sol.impacts is None or not len(sol.impacts) or sol.save_every != 1:
        return None
    change = np.nan_to_num(np.abs(np.diff(energy, axis=1)))
    for lane in range(len(change)):
        after = np.searchsorted(sol.times[lane], sol.impacts.t[sol.impacts.lane == lane], side="right")
        divided = np.unique(np.clip(after - 1, 0, change.shape[1] - 1))
        allowed = max(BY_WALLS * float(np.max(np.delete(change[lane], divided), initial=0.0)), NOTICED * size)
        by = float(np.max(change[lane, divided], initial=0.0))
        if by > allowed:
            row = int(divided[np.argmax(change[lane, divided])])
            step = f"the step from t = {sol.time_of(row, lane):.6g}{of_lane(sol, lane)}"
            text = f"changes by {by:.3g} in {step}, in which a wall was hit that does no work"
            return Line("energy", by, allowed, VIOLATED, text)
    return None


def port_lines(sol: Solution, tolerance: float | None) -> list[Line]:
    """The balances of a system with ports."""
    if sol.system is None or not (has_power(sol) or keeps_books(sol)):
        return []
    energy = energy_of(sol)
    return balances(sol, energy_scale(sol, energy), tolerance)


def _motion(sol: Solution, lane: int) -> np.ndarray:
    """All node fields of one trajectory side by side, (rows, d); of a large system some numbers of each."""
    nodes = [a for k, a in sol.fields.items() if sol.field_info[k].place == "node" and k != CLOCK]
    rows = [a if sol.batch is None else a[lane] for a in nodes]
    if row_numbers(sol) > LARGE:  # some of the sites
        return np.concatenate([np.asarray(a[:, spread(a.shape[1], SITES)]).reshape(len(a), -1) for a in rows], axis=1)
    return np.concatenate([np.asarray(a).reshape(len(a), -1) for a in rows], axis=1)


def energy_parts(sol: Solution, count: int, lane: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """What each number of one of the first `count` rows has to do with the energy of a trajectory: times (n,), and (n, numbers)
    the energy less what it were with this number as at the start. Nothing of a large system."""
    rows = np.unique(np.linspace(0, count - 1, min(count, PARTS_AT)).astype(int))
    times = sol.times[lane][rows]
    if sol.system is None or row_numbers(sol) > LARGE:
        return times, np.zeros((len(rows), 0))
    one = sol if sol.batch is None else sol[lane]
    nodes = {name: np.asarray(a)[rows] for name, a in one.row_fields.items()}
    energies = lambda: over_rows(at_rows(one, energy_at), one, (nodes,))[0]
    energy, found = energies(), []
    for name, values in nodes.items():
        for i in np.ndindex(values.shape[1:]):
            nodes[name] = np.array(values)
            nodes[name][:, *i] = values[0, *i]
            found.append(energy - energies())
        nodes[name] = values
    return times, np.nan_to_num(np.stack(found, axis=1))


def energy_scale(sol: Solution, energy: np.ndarray) -> float:
    """|E| + |∂E/∂row| |row|, the largest: what roundings of the rows do to the energy, in units of ε."""
    scale = float(np.nanmax(np.abs(energy)))
    return scale if sol.system is None else scale + float(np.nanmax(sampled_terms(sol, at_rows(sol, energy_at))))
