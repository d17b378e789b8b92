"""What a kernel keeps of a trajectory from call to call, and where it stands while the kernel works on it."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from dirax.engines.native.ir.emitter import Emitter

DOUBTFUL = 3
"""The outcome of a trajectory that has not begun, for the sizes of its unknowns are in doubt."""


@dataclass(frozen=True)
class Record:
    """The layout of a lane's record. Every quantity is a double, counters too, and stands `width` times, once a lane.

    state · for each stage the unknowns of the step before, their first differences, their second, the sizes of unknowns ·
    what rounding took from the state (with compensated summation) · good steps · outcome of the last · updates of Newton's
    method · largest residual.
    """

    state_size: int
    stages: int
    history: int
    """Unknowns kept for a stage: those of the largest equation."""
    compensated: bool

    @cached_property
    def kept(self) -> int:
        """Unknowns of all stages."""
        return self.stages * self.history

    @cached_property
    def lost(self) -> int:
        """Quantities that say what rounding took."""
        return self.state_size if self.compensated else 0

    @cached_property
    def size(self) -> int:
        return self.state_size + 4 * self.kept + self.lost + 4

    @cached_property
    def state(self) -> slice:
        return slice(self.state_size)

    def unknowns(self, stage: int, count: int) -> slice:
        """The first `count` unknowns of a stage."""
        first = self.state_size + stage * self.history
        return slice(first, first + count)

    @cached_property
    def differences(self) -> slice:
        """First and second differences of the unknowns of all stages."""
        return slice(self.state_size + self.kept, self.state_size + 3 * self.kept)

    def sizes(self, stage: int, count: int) -> slice:
        """Those of the first `count` unknowns of a stage."""
        first = self.state_size + 3 * self.kept + stage * self.history
        return slice(first, first + count)

    @cached_property
    def all_sizes(self) -> slice:
        """Those of the unknowns of all stages."""
        return slice(self.state_size + 3 * self.kept, self.state_size + 4 * self.kept)

    def put_sizes(self, table: np.ndarray, sizes: Sequence[np.ndarray]) -> None:
        """Write those of every stage, (…, k), into records (…, quantities)."""
        for stage, values in enumerate(sizes):
            table[..., self.sizes(stage, values.shape[-1])] = values

    @cached_property
    def completed(self) -> int:
        return self.size - 4

    @cached_property
    def status(self) -> int:
        return self.size - 3

    @cached_property
    def iterations(self) -> int:
        return self.size - 2

    @cached_property
    def max_residual(self) -> int:
        return self.size - 1


@dataclass(frozen=True)
class Frame:
    """Pointers to the quantities of a record in the frame of the kernel's function, and to those that a step needs besides.

    `kept` holds state and lost as they were before the step, `fresh` the unknowns found in it; `sizes` are those of the unknowns.
    """

    emitter: Emitter
    state: list[str]
    lost: list[str]
    kept: list[str]
    unknowns: str
    slopes: str
    bends: str
    sizes: str
    fresh: str
    completed: str
    status: str
    iterations: str
    max_residual: str

    @classmethod
    def of(cls, e: Emitter, record: Record) -> "Frame":
        """Room for a record in the function that `e` writes."""
        b = e.body
        state = [b.alloca(e.real) for _ in range(record.state_size)]
        lost = [b.alloca(e.real) for _ in range(record.lost)]
        kept = [b.alloca(e.real) for _ in range(record.state_size + record.lost)]
        arrays = [b.alloca(e.real, max(1, record.kept)) for _ in range(5)]
        numbers = [b.alloca(e.real) for _ in range(4)]
        return cls(e, state, lost, kept, *arrays, *numbers)

    def in_order(self, record: Record) -> list[str]:
        """One pointer for each quantity of the record."""
        arrays = [pointer for base in self.of_stages for pointer in self.slots(base, record.kept)]
        return [*self.state, *arrays, *self.lost, self.completed, self.status, self.iterations, self.max_residual]

    @property
    def of_stages(self) -> tuple[str, ...]:
        """The arrays that hold something of every stage, in the order of the record."""
        return self.unknowns, self.slopes, self.bends, self.sizes

    @property
    def carried(self) -> list[str]:
        """State and what rounding took from it."""
        return [*self.state, *self.lost]

    def slots(self, base: str, count: int, first: int | str = 0) -> list[str]:
        """Pointers to `count` quantities from `base` on."""
        b, e = self.emitter.body, self.emitter
        start = b.at(e.real, base, first) if first != 0 else base
        return [b.at(e.real, start, i) for i in range(count)]

    def loads(self, pointers: Iterable[str]) -> list[str]:
        return [self.emitter.body.load(self.emitter.real, p) for p in pointers]

    def stores(self, values: Iterable[str], pointers: Iterable[str]) -> None:
        for value, pointer in zip(values, pointers, strict=True):
            self.emitter.body.store(self.emitter.real, value, pointer)
