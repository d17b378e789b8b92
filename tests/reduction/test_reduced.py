"""Reduction by an abelian symmetry: the unreduced system as oracle, the paper's numbers, and what the connection must satisfy."""

import jax.numpy as jnp
import numpy as np
import pytest

import dirax as dx

MASS, LENGTH, GRAVITY = (20.0, 35.0), (500.0, 800.0), 9.8


def double_spherical_pendulum(q, v):
    """Lagrangian of the double spherical pendulum in (ϑ1, φ1, ϑ2, φ2), θ1 = ϑ1 − ϑ2, θ2 = ϑ1 + ϑ2 ([RL] §7)."""
    angles = ((q[0] - q[2], q[1], v[0] - v[2], v[1]), (q[0] + q[2], q[3], v[0] + v[2], v[3]))
    velocity, height, total = jnp.zeros(3), 0.0, 0.0
    for mass, length, (theta, phi, dtheta, dphi) in zip(MASS, LENGTH, angles, strict=True):
        along = jnp.array([jnp.cos(theta) * jnp.cos(phi), jnp.sin(theta) * jnp.cos(phi), -jnp.sin(phi)])
        around = jnp.array([-jnp.sin(theta), jnp.cos(theta), 0.0]) * jnp.sin(phi)
        velocity = velocity + length * (along * dphi + around * dtheta)
        height = height + length * jnp.cos(phi)
        total = total + mass * (velocity @ velocity / 2 - GRAVITY * height)
    return total


START = {"q": np.array([0, 9 / 4, 2, 3]), "p": np.array([0.0, 0, 1, 1])}
pendulum = dx.LagrangeDirac(double_spherical_pendulum)
TWISTED = [[0.3, -0.2, 0.1]]


@pytest.fixture(scope="module")
def unreduced():
    return dx.simulate(pendulum, dx.PlusLagrangeDirac("midpoint"), **START, step=0.01, steps=10_000)


def test_unreduced_end_state_of_the_paper(unreduced):
    a, f1, b, f2 = unreduced.q[-1]
    assert [a - b, f1, a + b, f2] == pytest.approx([-15.6278509, 3.03575496, 0.80410817, 2.51133911], abs=1e-7)


@pytest.mark.parametrize("horizontal", [None, TWISTED], ids=["zero connection", "twisted connection"])
@pytest.mark.parametrize("scheme", [dx.PlusLagrangeDirac, dx.MinusLagrangeDirac])
def test_reduced_pendulum_is_the_unreduced_one(unreduced, scheme, horizontal):
    reduced = dx.reduce(pendulum, dx.LinearConnection([0], horizontal))
    quotient = dx.simulate(reduced, scheme("midpoint"), **START, step=0.01, steps=500)
    lifted = dx.reconstruct(quotient)
    assert np.abs(lifted.q - unreduced.q[:501]).max() < 1e-10
    assert np.abs(lifted.p - unreduced.p[:501]).max() < 1e-10 * np.abs(unreduced.p).max()
    assert np.all(quotient.mu == quotient.mu[0])
    assert np.abs(quotient.energy() - unreduced.energy()[:501]).max() < 1e-11 * abs(unreduced.energy()[0])
    assert quotient.equation.unknowns == 4 and quotient.x.shape == (501, 3)


def test_charged_particle_table_1_of_the_paper():
    def lagrangian(q, v):
        potential = jnp.array([-q[1], q[0], 0.0]) / 2
        return v[:3] @ v[:3] / 2 + (potential @ v[:3] + v[3]) ** 2 / 2

    system = dx.reduce(dx.LagrangeDirac(lagrangian), dx.LinearConnection([3]))
    exact = np.array([np.sin(20.0), np.cos(20.0) - 1, 20.0])
    for steps, printed in ((10, "1.6781"), (50, ".25971"), (100, ".06626"), (200, ".01664")):
        sol = dx.simulate(system, dx.PlusLagrangeDirac(), q=np.zeros(4), v=[1.0, 0, 1, 1], step=20 / steps, steps=steps)
        error = np.linalg.norm(dx.reconstruct(sol).q[-1, :3] - exact)
        digits = len(printed.split(".")[1])
        assert f"{error:.{digits}f}".lstrip("0") == printed


@pytest.mark.parametrize("horizontal", [None, TWISTED])
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
    with pytest.raises(ValueError, match="does not fit a system of 2"):
        dx.simulate(dx.reduce(pulled, dx.LinearConnection([4])), dx.PlusLagrangeDirac(), **run)
    with pytest.raises(TypeError, match=r"dx\.reduce takes"):
        dx.reduce(3, dx.LinearConnection([0]))
    with pytest.raises(TypeError, match=r"dx\.reconstruct takes"):
        dx.reconstruct(dx.simulate(pulled, dx.PlusLagrangeDirac(), **run))
