"""Files that are changed at random: each is refused in one sentence, or holds what it held; nothing in it is executed, and memory
is bounded by what it says it holds. Forty of each kind here, fifty thousand in `make soak`."""

import builtins
import os
import subprocess
import tracemalloc

import jax.numpy as jnp
import numpy as np
import pytest

import dirax as dx

SKATE = dx.LagrangeDirac(lambda q, v: v @ v / 2 - 10.0 * q[0], lambda q: jnp.array([[jnp.sin(q[2]), -jnp.cos(q[2]), 0.0]]))
MEBIBYTE = 2**20


@pytest.fixture(scope="module")
def saved():
    """Two trajectories of a few rows."""
    v = np.array([[0.5, 0.0, 1.0], [-1.0, 0.0, 0.3]])
    return dx.simulate(SKATE, dx.PlusLagrangeDirac(), q=np.zeros(3), v=v, step=0.01, steps=6)


def mutated(content: bytes, draw: np.random.Generator) -> bytes:
    """With bits flipped, bytes replaced, left out, put in, repeated or exchanged, or the end cut off."""
    data, size = bytearray(content), len(content)
    first, last = sorted(draw.integers(0, size + 1, 2).tolist())
    last = min(last, first + int(draw.integers(1, 65)))
    match draw.integers(0, 7):
        case 0:
            for bit in draw.integers(0, 8 * size, draw.integers(1, 4)).tolist():
                data[bit // 8] ^= 1 << bit % 8
        case 1:
            data[first:last] = draw.bytes(last - first)
        case 2:
            del data[first:last]
        case 3:
            data[first:first] = draw.bytes(last - first)
        case 4:
            data[first:first] = data[first:last] * int(draw.integers(1, 50))
        case 5:
            data[first:last] = bytes(last - first)
        case _:
            del data[first:]
    return bytes(data)


def refuse(*_, **__):
    raise AssertionError("something in a file was executed")


def examine(sol, path, count, seed, monkeypatch):
    """How many of the mutated files are refused."""
    files = [path] if path.is_file() else sorted(p for p in path.rglob("*") if p.is_file() and p.stat().st_size)
    contents, draw, refused = [file.read_bytes() for file in files], np.random.default_rng(seed), 0
    whole = sum(map(len, contents)) + sum(np.asarray(values).nbytes for values in sol.fields.values())
    dx.load(path)  # what it imports is there
    for place, name in ((builtins, "eval"), (builtins, "exec"), (os, "system"), (subprocess, "check_output")):
        monkeypatch.setattr(place, name, refuse)
    tracemalloc.start()
    try:
        for _ in range(count):
            number = int(draw.integers(len(files)))
            files[number].write_bytes(mutated(contents[number], draw))
            tracemalloc.reset_peak()
            before = tracemalloc.get_traced_memory()[0]
            try:
                loaded = dx.load(path)
                assert loaded.fields.keys() == sol.fields.keys() and np.array_equal(loaded.t, sol.t)
                assert all(np.asarray(loaded.fields[name]).tobytes() == np.asarray(a).tobytes() for name, a in sol.fields.items())
            except ValueError as error:
                assert str(error).startswith(f"{path} cannot be loaded: ") and "\n" not in str(error)
                refused += 1
            assert tracemalloc.get_traced_memory()[1] - before < 2 * whole + 4 * MEBIBYTE
            files[number].write_bytes(contents[number])
    finally:
        tracemalloc.stop()
    return refused


@pytest.mark.parametrize("count", [40, pytest.param(50_000, marks=pytest.mark.soak)])
@pytest.mark.parametrize("ending", [".zarr", ".nc"])
@pytest.mark.soak
def test_mutated_files_are_refused_or_hold_what_they_held(ending, count, saved, tmp_path, monkeypatch):
    path = saved.save(tmp_path / f"run{ending}")
    assert examine(saved, path, count, len(ending), monkeypatch) > count // 2
