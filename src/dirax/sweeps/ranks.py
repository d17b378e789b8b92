"""Processes of `jax.distributed` that fill one store: the first one makes and holds it, and each runs its share of the tasks."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TypeVar

import jax
import numpy as np

from dirax.solution.flushed_files import StoreError
from dirax.sweeps.executors import PlaceLost
from dirax.sweeps.task import Task

Made = TypeVar("Made")

LONGEST = 2000
"""Bytes of what the first process says to the others."""


@dataclass(frozen=True)
class Ranks:
    """The `number` of this process among `count`; all of them make the same call."""

    number: int = 0
    count: int = 1

    def agreed(self, make: Callable[[], Made], read: Callable[[], Made]) -> Made:
        """What the first process makes and the others then read. Raises in all of them what `make` raises in the first."""
        if self.count == 1:
            return make()
        if self.number == 0:
            try:
                made = make()
            except Exception as error:
                _said(f"{error}" or type(error).__name__)
                raise
            _said("")
            return made
        if words := _said(""):
            raise StoreError(0, words)
        return read()

    def share(self, tasks: list[Task]) -> list[Task]:
        """The tasks of this process, of a list that is the same in all; none is begun before all of them have it."""
        self.wait("listed")
        return tasks[self.number :: self.count]

    def wait(self, place: str) -> None:
        """Wait until all processes are at this place."""
        if self.count > 1:
            from jax.experimental.multihost_utils import sync_global_devices

            with _together():
                sync_global_devices(f"dirax sweep: {place}")


def ranks() -> Ranks:
    """This process among those of `jax.distributed`; by itself where that has not been initialized."""
    if not jax.distributed.is_initialized():
        return Ranks()
    return Ranks(jax.process_index(), jax.process_count())


def _said(words: str) -> str:
    """What the first process says, in all of them."""
    from jax.experimental.multihost_utils import broadcast_one_to_all

    data = words.encode()[:LONGEST]
    with _together():
        heard = broadcast_one_to_all(np.frombuffer(data.ljust(LONGEST, b"\0"), np.uint8))
    return np.asarray(heard, np.uint8).tobytes().rstrip(b"\0").decode(errors="ignore")


@contextmanager
def _together() -> Iterator[None]:
    try:
        yield
    except (RuntimeError, ValueError) as error:  # as JAX says that a connection was closed
        raise PlaceLost("another process of jax.distributed has ended") from error
