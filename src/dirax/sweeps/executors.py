"""Where tasks are executed: threads here, processes of dirax's own, an executor of the user's, a cluster of dask."""

import contextlib
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import BrokenExecutor, Executor, Future, ProcessPoolExecutor, ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import jax

from dirax.engines.threads import thread_count
from dirax.numerics.arrays import is_whole
from dirax.sweeps.processes import Outcome, Processes, packed, run_packed
from dirax.sweeps.task import Done, Plan, Task, run_task

AHEAD = 2
"""Calls that an executor which is not here is given for each of its workers, so that none waits for the next."""

CALL_SECONDS = 2.0
"""How long a call to such an executor takes, of several tasks where these are short: what a scheduler does costs some ten
milliseconds a call."""

ASK_AGAIN = 5.0
"""Seconds after which a cluster is asked again how many workers it has."""


class PlaceLost(ConnectionError):
    """The executor has gone, and with it what it was doing."""


@dataclass
class Place:
    """`submit(tasks)` gives the future of a call that returns their outcomes; `slots()` is how many calls it is given at a time;
    `end()` gives up what is under way; `lost` are exceptions that say that the place as a whole is gone; `call_seconds` is how
    long a call should take, 0 for one task a call."""

    submit: Callable[[Sequence[Task]], Future]
    slots: Callable[[], int]
    end: Callable[[], None]
    lost: tuple[type[BaseException], ...] = ()
    call_seconds: float = 0.0


def checked(executor: Any) -> Any:
    """The executor that a user gave. Raises `TypeError` for anything else, `ImportError` for dask where it is not installed."""
    if executor is None or isinstance(executor, Executor) or _is_client(executor):
        return executor
    if is_whole(executor) and executor > 0:
        return int(executor)
    if executor == "dask":
        try:
            import distributed  # noqa: F401
        except ImportError as error:
            raise ImportError('executor="dask" needs dask.distributed: install dirax[dask].') from error
        return executor
    raise TypeError(
        "executor must be None (here), a number of processes, an executor of concurrent.futures, a client of dask.distributed, "
        f'or "dask", but {executor!r:.80} was given.'
    )


def parallel(executor: Any, plan_of_xla: bool) -> int:
    """How many tasks run at a time, by which these are sized."""
    if executor is None:
        return len(jax.local_devices()) if plan_of_xla else thread_count()
    if isinstance(executor, int):
        return executor
    if _is_client(executor):
        return _threads_of(executor)
    return max(1, getattr(executor, "_max_workers", 0) or thread_count())


@contextlib.contextmanager
def place(executor: Any, plan: Plan) -> Iterator[Place]:
    """The place of an executor, ended at the end of the block where it is not the user's."""
    if executor is None:
        with _here(plan) as found:
            yield found
    elif isinstance(executor, int):
        yield from _closing(own_processes(plan, executor))
    elif isinstance(executor, ProcessPoolExecutor) and forks(executor):
        yield from _closing(own_processes(plan, parallel(executor, False)))
    elif executor == "dask" or _is_client(executor):
        with _dask(executor, plan) as found:
            yield found
    else:
        data, count = packed(plan), parallel(executor, False)
        submit = lambda tasks: executor.submit(run_packed, data, tasks)
        yield Place(submit, lambda: AHEAD * count, lambda: None, (BrokenExecutor,), CALL_SECONDS)


def own_processes(plan: Plan, count: int) -> Place:
    """Processes of dirax's own."""
    processes = Processes(count, packed(plan))
    return Place(processes.submit, lambda: count, processes.shutdown)


def forks(executor: ProcessPoolExecutor) -> bool:
    """Whether the executor would fork this process, in which JAX has started threads: a child of it may hang for ever."""
    context = getattr(executor, "_mp_context", None)
    return context is None or context.get_start_method() == "fork"


def _closing(found: Place) -> Iterator[Place]:
    try:
        yield found
    finally:
        found.end()


@contextlib.contextmanager
def _here(plan: Plan) -> Iterator[Place]:
    """Threads, of which each runs a batch of its own; for the xla engine one a device, on that device."""
    stop = threading.Event()
    devices = jax.local_devices() if plan.filled else []
    count = len(devices) if plan.filled else thread_count() + 1  # one waits for the disk
    free = list(devices)

    def run(task: Task) -> Done:
        if len(devices) < 2:
            return run_task(plan, task, stop.is_set)
        device = free.pop()
        try:
            with jax.default_device(device):
                return run_task(plan, task, stop.is_set)
        finally:
            free.append(device)

    def outcomes(tasks: Sequence[Task]) -> list[Outcome]:
        return [run(task) for task in tasks]

    pool = ThreadPoolExecutor(count, thread_name_prefix="dirax-sweep")

    def end() -> None:
        stop.set()
        pool.shutdown(wait=True, cancel_futures=True)

    try:
        yield Place(lambda tasks: pool.submit(outcomes, tasks), lambda: count, end)
    finally:
        end()


@contextlib.contextmanager
def _dask(executor: Any, plan: Plan) -> Iterator[Place]:
    """A cluster of dask: the client's own, that of the client that there is, or one on this machine."""
    import distributed

    with contextlib.ExitStack() as stack:
        if executor == "dask":
            try:
                client = distributed.get_client()
            except ValueError:
                options = {"n_workers": thread_count(), "threads_per_worker": 1, "dashboard_address": None}
                client = stack.enter_context(distributed.Client(**options))
        else:
            client = executor
        data = packed(plan)
        pool = client.get_executor(pure=False)
        count, asked = _threads_of(client), time.monotonic()

        def slots() -> int:
            nonlocal count, asked
            if client.status != "running":
                raise PlaceLost("the scheduler has gone")
            if time.monotonic() > asked + ASK_AGAIN:  # workers come and go
                count, asked = _threads_of(client), time.monotonic()
            return AHEAD * count

        submit = lambda tasks: pool.submit(run_packed, data, tasks)
        yield Place(submit, slots, lambda: pool.shutdown(wait=False), call_seconds=CALL_SECONDS)


def _is_client(executor: Any) -> bool:
    """Whether it is a client of dask, without importing that."""
    distributed = sys.modules.get("distributed")
    return distributed is not None and isinstance(executor, distributed.Client)


def _threads_of(client: Any) -> int:
    """The threads of all workers of a cluster; 1 where it has none at this moment. Raises `PlaceLost`."""
    try:
        return max(1, sum(client.nthreads().values()))
    except OSError as error:
        raise PlaceLost("the scheduler has gone") from error
