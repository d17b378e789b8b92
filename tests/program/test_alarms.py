"""XLA's alarms about slow compilation, which go past Python to the terminal."""

import subprocess
import sys

import pytest

from dirax.program import alarms

SLOW = """
import sys
import jax, jax.numpy as jnp
import dirax as dx
from dirax.program.compiled import compiled

jax.config.update("jax_enable_compilation_cache", False)

def folded(x):
    return x + jax.lax.reduce_window(jnp.arange(12000.0), 0.0, jax.lax.add, (300,), (1,), "VALID").sum()

compiled(folded)(jnp.ones(()))
print("then", file=sys.stderr, flush=True)
jax.jit(folded)(jnp.ones(()))
"""


@pytest.mark.soak
def test_constants_that_are_folded_for_long_alarm_nobody():
    """JAX is imported first here; the level is that of before afterwards, so that programs of others alarm as they did."""
    errors = subprocess.run([sys.executable, "-c", SLOW], capture_output=True, text=True, check=True).stderr
    ours, others = errors.split("then\n")
    assert ours == "" and "Constant folding" in others


@pytest.mark.parametrize(("named", "variable", "level"), [("ERROR", "0", 2), (None, "1", 1), (None, "", 0), ("NOTSET", "2", 2)])
def test_the_level_is_set_back(monkeypatch, named, variable, level):
    levels = []
    monkeypatch.setattr(alarms, "_set_level", levels.append)
    monkeypatch.setenv("TF_CPP_MIN_LOG_LEVEL", variable)
    monkeypatch.setattr(alarms.jax, "config", type("Config", (), {"jax_logging_level": named}))
    with alarms.without_alarms(), alarms.without_alarms():
        assert levels == [alarms.FATAL]
    assert levels == [alarms.FATAL, level]
