"""The structures that schemes give of themselves: every pair of a system and a scheme has a line, and damage is seen in it."""

import jax.numpy as jnp
import numpy as np
import pytest

import dirax as dx
from dirax.schemes.discrete_structure_maps import NAME

MASSES = jnp.array([1.0, 1.0, 0.25, 0.5])
B = np.array([[0.0], [1.0], [1.0]])
J = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 0.0]])


def forms(q):
    c, s = jnp.cos(q[3]), jnp.sin(q[3])
    return jnp.array([[1.0, 0.0, -c, 0.0], [0.0, 1.0, -s, 0.0]])


def port(**parts):
    return dx.PortHamiltonian(lambda x: x @ x / 2 + x[0] ** 4 / 8, J, **parts)


DISK = dx.NonholonomicMechanics(lambda q: jnp.diag(MASSES), lambda q: 10 * jnp.sin(q[2]), forms)
DRIVEN = dx.LagrangeDirac(lambda q, v: v @ (MASSES * v) / 2, forms, forces=lambda t, q, v: jnp.cos(t) - 0.1 * v)
PENDULUM = dx.LagrangeDirac(lambda q, v: v @ v / 2 - q[1], holonomic=lambda q: jnp.array([q @ q - 1.0]))
PLANE = dx.PhaseSpaceLagrangian(lambda q: jnp.array([q[1] / 2 + q[1] ** 3 / 5, -q[0] / 2]), lambda q: q @ q / 2 + q[0] ** 4 / 4)
ON_SPHERE = dx.ManifoldLagrangian(
    lambda q, v: v @ v / 2 - 3 * q[2], dx.Sphere(3), one_forms=lambda q: jnp.array([[0.0, q[2], 0.3]])
)
LOSSY = port(R=np.diag([0, 0.1, 0.2]), B=B, inputs=lambda t, x: jnp.cos(t)[None])
OSCILLATOR = dx.ImplicitSystem(lambda x: jnp.eye(2), lambda x: jnp.array([x[1], -jnp.sin(x[0])]))

ROLLING = {"q": [0.0, 0.0, 0.0, 0.3], "v": [np.cos(0.3), np.sin(0.3), 1.0, 0.5]}
METHOD_ONE = [
    (DISK, dx.DiscreteDirac(), ROLLING),
    (DRIVEN, dx.DiscreteDirac(dx.Theta(0.5)), ROLLING),
    (PENDULUM, dx.DiscreteDirac(dx.Theta(0.3)), {"q": [1.0, 0.0], "v": [0.0, 0.3]}),
    (PLANE, dx.DiscreteDirac(), {"q": [1.0, 0.2], "v": [0.0, 0.0]}),
    (PLANE, dx.DiscreteDirac(constraints="resolve"), {"q": [1.0, 0.2], "v": [0.0, 0.0]}),
    (ON_SPHERE, dx.DiscreteDirac(dx.SphereProjection()), {"q": [0.6, 0.0, 0.8], "v": [-0.8, 0.0, 0.6]}),
    (LOSSY, dx.DiscreteDirac(dx.Theta(0.3)), {"x": [1.0, 0.2, 0.3]}),
    (port(B=B, closed=True), dx.DiscreteDirac(), {"x": [1.0, 0.2, -0.2]}),
]  # fmt: skip


@pytest.mark.parametrize(("system", "scheme", "start"), METHOD_ONE)
def test_steps_by_maps_are_in_their_structure_and_damage_is_seen(system, scheme, start):
    sol = dx.simulate(system, scheme, step=0.05, steps=20, check_initial=False, engine="native", **start)
    report = dx.verify(sol)
    assert report[NAME].verdict == "ok", report
    if "q" in sol.fields and "multipliers" in sol.fields:
        assert report["saved multipliers"].verdict == "ok", report
        sol.fields["multipliers"][7, 0] += 1e-6
        assert dx.verify(sol)["saved multipliers"].verdict == "VIOLATED"
    points = "q" if "q" in sol.fields else "x"
    sol.fields[points][12, 0] += 1e-7
    broken = dx.verify(sol)[NAME]
    assert broken.verdict == "VIOLATED"
    assert 0.5 <= float(broken.explanation.split("t = ")[1].split(":")[0].split(" ")[0]) <= 0.6


def test_implicit_systems_and_the_sentences_of_others():
    sol = dx.simulate(OSCILLATOR, dx.DiscreteDirac(), step=0.05, steps=20, x=[1.0, 0.0])
    assert dx.verify(sol)["discretized implicit system"].verdict == "ok"
    for scheme, words in (
        (dx.DiscreteDirac(constraints="resolve"), "projects the step of D"),
        (dx.Composition(dx.LagrangeDAlembert()), "between the parts of a step of Composition"),
    ):
        line = dx.verify(dx.simulate(DISK, scheme, step=0.05, steps=5, **ROLLING))["discrete Dirac structure"]
        assert line.verdict == "not checked" and words in line.explanation


def test_charts_change_and_the_step_stays_symplectic():
    system = dx.ManifoldLagrangian(lambda q, v: v @ v / 2 - 3 * q[2], dx.Sphere(3))
    start = {"q": [0.6, 0.0, 0.8], "v": [0.4, 0.3, -0.3], "step": 0.05, "steps": 40}
    sol = dx.simulate(system, dx.InCharts(dx.SphereProjection()), **start)
    assert len(np.unique(np.asarray(sol.chart), axis=0)) > 1
    line = dx.verify(sol)["symplecticity of one step"]
    assert line.verdict == "ok" and line.value < 1e-14, line


def test_a_forced_system_with_one_forms_is_checked_in_every_line():
    """The scalar field `work` beside q and p."""
    sol = dx.simulate(DRIVEN, dx.DiscreteDirac(), step=0.05, steps=20, **ROLLING)
    assert dx.verify(sol)["constraint"].verdict in ("ok", "not checked")
