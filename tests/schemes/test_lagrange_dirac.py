"""The (±)-discrete Lagrange–Dirac schemes against equations written out by hand, closed forms, and other integrators.

Nothing here is differentiated by JAX except inside dirax: derivatives are written out, and the oracles are numpy in
extended precision, closed forms of the difference equations, or scipy's DOP853 at tight tolerance.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

import dirax as dx
from dirax import gallery
from dirax.schemes.step import Shape

EPS = np.finfo(float).eps
RULES = ("left", "right", "midpoint", "trapezoidal")
BASES = ("left", "right", "midpoint")

# ------------------------------------------------------------------------------------ the vertical rolling disk, [PY] §8.1

M, R, I, J = 1.0, 1.0, 0.25, 0.5


def disk_one_forms(q):
    return jnp.array([[1.0, 0.0, -R * jnp.cos(q[3]), 0.0], [0.0, 1.0, -R * jnp.sin(q[3]), 0.0]])


def disk_lagrangian(q, v, params):
    return M * (v[0] ** 2 + v[1] ** 2) / 2 + I * v[2] ** 2 / 2 + J * v[3] ** 2 / 2 - params * jnp.sin(q[2])


DISK = dx.LagrangeDirac(disk_lagrangian, disk_one_forms)  # q = (x, y, θ, φ); params: the strength of the potential, 10
DISK_H, DISK_STEPS = 1e-3, 50_000
DISK_Q0 = np.array([0.0, 0.0, 0.0, np.pi / 3])
DISK_Q1 = np.array([0.005, 0.0086603, 0.01, 1.0481976])


@pytest.fixture(scope="module", params=["plus", "minus"])
def disk(request):
    """(name, solution): the paper's run to t = 50 from its two points, which lie on neither constraint exactly."""
    scheme = {"plus": dx.PlusLagrangeDirac(), "minus": dx.MinusLagrangeDirac()}[request.param]
    sol = dx.simulate(DISK, scheme, q0=DISK_Q0, q1=DISK_Q1, params=10.0, step=DISK_H, steps=DISK_STEPS, check_initial=False)
    assert sol.ok
    return request.param, sol


def disk_by_hand(sign: str, steps: int) -> np.ndarray:
    """The printed equations solved for θ_{k+1} in extended precision, positions (steps + 1, 4).

    μ is eliminated with (cos φ_k, sin φ_k, 1/R), the constraint gives Δx, Δy from Δθ, and φ is linear.
    """
    h, one = np.longdouble(DISK_H), np.longdouble(1)
    q = [DISK_Q0.astype(np.longdouble), DISK_Q1.astype(np.longdouble)]
    v = (q[1] - q[0]) / h
    for _ in range(steps - 1):
        _, _, theta, phi = q[-1]
        after = phi + h * v[3]
        base = after if sign == "plus" else phi
        spin = I * v[2] + R * M * (np.cos(phi) * v[0] + np.sin(phi) * v[1]) - 10 * h * np.cos(theta)
        rate = spin / (I + M * R**2 * (np.cos(after - phi) if sign == "plus" else one))
        v = np.array([R * np.cos(base) * rate, R * np.sin(base) * rate, rate, v[3]])
        q.append(q[-1] + h * v)
    return np.array(q)


def test_disk_ends_where_it_must(disk):
    """The paper's run recomputed independently, and the same in extended precision here."""
    name, sol = disk
    theta, x, y = {
        "plus": (502.8505732333817, -1.4295644891416, -2.2326919734974),
        "minus": (492.6224966390171, -1.8217193418493, -2.0521984078154),
    }[name]
    assert sol.q.shape == (DISK_STEPS + 1, 4)
    np.testing.assert_allclose(sol.q[-1, :3], [x, y, theta], atol=1e-6, rtol=0)
    by_hand = disk_by_hand(name, 5000)
    np.testing.assert_allclose(sol.q[:5001], by_hand.astype(float), atol=1e-9, rtol=0)


def test_disk_satisfies_the_printed_equations(disk):
    """The second-order equations of [PY] §8.1 for k = 1, …, N − 1, with the multipliers that the solution saves."""
    name, sol = disk
    h, (x, y, theta, phi) = DISK_H, sol.q.T
    mu1, mu2 = sol.multipliers[1:].T
    bend = lambda a: 2 * a[1:-1] - a[:-2] - a[2:]
    cos, sin = np.cos(phi[1:-1]), np.sin(phi[1:-1])
    rounding = lambda scale, a: 8 * EPS * scale / h * np.max(np.abs(a))
    assert np.max(np.abs(M / h * bend(x) - mu1)) < rounding(M, x)
    assert np.max(np.abs(M / h * bend(y) - mu2)) < rounding(M, y)
    spin = I / h * bend(theta) - 10 * h * np.cos(theta[1:-1])
    assert np.max(np.abs(spin + R * (mu1 * cos + mu2 * sin))) < rounding(I, theta)
    assert np.max(np.abs(J / h * bend(phi))) < rounding(J, phi)
    base = phi[2:] if name == "plus" else phi[1:-1]
    step = lambda a: (a[2:] - a[1:-1]) / h
    assert np.max(np.abs(step(x) - R * np.cos(base) * step(theta))) < rounding(1, x) + rounding(R, theta)
    assert np.max(np.abs(step(y) - R * np.sin(base) * step(theta))) < rounding(1, y) + rounding(R, theta)


def test_disk_satisfies_53_and_54(disk):
    """p_{k+1} = D2 L_d and p_k + D1 L_d = Wᵀμ with the derivatives of L_d written out; p_φ is conserved."""
    _, sol = disk
    q, p, mu = sol.q, sol.p, sol.multipliers
    v = np.diff(q, axis=0) / DISK_H
    d2 = v * [M, M, I, J]
    d1 = -d2
    d1[:, 2] -= 10 * DISK_H * np.cos(q[:-1, 2])
    force = np.stack([mu[:, 0], mu[:, 1], -R * (np.cos(q[:-1, 3]) * mu[:, 0] + np.sin(q[:-1, 3]) * mu[:, 1]), 0 * mu[:, 0]], 1)
    rounding = 8 * EPS / DISK_H * np.max(np.abs(q), axis=0) * [M, M, I, J]
    assert np.all(np.max(np.abs(p[1:] - d2), axis=0) < rounding)
    assert np.all(np.max(np.abs(p[:-1] + d1 - force), axis=0) < rounding)
    np.testing.assert_allclose(p[:, 3], J * (DISK_Q1[3] - DISK_Q0[3]) / DISK_H, rtol=0, atol=DISK_STEPS**0.5 * 8 * EPS * 0.5)
    assert np.max(np.abs(sol.constraint_residual()[1:])) < 40 * 16 * EPS


def test_plus_and_minus_pinch_the_continuous_disk(disk):
    """First order: at t = 50 the errors of θ are about ±5, of the sign that theory.md found."""
    name, sol = disk
    error = sol.q[-1, 2] - 497.53121842
    assert 4.5 < (error if name == "plus" else -error) < 5.5


# ------------------------------------------------------------------------------------------ the Heisenberg system, [PY] §8.2

HEISENBERG = dx.LagrangeDirac(lambda q, v: v @ v / 2, lambda q: jnp.array([[-q[1], q[0], 1.0]]))
HEISENBERG_H, HEISENBERG_STEPS = 0.01, 100_000


@pytest.fixture(scope="module")
def heisenberg():
    run = lambda scheme: dx.simulate(
        HEISENBERG, scheme, q0=[1.0, 0.0, 0.1], q1=[1.05, 0.1, 0.0], step=HEISENBERG_H, steps=HEISENBERG_STEPS
    )
    return run(dx.PlusLagrangeDirac()), run(dx.MinusLagrangeDirac())


def heisenberg_by_hand(steps: int):
    """v_k = v_{k−1} − w (w·v_{k−1})/(w·w), w = (−y, x, 1) at q_k: both signs of the scheme, in extended precision."""
    h = np.longdouble("0.01")
    x, y, z = np.longdouble("1.05"), np.longdouble("0.1"), np.longdouble(0)
    u, v, w = (x - 1) / h, y / h, (z - np.longdouble("0.1")) / h
    for _ in range(steps - 1):
        share = (x * v - y * u + w) / (x * x + y * y + 1)
        u, v, w = u + y * share, v - x * share, w - share
        x, y, z = x + h * u, y + h * v, z + h * w
    return np.array([x, y, z], dtype=float)


@pytest.mark.soak
def test_heisenberg_run_of_the_paper(heisenberg):
    """To t = 1000: the end to 1e-6, the discrete energy 112.5 to 5e-11, and (+) = (−)."""
    end = heisenberg_by_hand(HEISENBERG_STEPS)
    for sol in heisenberg:
        assert sol.ok
        np.testing.assert_allclose(sol.q[-1], end, atol=1e-6, rtol=0)
        energy = np.sum(np.diff(sol.q, axis=0) ** 2, axis=1) / (2 * HEISENBERG_H**2)
        assert energy[0] == pytest.approx(112.5, rel=1e-12)
        momentum_energy = np.sum(sol.p[1:] ** 2, axis=1) / 2  # free of the rounding of differences of q
        assert np.max(np.abs(momentum_energy / 112.5 - 1)) < 5e-11
        np.testing.assert_allclose(sol.energy()[1:], momentum_energy, rtol=1e-14)


def test_heisenberg_satisfies_the_printed_equations(heisenberg):
    for sol in heisenberg:
        h, (x, y, z), mu = HEISENBERG_H, sol.q.T, sol.multipliers[1:, 0]
        bend = lambda a, h=h: (2 * a[1:-1] - a[:-2] - a[2:]) / h
        rounding = 8 * EPS / h * np.max(np.abs(sol.q))
        assert np.max(np.abs(bend(x) + mu * y[1:-1])) < rounding
        assert np.max(np.abs(bend(y) - mu * x[1:-1])) < rounding
        assert np.max(np.abs(bend(z) - mu)) < rounding
        step = lambda a, h=h: np.diff(a) / h
        for shift in (slice(1, None), slice(None, -1)):  # the constraint holds at both ends of each step
            residual = step(z) - y[shift] * step(x) + x[shift] * step(y)
            assert np.max(np.abs(residual)) < rounding * np.max(np.abs(sol.q))


# ------------------------------------------------- every rule and every base point, against derivatives written out by hand


def mass(q):
    return 1 + q[0] ** 2


CURVED = dx.LagrangeDirac(
    lambda q, v: (mass(q) * v[0] ** 2 + v[1] ** 2 + v[0] * v[2] + v[2] ** 2) / 2 - jnp.cos(q[1]) * q[2],
    lambda q: jnp.stack([jnp.stack([jnp.sin(q[1]), q[2], -1.0 + 0 * q[0]])]),
)


def curved_q(q, v):
    return np.array([q[0] * v[0] ** 2, np.sin(q[1]) * q[2], -np.cos(q[1])])


def curved_v(q, v):
    return np.array([mass(q) * v[0] + v[2] / 2, v[1], v[0] / 2 + v[2]])


def curved_form(q):
    return np.array([np.sin(q[1]), q[2], -1.0])


def slots_by_hand(rule, q0, q1, h):
    """(D1 L_d, D2 L_d): the chain rule written out for each rule."""
    v = (q1 - q0) / h
    if rule == "trapezoidal":
        left, right = slots_by_hand("left", q0, q1, h), slots_by_hand("right", q0, q1, h)
        return tuple((a + b) / 2 for a, b in zip(left, right, strict=True))
    weight = {"left": 0.0, "right": 1.0, "midpoint": 0.5}[rule]
    at = q0 + weight * (q1 - q0)
    along, across = curved_q(at, v), curved_v(at, v)
    return h * (1 - weight) * along - across, h * weight * along + across


def test_steps_of_a_separable_lagrangian_are_explicit():
    """The trapezoidal rule is Störmer and Verlet's; its equations are linear in v, with the mass for a matrix."""
    mass = np.array([[2.0, 0.3], [0.3, 1.0]])
    system = dx.LagrangeDirac(lambda q, v: v @ mass @ v / 2 - jnp.sin(q[0]) * q[1] ** 2)
    q, v, h, steps = np.array([0.3, 0.8]), np.array([0.5, -0.2]), 0.1, 40
    sol = dx.simulate(system, dx.LagrangeDAlembert("trapezoidal"), q=q, v=v, step=h, steps=steps, engine="native")
    assert sol.stats["newton_iterations"] == 2 * steps
    p, force = mass @ v, lambda q: -np.array([np.cos(q[0]) * q[1] ** 2, 2 * np.sin(q[0]) * q[1]])
    for _ in range(steps):
        p = p + h / 2 * force(q)
        q = q + h * np.linalg.solve(mass, p)
        p = p + h / 2 * force(q)
    np.testing.assert_allclose(np.concatenate([sol.q[-1], sol.p[-1]]), np.concatenate([q, p]), rtol=0, atol=1e-14)


small = st.floats(-2, 2, allow_subnormal=False)
points = st.tuples(*[small] * 3).map(np.array)


@pytest.mark.parametrize("momentum, share", [("incoming", 0.0), ("mean", 0.5), ("outgoing", 1.0)])
def test_saved_momenta(momentum, share):
    """p_k as it arrives, p_k − Wᵀμ as it leaves, and their mean."""
    equation = dx.make_step_equation(dx.LagrangeDAlembert("left", "left", momentum), CURVED, Shape(3, 1))
    q, p, mu = np.array([0.3, 0.7, -0.4]), np.array([1.0, 2.0, 3.0]), 0.8
    saved = equation.unpack(equation.state_layout.join(q=q, p=p), np.array([0.1, 0.2, 0.3, mu]), 0.0, 0.1, None)
    np.testing.assert_allclose(saved["p"], p - share * mu * curved_form(q), atol=1e-15)


@pytest.mark.parametrize("base", BASES)
@pytest.mark.parametrize("rule", RULES)
@pytest.mark.soak_of(but=["left-right"])
def test_step_equation_is_the_equations(rule, base):
    """Residual, next state and saved arrays at arbitrary points and unknowns, solved or not."""
    equation = dx.make_step_equation(dx.LagrangeDAlembert(rule, base, momentum="mean"), CURVED, Shape(3, 1))
    everything = jax.jit(
        lambda q, p, v, mu, h: (
            equation.residual(jnp.append(v, mu), equation.state_layout.join(q=q, p=p), 0.0, h, None),
            equation.advance(jnp.append(v, mu), equation.state_layout.join(q=q, p=p), 0.0, h, None),
            equation.unpack(equation.state_layout.join(q=q, p=p), jnp.append(v, mu), 0.0, h, None),
        )
    )

    @settings(max_examples=30, deadline=None)
    @given(points, points, points, small, st.floats(0.01, 1))
    def check(q, p, v, mu, h):
        residual, state, saved = everything(q, p, v, mu, h)
        q1 = q + h * v
        d1, d2 = slots_by_hand(rule, q, q1, h)
        at = {"left": q, "right": q1, "midpoint": (q + q1) / 2}[base]
        close = lambda a, b: np.testing.assert_allclose(a, b, rtol=0, atol=4e-13 / h)  # q1 − q0 is rounded here, not there
        close(residual, np.append(p + d1 - mu * curved_form(q), curved_form(at) @ v))
        close(state, equation.state_layout.join(q=q1, p=d2))
        close(saved["p"], p - mu * curved_form(q) / 2)
        close(saved["multipliers"], [mu])
        close(saved["constraint"], [curved_form(at) @ v])

    check()


@pytest.mark.parametrize("rule", RULES)
@pytest.mark.parametrize("scheme, base", [(dx.PlusLagrangeDirac, "right"), (dx.MinusLagrangeDirac, "left")])
def test_plus_and_minus_are_special_cases(scheme, base, rule):
    one = dx.make_step_equation(scheme(rule), CURVED, Shape(3, 1))
    other = dx.make_step_equation(dx.LagrangeDAlembert(rule, base), CURVED, Shape(3, 1))
    generator = np.random.default_rng(1)
    u, state = generator.normal(size=4), generator.normal(size=6)
    for name in ("residual", "advance"):
        a, b = (getattr(equation, name)(u, state, 0.0, 0.1, None) for equation in (one, other))
        np.testing.assert_array_equal(a, b)
    a, b = (equation.unpack(state, u, 0.0, 0.1, None) for equation in (one, other))
    assert a.keys() == b.keys() and all(np.array_equal(a[k], b[k]) for k in a)
    assert one.fields == other.fields and one.labels == other.labels


@pytest.mark.parametrize("rule, base", [("midpoint", "midpoint"), ("trapezoidal", "right"), ("right", "left")])
def test_runs_satisfy_their_equations(rule, base):
    scheme = dx.LagrangeDAlembert(rule, base, momentum="incoming")
    h = 0.05
    sol = dx.simulate(CURVED, scheme, q=[0.3, 0.4, 0.5], v=[1.0, -0.5, 0.2], step=h, steps=40, project=True)
    assert sol.ok
    for k in range(40):
        q0, q1, mu = sol.q[k], sol.q[k + 1], sol.multipliers[k, 0]
        d1, d2 = slots_by_hand(rule, q0, q1, h)
        np.testing.assert_allclose(sol.p[k] + d1, mu * curved_form(q0), atol=1e-13)
        np.testing.assert_allclose(sol.p[k + 1], d2, atol=1e-13)
        at = {"left": q0, "right": q1, "midpoint": (q0 + q1) / 2}[base]
        assert abs(curved_form(at) @ (q1 - q0)) < 1e-15


# ---------------------------------------------------------------------------------- discrete functions of the user's own


def test_user_given_discrete_lagrangian():
    """The exact discrete Lagrangian of q̈ = −ω²q gives the exact solution at any step size."""
    omega, h = 1.3, 0.7

    def exact(q0, q1, h, params):
        return params / (2 * jnp.sin(params * h)) * jnp.sum((q0**2 + q1**2) * jnp.cos(params * h) - 2 * q0 * q1)

    system = dx.LagrangeDirac(lambda q, v, params: (v @ v - params**2 * q @ q) / 2)
    sol = dx.simulate(system, dx.PlusLagrangeDirac(exact), q=[1.0, 0.0], v=[0.0, 2.0], params=omega, step=h, steps=200)
    t = h * np.arange(201)
    q = np.stack([np.cos(omega * t), 2 / omega * np.sin(omega * t)], 1)
    p = np.stack([-omega * np.sin(omega * t), 2 * np.cos(omega * t)], 1)
    np.testing.assert_allclose(sol.q, q, atol=1e-12)
    np.testing.assert_allclose(sol.p, p, atol=1e-12)


def test_user_given_discrete_constraint():
    """w_d = (w(q0) + w(q1))/2 · Δq: the equations of Cortés and Martínez with it, on the output."""

    def average(q0, q1, h):
        form = lambda q: jnp.stack([jnp.sin(q[1]), q[2], -1.0])
        return ((form(q0) + form(q1)) @ (q1 - q0))[None] / (2 * h)

    h = 0.05
    scheme = dx.LagrangeDAlembert("midpoint", average, momentum="incoming")
    sol = dx.simulate(CURVED, scheme, q=[0.3, 0.4, 0.5], v=[1.0, -0.5, 0.2], step=h, steps=40, project=True)
    assert sol.ok
    for k in range(40):
        q0, q1 = sol.q[k], sol.q[k + 1]
        d1, d2 = slots_by_hand("midpoint", q0, q1, h)
        np.testing.assert_allclose(sol.p[k] + d1, sol.multipliers[k, 0] * curved_form(q0), atol=1e-13)
        np.testing.assert_allclose(sol.p[k + 1], d2, atol=1e-13)
        assert abs((curved_form(q0) + curved_form(q1)) @ (q1 - q0)) < 1e-15


# ------------------------------------------------------------------------------------------------------------------ starts


@pytest.mark.parametrize("momentum", ["incoming", "mean"])
def test_starts_agree(momentum):
    """From (q, v), from (q, p) with p = ∂L/∂v, and from the two points that this gives."""
    scheme = dx.LagrangeDAlembert("midpoint", "midpoint", momentum)
    q, v = np.array([0.3, 0.4, 0.5]), np.array([1.0, -0.5, 0.2])
    v = v - curved_form(q) * (curved_form(q) @ v) / (curved_form(q) @ curved_form(q))
    run = lambda **data: dx.simulate(CURVED, scheme, **data, step=0.05, steps=40)
    by_velocity, by_momentum = run(q=q, v=v), run(q=q, p=curved_v(q, v))
    by_points = run(q0=q, q1=by_velocity.q[1])
    np.testing.assert_allclose(by_velocity.p[0], curved_v(q, v), atol=1e-14)  # what is saved is what was given
    np.testing.assert_allclose(by_momentum.q, by_velocity.q, atol=1e-13)
    np.testing.assert_allclose(by_momentum.p, by_velocity.p, atol=1e-13)
    np.testing.assert_allclose(by_points.q, by_velocity.q, atol=1e-11)
    np.testing.assert_allclose(by_points.p[1:], by_velocity.p[1:], atol=1e-11)
    np.testing.assert_allclose(by_points.multipliers[1:], by_velocity.multipliers[1:], atol=1e-11)
    np.testing.assert_array_equal(by_points.q[:2], by_velocity.q[:2])  # rows 0 and 1 are the given points
    d1, _ = slots_by_hand("midpoint", *by_points.q[:2], 0.05)
    np.testing.assert_allclose(by_points.p[0], -d1, atol=1e-13)  # the Legendre transform F⁻L_d of the two points
    np.testing.assert_array_equal(by_points.multipliers[0], [0.0])


def test_starts_agree_without_constraints_for_a_nonlinear_legendre_transform():
    """L = −√(1 − v²) − q²/2: p = v/√(1 − v²), inverted by hand."""
    system = dx.LagrangeDirac(lambda q, v: -jnp.sqrt(1 - v @ v) - q @ q / 2)
    q, v = np.array([1.0, 0.5]), np.array([0.9, -0.3])
    run = lambda **data: dx.simulate(system, dx.PlusLagrangeDirac("trapezoidal"), **data, step=0.05, steps=60)
    by_velocity, by_momentum = run(q=q, v=v), run(q=q, p=v / np.sqrt(1 - v @ v))
    np.testing.assert_allclose(by_momentum.q, by_velocity.q, atol=1e-13)
    by_points = run(q0=q, q1=by_velocity.q[1])
    np.testing.assert_allclose(by_points.q, by_velocity.q, atol=1e-11)
    np.testing.assert_allclose(by_points.p, by_velocity.p, atol=1e-11)
    energy = np.sqrt(1 + np.sum(by_momentum.p**2, 1)) + np.sum(by_momentum.q**2, 1) / 2
    np.testing.assert_allclose(by_momentum.energy(), energy, rtol=1e-14)


# ---------------------------------------------------------------------------------------------------- degenerate Lagrangians


def test_phase_space_lagrangian_is_the_midpoint_rule():
    """L = ½(x ẏ − y ẋ) − ½(x² + y²) has no second derivative in v; its midpoint L_d rotates by 2 arctan(h/2) a step."""
    system = dx.LagrangeDirac(lambda q, v: (q[0] * v[1] - q[1] * v[0] - q @ q) / 2)
    h, angle = 0.3, 2 * np.arctan(0.15)
    q = np.array([1.0, 0.0])
    turn = lambda k: np.stack([np.cos(k * angle), np.sin(k * angle)], -1)
    k = np.arange(101)
    scheme = dx.PlusLagrangeDirac("midpoint")
    for data in ({"v": [0.0, 1.0]}, {"p": [0.0, 0.5]}):
        sol = dx.simulate(system, scheme, q=q, **data, step=h, steps=100)
        np.testing.assert_allclose(sol.q, turn(k), atol=1e-13)
        np.testing.assert_allclose(sol.p, np.stack([-sol.q[:, 1], sol.q[:, 0]], 1) / 2, atol=1e-13)
        np.testing.assert_allclose(sol.energy(), 0.5, atol=1e-13)
    sol = dx.simulate(system, scheme, q0=turn(0), q1=turn(1), step=h, steps=100)
    np.testing.assert_allclose(sol.q, turn(k), atol=1e-12)


@pytest.mark.soak
def test_four_vortices():
    """[BLM] (13), 300 steps of h = 1: its own two-step recursion, and the number found independently for it."""
    gamma = np.array([1.0, 1.0, -1.0, -1.0])
    z0 = np.array([-1 + 2j, 1 + 2j, -1 - 2j, 1 - 2j])

    def lagrangian(q, v):
        (x, y), (a, b) = q.reshape(2, 4), v.reshape(2, 4)
        energy = sum(
            gamma[i] * gamma[j] * jnp.log((x[i] - x[j]) ** 2 + (y[i] - y[j]) ** 2) for i in range(4) for j in range(i)
        ) / (4 * np.pi)
        return jnp.sum(gamma * (x * b - y * a)) / 2 - energy

    def field(z):  # conj(ż)
        apart = z[..., :, None] - z[..., None, :] + np.diag(np.full(4, np.inf))  # none acts on itself
        return np.sum(gamma / apart, axis=-1) / (2j * np.pi)

    z1 = z0 + np.conj(field(z0 + np.conj(field(z0)) / 2))
    split = lambda z: np.concatenate([z.real, z.imag])
    sol = dx.simulate(
        dx.LagrangeDirac(lagrangian), dx.PlusLagrangeDirac("midpoint"), q0=split(z0), q1=split(z1), step=1.0, steps=300
    )
    z = sol.q[:, :4] + 1j * sol.q[:, 4:]
    np.testing.assert_allclose(z[300, 0], 24.470654872552494 + 2.1769853988531884j, rtol=1e-10)
    of_steps = field((z[:-1] + z[1:]) / 2)
    np.testing.assert_allclose(np.conj(z[2:] - z[:-2]), of_steps[:-1] + of_steps[1:], atol=1e-12)


@pytest.mark.soak
def test_a_lagrangian_made_regular_by_its_constraint():
    """L = ½ v0² − ½ q1² with v1 = a v0: q̈0 = −a² q0, whose left rule is symplectic Euler, solved in closed form."""
    a, h = 2.0, 0.1
    system = dx.LagrangeDirac(lambda q, v: (v[0] ** 2 - q[1] ** 2) / 2, lambda q: jnp.array([[a, -1.0]]))
    angle = 2 * np.arcsin(a * h / 2)
    k = np.arange(201)
    q0 = np.cos((k + 0.5) * angle) / np.cos(angle / 2)  # from rest
    run = lambda **data: dx.simulate(system, dx.PlusLagrangeDirac(), **data, step=h, steps=200)
    for sol in (run(q=[1.0, a], v=[0.0, 0.0]), run(q=[1.0, a], p=[0.0, 0.0])):
        np.testing.assert_allclose(sol.q, np.stack([q0, a * q0], 1), atol=1e-12)
        np.testing.assert_allclose(sol.multipliers[:, 0], h * a * q0[:-1], atol=1e-12)
    sol = run(q0=[q0[0], a * q0[0]], q1=[q0[1], a * q0[1]])
    np.testing.assert_allclose(sol.q[:, 0], q0, atol=1e-11)
    moving = run(q=[1.0, a], p=[0.7, 0.0])  # v1 is not in p: the constraint determines it
    np.testing.assert_allclose(moving.q, run(q=[1.0, a], v=[0.7, 0.7 * a]).q, atol=1e-14)
    np.testing.assert_allclose(moving.energy()[0], 0.7**2 / 2 + a**2 / 2, rtol=1e-14)


# --------------------------------------------------------------- multipliers, saved momenta and order on a disk that rolls free


def free_disk(t):
    """Exact: θ̇ = 2, φ̇ = 1.5; the position, the momentum, and the multipliers λ of ṗ = ∂L/∂q + Wᵀλ."""
    phi = 0.4 + 1.5 * t
    q = np.stack([2 / 1.5 * (np.sin(phi) - np.sin(0.4)), -2 / 1.5 * (np.cos(phi) - np.cos(0.4)), 2 * t, phi], -1)
    p = np.stack([2 * np.cos(phi), 2 * np.sin(phi), I * 2 + 0 * t, J * 1.5 + 0 * t], -1)
    return q, p, np.stack([-3 * np.sin(phi), 3 * np.cos(phi)], -1)


def free_run(scheme, h):
    q, p, _ = free_disk(0.0)
    sol = dx.simulate(DISK, scheme, q=q, p=p, params=0.0, step=h, steps=round(1 / h))
    assert sol.ok
    return sol


def slope(errors) -> float:
    """Order from errors at h = 0.02, 0.01, 0.005."""
    return float(np.polyfit(np.log([4, 2, 1]), np.log(errors), 1)[0])


HS = (0.02, 0.01, 0.005)


def errors_of(scheme):
    """Largest errors of q, of p at its two sides and as saved, and of μ/(−h) against λ, for each step size."""
    rows = []
    for h in HS:
        sol = free_run(scheme, h)
        q, p, lam = free_disk(sol.t)
        arriving = np.diff(sol.q, axis=0) / h * [M, M, I, J]  # D2 L_d at t_{k+1}, and −D1 L_d at t_k: no potential
        rows.append(
            {
                "q": np.max(np.abs(sol.q - q)),
                "saved p": np.max(np.abs(sol.p - p)[1:]),
                "incoming p": np.max(np.abs(arriving - p[1:])),
                "outgoing p": np.max(np.abs(arriving - p[:-1])),
                "multipliers": np.max(np.abs(sol.multipliers[1:] / -h - lam[1:-1])),
            }
        )
    return {name: [row[name] for row in rows] for name in rows[0]}


@pytest.mark.parametrize(
    "scheme, orders",
    [
        (dx.PlusLagrangeDirac(), {"q": 1, "saved p": 1, "multipliers": 1}),
        (dx.MinusLagrangeDirac(), {"q": 1, "saved p": 1, "multipliers": 1}),
        (dx.LagrangeDAlembert(), {"q": 2, "saved p": 2, "incoming p": 1, "outgoing p": 1, "multipliers": 2}),
    ],
    ids=["plus", "minus", "midpoint"],
)
def test_orders_of_positions_momenta_and_multipliers(scheme, orders):
    errors = errors_of(scheme)
    for name, order in orders.items():
        assert slope(errors[name]) == pytest.approx(order, abs=0.1), name


def test_outgoing_momenta():
    """Saved with momentum="outgoing": −D1 L_d(q_k, q_{k+1}), at the last node too."""
    h = 0.05
    q, p, _ = free_disk(0.0)
    run = lambda steps: dx.simulate(DISK, dx.LagrangeDAlembert(momentum="outgoing"), q=q, p=p, params=0.0, step=h, steps=steps)
    longer, sol = run(21), run(20)
    leaving = np.diff(longer.q, axis=0) / h * [M, M, I, J]
    np.testing.assert_allclose(sol.p, leaving, atol=1e-12)
    np.testing.assert_allclose(sol.q, longer.q[:-1], atol=1e-14)


# ----------------------------------------------------------------------------------------------------------- reversibility


@pytest.mark.parametrize(
    "forward, backward",
    [
        (dx.LagrangeDAlembert(), dx.LagrangeDAlembert()),
        (dx.LagrangeDAlembert("trapezoidal", "midpoint"), dx.LagrangeDAlembert("trapezoidal", "midpoint")),
        (dx.PlusLagrangeDirac("left"), dx.MinusLagrangeDirac("right")),
    ],
    ids=["midpoint", "trapezoidal", "plus and minus"],
)
def test_the_way_back(forward, backward):
    """The exchanged end points run back along the same points: self-adjoint pairs with themselves, (+) as (−)."""
    start = {"q": [0.0, 0.0, 0.2, 0.4], "v": [2 * np.cos(0.4), 2 * np.sin(0.4), 2.0, 1.5]}
    there = dx.simulate(DISK, forward, **start, params=3.0, step=0.02, steps=60)
    back = dx.simulate(DISK, backward, q0=there.q[-1], q1=there.q[-2], params=3.0, step=0.02, steps=60, check_initial=False)
    np.testing.assert_allclose(back.q[::-1], there.q, atol=1e-10)


def test_the_one_sided_schemes_are_not_reversible():
    start = {"q": [0.0, 0.0, 0.2, 0.4], "v": [2 * np.cos(0.4), 2 * np.sin(0.4), 2.0, 1.5]}
    there = dx.simulate(DISK, dx.PlusLagrangeDirac(), **start, params=3.0, step=0.02, steps=60)
    back = dx.simulate(
        DISK, dx.PlusLagrangeDirac(), q0=there.q[-1], q1=there.q[-2], params=3.0, step=0.02, steps=60, check_initial=False
    )
    assert np.max(np.abs(back.q[::-1] - there.q)) > 1e-2


# ------------------------------------------------------------------------------------------- against another integrator


def test_orders_on_the_double_pendulum_against_dop853():
    """Lengths and masses 1: midpoint and trapezoidal of second order in q and p, the one-sided rules of first."""

    def lagrangian(q, v):
        c = jnp.cos(q[0] - q[1])
        return v[0] ** 2 + v[1] ** 2 / 2 + v[0] * v[1] * c + 9.8 * (2 * jnp.cos(q[0]) + jnp.cos(q[1]))

    def flow(t, s):
        a, b, u, w = s
        c, d = np.cos(a - b), np.sin(a - b)
        force = np.array([-w * w * d - 2 * 9.8 * np.sin(a), u * u * d - 9.8 * np.sin(b)])
        return np.array([u, w, *np.linalg.solve([[2, c], [c, 1]], force)])

    q, v = np.array([1.0, 0.4]), np.array([0.3, -0.2])
    end = solve_ivp(flow, (0, 1), [*q, *v], method="DOP853", rtol=1e-13, atol=1e-13).y[:, -1]
    c = np.cos(end[0] - end[1])
    exact = np.array([*end[:2], 2 * end[2] + c * end[3], end[3] + c * end[2]])
    system = dx.LagrangeDirac(lagrangian)
    for rule, order in (("midpoint", 2), ("trapezoidal", 2), ("left", 1), ("right", 1)):
        errors = []
        for steps in (100, 200, 400):
            sol = dx.simulate(system, dx.PlusLagrangeDirac(rule), q=q, v=v, step=1 / steps, steps=steps)
            errors.append(np.abs(np.append(sol.q[-1], sol.p[-1]) - exact))
        for error in (np.max(np.array(errors)[:, :2], 1), np.max(np.array(errors)[:, 2:], 1)):
            assert slope(error) == pytest.approx(order, abs=0.1), rule


def test_orders_on_the_forced_disk_against_dop853():
    """(I + mR²) θ̈ = −g cos θ with x and y by quadrature: (+) and (−) of first order, the midpoint pair of second."""
    g, omega = 3.0, 1.5
    flow = lambda t, s: [np.cos(0.4 + omega * t) * s[3], np.sin(0.4 + omega * t) * s[3], s[3], -g * np.cos(s[2]) / (I + M * R**2)]
    end = solve_ivp(flow, (0, 1), [0.0, 0.0, 0.2, 2.0], method="DOP853", rtol=1e-13, atol=1e-13).y[:3, -1]
    start = {"q": [0.0, 0.0, 0.2, 0.4], "v": [2 * np.cos(0.4), 2 * np.sin(0.4), 2.0, omega]}
    for scheme, order in ((dx.PlusLagrangeDirac(), 1), (dx.MinusLagrangeDirac(), 1), (dx.LagrangeDAlembert(), 2)):
        errors = []
        for h in HS:
            sol = dx.simulate(DISK, scheme, **start, params=g, step=h, steps=round(1 / h))
            errors.append(np.max(np.abs(sol.q[-1, :3] - end)))
        assert slope(errors) == pytest.approx(order, abs=0.1)


def test_systems_on_a_smaller_manifold_are_refused():
    """Trajectories of a two-point method that start on p = α(q) leave it: these systems are for DiscreteDirac."""
    vortex = dx.PhaseSpaceLagrangian(lambda q: jnp.array([q[1], 0.0]) / 2, lambda q: q @ q / 2)
    with pytest.raises(TypeError, match=r"a PhaseSpaceLagrangian was given: use dx\.DiscreteDirac"):
        dx.simulate(vortex, dx.LagrangeDAlembert(), q=[1.0, 0.0], v=[0.0, 0.0], step=0.1, steps=1)


@pytest.mark.parametrize("scheme", [dx.PlusLagrangeDirac, dx.MinusLagrangeDirac])
@pytest.mark.soak_of("PlusLagrangeDirac")
def test_the_momentum_that_is_saved_can_be_chosen(scheme):
    """The outgoing one is −D1 L_d of the two points ([PY] (54)); what is chosen changes nothing in q, and verify knows it."""
    disk = gallery.get("rolling-disk")
    saved = {name: disk.simulate(scheme(momentum=name), steps=20) for name in ("incoming", "mean", "outgoing")}
    q, h = saved["outgoing"].q, disk.step
    lagrangian = lambda q0, q1: h * disk.system.lagrangian(q0, (q1 - q0) / h, disk.params)
    outgoing = -jax.jit(jax.vmap(jax.grad(lagrangian)))(q[:-1], q[1:])
    np.testing.assert_allclose(saved["outgoing"].p[1:-1], outgoing[1:], atol=1e-12)
    between = (saved["incoming"].p + saved["outgoing"].p) / 2
    np.testing.assert_allclose(saved["mean"].p[1:], between[1:], atol=1e-13)  # a run begins with the p that was given
    for sol in saved.values():
        np.testing.assert_allclose(sol.q, q, rtol=0, atol=1e-14)
        assert dx.verify(sol).ok
    with pytest.raises(ValueError, match="momentum must be one of"):
        scheme(momentum="left")


@pytest.mark.parametrize(
    "of_another_system",
    [
        lambda q0, q1, h: PLAIN((q0 + q1) / 2, (q1 - q0) / h),  # without the factor h
        lambda q0, q1, h: -h * PLAIN((q0 + q1) / 2, (q1 - q0) / h),
        lambda q0, q1, h: h * PLAIN(q0 + q1, (q1 - q0) / h),  # the middle is half of the sum
        lambda q0, q1, h: h * PLAIN(q0, (q1 - q0) / h) + q1[0] * q1[1] - q0[0] * q0[1],  # p is not that of L
    ],
)
def test_a_discrete_lagrangian_of_another_system_is_refused(of_another_system):
    """Energy went from .5 to 118, and every line of verify was ok: these are structure-preserving steps of something else."""
    system = dx.LagrangeDirac(PLAIN)
    for data in ({"q": [0.8, 0.3], "v": [0.1, 0.5]}, {"q": [0.8, 0.3], "v": [0.0, 0.0]}, {"q": [0.0, 0.0], "v": [0.0, 2e-9]}):
        for _ in range(2):
            with pytest.raises(ValueError, match="none of this Lagrangian"):
                dx.simulate(system, dx.LagrangeDAlembert(of_another_system), **data, step=0.05, steps=2)


@pytest.mark.parametrize("step", [1e-7, 0.05, 0.7])
def test_a_discrete_lagrangian_of_the_system_is_taken(step):
    system = dx.LagrangeDirac(PLAIN)
    right = dx.LagrangeDAlembert(lambda q0, q1, h: h * (PLAIN(q0, (q1 - q0) / h) + PLAIN(q1, (q1 - q0) / h)) / 2)
    for data in ({"q": [0.8, 0.3], "v": [0.1, 0.5]}, {"q": [1.0, 1e-7], "v": [0.0, 1e-5]}, {"q": [0.0, 0.0], "v": [0.0, 2e-9]}):
        ours, theirs = (dx.simulate(system, s, **data, step=step, steps=4) for s in (right, dx.LagrangeDAlembert("trapezoidal")))
        np.testing.assert_allclose(ours.q, theirs.q, rtol=1e-7, atol=1e-12 * np.abs(theirs.q).max())


PLAIN = lambda q, v: v @ v / 2 - q @ q / 2 - q[0] ** 2 * q[1] / 5
