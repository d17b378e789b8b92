"""compare(): several schemes on one system, in one table: order, error, energy, constraint, cost."""

import time as clock
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from dirax.diagnostics.bench.subject import Skipped
from dirax.diagnostics.convergence import convergence, refuse_tolerance, simulated
from dirax.diagnostics.drift import judge
from dirax.diagnostics.energy_lines import energy_less_work, energy_parts, energy_scale
from dirax.diagnostics.explicit_solution import ExplicitSolution, explicit_solution
from dirax.diagnostics.power_balance import keeps_books
from dirax.numerics.arrays import is_whole
from dirax.numerics.tolerances import EPSILON
from dirax.program.user_functions import refuse_traced
from dirax.schemes.step import AbstractScheme
from dirax.solution.solution import Solution
from dirax.solution.style import COLOURS, MARKERS, given_or_new, style
from dirax.solution.trajectory import NotSaved
from dirax.systems.system import AbstractSystem
from dirax.text.tables import html_table, number, plain, text_table

if TYPE_CHECKING:
    from matplotlib.axes import Axes

HEADER = ("scheme", "order", "error", "energy band", "energy", "slope", "constraint", "µs/step", "Newton/step", "ended")
ORDER_STEPS = 64
"""The order is measured over so many steps of the run's size (fewer if the run is shorter), halved twice."""


@dataclass(frozen=True)
class Entry:
    """One scheme's row. `error` is the largest, relative as in `dx.convergence`, over the stretch over which the order was
    measured; None is not known.

    `drift` is the verdict on the energy, less the work of the forces and of ports ("bounded", "drifts", "not checked", "not
    finite"), `slope` its least-squares slope per unit of time.
    """

    scheme: str
    order: float | None
    error: float | None
    energy_band: float | None
    drift: str
    slope: float | None
    constraint: float | None
    microseconds_per_step: float
    newton_per_step: float
    ended: str
    note: str = ""
    precision: tuple[tuple[float, float], ...] = ()
    """(steps, error) of the runs from which the order was measured, the longest step first."""

    def cells(self) -> tuple[str, ...]:
        """The row as text."""
        numbers = (self.energy_band, self.slope, self.constraint, self.microseconds_per_step, self.newton_per_step)
        band, slope, constraint, cost, newton = (number(value) for value in numbers)
        order = "" if self.order is None else f"{self.order:.2f}"
        return (self.scheme, order, number(self.error), band, self.drift, slope, constraint, cost, newton, self.ended)


@dataclass(frozen=True)
class Comparison:
    """The rows of `dx.compare`; prints as a table. `comparison[name]` is the row of a scheme."""

    title: str
    entries: tuple[Entry, ...]

    def __getitem__(self, scheme: str) -> Entry:
        for entry in self.entries:
            if entry.scheme == scheme:
                return entry
        raise KeyError(f"no scheme {scheme!r}; there are {', '.join(repr(e.scheme) for e in self.entries)}.")

    def to_dict(self) -> dict[str, Any]:
        """The table as plain Python values, fit for JSON."""
        return plain({"title": self.title, "schemes": [vars(entry) for entry in self.entries]})

    def __str__(self) -> str:
        notes = [f"{entry.scheme}: {entry.note}" for entry in self.entries if entry.note]
        return "\n".join([text_table(HEADER, [entry.cells() for entry in self.entries], self.title), *notes])

    __repr__ = __str__

    def _repr_html_(self) -> str:
        return html_table(HEADER, [entry.cells() for entry in self.entries], self.title)

    @style()
    def plot(self, ax: "Axes | None" = None) -> "Axes":
        """Work and precision, both logarithmic: the error over the time of the run that has it, one curve a scheme, over the
        step that was compared (the large mark), and its half, quarter and eighth. Further left and down is better; a scheme
        whose runs failed is left out."""
        ax = given_or_new(ax)
        for k, entry in enumerate(entry for entry in self.entries if entry.precision):
            steps, errors = np.array(entry.precision).T
            work, mark = steps * entry.microseconds_per_step, MARKERS[k % len(MARKERS)]
            (curve,) = ax.plot(work, errors, f"{mark}-", color=COLOURS[k % len(COLOURS)], ms=4.5, label=entry.scheme)
            ax.plot(work[:1], errors[:1], mark, color=curve.get_color(), ms=8.5)
        ax.set(
            xscale="log",
            yscale="log",
            xlabel="time of the run (µs)",
            ylabel="largest error, relative",
            title=self.title.replace(", errors", "\nerrors"),
        )
        ax.legend()
        return ax


def compare(
    system: AbstractSystem,
    schemes: Mapping[str, AbstractScheme] | Sequence[AbstractScheme] | AbstractScheme,
    *,
    step: float,
    steps: int,
    reference: Callable | AbstractScheme | None = None,
    repeats: int = 3,
    **run: Any,
) -> Comparison:
    """Run every scheme on one system with the same data and tabulate what it costs and what it keeps.

    `schemes`: a dict by name, a list (named by class), or one. `reference` as in `dx.convergence`; without it, and for systems
    without explicit equations of motion, each scheme is compared with the refinement of the one whose measured order is highest.
    The title says which it was, and notes which schemes do not come to it. `run`: initial data and the other keywords
    of `dx.simulate`, one trajectory. Times are medians of `repeats` interleaved runs of compiled code, saving included.

    Raises what `dx.simulate` raises for bad data; a scheme that fails midway has that in its row.
    """
    refuse_traced("dx.compare", step, run)
    refuse_tolerance("dx.compare", run)
    schemes = [schemes] if isinstance(schemes, AbstractScheme) else schemes
    named = dict(schemes) if isinstance(schemes, Mapping) else _named(schemes)
    if not named:
        raise ValueError("schemes must name at least one scheme, but it is empty.")
    if not is_whole(repeats) or repeats < 1:
        raise ValueError(f"repeats must be a whole number ≥ 1, but {repeats!r:.80} was given.")
    sols = {name: simulated(system, scheme, step=step, steps=steps, **run) for name, scheme in named.items()}
    if batches := [sol.batch for sol in sols.values() if sol.batch is not None]:
        raise ValueError(f"dx.compare compares one trajectory, but a batch of {batches[0]} was given: give the data of one.")
    seconds = {name: [] for name in named}
    for _ in range(repeats):
        for name, scheme in named.items():
            tick = clock.perf_counter()
            sol = simulated(system, scheme, step=step, steps=steps, **run)
            seconds[name].append(sol.stats.get("run_seconds", clock.perf_counter() - tick))
    label = "its own" if reference is None else "the reference that was given"
    if reference is None:
        try:
            reference = explicit_solution(system, run)
            reference(float(run.get("t0", 0.0)) + np.arange(min(steps, ORDER_STEPS) + 1) * step)
            label = ExplicitSolution.label
        except Skipped:
            reference = None
    # without another reference a scheme is measured against itself, refined
    orders = {name: _order(system, scheme, step, steps, reference or scheme, run) for name, scheme in named.items()}
    best = max((name for name in named if orders[name][0] is not None), key=lambda n: orders[n][0] or 0.0, default=None)
    target = reference if reference is not None else named[best] if best is not None else None
    entries = []
    for name, sol in sols.items():
        order, precision, note = orders[name]
        if target is not None and order is not None and name != best and reference is None:
            label = f"{best} refined"
            _, precision, note = _order(system, named[name], step, steps, target, run)
        entries.append(_entry(name, sol, order, precision, note, float(np.median(seconds[name]))))
    stretch = f" of the first {ORDER_STEPS}" if steps > ORDER_STEPS else ""
    return Comparison(f"{type(system).__name__}: {steps} steps of {step:g}, errors{stretch} against {label}", tuple(entries))


def _named(schemes: Sequence[AbstractScheme]) -> dict[str, AbstractScheme]:
    named: dict[str, AbstractScheme] = {}
    for scheme in schemes:
        name, count = type(scheme).__name__, 2
        while name in named:
            name, count = f"{type(scheme).__name__} {count}", count + 1
        named[name] = scheme
    return named


def _order(system, scheme, step, steps, reference, run) -> tuple[float | None, tuple[tuple[float, float], ...], str]:
    """(order, (steps, error) of every step size, note); None where it could not be measured, with the reason as note."""
    stretch = min(steps, ORDER_STEPS)
    sizes, own = [step / 2**i for i in range(4)], {name: value for name, value in run.items() if name != "save_every"}
    try:
        found = convergence(system, scheme, step_sizes=sizes, time=stretch * step, reference=reference, **own)
    except ValueError as reason:
        return None, (), str(reason)
    first = next(iter(found.slopes.values()))
    precision = tuple((stretch * step / h, float(error)) for h, error in zip(found.step_sizes, first.errors, strict=True))
    told = not np.isfinite(first.order) or found.agrees is False
    return first.order if np.isfinite(first.order) else None, precision, " ".join(found.notes) if told else ""


def _energy(sol: Solution) -> tuple | None:
    """As of `energy_less_work`, less what came in by ports where books are kept of it; None for rows that do not say it."""
    try:
        energy, forced, changes = energy_less_work(sol)
    except NotSaved:
        return None
    if keeps_books(sol):
        supplied, dissipated = np.moveaxis(np.asarray(sol.fields["work"]), -1, 0)
        energy = energy - supplied + dissipated
    return energy, forced, changes


def _entry(name: str, sol: Solution, order, precision, note: str, seconds: float) -> Entry:
    steps = max(1, (sol.rows - 1) * sol.save_every)
    energy, band, drift, slope = None, None, "not checked", None
    if sol.rows > 1 and (found := _energy(sol)) is not None:
        energy, _, changes = found
        band = float(np.ptp(energy))
        slope = float(np.polyfit(sol.t - sol.t.mean(), energy, 1)[0])
        motion = np.asarray(sol.fields["q"] if "q" in sol.fields else sol.fields["x"])
        size = energy_scale(sol, energy)
        roundoff = 8 * EPSILON * np.sqrt(steps) * size
        if not np.all(np.isfinite(energy)):
            drift = "not finite"
        elif not changes:
            drift = judge(sol.t, energy, motion, roundoff, size, partial(energy_parts, sol, sol.rows)).verdict
    constraint = np.asarray(sol.constraint_residual())
    return Entry(
        scheme=name,
        order=order,
        error=precision[0][1] if precision else None,
        energy_band=band,
        drift=drift,
        slope=slope,
        constraint=float(np.max(np.abs(constraint))) if constraint.size else None,
        microseconds_per_step=1e6 * seconds / steps,
        newton_per_step=float(sol.stats["newton_iterations"]) / steps,
        ended="ok" if np.all(sol.ok) else f"stopped at t = {sol.t[-1]:g}",
        note=note or ("" if np.all(sol.ok) else str(sol.message)),
        precision=precision,
    )
