"""Discrete Euler–Poincaré equations against Euler's equations, closed forms and the unreduced motion on the group."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.special import ellipj

import dirax as dx
from dirax.diagnostics.reconstruction_line import reconstruction
from lie_groups import hat, integrate, matrices, orders, run, unreduced

I = np.array([1.0, 2.0, 3.0])
MAPS = ("exp", "cayley")
SO3 = dx.SO3()
BODY = dx.EulerPoincare(SO3, lambda xi: xi @ (jnp.asarray(I) * xi) / 2)
OMEGA = np.array([0.3, 1.0, 0.4])


# -------------------------------------------------------------------------------------------------------- the free body


def euler(t, y):
    """(μ, R)˙ = (μ × ω, R ω^), by hand."""
    w = y[:3] / I
    return np.concatenate([np.cross(y[:3], w), (y[3:].reshape(3, 3) @ hat(w)).ravel()])


@pytest.mark.parametrize("map", MAPS)
@pytest.mark.soak_of("exp")
def test_momentum_and_attitude_of_the_free_body_are_of_second_order(map):
    exact = integrate(euler, [*(I * OMEGA), *np.eye(3).ravel()], 4.0)
    momenta, attitudes = [], []
    for steps in (40, 80, 160):
        sol = run(BODY, map, 4.0 / steps, steps, x=BODY.state(OMEGA))
        momenta.append(np.abs(sol.x[-1] - exact[:3]).max())
        attitudes.append(np.abs(matrices(SO3, dx.reconstruct(sol).q[-1]) - exact[3:].reshape(3, 3)).max())
    assert orders(momenta) == pytest.approx([2, 2], abs=0.05)
    assert orders(attitudes) == pytest.approx([2, 2], abs=0.05)


def test_the_free_body_is_that_of_jacobi():
    """ω = (a cn, b sn, c dn) of the closed form, Richardson extrapolated."""
    order = I[::-1].copy()  # A > B > C
    A, B, C = order
    w = np.array([1.0, 0.0, 0.2])  # at a time when sn = 0
    L2, T2 = np.sum((order * w) ** 2), np.sum(order * w**2)
    assert L2 > B * T2  # around the axis of largest inertia: dn there
    rate = np.sqrt((A - B) * (L2 - T2 * C) / (A * B * C))
    modulus = (B - C) * (T2 * A - L2) / ((A - B) * (L2 - T2 * C))
    top = dx.EulerPoincare(SO3, lambda xi: xi @ (jnp.asarray(order) * xi) / 2)
    t = 3.0
    sn, cn, dn, _ = ellipj(rate * t, modulus)
    amplitude = np.sqrt((T2 * A - L2) / (B * (A - B)))
    exact = np.array([w[0] * dn, -amplitude * sn, w[2] * cn])
    ends = [run(top, "exp", t / n, n, x=top.state(w)).x[-1] / order for n in (150, 300, 600)]
    first, second = (4 * ends[1] - ends[0]) / 3, (4 * ends[2] - ends[1]) / 3
    assert np.abs((16 * second - first) / 15 - exact).max() < 1e-10


@pytest.mark.parametrize("map", MAPS)
@pytest.mark.soak
def test_engines_agree_and_momentum_stays(map):
    x = BODY.state(OMEGA)
    sols = [run(BODY, map, steps=500, x=x, engine=engine) for engine in ("xla", "native")]
    for name in ("x", "g", "xi"):
        assert np.abs(sols[0].fields[name] - sols[1].fields[name]).max() < 1e-11
    for sol in sols:
        lifted = dx.reconstruct(sol)
        assert np.ptp(np.linalg.norm(sol.x, axis=1)) < 1e-14
        assert np.abs(lifted.spatial_momentum - I * OMEGA).max() < 5e-14
        assert np.abs(np.linalg.norm(lifted.q, axis=1) - 1).max() < 1e-15
        assert np.ptp(sol.energy()) < 2e-3


@pytest.mark.soak
def test_reduced_is_unreduced():
    """L_d of the exponential is left-invariant on SO(3) × SO(3): its discrete Euler–Lagrange equations, in charts."""
    unreduced = dx.ManifoldLagrangian(lambda q, v: BODY.value(SO3.to_algebra(q, v), jnp.zeros(0)), SO3)
    q0 = np.array([np.cos(0.4), 0.0, np.sin(0.4), 0.0])
    v0 = np.asarray(SO3.left_translate(jnp.asarray(q0), jnp.asarray(OMEGA)))
    whole = dx.simulate(unreduced, dx.InCharts(dx.LieGroupExp(SO3, 0.5)), q=q0, v=v0, step=0.05, steps=500)
    lifted = dx.reconstruct(run(BODY, "exp", 0.05, 500, x=BODY.state(OMEGA)), g0=q0)
    assert np.abs(matrices(SO3, lifted.q) - matrices(SO3, whole.q)).max() < 1e-10
    assert np.abs(np.abs(np.sum(lifted.p * whole.p, axis=1)) - np.sum(whole.p**2, axis=1)).max() < 1e-10


def bivector_defect(system, map, x, h):
    """DΦ Λ DΦᵀ − Λ∘Φ of one step Φ, differentiated by the implicit function theorem."""
    n, x = system.space.size, jnp.asarray(x)
    equation = dx.make_step_equation(dx.DiscreteEulerPoincare(map), system, dx.Shape(n))
    state, u = jax.jit(lambda x: equation.start(system.complete({"x": x}, None, False), h, None))(x)
    lifted = lambda x: jnp.concatenate([x, state[n:]])
    residual = lambda u, x: equation.residual(u, lifted(x), 0.0, h, None)
    derivatives = jax.jit(lambda u, x: (residual(u, x), *jax.jacfwd(residual, argnums=(0, 1))(u, x)))
    for _ in range(8):
        value, along, _ = derivatives(u, x)
        u = u - np.linalg.solve(along, value)
    _, along, across = (np.asarray(a) for a in derivatives(u, x))
    advance = lambda u, x: equation.advance(u, lifted(x), 0.0, h, None)[:n]
    end, by_u, by_x = jax.jit(lambda u, x: (advance(u, x), *jax.jacfwd(advance, argnums=(0, 1))(u, x)))(u, x)
    step = np.asarray(by_x) - np.asarray(by_u) @ np.linalg.solve(along, across)
    before, after = (np.asarray(jax.jit(system.space.bivector)(point)) for point in (x, end))
    assert np.abs(step - np.eye(n)).max() > 0.01
    return np.abs(step @ before @ step.T - after).max()


@pytest.mark.parametrize("map", MAPS)
@pytest.mark.soak
def test_one_step_is_a_poisson_map(map):
    assert bivector_defect(BODY, map, BODY.state(OMEGA), 0.2) < 1e-13


@pytest.mark.soak
def test_general_lagrangian_with_advected_quantities_is_poisson():
    system = system_of("top")
    x = system.state(OMEGA, GROUND)
    assert bivector_defect(system, "exp", x, 0.2) < 1e-13
    hamiltonian = dx.LiePoisson(SO3, lambda mu, a: mu @ mu / (2 + a[0]) + (mu @ a) ** 2 / 5 + a[2] ** 3, advected=3)
    assert bivector_defect(hamiltonian, "cayley", x, 0.2) < 1e-13


# ------------------------------------------------------------------------- the unreduced discrete equations, on matrices


@pytest.mark.parametrize("case", ["top", "suslov"])
@pytest.mark.soak
def test_a_step_back_is_the_way_one_came(case):
    """The step equation at −h, with the unknowns of the two ends exchanged, leads from the end of a step to its start."""
    system, h = system_of(case), 0.2
    d, n, m = 3, system.space.size, int(case == "suslov")
    equation = dx.make_step_equation(dx.DiscreteEulerPoincare(), system, dx.Shape(n, m))
    x = system.state(*CASES[case][2:4])
    data = jax.jit(lambda x: system.complete({"x": x}, None, False))(x)
    state, u = equation.start(data, h, None)
    residual = lambda u, state, h: equation.residual(u, state, 0.0, h, None)
    step = jax.jit(
        lambda u, state, h: (
            residual(u, state, h),
            jax.jacfwd(residual)(u, state, h),
            equation.advance(u, state, 0.0, h, None),
        )
    )
    for _ in range(8):
        value, slope, end = step(u, state, h)
        u = u - np.linalg.solve(slope, value)
    back = jnp.concatenate([u[:d], u[2 * d + m :], data["v"], u[d : d + m]]) if m else u
    value, _, start = step(back, end, -h)
    assert np.abs(end[:n] - state[:n]).max() > 0.01
    assert np.abs(value).max() < 1e-14 and np.abs(start[: n + 4] - state[: n + 4]).max() < 1e-14


def spinning(xi, a):
    """A heavy top with a flywheel whose axis turns with gravity: l is not a difference of kinetic and potential energy."""
    return xi @ (jnp.asarray(I) * xi) / 2 + 0.2 * (xi @ a) ** 2 - 0.7 * a[2] - 0.3 * a[0] * a[1]


MASSES = np.diag([1.0, 1.6, 2.2, 1.2, 0.9, 1.5]) + 0.1
UNEVEN = np.array([[1.0, 0.1, 0.3], [0.1, 1.5, 0.2], [0.3, 0.2, 2.0]])
SLEIGH = np.array([[1.0, 0, 0], [0, 1.0, 0.4], [0, 0.4, 0.66]])  # the edge at the origin, the centre of mass 0.4 ahead
GROUND = np.array([0.3, 0.0, 0.9])
CASES = {
    "top": (SO3, spinning, OMEGA, GROUND, None),
    "vehicle": (
        dx.SE3(),
        lambda xi, a: xi @ (jnp.asarray(MASSES) @ xi) / 2 - 0.5 * a[2] - 0.1 * a[0],
        np.array([0.5, -0.2, 0.1, 0.4, 0.3, -0.6]),
        GROUND,
        None,
    ),
    "suslov": (SO3, lambda xi, a: xi @ (jnp.asarray(UNEVEN) @ xi) / 2, np.array([0.8, -0.6, 0.0]), np.zeros(0), np.eye(3)[2:]),
    "sleigh": (
        dx.SE2(),
        lambda xi, a: xi @ (jnp.asarray(SLEIGH) @ xi) / 2,
        np.array([0.3, 0.0, 0.9]),
        np.zeros(0),
        np.eye(3)[1:2],
    ),
    "planar": (dx.SO2(), lambda xi, a: xi[0] ** 2 / 2 - a[1], np.array([1.1]), np.array([0.6, -0.8]), None),
}


def system_of(case):
    group, l, _, a, forms = CASES[case]
    return dx.EulerPoincare(group, l if len(a) else lambda xi: l(xi, a), forms, advected=len(a))


@pytest.mark.parametrize(
    "case", [*("vehicle", "suslov"), *(pytest.param(name, marks=pytest.mark.soak) for name in ("planar", "sleigh", "top"))]
)
@pytest.mark.soak
def test_reduced_is_unreduced_on_matrices(case):
    """The discrete Euler–Lagrange and Lagrange–d'Alembert equations of L_d on the group, solved on its matrices."""
    group, l, xi, a, forms = CASES[case]
    system, h = system_of(case), 0.05
    sol = run(system, "cayley", h, 500, x=system.state(xi, a))
    g, unknowns = unreduced(group, l, h, jnp.asarray(sol.xi[0]), jnp.asarray(a), 500, forms)
    lifted = dx.reconstruct(sol)
    assert np.abs(matrices(group, lifted.q) - g).max() < 1e-10
    assert np.abs(sol.xi[1:] - unknowns[:, : len(xi)]).max() < 1e-10
    if forms is not None:
        assert np.abs(sol.constraint).max() < 1e-14
        assert np.abs(sol.multipliers[1:] - unknowns[:, len(xi) :]).max() < 1e-11


def test_steps_of_their_own_length_and_what_makes_no_motion():
    body = dx.EulerPoincare(dx.SO3(), lambda xi: xi @ (jnp.array([1.0, 2.0, 3.0]) * xi) / 2)
    by = lambda scheme, end, steps, of=body: dx.simulate(of, scheme, x=[0.3, 1.8, -1.2], step=end / steps, steps=steps)
    for density in (None, lambda x: 1 + 0.1 * x[0] ** 2):
        errors = []
        for steps in (40, 80):
            sol = by(dx.VariableSteps(dx.DiscreteEulerPoincare(), density), 2.0, steps)
            exact = by(dx.Collocation(6), float(sol.fields["clock"][-1]), 100, body.lie_poisson())
            errors.append(np.max(np.abs(sol.x[-1] - exact.x[-1])))
        assert np.log2(errors[0] / errors[1]) == pytest.approx(2.0, abs=0.05)
    with pytest.raises(ValueError, match=r"Collocation hold no steps on the group.*DiscreteEulerPoincare"):
        dx.reconstruct(exact)


def test_reconstructed_motions_between_rows():
    """Of the reduced motion at that time, not of a row that its steps do not make."""
    group, inertia = dx.SO3(), jnp.array([1.0, 2.0, 3.0])
    kinetic = lambda spin: spin @ (inertia * spin) / 2
    top = dx.ManifoldLagrangian(lambda q, v: kinetic(group.to_algebra(q, v)), group)
    start = {"q": [1.0, 0.0, 0.0, 0.0], "v": [0.0, 0.1, 0.2, 0.3]}
    reduced = dx.simulate(dx.reduce(top, group), dx.DiscreteEulerPoincare(), step=0.1, steps=20, **start)
    whole, t = dx.reconstruct(reduced), np.array([0.5, 0.55, 1.23])
    exact = dx.simulate(top, dx.Collocation(2), step=0.05, steps=40, **start)
    found = whole.at(t)
    assert np.max(np.abs(found.q - exact.at(t).q)) <= 1e-4 and np.max(np.abs(found.p - exact.at(t).p)) <= 1e-3
    assert np.max(np.abs(found.q[0] - whole.q[5])) <= 1e-15 and np.array_equal(found.x, reduced.at(t).x)
    assert np.array_equal(whole.at(0.55).q, found.q[1])
    with pytest.raises(ValueError, match=r"p, q, spatial_momentum are known at the rows of this run alone"):
        whole[2:9].at(0.55)


def test_what_is_reconstructed_is_verified():
    """Momenta that were three times as large were called ok."""
    group = dx.SO3()
    kinetic = lambda spin: spin @ (jnp.array([1.0, 2.0, 3.0]) * spin) / 2
    body = dx.reduce(dx.ManifoldLagrangian(lambda q, v: kinetic(group.to_algebra(q, v)), group), group)
    start = {"q": [[1.0, 0.0, 0.0, 0.0]] * 2, "v": [[0.0, 0.1, 0.2, 0.3], [0.0, 0.3, 0.1, 0.3]]}
    whole = dx.reconstruct(dx.simulate(body, dx.DiscreteEulerPoincare(), step=0.1, steps=8, **start))
    assert dx.verify(whole)["reconstruction"].verdict == "ok"
    for field in ("q", "p", "spatial_momentum", "xi", "x"):
        right = whole.fields[field]
        whole.fields[field] = np.array(right)
        whole.fields[field][1, 3] *= 1.0 + 1e-9
        line = reconstruction(whole, None)
        whole.fields[field] = right
        assert line.verdict == "VIOLATED" and f"{field} at t = 0.3 (trajectory 1)" in line.explanation


@pytest.mark.parametrize("scale", [1e-9, 1.0, 1e9])
@pytest.mark.soak
def test_a_momentum_that_no_velocity_has_has_no_energy(scale):
    """l = s √(1 + ξ·Iξ) has −s √(1 − μ·I⁻¹μ/s²) for its energy, and momenta with μ·I⁻¹μ < s² alone."""
    body = dx.EulerPoincare(dx.SO3(), lambda xi: scale * jnp.sqrt(1.0 + xi @ (jnp.array([1.0, 2.0, 3.0]) * xi)))
    energy = lambda mu: float(body.energy_at({"x": scale * jnp.array(mu), "t": 0.0}, None))
    assert energy([0.5, 0.3, 0.4]) == pytest.approx(-scale * np.sqrt(1.0 - 0.25 - 0.045 - 0.16 / 3.0), rel=1e-14)
    assert energy([0.0, 0.0, 0.0]) == -scale
    assert np.isnan(energy([1.5, 0.3, 0.4]))
    with pytest.raises(ValueError, match="outside the domain"):
        dx.simulate(body.lie_poisson(), dx.Collocation(2), x=scale * np.array([1.5, 0.3, 0.4]), step=0.1, steps=3)


def test_schemes_that_do_not_step_it_name_the_way_out():
    body = dx.EulerPoincare(dx.SO3(), lambda xi: 0.5 * xi @ (jnp.array([1.0, 2.0, 3.0]) * xi))
    for scheme in (dx.Collocation(2), dx.DiscreteDirac(), dx.DiscreteGradient()):
        with pytest.raises(TypeError, match=r"system\.lie_poisson\(\)"):
            dx.simulate(body, scheme, x=[0.5, 0.3, 0.4], step=0.1, steps=3)
