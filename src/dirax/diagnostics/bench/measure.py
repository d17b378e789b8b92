"""Every program on every subject, by turns, and the table of their times as ratios to one lane of the native engine."""

import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from dirax.diagnostics.bench import engines, ode_solvers
from dirax.diagnostics.bench.casadi_c import casadi_c
from dirax.diagnostics.bench.ode import ExplicitODE, explicit_ode
from dirax.diagnostics.bench.subject import Program, Skipped, Subject
from dirax.diagnostics.bench.timing import interleaved, machine, summary
from dirax.solution.style import new_figure
from dirax.text.tables import html_table, number, plain, text_table

NATIVE = "native"
SAME_STEPS: dict[str, Callable[[Subject], Program]] = {
    NATIVE: engines.native_one,
    "native batch": engines.native_batch,
    "xla": engines.xla_one,
    "xla batch": engines.xla_batch,
    "plain JAX": engines.plain_jax,
    "plain JAX batch": engines.plain_jax_batch,
    "CasADi C": casadi_c,
}
"""Programs that take the steps of the scheme."""

SAME_ERROR: dict[str, Callable[[ExplicitODE, float, np.ndarray, float], Program]] = {
    "heyoka": ode_solvers.heyoka_taylor,
    "DOP853": ode_solvers.dop853,
    "diffrax": ode_solvers.diffrax_dopri8,
}
"""Programs that take steps of their own, at the end error of the scheme."""

COLLOCATION = "collocation"
PROGRAMS = (*SAME_STEPS, COLLOCATION, *SAME_ERROR)
LONGEST_RUN = 0.5
"""Seconds of a run from which on it is timed once and not repeated."""

LONGEST_REASON = 160
"""Letters of the reason why a program was left out."""

LONGEST_LIST = 12
"""Systems that a note names; more are counted."""

ROUNDOFF = 1e-13
"""End errors below this are not asked of the other programs."""


@dataclass
class Row:
    """One subject: by program the seconds of every repeat, end errors, settings, and why a program was left out."""

    name: str
    scheme: str
    step: float
    steps: int
    seconds: dict[str, list[float]] = field(default_factory=dict)
    error: dict[str, float] = field(default_factory=dict)
    settings: dict[str, dict[str, Any]] = field(default_factory=dict)
    skipped: dict[str, str] = field(default_factory=dict)

    def ratio(self, program: str) -> float | None:
        """The median time of a program, that of one native lane being 1; None where it was left out."""
        if program not in self.seconds or NATIVE not in self.seconds:
            return None
        return summary(self.seconds[program])["median"] / summary(self.seconds[NATIVE])["median"]

    @property
    def microseconds(self) -> float | None:
        """µs of one step of the native lane."""
        return 1e6 * summary(self.seconds[NATIVE])["median"] / self.steps if NATIVE in self.seconds else None


@dataclass
class Bench:
    """What was measured; `str` is the table, `to_dict` the JSON, `plot` the picture."""

    rows: list[Row]
    machine: dict[str, Any]
    repeats: int

    @property
    def header(self) -> tuple[str, ...]:
        return ("system", "native µs a step", "its end error", *PROGRAMS[1:])

    @property
    def title(self) -> str:
        here = self.machine
        return (
            f"Time of one trajectory, one lane of the native engine = 1; medians of {self.repeats} interleaved repeats on "
            f"{here['processor']}, {here['cores']} cores, Python {here['python']}, JAX {here['jax']}"
        )

    def cells(self) -> list[tuple[str, ...]]:
        """The table, row by row: smaller is faster, "–" where a program was left out."""
        ratio = lambda row, program: number(value, 3) if (value := row.ratio(program)) is not None else "–"
        return [
            (row.name, number(row.microseconds), number(row.error.get(NATIVE), 2), *(ratio(row, p) for p in PROGRAMS[1:]))
            for row in self.rows
        ]

    def notes(self) -> list[str]:
        """Why programs were left out or timed once, those of one reason together."""
        found: dict[tuple[str, str, str], list[str]] = {}
        for row in self.rows:
            for program, reason in row.skipped.items():
                found.setdefault((program, "left out", reason), []).append(row.name)
            for program, seconds in row.seconds.items():
                if len(seconds) < self.repeats:
                    found.setdefault((program, "timed once", "a run is long"), []).append(row.name)
        together: dict[tuple[str, str, str], list[str]] = {}
        for (program, what, reason), names in found.items():
            together.setdefault((what, self._where(names), reason), []).append(program)
        return [f"{', '.join(programs)} {what} ({where}): {reason}" for (what, where, reason), programs in together.items()]

    def _where(self, names: list[str]) -> str:
        if len(names) == len(self.rows) > 1:
            return "everywhere"
        return ", ".join(names) if len(names) <= LONGEST_LIST else f"{len(names)} systems"

    def __str__(self) -> str:
        return "\n".join([text_table(self.header, self.cells(), self.title), *([""] if self.notes() else []), *self.notes()])

    def _repr_html_(self) -> str:
        return html_table(self.header, self.cells(), self.title)

    def to_dict(self) -> dict[str, Any]:
        """Plain values: times in seconds of a trajectory, ratios, errors, settings."""
        rows = [
            {
                "system": row.name,
                "scheme": row.scheme,
                "step": row.step,
                "steps": row.steps,
                "native_microseconds_per_step": row.microseconds,
                "programs": {
                    program: {
                        **summary(row.seconds[program]),
                        "ratio": row.ratio(program),
                        "end_error": row.error.get(program),
                        **row.settings[program],
                    }
                    for program in row.seconds
                },
                "left_out": row.skipped,
            }
            for row in self.rows
        ]
        return plain({"machine": self.machine, "repeats": self.repeats, "rows": rows})

    def plot(self) -> Any:
        """A dot for every program and system on a logarithmic axis; returns the matplotlib figure."""
        figure, ax = new_figure(size=(9, 1.8 + 0.34 * len(self.rows)))
        markers = dict(zip(PROGRAMS, ("|", "s", "o", "D", "^", "<", "P", "h", "X", "v", "*"), strict=True))
        for program in PROGRAMS:
            points = [(r, i) for i, row in enumerate(self.rows) if (r := row.ratio(program)) is not None]
            if points and program != NATIVE:
                ax.plot(*zip(*points, strict=True), markers[program], label=program, markersize=7, alpha=0.85)
        ax.axvline(1.0, color="black", linewidth=1, label="native, one lane")
        ax.set(xscale="log", ylim=(len(self.rows) - 0.5, -0.5), xlabel="time of a trajectory, one native lane = 1 (left: faster)")
        ax.set_yticks(range(len(self.rows)), [row.name for row in self.rows])
        ax.grid(axis="both", alpha=0.3)
        figure.legend(loc="outside upper center", ncols=5, frameon=False)
        return figure


def bench(subjects: Iterable[Subject], repeats: int = 7, tell: Callable[[float | None, str], None] | None = None) -> Bench:
    """Time every program on every subject; `tell(fraction done, text)` hears of the progress. Ctrl-C
    ends it with the subjects that are done.

    Raises `ValueError` for fewer than one repeat.
    """
    if repeats < 1:
        raise ValueError(f"repeats must be at least 1, but {repeats} was given.")
    subjects, rows = list(subjects), []
    for i, subject in enumerate(subjects):
        say = lambda text, i=i, name=subject.name: tell(i / len(subjects), f"{name}: {text}") if tell else None
        try:
            rows.append(measure(subject, repeats, say))
        except KeyboardInterrupt:
            if not rows:
                raise
            break
    return Bench(rows, machine(), repeats)


@contextmanager
def leaving_out(row: Row, *names: str) -> Iterator[None]:
    """Programs that cannot run, or end in an error, are left out of the row with the reason; the others are still timed."""
    try:
        yield
    except Skipped as reason:
        row.skipped |= dict.fromkeys(names, str(reason))
    except Exception as error:
        first = next(iter(str(error).splitlines()), "")
        row.skipped |= dict.fromkeys(names, f"it ended in {type(error).__name__}: {first}"[:LONGEST_REASON])


def measure(subject: Subject, repeats: int, say: Callable[[str], Any]) -> Row:
    """One row of the table."""
    row = Row(subject.name, repr(subject.scheme), subject.step, subject.steps)
    programs: dict[str, Program] = {}
    once: dict[str, list[float]] = {}

    def add(name: str, make: Callable[[], Program]) -> None:
        say(name)
        with leaving_out(row, name):
            made = make()
            tick = time.perf_counter()
            seconds = made.run()
            programs[name] = made
            if time.perf_counter() - tick > LONGEST_RUN:
                once[name] = [seconds]

    for name, make in SAME_STEPS.items():
        add(name, lambda make=make: make(subject))
    if NATIVE not in programs:
        return Row(row.name, row.scheme, row.step, row.steps, skipped=row.skipped)
    reference = None
    with leaving_out(row, COLLOCATION, *SAME_ERROR):
        ode = explicit_ode(subject.system, subject.arrays, subject.leaves)
        reference = ode_solvers.reference_end(ode, subject.span)
        end = programs[NATIVE].end()
        assert end is not None
        wanted = max(ROUNDOFF, engines.end_error(end, reference))
        add(COLLOCATION, lambda: engines.collocation(subject, reference, wanted))
        for name, make in SAME_ERROR.items():
            add(name, lambda make=make: make(ode, subject.span, reference, wanted))
    say("timing")
    repeated = {name: program.run for name, program in programs.items() if name not in once or name == NATIVE}
    found = interleaved(repeated, repeats) | {name: seconds for name, seconds in once.items() if name != NATIVE}
    row.seconds = {name: found[name] for name in programs}
    row.settings = {name: dict(program.settings) for name, program in programs.items()}
    ends = {name: end for name, program in programs.items() if (end := program.end()) is not None}
    if reference is not None:
        row.error = {name: engines.end_error(end, reference) for name, end in ends.items()}
    return row
