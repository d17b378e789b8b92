"""Reduction by an abelian symmetry: the unreduced system as oracle, the paper's numbers, and what the connection must satisfy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dirax as dx
from dirax import gallery
from dirax.gallery import charged_particle

TWISTED = [[0.3, -0.2, 0.1]]
PENDULUM = gallery.get("double-spherical-pendulum")


def in_angles(q, v, params):
    """The double spherical pendulum of [RL] §7 from the positions of its masses; θ1 = ϑ1 − ϑ2, θ2 = ϑ1 + ϑ2."""

    def places(q):
        link = lambda theta, phi: jnp.array([jnp.sin(phi) * jnp.cos(theta), jnp.sin(phi) * jnp.sin(theta), jnp.cos(phi)])
        first = params["l1"] * link(q[0] - q[2], q[1])
        return first, first + params["l2"] * link(q[0] + q[2], q[3])

    (r1, r2), (v1, v2) = jax.jvp(places, (q,), (v,))
    kinetic = params["m1"] * v1 @ v1 / 2 + params["m2"] * v2 @ v2 / 2
    return kinetic - params["g"] * (params["m1"] * r1[2] + params["m2"] * r2[2])


@pytest.mark.soak
def test_pendulum_of_the_paper():
    """Its end state, from a Lagrangian written in another way; the same energy from the reduced and the unreduced equations."""
    run = {**PENDULUM.initial, "params": PENDULUM.params, "step": 0.01, "steps": 10_000, "engine": "native"}
    unreduced = dx.simulate(dx.LagrangeDirac(in_angles), dx.PlusLagrangeDirac("midpoint"), **run)
    quotient = dx.simulate(dx.reduce(PENDULUM.system, dx.LinearConnection([0])), dx.PlusLagrangeDirac("midpoint"), **run)
    for sol in (unreduced, dx.reconstruct(quotient)):
        a, f1, b, f2 = sol.q[-1]
        assert [a - b, f1, a + b, f2] == pytest.approx([-15.6278509, 3.03575496, 0.80410817, 2.51133911], abs=1e-7)
    scale = abs(unreduced.energy()[0])
    assert np.abs(quotient.energy() - unreduced.energy()).max() < 1e-10 * scale
    assert np.all(quotient.mu == quotient.mu[0]) and np.ptp(unreduced.p[:, 0]) < 1e-8 * np.abs(unreduced.p).max()


def test_charged_particle_table_1_of_the_paper():
    system = dx.reduce(dx.LagrangeDirac(charged_particle.lagrangian), dx.LinearConnection([3]))
    exact = np.array([np.sin(20.0), np.cos(20.0) - 1, 20.0])
    for steps, printed in ((10, "1.6781"), (50, ".25971"), (100, ".06626"), (200, ".01664")):
        run = {"q": np.zeros(4), "v": [1.0, 0, 1, 1], "params": charged_particle.PARAMS, "step": 20 / steps, "steps": steps}
        sol = dx.simulate(system, dx.PlusLagrangeDirac(), engine="native", **run)
        error = np.linalg.norm(dx.reconstruct(sol).q[-1, :3] - exact)
        digits = len(printed.split(".")[1])
        assert f"{error:.{digits}f}".lstrip("0") == printed


@pytest.mark.parametrize("horizontal", [None, TWISTED])
@pytest.mark.soak_of("None")
def test_the_connection_satisfies_its_axioms(horizontal):
    rng = np.random.default_rng(1)
    connection = dx.LinearConnection([2], horizontal)
    q0, q1, g = rng.normal(size=4), rng.normal(size=4), np.array([0, 0, 1.3, 0])
    omega = lambda a, b: float(connection.one_form(a, b)[0])
    assert omega(q0, q0) == pytest.approx(0.0, abs=1e-15)
    assert omega(q0 + g, q1) == pytest.approx(omega(q0, q1) - 1.3, abs=1e-14)
    assert omega(q0, q1 + g) == pytest.approx(omega(q0, q1) + 1.3, abs=1e-14)
    x1, _ = connection.split(q1)
    lift = connection.horizontal_lift(q0, x1)
    assert omega(q0, connection.join(x1, lift)) == pytest.approx(0.0, abs=1e-14)
    assert float(lift[0]) == pytest.approx(float((connection.lift_of_point(q0) + connection.lift_of_shape(x1))[0]), abs=1e-14)
    _, w, r = connection.trivialize_covector(q0, q1)
    assert np.asarray(connection.untrivialize_covector(q0[[0, 1, 3]], w, r)) == pytest.approx(q1, abs=1e-14)


def test_mistakes():
    with pytest.raises(ValueError, match="different non-negative"):
        dx.LinearConnection([1, 1])
    with pytest.raises(ValueError, match=r"shape \(k, n − k\)"):
        dx.LinearConnection([1], np.zeros((2, 2)))
    run = {"q": [0.1, 0.2], "v": [0.0, 0.0], "step": 0.1, "steps": 2}
    pulled = dx.LagrangeDirac(lambda q, v: v @ v / 2 - q[1])
    with pytest.raises(ValueError, match=r"not invariant under translation of q\[1\]: ∂L/∂q\[1\] = 1"):
        dx.simulate(dx.reduce(pulled, dx.LinearConnection([1])), dx.PlusLagrangeDirac(), **run)
    # a defect that the initial point itself does not show
    spring = dx.LagrangeDirac(lambda q, v: v @ v / 2 - q[1] ** 2)
    with pytest.raises(ValueError, match=r"∂L/∂q\[1\] = 0\.\d+ at q = \[.*at or near the initial data"):
        dx.simulate(dx.reduce(spring, dx.LinearConnection([1])), dx.PlusLagrangeDirac(), **run | {"q": [0.1, 0.0]})
    with pytest.raises(ValueError, match="does not fit a system of 2"):
        dx.simulate(dx.reduce(pulled, dx.LinearConnection([4])), dx.PlusLagrangeDirac(), **run)
    free = dx.LagrangeDirac(lambda q, v: v @ v / 2)
    for fibre in ([1.5], "z", []):
        with pytest.raises(ValueError, match=r"different non-negative indices of coordinates, such as \[0\], but"):
            dx.LinearConnection(fibre)
    for scheme in (dx.Collocation(2), dx.VariableSteps(dx.LagrangeDAlembert()), dx.DiscreteDirac()):
        with pytest.raises(TypeError, match=r"\. Reduced systems are stepped by dx\.LagrangeDAlembert, .* step the system that"):
            dx.simulate(dx.reduce(free, dx.LinearConnection([1])), scheme, **run)
    pulling = lambda q0, q1, h: (q1 - q0) @ (q1 - q0) / (2 * h) - h * q1[1] ** 2
    for scheme in (dx.PlusLagrangeDirac(pulling), dx.DiscreteRouth(pulling)):
        with pytest.raises(ValueError, match=r"discrete_lagrangian is not invariant .* q\[1\]: its derivative .* is 0\.0"):
            dx.simulate(dx.reduce(free, dx.LinearConnection([1])), scheme, **run)
    tied = dx.LagrangeDirac(lambda q, v: v @ v / 2, lambda q: jnp.array([[1.0, -0.5]]))
    scheme = dx.LagrangeDAlembert(constraint=lambda q0, q1, h: jnp.array([1.0, -0.5]) @ (q1 - q0) / h + q0[1:])
    with pytest.raises(ValueError, match=r"constraint is not invariant under translation of q\[1\]"):
        dx.simulate(dx.reduce(tied, dx.LinearConnection([1])), scheme, **run)
    for other, way in (
        (3, "int was given"),
        (dx.PortHamiltonian(lambda x: x @ x, np.zeros((2, 2))), "PortHamiltonian was given"),
    ):
        with pytest.raises(TypeError, match=r"dx\.reduce takes a dx\.LagrangeDirac .*" + way):
            dx.reduce(other, dx.LinearConnection([0]))
    for symmetry, way in ((dx.Translations([1]), r"dx\.LinearConnection\(fibre=\[1\]\)"), (dx.SO3, "add parentheses")):
        with pytest.raises(TypeError, match="the symmetry must be a connection such as .* was given: " + way):
            dx.reduce(free, symmetry)
    with pytest.raises(TypeError, match=r"dx\.reconstruct takes"):
        dx.reconstruct(dx.simulate(pulled, dx.PlusLagrangeDirac(), **run))


def test_events_are_lifted_with_the_motion():
    """A zero of a shape on the quotient is that of the unreduced motion; on a group, spatial momenta at events are the first."""
    system = dx.LagrangeDirac(lambda q, v: v @ v / 2 - q[0] ** 2 / 2 - q[1] ** 2 + 0.3 * v[2] * q[0])
    run = {"q": [1.0, 0.2, 0.3], "v": [0.0, 0.1, 0.5], "step": 0.01, "steps": 500}
    scheme, reduced = dx.PlusLagrangeDirac("midpoint"), dx.reduce(system, dx.LinearConnection([2]))
    lifted = dx.reconstruct(dx.simulate(reduced, scheme, **run, events=[dx.Event(lambda x: x[0])])).events
    whole = dx.simulate(system, scheme, **run, events=[dx.Event(lambda q: q[0])]).events
    assert len(lifted) == len(whole) == 2
    np.testing.assert_allclose(lifted.t, whole.t, atol=1e-6)
    np.testing.assert_allclose(np.concatenate([lifted.q, lifted.p]), np.concatenate([whole.q, whole.p]), atol=2e-5)
    inertia, start = np.array([1.0, 2.0, 3.0]), np.array([[0.3, 1.0, 0.2], [0.1, -2.0, 0.1]])
    top = dx.EulerPoincare(dx.SO3(), lambda xi: (inertia * xi) @ xi / 2)
    spun = dx.simulate(top, dx.DiscreteEulerPoincare("cayley"), x=start, step=0.05, steps=500, events=[dx.Event(lambda x: x[1])])
    events = dx.reconstruct(spun).events
    assert set(events.lane) == {0, 1}
    np.testing.assert_allclose(events.spatial_momentum, start[events.lane], atol=1e-12)


@pytest.mark.soak
def test_reduction_by_all_coordinates_is_reconstructed_and_verified():
    """The shape space is a point; NumPy could not reshape its rows."""
    free = dx.reduce(dx.LagrangeDirac(lambda q, v: v @ v / 2), dx.LinearConnection([0, 1]))
    for scheme in (dx.LagrangeDAlembert(), dx.PlusLagrangeDirac(), dx.DiscreteRouth()):
        sol = dx.simulate(free, scheme, q=[0.0, 1.0], v=[1.0, 2.0], step=0.1, steps=10)
        assert np.max(np.abs(dx.reconstruct(sol).q - np.array([0.0, 1.0]) - np.outer(sol.t, [1.0, 2.0]))) <= 1e-14
        assert dx.verify(sol).ok
