"""Rows of composed steps: what is saved is the whole step's, of the order of q in every field, on both engines."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dirax as dx

G = 9.81
pendulum = dx.LagrangeDirac(
    lambda q, v: v @ v / 2 - G * q[1], holonomic=lambda q: jnp.array([(q @ q - 1) / 2])
)  # the force of the constraint is −λ q with λ = v² − g·q, and multipliers are impulses of the opposite sign
START = {"q": jnp.array([np.sin(0.5), -np.cos(0.5)]), "v": jnp.zeros(2)}
END = 1.0


ANGLE = dx.LagrangeDirac(lambda q, v: v[0] ** 2 / 2 + G * jnp.cos(q[0]))


@cache
def mean_tension(intervals):
    """The mean of the tension over every step: by Simpson's rule on a run of a fine plain scheme in the angle."""
    fine = 64
    steps, scheme = fine * intervals, dx.Composition(dx.LagrangeDAlembert(), "kahan-li8")
    ref = dx.simulate(ANGLE, scheme, q=jnp.array([0.5]), v=jnp.zeros(1), step=END / steps, steps=steps)
    tension = np.asarray(ref.p)[:, 0] ** 2 + G * np.cos(np.asarray(ref.q)[:, 0])
    weights = np.array([1, *([4, 2] * (fine // 2 - 1)), 4, 1]) / (3 * fine)
    return np.array([weights @ tension[i * fine : (i + 1) * fine + 1] for i in range(intervals)])


@pytest.mark.parametrize(
    ("name", "order", "engine"),
    [("suzuki4", 4, "native"), ("yoshida4", 4, "native"), ("kahan-li6", 6, "native"), ("yoshida4", 4, "xla")],
)
@pytest.mark.soak_of("suzuki4-4-native", "yoshida4-4-xla")
def test_the_impulse_of_a_composed_step_is_the_whole_steps(name, order, engine):
    """The first part of a step of suzuki4 has .4145 of the tension, of yoshida4 1.3512."""
    errors = []
    for steps in (10, 20):
        sol = dx.simulate(
            pendulum, dx.Composition(dx.LagrangeDAlembert(), name), **START, step=END / steps, steps=steps, engine=engine
        )
        found = np.asarray(sol.multipliers)[:, 0] / sol.step
        errors.append(np.max(np.abs(np.abs(found) / mean_tension(steps) - 1)))
    assert errors[0] < 0.02
    assert np.log2(errors[0] / errors[1]) > order - 0.5


@pytest.mark.parametrize("engine", ["native", pytest.param("xla", marks=pytest.mark.soak)])
def test_symmetric_compositions_too(engine):
    """The first part had .056, .141 and .077 of the tension along one run."""
    scheme, errors = dx.SymmetricComposition(dx.PlusLagrangeDirac()), []
    for steps in (20, 40):
        sol = dx.simulate(pendulum, scheme, **START, step=END / steps, steps=steps, engine=engine)
        found = np.abs(np.asarray(sol.multipliers)[:, 0]) / sol.step
        errors.append(np.max(np.abs(found / mean_tension(steps) - 1)))
    assert errors[0] < 0.05
    assert np.log2(errors[0] / errors[1]) > 1.7


KNIFE_EDGE = dx.LagrangeDirac(
    lambda q, v: (v @ v) / 2 + 0.3 * v[2] ** 2 + q[0] + 0.2 * jnp.sin(q[1]),
    one_forms=lambda q: jnp.array([[jnp.sin(q[2]), -jnp.cos(q[2]), 0.0]]),
    forces=lambda t, q, v: -0.3 * v,
)
"""A blade on an inclined plane, with friction: one-forms and forces."""
BLADE = {"q": jnp.array([0.0, 0.0, 0.4]), "v": jnp.array([np.cos(0.4), np.sin(0.4), 1.5])}


@pytest.fixture(scope="module")
def reference():
    """q, p, work of the blade and its impulses so far, on a fine grid of 40 points, by explicit equations."""
    from scipy.integrate import solve_ivp

    inertia = np.array([1.0, 1.0, 1.6])

    def field(t, y):
        q, v = y[:3], y[3:6]
        w = np.array([np.sin(q[2]), -np.cos(q[2]), 0.0])
        turning = v[2] * (np.cos(q[2]) * v[0] + np.sin(q[2]) * v[1])
        force = np.array([1.0, 0.2 * np.cos(q[1]), 0.0]) - 0.3 * v
        multiplier = -(turning + w @ (force / inertia)) / (w @ (w / inertia))
        return [*v, *((force + multiplier * w) / inertia), -0.3 * v @ v, -multiplier]

    start = [*np.asarray(BLADE["q"]), *np.asarray(BLADE["v"]), 0.0, 0.0]
    grid = np.linspace(0, 2, 41)
    y = solve_ivp(field, (0, 2), start, t_eval=grid, rtol=1e-13, atol=1e-14, method="DOP853").y.T
    return {"q": y[:, :3], "p": y[:, 3:6] * inertia, "work": y[:, 6], "impulse": y[:, 7]}


@pytest.mark.parametrize("engine", ["native", pytest.param("xla", marks=pytest.mark.soak)])
@pytest.mark.parametrize(
    ("scheme", "order"),
    [
        (dx.Composition(dx.LagrangeDAlembert(), "suzuki4"), 4),
        (dx.Composition(dx.LagrangeDAlembert("trapezoidal"), "kahan-li6"), 6),
        (dx.SymmetricComposition(dx.PlusLagrangeDirac()), 2),
        (dx.Composition(dx.SymmetricComposition(dx.MinusLagrangeDirac()), "yoshida4"), 4),
    ],
    ids=["suzuki4", "kahan-li6", "symmetric", "symmetric-yoshida4"],
)
@pytest.mark.soak_of("suzuki4-native")
def test_with_one_forms_every_field_has_the_order_of_q(reference, engine, scheme, order):
    errors = []
    for steps in (10, 20, 40):
        sol = dx.simulate(KNIFE_EDGE, scheme, **BLADE, step=2 / steps, steps=steps, engine=engine)
        at = np.arange(0, 41, 40 // steps)
        found = {name: np.asarray(sol.fields[name]) for name in ("q", "p", "work")}
        errors.append([np.max(np.abs(found[name] - reference[name][at])) for name in found])
        errors[-1].append(np.max(np.abs(np.cumsum(np.asarray(sol.multipliers)[:, 0]) - reference["impulse"][at[1:]])))
    slopes = np.log2(np.array(errors[:-1]) / np.array(errors[1:]))
    assert np.all(slopes[-1] > order - 0.5), (errors, slopes)


@pytest.mark.soak
def test_what_happens_in_a_step_is_that_of_all_its_parts():
    """The power of a step is the energy that it adds, over h."""
    system = dx.PortHamiltonian(
        lambda x: x @ x / 2 + x[0] ** 4 / 4, jnp.array([[0.0, 1.0], [-1.0, 0.0]]), R=jnp.diag(jnp.array([0.0, 0.3]))
    )
    for engine in ("native", "xla"):
        scheme = dx.Composition(dx.DiscreteGradient(), "yoshida4")
        sol = dx.simulate(system, scheme, x=jnp.array([1.0, 0.4]), step=0.1, steps=12, engine=engine)
        stored, _, dissipated = np.asarray(sol.power).T * sol.step
        np.testing.assert_allclose(stored, np.diff(np.asarray(sol.energy())), atol=1e-14)
        np.testing.assert_allclose(dissipated, np.diff(np.asarray(sol.work)[:, 1]), atol=1e-14)


def test_the_adjoint_saves_what_happens_at_its_own_base_point():
    """The adjoint of the θ map is that of 1 − θ."""
    system = dx.PortHamiltonian(
        lambda x: x @ x / 2 + x[0] ** 4 / 4, jnp.array([[0.0, 1.0], [-1.0, 0.0]]), R=jnp.diag(jnp.array([0.0, 0.3]))
    )
    schemes = dx.Adjoint(dx.DiscreteDirac(dx.Theta(0.2))), dx.DiscreteDirac(dx.Theta(0.8))
    one, other = (dx.simulate(system, s, x=jnp.array([1.0, 0.4]), step=0.1, steps=9) for s in schemes)
    assert "power" in one.fields
    for name in one.fields:
        np.testing.assert_allclose(one.fields[name], other.fields[name], atol=1e-13)


def rows_of(engine, save_every=1, **changed):
    def run(stiffness, q):
        system = dx.LagrangeDirac(
            lambda q, v, params: v @ v / 2 - params * q[1], holonomic=lambda q: jnp.array([(q @ q - 1) / 2])
        )
        sol = dx.simulate(
            system, changed.get("scheme", dx.SymmetricComposition(dx.PlusLagrangeDirac())), q=q, v=jnp.zeros(2),
            params=stiffness, step=0.05, steps=5, save_every=save_every, engine=engine,
        )  # fmt: skip
        return jnp.sum(sol.multipliers**2) + jnp.sum(jnp.sin(sol.p)) + sol.multipliers[-1, 0]

    return run


@pytest.mark.soak
def test_gradients_of_composed_rows():
    """The same by both engines, forward and backward, and by differences."""
    save_every = 2
    at = (jnp.array(9.81), START["q"])
    native, xla = (jax.grad(rows_of(engine, save_every), argnums=(0, 1))(*at) for engine in ("native", "xla"))
    forward = jax.jacfwd(rows_of("native", save_every))(*at)
    for a, b in zip(native, xla, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-9)
    np.testing.assert_allclose(forward, native[0], rtol=1e-9)
    run, e = rows_of("native", save_every), 1e-5
    np.testing.assert_allclose((run(9.81 + e, at[1]) - run(9.81 - e, at[1])) / (2 * e), native[0], rtol=1e-6)


@pytest.mark.soak
def test_the_engines_agree_in_batches_and_where_a_run_fails():
    batch = {name: jnp.stack([a, a]) for name, a in START.items()}
    batch["q"] = batch["q"].at[1].set(jnp.array([np.sin(0.9), -np.cos(0.9)]))
    scheme = dx.Composition(dx.SymmetricComposition(dx.PlusLagrangeDirac()), "suzuki4")
    one, other = (
        dx.simulate(pendulum, scheme, **batch, step=0.1, steps=8, save_every=3, engine=engine) for engine in ("native", "xla")
    )
    alone = dx.simulate(pendulum, scheme, **START, step=0.1, steps=8, save_every=3, engine="native")
    for name in one.fields:
        np.testing.assert_allclose(one.fields[name], other.fields[name], atol=1e-12)
        np.testing.assert_array_equal(np.asarray(one.fields[name])[0], alone.fields[name])


MIDPOINT = dx.LagrangeDAlembert()
SKATE = dx.LagrangeDirac(lambda q, v: v @ v / 2 - q[0] / 2, lambda q: jnp.array([[jnp.sin(q[2]), -jnp.cos(q[2]), 0.0]]))
SKATING = {"q": [0.0, 0.0, 0.0], "v": [1.0, 0.0, 1.0]}


def skated(t):
    """(p, ∫λ dt) of the skate, which turns by φ = t and goes with u = 1 − sin(t)/2 along (cos t, sin t)."""
    u = 1 - np.sin(t) / 2
    return np.stack([u * np.cos(t), u * np.sin(t), np.ones_like(t)], axis=1), 1 - np.cos(t) - t


@pytest.mark.soak
def test_method_1_has_its_order_in_momenta_and_multipliers_too():
    """What is off the constraint in p changes its sign in every plain step, and stayed of order 2."""
    systems = SKATE, dx.NonholonomicMechanics(lambda q: jnp.eye(3), lambda q: q[0] / 2, lambda q: SKATE.one_forms(q, None))
    for system, (name, order) in zip(systems, [("suzuki4", 4), ("kahan-li6", 6)], strict=True):
        errors = []
        for steps in (5, 10):
            sol = dx.simulate(system, dx.Composition(dx.DiscreteDirac(), name), **SKATING, step=2 / steps, steps=steps)
            p, impulse = skated(np.asarray(sol.t))
            found = np.cumsum(np.asarray(sol.multipliers)[:, 0]) * sol.step
            errors.append([np.abs(sol.p - p).max() + 1e-15, np.abs(found - impulse[1:]).max(), np.ptp(sol.energy()) + 1e-15])
        slopes = np.log2(np.array(errors[0]) / np.array(errors[1]))
        assert errors[1][0] < 1e-13 or slopes[0] > order - 0.5
        assert slopes[1] > order - 0.6, (errors, slopes)
        assert errors[1][2] < 1e-12


def test_the_adjoint_of_the_midpoint_scheme_is_itself():
    """With one-forms its p was the one before the jump at a node, of order 1."""
    one, other = (dx.simulate(SKATE, s, **SKATING, step=0.02, steps=50) for s in (MIDPOINT, dx.Adjoint(MIDPOINT)))
    for name in one.fields:
        np.testing.assert_allclose(one.fields[name], other.fields[name], atol=1e-14)


BEAD = dx.DiracSystem(
    dx.induced_dirac(None, 2),
    lambda x: x[2:] @ x[2:] / 2 + x[1],
    holonomic=lambda x: jnp.array([(x[0] ** 2 + 2 * x[1] ** 2 - 2) / 2]),
)


def test_steps_that_leave_the_constraints_of_a_system_in_x_do_not_compose():
    port = lambda more: dx.PortHamiltonian(
        lambda x: x @ x / 2 + x[0] ** 4 / 4 + more * x[2] ** 4,
        J=jnp.array([[0, 1.0, 0], [-1, 0, 0], [0, 0, 0]]),
        B=lambda x: jnp.array([[0.0], [1.0], [1.0]]),
        closed=True,
    )
    scheme, run = dx.Composition(dx.DiscreteDirac(), "suzuki4"), {"step": 0.1, "steps": 2}
    for system, x in ((BEAD, [0.0, -1.0, 0.8, 0.0]), (port(1.0), [0.5, 0.2 + 4 * 0.2**3, -0.2])):
        with pytest.raises(ValueError, match=r"leaves those of this \w+, by .* turns into its opposite.*constraints=\"resolve\""):
            dx.simulate(system, scheme, x=x, **run)
        assert dx.simulate(system, scheme, x=x, check_initial=False, **run).ok
    assert dx.simulate(port(0.0), scheme, x=[0.5, 0.2, -0.2], **run).ok  # y is linear, and is kept
