"""Torus actions on manifolds, in retraction-compatible charts ([RL] §6): the motion in charts of the manifold as oracle."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dirax as dx
from dirax.gallery import charged_particle

SPACE = dx.Product(dx.Euclidean(3), dx.SO2())
PARAMS = {"m": 1.3, "B0": 0.7}


def kaluza_klein(q, v):
    """The charged particle on R³ × S¹, its circle that of unit complex numbers."""
    turn = dx.SO2().to_algebra(q[3:], v[3:])
    return charged_particle.lagrangian(jnp.append(q[:3], 0.0), jnp.append(v[:3], turn), PARAMS)


def angles(y):
    """(x, θ) to (x, cos θ, sin θ): a chart in which the circle acts by addition."""
    return jnp.concatenate([y[:3], jnp.stack([jnp.cos(y[3]), jnp.sin(y[3])])])


@pytest.mark.soak
def test_reduction_in_the_angle_is_the_motion_on_the_circle():
    """The angle goes round several times, so that the charts of the manifold change; the angle of the quotient does not end."""
    system = dx.ManifoldLagrangian(kaluza_klein, SPACE)
    y, w = np.array([0.3, -0.2, 0.1, 2.9]), np.array([1.0, 0.4, 0.5, 3.0])
    q, v = (np.asarray(a) for a in jax.jvp(angles, (y,), (w,)))
    settings = {"step": 0.02, "steps": 500}
    whole = dx.simulate(system, dx.InCharts(dx.RiemannianExp(SPACE, 0.5)), q=q, v=v, **settings)
    in_angles = dx.in_coordinates(system, angles)
    assert dx.cyclic_coordinates(in_angles, y) == (2, 3)
    for twist, scheme in ((None, dx.DiscreteRouth("midpoint")), ([[0.3, -0.2, 0.1]], dx.PlusLagrangeDirac("midpoint"))):
        quotient = dx.simulate(dx.reduce(in_angles, dx.LinearConnection([3], twist)), scheme, q=y, v=w, **settings)
        lifted = dx.reconstruct(quotient)
        assert np.ptp(lifted.q[:, 3]) > 4 * np.pi and np.all(quotient.mu == quotient.mu[0])
        assert np.abs(np.asarray(jax.vmap(angles)(jnp.asarray(lifted.q))) - whole.q).max() < 1e-10


@pytest.mark.soak
def test_two_arms_on_a_torus_with_a_common_turn():
    """On T² in angles the symmetry is oblique: found, made a coordinate by a linear change, reduced, and undone modulo 2π."""
    torus = dx.Torus(2)

    def lagrangian(q, v):
        return v[0] ** 2 / 2 + v[1] ** 2 + 0.7 * jnp.cos(q[0] - q[1]) * v[0] * v[1] + jnp.cos(q[0] - q[1])

    q, v, settings = np.array([3.0, -2.8]), np.array([2.0, 1.1]), {"step": 0.02, "steps": 500}
    whole = dx.simulate(dx.ManifoldLagrangian(lagrangian, torus), dx.InCharts(dx.RiemannianExp(torus, 0.5)), q=q, v=v, **settings)
    system = dx.LagrangeDirac(lagrangian)
    directions = dx.translation_symmetries(system, q)
    assert np.abs(directions) == pytest.approx(np.full((1, 2), np.sqrt(0.5)), abs=1e-12)
    basis = dx.adapted_basis(directions)
    adapted = dx.in_coordinates(system, lambda y: basis @ y)
    routh = dx.simulate(
        dx.reduce(adapted, dx.LinearConnection([1], [[0.4]])), dx.DiscreteRouth("midpoint"),
        q=np.linalg.solve(basis, q), v=np.linalg.solve(basis, v), **settings,
    )  # fmt: skip
    found = dx.reconstruct(routh).q @ basis.T
    assert np.ptp(found[:, 0]) > 2 * np.pi
    assert np.abs(np.angle(np.exp(1j * (found - whole.q)))).max() < 1e-10


def test_torus_action_on_a_product_of_spheres():
    """Turns of each sphere about its own axis, an action of T² given by a function: generators, lifts and momenta."""

    def act(g, q):
        turn = lambda angle, a: jnp.stack(
            [jnp.cos(angle) * a[0] - jnp.sin(angle) * a[1], jnp.sin(angle) * a[0] + jnp.cos(angle) * a[1], a[2]]
        )
        return jnp.concatenate([turn(g[0], q[:3]), turn(g[1], q[3:])])

    torus, rng = dx.GroupAction(act, 2), np.random.default_rng(2)
    q, p, v = rng.normal(size=(3, 6))
    q[:3], q[3:] = q[:3] / np.linalg.norm(q[:3]), q[3:] / np.linalg.norm(q[3:])
    about = lambda a, b: a[0] * b[1] - a[1] * b[0]
    assert np.asarray(torus.momentum_map(q, p)) == pytest.approx([about(q[:3], p[:3]), about(q[3:], p[3:])], abs=1e-14)
    assert np.asarray(torus.generator(jnp.array([0.0, 2.0]), q)) == pytest.approx([0, 0, 0, -2 * q[4], 2 * q[3], 0], abs=1e-14)
    once = torus.tangent_lift(jnp.array([2 * np.pi, -4 * np.pi]), q, v)  # a torus: whole turns do nothing
    assert np.abs(np.concatenate(once) - np.concatenate([q, v])).max() < 1e-14
    kinetic = lambda q, v: v @ v / 2 - q[2] * q[5] + (q[0] ** 2 + q[1] ** 2) * v[5]
    there, rate = torus.tangent_lift(jnp.array([0.7, -1.1]), q, v)
    assert float(kinetic(there, rate)) == pytest.approx(float(kinetic(q, v)), abs=1e-13)
    assert dx.check_invariance(dx.ManifoldLagrangian(kinetic, dx.Product(dx.Sphere(3), dx.Sphere(3))), torus, q=q, v=v)
    tied = dx.check_invariance(dx.LagrangeDirac(lambda q, v: v @ v / 2 + q[0] * q[3] + q[1] * q[4]), torus, q=q, v=v)
    assert not tied and tied.defect > 0.1
