"""convergence(): the order of a scheme, measured: errors over several step sizes, and the slope above roundoff."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from dirax.diagnostics.bench.subject import Skipped
from dirax.diagnostics.explicit_solution import ExplicitSolution, explicit_solution
from dirax.program.user_functions import refuse_traced
from dirax.run.failure_messages import INTERRUPTED
from dirax.run.simulate import simulate
from dirax.schemes.step import AbstractScheme
from dirax.solution.solution import Solution
from dirax.solution.style import COLOURS, MARKERS, given_or_new, style
from dirax.systems.system import AbstractSystem
from dirax.text.tables import html_table, number, plain, text_table

if TYPE_CHECKING:
    from matplotlib.axes import Axes

REFINEMENT = 16
"""A refined reference has so many times smaller steps than the smallest measured ones."""

PLATEAU = 100.0
"""Errors below so many units of roundoff growth, ε·√steps, are not used."""

STILL_FALLING = 0.9
"""A smaller step must bring the error below this fraction of that before, or the plateau has begun."""

APART = 0.25
"""What is left of an error after the step is divided by REFINEMENT; of first order it is a sixteenth."""

SOLVED = 1e-9
"""Relative error of the explicit solution over the time of a measurement, at most: a tenth of roundoff a step, times what a
motion makes of that."""

USABLE = 3
"""Step sizes that a slope needs."""

RESOLVED = 0.5
"""Error of the smallest step, relative to the largest size of a coordinate, from which on that is not a size of its motion: the
coordinate is zero throughout, or roundoff."""


@dataclass(frozen=True)
class Slope:
    """The measured order of one quantity: the slope of log(error) over log(h), its standard error, and what it rests on.

    `errors` holds the largest error over the common times for each step size, of each coordinate relative to its largest size
    in the reference, `used` says which ones the slope rests on; `end_errors` are those at the last common time. Where fewer than
    three can be used, the order is NaN, and none are.
    """

    order: float
    standard_error: float
    errors: np.ndarray
    used: np.ndarray
    end_errors: np.ndarray

    @property
    def text(self) -> str:
        """The order for a cell."""
        return f"{self.order:.3f} ± {self.standard_error:.1g}" if np.any(self.used) else number(self.order)


@dataclass(frozen=True)
class Convergence:
    """What `dx.convergence` measured; prints as a table. `order` is that of q (or x); `orders` has all by name. NaN is an order
    that these runs do not show, and `notes` say why."""

    title: str
    step_sizes: np.ndarray
    slopes: dict[str, Slope]
    reference: str
    notes: tuple[str, ...] = field(default_factory=tuple)
    agrees: bool | None = None
    """Whether the scheme refined comes to the reference, which is of another kind; None where that was not asked."""

    @property
    def orders(self) -> dict[str, float]:
        """The measured order of each quantity."""
        return {name: slope.order for name, slope in self.slopes.items()}

    @property
    def order(self) -> float:
        """The measured order of the positions: q, or x where there is no q."""
        return next(iter(self.slopes.values())).order

    def to_dict(self) -> dict[str, Any]:
        """Everything as plain Python values, fit for JSON."""
        slopes = {name: vars(slope) for name, slope in self.slopes.items()}
        head = {"title": self.title, "step_sizes": self.step_sizes, "reference": self.reference, "agrees": self.agrees}
        return plain({**head, "quantities": slopes, "notes": self.notes})

    def _table(self):
        header = ("step", *(f"error of {name}" for name in self.slopes))
        rows: list[tuple[str, ...]] = []
        for i, h in enumerate(self.step_sizes):
            cells = [number(s.errors[i]) + ("" if s.used[i] else " (not used)") for s in self.slopes.values()]
            rows.append((number(h, 6), *cells))
        rows.append(("order", *(s.text for s in self.slopes.values())))
        return header, rows, f"{self.title}, against {self.reference}"

    def __str__(self) -> str:
        header, rows, title = self._table()
        return "\n".join([text_table(header, rows, title), *self.notes])

    __repr__ = __str__

    def _repr_html_(self) -> str:
        header, rows, title = self._table()
        return html_table(header, rows, title)

    @style()
    def plot(self, ax: "Axes | None" = None) -> "Axes":
        """The errors over the step sizes, both logarithmic, and the measured slopes; hollow marks were not used."""
        ax = given_or_new(ax)
        for k, (name, slope) in enumerate(self.slopes.items()):
            h, errors, colour = self.step_sizes, np.asarray(slope.errors), COLOURS[k % len(COLOURS)]
            text = f"${name}$" if len(name) == 1 else name
            if np.any(slope.used):
                centre = np.exp(np.mean(np.log(errors[slope.used])) - slope.order * np.mean(np.log(h[slope.used])))
                ax.plot(h, centre * h**slope.order, color=colour, lw=0.9, label=f"{text}: order {slope.order:.2f}")
            else:
                ax.plot([], [], MARKERS[k % len(MARKERS)], mfc="none", color=colour, ms=5, label=f"{text}: no order")
            for used, fill in ((slope.used, colour), (~slope.used, "none")):
                ax.plot(h[used], errors[used], MARKERS[k % len(MARKERS)], mfc=fill, color=colour, ms=5)
        ax.set(
            xscale="log",
            yscale="log",
            xlabel="step $h$",
            ylabel="largest error, relative",
            title=f"{self.title}\nerrors against {self.reference}",
        )
        ax.set_xticks(self.step_sizes, [f"{h:.3g}" for h in self.step_sizes])
        ax.minorticks_off()
        ax.legend()
        return ax


def refuse_tolerance(what: str, run: dict[str, Any]) -> None:
    """Raise `ValueError` for a run whose step is to be found."""
    if "tolerance" in run:
        raise ValueError(f"{what} compares steps that are given: find one by dx.simulate(…, tolerance=…), and leave it out here.")


def convergence(
    system: AbstractSystem,
    scheme: AbstractScheme,
    *,
    step_sizes: Sequence[float],
    time: float,
    reference: Callable | AbstractScheme | None = None,
    quantities: Sequence[str] | None = None,
    **run: Any,
) -> Convergence:
    """Measure the order of `scheme` on `system` over runs to `time` with the given step sizes (at least three).

    `run`: initial data, `params` and the other keywords of `dx.simulate`, without step and steps. Every step size must
    divide the largest, and the largest `time`; errors are the largest over the common times, of each coordinate relative to its
    largest size in the reference, or of one that is zero throughout, to that of the others. `reference`: a function
    t (rows,) -> q (rows, n), or -> a dict of such arrays by name; a scheme, run with 16 times smaller steps than the
    smallest; or None for the explicit equations of motion, solved by extrapolation to roundoff. Where the system has none, it is
    `scheme` itself so refined (the slope then allows for the reference's own error), and so always for multipliers. Before an
    order is told the explicit solution and the scheme so refined are compared: one that converges to something else has no
    order, and the notes say so, as `agrees` does. `Convergence.reference` says which was used.
    `quantities`: names of saved fields, by default all of q, p, x that the reference has, and the multipliers of discrete
    Lagrange–d'Alembert schemes, compared as μ_k/h at their nodes from the second on, those of compositions as means over steps.

    The slope is a regression over the step sizes above the roundoff plateau. Where fewer than three can be used, because the
    scheme is exact up to roundoff or converges to something else, the order is NaN, and `notes` say what the errors are. Raises
    `ValueError` for step sizes that do not fit and for a run that fails.
    """
    refuse_traced("dx.convergence", step_sizes, time, run)
    refuse_tolerance("dx.convergence", run)
    if set(run) & {"save_every", "step", "steps"}:
        raise ValueError(
            "dx.convergence takes its steps from step_sizes= and time=, and rows where they meet: leave out "
            f"{', '.join(name for name in ('step', 'steps', 'save_every') if name in run)}."
        )
    h = _checked(step_sizes, time)
    if "q0" in run or "q1" in run:
        raise ValueError("the points q0= and q1= belong to one step size, and here there are several: give q= with v= or p=.")
    exact = reference if callable(reference) and not isinstance(reference, AbstractScheme) else None
    stride = np.round(h[0] / h).astype(int)
    runs = [_run(system, scheme, size, time, int(every), run) for size, every in zip(h, stride, strict=True)]
    if runs[0].has_own_times:
        raise ValueError(
            "dx.convergence compares runs at common times, and variable steps have none: compare sol.q with a solution at sol.t."
        )
    common = runs[0].t
    measured, notes = [_quantities(sol) for sol in runs], []
    explicit, by = None, reference if isinstance(reference, AbstractScheme) else scheme
    refined, label = {}, f"{type(by).__name__} with steps of {h[-1] / REFINEMENT:.3g}"
    if reference is None:
        try:
            exact = explicit_solution(system, run)
            explicit = exact(common)
        except Skipped as reason:
            exact, label = None, f"{label}, for want of another ({reason})"
    elif isinstance(reference, ExplicitSolution):
        explicit = reference(common)
    if explicit is not None or exact is None:
        refined = _quantities(_run(system, by, h[-1] / REFINEMENT, time, int(stride[-1]) * REFINEMENT, run))
    own = {name for name in refined if explicit is None or name not in explicit} if by is scheme else set()
    if explicit is not None:
        label = f"{ExplicitSolution.label}" + (f", {', '.join(sorted(own))} against {label}" if own else "")
    elif exact is not None:
        label = "the exact solution"
    expected = refined | (explicit if explicit is not None else _evaluated(exact, common) if exact is not None else {})
    in_steps = _in_steps(runs, by, h, time, int(stride[-1]), run) if by is scheme else {}
    apart = {} if explicit is None else _apart(measured, refined, explicit, h)
    for name, (distance, needed) in apart.items():
        notes.append(
            f"{name}: {type(scheme).__name__} does not come to the explicit equations of motion: with steps of "
            f"{h[-1] / REFINEMENT:.3g} it is off by {number(distance)} of its size, where {number(needed)} was to be expected."
        )
    names = list(quantities) if quantities is not None else [name for name in measured[0] if name in expected]
    missing = [name for name in names if name not in measured[0] or name not in expected]
    if missing or not names:
        raise ValueError(
            f"quantities {missing or names} are not in both the run ({', '.join(measured[0])}) and the reference "
            f"({', '.join(expected)}): choose among those in both."
        )
    slopes = {}
    for name in names:
        wanted = in_steps.get(name) or [expected[name]] * len(h)
        relative = [_relative(m[name], one, measured[-1][name]) for m, one in zip(measured, wanted, strict=True)]
        errors = np.array([np.max(one) for one in relative])
        at_end = np.array([np.max(one[..., -1, :]) for one in relative])
        finest = h[-1] / REFINEMENT if name in own else None
        used = _above_plateau(errors, np.finfo(float).eps * np.sqrt(time / h) * PLATEAU)
        if np.sum(used) >= USABLE:
            slope = _slope(h[used], errors[used], finest)
        else:
            if name not in apart:
                notes.append(
                    f"{name}: {int(np.sum(used))} of the step sizes give errors that fall and lie above roundoff, and an order "
                    f"needs {USABLE}: errors {', '.join(number(e) for e in errors)} for steps "
                    f"{', '.join(number(s) for s in h)}; take larger steps, or more of them."
                )
            slope, used = (np.nan, np.nan), np.zeros(len(h), bool)
        slopes[name] = Slope(*slope, errors, used, at_end)
    title = f"{type(scheme).__name__} on {type(system).__name__}, t ≤ {time:g}"
    return Convergence(title, h, slopes, label, tuple(notes), None if explicit is None else not apart)


def _relative(found: np.ndarray, expected: np.ndarray, finest: np.ndarray) -> np.ndarray:
    """The errors (…, rows, n) of each coordinate, relative to its largest size in the reference; `finest` is what the smallest
    step gives."""
    over_rows = tuple(range(expected.ndim - 1))
    sizes, left = (np.max(np.abs(a), axis=over_rows) for a in (expected, finest - expected))
    resolved = (sizes > 0.0) & (left <= RESOLVED * sizes)
    of_all = np.max(sizes, where=resolved, initial=0.0) or np.max(sizes, initial=0.0) or 1.0
    return np.abs(found - expected) / np.where(resolved, sizes, of_all)


def _apart(measured: list, refined: dict, explicit: dict, h: np.ndarray) -> dict[str, tuple[float, float]]:
    """The quantities in which the scheme refined is further from the explicit solution than a scheme of first order would be:
    (how far, how far that is at most), by name."""
    found = {}
    for name in refined.keys() & explicit.keys():
        finest = measured[-1][name]
        distance, last = (float(np.max(_relative(a, explicit[name], finest))) for a in (refined[name], finest))
        needed = max(APART * last, PLATEAU * np.finfo(float).eps * np.sqrt(REFINEMENT * len(explicit[name])), SOLVED)
        if not distance <= needed:
            found[name] = distance, needed
    return dict(sorted(found.items(), reverse=True))


def _checked(step_sizes, time: float) -> np.ndarray:
    h = np.sort(np.unique(np.asarray(step_sizes, dtype=float)))[::-1]
    if len(h) < USABLE or not np.all(np.isfinite(h)) or h[-1] <= 0:
        raise ValueError(f"step_sizes must be at least {USABLE} different positive numbers, but {step_sizes!r} was given.")
    if not 0 < time < np.inf:
        raise ValueError(f"time must be a positive finite number, but {time!r:.80} was given.")
    ratios = np.append(h[0] / h, time / h[0])
    off = np.abs(ratios - np.round(ratios)) > 1e-9 * ratios
    if np.any(off) or round(time / h[0]) < 1:
        raise ValueError(
            f"every step size must divide the largest, {h[0]:g}, and that must divide time = {time:g}, so that there are "
            f"common times: {', '.join(number(s, 6) for s in h)} do not; take {h[0]:g}/2, {h[0]:g}/4, … for instance."
        )
    return h


def simulated(system: AbstractSystem, scheme: AbstractScheme, **run: Any) -> Solution:
    """`dx.simulate`, of which Ctrl-C ends the whole measurement and not one run of it alone."""
    sol = simulate(system, scheme, **run)
    if any(message.startswith(INTERRUPTED) for message in ([sol.message] if isinstance(sol.message, str) else sol.message)):
        raise KeyboardInterrupt
    return sol


def _run(system, scheme, h: float, time: float, every: int, run: Mapping[str, Any]) -> Solution:
    sol = simulated(system, scheme, step=h, steps=round(time / h), save_every=every, **run)
    if not np.all(sol.ok):
        message = sol.message if isinstance(sol.message, str) else next(m for m in sol.message if m)
        raise ValueError(f"the run with steps of {h:g} failed, so no order can be measured: {message}")
    if sol.rows <= round(time / h) // every or not np.all(np.isfinite(sol.fields["q" if "q" in sol.fields else "x"])):
        raise ValueError(
            f"an event has ended the run with steps of {h:g} before t = {float(run.get('t0', 0.0)) + time:g}, and others end at "
            "other rows, so no order can be measured: leave out the events, or stop before them."
        )
    return sol


def _quantities(sol: Solution) -> dict[str, np.ndarray]:
    """The node fields, rows first, and multipliers of discrete Lagrange–d'Alembert schemes as μ/h."""
    found = {name: np.asarray(sol.fields[name]) for name in ("q", "x", "p") if name in sol.fields}
    if "multipliers" in sol.fields and "constraint" in sol.fields and sol.rows > 2:
        found["multipliers"] = np.asarray(sol.fields["multipliers"])[..., 1:, :] / sol.step
    return found


def _in_steps(runs: list[Solution], by: AbstractScheme, h: np.ndarray, time: float, stride: int, run: Mapping[str, Any]) -> dict:
    """What the multipliers of composed steps are compared with, for each step size: an impulse is that of the whole step, and so
    is the sum of those of the refined scheme in it."""
    if "multipliers" not in _quantities(runs[0]) or len(runs[0].equation.stages) < 2:
        return {}
    assert runs[0].system is not None
    fine = np.asarray(_run(runs[0].system, by, h[-1] / REFINEMENT, time, 1, run).fields["multipliers"])
    until = np.concatenate([np.zeros_like(fine[..., :1, :]), np.cumsum(fine, axis=-2)], axis=-2)
    starts = np.arange(1, fine.shape[-2] // (stride * REFINEMENT)) * stride * REFINEMENT
    ends = [starts + round(size / h[-1] * REFINEMENT) for size in h]
    return {"multipliers": [(until[..., end, :] - until[..., starts, :]) / size for end, size in zip(ends, h, strict=True)]}


def _evaluated(exact: Callable, t: np.ndarray) -> dict[str, np.ndarray]:
    values = exact(t)
    named = values if isinstance(values, Mapping) else {"q": values, "x": values}
    return {name: np.asarray(value) for name, value in named.items()}


def _above_plateau(errors: np.ndarray, floor: np.ndarray) -> np.ndarray:
    """Which errors lie above roundoff and before the first that no longer falls; `errors` by falling step size."""
    used = np.isfinite(errors) & (errors > floor)
    for i in range(1, len(errors)):
        if used[i] and not (used[i - 1] and errors[i] < STILL_FALLING * errors[i - 1]):
            used[i:] = False
    return used


def _slope(h: np.ndarray, errors: np.ndarray, finest: float | None) -> tuple[float, float]:
    """(order, standard error); against the scheme's own refinement e(h) = C (h^p − h_ref^p), solved by iteration for p."""
    corrected, order, error = errors, 0.0, 0.0
    for _ in range(1 if finest is None else 10):
        x, y = np.log(h / h[0]), np.log(corrected / corrected[0])  # ratios have no units
        order, offset = np.polyfit(x, y, 1)
        residual = y - order * x - offset
        spread = np.sum((x - x.mean()) ** 2)
        error = float(np.sqrt(np.sum(residual**2) / max(len(h) - 2, 1) / spread))
        if finest is not None and order > 0:
            corrected = errors / (1.0 - (finest / h) ** order)
    return float(order), error
