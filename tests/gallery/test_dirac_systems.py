"""Gallery systems stated by a Dirac structure: Casimirs, integrals and orders, against scipy and closed forms."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import dirax as dx
from dirax import gallery


def right_hand_side(name):
    """The equations of motion as printed in textbooks, by hand."""
    cross = np.cross
    if name == "rigid-body":
        return lambda t, x: cross(x, x / [1.0, 2.0, 3.0])
    if name == "heavy-top":
        inertia, axis = np.array([1.0, 1.0, 0.5]), np.array([0.0, 0.0, 1.0])
        return lambda t, x: np.concatenate([cross(x[:3], x[:3] / inertia) + cross(x[3:], axis), cross(x[3:], x[:3] / inertia)])
    if name == "kirchhoff":
        inertia, mass = np.array([1.0, 1.5, 2.0]), np.array([1.0, 2.0, 2.5])
        return lambda t, x: np.concatenate(
            [cross(x[:3], x[:3] / inertia) + cross(x[3:], x[3:] / mass), cross(x[3:], x[:3] / inertia)]
        )
    return lambda t, x: np.array([x[1], -np.sin(x[0])])


@pytest.mark.parametrize("name", ["rigid-body", "heavy-top", "kirchhoff", "pendulum"])
@pytest.mark.soak_of("heavy-top")
def test_second_order(name):
    example = gallery.get(name)
    start = example.initial["x"]
    solved = solve_ivp(right_hand_side(name), (0, 4), start, method="DOP853", rtol=1e-12, atol=1e-12, dense_output=True)
    exact = lambda t: solved.sol(t).T
    found = dx.convergence(
        example.system, example.scheme, step_sizes=[0.1, 0.05, 0.025], time=4.0, reference=exact,
        params=example.params, **example.initial,
    )  # fmt: skip
    assert found.order == pytest.approx(2.0, abs=0.05)


def test_quadratic_casimirs_and_integrals_are_kept():
    top = gallery.get("heavy-top").simulate(steps=5000).x
    for invariant in ((top[:, 3:] ** 2).sum(1), (top[:, :3] * top[:, 3:]).sum(1), top[:, 2]):
        assert np.ptp(invariant) < 1e-12
    fish = gallery.get("kirchhoff").simulate(steps=5000)
    for invariant in ((fish.x[:, 3:] ** 2).sum(1), (fish.x[:, :3] * fish.x[:, 3:]).sum(1), fish.energy()):
        assert np.ptp(invariant) < 1e-12


@pytest.mark.parametrize("theta, order", [(0.0, 1), (0.25, 1), (0.5, 2), (0.75, 1), (1.0, 1)])
@pytest.mark.soak_of(but=["0.5-2"])
def test_every_theta_lifts_to_a_symplectic_method(theta, order):
    pendulum = gallery.get("pendulum")
    scheme = dx.DiscreteDirac(map=dx.cotangent_lift(dx.Theta(theta)))
    found = dx.convergence(pendulum.system, scheme, step_sizes=[0.1, 0.05, 0.025, 0.0125], time=2.0, **pendulum.initial)
    assert found.order == pytest.approx(order, abs=0.1)
    sol = pendulum.simulate(scheme, steps=400)
    assert dx.verify(sol)["symplecticity of one step"].value < 1e-12


@pytest.mark.soak
def test_the_rigid_body_by_both_maps_over_a_million_steps_stays_on_the_sphere():
    body = gallery.get("rigid-body")
    for map in (dx.SphereProjection(), dx.RiemannianExp(dx.Sphere(3), 0.5)):
        sol = body.simulate(dx.DiscreteDirac(map=map), steps=1_000_000, save_every=100)
        assert sol.ok
        assert np.abs(np.linalg.norm(sol.x, axis=1) - 1).max() < 1e-14
        energy = sol.energy()
        assert np.ptp(energy[len(energy) // 2 :]) < 1.2 * np.ptp(energy[: len(energy) // 2]) + 1e-12  # bounded
