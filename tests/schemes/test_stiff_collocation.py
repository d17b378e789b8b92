"""Collocation where the fixed-point iteration does not converge, or hardly: what is taken for a solved step."""

import jax.numpy as jnp
import numpy as np
import pytest

import dirax as dx


def springs(q, v, k):
    """Bobs in a chain; k is the frequency of a spring."""
    ends = jnp.concatenate([jnp.zeros(2), q]).reshape(-1, 2)
    lengths = jnp.linalg.norm(ends[1:] - ends[:-1], axis=1)
    return v @ v / 2 - k**2 * jnp.sum((lengths - 1.0) ** 2) / 2 - jnp.sum(q[1::2])


def coupled(q, v):
    """Two arms with a stiff spring between them, rates of a mass matrix."""
    kinetic = v[0] ** 2 + v[1] ** 2 / 2 + v[0] * v[1] * jnp.cos(q[0] - q[1])
    return kinetic + 9.8 * (2 * jnp.cos(q[0]) + jnp.cos(q[1])) - 2e4 * (q[1] - q[0]) ** 2


CHAIN = dx.LagrangeDirac(springs)

STIFF = {
    "accelerations": (CHAIN, {"q": [0.6, -0.8, 1.2, -1.6], "v": [0.4, 0.3, 0.0, 0.1]}, {"params": 100.0}, 0.06, 3),
    "rates of a mass matrix": (dx.LagrangeDirac(coupled), {"q": [0.7, 0.7], "v": [0.3, 0.3]}, {}, 0.1, 5),
    "ports": (
        dx.PortHamiltonian(
            lambda x: x @ x / 2 + x[0] ** 4 / 4,
            J=lambda x: jnp.array([[0.0, 1.0 + x[1], 0.0], [-1.0 - x[1], 0.0, 3.0], [0.0, -3.0, 0.0]]),
            R=lambda x: jnp.diag(jnp.array([0.0, 0.0, 1e4])),
        ),
        {"x": [1.0, 0.2, 0.5]}, {}, 0.2, 3,
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", ["accelerations", "ports", pytest.param("rates of a mass matrix", marks=pytest.mark.soak)])
@pytest.mark.soak
def test_where_the_fixed_point_does_not_converge_newton_goes_on_with_systems_of_one_node(name):
    system, data, more, step, stages = STIFF[name]
    run = lambda engine, data: dx.simulate(system, dx.Collocation(stages), step=step, steps=30, engine=engine, **data, **more)
    native, arrays = run("native", data), run("xla", data)
    assert "then simplified Newton" in native.stats["iteration"] and "all unknowns" not in native.stats["iteration"]
    for field, values in native.fields.items():
        np.testing.assert_allclose(values, arrays.fields[field], rtol=1e-11, atol=1e-11)
    batch = run("native", {field: np.array([np.multiply(0.1, values), values]) for field, values in data.items()})
    for field, values in native.fields.items():
        np.testing.assert_array_equal(batch.fields[field][1], values)


HARDLY = {
    "fixed point": (dx.Collocation(3), [np.cos(0.7), -np.sin(0.7)], [0.0, 0.0], 200.0, 4.0, 500),
    "fixed point of means": (dx.EnergyCollocation(4), [np.cos(0.7), -np.sin(0.7)], [0.0, 0.0], 200.0, 4.0, 500),
    "simplified Newton": (
        dx.Collocation(2),
        [0.7707, -0.66163, 1.5279, -1.29474],
        [-0.1588, -0.325, 0.2857, 0.1698],
        1033.4,
        6.8013,
        1000,
    ),
}


@pytest.mark.parametrize("name", HARDLY)
@pytest.mark.soak_of(but=["simplified Newton"])
def test_a_step_is_not_left_where_its_changes_stop_to_shrink(name):
    """The iteration goes to and fro at 1e-10 of the stiff forces, far above their roundoff; another one goes on then."""
    scheme, q, v, k, hk, most = HARDLY[name]
    sol = dx.simulate(CHAIN, scheme, q=q, v=v, step=hk / k, steps=50, params=k, engine="native")
    assert "simplified Newton" in sol.stats["iteration"] and sol.stats["newton_iterations"] < most
    report = dx.verify(sol)
    assert report["steps solved"].value < 1e-12 and report["steps replayed"].verdict == "ok", report


SHORT = {
    "roundoff of large accelerations": (dx.Collocation(3), [0.768, -0.65, 1.53, -1.29], [0.2, 0.1, -0.1, 0.3], 1429.0, 0.093),
    "energy given back at low speed": (dx.EnergyCollocation(3), [0.7613, -0.641], [-0.1019, -0.0179], 100.34, 0.03817),
}


@pytest.mark.parametrize("name", SHORT)
@pytest.mark.soak_of("energy given back at low speed")
def test_short_steps_of_stiff_springs_are_no_false_alarm(name):
    scheme, q, v, k, hk = SHORT[name]
    report = dx.verify(dx.simulate(CHAIN, scheme, q=q, v=v, step=hk / k, steps=60, params=k))
    assert report["steps solved"].value < 1e-11 and report["steps replayed"].verdict == "ok", report
