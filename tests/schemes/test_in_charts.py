"""Lagrangians on manifolds in charts that change on the way: through the poles, where angles fail."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dirax as dx
from dirax import gallery

pendulums = gallery.get("spherical-pendulums")
SPACE = pendulums.system.manifold


@pytest.fixture(scope="module")
def through_the_pole():
    return pendulums.simulate(steps=1000)


@pytest.mark.soak
def test_the_motion_passes_the_pole_and_keeps_its_energy_band(through_the_pole):
    sol = through_the_pole
    assert sol.ok
    assert np.any((sol.q[:, 2] < -1 + 1e-3) & (np.abs(sol.q[:, 0]) < 0.05))  # near a_3 = −1
    assert len(np.unique(sol.chart[:, 0])) > 5  # charts were changed
    energy = sol.energy()
    assert np.ptp(energy) < 1e-4 * abs(energy[0])
    early, late = energy[:500], energy[500:]
    assert abs(np.ptp(late) - np.ptp(early)) < 0.5 * np.ptp(early)
    assert np.abs(np.linalg.norm(sol.q[:, :3], axis=1) - 1).max() < 1e-15
    assert np.abs(np.sum(sol.q[:, :3] * sol.p[:, :3], axis=1)).max() < 1e-13  # covectors are tangent


@pytest.mark.parametrize(
    "atlas",
    [
        dx.Atlas(SPACE, exponential=True, leave_at=0.3),
        dx.Atlas(SPACE, leave_at=0.1),
    ],
    ids=["normal coordinates", "small charts"],
)
@pytest.mark.soak
def test_the_atlas_changes_nothing_but_roundoff(through_the_pole, atlas):
    other = pendulums.simulate(dx.InCharts(dx.RiemannianExp(SPACE, 0.5), atlas), steps=1000)
    assert len(np.unique(other.chart[:, 0])) != len(np.unique(through_the_pole.chart[:, 0]))
    difference = np.abs(other.q - through_the_pole.q).max(axis=1)
    assert difference[100] < 1e-13
    assert difference.max() < 1e-10


def in_angles(angles, rates):
    """The same Lagrangian in the angles (θ1, φ1, θ2, φ2) of [RL] §7."""
    point = lambda q: jnp.concatenate([unit(q[0], q[1]), unit(q[2], q[3])])
    q, v = jax.jvp(point, (angles,), (rates,))
    return pendulums.system.lagrangian(q, v, pendulums.params)


def unit(theta, phi):
    return jnp.array([jnp.sin(phi) * jnp.cos(theta), jnp.sin(phi) * jnp.sin(theta), jnp.cos(phi)])


ANGLES, RATES = jnp.array([0.0, np.pi - 0.5, 0.0, np.pi - 1.0]), jnp.array([1e-6, -2.0, 1e-6, -1.0])


def test_away_from_the_poles_charts_and_angles_follow_the_same_motion():
    rates = jnp.array([1.0, 0.5, 1.5, -0.5])
    point = lambda q: jnp.concatenate([unit(q[0], q[1]), unit(q[2], q[3])])
    q, v = jax.jvp(point, (ANGLES,), (rates,))
    errors = []
    for steps in (50, 100, 200):
        run = {"step": 0.5 / steps, "steps": steps}
        charted = pendulums.simulate(q=q, v=v, **run)
        angles = dx.simulate(dx.LagrangeDirac(in_angles), dx.LagrangeDAlembert(), q=ANGLES, v=rates, **run)
        errors.append(np.abs(charted.q[-1] - np.asarray(point(jnp.asarray(angles.q[-1])))).max())
    assert -np.diff(np.log2(errors)) == pytest.approx([2, 2], abs=0.1)  # two schemes of order 2
    vertical = charted.momentum_map(lambda q: pendulums.symmetries["angular momentum about the vertical"](q))
    assert np.ptp(vertical) < 1e-12 * np.abs(vertical).max()  # roundoff ε|q|/h a step


@pytest.mark.soak
def test_near_a_pole_angles_fail_with_a_message_and_charts_do_not():
    """A swing that misses the pole by a hair: in angles θ turns by π within a step."""
    point = lambda q: jnp.concatenate([unit(q[0], q[1]), unit(q[2], q[3])])
    q, v = jax.jvp(point, (ANGLES,), (RATES,))
    angles = dx.simulate(dx.LagrangeDirac(in_angles), dx.LagrangeDAlembert(), q=ANGLES, v=RATES, step=0.01, steps=1000)
    assert not angles.ok
    assert "did not converge" in angles.message or "is singular" in angles.message
    assert "kept up to step" in angles.message
    charted = pendulums.simulate(q=q, v=v, steps=1000)
    assert charted.ok and np.ptp(charted.energy()) < 2e-3


def test_mistakes():
    with pytest.raises(ValueError, match="q is not on"):
        pendulums.simulate(q=np.ones(6), v=np.zeros(6), steps=2)
    with pytest.raises(ValueError, match="v is not tangent"):
        pendulums.simulate(q=[0, 0, -1, 0, 0, -1], v=[0, 0, 1, 0, 0, 0], steps=2)
    with pytest.raises(TypeError, match=r"dx\.InCharts steps a dx\.ManifoldLagrangian"):
        gallery.get("kepler").simulate(pendulums.scheme, steps=1)


@pytest.mark.parametrize("engine", ["native", pytest.param("xla", marks=pytest.mark.soak)])
def test_a_change_of_chart_leaves_the_guess_behind(engine):
    """A fast pendulum on the sphere, over forty changes of chart: the steps of the same L_d without charts."""
    system = dx.ManifoldLagrangian(lambda q, v: v @ v / 2 - 3.0 * q[2], dx.Sphere(3))
    start = {"q": np.array([0.6, 0.0, 0.8]), "v": np.array([0.8, 0.3, -0.6]), "step": 0.1, "steps": 60}
    charted = dx.simulate(system, dx.InCharts(dx.RiemannianExp(dx.Sphere(3))), **start, engine=engine)
    plain = dx.simulate(system, dx.DiscreteDirac(dx.RiemannianExp(dx.Sphere(3))), **start)
    assert charted.ok and len(np.unique(charted.chart, axis=0)) > 5
    np.testing.assert_allclose(charted.q, plain.q, atol=1e-11)


@pytest.mark.parametrize(
    ("made", "words"),
    [
        (lambda: dx.InCharts(dx.LagrangeDAlembert()), r"such as dx.SphereProjection\(\), but LagrangeDAlembert.* themselves"),
        (lambda: dx.InCharts(dx.SphereProjection(), dx.Sphere(3)), r"atlas must be a dx.Atlas, but Sphere"),
        (lambda: dx.Adjoint("midpoint"), r"such as dx.PlusLagrangeDirac\(\), but 'midpoint' was given\."),
        (lambda: dx.SymmetricComposition(dx.PlusLagrangeDirac), "add parentheses"),
    ],
)
def test_parts_that_are_none_are_refused_where_they_are_given(made, words):
    with pytest.raises(TypeError, match=words):
        made()
