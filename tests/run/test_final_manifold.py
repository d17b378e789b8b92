"""Singular Lagrangians: data off the final manifold are refused or projected, and compositions of steps that leave it too."""

import jax.numpy as jnp
import numpy as np
import pytest

import dirax as dx
from dirax import gallery

FLAT = dx.LagrangeDirac(lambda q, v: v[0] ** 2 / 2 - q @ q / 2)  # q1 has no inertia, and is zero
OFF = {"q": [1.0, 0.7], "v": [0.0, 0.0], "step": 0.1, "steps": 50}
SCHEMES = [dx.LagrangeDAlembert(), dx.DiscreteDirac()]


@pytest.mark.parametrize("scheme", SCHEMES, ids=["lagrange-dalembert", "method 1"])
@pytest.mark.soak_of(but=["method 1"])
def test_data_off_the_final_manifold(scheme):
    with pytest.raises(ValueError, match=r"singular at the initial data.*off its final constraint manifold.*0\.7.*project=True"):
        dx.simulate(FLAT, scheme, **OFF)
    sol = dx.simulate(FLAT, scheme, **OFF, project=True)
    assert sol.ok and np.abs(sol.q[:, 1]).max() < 1e-15 and abs(sol.q[0, 0] - 1) < 1e-15
    assert dx.verify(sol)["final manifold"].verdict == "ok"
    on = dx.simulate(FLAT, scheme, **(OFF | {"q": [1.0, 0.0]}))
    np.testing.assert_allclose(on.q, sol.q, atol=1e-14)
    as_they_are = dx.simulate(FLAT, scheme, **OFF, check_initial=False)
    np.testing.assert_allclose(as_they_are.q[:, 1], 0.7 * (-1.0) ** np.arange(51), atol=1e-12)
    line = dx.verify(as_they_are)["final manifold"]
    assert line.verdict == "VIOLATED" and "jumps from one solution of the discrete equations to the other" in line.explanation


def test_the_values_of_all_constraints_are_said():
    """L = −q²/2 + q1 has ∂L/∂q = (−1, 1) there instead of 0: numbers that end in dots do not end the sentence."""
    system = dx.LagrangeDirac(lambda q, v: -q @ q / 2 + q[1])
    with pytest.raises(ValueError, match=r"2 new constraints there have the values \[ *1\. -1\.\]; pass project=True to project"):
        dx.simulate(system, dx.LagrangeDAlembert(), q=[1.0, 0.0], v=[0.0, 1.0], step=0.01, steps=10)


@pytest.mark.soak
def test_each_trajectory_of_a_batch():
    q = np.array([[1.0, 0.0], [1.0, 0.2]])
    run = {"q": q, "v": np.zeros((2, 2)), "step": 0.1, "steps": 3}
    with pytest.raises(ValueError, match=r"of trajectory 1.*final constraint manifold"):
        dx.simulate(FLAT, dx.DiscreteDirac(), **run)
    sol = dx.simulate(FLAT, dx.DiscreteDirac(), **run, project=True)
    np.testing.assert_allclose(sol.q[0], sol.q[1], atol=1e-14)


def test_what_ran_before_decides_nothing():
    """Lengths of 1e-10 after lengths of 1: the manifold that is known from the run before is not measured in its units."""
    for length in (1.0, 2.0**-33):
        with pytest.raises(ValueError, match="off its final constraint manifold"):
            dx.simulate(FLAT, dx.DiscreteDirac(), **(OFF | {"q": np.array([1.0, 0.7]) * length}))


@pytest.mark.soak
def test_each_of_two_points():
    """Two points give no momentum: each is on the manifold if a point of it lies over it."""
    for q0, q1, wrong in (((1.0, 0.7), (1.0, -0.7), "q0="), ((1.0, 0.0), (0.99, 0.1), "q1=")):
        with pytest.raises(ValueError, match=rf"{wrong} is off its final constraint manifold"):
            dx.simulate(FLAT, dx.LagrangeDAlembert(), q0=q0, q1=q1, step=0.1, steps=3)
    sol = dx.simulate(FLAT, dx.LagrangeDAlembert(), q0=[1.0, 0.0], q1=[0.995, 0.0], step=0.1, steps=50)
    assert np.abs(sol.q[:, 1]).max() < 1e-15
    magnetic = dx.LagrangeDirac(lambda q, v: q[1] * v[0] - q @ q / 2)  # q turns at the rate 1: any q is on M_f
    turned = [np.cos(0.1), -np.sin(0.1)]
    assert dx.simulate(magnetic, dx.LagrangeDAlembert(), q0=[1.0, 0.0], q1=turned, step=0.1, steps=5).ok


def test_an_inconsistent_system():
    empty = dx.LagrangeDirac(lambda q, v: v[0] ** 2 / 2 + q[1] ** 3 + q[1])
    with pytest.raises(ValueError, match="no motion passes through"):
        dx.simulate(empty, dx.DiscreteDirac(), q=[1.0, 0.7], v=[0.0, 0.0], step=0.1, steps=3)


def test_a_velocity_that_the_system_determines_is_a_guess():
    """L = v0²/2 − q²/2 with friction on q1 alone: q1 has no inertia and v1 = −q1, whatever was given."""
    system = dx.LagrangeDirac(lambda q, v: v[0] ** 2 / 2 - q @ q / 2, forces=lambda t, q, v: jnp.stack([0.0 * v[0], -v[1]]))
    sol = dx.simulate(system, dx.DiscreteDirac(), q=[1.0, 0.7], v=[0.0, 5.0], step=0.01, steps=100)
    assert np.abs(sol.q[-1] - [np.cos(1.0), 0.7 * np.exp(-1.0)]).max() < 1e-4


@pytest.mark.parametrize("coefficients", ["suzuki4", "kahan-li8"])
@pytest.mark.soak_of("suzuki4")
def test_compositions_of_steps_that_leave_the_final_manifold(coefficients):
    curved = dx.LagrangeDirac(lambda q, v: q[1] * (1 + q[0] ** 2) * v[0] - q @ q / 2)
    lotka = gallery.get("lotka-volterra")
    for system, start in (
        (curved, {"q": [0.5, 1.2], "v": [0.0, 0.0]}),
        (lotka.system, {"q": [0.5, 1.2], "params": lotka.params}),
    ):
        with pytest.raises(ValueError, match=r"leaves that of this \w+, by .*constraints=\"resolve\""):
            dx.simulate(system, dx.Composition(dx.DiscreteDirac(), coefficients), **start, step=0.05, steps=5)
    resolved = dx.Composition(dx.DiscreteDirac(constraints="resolve"), coefficients)
    assert dx.simulate(lotka.system, resolved, q=[0.5, 1.2], params=lotka.params, step=0.05, steps=5).ok


@pytest.mark.soak
def test_a_linear_one_form_keeps_the_order_of_a_composition():
    linear = dx.LagrangeDirac(lambda q, v: q[1] * v[0] - q @ q / 2 - q[0] ** 4 / 4)
    found = dx.convergence(
        linear, dx.Composition(dx.DiscreteDirac(), "suzuki4"), q=[0.5, 1.2], v=[0.0, 0.0], time=1.6, step_sizes=[0.4, 0.2, 0.1]
    )
    assert abs(found.order - 4) < 0.3


@pytest.mark.soak
def test_a_lagrangian_that_is_singular_in_some_trajectories():
    """The first one is regular, and says nothing of the others."""
    system = dx.LagrangeDirac(lambda q, v, params: params["m"] @ (v * v) / 2 - q @ q / 2)
    masses = {"params": {"m": np.array([[1.0, 1.0], [1.0, 0.0]])}, "batch_params": True}
    with pytest.raises(ValueError, match=r"singular at the initial data of trajectory 1"):
        dx.simulate(system, dx.LagrangeDAlembert(), **OFF, **masses)
    assert np.all(dx.simulate(system, dx.LagrangeDAlembert(), **(OFF | {"q": [1.0, 0.0]}), **masses).ok)


def test_the_reason_of_a_singular_first_step():
    held = dx.LagrangeDirac(lambda q, v: v[0] ** 2 / 2 - q @ q / 2, one_forms=lambda q: jnp.array([[1.0, 0.0, 1.0]]))
    with pytest.raises(ValueError, match="a part of a composition ends at the momentum of a velocity"):
        dx.simulate(
            held, dx.Composition(dx.LagrangeDAlembert(), "suzuki4"), q=[1.0, 0.0, 0.0], v=[0.0, 0.0, 0.0], step=0.1, steps=5
        )


def test_a_trajectory_that_leaves_the_manifold():
    """L = (v0 + sin(q0) v1)²/2 − |q|²/2: two-point methods have modes off M_f that grow, from data on it, whatever the step."""
    curved = dx.LagrangeDirac(lambda q, v: (v[0] + jnp.sin(q[0]) * v[1]) ** 2 / 2 - q @ q / 2)
    u, s, c = 0.3, np.sin(1.0), np.cos(1.0)
    q1 = s - c * u**2  # c u² − s q0 + q1 = 0 is the secondary constraint
    v = np.linalg.solve([[1, s], [-s * u * u - c - s, 1 + 2 * c * c * u * u]], [u, 2 * c * u])
    with pytest.warns(RuntimeWarning, match=r"leaves the final manifold .*constraint_algorithm"):
        sol = dx.simulate(curved, dx.PlusLagrangeDirac(), q=[1.0, q1], v=v, step=0.01, steps=100)
    assert np.abs(sol.q).max() > 10  # of a motion that stays below 1.1
    line = dx.verify(sol)["final manifold"]
    assert line.verdict == "VIOLATED" and "leaves the final manifold" in line.explanation


@pytest.mark.parametrize("scheme", [dx.Collocation(2), dx.Collocation(3, nodes="lobatto"), dx.EnergyCollocation(2)])
@pytest.mark.soak_of(but=["scheme1"])
def test_collocation_of_a_singular_lagrangian_names_its_premise(scheme):
    coupled = dx.LagrangeDirac(lambda q, v: v[0] ** 2 / 2 - (q[0] ** 2 + q[0] * q[1] + 2 * q[1] ** 2) / 2)
    start = {"q": [1.0, -0.25], "v": [0.0, 0.0]}
    with pytest.raises(ValueError, match=r"collocation takes regular Lagrangians, and ∂²L/∂v² is singular .*\.resolved\(\)"):
        dx.simulate(coupled, scheme, **start, step=0.1, steps=6)


@pytest.mark.parametrize("scheme", [dx.PlusLagrangeDirac(), dx.LagrangeDAlembert(), dx.DiscreteDirac()])
def test_lagrangians_that_determine_no_parametrization_are_refused(scheme):
    """The metric of Jacobi of the Kepler problem: of degree one in v, so that ∂²L/∂v² v = 0. Errors of the discretization alone
    make its steps regular, and points jumped by a hundred times h|v| with ok=True."""
    jacobi = dx.LagrangeDirac(lambda q, v: jnp.sqrt(2.0 * (1.0 / jnp.sqrt(q @ q) - 0.5)) * jnp.sqrt(v @ v))
    with pytest.raises(ValueError, match=r"they do not determine a motion: .*1 direction of ẋ undetermined"):
        dx.simulate(jacobi, scheme, q=[0.8, 0.2], v=[0.3, 0.9], step=0.01, steps=40)
    in_time = dx.LagrangeDirac(lambda t, q, v: -jnp.sqrt(1.0 - v @ v) - q @ q / 2)  # nonlinear in v, and regular
    assert dx.simulate(in_time, scheme, q=[0.8, 0.2], v=[0.3, 0.9], step=0.01, steps=4).ok
