"""Processes of dirax's own for tasks: new interpreters, never forks, each with one thread of this process that speaks with it."""

import contextlib
import os
import pickle
import subprocess
import sys
import threading
from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, BinaryIO, TypeAlias

from dirax.sweeps.task import Done, Plan, Task, finished, run_task

Outcome: TypeAlias = "Done | Exception"
"""What became of a task."""


class WorkerDied(RuntimeError):
    """The process of a task ended before the task."""


class Processes:
    """`count` processes, started when there is something for them to do; a process that dies is replaced for the next task."""

    def __init__(self, count: int, plan: bytes):
        self.count, self._plan = count, plan
        self._pool = ThreadPoolExecutor(count, thread_name_prefix="dirax-sweep")
        self._local = threading.local()
        self._all: set[subprocess.Popen] = set()
        self._lock = threading.Lock()
        self._ended = False

    def submit(self, tasks: Sequence[Task]) -> Future:
        """The future of the outcomes of tasks. Its exception is `WorkerDied` where the process ended."""
        return self._pool.submit(self._ask, tasks)

    def shutdown(self) -> None:
        """End all processes, whatever they do."""
        with self._lock:
            self._ended = True
            running = list(self._all)
        for process in running:
            process.kill()
        self._pool.shutdown(wait=True, cancel_futures=True)
        for process in running:
            _close(process)

    def _ask(self, tasks: Sequence[Task]) -> list[Outcome]:
        process = getattr(self._local, "process", None) or self._started()
        try:
            send(process.stdin, pickle.dumps(tasks))  # type: ignore[arg-type]
            answer = receive(process.stdout)  # type: ignore[arg-type]
        except OSError:
            answer = None
        if answer is None:
            self._local.process = None
            process.kill()
            code = _close(process)
            with self._lock:
                self._all.discard(process)
            raise WorkerDied(f"the process that ran it ended ({_ending(code)})")
        return pickle.loads(answer)

    def _started(self) -> subprocess.Popen:
        with self._lock:
            if self._ended:
                raise WorkerDied("the sweep has ended")
            command = [sys.executable, "-m", "dirax.sweeps.worker"]
            paths = {
                "PYTHONPATH": os.pathsep.join(filter(None, sys.path))
            }  # as the modules of the user's functions are found here
            process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=os.environ | paths)
            self._all.add(process)
        self._local.process = process
        with contextlib.suppress(OSError):  # it has ended, which the first answer will show
            send(process.stdin, self._plan)  # type: ignore[arg-type]
        return process


def _close(process: subprocess.Popen) -> int:
    """The exit status of a process that has ended, its pipes closed."""
    for pipe in (process.stdin, process.stdout):
        with contextlib.suppress(OSError):
            pipe.close() if pipe else None
    return process.wait()


def send(pipe: BinaryIO, data: bytes) -> None:
    """Write bytes after their number."""
    pipe.write(len(data).to_bytes(8, "little") + data)
    pipe.flush()


def receive(pipe: BinaryIO) -> bytes | None:
    """Bytes that were sent; None at the end."""
    head = pipe.read(8)
    if len(head) < 8:
        return None
    size = int.from_bytes(head, "little")
    data = pipe.read(size)
    return data if len(data) == size else None


def _ending(code: int) -> str:
    return f"signal {-code}" if code < 0 else f"exit status {code}"


def packed(plan: Plan) -> bytes:
    """The plan for other processes; functions travel by value where these could not import them. Raises `TypeError` for what
    cannot."""
    import cloudpickle

    try:
        return cloudpickle.dumps(plan)
    except Exception as error:
        raise TypeError(
            f"the functions of this sweep, or what they read, cannot be sent to other processes ({error}): let them read nothing "
            "such, or leave executor out, for threads of this process."
        ) from error


_plans: dict[int, Any] = {}
_loading = threading.Lock()


def run_packed(plan: bytes, tasks: Sequence[Task]) -> list[Outcome]:
    """The outcomes of tasks in another process, which keeps the plan that it was given last."""
    key = hash(plan)
    with _loading:  # threads of one process share the plan, and what is compiled for it
        if key not in _plans:
            loaded = pickle.loads(plan)
            _plans.clear()
            _plans[key] = loaded
        common = _plans[key]
    return [_outcome(common, task) for task in tasks]


def _outcome(plan: Plan, task: Task) -> Outcome:
    try:
        return finished(plan, task) or run_task(plan, task)
    except Exception as error:
        try:
            pickle.loads(pickle.dumps(error))
        except Exception:  # it cannot travel, but its text can
            return RuntimeError(f"{type(error).__name__}: {error}")
        return error
