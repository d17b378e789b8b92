"""What is killed loses nothing: the caller, a worker, the scheduler, at two moments each; at twenty in `make soak`."""

import json
import os
import random
import signal
import sys
import time
import warnings
from importlib.util import find_spec
from pathlib import Path

import pytest
import xarray as xr

import swept_pendulums
from swept_pendulums import LONG, files, same, study


@pytest.fixture(scope="module")
def uninterrupted(tmp_path_factory):
    path = tmp_path_factory.mktemp("uninterrupted") / "study.zarr"
    return study(path, **LONG), files(path)


@pytest.fixture(scope="module")
def started(forked):
    """The study in a process of its own, which says its last words in a file beside the store."""
    return lambda path, how: forked(swept_pendulums.main, path, how, words=path.with_name("words.txt"))


def ended(process):
    """Wait for a process; its exit status."""
    process.join(200.0)
    assert process.exitcode is not None
    return process.exitcode


def words_beside(path):
    """The last words of a study."""
    return path.with_name("words.txt").read_text()


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
    while process.is_alive() and (not path.exists() or len(list(path.glob("status/c.*"))) < count):
        assert time.monotonic() < end
        time.sleep(0.01)


def finished(path, uninterrupted):
    """The same call again: the bits and the files of an uninterrupted run."""
    marks(path)
    data = study(path, **LONG)
    names = {name for name in files(path) if "/c." not in name or name.split("/")[0] in ("g", "angle", "time")}
    there = {name for name in uninterrupted[1] if "/c." not in name or name.split("/")[0] in ("g", "angle", "time")}
    assert same(data, uninterrupted[0]) and names == there and not list(path.parent.glob(".*"))


def kill_callers(tmp_path, uninterrupted, started, moments):
    path = tmp_path / "study.zarr"
    for moment in moments:
        process = started(path, "here")
        wait_for(path, process, moment)
        process.kill()
        ended(process)
        before = marks(path)
        assert before >= min(moment, 1)
    finished(path, uninterrupted)


def kill_workers(tmp_path, uninterrupted, started, moments):
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
    assert ended(process) == 0, words_beside(path)
    finished(path, uninterrupted)


def test_the_caller_is_killed(tmp_path, uninterrupted, started):
    kill_callers(tmp_path, uninterrupted, started, (0, 6))


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="processes are found in /proc")
@pytest.mark.soak
def test_a_worker_is_killed(tmp_path, uninterrupted, started):
    kill_workers(tmp_path, uninterrupted, started, (1, 6))


@pytest.mark.skipif(find_spec("distributed") is None, reason="dask.distributed is not installed: pip install dirax[dask]")
@pytest.mark.soak
def test_a_scheduler_and_its_workers_are_killed(tmp_path, uninterrupted, started, forked):
    kill_schedulers(tmp_path, uninterrupted, started, forked, (1, 6))


@pytest.mark.soak
def test_everything_is_killed_at_twenty_moments(tmp_path, uninterrupted, started, forked):
    moments = random.Random(0)
    kill_callers(tmp_path, uninterrupted, started, sorted(moments.randrange(12) for _ in range(20)))
    kill_workers(tmp_path / "workers", uninterrupted, started, sorted(moments.randrange(1, 10) for _ in range(20)))
    kill_schedulers(tmp_path / "schedulers", uninterrupted, started, forked, [moments.randrange(1, 10) for _ in range(20)])


def kill_schedulers(tmp_path, uninterrupted, started, forked, moments):
    """The caller ends with one sentence, and the same call again, without a cluster here, goes on."""
    tmp_path.mkdir(exist_ok=True)
    path = tmp_path / "study.zarr"
    for number, moment in enumerate(moments):
        address = tmp_path / f"scheduler{number}.json"
        scheduler = forked(swept_pendulums.scheduler, address)
        worker = forked(swept_pendulums.dask_worker, address)
        try:
            while not address.exists() or not address.read_text().endswith("\n}"):
                time.sleep(0.05)
            process = started(path, json.loads(address.read_text())["address"])
            wait_for(path, process, marks(path) + moment)
            scheduler.kill()
            code = ended(process)
        finally:
            for one in (scheduler, worker):
                one.kill()
                ended(one)
        assert code == 0 or "the same call again goes on from there" in words_beside(path)
    finished(path, uninterrupted)


@pytest.mark.soak
def test_ctrl_c_ends_cleanly_and_says_how_to_go_on(tmp_path, uninterrupted, started):
    path = tmp_path / "study.zarr"
    process = started(path, "here")
    wait_for(path, process, 3)
    os.kill(process.pid, signal.SIGINT)
    assert ended(process) != 0 and "of 240 points done, kept in" in words_beside(path)
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
        data = study(tmp_path / "deadly.zarr", case=deadly, executor=1)
    assert any("failed three times" in str(one.message) and "signal 9" in str(one.message) for one in caught)
    left = int((data.status == 0).sum())
    assert 0 < left < 120 and data.status.values[-1, -1] == 0
