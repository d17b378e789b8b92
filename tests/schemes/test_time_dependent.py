"""Lagrangians and constraints that depend on time, and affine constraints: closed forms, and tight scipy integrations."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import dirax as dx
from dirax import gallery
from dirax.diagnostics.verify import verify
from dirax.gallery import turntable
from dirax.program.user_functions import UserFunction


def slopes(errors) -> np.ndarray:
    """log2 of successive ratios, for halved steps."""
    errors = np.asarray(errors)
    return np.log2(errors[:-1] / errors[1:])


# ------------------------------------------------------------------------------------------------- time in the Lagrangian

GAMMA, OMEGA, T0 = 0.15, 1.2, 0.7
DAMPED = np.sqrt(OMEGA**2 - GAMMA**2)
CALDIROLA = dx.LagrangeDirac(lambda t, q, v: jnp.exp(2 * GAMMA * t) * (v @ v - OMEGA**2 * q @ q) / 2)


def damped(t):
    """(q, p) of L = e^{2γt}(q̇² − ω²q²)/2 (Caldirola, Kanai): q̈ + 2γq̇ + ω²q = 0, from q = 1, q̇ = 0.3 at T0."""
    amplitude = 1.0 - 1j * (0.3 + GAMMA) / DAMPED
    q = amplitude * np.exp((-GAMMA + 1j * DAMPED) * (t - T0))
    return q.real, np.exp(2 * GAMMA * t) * ((-GAMMA + 1j * DAMPED) * q).real


def two_points(t, q0, q1, h):
    """The trapezoidal L_d of it, as a user's."""
    kinetic, ends = (q1 - q0) @ (q1 - q0) / h, jnp.exp(2 * GAMMA * t) * q0 @ q0 + jnp.exp(2 * GAMMA * (t + h)) * q1 @ q1
    return (jnp.exp(2 * GAMMA * t) + jnp.exp(2 * GAMMA * (t + h))) / 4 * kinetic - h * OMEGA**2 * ends / 4


SCHEMES = [
    (dx.LagrangeDAlembert("midpoint"), 2),
    (dx.LagrangeDAlembert("trapezoidal"), 2),
    (dx.LagrangeDAlembert(two_points), 2),
    (dx.PlusLagrangeDirac("left"), 1),
    (dx.MinusLagrangeDirac("right"), 1),
    (dx.DiscreteDirac(), 2),
    (dx.Composition(dx.LagrangeDAlembert("midpoint"), "suzuki4"), 4),
    (dx.SymmetricComposition(dx.PlusLagrangeDirac("left")), 2),
    (dx.SymmetricComposition(dx.LagrangeDAlembert(two_points)), 2),
]


@pytest.mark.parametrize(("scheme", "order"), SCHEMES)
def test_a_mass_that_grows_with_time(scheme, order):
    errors = []
    p0 = damped(T0)[1]
    for steps in (40, 80, 160):
        sol = dx.simulate(CALDIROLA, scheme, q=[1.0], p=[p0], t0=T0, step=4.0 / steps, steps=steps)
        q, p = damped(sol.t)
        errors.append((np.max(np.abs(sol.q[:, 0] - q)), np.max(np.abs(sol.p[:, 0] - p))))
    assert slopes(errors) == pytest.approx(order, abs=0.1)
    q, v = sol.q[:, 0], sol.p[:, 0] * np.exp(-2 * GAMMA * sol.t)
    np.testing.assert_allclose(sol.energy(), np.exp(2 * GAMMA * sol.t) * (v**2 + OMEGA**2 * q**2) / 2, rtol=1e-13)


def test_a_function_of_the_user_is_its_rule():
    run = {"q": [1.0], "v": [0.3], "t0": T0, "step": 0.1, "steps": 50}
    own, named = (dx.simulate(CALDIROLA, dx.LagrangeDAlembert(rule), **run) for rule in (two_points, "trapezoidal"))
    np.testing.assert_allclose(own.q, named.q, atol=1e-13)
    two = dx.simulate(CALDIROLA, dx.LagrangeDAlembert("trapezoidal"), **{**run, "q": None, "v": None}, q0=own.q[0], q1=own.q[1])
    np.testing.assert_allclose(two.q, named.q, atol=1e-12)
    report = verify(own)
    assert report.ok and report["discrete Dirac structure"].verdict == "ok", report
    assert report["symplecticity of one step"].verdict == "ok"
    assert report["energy"].verdict == "not checked" and "depends on time" in report["energy"].explanation


def test_a_nonlinear_parametric_pendulum_on_both_engines_and_in_a_batch():
    """q̈ + (1 + ε cos νt) sin q = 0, a nonlinear Mathieu equation, against DOP853."""
    system = dx.LagrangeDirac(lambda t, q, v, params: v @ v / 2 + (1 + params * jnp.cos(2.1 * t)) * jnp.cos(q[0]))
    start = np.array([1.1, 0.2])
    field = lambda t, y: [y[1], -(1 + 0.4 * np.cos(2.1 * t)) * np.sin(y[0])]
    y = solve_ivp(field, (0.5, 4.5), start, method="DOP853", rtol=1e-13, atol=1e-13).y[:, -1]
    errors = []
    for steps in (80, 160, 320):
        run = {"q": start[:1], "v": start[1:], "params": 0.4, "t0": 0.5, "step": 4.0 / steps, "steps": steps}
        sol = dx.simulate(system, dx.LagrangeDAlembert(), **run)
        errors.append((abs(sol.q[-1, 0] - y[0]), abs(sol.p[-1, 0] - y[1])))
    assert slopes(errors) == pytest.approx(2.0, abs=0.1)
    both = [dx.simulate(system, dx.LagrangeDAlembert(), engine=e, **run) for e in ("native", "xla")]
    np.testing.assert_allclose(both[0].q, both[1].q, atol=1e-12)
    many = dx.simulate(system, dx.LagrangeDAlembert(), **{**run, "params": np.array([0.4, 0.1])}, batch_params=True)
    np.testing.assert_array_equal(many.q[0], sol.q)
    np.testing.assert_allclose(many.energy()[0], sol.energy(), rtol=1e-13)
    later = dx.simulate(
        system, dx.LagrangeDAlembert(), **{**run, "q": sol.q[100], "v": None, "p": sol.p[100], "t0": sol.t[100], "steps": 100}
    )
    np.testing.assert_allclose(later.q[-1], sol.q[200], atol=1e-12)
    end = lambda eps: dx.simulate(system, dx.LagrangeDAlembert(), **{**run, "params": eps, "steps": 40}).q[-1, 0]
    assert jax.jit(jax.grad(end))(0.4) == pytest.approx((float(end(0.4 + 1e-5)) - float(end(0.4 - 1e-5))) / 2e-5, rel=1e-7)


# ----------------------------------------------------------------------------------------------- time in the constraints

HEADING = dx.LagrangeDirac(lambda q, v: v @ v / 2, lambda t, q: jnp.stack([jnp.sin(t), -jnp.cos(t)])[None])


@pytest.mark.parametrize(
    ("scheme", "order", "of_p"),
    [
        (dx.LagrangeDAlembert("midpoint", "midpoint"), 2, 2),
        (
            dx.LagrangeDAlembert(
                "trapezoidal", lambda t, q0, q1, h: jnp.stack([jnp.sin(t + h / 2), -jnp.cos(t + h / 2)])[None] @ (q1 - q0) / h
            ),
            2,
            2,
        ),
        (dx.PlusLagrangeDirac("left"), 1, 1),
        (dx.MinusLagrangeDirac("left"), 1, 1),
        (dx.DiscreteDirac(), 2, 2),
        (dx.DiscreteDirac(constraints="resolve"), 2, 2),
    ],
)
@pytest.mark.soak_of("scheme0-2-2")
def test_a_particle_with_a_prescribed_heading_goes_round_a_circle(scheme, order, of_p):
    """sin t dx − cos t dy = 0: the speed is constant, q = (sin t, 1 − cos t), and the force is that of the turn, 1."""
    errors = []
    for steps in (50, 100, 200):
        sol = dx.simulate(HEADING, scheme, q=[0.0, 0.0], v=[1.0, 0.0], step=2.0 / steps, steps=steps)
        t, h = sol.t, 2.0 / steps
        force = sol.multipliers[1:, 0] * (-1.0 if isinstance(scheme, dx.DiscreteDirac) else 1.0 / h)
        errors.append(
            (
                np.max(np.abs(sol.q - np.stack([np.sin(t), 1 - np.cos(t)], 1))),
                np.max(np.abs(sol.p - np.stack([np.cos(t), np.sin(t)], 1))) + 1e-12,
                np.max(np.abs(force - 1.0)) + 1e-12,
            )
        )
    measured = slopes(errors)
    assert measured[:, 0] == pytest.approx(order, abs=0.1)
    assert np.all((measured[:, 1:] > order - 0.1) | (np.array(errors)[1:, 1:] < 1e-11))
    if scheme != dx.LagrangeDAlembert():
        return
    report = verify(sol)
    assert report.ok and report["energy"].verdict == "not checked", report
    assert report["structural relation φ*Ω = Ω + dβ"].verdict == "ok"


# -------------------------------------------------------------------------------------------------- affine constraints

SPIN = 1.4


def table(q, params):
    """A homogeneous ball on a table that turns with Ω: q = (x, y) and ∫ω dt, ẋ − ω_y = −Ωy, ẏ + ω_x = Ωx (radius 1)."""
    return jnp.array([[1.0, 0.0, 0.0, -1.0], [0.0, 1.0, 1.0, 0.0]])


TURNTABLE = dx.LagrangeDirac(
    lambda q, v: (v[:2] @ v[:2] + 0.4 * v[2:] @ v[2:]) / 2,
    table,
    affine=lambda q, params: params * jnp.stack([q[1], -q[0]]),
)
CENTRE = np.array([0.5, -0.3, 0.0, 0.0])
VELOCITY = np.array([0.2, 0.7, SPIN * 0.5 - 0.7, 0.2 + SPIN * -0.3])


@pytest.mark.parametrize(
    ("scheme", "order"),
    [
        (dx.LagrangeDAlembert(), 2),
        (dx.PlusLagrangeDirac("left"), 1),
        (dx.MinusLagrangeDirac("left"), 1),
        (dx.DiscreteDirac(), 2),
        (dx.DiscreteDirac(constraints="resolve"), 2),
    ],
)
@pytest.mark.soak_of("scheme0-2")
def test_a_ball_on_a_turntable_goes_round_with_two_sevenths_of_its_frequency(scheme, order):
    """z̈ = (2/7)iΩż for z = x + iy: a circle, from any velocity (Earnshaw; Neimark, Fufaev)."""
    rate, z0, u0 = 2 * SPIN / 7, CENTRE[0] + 1j * CENTRE[1], VELOCITY[0] + 1j * VELOCITY[1]
    errors = []
    for steps in (60, 120, 240):
        sol = dx.simulate(TURNTABLE, scheme, q=CENTRE, v=VELOCITY, params=SPIN, step=6.0 / steps, steps=steps)
        z = z0 + u0 * (np.exp(1j * rate * sol.t) - 1) / (1j * rate)
        u = u0 * np.exp(1j * rate * sol.t)
        # the constraint force on the centre is its acceleration
        force = sol.multipliers[1:] @ np.array([1.0, 1j]) * (1.0 if isinstance(scheme, dx.DiscreteDirac) else -steps / 6.0)
        at = sol.t[1:-1] + (sol.t[1] / 2 if isinstance(scheme, dx.DiscreteDirac) else 0.0)
        found = (
            sol.q[:, 0] + 1j * sol.q[:, 1] - z,
            sol.p[:, 0] + 1j * sol.p[:, 1] - u,
            force - 1j * rate * u0 * np.exp(1j * rate * at),
        )
        errors.append([np.max(np.abs(e)) for e in found])
    assert slopes(errors) == pytest.approx(order, abs=0.15)
    if scheme != dx.LagrangeDAlembert():
        return
    report = verify(sol)
    assert report.ok, report
    assert report["energy"].verdict == "not checked" and "affine" in report["energy"].explanation


def test_the_gallery_has_it_in_euler_angles():
    example, errors = gallery.get("turntable"), []
    for steps in (100, 200, 400):
        sol = example.simulate(step=4.0 / steps, steps=steps)
        errors.append(np.max(np.abs(sol.q[:, :2] - turntable.exact(sol.t, example.initial["q"], example.initial["v"]))))
    assert slopes(errors) == pytest.approx(2.0, abs=0.1)
    assert np.max(np.abs(sol.constraint)) < 1e-14


@pytest.mark.soak
def test_projection_onto_affine_constraints_and_engines():
    sol = dx.simulate(
        TURNTABLE, dx.LagrangeDAlembert(), q=CENTRE, v=[1.0, 0.0, 0.0, 0.0], params=SPIN, step=0.1, steps=30, project=True
    )
    assert np.max(np.abs(sol.constraint)) < 1e-14
    other = dx.simulate(TURNTABLE, dx.LagrangeDAlembert(), q=CENTRE, p=sol.p[0], params=SPIN, step=0.1, steps=30, engine="xla")
    np.testing.assert_allclose(sol.q, other.q, atol=1e-13)
    np.testing.assert_allclose(sol.multipliers, other.multipliers, atol=1e-13)
    with pytest.raises(ValueError, match=r"off the constraint, whose residual is \[ 0.58"):
        dx.simulate(TURNTABLE, dx.LagrangeDAlembert(), q=CENTRE, v=[1.0, 0.0, 0.0, 0.0], params=SPIN, step=0.1, steps=3)


# ------------------------------------------------------------------------------------------------------- the time argument


def test_time_is_recognised_by_its_name():
    takes = lambda f: (
        UserFunction(f, "lagrangian", ("q", "v"), timed=True).takes_time,
        UserFunction(f, "lagrangian", ("q", "v"), timed=True).takes_params,
    )
    assert takes(lambda q, v: 0.0) == (False, False)
    assert takes(lambda q, v, params: 0.0) == (False, True)
    assert takes(lambda t, q, v: 0.0) == (True, False)
    assert takes(lambda t, q, v, params: 0.0) == (True, True)
    with pytest.raises(TypeError, match=r"takes \(t, v\), where t stands in the place of q"):  # there is no room for another one
        takes(lambda t, v: 0.0)
    with pytest.raises(TypeError, match=r"lagrangian\(q, v\[, params\]\) or lagrangian\(t, q, v\[, params\]\), but"):
        dx.LagrangeDirac(lambda q: q @ q)
    assert repr(dx.LagrangeDirac(lambda t, q, v: 0.0)) == "LagrangeDirac(lagrangian=lambda(t, q, v), one_forms=None)"


def test_bad_affine_and_timed_functions():
    L = lambda q, v: v @ v / 2
    forms = lambda q: jnp.array([[1.0, q[0], 0.0]])
    with pytest.raises(ValueError, match="no one_forms were given"):
        dx.LagrangeDirac(L, affine=lambda q: q)
    run = lambda system, **more: dx.simulate(
        system, dx.LagrangeDAlembert(), q=[0.0] * 3, v=[0.0, 0.0, 1.0], step=0.1, steps=2, **more
    )
    with pytest.raises(ValueError, match=r"affine\(q\) must return shape \(1,\), one number a row of W\(q\) of shape \(1, 3\)"):
        run(dx.LagrangeDirac(L, forms, affine=lambda q: q))
    with pytest.raises(ValueError, match="affine is not finite at the initial data"):
        run(dx.LagrangeDirac(L, forms, affine=lambda q: jnp.log(q[:1] - 1.0)))
    with pytest.raises(ValueError, match=r"must return a scalar"):
        run(dx.LagrangeDirac(lambda t, q, v: v))
    with pytest.raises(ValueError, match="lagrangian is nan at the initial data"):
        run(dx.LagrangeDirac(lambda t, q, v: v @ v / 2 + jnp.log(t)), t0=-1.0)
