"""The process that runs tasks for a sweep in another: `python -m dirax.sweeps.worker`, which hears of them on standard input."""

import ctypes
import os
import pickle
import signal
import sys


def main() -> None:
    """Run tasks until there are no more. Ctrl-C is for the process that sends them, and so is its end for this one."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    _end_with_parent()
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # what users' functions print goes where it disturbs no answer

    from dirax.sweeps.processes import receive, run_packed, send

    plan = receive(sys.stdin.buffer)
    while plan is not None and (tasks := receive(sys.stdin.buffer)) is not None:
        send(answers, pickle.dumps(run_packed(plan, pickle.loads(tasks))))


def _end_with_parent() -> None:
    """Have the system end this process when the one that started it is killed (Linux)."""
    if sys.platform.startswith("linux"):
        ctypes.CDLL(None).prctl(1, signal.SIGKILL, 0, 0, 0)


if __name__ == "__main__":
    main()
