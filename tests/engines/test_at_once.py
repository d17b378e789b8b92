"""Short runs in one call of machine code have the bits of those that are taken chunk by chunk."""

import jax.numpy as jnp
import numpy as np
import pytest

import dirax as dx
from dirax import gallery
from dirax.engines.native import run as driver
from dirax.engines.native.one_lane import OneLane

QUARTIC = dx.LagrangeDirac(lambda q, v, k: v @ v / 2 - k * q[0] ** 4 - q @ q / 2 + jnp.log(q[1]))


CASES = {
    "explicit": (QUARTIC, dx.PlusLagrangeDirac(), {"q": [0.3, 1.0], "v": [0.1, 0.2], "params": 0.5, "step": 0.05, "steps": 7}),
    "implicit": (QUARTIC, dx.LagrangeDAlembert(), {"q": [0.3, 1.0], "v": [0.1, 0.2], "params": 0.5, "step": 0.05, "steps": 7}),
    "composed": (
        QUARTIC,
        dx.Composition(dx.LagrangeDAlembert(), "suzuki4"),
        {"q": [0.3, 1.0], "v": [0.1, 0.2], "params": 0.5, "step": 0.05, "steps": 7, "save_every": 3, "t0": 2.0},
    ),
    "two points": (
        QUARTIC,
        dx.LagrangeDAlembert(),
        {"q0": [0.3, 1.0], "q1": [0.31, 1.01], "params": 0.5, "step": 0.05, "steps": 7},
    ),
    "one step": (QUARTIC, dx.LagrangeDAlembert(), {"q": [0.3, 1.0], "v": [0.1, 0.2], "params": 0.5, "step": 0.05, "steps": 1}),
    "fails on the way": (
        QUARTIC,
        dx.LagrangeDAlembert(),
        {"q": [0.3, 0.2], "v": [0.1, -9.0], "params": 0.5, "step": 0.4, "steps": 7},
    ),
}


LEFT = {"fails on the way", "lc-ladder"}
"""Runs that one call leaves to chunks: their sizes are in doubt, or they stop."""


@pytest.mark.parametrize("name", [*CASES, "rolling-disk", "double-spherical-pendulum", "lc-ladder"])
def test_one_call_has_the_bits_of_chunks(name, monkeypatch):
    if name in CASES:
        system, scheme, given = CASES[name]
    else:
        example = gallery.get(name)
        system, scheme, given = (
            example.system,
            example.scheme,
            {**example.initial, "params": example.params, "step": example.step},
        )
        given["steps"] = 9
    run, called, at_once = dx.prepare(system, scheme, engine="native", **given), [], OneLane.at_once

    def counted(self, *kernels):
        called.append(at_once(self, *kernels))
        return called[-1]

    monkeypatch.setattr(OneLane, "at_once", counted)
    whole, longer = run(), run().extend(3)
    assert len(called) >= 2 and all((found is None) == (name in LEFT) for found in called)
    monkeypatch.setattr(driver.Ready, "_at_once", lambda *_: None)
    by_chunks = run()
    assert whole.ok == by_chunks.ok and whole.message == by_chunks.message and np.array_equal(whole.t, by_chunks.t)
    for field in by_chunks.fields:
        assert np.array_equal(whole.fields[field], by_chunks.fields[field], equal_nan=True), field
        assert np.array_equal(longer.fields[field], by_chunks.extend(3).fields[field], equal_nan=True), field
    for number in ("newton_iterations", "max_residual"):
        assert whole.stats[number] == by_chunks.stats[number]


def test_ctrl_c_keeps_what_a_call_has_found(monkeypatch):
    system, scheme, given = CASES["implicit"]
    run, at_once = dx.prepare(system, scheme, **given), OneLane.at_once
    before = run()

    def interrupted(self, *kernels):
        at_once(self, *kernels)
        raise KeyboardInterrupt

    monkeypatch.setattr(OneLane, "at_once", interrupted)
    assert np.array_equal(run().q, before.q) and run().ok
