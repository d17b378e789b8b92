"""A momentum that several velocities have: what is derived from rows belongs to the velocity of the motion."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import dirax as dx


def lagrangian(q, v):
    """p = v³ − v, which up to three velocities have."""
    return v[0] ** 4 / 4 - v[0] ** 2 / 2 - q[0] ** 2 / 2


ENERGY = 0.75 * 1.5**4 - 0.5 * 1.5**2
START = {"q": [0.0], "v": [1.5]}


@pytest.fixture(scope="module")
def motion():
    flow = lambda t, y: [y[1], -y[0] / (3.0 * y[1] ** 2 - 1.0)]
    return solve_ivp(flow, (0.0, 0.6), [0.0, 1.5], rtol=1e-12, atol=1e-12, dense_output=True).sol


@pytest.mark.parametrize(
    ("scheme", "of_energy", "of_q"),
    [
        (dx.LagrangeDAlembert(), 1e-7, 1e-5),
        (dx.Collocation(2), 1e-11, 1e-8),
        (dx.Composition(dx.LagrangeDAlembert(), "kahan-li6"), 1e-9, 1e-8),
    ],
)
@pytest.mark.soak_of(but=["scheme0-1e-07-1e-05"])
def test_energies_and_places_between_rows(motion, scheme, of_energy, of_q):
    sol = dx.simulate(dx.LagrangeDirac(lagrangian), scheme, **START, step=0.01, steps=60)
    np.testing.assert_allclose(sol.energy(), ENERGY, atol=of_energy)
    times = np.linspace(0.003, 0.59, 40)
    np.testing.assert_allclose(sol.at(times).q[:, 0], motion(times)[0], atol=of_q)
    assert dx.verify(sol).ok


@pytest.mark.parametrize("scheme", [dx.LagrangeDAlembert(), dx.Composition(dx.LagrangeDAlembert(), "kahan-li6")])
@pytest.mark.parametrize("v", [1.5, -0.9, 0.2])
@pytest.mark.soak_of("1.5-scheme1", "-0.9-scheme1", "0.2-scheme1")
def test_rows_far_from_saved_ones(scheme, v):
    run = lambda every: dx.simulate(dx.LagrangeDirac(lagrangian), scheme, q=[0.0], v=[v], step=0.01, steps=20, save_every=every)
    whole, thin = run(1), run(20)
    found = thin.at(whole.t[[3, 11, 17]])
    for name in ("q", "p"):
        np.testing.assert_allclose(found.fields[name], whole.fields[name][[3, 11, 17]], rtol=0, atol=1e-13)


def test_rows_of_a_batch_are_those_of_one():
    run = lambda q, v: dx.simulate(dx.LagrangeDirac(lagrangian), dx.LagrangeDAlembert(), q=q, v=v, step=0.01, steps=9)
    two, one = run(np.zeros((2, 1)), [[1.5], [1.2]]), run([0.0], [1.2])
    assert np.array_equal(two.energy()[1], one.energy())


@pytest.mark.soak
def test_the_parameters_of_a_morse_family_are_those_of_the_steps():
    structure = dx.induced_dirac(lambda q: jnp.zeros((0, 1)), 1)
    system = dx.GeneralizedDiracSystem(structure, dx.LagrangianSubmanifold.from_lagrangian(lagrangian, 1))
    sol = dx.simulate(system, dx.DiscreteDirac(dx.Midpoint()), **START, step=0.01, steps=60)
    np.testing.assert_allclose(sol.energy(), ENERGY, atol=1e-7)
    assert np.max(np.abs(sol.constraint_residual())) < 1e-13
    assert dx.verify(sol).ok


def test_on_a_manifold():
    of_speed = lambda q, v: (v @ v) ** 2 / 4 - v @ v / 2 - q[2]
    system = dx.ManifoldLagrangian(of_speed, dx.Sphere(3))
    sol = dx.simulate(system, dx.LagrangeDAlembert(), q=[1.0, 0.0, 0.0], v=[0.0, 1.5, 0.0], step=0.01, steps=20)
    np.testing.assert_allclose(sol.energy(), ENERGY, atol=1e-5)


def test_on_a_lie_algebra():
    body = dx.EulerPoincare(dx.SO3(), lambda xi: (xi @ xi) ** 2 / 4 - xi @ (jnp.array([1.0, 2.0, 3.0]) * xi) / 6)
    xi = np.array([0.9, 0.8, 1.1])
    sol = dx.simulate(body, dx.DiscreteEulerPoincare(), x=body.state(xi), step=0.01, steps=50)
    np.testing.assert_allclose(sol.energy(), 0.75 * (xi @ xi) ** 2 - xi @ ([1.0, 2.0, 3.0] * xi) / 6, atol=1e-6)


def test_on_a_quotient():
    of_speed = lambda q, v: (v @ v) ** 2 / 4 - v @ v / 2 - q[0] ** 2 / 2
    system, data = dx.LagrangeDirac(of_speed), {"q": [0.0, 0.3], "v": [1.2, 0.9], "step": 0.01, "steps": 60}
    bent = dx.LinearConnection(fibre=[1], horizontal=[[0.3]])
    sol = dx.simulate(dx.reduce(system, bent), dx.LagrangeDAlembert(), **data)
    np.testing.assert_allclose(sol.energy(), ENERGY, atol=1e-6)
    np.testing.assert_allclose(dx.reconstruct(sol).energy(), sol.energy(), atol=1e-13)


@pytest.mark.parametrize("every", [1, 7])
@pytest.mark.soak_of("1")
def test_beside_a_wall_that_turns_the_velocity(every):
    wall = dx.Impact(lambda q: 0.5 - q[0])
    data = {**START, "step": 0.01, "steps": 70, "save_every": every, "events": wall}
    sol = dx.simulate(dx.LagrangeDirac(lagrangian), dx.LagrangeDAlembert(), **data)
    assert len(sol.impacts) == 1
    np.testing.assert_allclose(sol.energy(), ENERGY, atol=1e-6)
