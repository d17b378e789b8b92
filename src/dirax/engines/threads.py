"""How many threads share a batch."""

import os
from contextvars import ContextVar

from dirax.numerics.processors import processors

at_most: ContextVar[int | None] = ContextVar("at_most", default=None)
"""Threads for batches in this context, where several batches run side by side."""


def thread_count() -> int:
    """Threads for batches: as many as the context has, else DIRAX_THREADS, else the processors this process may use."""
    if (most := at_most.get()) is not None:
        return most
    chosen = os.environ.get("DIRAX_THREADS", "")
    if chosen.isdigit() and int(chosen) > 0:
        return int(chosen)
    return processors()
