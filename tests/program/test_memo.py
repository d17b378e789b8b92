"""What is kept in memory for later calls is bounded, and can be let go."""

import gc
import subprocess
import sys

import numpy as np
import pytest

from dirax.program.memo import Memo, Same


def test_a_memo_keeps_what_was_used_last():
    made, memo = [], Memo(2)
    get = lambda key: memo.get(key, lambda: made.append(key) or len(made))
    assert [get("a"), get("b"), get("a"), get("c"), get("a"), get("b")] == [1, 2, 1, 3, 1, 4]
    assert len(memo) == 2


def test_keys_by_value_by_identity_and_without_a_hash():
    memo, one, other = Memo(8), np.ones(2), np.ones(2)
    assert memo.get((1, "x"), list) is memo.get((1, "x"), list)
    assert memo.get(Same(one), list) is memo.get(Same(one), list)
    assert memo.get(Same(one), list) is not memo.get(Same(other), list)
    assert memo.get((one,), list) is not memo.get((one,), list)  # type: ignore[arg-type]


def test_errors_of_what_is_made_are_passed_on():
    """Also a TypeError that speaks of hashes, which is not about the key."""

    def make():
        raise TypeError("unhashable type: 'dict'")

    with pytest.raises(TypeError, match="unhashable"):
        Memo(1).get("key", make)


LET_GO = """
import gc, sys, weakref
import jax.numpy as jnp, numpy as np
import dirax as dx
def run():
    system = dx.LagrangeDirac(lambda q, v: v @ v / 2 - 1 + jnp.cos(q[0]))
    sol = dx.simulate(system, dx.LagrangeDAlembert(), q=[1.0], v=[0.0], step=0.1, steps=5, engine=sys.argv[1])
    assert np.isfinite(sol.energy()).all()
    return weakref.ref(system), float(sol.q[-1, 0])

kept, before = run()
gc.collect()
assert kept() is not None, "kept for a second run"
dx.clear_caches()
gc.collect()
assert kept() is None, "let go"
assert run()[1] == before
"""


@pytest.mark.parametrize("engine", ["native", pytest.param("xla", marks=pytest.mark.soak)])
def test_a_system_that_was_run_is_let_go(engine):
    """In a process of its own: to collect all the garbage of a long one takes seconds."""
    ran = subprocess.run([sys.executable, "-c", LET_GO, engine], capture_output=True, text=True)
    assert ran.returncode == 0, ran.stderr


def test_garbage_is_looked_for_less_often_while_something_is_made():
    usual, seen = gc.get_threshold(), []
    memo: Memo[int] = Memo(4)

    def inner() -> int:
        seen.append(gc.get_threshold()[0])
        return 1

    def fails() -> int:
        seen.append(gc.get_threshold()[0])
        raise ValueError

    assert memo.get("outer", lambda: memo.get("inner", inner)) == 1
    with pytest.raises(ValueError):
        memo.get("fails", fails)
    assert min(seen) > usual[0] and gc.get_threshold() == usual
