"""Forces by the discrete Lagrange–d'Alembert principle: closed forms of driven and damped motion, and the energy book."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import dirax as dx
from dirax.diagnostics.verify import verify

GAMMA, OMEGA, DRIVE, NU = 0.1, 1.3, 0.7, 0.9
Q0, V0 = 1.0, 0.2


def driven(t):
    """(q, q̇) of q̈ + 2γq̇ + ω²q = F cos νt."""
    amplitude = DRIVE / (OMEGA**2 - NU**2 + 2j * GAMMA * NU)
    damped = np.sqrt(OMEGA**2 - GAMMA**2)
    c = Q0 - amplitude.real
    s = (V0 - (1j * NU * amplitude).real + GAMMA * c) / damped
    free = (c - 1j * s) * np.exp((-GAMMA + 1j * damped) * t)
    steady = amplitude * np.exp(1j * NU * t)
    return (free + steady).real, ((-GAMMA + 1j * damped) * free + 1j * NU * steady).real


OSCILLATOR = dx.LagrangeDirac(
    lambda q, v: v @ v / 2 - OMEGA**2 * q @ q / 2, forces=lambda t, q, v: -2 * GAMMA * v + DRIVE * jnp.cos(NU * t)
)

# a pendulum with a q-dependent mass in the plane, dragged quadratically and pushed by a control with parameters
FREE = lambda q, v, params: (1 + q[0] ** 2 / 4) * v[0] ** 2 / 2 + v[1] ** 2 / 2 + v[0] * v[1] * jnp.sin(q[1]) / 3 + jnp.cos(q[0])


def push(t, q, v, params):
    return jnp.stack([-params * v[0] * jnp.sqrt(1 + v @ v), jnp.sin(t) * q[0] - params * v[1]])


NONLINEAR = dx.LagrangeDirac(FREE, forces=push)
START = {"q": np.array([0.4, -0.2]), "v": np.array([0.3, 0.5])}


def nonlinear_reference(end: float, params: float) -> tuple[np.ndarray, np.ndarray, float]:
    """(q, p, work) by DOP853, derivatives written out."""

    def mass(q):
        coupling = np.sin(q[1]) / 3
        return np.array([[1 + q[0] ** 2 / 4, coupling], [coupling, 1.0]])

    def rates(t, y):
        q, v = y[:2], y[2:4]
        f = np.array([-params * v[0] * np.sqrt(1 + v @ v), np.sin(t) * q[0] - params * v[1]])
        coupling_rate = np.cos(q[1]) / 3 * v[1]
        dq = np.array([q[0] * v[0] ** 2 / 4 - np.sin(q[0]), v[0] * v[1] * np.cos(q[1]) / 3])
        mass_rate = np.array([[q[0] * v[0] / 2, coupling_rate], [coupling_rate, 0.0]])
        return np.concatenate([v, np.linalg.solve(mass(q), dq + f - mass_rate @ v), [f @ v]])

    start = np.concatenate([START["q"], START["v"], [0.0]])
    y = solve_ivp(rates, (0, end), start, method="DOP853", rtol=1e-13, atol=1e-13).y[:, -1]
    return y[:2], mass(y[:2]) @ y[2:4], y[4]


def slopes(errors) -> np.ndarray:
    """log2 of successive ratios, for halved steps."""
    errors = np.asarray(errors)
    return np.log2(errors[:-1] / errors[1:])


SCHEMES = [
    (dx.LagrangeDAlembert("midpoint"), 2),
    (dx.LagrangeDAlembert("trapezoidal"), 2),
    (dx.PlusLagrangeDirac("left"), 1),
    (dx.MinusLagrangeDirac("right"), 1),
    (dx.LagrangeDAlembert(lambda q0, q1, h: (q1 - q0) @ (q1 - q0) / h / 2 - h * OMEGA**2 * (q0 @ q0 + q1 @ q1) / 4), 2),
    (dx.DiscreteDirac(), 2),
    (dx.DiscreteDirac(dx.Theta(0.3)), 1),
    (dx.Composition(dx.LagrangeDAlembert("trapezoidal"), "suzuki4"), 4),
    (dx.SymmetricComposition(dx.PlusLagrangeDirac("left")), 2),
]


@pytest.mark.parametrize(("scheme", "order"), SCHEMES)
def test_driven_damped_oscillator_against_its_closed_form(scheme, order):
    errors = []
    for steps in (40, 80, 160):
        sol = dx.simulate(OSCILLATOR, scheme, q=[Q0], v=[V0], step=4.0 / steps, steps=steps)
        q, v = driven(sol.t)
        errors.append((np.max(np.abs(sol.q[:, 0] - q)), np.max(np.abs(sol.p[:, 0] - v))))
    assert slopes(errors) == pytest.approx(order, abs=0.1)
    assert np.max(errors[-1]) < {1: 0.1, 2: 1e-3, 4: 1e-5}[order]


@pytest.mark.parametrize("scheme", [dx.LagrangeDAlembert("midpoint"), dx.LagrangeDAlembert("trapezoidal"), dx.DiscreteDirac()])
def test_a_nonlinear_system_in_q_p_and_the_work(scheme):
    q, p, work = nonlinear_reference(2.0, 0.3)
    errors, book = [], []
    for steps in (40, 80, 160):
        sol = dx.simulate(NONLINEAR, scheme, step=2.0 / steps, steps=steps, params=0.3, **START)
        errors.append((np.max(np.abs(sol.q[-1] - q)), np.max(np.abs(sol.p[-1] - p)), abs(sol.work[-1] - work)))
        book.append(np.max(np.abs(sol.energy() - sol.energy()[0] - sol.work)))
    assert slopes(errors) == pytest.approx(2.0, abs=0.15)
    assert slopes(book) == pytest.approx(2.0, abs=0.15)
    assert sol.work[0] == 0.0 and np.max(errors[-1]) < 1e-4


@pytest.mark.parametrize("rule", ["left", "right", "midpoint", "trapezoidal"])
def test_the_force_of_a_potential_is_the_potential(rule):
    """f_d^± of f = −∂V/∂q is −∂_{1,2} of the rule's quadrature of V: the same trajectory, exactly."""
    V = lambda q: jnp.cos(q[0]) * q[1] ** 2 + q[0] ** 4 / 4
    kinetic = lambda q, v: v @ v / 2 + v[0] * v[1] * q[0] / 5
    inside = dx.LagrangeDirac(lambda q, v: kinetic(q, v) - V(q))
    outside = dx.LagrangeDirac(kinetic, forces=lambda t, q, v: -jax.grad(V)(q))
    one, other = (dx.simulate(s, dx.LagrangeDAlembert(rule), step=0.05, steps=60, **START) for s in (inside, outside))
    np.testing.assert_allclose(one.q, other.q, atol=1e-12)
    np.testing.assert_allclose(one.p, other.p, atol=1e-12)
    two = dx.simulate(outside, dx.LagrangeDAlembert(rule), q0=one.q[0], q1=one.q[1], step=0.05, steps=60)
    np.testing.assert_allclose(two.q, one.q, atol=1e-12)
    assert two.work[0] == 0.0 and two.work[1] == pytest.approx(other.work[1], abs=1e-13)


def test_forces_together_with_nonholonomic_constraints():
    """A skate dragged by −γv on a line of its own: u̇ = −γu along the heading, which turns evenly: a spiral in closed form."""
    gamma, turn, u0 = 0.4, 1.5, 1.2
    skate = dx.LagrangeDirac(
        lambda q, v: v @ v / 2,
        lambda q: jnp.stack([jnp.sin(q[2]), -jnp.cos(q[2]), 0.0 * q[0]])[None],
        forces=lambda t, q, v: -gamma * v * jnp.array([1.0, 1.0, 0.0]),
    )
    mechanics = dx.NonholonomicMechanics(
        lambda q: jnp.eye(3), lambda q: 0.0 * q[0], skate.one_forms.function, forces=skate.forces.function
    )
    cases = [(skate, dx.LagrangeDAlembert()), (skate, dx.DiscreteDirac()), (skate, dx.DiscreteDirac(constraints="resolve"))]
    for system, scheme in [*cases, (mechanics, dx.DiscreteDirac(constraints="resolve"))]:
        errors = []
        for steps in (30, 60, 120):
            sol = dx.simulate(system, scheme, q=[0.0, 0.0, 0.0], v=[u0, 0.0, turn], step=2.0 / steps, steps=steps)
            path = u0 * (1 - np.exp((-gamma + 1j * turn) * sol.t)) / (gamma - 1j * turn)
            speed = u0 * np.exp((-gamma + 1j * turn) * sol.t)
            work = u0**2 * (np.exp(-2 * gamma * sol.t) - 1) / 2
            pairs = ((sol.q[:, 0] + 1j * sol.q[:, 1], path), (sol.p[:, 0] + 1j * sol.p[:, 1], speed), (sol.work, work))
            errors.append([np.max(np.abs(found - known)) for found, known in pairs])
        assert slopes(errors) == pytest.approx(2.0, abs=0.2), scheme


@pytest.mark.soak
def test_engines_batches_and_gradients_agree():
    scheme, run = dx.LagrangeDAlembert(), {"step": 0.05, "steps": 40}
    batch = {"q": np.stack([START["q"], 2 * START["q"]]), "v": np.stack([START["v"], -START["v"]])}
    native, xla = (dx.simulate(NONLINEAR, scheme, params=0.3, engine=e, **batch, **run) for e in ("native", "xla"))
    for name in ("q", "p", "work"):
        np.testing.assert_allclose(native.fields[name], xla.fields[name], atol=1e-13)
    alone = dx.simulate(NONLINEAR, scheme, params=0.3, **START, **run)
    np.testing.assert_array_equal(alone.work, native.work[0])

    end = lambda drag: dx.simulate(NONLINEAR, scheme, params=drag, **START, **run).work[-1]
    slope = jax.jit(jax.grad(end))(0.3)
    assert slope == pytest.approx((float(end(0.3 + 1e-5)) - float(end(0.3 - 1e-5))) / 2e-5, rel=1e-8)


def test_verify_judges_the_energy_less_the_work():
    sol = dx.simulate(OSCILLATOR, dx.LagrangeDAlembert(), q=[Q0], v=[V0], step=0.01, steps=3000)
    report = verify(sol)
    assert report.ok, report
    assert np.ptp(sol.energy()) > 0.1
    assert report["energy"].verdict == "bounded" and "less the work" in report["energy"].explanation
    assert report["discrete Dirac structure"].verdict == report["saved p"].verdict == "ok"
    assert report["symplecticity of one step"].verdict == "not checked"
    for scheme in (dx.PlusLagrangeDirac(), dx.MinusLagrangeDirac("trapezoidal")):
        report = verify(dx.simulate(NONLINEAR, scheme, step=0.01, steps=20, params=0.3, **START))
        assert report.ok and report.lines[1].verdict == "ok", report


def test_compare_takes_the_work_off_the_energy():
    entry = dx.compare(OSCILLATOR, [dx.LagrangeDAlembert()], q=[Q0], v=[V0], step=0.02, steps=2000).entries[0]
    assert entry.energy_band < 1e-12 and entry.drift == "bounded"


def test_work_is_kept_with_rows_left_out_and_in_a_dataset():
    every = dx.simulate(NONLINEAR, dx.LagrangeDAlembert(), step=0.05, steps=40, params=0.3, **START)
    some = dx.simulate(NONLINEAR, dx.LagrangeDAlembert(), step=0.05, steps=40, params=0.3, save_every=10, **START)
    np.testing.assert_array_equal(some.work, every.work[::10])
    assert some.to_xarray()["work"].dims == ("time",)


def test_bad_forces():
    oscillator = lambda **more: dx.LagrangeDirac(lambda q, v: v @ v / 2, **more)
    with pytest.raises(TypeError, match=r"forces must have the signature forces\(t, q, v\[, params\]\)"):
        oscillator(forces=lambda q, v: v)
    run = lambda system: dx.simulate(system, dx.LagrangeDAlembert(), q=[1.0, 0.0], v=[0.0, 1.0], step=0.1, steps=2)
    with pytest.raises(ValueError, match=r"forces\(t, q, v\) must return shape \(2,\)"):
        run(oscillator(forces=lambda t, q, v: v[:1]))
    with pytest.raises(ValueError, match="first step is not finite"):
        run(oscillator(forces=lambda t, q, v: v / (q[1] * 0.0)))
    late = dx.simulate(
        oscillator(forces=lambda t, q, v: v * jnp.sqrt(1.0 - t)), dx.LagrangeDAlembert(), q=[1.0], v=[1.0], step=0.1, steps=20
    )
    assert not late.ok and late.t[-1] == pytest.approx(1.0) and np.all(np.isfinite(late.work))
