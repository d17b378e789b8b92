"""Mechanics on SO(3), SE(2) and SE(3) reduced by the group, against Euler's equations, closed forms and the unreduced motion."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation
from scipy.special import ellipj

import dirax as dx
from dirax import gallery
from dirax.gallery import heavy_top, suslov, underwater_vehicle

I = np.array([1.0, 2.0, 3.0])
MAPS = ("exp", "cayley")
SO3 = dx.SO3()
BODY = dx.EulerPoincare(SO3, lambda xi: xi @ (jnp.asarray(I) * xi) / 2)
OMEGA = np.array([0.3, 1.0, 0.4])


def run(system, scheme="exp", step=0.1, steps=100, **settings):
    sol = dx.simulate(system, dx.DiscreteEulerPoincare(scheme), step=step, steps=steps, **settings)
    assert np.all(sol.ok), sol.message
    return sol


def hat(w):
    return np.array([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]])


def matrices(group, g):
    return np.squeeze(jax.vmap(group.matrix)(jnp.atleast_2d(jnp.asarray(g))))


def orders(errors):
    return -np.diff(np.log2(errors))


def integrate(field, y, end):
    return solve_ivp(field, (0.0, end), y, method="DOP853", rtol=1e-13, atol=1e-14).y[:, -1]


# -------------------------------------------------------------------------------------------------------- the free body


def euler(t, y):
    """(μ, R)˙ = (μ × ω, R ω^), by hand."""
    w = y[:3] / I
    return np.concatenate([np.cross(y[:3], w), (y[3:].reshape(3, 3) @ hat(w)).ravel()])


@pytest.mark.parametrize("map", MAPS)
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
def test_one_step_is_a_poisson_map(map):
    assert bivector_defect(BODY, map, BODY.state(OMEGA), 0.2) < 1e-13


# ------------------------------------------------------------------------- the unreduced discrete equations, on matrices

SPACE_TURNS = np.stack([hat(e) for e in np.eye(3)])


def basis_of(group):
    """The matrices of the algebra's basis, translations first, written out here."""
    k = 3 if group.dimension in (3, 6) and group.double_cover else 2
    turns = SPACE_TURNS if k == 3 else np.array([[[0.0, -1.0], [1.0, 0.0]]])
    if not group.translations:
        return turns
    basis = np.zeros((group.dimension, k + 1, k + 1))
    basis[np.arange(k), np.arange(k), k] = 1.0
    basis[k:, :k, :k] = turns
    return basis


def unreduced(group, l, h, start, a0, steps, forms=None):
    """g_k (steps + 1, …) of the discrete Euler–Lagrange equations of L_d(g0, g1) on the group, with Cayley's map.

    Solved on matrices, by the derivative of L_d along curves in the group and Newton's method; `start` is the first ξ and
    `forms` the A of constraints A ξ_k = 0, with forces Aᵀλ on the left-trivialized equations.
    """
    basis = jnp.asarray(basis_of(group))
    size, d = basis.shape[1], len(basis)
    A = jnp.zeros((0, d)) if forms is None else jnp.asarray(forms)
    one, square = jnp.eye(size), np.sum(np.asarray(basis) ** 2, axis=(1, 2))
    algebra = lambda xi: jnp.tensordot(xi, basis, axes=1)
    k = 3 if group.double_cover else 2

    def discrete_lagrangian(g0, g1):
        f = jnp.linalg.solve(g0, g1)
        zeta = 2 * jnp.linalg.solve((f + one).T, (f - one).T).T
        xi = jnp.einsum("aij,ij->a", basis, zeta) / square / h
        seen = lambda g: g[:k, :k].T @ a0 if len(a0) else a0
        return h / 2 * (l(xi, seen(g0)) + l(xi, seen(g1)))

    def following(g, xi):
        return g @ jnp.linalg.solve(one - h / 2 * algebra(xi), one + h / 2 * algebra(xi))

    def step(carry, _):
        before, g, xi = carry

        def equations(u):
            after = following(g, u[:d])
            curve = lambda eta: g @ (one + algebra(eta))
            action = lambda eta: discrete_lagrangian(before, curve(eta)) + discrete_lagrangian(curve(eta), after)
            return jnp.concatenate([jax.grad(action)(jnp.zeros(d)) + A.T @ u[d:], A @ u[:d]])

        u = jnp.concatenate([xi, jnp.zeros(len(A))])
        for _ in range(5):
            u = u - jnp.linalg.solve(jax.jacfwd(equations)(u), equations(u))
        return (g, following(g, u[:d]), u[:d]), (following(g, u[:d]), u)

    first = following(one, start)
    _, (rest, unknowns) = jax.jit(lambda s: jax.lax.scan(step, (one, following(one, s), s), None, length=steps - 1))(start)
    return np.concatenate([[one, first], rest]), np.asarray(unknowns)


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


@pytest.mark.parametrize("case", CASES)
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


# -------------------------------------------------------------------------------------------------------- the heavy top


def heavy(t, y):
    """(μ, Γ, R)˙ of the gallery's top, by hand."""
    w = y[:3] / [1.0, 1.0, 0.5]
    chi = np.array([0.0, 0.0, 1.0])
    torque = np.cross(y[:3], w) + np.cross(y[3:6], chi)
    return np.concatenate([torque, np.cross(y[3:6], w), (y[6:].reshape(3, 3) @ hat(w)).ravel()])


TOP = gallery.get("heavy-top")
LAGRANGE_TOP = dx.EulerPoincare(SO3, lambda xi, gamma: (xi[0] ** 2 + xi[1] ** 2 + 0.5 * xi[2] ** 2) / 2 - gamma[2], advected=3)


@pytest.mark.parametrize("map", MAPS)
def test_heavy_top_is_of_second_order_and_keeps_its_integrals(map):
    x0 = TOP.initial["x"]
    end = integrate(heavy, [*x0, *np.eye(3).ravel()], 4.0)
    errors = []
    for steps in (80, 160, 320):
        sol = dx.reconstruct(run(LAGRANGE_TOP, map, 4.0 / steps, steps, x=x0))
        errors.append([np.abs(sol.x[-1, :3] - end[:3]).max(), np.abs(sol.x[-1, 3:] - end[3:6]).max()])
        errors[-1].append(np.abs(matrices(SO3, sol.q[-1]) - end[6:].reshape(3, 3)).max())
    assert orders(np.array(errors).T) == pytest.approx(np.full((3, 2), 2.0), abs=0.06)
    mu, gamma = sol.x[:, :3], sol.x[:, 3:]
    integrals = [np.sum(gamma**2, axis=1), np.sum(mu * gamma, axis=1), mu[:, 2], sol.spatial_momentum @ x0[3:]]
    assert np.ptp(integrals, axis=1).max() < 1e-13
    assert np.abs(np.einsum("tij,tj->ti", matrices(SO3, sol.q), gamma) - x0[3:]).max() < 1e-13


def test_hamiltonian_and_lagrangian_top_are_one():
    x0 = TOP.initial["x"]
    by_hamiltonian = run(heavy_top.ON_SO3, "cayley", 0.05, 300, x=x0, params=TOP.params)
    by_lagrangian = run(LAGRANGE_TOP, "cayley", 0.05, 300, x=x0)
    assert np.abs(by_hamiltonian.x - by_lagrangian.x).max() < 1e-12
    assert np.abs(by_hamiltonian.energy() - by_lagrangian.energy()).max() < 1e-12
    point = jnp.asarray(x0)
    legendre = jax.jit(LAGRANGE_TOP.lie_poisson().value)(point[:3], point[3:])
    assert legendre == pytest.approx(float(by_lagrangian.energy()[0]), abs=1e-14)
    space = heavy_top.ON_SO3.space
    assert np.array_equal(jax.jit(space.bivector)(point), heavy_top.bivector(point))
    velocity = jax.jit(space.field)(point, point[:3] / jnp.array([1.0, 1.0, 0.5]), jnp.array([0.0, 0.0, -1.0]))
    assert velocity == pytest.approx(heavy(0.0, np.append(x0, np.eye(3)))[:6], abs=1e-15)
    relation = heavy_top.ON_SO3.dirac_system().relation(point, velocity, jnp.zeros(0), 0.0, TOP.params)
    assert np.abs(relation).max() < 1e-15


def test_general_lagrangian_with_advected_quantities_is_poisson():
    system = system_of("top")
    x = system.state(OMEGA, GROUND)
    assert bivector_defect(system, "exp", x, 0.2) < 1e-13
    hamiltonian = dx.LiePoisson(SO3, lambda mu, a: mu @ mu / (2 + a[0]) + (mu @ a) ** 2 / 5 + a[2] ** 3, advected=3)
    assert bivector_defect(hamiltonian, "cayley", x, 0.2) < 1e-13


# --------------------------------------------------------------------------------------------------------------- SE(3)


def test_vehicle_is_of_second_order_and_keeps_its_casimirs():
    example = gallery.get("underwater-vehicle")

    def field(t, y):
        P, L, gamma, xi = y[:3], y[3:6], y[6:9], y[:6] / underwater_vehicle.INERTIA
        V, W, R = xi[:3], xi[3:], y[12:].reshape(3, 3)
        torque = np.cross(L, W) + np.cross(P, V) - 0.5 * np.cross(gamma, [0, 0, 1.0])
        return np.concatenate([np.cross(P, W), torque, np.cross(gamma, W), R @ V, (R @ hat(W)).ravel()])

    x0 = example.initial["x"]
    end = integrate(field, [*x0, *np.zeros(3), *np.eye(3).ravel()], 3.0)
    motion = np.block([[end[12:].reshape(3, 3), end[9:12, None]], [np.zeros((1, 3)), np.ones((1, 1))]])
    errors = []
    for steps in (60, 120, 240):
        sol = dx.reconstruct(example.simulate(step=3.0 / steps, steps=steps))
        errors.append([np.abs(sol.x[-1] - end[:9]).max(), np.abs(matrices(dx.SE3(), sol.q[-1]) - motion).max()])
    assert orders(np.array(errors).T) == pytest.approx(np.full((2, 2), 2.0), abs=0.06)
    P, gamma, spatial = sol.x[:, :3], sol.x[:, 6:], sol.spatial_momentum
    about_gravity = spatial[:, 3:] @ x0[6:]
    kept = [np.sum(P**2, axis=1), np.sum(P * gamma, axis=1), np.sum(gamma**2, axis=1), about_gravity, *spatial[:, :3].T]
    assert np.ptp(kept, axis=1).max() < 2e-13


def test_a_representation_of_ones_own():
    """A ball on a spring: the body sees the spring's end, a point that rigid motions move, at a = g⁻¹·(r, 1)."""
    ball = dx.EulerPoincare(
        dx.SE3(), lambda xi, a: xi @ xi / 2 - 2.0 * a[:3] @ a[:3], advected=4, representation=lambda matrix, a: matrix @ a
    )
    v, end, errors = np.array([0.0, 0.5, 0.0]), np.array([-1.0, 0.0, 0.2]), []
    for steps in (50, 100, 200):
        sol = dx.reconstruct(run(ball, "cayley", 2.0 / steps, steps, x=ball.state([*v, 0.7, -0.4, 0.9], [*end, 1.0])))
        errors.append(np.abs(sol.q[-1, 4:] - end - (v / 2 * np.sin(4.0) - end * np.cos(4.0))).max())
    assert orders(errors) == pytest.approx([2, 2], abs=0.06)


# --------------------------------------------------------------------------------------------------------- constraints


@pytest.mark.parametrize(("name", "map"), [("suslov", "exp"), ("chaplygin-sleigh-se2", "cayley")])
def test_constrained_motions_are_their_closed_forms(name, map):
    example, errors = gallery.get(name), []
    for steps in (100, 200, 400):
        sol = example.simulate(dx.DiscreteEulerPoincare(map), step=10.0 / steps, steps=steps)
        errors.append(np.abs(sol.x - example.exact(sol.t, example.initial["x"])).max())
    assert orders(errors) == pytest.approx([2, 2], abs=0.06)
    assert np.abs(sol.constraint).max() < 1e-15
    nodes = sol.map_rows(lambda row, params: example.system.constraint_at(row, params))
    assert np.abs(nodes).max() < 1e-14
    assert np.ptp(sol.energy()) < 1e-4


def test_suslov_multipliers_are_the_torque_that_the_constraint_needs():
    """λ = d/dt μ_3 − (μ × ω)_3 of the closed form, the derivative by a fourth-order difference."""
    example, worst = gallery.get("suslov"), []
    matrix = np.asarray(suslov.inertia(example.params))
    for steps in (100, 200, 400):
        sol = example.simulate(step=5.0 / steps, steps=steps)
        node, e = sol.t[1:-1], 1e-3
        mu = lambda t: suslov.exact(t, example.initial["x"])
        rate = (8 * (mu(node + e) - mu(node - e)) - mu(node + 2 * e) + mu(node - 2 * e))[:, 2] / (12 * e)
        omega = np.linalg.solve(matrix, mu(node).T).T
        force = rate - np.cross(mu(node), omega)[:, 2]
        worst.append(np.abs(sol.multipliers[1:, 0] / sol.step - force).max())
    assert orders(worst) == pytest.approx([2, 2], abs=0.1)


def test_suslov_with_a_principal_axis_is_steady():
    sol = gallery.get("suslov").simulate(params={"I13": 0.0, "I23": 0.0}, x=[0.7, -0.4, 0.0], steps=200)
    assert np.abs(sol.x - sol.x[0]).max() < 1e-14 and np.abs(suslov.exact([3.0], sol.x[0], sol.params) - sol.x[0]).max() < 1e-15


def test_sleigh_on_se2_is_the_sleigh_in_the_plane():
    plane, group, errors = gallery.get("chaplygin-sleigh"), gallery.get("chaplygin-sleigh-se2"), []
    for steps in (100, 200, 400):
        whole = plane.simulate(step=4.0 / steps, steps=steps)
        sol = dx.reconstruct(group.simulate(step=4.0 / steps, steps=steps))
        exact = plane.exact(sol.t, **plane.initial)
        lifted = np.column_stack([sol.q[:, 2:], np.unwrap(np.arctan2(sol.q[:, 1], sol.q[:, 0]))])
        errors.append([np.abs(lifted - exact).max(), np.abs(lifted - whole.q).max()])
    assert orders(np.array(errors).T) == pytest.approx(np.full((2, 2), 2.0), abs=0.1)


def test_constraint_that_the_body_sees_turning():
    """Veselova's problem: ω·γ = 0 for a direction fixed in space; λ by differentiating the constraint by hand."""
    system = dx.EulerPoincare(SO3, lambda xi, a: xi @ (jnp.asarray(I) * xi) / 2, lambda a: a[None], advected=3)

    def field(t, y):
        w, gamma = y[:3] / I, y[3:]
        torque = np.cross(y[:3], w)
        return np.concatenate([torque - gamma * (gamma @ (torque / I)) / (gamma @ (gamma / I)), np.cross(gamma, w)])

    gamma = np.array([0.6, 0.0, 0.8])
    x0 = system.state(np.array([0.8, 0.5, -0.6]), gamma)
    exact, errors = integrate(field, x0, 3.0), []
    for steps in (60, 120, 240):
        sol = run(system, "exp", 3.0 / steps, steps, x=x0)
        errors.append(np.abs(sol.x[-1] - exact).max())
    assert orders(errors) == pytest.approx([2, 2], abs=0.06)
    assert np.abs(sol.constraint).max() < 1e-14


# ------------------------------------------------------------------------------------------ batches, derivatives, errors


def test_batches_are_their_trajectories_and_derivatives_those_of_differences():
    top = dx.EulerPoincare(SO3, lambda xi, params: xi @ (params * xi) / 2)
    xi = np.array([[0.1, 1.0, 0.2], [0.5, -0.2, 0.7]])
    x = top.state(xi, params=jnp.asarray(I))
    both = run(top, "exp", x=x, params=I, steps=50, engine="native")
    for lane in (0, 1):
        one = run(top, "exp", x=x[lane], params=I, steps=50, engine="native")
        assert np.array_equal(both.x[lane], one.x) and np.array_equal(both.g[lane], one.g)
    lifted = dx.reconstruct(both, g0=np.array([[1.0, 0, 0, 0], [0.6, 0.8, 0, 0]]))
    assert lifted.q.shape == (2, 51, 4) and np.ptp(lifted.spatial_momentum, axis=1).max() < 1e-14

    def end(inertia):
        return dx.simulate(top, dx.DiscreteEulerPoincare(), x=x[0], params=inertia, step=0.1, steps=10)

    back = jax.jit(jax.grad(lambda inertia: jnp.sum(dx.reconstruct(end(inertia)).q[-1])))(jnp.asarray(I))
    differences = [(dx.reconstruct(end(I + d)).q[-1] - dx.reconstruct(end(I - d)).q[-1]).sum() / 2e-5 for d in 1e-5 * np.eye(3)]
    assert np.asarray(back) == pytest.approx(np.array(differences), abs=1e-8)


SUSLOV = dx.EulerPoincare(SO3, lambda xi: xi @ (jnp.asarray(UNEVEN) @ xi) / 2, [[0, 0, 1.0]])


def with_forms(matrix):
    return dx.EulerPoincare(SO3, BODY.lagrangian.function, matrix)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: dx.EulerPoincare("SO3", lambda xi: xi @ xi), "group must be a Lie group such as dx.SO3"),
        (lambda: dx.EulerPoincare(SO3, lambda xi, a, b: xi @ xi), r"lagrangian\(xi\[, params\]\)"),
        (lambda: dx.EulerPoincare(SO3, lambda xi, a: xi @ a, advected=2), "a multiple of 3"),
        (lambda: dx.DiscreteEulerPoincare("log"), "map must be exp or cayley, but 'log'"),
        (lambda: BODY.state([1.0, 2.0]), r"xi must have shape \(3,\)"),
        (lambda: run(BODY, x=[1.0, 2.0]), r"starts from x= μ of shape \(3,\), but x has shape \(2,\)"),
        (lambda: run(BODY, q=[1.0, 0, 0], v=[1.0, 0, 0]), "but q, v were given"),
        (lambda: run(BODY, x=BODY.state([0.0, 40.0, 0.0])), "of a step that turns by less than π"),
        (lambda: run(BODY, "cayley", x=BODY.state([0.0, 40.0, 0.0])), "of a step that turns by less than π"),
        (lambda: run(dx.EulerPoincare(SO3, lambda xi: xi), x=OMEGA), r"must return a scalar, but it returned shape \(3,\)"),
        (lambda: run(dx.EulerPoincare(SO3, lambda xi: xi[0] ** 2 + xi[1] ** 2), x=OMEGA), "singular .* rank 2 of 3"),
        (lambda: run(SUSLOV, x=SUSLOV.state(OMEGA)), r"off the constraint, whose residual is \[0.4\]"),
        (
            lambda: run(dx.EulerPoincare(SO3, BODY.lagrangian.function, [1.0, 0, 0]), x=OMEGA),
            r"one_forms must have shape \(m, d\)",
        ),
        (lambda: run(with_forms(np.ones((2, 3))), x=OMEGA), "independent, .* has rank 1"),
        (lambda: SUSLOV.lie_poisson(), "no Lie–Poisson system"),
        (lambda: dx.simulate(BODY, dx.PlusLagrangeDirac(), x=OMEGA, step=0.1, steps=1), "EulerPoincare"),
        (lambda: TOP.simulate(dx.DiscreteEulerPoincare()), "DiracSystem"),
        (lambda: dx.reconstruct(run(BODY, x=OMEGA, steps=1), g0=[1.0, 0, 0]), r"shape \(4,\), or a matrix \(3, 3\)"),
        (lambda: dx.reconstruct(run(BODY, x=OMEGA, steps=1), g0=[1.0, 1.0, 0, 0]), "no element of SO3: it is off by 0.414"),
        (lambda: dx.reconstruct(run(BODY, x=OMEGA, steps=1), g0=-np.eye(3)), "no element of SO3"),
    ],
)
def test_errors_say_what_came_and_the_way_out(make, message):
    with pytest.raises((TypeError, ValueError), match=message):
        make()


def test_projection_changes_the_momentum_by_a_reaction():
    sol = run(SUSLOV, x=SUSLOV.state(OMEGA), project=True, steps=1)
    assert np.linalg.solve(UNEVEN, sol.x[0])[2] == pytest.approx(0.0, abs=1e-15)
    assert sol.x[0][:2] == pytest.approx((UNEVEN @ OMEGA)[:2], abs=1e-14)


def test_a_motion_can_start_from_a_matrix():
    turn = Rotation.from_rotvec([0.3, -0.2, 0.5]).as_matrix()
    sol = run(BODY, x=BODY.state(OMEGA), steps=10)
    assert np.abs(matrices(SO3, dx.reconstruct(sol, g0=turn).q) - turn @ matrices(SO3, sol.g)).max() < 1e-15


@pytest.mark.soak
@pytest.mark.parametrize("name", ["free-top", "underwater-vehicle"])
@pytest.mark.parametrize("map", MAPS)
def test_casimirs_and_momenta_over_a_million_steps(name, map):
    example = gallery.get(name)
    sol = dx.reconstruct(example.simulate(dx.DiscreteEulerPoincare(map), steps=1_000_000, save_every=1000))
    assert sol.ok
    if name == "free-top":
        kept = [np.linalg.norm(sol.x, axis=1), *sol.spatial_momentum.T]
    else:
        P, gamma = sol.x[:, :3], sol.x[:, 6:]
        kept = [np.sum(P**2, axis=1), np.sum(P * gamma, axis=1), np.sum(gamma**2, axis=1), *sol.spatial_momentum[:, :3].T]
    scale = np.abs(kept).max()
    print(name, map, np.ptp(kept, axis=1) / scale)
    assert np.ptp(kept, axis=1).max() < 2e-12 * scale
    assert np.abs(np.linalg.norm(sol.q[:, :4], axis=1) - 1).max() < 1e-15
