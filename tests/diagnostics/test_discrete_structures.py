"""The structures that schemes give of themselves: every pair of a system and a scheme has a line, and damage is seen in it."""

import jax.numpy as jnp
import numpy as np
import pytest

import dirax as dx
from dirax.diagnostics.structure_lines import membership, structure_of
from dirax.schemes.discrete_structure import AbstractDiscreteStructure, AbstractStepForm
from dirax.schemes.discrete_structure_maps import NAME
from dirax.schemes.step import make_step_equation

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
@pytest.mark.soak_of(but=["system6-scheme6-start6"])
def test_steps_by_maps_are_in_their_structure_and_damage_is_seen(system, scheme, start):
    lines = lambda sol: {line.quantity: line for line in membership(sol, structure_of(sol), None)}
    sol = dx.simulate(system, scheme, step=0.05, steps=20, check_initial=False, engine="native", **start)
    report = dx.verify(sol)
    assert report[NAME].verdict == "ok", report
    if "q" in sol.fields and "multipliers" in sol.fields:
        assert report["saved multipliers"].verdict == "ok", report
        sol.fields["multipliers"][7, 0] += 1e-6
        assert lines(sol)["saved multipliers"].verdict == "VIOLATED"
    points = "q" if "q" in sol.fields else "x"
    sol.fields[points][12, 0] += 1e-7
    broken = lines(sol)[NAME]
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


@pytest.mark.soak
def test_charts_change_and_the_step_stays_symplectic():
    system = dx.ManifoldLagrangian(lambda q, v: v @ v / 2 - 3 * q[2], dx.Sphere(3))
    start = {"q": [0.6, 0.0, 0.8], "v": [0.4, 0.3, -0.3], "step": 0.05, "steps": 40}
    sol = dx.simulate(system, dx.InCharts(dx.SphereProjection()), **start)
    assert len(np.unique(np.asarray(sol.chart), axis=0)) > 1
    line = dx.verify(sol)["symplecticity of one step"]
    assert line.verdict == "ok" and (line.value or 0.0) < 1e-14, line


def test_a_forced_system_with_one_forms_is_checked_in_every_line():
    """The scalar field `work` beside q and p."""
    sol = dx.simulate(DRIVEN, dx.DiscreteDirac(), step=0.05, steps=20, **ROLLING)
    assert dx.verify(sol)["constraint"].verdict in ("ok", "not checked")


SO3, SPHERE, INERTIA = dx.SO3(), dx.Sphere(3), jnp.array([1.0, 2.0, 3.0])
CANONICAL = jnp.array([[0.0, 1.0], [-1.0, 0.0]])
ROW = lambda q: jnp.array([[-q[1], q[0], 1.0]])
QUADRATIC = lambda x: x @ x / 2 + x[0] ** 4 / 4
NEWTON, IN_SPACE = (lambda q, v: v @ v / 2 - q[0] ** 2), (lambda q, v: v @ v / 2)


def two_form(of):
    return dx.DiracSystem(dx.DiracStructure.from_two_form(lambda x: of(x) * CANONICAL), QUADRATIC)


PLANAR = {"q": [1.0, 0.2], "v": [0.0, 0.3]}
SPATIAL = {"q": [1.0, 0.0, 0.1], "v": [0.0, 0.3, -0.3]}
POINT = {"x": [1.0, 0.2]}
THREE = {"x": [1.0, 0.2, 0.3]}
ON_S2 = {"q": [0.6, 0.0, 0.8], "v": [-0.8, 0.0, 0.6]}
KINDS = {
    "Lagrangian": (dx.LagrangeDirac(NEWTON), PLANAR),
    "one-forms": (dx.LagrangeDirac(IN_SPACE, ROW), SPATIAL),
    "affine": (dx.LagrangeDirac(IN_SPACE, ROW, affine=lambda q: jnp.array([0.1])), SPATIAL),
    "holonomic": (PENDULUM, {"q": [1.0, 0.0], "v": [0.0, 0.3]}),
    "forces": (DRIVEN, ROLLING),
    "friction": (dx.LagrangeDirac(IN_SPACE, ROW, forces=lambda t, q, v, multipliers: -multipliers[0] * v), SPATIAL),
    "metric": (DISK, ROLLING),
    "phase space": (PLANE, {"q": [1.0, 0.2]}),
    "Hamiltonian": (dx.HamiltonDirac(lambda q, p: (p @ p + q @ q) / 2), {"q": [1.0, 0.2], "p": [0.0, 0.3]}),
    "Hamiltonian, one-forms": (dx.HamiltonDirac(lambda q, p: p @ p / 2, ROW), {"q": [1.0, 0.0, 0.1], "p": [0.0, 0.3, -0.3]}),
    "two-form": (two_form(lambda x: 2.0), POINT),
    "two-form that changes": (two_form(lambda x: 2.0 + x[0] ** 2), POINT),
    "bivector": (dx.DiracSystem(dx.DiracStructure.from_bivector(lambda x: 2.0 * CANONICAL), QUADRATIC), POINT),
    "canonical": (dx.DiracSystem(dx.induced_dirac(None, 1), QUADRATIC), POINT),
    "induced": (dx.DiracSystem(dx.induced_dirac(ROW, 3), QUADRATIC), {"x": [1.0, 0.0, 0.1, 0.0, 0.3, -0.3]}),
    "ports": (LOSSY, THREE),
    "closed ports": (port(B=B, closed=True), {"x": [1.0, 0.2, -0.2]}),
    "no ports": (port(), THREE),
    "sphere": (dx.ManifoldLagrangian(lambda q, v: v @ v / 2 - q[2], SPHERE), ON_S2),
    "sphere, one-forms": (ON_SPHERE, ON_S2),
    "implicit": (OSCILLATOR, {"x": [1.0, 0.0]}),
    "Euler-Poincaré": (dx.EulerPoincare(SO3, lambda xi: xi @ (INERTIA * xi) / 2), THREE),
    "Suslov": (dx.EulerPoincare(SO3, lambda xi: xi @ (INERTIA * xi) / 2, [[1.0, 0.2, 0.3]]), {"x": [0.2, -2.0, 0.0]}),
    "Lie-Poisson": (dx.LiePoisson(SO3, lambda mu: mu @ (mu / INERTIA) / 2), THREE),
}
SCHEMES = [
    dx.PlusLagrangeDirac(), dx.MinusLagrangeDirac(), dx.LagrangeDAlembert(), dx.PlusHamiltonDirac(), dx.MinusHamiltonDirac(),
    dx.DiscreteDirac(), dx.DiscreteDirac(dx.cotangent_lift(dx.Theta(0.0))), dx.DiscreteDirac(constraints="resolve"),
    dx.DiscreteDirac(dx.SphereProjection()), dx.DiscreteDirac(dx.SphereProjection(), "resolve"),
    dx.InCharts(dx.SphereProjection()), dx.DiscreteGradient(), dx.DiscreteEulerPoincare(), dx.Collocation(2),
    dx.Collocation(3, "lobatto"), dx.EnergyCollocation(2), dx.Adjoint(dx.PlusLagrangeDirac()), dx.Adjoint(dx.DiscreteDirac()),
    dx.Composition(dx.DiscreteDirac()), dx.SymmetricComposition(dx.LagrangeDAlembert()), dx.VariableSteps(dx.LagrangeDAlembert()),
]  # fmt: skip


def test_every_pair_of_a_system_and_a_scheme_has_a_structure_or_a_reason():
    """What `verify` asks of each pair that `simulate` accepts; a quotient is judged by the motion that is reconstructed."""
    pairs, measured, reasons = 0, 0, set()
    for name, (system, start) in KINDS.items():
        shape = dx.Shape(*system.sizes({key: np.asarray(a, float) for key, a in start.items()}, None))
        accepted = 0
        for scheme in SCHEMES:
            try:
                make_step_equation(scheme, system, shape)
            except (TypeError, ValueError):
                continue
            accepted += 1
            structure, form = scheme.discrete_structure(system, shape, 0.1), scheme.step_form(system, shape, 0.1)
            if isinstance(structure, str):
                reasons.add(structure)
            else:
                assert isinstance(structure, AbstractDiscreteStructure) and structure.claims, (name, scheme)
            measured += not (isinstance(structure, str) and isinstance(form, str))
            if isinstance(form, str):
                reasons.add(form)
            else:
                assert isinstance(form, AbstractStepForm), (name, scheme)
        assert accepted, name
        pairs += accepted
    assert pairs > 200 and measured > 0.6 * pairs
    assert all(len(reason.split()) > 4 and "states no discrete Dirac structure" not in reason for reason in reasons), reasons


LINES = [
    ("two-form", dx.DiscreteDirac(), "ok"),
    ("two-form", dx.Collocation(2), "ok"),
    ("two-form", dx.DiscreteDirac(dx.Theta(0.3)), "Remark 6.4"),
    ("two-form that changes", dx.DiscreteDirac(), "changes from point to point"),
    ("bivector", dx.DiscreteDirac(), "ok"),
    ("no ports", dx.DiscreteDirac(), "ok"),
    ("sphere", dx.DiscreteDirac(dx.SphereProjection()), "ok"),
    ("sphere", dx.Adjoint(dx.PlusLagrangeDirac()), "ok"),
]  # fmt: skip


@pytest.mark.parametrize(("kind", "scheme", "says"), LINES)
@pytest.mark.soak_of("two-form-scheme0-ok", "sphere-scheme6-ok", "sphere-scheme7-ok")
def test_the_form_whose_graph_d_is_and_that_of_a_manifold(kind, scheme, says):
    system, start = KINDS[kind]
    line = dx.verify(dx.simulate(system, scheme, step=0.1, steps=6, **start))["symplecticity of one step"]
    if says == "ok":
        assert line.verdict == "ok" and (line.value or 0.0) < 1e-14, line
    else:
        assert line.verdict == "not checked" and (line.value or 0.0) > 1e-8 and says in line.explanation, line
