"""What is killed loses nothing: the caller, a worker, the scheduler, at three moments each; at twenty in `make soak`."""

import json
import os
import random
import signal
import subprocess
import sys
import time
import warnings
from pathlib import Path

import pytest
import xarray as xr

from swept_pendulums import files, same, study

PROGRAM = Path(__file__).parents[1] / "swept_pendulums.py"
LONG = {"steps": 40_000, "save_every": 10_000, "task_seconds": 0.1}
"""About 240 points × 40 000 steps, two seconds of one processor."""


@pytest.fixture(scope="module")
def uninterrupted(tmp_path_factory):
    path = tmp_path_factory.mktemp("uninterrupted") / "study.zarr"
    return study(path, **LONG), files(path)


def started(path, how):
    """The study in a process of its own."""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    command = [sys.executable, str(PROGRAM), str(path), how]
    return subprocess.Popen(command, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)


def marks(path):
    """How many tasks are done; the store opens at any moment."""
    if not path.exists():
        return 0
    found = len(list(path.glob("status/c.*")))
    assert xr.open_zarr(path, consolidated=None).sizes["angle"] == 20
    return found


def wait_for(path, process, count, patience=120.0):
    """Until so many tasks are done, or the process has ended."""
    end = time.monotonic() + patience
    while process.poll() is None and (not path.exists() or len(list(path.glob("status/c.*"))) < count):
        assert time.monotonic() < end
        time.sleep(0.01)


def finished(path, uninterrupted):
    """The same call again: the bits and the files of an uninterrupted run."""
    marks(path)
    data = study(path, **LONG)
    names = {name for name in files(path) if "/c." not in name or name.split("/")[0] in ("g", "angle", "time")}
    there = {name for name in uninterrupted[1] if "/c." not in name or name.split("/")[0] in ("g", "angle", "time")}
    assert same(data, uninterrupted[0]) and names == there and not list(path.parent.glob(".*"))


def kill_callers(tmp_path, uninterrupted, moments):
    path = tmp_path / "study.zarr"
    for moment in moments:
        process = started(path, "here")
        wait_for(path, process, moment)
        process.kill()
        process.communicate()
        before = marks(path)
        assert before >= min(moment, 1)
    finished(path, uninterrupted)


def kill_workers(tmp_path, uninterrupted, moments):
    """One of the processes of a caller's own, found by their parent, again and again in one run."""
    tmp_path.mkdir(exist_ok=True)
    path = tmp_path / "study.zarr"
    process = started(path, "2")
    for moment in moments:
        wait_for(path, process, moment)
        children = Path(f"/proc/{process.pid}/task").glob("*/children")
        workers = [int(pid) for listing in children for pid in listing.read_text().split()]
        for worker in workers[:1]:
            os.kill(worker, signal.SIGKILL)
    _, error = process.communicate(timeout=200)
    assert process.returncode == 0, error.decode()
    finished(path, uninterrupted)


def test_the_caller_is_killed(tmp_path, uninterrupted):
    kill_callers(tmp_path, uninterrupted, (0, 3, 9))


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="processes are found in /proc")
def test_a_worker_is_killed(tmp_path, uninterrupted):
    kill_workers(tmp_path, uninterrupted, (1, 4, 8))


@pytest.mark.soak
def test_a_scheduler_and_its_workers_are_killed(tmp_path, uninterrupted):
    kill_schedulers(tmp_path, uninterrupted, (1, 4, 8))


@pytest.mark.soak
def test_everything_is_killed_at_twenty_moments(tmp_path, uninterrupted):
    moments = random.Random(0)
    kill_callers(tmp_path, uninterrupted, sorted(moments.randrange(12) for _ in range(20)))
    kill_workers(tmp_path / "workers", uninterrupted, sorted(moments.randrange(1, 10) for _ in range(20)))
    kill_schedulers(tmp_path / "schedulers", uninterrupted, [moments.randrange(1, 10) for _ in range(20)])


def kill_schedulers(tmp_path, uninterrupted, moments):
    """The caller ends with one sentence, and the same call again, without a cluster here, goes on."""
    tmp_path.mkdir(exist_ok=True)
    path = tmp_path / "study.zarr"
    for number, moment in enumerate(moments):
        address = tmp_path / f"scheduler{number}.json"
        run = lambda module, *rest: subprocess.Popen(
            [sys.executable, "-m", f"distributed.cli.{module}", *rest], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        scheduler = run("dask_scheduler", "--port", "0", "--no-dashboard", "--scheduler-file", str(address))
        worker = run("dask_worker", "--scheduler-file", str(address), "--nthreads", "2", "--no-dashboard", "--no-nanny")
        try:
            while not address.exists():
                time.sleep(0.05)
            process = started(path, json.loads(address.read_text())["address"])
            wait_for(path, process, marks(path) + moment)
            scheduler.kill()
            _, error = process.communicate(timeout=120)
        finally:
            for ended in (scheduler, worker):
                ended.kill()
                ended.wait()
        assert process.returncode == 0 or "the same call again goes on from there" in error.decode()
    finished(path, uninterrupted)


def test_ctrl_c_ends_cleanly_and_says_how_to_go_on(tmp_path, uninterrupted):
    path = tmp_path / "study.zarr"
    process = started(path, "here")
    wait_for(path, process, 3)
    process.send_signal(signal.SIGINT)
    _, error = process.communicate(timeout=60)
    assert process.returncode != 0 and "of 240 points done, kept in" in error.decode()
    assert not any("unfinished" in name for name in files(path))
    finished(path, uninterrupted)


def test_a_task_that_kills_its_worker_three_times_is_left_open_and_the_rest_goes_on(tmp_path):
    caller = os.getpid()

    def deadly(g, angle):
        if os.getpid() != caller and g > 1.9 and angle > 2.9:
            os.kill(os.getpid(), signal.SIGKILL)
        return {"q": [float(angle), 0.0], "v": [0.0, 0.0], "params": {"g": float(g)}}

    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        data = study(tmp_path / "deadly.zarr", case=deadly, executor=2)
    assert any("failed three times" in str(one.message) and "signal 9" in str(one.message) for one in caught)
    left = int((data.status == 0).sum())
    assert 0 < left < 120 and data.status.values[-1, -1] == 0
