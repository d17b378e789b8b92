"""The scalar graph given back as JAX programs: the same steps and the same derivatives as the equations as they are."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dirax as dx
from dirax.engines import policy
from dirax.engines.close_sizes import sizes_at
from dirax.engines.xla.lane import first_lane, take_step
from dirax.schemes.step import Shape, make_step_equation

SYSTEM = dx.LagrangeDirac(
    lambda q, v, c: (v[0] ** 2 + v[1] ** 2) / 2 + v[2] ** 2 / 8 + v[3] ** 2 / 4 - c["g"] * jnp.sin(q[2]) * jnp.hypot(q[0], 2.0),
    lambda q: jnp.array([[1.0, 0.0, -jnp.cos(q[3]), 0.0], [0.0, 1.0, -jnp.sin(q[3]), 0.0]]),
)
START = {"q": np.array([0.0, 0.0, 0.0, 1.0]), "v": np.array([5.0, 8.0, 10.0, 1.0]), "project": True}


def run(scheme, **more):
    return dx.simulate(SYSTEM, scheme, **(START | {"step": 1e-3, "steps": 40, "engine": "xla"} | more))


@pytest.mark.soak
def test_steps_written_in_scalars_are_the_steps(monkeypatch):
    """Against the native engine: a composition of two equations, and a batch with parameters of its own."""
    c = {"g": np.array([1.0, 9.81, 3.0])}
    batch = {name: np.tile(START[name], (3, 1)) for name in ("q", "v")} | {"params": c, "batch_params": True}
    runs = [
        lambda engine: run(dx.SymmetricComposition(dx.PlusLagrangeDirac()), params={"g": 9.81}, compensated=True, engine=engine),
        lambda engine: run(dx.PlusLagrangeDirac(), **batch, engine=engine),
    ]
    native = [r("native") for r in runs]
    assert np.max(np.abs(native[0].multipliers)) > 1e-3
    monkeypatch.setattr(policy, "fast_loops_asked_for", lambda: True)
    for plain, scalar in zip(native, [r("xla") for r in runs], strict=True):
        assert np.all(scalar.ok)
        for name, values in plain.fields.items():
            np.testing.assert_allclose(scalar.fields[name], values, rtol=1e-10, atol=1e-10)


@pytest.mark.soak
def test_derivatives_through_scalars(monkeypatch):
    end = lambda g: jnp.sum(jnp.cos(run(dx.PlusLagrangeDirac(), params={"g": g}, steps=10).p[-1]))
    plain = jax.jit(jax.grad(end))(9.81)
    monkeypatch.setattr(policy, "fast_loops_asked_for", lambda: True)
    scalar = jax.jit(jax.grad(lambda g: end(g)))(9.81)
    np.testing.assert_allclose(scalar, plain, rtol=1e-11)


@pytest.mark.soak
def test_method_2_in_large_batches_with_the_jacobian_of_the_graph():
    """Against the native engine, to roundoff: one stage and five equal ones, which are compiled once."""
    metric = lambda q: jnp.diag(jnp.stack([1.0 + q[1] ** 2, jnp.ones(())]))
    forms = lambda q: jnp.stack([jnp.stack([jnp.sin(q[1]), jnp.ones(())])])
    system = dx.NonholonomicMechanics(metric, lambda q: -jnp.cos(q[0]), forms)
    q = np.stack([np.linspace(0.1, 1.0, policy.SCALAR_BATCH), np.full(policy.SCALAR_BATCH, 0.7)], axis=1)
    run_2 = {"q": q, "v": np.ones_like(q), "project": True, "step": 0.05, "steps": 20}
    scheme = dx.DiscreteDirac(constraints="resolve")
    for made in (scheme, dx.Composition(scheme, "suzuki4")):
        ours, theirs = (dx.simulate(system, made, **run_2, engine=engine) for engine in ("xla", "native"))
        assert np.all(ours.ok) and np.max(np.abs(theirs.multipliers)) > 0.1
        for name, values in theirs.fields.items():
            np.testing.assert_allclose(ours.fields[name], values, rtol=1e-12, atol=1e-12)


@pytest.mark.soak
def test_equal_stages_are_compiled_once():
    scheme, shape = dx.LagrangeDAlembert(), Shape(4, 2)
    sizes = []
    for made in (dx.Composition(scheme, [1.0]), dx.Composition(scheme, "suzuki4")):
        equation = make_step_equation(made, SYSTEM, shape)
        lane = first_lane(jnp.ones(8), tuple(jnp.ones(stage.unknowns) for stage, _ in equation.stages))
        units = sizes_at(equation, lane.state, lane.unknowns, {"g": 9.81}, 0.0, 0.1)
        step = lambda lane, h, c, equation=equation, units=units: take_step(equation, lane, 0.0, h, c, units, 50, False)
        sizes.append(len(jax.jit(step).lower(lane, 0.1, {"g": 9.81}).as_text()))
    assert sizes[1] < 1.5 * sizes[0]
