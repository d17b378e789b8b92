"""The multipliers of the row that a run starts from: of one-forms too, they are those of a whole step where the mean is saved."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dirax as dx
from fuzz.reference import motion, rows_of
from fuzz.systems import Kind, RandomSystem

MEAN = dx.LagrangeDAlembert()
BLADE = lambda q: jnp.array([[jnp.sin(q[2]), -jnp.cos(q[2]), 0.0]])
SKATE = dx.LagrangeDirac(
    lambda q, v: v @ v / 2 + q[0], BLADE
)  # on a slope: x = sin²t/2, y = (t − sin t cos t)/2, φ = t, with the force 2 sin t of the ice
START = 0.5


def skate(scheme, h, system=SKATE, **more):
    s = START
    q = [np.sin(s) ** 2 / 2, (s - np.sin(2 * s) / 2) / 2, s]
    v = [np.sin(2 * s) / 2, (1 - np.cos(2 * s)) / 2, 1.0]
    return dx.simulate(system, scheme, q=q, v=v, t0=s, step=h, steps=round(0.4 / h), **more)


def orders(errors):
    return np.log2(np.divide(errors[:-1], errors[1:]))


@pytest.mark.parametrize("engine", ["native", "xla"])
@pytest.mark.parametrize(
    ("scheme", "order"),
    [
        (MEAN, 2),
        (dx.LagrangeDAlembert("trapezoidal"), 2),
        (dx.PlusLagrangeDirac("midpoint", "mean"), 1),
        (dx.MinusLagrangeDirac(momentum="mean"), 1),
        (dx.Adjoint(dx.MinusLagrangeDirac(momentum="mean")), 1),
    ],
)
@pytest.mark.soak_of("scheme0-2-xla", "scheme1-2-xla", "scheme2-1-xla", "scheme3-1-xla", "scheme4-1-xla")
def test_the_force_on_a_skate_in_the_first_row(scheme, order, engine):
    errors = []
    for h in (0.04, 0.02, 0.01):
        sol = skate(scheme, h, engine=engine)
        errors.append(abs(sol.multipliers[0, 0] / h - 2 * np.sin(START)))
    assert np.all(orders(errors) > order - 0.1), errors


@functools.cache
def at_the_start(kind):
    """A system of a kind, its parameters and initial data, and what is at the start: p, the force of the constraints, and the
    rows that the multipliers of dirax belong to."""
    system = RandomSystem(kind)
    params, start = system.parameters(np.random.default_rng(3))
    exact = {name: a[0] for name, a in motion(system, params, start, np.array([0.0, 0.1])).items()}
    own, every = (np.asarray(rows)[0] for rows in rows_of(system)(np.zeros(1), start["q"][None], params))
    return system.system, params, start, exact["p"], own.T @ exact["multipliers"], every


ALL = Kind(4, m=1, c=1, magnetic=True, affine=True, forced=True, timed=True, moving=True, redundant=True)


@pytest.mark.parametrize(
    ("kind", "rule"),
    [
        pytest.param(Kind(4, m=1, magnetic=True), "midpoint", marks=pytest.mark.soak),
        pytest.param(Kind(3, m=1, affine=True, forced=True, timed=True), "trapezoidal", marks=pytest.mark.soak),
        (ALL, "midpoint"),
        (ALL, "trapezoidal"),
    ],
    ids=["one-forms", "affine", "all", "all, trapezoidal"],
)
@pytest.mark.soak
def test_second_order_whatever_the_system_has(kind, rule):
    """Against the saddle-point equations of the Lagrangian's own derivatives at the start."""
    system, params, start, p, force, every = at_the_start(kind)
    errors = []
    for h in (0.02, 0.01, 0.005):
        sol = dx.simulate(system, dx.LagrangeDAlembert(rule), params=params, **start, step=h, steps=2)
        errors.append(np.max(np.abs(-every.T @ sol.multipliers[0] / h - force)))
        np.testing.assert_allclose(sol.p[0], p, atol=1e-13)
    np.testing.assert_allclose(orders(errors), 2, atol=0.15)


@pytest.mark.parametrize("momentum", ["incoming", "outgoing"])
def test_other_momenta_begin_with_the_impulse_from_the_given_one_on(momentum):
    """p_0 + D1 L_d = Wᵀμ_0 with the given p_0: half of the impulse of later rows, up to h."""
    errors = []
    for h in (0.04, 0.02, 0.01):
        sol = skate(dx.LagrangeDAlembert(momentum=momentum), h)
        given = np.array([np.sin(2 * START) / 2, (1 - np.cos(2 * START)) / 2, 1.0])
        leaving = (sol.q[1] - sol.q[0]) / h - np.array([h / 2, 0.0, 0.0])
        row = np.array([np.sin(START), -np.cos(START), 0.0])
        np.testing.assert_allclose(given - leaving, row * sol.multipliers[0, 0], atol=1e-13)
        errors.append(abs(sol.multipliers[0, 0] / h - np.sin(START)))
    np.testing.assert_allclose(orders(errors), 1, atol=0.1)


def smoothness(scheme, run, parts=(20, 40, 80)):
    """By how much the first row is off a parabola through the next three, of forces."""
    missed = []
    for steps in parts:
        sol = run(scheme, steps)
        forces = np.asarray(sol.multipliers)[:4] / sol.step
        missed.append(np.max(np.abs(np.array([1.0, -3.0, 3.0, -1.0]) @ forces)))
    return missed


ON_A_SPHERE = dx.ManifoldLagrangian(
    lambda q, v: v @ v / 2 - q[2], dx.Product(dx.Sphere(3), dx.Circle()), lambda q: jnp.array([[q[1], 0.4, -q[0], 1.0]])
)


@pytest.mark.parametrize("rule", ["midpoint", "trapezoidal"])
@pytest.mark.soak_of("midpoint")
def test_in_charts(rule):
    """A pendulum of a sphere with a nonintegrable constraint."""
    run = lambda scheme, steps: dx.simulate(
        ON_A_SPHERE, scheme, q=[0.6, 0.0, 0.8, 0.0], v=[0.4, 0.5, -0.3, 0.2], step=1.0 / steps, steps=4, project=True
    )
    assert np.all(orders(smoothness(dx.LagrangeDAlembert(rule, momentum="mean"), run)) > 1.8)


def test_on_the_quotient_by_a_symmetry():
    """The skate again, without its y."""
    reduced = dx.reduce(SKATE, dx.LinearConnection([1]))
    run = lambda scheme, steps: skate(scheme, 1.0 / steps, system=reduced)
    assert np.all(orders(smoothness(MEAN, run)) > 1.8)


def test_nothing_else_has_another_first_row():
    """Going on, in a batch, and in a composition, whose impulses are those of whole steps."""
    sol, longer = skate(MEAN, 0.02), skate(MEAN, 0.04).extend(5)
    assert np.array_equal(skate(MEAN, 0.04, engine="native").multipliers, longer.multipliers[:10])
    scale = np.array([1.0, 1.3])[:, None]
    batch = dx.simulate(SKATE, MEAN, q=sol.q[0] * np.ones((2, 3)), v=sol.p[0] * scale, step=0.02, steps=20)
    np.testing.assert_allclose(batch.multipliers[0], sol.multipliers, atol=1e-14)
    composed = skate(dx.Composition(MEAN), 0.02)
    assert abs(composed.multipliers[0, 0] / 0.02 - 2 * np.sin(START + 0.01)) < 1e-4


@pytest.mark.parametrize("scheme", [MEAN, dx.LagrangeDAlembert(momentum="incoming"), dx.PlusLagrangeDirac(momentum="mean")])
@pytest.mark.soak_of(but=["scheme1"])
def test_verify_takes_the_first_row_again(scheme):
    sol = skate(scheme, 0.02)
    report = dx.verify(sol)
    assert report["steps replayed"].verdict == report["saved p and multipliers"].verdict == "ok"
    assert all(line.verdict != "VIOLATED" for line in report.lines)
    sol.fields["multipliers"][0] *= 1.0 + 1e-6
    assert dx.verify(sol)["steps replayed"].verdict == "VIOLATED"


HEAVY = dx.LagrangeDirac(lambda q, v, m: m * (v @ v) / 2 + m**2 * q[0], BLADE)


@pytest.mark.parametrize("engine", ["native", pytest.param("xla", marks=pytest.mark.soak)])
@pytest.mark.soak
def test_it_is_differentiated(engine):
    """L = m|v|²/2 + m g x: the force at the start is 2 m g sin t₀ up to h², with ẋ that of g = 1 where φ̇ = 1. Differences are
    those of runs of the native engine."""
    h, step = 0.01, 1e-5
    first = lambda m, engine="native": skate(MEAN, h, system=HEAVY, params=m, engine=engine).multipliers[0, 0]
    found = jax.grad(first)(1.2, engine)
    assert found == pytest.approx((first(1.2 + step) - first(1.2 - step)) / (2 * step), rel=1e-7)


@pytest.mark.soak
def test_a_force_that_does_not_act_before():
    """√t at t = 0: a step that would arrive there has none, and its place takes one that comes back to the start."""
    system = dx.LagrangeDirac(
        lambda q, v, a: v @ v / 2, BLADE, forces=lambda t, q, v, a: jnp.stack([0.0 * a, a * jnp.sqrt(t), 0.0 * a])
    )

    def run(a):
        return dx.simulate(system, MEAN, q=[0.0, 0.0, 0.0], v=[1.0, 0.0, 1.0], params=a, step=0.01, steps=10)

    sol = run(1.0)
    assert sol.ok and np.array_equal(sol.p[0], [1.0, 0.0, 1.0])
    assert sol.multipliers[0, 0] / 0.01 == pytest.approx(1.0, abs=0.1)  # the force that turns it
    slope = jax.grad(lambda a: run(a).q[-1, 1])(1.0)
    assert slope == pytest.approx((run(1.001).q[-1, 1] - run(0.999).q[-1, 1]) / 0.002, rel=1e-6)
