"""The constraint algorithm on systems with forces, and on those that depend on time, with t as a coordinate."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import dirax as dx

circle = lambda q: jnp.stack([q @ q - 1.0])
PENDULUM = lambda q, v: v @ v / 2 - q[1]


def dimensions(chain):
    return [level.dimension for level in chain.levels]


@pytest.mark.soak
def test_forces_enter_the_field_and_the_multipliers():
    """f = c(v_y, −v_x) − γv on |q| = 1: 2λ = y − |v|² − q·f keeps q·q̈ = −|v|²."""
    c, gamma = 0.7, 0.2
    force = lambda t, q, v: c * jnp.stack([v[1], -v[0]]) - gamma * v
    near = {"q": [0.6, -0.8], "v": [0.4, 0.3]}
    system = dx.NonholonomicMechanics(lambda q: jnp.eye(2), lambda q: q[1], holonomic=circle, forces=force)
    chain = dx.constraint_algorithm(system, near=near)
    assert (dimensions(chain), chain.index, chain.verdict) == ([3, 2, 2], 2, "determined")
    assert chain.coordinates == ("q0", "q1", "p0", "p1") and not chain.clock
    q, v = np.array(near["q"]), np.array(near["v"])
    f = np.asarray(force(0.0, jnp.asarray(q), jnp.asarray(v)))
    tension = q[1] - v @ v - q @ f
    assert chain.multipliers(chain.point) == pytest.approx([tension / 2], abs=1e-12)
    assert chain.field(chain.point) == pytest.approx([*v, *(np.array([0.0, -1.0]) + f + tension * q)], abs=1e-12)


@pytest.mark.soak
def test_a_driven_pendulum_has_the_time_as_its_last_coordinate():
    """A push sin 2t along x; Method 2 of the chain against angles, and against Method 2 of the system itself."""
    system = dx.LagrangeDirac(PENDULUM, holonomic=circle, forces=lambda t, q, v: jnp.stack([jnp.sin(2 * t), 0.0 * t]))
    start, t0 = {"q": np.array([0.6, -0.8]), "v": np.array([0.4, 0.3])}, 0.3
    chain = dx.constraint_algorithm(system, near={**start, "t": t0})
    assert chain.coordinates[-1] == "t" and chain.clock and dimensions(chain) == [4, 3, 3]
    assert chain.field(chain.point)[-1] == 1.0 and chain.point[-1] == t0
    x = np.concatenate([start["q"], start["v"], [t0]])
    swing = lambda t, y: [y[1], -np.sin(y[0]) + np.sin(2 * t) * np.cos(y[0])]
    angle = solve_ivp(swing, (t0, t0 + 2), [np.arctan2(0.6, 0.8), 0.5], rtol=1e-12, atol=1e-12).y[0, -1]
    errors = []
    for steps in (20, 40, 80):
        sol = dx.simulate(chain.resolved(), dx.DiscreteDirac(), x=x, step=2 / steps, steps=steps, t0=t0)
        np.testing.assert_allclose(sol.x[:, -1], sol.t, atol=1e-14)
        assert np.abs(sol.constraint_residual()).max() < 5e-15
        direct = dx.simulate(system, dx.DiscreteDirac(constraints="resolve"), **start, step=2 / steps, steps=steps, t0=t0)
        known = [np.sin(angle), -np.cos(angle)]
        errors.append([np.abs(sol.x[-1, :2] - known).max(), np.abs(direct.q[-1] - known).max()])
    assert np.log2(np.array(errors)[:-1] / np.array(errors)[1:]) == pytest.approx(2.0, abs=0.15)


@pytest.mark.soak
def test_constraints_that_move():
    """The pivot at x = .3 cos 2t: g, then G q̇ + ∂g/∂t; projections leave t alone; λ is that of Method 2."""
    pivot = lambda t: 0.3 * jnp.cos(2 * t)
    moving = lambda t, q: jnp.stack([(q[0] - pivot(t)) ** 2 + q[1] ** 2 - 1.0])
    system = dx.NonholonomicMechanics(lambda q: jnp.eye(2), lambda q: q[1], holonomic=moving)
    q, v = np.array([0.6 + 0.3, -0.8]), np.array([0.4, 0.3])
    chain = dx.constraint_algorithm(system, near={"q": q, "v": v})
    assert dimensions(chain) == [4, 3, 3]
    x = chain.point
    assert chain.multipliers(x) == pytest.approx(np.asarray(system.multipliers(x[:2], x[2:4], None, x[4])), abs=1e-12)
    y = np.asarray(chain.project(x + np.array([0.02, -0.01, 0.03, 0.02, 0.1])))
    assert y[4] == x[4] + 0.1
    assert system.constraint_at({"q": y[:2], "p": y[2:4], "t": y[4]}, None) == pytest.approx([0.0, 0.0], abs=1e-14)


def test_inputs_of_an_open_port_are_those_of_the_time():
    port = lambda inputs: dx.PortHamiltonian(lambda x: x @ x / 2, J=[[0.0, 1.0], [-1.0, 0.0]], B=[[0.0], [1.0]], inputs=inputs)
    driven = dx.constraint_algorithm(port(lambda t, x: jnp.sin(t)[None]), near={"x": [1.0, 0.5], "t": 0.4})
    assert driven.coordinates == ("x0", "x1", "t")
    assert driven.field(driven.point) == pytest.approx([0.5, -1.0 + np.sin(0.4), 1.0], abs=1e-15)
    fed_back = dx.constraint_algorithm(port(lambda t, x: -x[1:]), near=[1.0, 0.5])
    assert fed_back.field(fed_back.point) == pytest.approx([0.5, -1.5], abs=1e-15)


def test_a_singular_lagrangian_with_forces_is_put_on_the_pontryagin_bundle():
    """L = v_0²/2 − q_0q_1 − q_1²/2 dragged by −γv_0: q_1 = −q_0, v̇_0 = q_0 − γv_0."""
    system = dx.LagrangeDirac(
        lambda q, v: v[0] ** 2 / 2 - q[0] * q[1] - q[1] ** 2 / 2, forces=lambda t, q, v: -0.3 * v * jnp.array([1.0, 0.0])
    )
    chain = dx.constraint_algorithm(system, near={"q": [0.5, -0.4], "v": [0.2, -0.1]})
    assert chain.verdict == "determined" and chain.dimension == 2 and len(chain.coordinates) == 6
    q, v, p = np.split(chain.point, 3)
    assert [q[1], v[1], p[1], p[0]] == pytest.approx([-q[0], -v[0], 0.0, v[0]], abs=1e-12)
    assert np.asarray(chain.field(chain.point))[2] == pytest.approx(q[0] - 0.3 * v[0], abs=1e-12)
    with pytest.raises(ValueError, match="singular and has forces, which are functions of v: give near="):
        dx.constraint_algorithm(system, near=[0.5, -0.4, 0.0, 0.0])


def test_a_lagrangian_that_depends_on_time():
    """L = e^{.2t}(v²/2 − q²/2): ṗ = −e^{.2t}q, q̇ = e^{−.2t}p."""
    chain = dx.constraint_algorithm(
        dx.LagrangeDirac(lambda t, q, v: jnp.exp(0.2 * t) * (v @ v - q @ q) / 2), near={"q": [1.0], "v": [0.5], "t": 1.0}
    )
    grown = np.exp(0.2)
    assert chain.point == pytest.approx([1.0, 0.5 * grown, 1.0], abs=1e-14)
    assert chain.field(chain.point) == pytest.approx([0.5, -grown, 1.0], abs=1e-14)


def test_a_constraint_on_the_time_alone_is_inconsistent():
    chain = dx.constraint_algorithm(
        dx.LagrangeDirac(lambda q, v: v @ v / 2, holonomic=lambda t, q: jnp.stack([t - 1.0 + 0.0 * q[0]])), near={"q": [1.0, 0.0]}
    )
    assert chain.empty and "inconsistent" in chain.explanation
