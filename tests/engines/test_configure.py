"""configure(): the XLA option takes effect before the first computation, and is refused after it."""

import os
import subprocess
import sys

import jax.numpy as jnp
import pytest

import dirax as dx
from dirax.engines.configure import with_option

FAST = """
import dirax as dx
from dirax.engines.configure import small_loops_are_one_kernel
system = dx.LagrangeDirac(lambda q, v, params: (v @ v - params["k"] * q @ q) / 2)
run = {"q": [1.0], "v": [0.0], "params": {"k": 1.0}, "step": 0.5, "steps": 2}
sol = dx.simulate(system, dx.PlusLagrangeDirac(), **run)
assert sol.stats["engine"] == "native"
assert abs(sol.q[-1, 0] - 0.3125) < 1e-14, sol.q
dx.configure(fast_loops=True)
assert small_loops_are_one_kernel()
sol = dx.simulate(system, dx.PlusLagrangeDirac(), **run, engine="xla")
assert abs(sol.q[-1, 0] - 0.3125) < 1e-14, sol.q
"""


def test_before_the_first_computation():
    """Importing dirax computes nothing, and a run of the native engine nothing by JAX. Two steps of p −= q/2, q += p/2
    from (1, 0): q = 1, 3/4, 5/16."""
    environment = {name: value for name, value in os.environ.items() if name != "XLA_FLAGS"}
    environment["JAX_PLATFORMS"] = "cpu"
    done = subprocess.run([sys.executable, "-c", FAST], env=environment, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr


def test_after_the_first_computation(monkeypatch):
    assert jnp.ones(2).sum() == 2
    monkeypatch.setenv("XLA_FLAGS", "--xla_dump_to=/nowhere")
    with pytest.raises(RuntimeError, match="fast_loops=True has no effect: JAX has computed something"):
        dx.configure(fast_loops=True)
    assert os.environ["XLA_FLAGS"] == "--xla_dump_to=/nowhere"
    monkeypatch.delenv("XLA_FLAGS")
    with pytest.raises(RuntimeError):
        dx.configure(fast_loops=True)
    assert "XLA_FLAGS" not in os.environ


def test_other_flags_stay():
    option = "xla_cpu_small_while_loop_byte_threshold"
    extra = "--xla_backend_extra_options="
    assert with_option("", True) == f"{extra}{option}=65536"
    assert with_option(f"--a=1 {extra}b=2,{option}=7", True) == f"--a=1 {extra}b=2,{option}=65536"
    assert with_option(f"--a=1 {extra}{option}=7", False) == "--a=1"
    assert with_option(f"{extra}b=2", False) == f"{extra}b=2"
    with pytest.raises(TypeError, match="must be True or False, but 'yes'"):
        dx.configure(fast_loops="yes")
