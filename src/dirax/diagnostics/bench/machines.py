"""Machines of the gallery: time, end error, drift of the energy and of the constraints, and what other programs can state."""

import importlib.util
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from dirax.diagnostics.bench import in_drake, in_exudyn, in_mujoco, in_pinocchio
from dirax.diagnostics.bench.timing import machine
from dirax.text.tables import number, plain, text_table

OTHERS = {"MuJoCo": "mujoco", "Exudyn": "exudyn", "pinocchio": "pinocchio", "Drake": "pydrake"}
"""Programs for machines, and the module that is imported where they are installed: each is then a column."""

STATED = {"MuJoCo": in_mujoco, "Exudyn": in_exudyn, "pinocchio": in_pinocchio, "Drake": in_drake}
"""How each of them is given a machine."""

ROLLS = ("Exudyn",)
"""Those that have constraints on velocities, and constraints that take the time."""

NO_ROLLING = "cannot: no constraints on velocities"
NO_TIME = "cannot: no constraints that take the time"
NOT_HERE = "not stated here"
FINER = 4


def _others_on(example: Any, program: str, steps: int, end: np.ndarray, repeats: int) -> str:
    """What a program does on the machine, or why it cannot state it, as far as its kinds of constraints go."""
    if program not in ROLLS and example.system.one_forms is not None:
        return NO_ROLLING
    if program not in ROLLS and example.system.depends_on_time:
        return NO_TIME
    if STATED[program].is_stated(example.model):
        return STATED[program].measured(example, steps, end, repeats)
    return NOT_HERE


@dataclass(frozen=True)
class MachineRow:
    """One machine by its own scheme and step: seconds of a step, the error of q at the end, as steps of a quarter the size
    tell it, the range of the energy less the work of the forces, relative to the largest energy (NaN where it is no constant),
    and the largest residual of the constraints."""

    name: str
    step: float
    steps: int
    unknowns: int
    microseconds: float
    error: float
    drift: float
    constraint: float
    others: dict[str, str]


@dataclass(frozen=True)
class Machines:
    """What was measured; `str` is the table."""

    rows: tuple[MachineRow, ...]
    machine: dict[str, Any]
    repeats: int

    @property
    def installed(self) -> tuple[str, ...]:
        """The other programs that are columns."""
        return tuple(self.rows[0].others) if self.rows else ()

    @property
    def header(self) -> tuple[str, ...]:
        return ("machine", "step", "unknowns", "µs a step", "end error", "energy", "constraints", *self.installed)

    @property
    def title(self) -> str:
        here = self.machine
        return f"Machines by their own scheme, the fastest of {self.repeats} runs on {here['processor']}, one trajectory"

    def cells(self) -> list[tuple[str, ...]]:
        """The table, row by row."""
        return [
            (
                *(row.name, number(row.step), str(row.unknowns), number(row.microseconds)),
                *(number(x, 2) for x in (row.error, row.drift, row.constraint)),
                *row.others.values(),
            )
            for row in self.rows
        ]

    def notes(self) -> list[str]:
        """Which programs have no column."""
        missing = [name for name in OTHERS if name not in self.installed]
        return [f"{', '.join(missing)} left out: not installed"] if missing else []

    def __str__(self) -> str:
        return "\n".join([text_table(self.header, self.cells(), self.title), "", *self.notes()])

    def to_dict(self) -> dict[str, Any]:
        """Plain values, None for a drift that is not one."""
        return plain({"machine": self.machine, "repeats": self.repeats, "rows": [dict(vars(row)) for row in self.rows]})


def bench_machines(
    examples: Sequence[Any], repeats: int = 5, steps: int = 1000, tell: Callable[[float | None, str], None] | None = None
) -> Machines:
    """Measure examples of the gallery, each by its own scheme; runs are cut after `steps`."""
    installed = [name for name, module in OTHERS.items() if importlib.util.find_spec(module) is not None]
    rows = []
    for k, example in enumerate(examples):
        if tell is not None:
            tell(k / len(examples), example.name)
        rows.append(_measured(example, repeats, min(steps, example.steps), installed))
    return Machines(tuple(rows), machine(), repeats)


def _measured(example: Any, repeats: int, steps: int, installed: Sequence[str]) -> MachineRow:
    seconds, sol = [], example.simulate(steps=steps)
    for _ in range(repeats):
        before = time.process_time()
        sol = example.simulate(steps=steps)
        seconds.append(min(time.process_time() - before, sol.stats["run_seconds"]))
    fine = example.simulate(step=example.step / FINER, steps=FINER * steps, save_every=FINER * steps)
    end = fine.q[-1] + (fine.q[-1] - sol.q[-1]) / (FINER**2 - 1)  # the schemes are of order two
    energy = sol.energy()
    size = max(np.abs(energy).max(), 1e-300)
    drift = np.ptp(energy - getattr(sol, "work", 0.0)) / size  # a Solution has it where there are forces
    return MachineRow(
        example.name,
        example.step,
        steps,
        int(sol.stats["unknowns"]),
        1e6 * min(seconds) / steps,
        float(np.abs(sol.q[-1] - end).max()),
        float("nan") if example.system.energy_changes else float(drift),
        float(np.abs(sol.constraint_residual()).max(initial=0.0)),
        {program: _others_on(example, program, steps, end, repeats) for program in installed},
    )
