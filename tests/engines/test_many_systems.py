"""Many systems, and many threads: what is compiled for those that are gone is released, and nothing that still runs."""

import gc
import threading
from pathlib import Path

import jax
import jax.numpy as jnp
import pytest

import dirax as dx

MAPS = Path("/proc/self/maps")
WARM, MORE = 120, 60
"""Systems until every cache is full, and those over which nothing may grow."""


def used() -> tuple[int, float]:
    """(memory maps, megabytes in memory) of this process."""
    gc.collect()
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return MAPS.read_text().count("\n"), pages * 4096 / 2**20


def run(number: int, kind: str) -> None:
    """A run of a system that was not there before, or its derivative."""
    system = dx.LagrangeDirac(lambda q, v: (v @ v - (1.0 + number / 100) * q @ q) / 2)
    given = {"v": jnp.array([0.0, 1.0]), "step": 0.1, "steps": 5}
    if kind == "gradient":
        jax.grad(lambda q: jnp.sum(dx.simulate(system, dx.LagrangeDAlembert(), q=q, **given).q[-1]))(jnp.array([1.0, 0.0]))
    else:
        dx.simulate(system, dx.LagrangeDAlembert(), q=[1.0, 0.0], engine=kind, **given)


@pytest.mark.soak
@pytest.mark.skipif(not MAPS.exists(), reason="there is no /proc to read memory maps from")
@pytest.mark.parametrize("kind", ["native", "xla", "gradient"])
def test_nothing_grows(kind):
    for number in range(WARM):
        run(number, kind)
    maps, megabytes = used()
    for number in range(WARM, WARM + MORE):
        run(number, kind)
    more_maps, more_megabytes = used()
    assert more_maps - maps < 3 * MORE
    assert more_megabytes - megabytes < 0.5 * MORE


def test_the_first_runs_of_a_system_in_several_threads():
    """Each may have compiled the step: none lets go of the code that another one runs."""

    def last(system, begin, found):
        begin.wait()
        run = {"q": [1.0], "v": [0.0], "step": 0.01, "steps": 100_000, "save_every": 1000, "engine": "native"}
        found.append(dx.simulate(system, dx.LagrangeDAlembert(), **run).q[-1, 0])

    for length in (1.0, 1.1):
        system = dx.LagrangeDirac(lambda q, v, length=length: v @ v / 2 + jnp.cos(q[0]) * length)
        begin, found = threading.Barrier(6), []
        threads = [threading.Thread(target=last, args=(system, begin, found)) for _ in range(6)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        assert len(found) == 6 and len(set(found)) == 1
