"""Runs into a store: the rows, bits and messages of a run in memory, whatever stops them; what is read of them later."""

import os
import re
import shutil
import signal
import subprocess
import sys
import time

import jax.numpy as jnp
import numpy as np
import pytest

import dirax as dx
from dirax.run import streaming
from dirax.solution.run_store import RunStore


def chain(q, v):
    d = jnp.diff(jnp.concatenate([jnp.zeros(1), q, jnp.zeros(1)]))
    return v @ v / 2 - jnp.sum(d**2 / 2 + d**4 / 5)


CHAIN = dx.LagrangeDirac(chain)
PENDULUM = dx.LagrangeDirac(lambda q, v: v @ v / 2 - 9.81 * q[1], holonomic=lambda q: (q @ q - 1.0)[None])
WELL = dx.LagrangeDirac(lambda q, v: v @ v / 2 - jnp.sum(jnp.sqrt(1.0 - q)))
WAVE = np.sin(np.pi * np.arange(1, 65) / 65)
HANGING = {"q": [0.6, -0.8], "v": [0.8, 0.6]}

RUNS = {
    "native": (CHAIN, {"q": WAVE[:3], "v": 0 * WAVE[:3]}),
    "xla": (CHAIN, {"q": WAVE[:3], "v": 0 * WAVE[:3], "engine": "xla"}),
    "sparse": (CHAIN, {"q": WAVE, "v": 0 * WAVE}),
    "multipliers": (PENDULUM, HANGING),
    "compensated": (PENDULUM, {**HANGING, "compensated": True}),
    "two points": (CHAIN, {"q0": WAVE[:3], "q1": 0.99 * WAVE[:3]}),
    "a batch": (PENDULUM, {"q": [[0.6, -0.8], [0.0, -1.0], [-1.0, 0.0]], "v": [[0.8, 0.6], [1.0, 0.0], [0.0, 2.0]]}),
    "a failure": (WELL, {"q": [0.0, 0.1], "v": [0.0, 1.0]}),
    "a batch with a failure": (WELL, {"q": [[0.0, 0.1], [-5.0, -6.0]], "v": [[0.0, 1.0], [0.0, 0.0]]}),
}


@pytest.fixture(autouse=True)
def small_pieces(monkeypatch):
    monkeypatch.setattr(streaming, "FEWEST_ROWS", 1)
    monkeypatch.setattr(streaming, "CHUNK_BYTES", 7 * 3 * 8)


def run(name, steps, **more):
    system, given = RUNS[name]
    return dx.simulate(system, dx.LagrangeDAlembert(), **{**given, **more}, step=0.05, steps=steps)


def same(ours, theirs):
    assert ours.t.tobytes() == theirs.t.tobytes()
    for field, values in theirs.fields.items():
        assert np.asarray(ours.fields[field]).tobytes() == np.asarray(values).tobytes(), field
    assert np.array_equal(ours.ok, theirs.ok) and ours.message == theirs.message


@pytest.mark.parametrize(("name", "every"), [*((name, 1) for name in RUNS), ("native", 3), ("sparse", 3), ("two points", 3)])
@pytest.mark.soak_of(but=["native-3", "two points-3"])
def test_has_the_bits_of_a_run_in_memory(name, every, tmp_path):
    path, theirs = tmp_path / "run.zarr", run(name, 40, save_every=every)
    first = run(name, 11, save_every=every, to=path)
    longer = run(name, 25, save_every=every, to=path)
    ours = longer.extend(15)
    assert first.q.shape == run(name, 11, save_every=every).q.shape and longer.rows <= ours.rows
    same(ours, theirs)
    again = dx.load(path, system=RUNS[name][0])
    same(again, theirs)
    if np.all(theirs.ok):
        np.testing.assert_allclose(again.energy(), theirs.energy(), rtol=0, atol=1e-14)
    for name in ("engine", "newton_iterations", "max_residual"):
        assert ours.stats[name] == theirs.stats[name]


@pytest.mark.parametrize("stops", [KeyboardInterrupt, SystemExit])
@pytest.mark.parametrize("where", ["put", "mark"])
@pytest.mark.soak_of(but=["mark-KeyboardInterrupt"])
def test_what_stops_a_run_keeps_what_was_written(where, stops, tmp_path, monkeypatch):
    path, calls, method = tmp_path / "run.zarr", [], getattr(RunStore, where)

    def stopped(self, *given):
        calls.append(given)
        if len(calls) > 3 and where == "mark":
            raise stops
        method(self, *given)
        if len(calls) > 3:
            raise stops

    with monkeypatch.context() as m:
        m.setattr(RunStore, where, stopped)
        if stops is KeyboardInterrupt:
            part = run("multipliers", 40, to=path)
        else:
            with pytest.raises(SystemExit):
                run("multipliers", 40, to=path)
            part = dx.load(path)
    theirs = run("multipliers", 40)
    assert not part.ok and "the same call" in part.message and 15 < part.rows < 40
    assert np.array_equal(part.q, theirs.q[: part.rows]) and len(part.multipliers) == part.rows - 1
    same(run("multipliers", 40, to=path), theirs)


@pytest.mark.parametrize("at", [14, 40])
def test_a_store_that_is_taken_away_meanwhile_is_one_error(at, tmp_path):
    path = tmp_path / "run.zarr"
    vanishing = lambda done, _: done >= at and shutil.rmtree(path, ignore_errors=True)
    with pytest.raises(OSError, match=rf"^the store {re.escape(str(path))} was removed or moved while it was written"):
        run("native", 40, to=path, progress=vanishing)


def test_reads_what_is_indexed(tmp_path, monkeypatch):
    sol, theirs = run("a batch", 40, to=tmp_path / "run.zarr"), run("a batch", 40)
    q, inside = sol.q, theirs.q
    keys = [
        (0,), (0, 5), (slice(None), -1), (Ellipsis, 1), (slice(None), slice(30, 4, -3)), (1, [3, 1, 30]), (slice(None), None, 2),
        ([0, 1], [4, 9]), (2, np.arange(41) % 2 == 0), inside > 0.5, (slice(None), slice(2, 2)),
    ]  # fmt: skip
    for key in keys:
        assert np.array_equal(q[key], inside[key]), key
    assert np.array_equal(q - inside, 0 * inside) and q.max() == inside.max() and len(list(q)) == 3
    assert np.array_equal(sol[1].q, theirs[1].q) and np.array_equal(sol[0.5:0.8].q, theirs[0.5:0.8].q)
    read = []
    block = type(q).block
    monkeypatch.setattr(type(q), "block", lambda self, index: (read.append(index), block(self, index))[1])
    assert np.array_equal(q[:, 20], inside[:, 20]) and len(read) == 1
    np.testing.assert_allclose(sol.at(1.01).q, theirs.at(1.01).q, rtol=0, atol=1e-14)
    assert len(set(read)) < 10


def test_refusals(tmp_path):
    path = tmp_path / "run.zarr"
    run("native", 20, to=path)
    with pytest.raises(ValueError, match="another run, which differs in initial data"):
        run("native", 20, to=path, q=WAVE[1:4])
    with pytest.raises(ValueError, match="has 20 steps already, and 10"):
        run("native", 10, to=path)
    with pytest.raises(ValueError, match=r"ends in \.zarr"):
        run("native", 10, to=tmp_path / "run.nc")
    with pytest.raises(ValueError, match="events= need every row"):
        run("native", 10, to=path, events=[dx.Event(lambda q: q[0])])
    run("native", 5).save(tmp_path / "saved.zarr")
    with pytest.raises(FileExistsError, match="not the store of a run"):
        run("native", 10, to=tmp_path / "saved.zarr")
    chunk = path / "q" / "c" / "0" / "0"
    data = bytearray(chunk.read_bytes())
    data[9] ^= 1
    chunk.write_bytes(data)
    with pytest.raises(ValueError, match="damaged"):
        np.asarray(dx.load(path).q)
    for write, about in ((np.savez_compressed, np.zeros(10**7, np.uint8)), (np.savez, np.zeros(3, np.uint8))):
        write(path / "time" / "reached.npz", about=about)
        for read in (lambda: dx.load(path), lambda: run("native", 30, to=path)):
            with pytest.raises(ValueError, match=r"run\.zarr.*reached\.npz is"):
                read()


@pytest.mark.soak
def test_a_killed_run_goes_on_with_its_bits(tmp_path):
    code = """
import sys, numpy as np, jax.numpy as jnp, dirax as dx
sys.path.insert(0, {here!r})
from test_streaming import CHAIN, WAVE
dx.simulate(CHAIN, dx.LagrangeDAlembert(), q=WAVE, v=0 * WAVE, step=0.05, steps=1_000_000_000, save_every=1000, to={path!r})
"""
    path = tmp_path / "run.zarr"
    child = subprocess.Popen([sys.executable, "-c", code.format(here=os.path.dirname(__file__), path=str(path))])
    while not path.exists():
        time.sleep(0.2)
    time.sleep(8.0)
    child.send_signal(signal.SIGKILL)
    child.wait()
    there = dx.load(path)
    steps = 1000 * (there.rows - 1)
    assert steps > 1000 and not there.ok
    theirs = dx.simulate(CHAIN, dx.LagrangeDAlembert(), q=WAVE, v=0 * WAVE, step=0.05, steps=steps, save_every=1000)
    assert np.array_equal(there.q, theirs.q)


@pytest.mark.soak
@pytest.mark.skipif(not os.path.exists("/proc/self/status"), reason="the peak of a process's memory is read from /proc")
def test_memory_does_not_grow_with_the_rows(tmp_path):
    """Ten thousand oscillators: rows of 640 MB pass through a process that has room for a part of them."""
    code = """
import sys, numpy as np, dirax as dx
from dirax.gallery import oscillator_chain
q = oscillator_chain.first_mode(10_000)
chain, rows = oscillator_chain.chain(alpha=0.0, beta=0.8), int(sys.argv[1])
sol = dx.simulate(chain, dx.LagrangeDAlembert(), q=q, v=0 * q, step=0.05, steps=rows, to=sys.argv[2])
assert sol.ok and sol.rows == rows + 1 and np.ptp(sol.energy()) < 1e-6 * sol.energy()[0]
print(next(line.split()[1] for line in open("/proc/self/status") if line.startswith("VmHWM")))
"""
    peaks = []
    for rows in (400, 4000):
        given = [sys.executable, "-c", code, str(rows), str(tmp_path / f"{rows}.zarr")]
        peaks.append(1024 * int(subprocess.run(given, capture_output=True, text=True, check=True).stdout.split()[-1]))
    assert peaks[1] - peaks[0] < 0.3 * 3600 * 10_000 * 16
