"""Retraction-compatible charts: Definition 6.2, the pairing, transitions, and curves that change charts through a pole."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate
from hypothesis import given, settings
from hypothesis import strategies as st

from dirax.geometry.charts import Atlas, chart_at, check_chart
from dirax.geometry.lie_groups import SE2, SO3
from dirax.geometry.products import Product
from dirax.geometry.spaces import Circle, Euclidean, Sphere, Torus

BATCH = 4
MANIFOLDS = {
    "Euclidean": Euclidean(3),
    "circle": Circle(),
    "torus": Torus(2),
    "S2": Sphere(3),
    "S2 x S2": Product(Sphere(3), Sphere(3)),
    "SO3": SO3(),
    "SE2": SE2(),
}
examples = settings(max_examples=10, deadline=None)
seeds = st.integers(0, 2**32 - 1)


def random_arrays(seed, *shape):
    return np.random.default_rng(seed).normal(size=shape)


@functools.cache
def chart_laws(name, exponential):
    manifold = MANIFOLDS[name]

    def laws(a, r, s, p):
        m = manifold.nearest(a)
        chart = chart_at(manifold, m, exponential)
        r = 0.8 * r / jnp.maximum(1.0, 2.0 * jnp.max(jnp.abs(r)))  # at most half the domain: both other charts reach it
        x, v = chart.velocity_to_manifold(r, s)
        _, covector = chart.momentum_to_manifold(r, p)
        second = chart_at(manifold, chart.to_manifold(0.5 * r), exponential)
        third = chart_at(manifold, chart.to_manifold(0.3 * s / (1.0 + jnp.max(jnp.abs(s)))), not exponential)
        report = check_chart(chart, r, p)
        to_second = chart.transition_momentum(r, p, second)
        velocity = chart.transition_velocity(r, s, second)
        return {
            "origin": report.origin_defect,
            "retraction": report.retraction_defect,
            "pairing at m": report.pairing_defect,
            "points": jnp.stack([chart.to_local(x) - r, second.transition(to_second[0], chart) - r]),
            "velocities": jnp.stack(chart.velocity_to_local(x, v)) - jnp.stack([r, s]),
            "momenta": jnp.stack(chart.momentum_to_local(x, covector)) - jnp.stack([r, p]),
            "covector tangent": manifold.tangent_defect(x, covector),
            "pairing on the manifold": jnp.dot(covector, v) - jnp.dot(p, s),
            "pairing in another chart": jnp.dot(to_second[1], velocity[1]) - jnp.dot(p, s),
            "momentum through the manifold": jnp.stack(second.momentum_to_local(x, covector)) - jnp.stack(to_second),
            "functorial": jnp.stack(second.transition_momentum(*to_second, third))
            - jnp.stack(chart.transition_momentum(r, p, third)),
            "functorial on velocities": jnp.stack(second.transition_velocity(*velocity, third))
            - jnp.stack(chart.transition_velocity(r, s, third)),
        }

    return jax.jit(laws)


@pytest.mark.parametrize(
    ("name", "exponential"),
    [
        pytest.param(name, e, id=f"{name}-{way}", marks=[pytest.mark.soak] if e and name == "S2 x S2" else [])
        for name in MANIFOLDS
        for e, way in ((False, "retraction"), (True, "exponential"))
        if not (e and name in ("Euclidean", "circle", "SO3", "SE2"))  # there the retraction is the exponential
    ],
)
@examples
@given(seed=seeds)
@pytest.mark.soak_of(but=["torus-exponential"])
def test_laws(name, exponential, seed):
    manifold = MANIFOLDS[name]
    a = random_arrays(seed, BATCH, manifold.ambient_dimension)
    r, s, p = random_arrays(seed + 1, 3, BATCH, manifold.dimension)
    for at in zip(a, r, s, p, strict=True):
        for law, defect in chart_laws(name, exponential)(*at).items():
            assert np.max(np.abs(defect)) < 1e-13, law


def test_chart_at_a_pole_is_the_central_projection():
    chart = chart_at(Sphere(3), jnp.array([0.0, 0.0, -1.0]))
    r = chart.to_local(jnp.array([0.48, -0.36, -0.8]))
    np.testing.assert_allclose(chart.frame @ r, [0.6, -0.45, 0.0], atol=1e-15)
    assert float(chart.reach(r)) == pytest.approx(2.0 / np.pi * np.arctan(0.75))


def test_canonical_coordinates_of_the_first_kind():
    group = SO3()
    g = group.group_exp(jnp.array([0.4, 0.1, -0.3]))
    chart = chart_at(group, g)
    omega = jnp.array([0.2, -0.5, 0.7])
    np.testing.assert_allclose(chart.to_manifold(omega), group.multiply(g, group.group_exp(omega)), atol=1e-15)
    np.testing.assert_allclose(chart.to_local(-chart.to_manifold(omega)), omega, atol=1e-15)  # either quaternion


def test_angles_in_a_chart_are_the_nearest_ones():
    chart = chart_at(Torus(2), jnp.array([3.0, 0.0]))
    np.testing.assert_allclose(chart.to_local(jnp.array([-3.0, 12.0])), [2 * np.pi - 6.0, 12.0 - 4 * np.pi], atol=1e-14)


@pytest.mark.parametrize("name", ["S2", "S2 x S2", "SO3"])
def test_leaving(name):
    manifold = MANIFOLDS[name]
    chart = chart_at(manifold, manifold.nearest(random_arrays(1, manifold.ambient_dimension)))
    r = jnp.zeros(manifold.dimension)
    assert not bool(chart.leaving(r))
    assert not bool(chart.leaving(r.at[-1].set(0.9)))
    assert bool(chart.leaving(r.at[-1].set(1.7)))
    assert bool(chart.leaving(r.at[-1].set(jnp.nan)))


def discrete_lagrangian(q0, q1, h):
    """The spherical pendulum L = |q̇|²/2 − z of S², on the manifold: chord for speed, trapezoidal rule."""
    return (q1 - q0) @ (q1 - q0) / (2.0 * h) - h * (q0[2] + q1[2]) / 2.0


def pendulum_in(atlas, q, p, h, steps):
    """−∂L_d/∂r0 = p0, p1 = ∂L_d/∂r1 in the current chart by Newton's method; (q, p) in R³ and chart changes, each step."""

    def step(carry, _):
        chart, r0, p0 = carry
        action = lambda r0, r1: discrete_lagrangian(chart.to_manifold(r0), chart.to_manifold(r1), h)
        equation = lambda r1: jax.grad(action)(r0, r1) + p0
        improve = lambda r1, _: (r1 - jnp.linalg.solve(jax.jacfwd(equation)(r1), equation(r1)), None)
        r1 = jax.lax.scan(improve, r0, None, 7)[0]
        p1 = jax.grad(action, 1)(r0, r1)
        followed = atlas.follow(chart, r1, p1)
        return followed, (chart.momentum_to_manifold(r1, p1), jnp.any(followed[0].base != chart.base))

    chart = atlas.chart_at(q)
    return jax.lax.scan(step, (chart, *chart.momentum_to_local(q, p)), None, steps)[1]


def test_a_curve_through_both_poles_does_not_see_its_charts():
    # A pendulum that turns over in a vertical plane passes both poles, where angle coordinates fail. The discrete
    # Euler–Lagrange equations are the same in every chart, so three atlases give one curve to roundoff.
    speed, h, steps = 3.0, 1e-2, 400
    q, p = jnp.array([0.0, 0.6, -0.8]), speed * jnp.array([0.0, 0.8, 0.6])
    centres = jnp.concatenate([jnp.eye(3), -jnp.eye(3)])
    atlases = [Atlas(Sphere(3)), Atlas(Sphere(3), True, leave_at=0.3), Atlas(Sphere(3), centres=centres, leave_at=0.7)]
    runs = []
    for atlas in atlases:
        run = jax.jit(lambda q, p, atlas=atlas: pendulum_in(atlas, q, p, h, steps))
        (points, covectors), changed = jax.tree.map(np.asarray, run(q, p))
        assert np.sum(changed) >= 6
        assert np.max(points[:, 2]) > 1.0 - 1e-3  # over both poles
        assert np.min(points[:, 2]) < -1.0 + 1e-3
        assert np.max(np.abs(np.linalg.norm(points, axis=1) - 1.0)) < 1e-15
        runs.append(np.hstack([points, covectors]))
    np.testing.assert_allclose(runs[1], runs[0], atol=1e-11)
    np.testing.assert_allclose(runs[2], runs[0], atol=1e-11)

    # the planar pendulum by another program: z = −cos a, with a the angle from the bottom
    points, covectors = runs[0][:, :3], runs[0][:, 3:]
    field = lambda t, y: [y[1], -np.sin(y[0])]
    exact = scipy.integrate.solve_ivp(field, (0.0, h * steps), [np.arcsin(0.6), speed], rtol=1e-11, atol=1e-11).y[:, -1]
    np.testing.assert_allclose(points[-1], [0.0, np.sin(exact[0]), -np.cos(exact[0])], atol=20 * h**2)
    energy = np.sum(covectors**2, axis=1) / 2 + points[:, 2] - (speed**2 / 2 - 0.8)
    assert np.max(np.abs(energy)) < 10 * h**2


def test_free_motion_is_exact_across_chart_changes():
    # In canonical coordinates at g a one-parameter subgroup is a straight line; followed through many charts it is exact.
    group = SO3()
    atlas = Atlas(group, leave_at=0.2)
    omega = np.array([0.6, -0.3, 0.5])
    momentum = omega / 1.0

    def step(carry, _):
        chart, r, p = carry
        followed = atlas.follow(chart, r + 0.05 * omega, p)
        return followed, followed[0].base

    start = atlas.chart_at(group.identity())
    scan = jax.jit(lambda: jax.lax.scan(step, (start, jnp.zeros(3), jnp.asarray(momentum)), None, 200))
    (chart, r, p), bases = scan()
    assert len(np.unique(np.asarray(bases), axis=0)) > 5
    exact = group.group_exp(jnp.asarray(10.0 * omega))
    assert float(group.distance(chart.to_manifold(r), exact)) < 1e-13
    # the covector along the subgroup through r keeps ⟨p, ω⟩
    assert float(p @ omega) == pytest.approx(float(momentum @ omega), abs=1e-13)


def test_errors():
    sphere = Sphere(3)
    with pytest.raises(ValueError, match=r"m is not on Sphere.*0\.1"):
        chart_at(sphere, jnp.array([1.1, 0.0, 0.0]))
    with pytest.raises(ValueError, match=r"frame must have shape \(3, 2\).*\(3, 3\)"):
        chart_at(sphere, jnp.array([1.0, 0.0, 0.0]), frame=jnp.eye(3))
    with pytest.raises(ValueError, match=r"x must have shape \(3,\)"):
        Atlas(sphere).chart_at(jnp.zeros(2))
