"""Hamiltonian systems with holonomic constraints: a spherical pendulum in curved coordinates of T*R³ against its angles and
against its Lagrangian, a rigid body's level set, redundant constraints, and what cannot be stated so.

The oracles are scipy's DOP853 at tight tolerance in angles, the Lagrangian route, and conservation laws.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import dirax as dx
from curved_pendulum import exact, metric, place, slopes, sphere
from dirax import gallery
from dirax.diagnostics.bench.ode import explicit_ode

METHOD_1, METHOD_2 = dx.DiscreteDirac(), dx.DiscreteDirac(constraints="resolve")


def hamiltonian(x):
    return x[3:] @ jnp.linalg.solve(metric(x[:3]), x[3:]) / 2 + place(x[:3])[2]


on_sphere = lambda x: sphere(x[:3])
PENDULUM = dx.DiracSystem(dx.induced_dirac(None, 3), hamiltonian, holonomic=on_sphere)


def exact_state(times):
    """(x, λ) with x = (y, p) on T*R³."""
    y, p, multipliers = exact(times)
    return np.concatenate([y, p], 1), multipliers


START = exact_state(np.array([0.0, 1.0]))[0][0]


def pendulum_errors(scheme, steps):
    """Errors of q, p, of λ at the middle of each step and of the mean of two neighbours at their node."""
    sol = dx.simulate(PENDULUM, scheme, x=START, step=2.0 / steps, steps=steps)
    (x, at_nodes), (_, in_steps) = exact_state(sol.t), exact_state((sol.t[1:] + sol.t[:-1]) / 2)
    means = (sol.multipliers[1:] + sol.multipliers[:-1]) / 2
    parts = ((sol.x[:, :3], x[:, :3]), (sol.x[:, 3:], x[:, 3:]), (sol.multipliers, in_steps), (means, at_nodes[1:-1]))
    return [np.max(np.abs(found - known)) for found, known in parts], sol


@pytest.mark.soak
def test_orders_of_q_p_and_the_tension_of_method_2():
    errors = []
    for steps in (50, 100, 200):
        found, sol = pendulum_errors(METHOD_2, steps)
        errors.append(found)
        assert np.max(np.abs(sol.constraint_residual())) < 5e-15
    assert slopes(errors) == pytest.approx(2.0, abs=0.1)


@pytest.mark.soak
def test_the_multipliers_of_method_1_alternate_and_their_means_are_of_second_order():
    """p̄ is on the hidden constraint, so that the nodes are off it by O(h²), to either side in turn, and λ by O(h)."""
    errors, h = [pendulum_errors(METHOD_1, steps)[0] for steps in (50, 100, 200)], 2.0 / 200
    for measured in slopes(errors):
        assert measured == pytest.approx([2.0, 2.0, 1.0, 2.0], abs=0.1)
    _, sol = pendulum_errors(METHOD_1, 200)
    signs = np.sign(np.asarray(jax.vmap(PENDULUM.hidden_defect)(jnp.asarray(sol.x[1:11])))[:, 0])
    assert np.all(signs[1:9:2] == -signs[:8:2]) and errors[-1][2] > h * 0.05


@pytest.mark.soak
def test_method_1_is_that_of_the_lagrangian():
    """The same equations in x = (q, p), to roundoff, multipliers included; and q, p as initial data."""
    lagrangian = dx.LagrangeDirac(
        lambda y, v: v @ metric(y) @ v / 2 - place(y)[2], holonomic=lambda y: jnp.stack([place(y) @ place(y) - 1.0])
    )
    run = {"q": START[:3], "p": START[3:], "step": 0.05, "steps": 40}
    one, other = (dx.simulate(system, METHOD_1, **run) for system in (PENDULUM, lagrangian))
    np.testing.assert_allclose(one.x, np.concatenate([other.q, other.p], 1), atol=1e-13)
    np.testing.assert_allclose(one.multipliers, other.multipliers, atol=1e-12)
    assert one.ok and dx.verify(one).ok
    report = dx.verify(dx.simulate(PENDULUM, METHOD_2, **run))
    assert report.ok and report["constraint"].verdict == "ok", report


@pytest.mark.soak
def test_the_explicit_equations_of_the_benchmarks_are_those_of_the_constrained_system():
    ode = explicit_ode(PENDULUM, {"x": jnp.asarray(START)}, None)
    np.testing.assert_allclose(ode.derivative(0.0, jnp.asarray(START)), PENDULUM.constrained_field(START)[0], atol=1e-13)


def test_constraints_and_momentum_over_many_steps():
    """Method 2 keeps g and {g, H}; the angular momentum about the vertical, where coordinates are Cartesian."""
    flat = dx.DiracSystem(
        dx.induced_dirac(None, 3), lambda x: x[3:] @ x[3:] / 2 + x[2], holonomic=lambda x: jnp.stack([x[:3] @ x[:3] - 1.0])
    )
    sol = dx.simulate(
        flat, METHOD_2, q=[0.6, 0.0, -0.8], p=[0.4, 0.9, 0.3], step=0.02, steps=50_000, save_every=50, engine="native"
    )
    assert sol.ok and np.max(np.abs(sol.constraint_residual())) < 5e-15
    assert np.max(np.abs(sol.energy() - sol.energy()[0])) < 1e-4
    momentum = sol.x[:, 0] * sol.x[:, 4] - sol.x[:, 1] * sol.x[:, 3]
    assert np.max(np.abs(momentum - momentum[0])) < 1e-12


curve = lambda x: jnp.stack([x[0] ** 2 + 2 * x[1] ** 2 + x[0] ** 4 - 2.0])
FLAT = dx.DiracSystem(
    dx.induced_dirac(None, 2),
    lambda x: x[2:] @ x[2:] / 2 + 0.1 * (x[0] * x[3]) ** 2 + x[1],
    holonomic=curve,
)
FLAT_START = np.array([1.0, 0.0, 0.0, 0.7])


@pytest.mark.soak
def test_engines_and_batches_agree():
    run = {"step": 0.1, "steps": 10}
    batch = np.stack([FLAT_START, FLAT_START * np.array([1.0, 1.0, 1.0, -0.5])])
    native, xla = (dx.simulate(FLAT, METHOD_2, x=batch, engine=e, **run) for e in ("native", "xla"))
    np.testing.assert_allclose(native.x, xla.x, atol=1e-13)
    np.testing.assert_allclose(native.multipliers, xla.multipliers, atol=1e-12)
    np.testing.assert_array_equal(dx.simulate(FLAT, METHOD_2, x=FLAT_START, **run).x, native.x[0])


@pytest.mark.soak
def test_a_gradient_against_finite_differences():
    run = {"step": 0.1, "steps": 10}
    end = lambda speed: dx.simulate(FLAT, METHOD_2, x=jnp.array([1.0, 0.0, 0.0, 1.0]) * jnp.stack([1, 0, 0, speed]), **run).x[
        -1, 1
    ]
    slope = jax.jit(jax.grad(end))(0.7)
    assert slope == pytest.approx((float(end(0.7 + 1e-5)) - float(end(0.7 - 1e-5))) / 2e-5, rel=1e-7)


@pytest.mark.soak
def test_the_chain_finds_the_same_final_manifold_field_and_multipliers():
    chain = dx.constraint_algorithm(FLAT, near=FLAT_START)
    assert [level.dimension for level in chain.levels] == [3, 2, 2] and chain.verdict == "determined"
    x = FLAT.project(jnp.asarray(FLAT_START) + jnp.array([0.02, -0.01, 0.03, 0.01]))
    assert np.max(np.abs(chain.constraints(x))) < 1e-13
    velocity, multipliers = FLAT.constrained_field(x)
    np.testing.assert_allclose(chain.field(x), velocity, atol=1e-12)
    np.testing.assert_allclose(chain.multipliers(x), multipliers, atol=1e-12)


@pytest.mark.soak
def test_composition_and_the_exact_energy_of_a_discrete_gradient():
    errors = []
    fine = dx.simulate(FLAT, dx.Composition(METHOD_2, "suzuki4"), x=FLAT_START, step=0.0025, steps=400).x[-1]
    for steps in (10, 20, 40):
        sol = dx.simulate(FLAT, dx.Composition(METHOD_2, "suzuki4"), x=FLAT_START, step=1.0 / steps, steps=steps)
        errors.append(np.max(np.abs(sol.x[-1] - fine)))
        assert np.max(np.abs(sol.constraint_residual())) < 5e-15
    assert slopes(errors) == pytest.approx(4.0, abs=0.35)
    sol = dx.simulate(FLAT, dx.DiscreteGradient(), x=FLAT_START, step=0.02, steps=500)
    assert sol.ok and np.max(np.abs(sol.energy() - sol.energy()[0])) < 1e-14


def test_a_redundant_constraint_is_left_out_and_reported():
    make = lambda g: dx.DiracSystem(FLAT.structure, FLAT.hamiltonian.function, holonomic=g)
    twice = make(lambda x: jnp.concatenate([curve(x), 2 * curve(x) + curve(x) ** 2]))
    for scheme in (METHOD_1, METHOD_2, dx.DiscreteGradient()):
        one, both = (dx.simulate(system, scheme, x=FLAT_START, step=0.05, steps=40) for system in (FLAT, twice))
        assert both.stats["redundant_constraints"] == [1]
        np.testing.assert_allclose(both.x, one.x, atol=1e-13)
        np.testing.assert_allclose(both.multipliers, one.multipliers * [1.0, 0.0], atol=1e-12)
    contradicting = make(lambda x: jnp.concatenate([curve(x), curve(x) - 1e-3]))
    with pytest.raises(ValueError, match="contradict each other"):
        dx.simulate(contradicting, METHOD_2, x=FLAT_START, step=0.05, steps=4, check_initial=False)


def test_a_constrained_poisson_structure():
    """The rigid body ẋ = x × ∇H restricted to |x|² = 1, a Casimir: {g, ·} = 0, so that nothing is to be imposed."""
    so3 = dx.DiracStructure.from_bivector(lambda x: jnp.cross(x, jnp.eye(3), axisb=0, axisc=0))
    body = dx.DiracSystem(so3, lambda x: x @ (x / jnp.array([1.0, 2.0, 3.0])) / 2, holonomic=lambda x: jnp.stack([x @ x - 1.0]))
    with pytest.raises(ValueError, match="no unique solution"):
        dx.simulate(body, METHOD_1, x=[0.6, 0.0, 0.8], step=0.1, steps=2)


def test_a_charge_on_a_sphere_in_kinetic_momenta():
    """The gallery's bivector with a magnetic term against q̈ = v × b − e₃ + 2λq in scipy."""
    example = gallery.get("magnetic-spherical-pendulum")
    field = example.params["b"]
    force = lambda v: np.cross(v, field) - np.array([0.0, 0.0, 1.0])

    def tension(x, v):
        return -(np.sum(v * v, -1) + np.sum(x * force(v), -1)) / 2

    def newton(t, y):
        x, v = y[:3], y[3:]
        return np.concatenate([v, force(v) + 2 * tension(x, v) * x])

    start, errors = example.initial["x"], []
    for steps in (50, 100, 200):
        sol = example.simulate(METHOD_2, step=2.0 / steps, steps=steps)
        y = solve_ivp(newton, (0, 2), start, method="DOP853", rtol=1e-13, atol=1e-13, dense_output=True).sol
        middle = y((sol.t[1:] + sol.t[:-1]) / 2).T
        known = tension(middle[:, :3], middle[:, 3:])
        errors.append([np.max(np.abs(sol.x - y(sol.t).T)), np.max(np.abs(sol.multipliers[:, 0] - known))])
        assert np.max(np.abs(sol.constraint_residual())) < 5e-15
    assert slopes(errors) == pytest.approx(2.0, abs=0.1)


def test_a_charge_on_a_sphere_over_many_steps():
    """Upright field: the angular momentum with the field's part has no drift, and the constraints stay at roundoff."""
    b = 0.8
    run = {"params": {"b": np.array([0.0, 0.0, b])}, "steps": 50_000, "save_every": 50, "engine": "native"}
    sol = gallery.get("magnetic-spherical-pendulum").simulate(**run)
    x, y, _, u, v, _ = np.asarray(sol.x).T
    momentum = x * v - y * u + b * (x * x + y * y) / 2
    assert sol.ok and np.max(np.abs(sol.constraint_residual())) < 5e-15
    assert np.max(np.abs(momentum - momentum[0])) < 1e-11
    assert np.max(np.abs(sol.energy() - sol.energy()[0])) < 1e-4


ROLLING = dx.DiracSystem(  # x² + y² = 1 and dz = y ds on T*R⁴: the second in the structure, the first beside it
    dx.induced_dirac(lambda q: jnp.stack([0.0 * q[0], 0.0 * q[0], 1.0 + 0.0 * q[0], -q[1]])[None], 4),
    lambda x: x[4:] @ x[4:] / 2,
    holonomic=lambda x: jnp.stack([x[0] ** 2 + x[1] ** 2 - 1.0]),
)
ROLLING_START = np.array([1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.8])


def test_holonomic_constraints_of_a_nonholonomic_structure():
    """θ = t and ṡ = ṡ0/√(1 + sin²θ), by Method 1."""
    errors = []
    for steps in (50, 100, 200):
        sol = dx.simulate(ROLLING, METHOD_1, x=ROLLING_START, step=2.0 / steps, steps=steps)
        sine, rate = np.sin(sol.t), 0.8 / np.sqrt(1 + np.sin(sol.t) ** 2)
        pairs = ((sol.x[:, :2], np.stack([np.cos(sol.t), sine], 1)), (sol.x[:, 6:], np.stack([sine * rate, rate], 1)))
        errors.append([np.max(np.abs(found - known)) for found, known in pairs])
    assert slopes(errors) == pytest.approx(2.0, abs=0.1)


@pytest.mark.soak
def test_the_chain_of_both_kinds_of_constraints():
    chain = dx.constraint_algorithm(ROLLING, near=ROLLING_START)
    assert [level.dimension for level in chain.levels] == [6, 5, 5]
    field = chain.field(jnp.asarray(ROLLING_START))
    np.testing.assert_allclose(field, [0.0, 1.0, 0.0, 0.8, -1.0, 0.0, 0.8, 0.0], atol=1e-12)
    assert chain.multipliers(jnp.asarray(ROLLING_START)) == pytest.approx([-0.5], abs=1e-12)


def test_initial_data_off_the_final_manifold_are_refused_or_projected():
    for x in FLAT_START + 0.1 * np.eye(4)[1:3]:
        with pytest.raises(ValueError, match="off the constraint"):
            dx.simulate(FLAT, METHOD_2, x=x, step=0.1, steps=1)
        sol = dx.simulate(FLAT, METHOD_2, x=x, step=0.1, steps=1, project=True)
        assert np.max(np.abs(sol.constraint_residual())) < 5e-15


def test_what_method_2_refuses():
    """A plane in phase space is symplectic, {q_0, p_0} = 1: the constraint algorithm stops at level 0 there."""
    plane = dx.DiracSystem(dx.induced_dirac(None, 2), lambda x: x @ x / 2, holonomic=lambda x: x[::2] - 0.5 * x[1::2])
    with pytest.raises(ValueError, match=r"brackets .* are up to 1\.25 here: simulate dx\.constraint_algorithm"):
        dx.simulate(plane, METHOD_2, x=[0.5, 1.0, 0.25, 0.5], step=0.1, steps=1)
    sol = dx.simulate(plane, METHOD_1, x=[0.5, 1.0, 0.25, 0.5], step=0.1, steps=20)
    assert np.max(np.abs(sol.x[:, ::2] - 0.5 * sol.x[:, 1::2])) < 1e-14
    chain = dx.constraint_algorithm(plane, near=[0.5, 1.0, 0.25, 0.5])
    np.testing.assert_allclose(
        chain.multipliers(jnp.asarray(chain.point)), sol.multipliers[0], atol=0.1
    )  # at the middle of the step
    assert [level.dimension for level in chain.levels] == [2, 2]
    with pytest.raises(ValueError, match="but CotangentLift was given"):
        dx.simulate(FLAT, dx.DiscreteDirac(dx.cotangent_lift(dx.Theta(0.0)), "resolve"), x=FLAT_START, step=0.1, steps=1)
    edge = dx.DiracSystem(
        dx.induced_dirac(lambda q: jnp.stack([jnp.sin(q[2]), -jnp.cos(q[2]), 0.0 * q[0]])[None], 3),
        lambda x: x[3:] @ x[3:] / 2,
        holonomic=lambda x: x[:1] ** 2 + x[1:2] ** 2 - 1.0,
    )
    with pytest.raises(ValueError, match=r"constraint_algorithm\(system, near=x\)"):
        dx.simulate(edge, METHOD_2, x=[1.0, 0.0, np.pi / 2, 0.0, 1.0, 1.0], step=0.1, steps=1)
    with pytest.raises(ValueError, match=r"holonomic\(x\) must return an array of shape"):
        dx.simulate(
            dx.DiracSystem(PENDULUM.structure, hamiltonian, holonomic=lambda x: x @ x), METHOD_1, x=START, step=0.1, steps=1
        )
