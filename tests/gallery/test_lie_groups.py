"""Tops, vehicles and constrained bodies on Lie groups: orders, integrals, closed forms and multipliers."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dirax as dx
from dirax import gallery
from dirax.gallery import heavy_top, suslov, underwater_vehicle
from lie_groups import hat, integrate, matrices, orders, run

I = np.array([1.0, 2.0, 3.0])
MAPS = ("exp", "cayley")
SO3 = dx.SO3()


# -------------------------------------------------------------------------------------------------------- the heavy top


def heavy(t, y):
    """(μ, Γ, R)˙ of the gallery's top, by hand."""
    w = y[:3] / [1.0, 1.0, 0.5]
    chi = np.array([0.0, 0.0, 1.0])
    torque = np.cross(y[:3], w) + np.cross(y[3:6], chi)
    return np.concatenate([torque, np.cross(y[3:6], w), (y[6:].reshape(3, 3) @ hat(w)).ravel()])


TOP = gallery.get("heavy-top")
ON_SO3 = gallery.get("heavy-top-so3").system
LAGRANGE_TOP = dx.EulerPoincare(SO3, lambda xi, gamma: (xi[0] ** 2 + xi[1] ** 2 + 0.5 * xi[2] ** 2) / 2 - gamma[2], advected=3)


@pytest.mark.parametrize("map", MAPS)
@pytest.mark.soak_of("exp")
def test_heavy_top_is_of_second_order_and_keeps_its_integrals(map):
    x0 = TOP.initial["x"]
    end = integrate(heavy, [*x0, *np.eye(3).ravel()], 4.0)
    errors = []
    for steps in (80, 160, 320):
        sol = dx.reconstruct(run(LAGRANGE_TOP, map, 4.0 / steps, steps, x=x0))
        errors.append([np.abs(sol.x[-1, :3] - end[:3]).max(), np.abs(sol.x[-1, 3:] - end[3:6]).max()])
        errors[-1].append(np.abs(matrices(SO3, sol.q[-1]) - end[6:].reshape(3, 3)).max())
    assert orders(np.array(errors).T) == pytest.approx(np.full((3, 2), 2.0), abs=0.06)
    mu, gamma = sol.x[:, :3], sol.x[:, 3:]
    integrals = [np.sum(gamma**2, axis=1), np.sum(mu * gamma, axis=1), mu[:, 2], sol.spatial_momentum @ x0[3:]]
    assert np.ptp(integrals, axis=1).max() < 1e-13
    assert np.abs(np.einsum("tij,tj->ti", matrices(SO3, sol.q), gamma) - x0[3:]).max() < 1e-13


@pytest.mark.soak
def test_hamiltonian_and_lagrangian_top_are_one():
    x0 = TOP.initial["x"]
    by_hamiltonian = run(ON_SO3, "cayley", 0.05, 300, x=x0, params=TOP.params)
    by_lagrangian = run(LAGRANGE_TOP, "cayley", 0.05, 300, x=x0)
    assert np.abs(by_hamiltonian.x - by_lagrangian.x).max() < 1e-12
    assert np.abs(by_hamiltonian.energy() - by_lagrangian.energy()).max() < 1e-12
    point = jnp.asarray(x0)
    legendre = jax.jit(LAGRANGE_TOP.lie_poisson().value)(point[:3], point[3:])
    assert legendre == pytest.approx(float(by_lagrangian.energy()[0]), abs=1e-14)
    space = ON_SO3.space
    assert np.array_equal(jax.jit(space.bivector)(point), heavy_top.bivector(point))
    velocity = jax.jit(space.field)(point, point[:3] / jnp.array([1.0, 1.0, 0.5]), jnp.array([0.0, 0.0, -1.0]))
    assert velocity == pytest.approx(heavy(0.0, np.append(x0, np.eye(3)))[:6], abs=1e-15)
    relation = ON_SO3.dirac_system().relation(point, velocity, jnp.zeros(0), 0.0, TOP.params)
    assert np.abs(relation).max() < 1e-15


# --------------------------------------------------------------------------------------------------------------- SE(3)


@pytest.mark.soak
def test_vehicle_is_of_second_order_and_keeps_its_casimirs():
    example = gallery.get("underwater-vehicle")

    def field(t, y):
        P, L, gamma, xi = y[:3], y[3:6], y[6:9], y[:6] / underwater_vehicle.INERTIA
        V, W, R = xi[:3], xi[3:], y[12:].reshape(3, 3)
        torque = np.cross(L, W) + np.cross(P, V) - 0.5 * np.cross(gamma, [0, 0, 1.0])
        return np.concatenate([np.cross(P, W), torque, np.cross(gamma, W), R @ V, (R @ hat(W)).ravel()])

    x0 = example.initial["x"]
    end = integrate(field, [*x0, *np.zeros(3), *np.eye(3).ravel()], 3.0)
    motion = np.block([[end[12:].reshape(3, 3), end[9:12, None]], [np.zeros((1, 3)), np.ones((1, 1))]])
    errors = []
    for steps in (60, 120, 240):
        sol = dx.reconstruct(example.simulate(step=3.0 / steps, steps=steps))
        errors.append([np.abs(sol.x[-1] - end[:9]).max(), np.abs(matrices(dx.SE3(), sol.q[-1]) - motion).max()])
    assert orders(np.array(errors).T) == pytest.approx(np.full((2, 2), 2.0), abs=0.06)
    P, gamma, spatial = sol.x[:, :3], sol.x[:, 6:], sol.spatial_momentum
    about_gravity = spatial[:, 3:] @ x0[6:]
    kept = [np.sum(P**2, axis=1), np.sum(P * gamma, axis=1), np.sum(gamma**2, axis=1), about_gravity, *spatial[:, :3].T]
    assert np.ptp(kept, axis=1).max() < 2e-13


@pytest.mark.soak
def test_a_representation_of_ones_own():
    """A ball on a spring: the body sees the spring's end, a point that rigid motions move, at a = g⁻¹·(r, 1)."""
    ball = dx.EulerPoincare(
        dx.SE3(), lambda xi, a: xi @ xi / 2 - 2.0 * a[:3] @ a[:3], advected=4, representation=lambda matrix, a: matrix @ a
    )
    v, end, errors = np.array([0.0, 0.5, 0.0]), np.array([-1.0, 0.0, 0.2]), []
    for steps in (50, 100, 200):
        sol = dx.reconstruct(run(ball, "cayley", 2.0 / steps, steps, x=ball.state([*v, 0.7, -0.4, 0.9], [*end, 1.0])))
        errors.append(np.abs(sol.q[-1, 4:] - end - (v / 2 * np.sin(4.0) - end * np.cos(4.0))).max())
    assert orders(errors) == pytest.approx([2, 2], abs=0.06)


# --------------------------------------------------------------------------------------------------------- constraints


@pytest.mark.parametrize(("name", "map"), [("suslov", "exp"), ("chaplygin-sleigh-se2", "cayley")])
@pytest.mark.soak_of("suslov-exp")
def test_constrained_motions_are_their_closed_forms(name, map):
    example, errors = gallery.get(name), []
    for steps in (100, 200, 400):
        sol = example.simulate(dx.DiscreteEulerPoincare(map), step=10.0 / steps, steps=steps)
        errors.append(np.abs(sol.x - example.exact(sol.t, example.initial["x"])).max())
    assert orders(errors) == pytest.approx([2, 2], abs=0.06)
    assert np.abs(sol.constraint).max() < 1e-15
    nodes = sol.map_rows(lambda row, params: example.system.constraint_at(row, params))
    assert np.abs(nodes).max() < 1e-14
    assert np.ptp(sol.energy()) < 1e-4


def test_suslov_multipliers_are_the_torque_that_the_constraint_needs():
    """λ = d/dt μ_3 − (μ × ω)_3 of the closed form, the derivative by a fourth-order difference."""
    example, worst = gallery.get("suslov"), []
    matrix = np.asarray(suslov.inertia(example.params))
    for steps in (100, 200, 400):
        sol = example.simulate(step=5.0 / steps, steps=steps)
        node, e = sol.t[1:-1], 1e-3
        mu = lambda t: suslov.exact(t, example.initial["x"])
        rate = (8 * (mu(node + e) - mu(node - e)) - mu(node + 2 * e) + mu(node - 2 * e))[:, 2] / (12 * e)
        omega = np.linalg.solve(matrix, mu(node).T).T
        force = rate - np.cross(mu(node), omega)[:, 2]
        worst.append(np.abs(sol.multipliers[1:, 0] / sol.step - force).max())
    assert orders(worst) == pytest.approx([2, 2], abs=0.1)


def test_suslov_with_a_principal_axis_is_steady():
    sol = gallery.get("suslov").simulate(params={"I13": 0.0, "I23": 0.0}, x=[0.7, -0.4, 0.0], steps=200)
    assert np.abs(sol.x - sol.x[0]).max() < 1e-14 and np.abs(suslov.exact([3.0], sol.x[0], sol.params) - sol.x[0]).max() < 1e-15


def test_sleigh_on_se2_is_the_sleigh_in_the_plane():
    plane, group, errors = gallery.get("chaplygin-sleigh"), gallery.get("chaplygin-sleigh-se2"), []
    for steps in (100, 200, 400):
        whole = plane.simulate(step=4.0 / steps, steps=steps)
        sol = dx.reconstruct(group.simulate(step=4.0 / steps, steps=steps))
        exact = plane.exact(sol.t, **plane.initial)
        lifted = np.column_stack([sol.q[:, 2:], np.unwrap(np.arctan2(sol.q[:, 1], sol.q[:, 0]))])
        errors.append([np.abs(lifted - exact).max(), np.abs(lifted - whole.q).max()])
    assert orders(np.array(errors).T) == pytest.approx(np.full((2, 2), 2.0), abs=0.1)


@pytest.mark.soak
def test_constraint_that_the_body_sees_turning():
    """Veselova's problem: ω·γ = 0 for a direction fixed in space; λ by differentiating the constraint by hand."""
    system = dx.EulerPoincare(SO3, lambda xi, a: xi @ (jnp.asarray(I) * xi) / 2, lambda a: a[None], advected=3)

    def field(t, y):
        w, gamma = y[:3] / I, y[3:]
        torque = np.cross(y[:3], w)
        return np.concatenate([torque - gamma * (gamma @ (torque / I)) / (gamma @ (gamma / I)), np.cross(gamma, w)])

    gamma = np.array([0.6, 0.0, 0.8])
    x0 = system.state(np.array([0.8, 0.5, -0.6]), gamma)
    exact, errors = integrate(field, x0, 3.0), []
    for steps in (60, 120, 240):
        sol = run(system, "exp", 3.0 / steps, steps, x=x0)
        errors.append(np.abs(sol.x[-1] - exact).max())
    assert orders(errors) == pytest.approx([2, 2], abs=0.06)
    assert np.abs(sol.constraint).max() < 1e-14


@pytest.mark.soak
@pytest.mark.parametrize("name", ["free-top", "underwater-vehicle"])
@pytest.mark.parametrize("map", MAPS)
def test_casimirs_and_momenta_over_a_million_steps(name, map):
    example = gallery.get(name)
    sol = dx.reconstruct(example.simulate(dx.DiscreteEulerPoincare(map), steps=1_000_000, save_every=1000))
    assert sol.ok
    if name == "free-top":
        kept = [np.linalg.norm(sol.x, axis=1), *sol.spatial_momentum.T]
    else:
        P, gamma = sol.x[:, :3], sol.x[:, 6:]
        kept = [np.sum(P**2, axis=1), np.sum(P * gamma, axis=1), np.sum(gamma**2, axis=1), *sol.spatial_momentum[:, :3].T]
    scale = np.abs(kept).max()
    assert np.ptp(kept, axis=1).max() < 2e-12 * scale
    assert np.abs(np.linalg.norm(sol.q[:, :4], axis=1) - 1).max() < 1e-15
