"""Compositions on quotients of systems with constraints: the unreduced compositions, and an explicit ODE for their order."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import dirax as dx

T = 1.0


def lagrangian(q, v):
    """(r, s, θ) with inertias that depend on r; θ is cyclic."""
    kinetic = v[0] ** 2 + (1 + 0.3 * q[0] ** 2) * v[1] ** 2 + v[2] ** 2
    return kinetic / 2 + 0.3 * q[0] * v[1] * v[2] - q[0] ** 2 / 2


def rows(q):
    return jnp.array([[1.0, 0.3 * q[0], 0.5]])


def admissible(v, row, rate=0.0):
    """The velocity nearest to v with row·v + rate = 0."""
    row = np.asarray(row)
    return v - row * (row @ v + rate) / (row @ row)


Q = np.array([0.3, 0.1, 0.2])
V = admissible(np.array([0.4, 0.3, -0.5]), rows(Q)[0])
PLAIN = dx.LagrangeDirac(lagrangian, rows)
TILTED = dx.LinearConnection([2], [[0.3, -0.2]])
BENT = dx.DiscreteConnection(lambda q0, q1: q1[2:] - q0[2:] - (q0[:1] + q1[:1]) * (q1[1:2] - q0[1:2]) / 5, [2])
MIDPOINT = dx.Composition(dx.LagrangeDAlembert(), "suzuki4")
OWN = dx.LagrangeDAlembert(
    lambda q0, q1, h: h * lagrangian((q0 + q1) / 2, (q1 - q0) / h), lambda q0, q1, h: rows((q0 + q1) / 2) @ (q1 - q0) / h
)
SCHEMES = {
    "midpoint": MIDPOINT,
    "trapezoidal": dx.Composition(dx.LagrangeDAlembert("trapezoidal", momentum="outgoing"), "yoshida4"),
    "(+)": dx.SymmetricComposition(dx.PlusLagrangeDirac()),
    "(-)": dx.SymmetricComposition(dx.MinusLagrangeDirac()),
    "of (-) to order 4": dx.Composition(dx.SymmetricComposition(dx.MinusLagrangeDirac()), "suzuki4"),
    "of functions": dx.Composition(OWN, "suzuki4"),
}
FORCED = lambda t, q, v: -0.1 * v + jnp.stack([jnp.sin(t), 0 * t, 0.2 * q[0]])
SEEING = lambda t, q, v, multipliers: -0.1 * (1 + multipliers[0] ** 2) * v
TIMED = lambda t, q, v: lagrangian(q, v) + 0.2 * jnp.sin(t) * v[2] * q[0]
MOVING = lambda t, q: jnp.array([0.3 + 0.1 * q[0] + 0.1 * jnp.sin(t)])
ROLLING = lambda t, q: jnp.array([[1.0, 0.3 * q[0], 0.5 + 0.1 * jnp.sin(t)]])
METRIC = lambda q: jnp.array([[1, 0, 0], [0, 1 + 0.3 * q[0] ** 2, 0.3 * q[0]], [0, 0.3 * q[0], 1.0]])
SYSTEMS = {
    "forces that see the multipliers": (dx.LagrangeDirac(lagrangian, rows, forces=SEEING), V),
    "forces, affine and time": (
        dx.LagrangeDirac(TIMED, ROLLING, affine=MOVING, forces=FORCED),
        admissible(V, ROLLING(0.0, Q)[0], MOVING(0.0, Q)[0]),
    ),
    "redundant": (dx.LagrangeDirac(lagrangian, lambda q: jnp.concatenate([rows(q), 2 * rows(q)])), V),
    "nonholonomic mechanics": (dx.NonholonomicMechanics(METRIC, lambda q: q[0] ** 2 / 2, rows), V),
}
RING = dx.LagrangeDirac(
    lambda q, v: v @ v / 2 + 0.3 * q[0] * v[1] * v[2] - q[1] / 2,
    lambda q: jnp.stack([q[1], 0 * q[0], jnp.ones(())])[None],
    holonomic=lambda t, q: jnp.array([q[0] ** 2 + q[1] ** 2 - 1.0 - 0.1 * t]),
)
"""On a moving circle, with a one-form."""


reduced_by = cache(dx.reduce)


@cache
def unreduced(system, scheme, steps, *numbers):
    return dx.simulate(system, scheme, q=numbers[: len(numbers) // 2], v=numbers[len(numbers) // 2 :], step=0.05, steps=steps)


def both(system, scheme, connection, q, v, reduced_scheme=None, steps=12, as_whole=False):
    """The unreduced run and the reduced one, reconstructed; and that `verify` finds nothing wrong with it, `as_whole` also as a
    run of the unreduced system."""
    whole = unreduced(system, scheme, steps, *map(float, (*q, *v)))
    reduced = dx.simulate(reduced_by(system, connection), reduced_scheme or scheme, q=q, v=v, step=0.05, steps=steps)
    assert whole.ok and reduced.ok
    again = dx.reconstruct(reduced)
    for sol in (reduced, again)[: 1 + as_whole]:
        assert dx.verify(sol).ok, str(dx.verify(sol))
    return whole, again


def agree(whole, again, tolerance):
    """Check that every saved number is that of the unreduced run, but for the choice of charts."""
    assert set(whole.fields) == set(again.fields)
    for name in whole.fields.keys() - {"chart"}:
        assert np.abs(whole.fields[name] - again.fields[name]).max() < tolerance, name


@pytest.mark.parametrize("scheme", SCHEMES.values(), ids=SCHEMES.keys())
@pytest.mark.soak
def test_composed_reduced_runs_are_the_unreduced_ones(scheme):
    agree(*both(PLAIN, scheme, TILTED, Q, V, as_whole=True), tolerance=3e-14)


@pytest.mark.parametrize("name", ["midpoint", "(-)", "of functions"])
@pytest.mark.soak
def test_and_by_a_connection_that_is_not_linear(name):
    agree(*both(PLAIN, SCHEMES[name], BENT, Q, V), tolerance=3e-14)


@pytest.mark.parametrize("name", SYSTEMS)
@pytest.mark.soak_of(but=["redundant"])
def test_forces_time_affine_and_redundant_constraints(name):
    system, v = SYSTEMS[name]
    for scheme in (MIDPOINT, SCHEMES["(+)"])[: 1 + (name == "forces, affine and time")]:
        agree(*both(system, scheme, TILTED, Q, v), tolerance=1e-14)


@pytest.mark.parametrize("scheme", [MIDPOINT, SCHEMES["(-)"], dx.Adjoint(dx.PlusLagrangeDirac())])
@pytest.mark.soak
def test_moving_holonomic_constraints(scheme):
    q = np.array([0.6, 0.8, 0.2])
    v = np.array([0.8, -0.6, 0.0]) + 0.05 * np.array([0.6, 0.8, 0.0])
    v[2] = -q[1] * v[0]
    agree(*both(RING, scheme, TILTED, q, v), tolerance=1e-14)


def seeing(t, q, v, multipliers):
    return jnp.array([-0.1, -0.2 * q[0], 0.0]) * v * (1 + multipliers[0] ** 2)


@pytest.mark.parametrize(
    ("forces", "made", "rule"),
    [
        pytest.param(None, lambda scheme: dx.Composition(scheme, "suzuki4"), (), marks=pytest.mark.soak),
        (seeing, dx.SymmetricComposition, ("left", "right")),
    ],
)
def test_composed_routh_equations_with_constraints_are_the_unreduced_ones(forces, made, rule):
    system = dx.LagrangeDirac(lagrangian, lambda q: jnp.array([[1.0, 0.3 * q[0], 0.0]]), forces=forces)
    v = admissible(V, [1.0, 0.3 * Q[0], 0.0])
    agree(*both(system, made(dx.LagrangeDAlembert(*rule)), TILTED, Q, v, made(dx.DiscreteRouth(*rule))), tolerance=1e-14)


def test_composed_routh_equations_with_holonomic_constraints_are_the_unreduced_ones():
    circle = dx.LagrangeDirac(RING.lagrangian.function, holonomic=lambda q: jnp.array([q[0] ** 2 + q[1] ** 2 - 1.0]))
    start = np.array([0.6, 0.8, 0.2]), np.array([0.8, -0.6, 0.4])
    agree(*both(circle, MIDPOINT, TILTED, *start, dx.Composition(dx.DiscreteRouth(), "suzuki4")), tolerance=1e-14)


@cache
def exact():
    """(q, p, λ) at T, from q̈ and λ of M(q)q̈ + … = −Wᵀλ, Ẇq̇ + Wq̈ = 0."""

    @jax.jit
    def accelerations(q, v):
        momentum = lambda q, v: jax.grad(lagrangian, 1)(q, v)
        mass = jax.jacfwd(momentum, 1)(q, v)
        force = jax.grad(lagrangian)(q, v) - jax.jacfwd(momentum)(q, v) @ v
        bend = jax.jacfwd(lambda q: rows(q) @ v)(q) @ v
        matrix = jnp.block([[mass, rows(q).T], [rows(q), jnp.zeros((1, 1))]])
        return jnp.linalg.solve(matrix, jnp.concatenate([force, -bend]))

    rate = lambda t, y: np.concatenate([y[3:], accelerations(y[:3], y[3:])[:3]])
    y = solve_ivp(rate, (0, T), np.concatenate([Q, V]), method="DOP853", rtol=1e-12, atol=1e-14).y[:, -1]
    return y[:3], np.asarray(jax.grad(lagrangian, 1)(y[:3], y[3:]))


@pytest.mark.parametrize(("scheme", "order"), [(MIDPOINT, 4), (SCHEMES["(+)"], 2)], ids=["midpoint", "(+)"])
@pytest.mark.soak_of("midpoint")
def test_reduced_momenta_have_the_order_of_the_composition(scheme, order):
    q, p = exact()
    missed = []
    for steps in (10, 20, 40):
        sol = dx.reconstruct(dx.simulate(reduced_by(PLAIN, TILTED), scheme, q=Q, v=V, step=T / steps, steps=steps))
        missed.append([np.abs(sol.q[-1] - q).max(), np.abs(sol.p[-1] - p).max()])
    slopes = np.log2(np.array(missed[:-1]) / missed[1:])
    assert np.all(np.abs(slopes - order) < 0.25), slopes


@pytest.mark.soak
def test_one_forms_that_the_group_moves_do_not_compose_on_the_quotient():
    moved = dx.LagrangeDirac(lagrangian, lambda q: (1 + q[2] ** 2) * rows(q))
    with pytest.raises(ValueError, match=r"one-form 0 is moved by the group.*step the unreduced system"):
        dx.simulate(dx.reduce(moved, TILTED), MIDPOINT, q=Q, v=V, step=0.05, steps=2)
    agree(*both(moved, dx.LagrangeDAlembert(), TILTED, Q, V, steps=4), tolerance=1e-14)


def test_variable_steps_are_for_systems_that_are_not_reduced():
    with pytest.raises(TypeError, match="not reduced"):
        dx.simulate(dx.reduce(PLAIN, TILTED), dx.VariableSteps(dx.LagrangeDAlembert()), q=Q, v=V, step=0.05, steps=2)


# ---------------------------------------------------------------------------------------------------- on manifolds

SO3 = dx.SO3()


def on_bundle(q, v):
    x, spin = q[:3], SO3.to_algebra(q[3:], v[3:])
    own = v[:3] @ v[:3] / 2 + spin @ (jnp.array([1.0, 2.0, 3.0]) * spin) / 2
    return own + 0.3 * spin @ jnp.cross(x, v[:3]) + 0.2 * (spin @ x) ** 2 - x[2] / 2 - 0.2 * x[0] * x[1]


def left_invariant_row(q):
    row = lambda v: SO3.to_algebra(q[3:], v[3:]) @ jnp.array([1.0, 0.3, -0.2]) + (q[2] + 0.4 * q[0]) * v[1]
    return jax.grad(row)(jnp.zeros(7))[None]


BUNDLE = dx.Product(dx.Sphere(3), SO3)
CURVED = dx.GroupConnection(SO3, lambda a, b: SO3.group_exp(0.3 * jnp.cross(a, b)))
AT = np.array([0.6, 0.0, 0.8, 0.5, 0.5, 0.5, 0.5])


def velocity_on_bundle():
    shape, row = np.array([0.4, 0.5, -0.3]), np.array([1.0, 0.3, -0.2])
    spin = admissible(np.array([0.3, -0.4, 0.6]), row, (0.8 + 0.4 * 0.6) * shape[1])
    return np.concatenate([shape, SO3.left_translate(jnp.asarray(AT[3:]), jnp.asarray(spin))])


@pytest.mark.soak
def test_on_a_bundle_over_the_sphere():
    system = dx.ManifoldLagrangian(on_bundle, BUNDLE, left_invariant_row)
    agree(*both(system, SCHEMES["(-)"], CURVED, AT, velocity_on_bundle(), steps=6), tolerance=1e-12)


def test_one_forms_on_a_bundle_that_the_group_moves():
    system = dx.ManifoldLagrangian(on_bundle, BUNDLE, lambda q: (1 + q[3] ** 2) * left_invariant_row(q))
    with pytest.raises(ValueError, match="one-form 0 is moved by the group"):
        dx.simulate(dx.reduce(system, SO3), MIDPOINT, q=AT, v=velocity_on_bundle(), step=0.05, steps=2)
