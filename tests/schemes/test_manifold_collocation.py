"""Collocation on manifolds, in the chart at the point that a step leaves: orders, points on the manifold, symplecticity."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import dirax as dx

GRAVITY = jnp.array([0.3, 0.0, -1.0])


def pendulum(q, v):
    return v @ v / 2 + GRAVITY @ q - 0.4 * q[0] * q[2] ** 2


def test_a_pendulum_on_the_sphere():
    system = dx.ManifoldLagrangian(pendulum, dx.Sphere(3))
    q, v = np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.7, 0.4])

    def rates(t, x):
        q, v = x[:3], x[3:]
        slope = np.asarray(GRAVITY) - 0.4 * np.array([q[2] ** 2, 0.0, 2 * q[0] * q[2]])
        return [*v, *(slope - q * (q @ slope + v @ v))]

    exact = solve_ivp(rates, (0.0, 2.0), [*q, *v], method="DOP853", rtol=1e-13, atol=1e-14).y[:, -1]
    for stages, steps in ((2, (20, 40)), (3, (10, 20))):
        errors = []
        for n in steps:
            sol = dx.simulate(system, dx.Collocation(stages), q=q, v=v, step=2.0 / n, steps=n)
            assert sol.ok and sol.stats["engine"] == "native"
            errors.append([np.max(np.abs(sol.q[-1] - exact[:3])), np.max(np.abs(sol.p[-1] - exact[3:]))])
        assert np.all(np.abs(np.log2(np.divide(*errors)) - 2 * stages) < 0.3), errors
    long = dx.simulate(system, dx.Collocation(3), q=q, v=v, step=0.2, steps=2000)
    assert np.max(np.abs(np.linalg.norm(long.q, axis=1) - 1.0)) < 1e-15
    energy = long.energy()
    assert np.max(np.abs(energy - energy[0])) < 1e-6
    (line,) = [line for line in dx.verify(long).lines if line.quantity == "energy"]
    assert line.verdict == "bounded", line


@pytest.mark.soak
def test_a_free_body_on_so3_has_its_order_and_keeps_its_spatial_momentum():
    stages = 2
    group, inertia = dx.SO3(), jnp.array([1.0, 2.0, 3.0])

    def kinetic(q, v):
        xi = group.to_algebra(q, v)
        return xi @ (inertia * xi) / 2

    system = dx.ManifoldLagrangian(kinetic, group)
    q = np.asarray(group.identity())
    v = np.asarray(group.left_translate(jnp.asarray(q), jnp.array([0.6, 0.5, -0.4])))
    run = lambda n: dx.simulate(system, dx.Collocation(stages), q=q, v=v, step=2.0 / n, steps=n)
    body = dx.EulerPoincare(group, lambda xi: xi @ (inertia * xi) / 2).lie_poisson()
    exact = dx.simulate(body, dx.Collocation(8), x=np.array([0.6, 1.0, -1.2]), step=0.1, steps=20).x[-1]
    errors = []
    for n in (8, 16):
        sol = run(n)
        errors.append(np.max(np.abs(group.body_momentum(sol.q[-1], sol.p[-1]) - exact)))
    assert abs(np.log2(errors[0] / errors[1]) - 2 * stages) < 0.4, errors
    assert max(float(group.defect(q)) for q in sol.q) < 2e-14
    spatial = [group.matrix(q) @ group.body_momentum(q, p) for q, p in zip(sol.q, sol.p, strict=True)]
    np.testing.assert_allclose(spatial, np.broadcast_to(spatial[0], (17, 3)), atol=1e-13)


@pytest.mark.soak
def test_both_engines_agree_on_the_sphere():
    system = dx.ManifoldLagrangian(pendulum, dx.Sphere(3))
    native, arrays = (
        dx.simulate(system, dx.Collocation(2), q=[1.0, 0.0, 0.0], v=[0.0, 0.7, 0.4], step=0.1, steps=10, engine=engine)
        for engine in ("native", "xla")
    )
    np.testing.assert_allclose(native.q, arrays.q, atol=1e-13)
    np.testing.assert_allclose(native.p, arrays.p, atol=1e-13)


def test_what_is_not_taken_on_a_manifold_is_refused():
    driven = dx.ManifoldLagrangian(pendulum, dx.Sphere(3), forces=lambda t, q, v: -v)
    with pytest.raises(TypeError, match="forces are not taken there"):
        dx.simulate(driven, dx.Collocation(2), q=[1.0, 0.0, 0.0], v=[0.0, 1.0, 0.0], step=0.1, steps=1)
