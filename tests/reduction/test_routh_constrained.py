"""Discrete Routh equations of systems with constraints and forces that do no work along the group: the unreduced equations,
an explicit ODE for order, and the refusal of those that move μ."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import dirax as dx
from dirax import gallery
from dirax.gallery import charged_particle

STEPS = 500


def skate_lagrangian(q, v):
    """A skate (x, y, φ) in a hilly field with a rotor θ whose inertia and axis the pose changes: θ is cyclic."""
    turn = v[3] + 0.4 * v[2] + 0.2 * jnp.sin(q[2]) * v[0]
    return (v[0] ** 2 + v[1] ** 2 + v[2] ** 2) / 2 + (1 + q[0] ** 2 / 4) * turn**2 / 2 - jnp.cos(q[0]) - q[1] / 5


def edge(q):
    return jnp.stack([jnp.sin(q[2]), -jnp.cos(q[2]), jnp.zeros(()), jnp.zeros(())])[None]


def drag(t, q, v):
    """On the shape alone, but not blind to the rotor."""
    return jnp.stack([-0.1 * v[0], 0.2 * jnp.sin(t), -0.1 * v[2] * (1 + v[3] ** 2), jnp.zeros(())])


SKATE = dx.LagrangeDirac(skate_lagrangian, edge, forces=drag)
SKATE_START: dict[str, Any] = {
    "q": np.array([0.3, 0.1, 0.5, 0.0]),
    "v": np.array([0.6 * np.cos(0.5), 0.6 * np.sin(0.5), 0.4, 0.9]),
}

BOWL = dx.LagrangeDirac(
    lambda q, v: (v[0] ** 2 + v[1] ** 2 + (q[0] * v[2]) ** 2) / 2 - q[1],
    holonomic=lambda q: jnp.array([q[0] ** 2 + q[1] ** 2 - 1.0]),
    forces=lambda t, q, v: jnp.array([-0.1 * v[0], -0.1 * v[1], 0.0]),
)
"""A spherical pendulum in cylindrical coordinates (r, z, θ), its rod a constraint, with drag on r and z."""
BOWL_START: dict[str, Any] = {"q": np.array([0.6, -0.8, 0.0]), "v": np.array([0.4, 0.3, 1.5])}


def everything(t, q, v):
    """(x, y, u, θ); not quadratic in θ̇, and with explicit time."""
    spin = v[3] - 0.3 * q[1] * v[0]
    return v[:3] @ v[:3] / 2 + (1 + q[0] ** 2 / 3) * (spin**2 / 2 + spin**4 / 8) - (1 + 0.3 * jnp.sin(t)) * q[0] ** 2 / 2 - q[2]


EVERYTHING = dx.LagrangeDirac(
    everything,
    one_forms=lambda q: jnp.array([[0.2 * q[0], 1.0, 0.0, 0.0]]),
    affine=lambda t, q: jnp.array([0.1 * jnp.cos(t)]),
    holonomic=lambda t, q: jnp.array([q[0] ** 2 + q[2] ** 2 - 1.0 - 0.1 * jnp.sin(t)]),
    forces=lambda t, q, v: jnp.append(-0.1 * v[3] * v[:3], 0.0),
)


def compared(system, start, fibre, rule="midpoint", constraint="midpoint", momentum=None, twist=None, **settings):
    """The run lifted from the Routh equations, each field equal to that of the unreduced one."""
    settings = {"step": 0.01, "steps": STEPS, "engine": "native", **start, **settings}
    unreduced = dx.simulate(system, dx.LagrangeDAlembert(rule, constraint, momentum), **settings)
    reduced = dx.reduce(system, dx.LinearConnection(fibre, twist))
    quotient = dx.simulate(reduced, dx.DiscreteRouth(rule, constraint, momentum), **settings)
    assert unreduced.ok and quotient.ok, (unreduced.message, quotient.message)
    lifted = dx.reconstruct(quotient)
    assert set(lifted.fields) == set(unreduced.fields)
    for name, values in unreduced.fields.items():
        # constraints are roundoff over the step
        tolerance = 1e-9 if name == "constraint" else 1e-10
        assert np.abs(lifted.fields[name] - values).max() < tolerance * max(1.0, np.abs(values).max()), name
    assert np.all(quotient.mu == quotient.mu[0])
    return unreduced, quotient


@pytest.mark.parametrize(
    ("rule", "constraint", "momentum", "twist"),
    [("midpoint", "midpoint", None, None), ("trapezoidal", "right", "outgoing", [[0.3, -0.2, 0.4]])],
)
@pytest.mark.soak
def test_a_skate_with_a_rotor(rule, constraint, momentum, twist):
    unreduced, quotient = compared(SKATE, SKATE_START, [3], rule, constraint, momentum, twist)
    assert quotient.equation.unknowns == 4 and unreduced.equation.unknowns == 5
    assert np.ptp(unreduced.q[:, 3]) > 1 and np.abs(unreduced.multipliers).max() > 1e-3 and np.ptp(unreduced.work) > 0.1
    assert np.ptp(unreduced.p[:, 3]) < 1e-12  # no force moves it there either


@pytest.mark.soak
def test_a_spherical_pendulum_on_a_rod():
    unreduced, quotient = compared(BOWL, BOWL_START, [2], twist=[[0.5, -0.3]])
    assert unreduced.equation.unknowns - quotient.equation.unknowns == 2  # ġ, and that of the projected velocity
    assert np.abs(unreduced.multipliers).max() > 1e-3


@pytest.mark.parametrize("twist", [pytest.param(None, marks=pytest.mark.soak), [[0.3, -0.2, 0.4]]])
@pytest.mark.soak
def test_everything_at_once(twist):
    """Nonholonomic, affine and holonomic constraints, forces, explicit time, and a γ without a closed form."""
    start = {"q": [0.6, 0.2, -0.8, 0.1], "v": [0.3, -0.136, 0.2875, 0.8], "project": True}
    unreduced, quotient = compared(EVERYTHING, start, [3], twist=twist)
    assert np.ptp(unreduced.q[:, 3]) > 1 and quotient.multipliers.shape == (STEPS, 2)
    assert np.abs(quotient.multipliers).max(axis=0).min() > 1e-4


@pytest.mark.soak
def test_redundant_constraints_and_two_points():
    twice = dx.LagrangeDirac(skate_lagrangian, lambda q: jnp.concatenate([edge(q), 2 * edge(q)]), forces=drag)
    _, quotient = compared(twice, SKATE_START, [3], steps=50)
    assert quotient.stats["redundant_constraints"] == [1]
    first = dx.simulate(SKATE, dx.LagrangeDAlembert(), step=0.01, steps=1, **SKATE_START)
    compared(SKATE, {"q0": first.q[0], "q1": first.q[1]}, [3], steps=50)


def test_one_forms_of_which_only_the_span_is_invariant():
    """The multipliers are those of the one-forms at q, not of those at group coordinate 0."""
    scaled = dx.LagrangeDirac(skate_lagrangian, lambda q: jnp.exp(q[3]) * edge(q), forces=drag)
    assert dx.cyclic_coordinates(scaled, SKATE_START["q"]) == (3,)
    unreduced, quotient = compared(scaled, SKATE_START, [3], steps=200)
    assert np.abs(quotient.multipliers - unreduced.multipliers).max() > 1e-4


def field(t, y):
    """(q̇, v̇) of the skate from M v̇ = ∂L/∂q − ∂²L/∂v∂q v + f − Wᵀλ and W v̇ + Ẇ v = 0, and λ."""
    q, v = y[:4], y[4:8]
    slope, mixed, mass, w, turning = (np.asarray(a) for a in _parts(q, v))
    matrix = np.block([[mass, w.T], [w, np.zeros((1, 1))]])
    right = np.concatenate([slope - mixed @ v + np.asarray(drag(t, q, v)), -turning])
    found = np.linalg.solve(matrix, right)
    return np.concatenate([v, found[:4]]), found[4:]


@jax.jit
def _parts(q, v):
    slope = jax.grad(skate_lagrangian)(q, v)
    mixed = jax.jacfwd(jax.grad(skate_lagrangian, argnums=1))(q, v)
    mass = jax.hessian(skate_lagrangian, argnums=1)(q, v)
    return slope, mixed, mass, edge(q), jax.jvp(edge, (q,), (v,))[1] @ v


@pytest.mark.soak
def test_second_order_in_q_p_and_multipliers():
    y = np.concatenate([SKATE_START["q"], SKATE_START["v"]])
    exact = solve_ivp(lambda t, y: field(t, y)[0], (0, 1), y, "DOP853", rtol=1e-12, atol=1e-13).y[:, -1]
    momentum = np.asarray(SKATE.legendre(jnp.asarray(exact[:4]), jnp.asarray(exact[4:])))
    multiplier, errors = field(1.0, exact)[1], []
    reduced = dx.reduce(SKATE, dx.LinearConnection([3], [[0.3, -0.2, 0.4]]))
    for steps in (20, 40, 80, 160):
        h = 1 / steps
        sol = dx.simulate(reduced, dx.DiscreteRouth(), step=h, steps=steps + 1, engine="native", **SKATE_START)
        lifted = dx.reconstruct(sol)
        errors.append([
            np.abs(lifted.q[steps] - exact[:4]).max(),
            np.abs(lifted.p[steps] - momentum).max(),
            np.abs(lifted.multipliers[steps] / h - multiplier).max(),
        ])  # fmt: skip
    slopes = -np.polyfit(np.log([20, 40, 80, 160]), np.log(errors), 1)[0]
    assert slopes == pytest.approx([2, 2, 2], abs=0.08)


@pytest.mark.soak
def test_gradients_and_both_engines():
    reduced = dx.reduce(BOWL, dx.LinearConnection([2]))
    settings = {"step": 0.02, "steps": 25, **BOWL_START}
    runs = [dx.simulate(reduced, dx.DiscreteRouth(), engine=engine, **settings) for engine in ("native", "xla")]
    for name in ("x", "w", "g", "multipliers", "work"):
        assert np.abs(runs[0].fields[name] - runs[1].fields[name]).max() < 1e-12, name

    def height(system, scheme, rate):
        v = jnp.asarray(BOWL_START["v"]).at[2].set(rate)
        sol = dx.simulate(system, scheme, q=BOWL_START["q"], v=v, step=0.02, steps=10)
        return dx.reconstruct(sol).q[-1] @ jnp.arange(1.0, 4) if system is reduced else sol.q[-1] @ jnp.arange(1.0, 4)

    by_routh = jax.grad(lambda rate: height(reduced, dx.DiscreteRouth(), rate))(1.5)
    unreduced = jax.grad(lambda rate: height(BOWL, dx.LagrangeDAlembert(), rate))(1.5)
    assert float(by_routh) == pytest.approx(float(unreduced), rel=1e-10)


def test_what_moves_the_momentum_is_refused_with_its_size_and_place():
    start = {"step": 0.1, "steps": 3}
    disk: Any = gallery.get("rolling-disk")
    message = r"constraints move: one-form 0 has the part 1 along q\[0\] at q = .*, at or near .*use dx.LagrangeDAlembert on"
    with pytest.raises(ValueError, match=message):
        dx.simulate(dx.reduce(disk.system, dx.LinearConnection([0, 1])), dx.DiscreteRouth(), params=disk.params,
                    **disk.initial, **start)  # fmt: skip
    # a part that vanishes at the initial point itself
    pushed = dx.LagrangeDirac(
        charged_particle.lagrangian, forces=lambda t, q, v, params: jnp.append(-0.1 * v[:3], 0.3 * q[0] * v[3])
    )
    reduced = dx.reduce(pushed, dx.LinearConnection([3]))
    particle: dict[str, Any] = {"q": np.zeros(4), "v": [1.0, 0.0, 1.0, 1.0], "params": charged_particle.PARAMS}
    with pytest.raises(ValueError, match=r"f has the part -?0\.\d+ along q\[3\] at q = \[.*\], v = \[.*\], at or near"):
        dx.simulate(reduced, dx.DiscreteRouth(), **particle, **start)
    assert dx.simulate(reduced, dx.LagrangeDAlembert(), **particle, **start).ok
    assert reduced.moves_momentum({k: jnp.asarray(particle[k]) for k in "qv"}, charged_particle.PARAMS)
