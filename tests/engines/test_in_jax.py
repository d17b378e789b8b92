"""The scalar graph given back as JAX programs: the same steps and the same derivatives as the equations as they are."""

import jax
import jax.numpy as jnp
import numpy as np

import dirax as dx
from dirax.engines import xla

SYSTEM = dx.LagrangeDirac(
    lambda q, v, c: (v[0] ** 2 + v[1] ** 2) / 2 + v[2] ** 2 / 8 + v[3] ** 2 / 4 - c["g"] * jnp.sin(q[2]) * jnp.hypot(q[0], 2.0),
    lambda q: jnp.array([[1.0, 0.0, -jnp.cos(q[3]), 0.0], [0.0, 1.0, -jnp.sin(q[3]), 0.0]]),
)
START = {"q": np.array([0.0, 0.0, 0.0, 1.0]), "v": np.array([5.0, 8.0, 10.0, 1.0]), "project": True}


def run(scheme, **more):
    return dx.simulate(SYSTEM, scheme, **(START | {"step": 1e-3, "steps": 40, "engine": "xla"} | more))


def test_steps_written_in_scalars_are_the_steps(monkeypatch):
    """One equation, a composition of two, and a batch with parameters of its own."""
    c = {"g": np.array([1.0, 9.81, 3.0])}
    batch = {name: np.tile(START[name], (3, 1)) for name in ("q", "v")} | {"params": c, "batch_params": True}
    runs = [
        lambda: run(dx.PlusLagrangeDirac(), params={"g": 9.81}),
        lambda: run(dx.SymmetricComposition(dx.PlusLagrangeDirac()), params={"g": 9.81}, compensated=True),
        lambda: run(dx.PlusLagrangeDirac(), **batch),
    ]
    arrays = [r() for r in runs]
    assert np.max(np.abs(arrays[0].multipliers)) > 1e-3
    monkeypatch.setattr(xla, "fast_loops_asked_for", lambda: True)
    for plain, scalar in zip(arrays, [r() for r in runs], strict=True):
        assert np.all(scalar.ok)
        for name, values in plain.fields.items():
            np.testing.assert_allclose(scalar.fields[name], values, rtol=1e-10, atol=1e-10)


def test_derivatives_through_scalars(monkeypatch):
    end = lambda g: jnp.sum(jnp.cos(run(dx.PlusLagrangeDirac(), params={"g": g}, steps=10).p[-1]))
    plain = jax.jit(jax.grad(end))(9.81)
    monkeypatch.setattr(xla, "fast_loops_asked_for", lambda: True)
    scalar = jax.jit(jax.grad(lambda g: end(g)))(9.81)
    np.testing.assert_allclose(scalar, plain, rtol=1e-11)
