"""Lagrangian systems by any discretization map and its cotangent lift: the θ maps' own form, SciPy on other equations, laws."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import dirax as dx

METHODS = ("discretize", "resolve")


class OwnTheta(dx.AbstractDiscretizationMap):
    """The θ map, not known to dirax as one."""

    theta: float

    @property
    def base_fraction(self):
        return self.theta

    def manifold(self, ambient_dimension):
        return dx.Euclidean(ambient_dimension)

    def forward(self, x, v):
        return x - self.theta * v, x + (1 - self.theta) * v

    def backward(self, x0, x1):
        return (1 - self.theta) * x0 + self.theta * x1, x1 - x0

    def reach(self, x, v):
        return jnp.zeros(())


class Bent(dx.AbstractDiscretizationMap):
    """R_d(x, v) = (y − v/2, y + v/2), y = x − c(v), with c of even degree: nonlinear and symmetric."""

    def bend(self, v):
        return 0.3 * jnp.stack([v[0] * v[1], v[1] ** 2 * jnp.cos(v[0])])

    def manifold(self, ambient_dimension):
        return dx.Euclidean(ambient_dimension)

    def forward(self, x, v):
        return x - self.bend(v) - v / 2, x - self.bend(v) + v / 2

    def backward(self, x0, x1):
        return (x0 + x1) / 2 + self.bend(x1 - x0), x1 - x0

    def reach(self, x, v):
        return jnp.zeros(())


def metric(q):
    return jnp.diag(jnp.array([1.0, 1.0, 0.5])) + 0.2 * jnp.outer(jnp.sin(q), jnp.sin(q))


@cache
def moving_edge():
    """One-forms, forces and explicit time."""
    return dx.LagrangeDirac(
        lambda t, q, v: v @ metric(q) @ v / 2 - 0.3 * jnp.cos(t) * q[0] ** 2,
        lambda q: jnp.array([[jnp.sin(q[2]), -jnp.cos(q[2]), 0.3 * q[0]]]),
        forces=lambda t, q, v: jnp.array([jnp.sin(2 * t), 0.0, 0.0]) - 0.1 * v,
    ), {"q": [0.3, 0.1, 0.4], "v": [0.9, 0.4, 1.0]}


@cache
def tied_pendulum():
    """A holonomic constraint."""
    system = dx.LagrangeDirac(lambda q, v: v @ metric(q) @ v / 2 - q[2], holonomic=lambda q: jnp.array([q @ q - 1.0]))
    return system, {"q": [0.6, 0.0, 0.8], "v": [0.8, 0.3, -0.6]}


@pytest.mark.parametrize("theta", [0.5, 0.3])
@pytest.mark.parametrize("constraints", METHODS)
@pytest.mark.parametrize("case", [moving_edge, tied_pendulum])
@pytest.mark.soak_of(but=["moving_edge-resolve-0.3"])
def test_a_theta_map_of_ones_own_is_the_theta_map(case, constraints, theta):
    system, data = case()
    run = {**data, "project": True, "step": 0.05, "steps": 30}
    known = dx.simulate(system, dx.DiscreteDirac(dx.Theta(theta), constraints), **run)
    own = dx.simulate(system, dx.DiscreteDirac(OwnTheta(theta), constraints), **run)
    assert known.ok and own.ok
    assert np.abs(known.q - own.q).max() < 3e-14 and np.abs(known.p - own.p).max() < 1e-13
    assert np.abs(known.multipliers - own.multipliers).max() < 1e-10
    if constraints == "resolve":
        assert np.abs(own.constraint_residual()).max() < 1e-13


@pytest.mark.soak
def test_the_lift_of_a_nonlinear_map_is_symplectic_and_of_second_order():
    """JᵀΩJ = Ω for a step far from small, and the order in q and p against DOP853."""
    mass = lambda q: jnp.array([[1.0 + q[1] ** 2, 0.3], [0.3, 2.0]])
    system = dx.LagrangeDirac(lambda q, v: v @ mass(q) @ v / 2 - jnp.cos(q[0]) - q[0] * q[1] ** 2)

    slopes = jax.jit(jax.grad(lambda x: x[2:] @ jnp.linalg.solve(mass(x[:2]), x[2:]) / 2 + jnp.cos(x[0]) + x[0] * x[1] ** 2))

    def hamilton(t, x):
        slope = slopes(jnp.asarray(x))
        return np.concatenate([slope[2:], -slope[:2]])

    def end(x, steps=1, step=0.4):
        sol = dx.simulate(system, dx.DiscreteDirac(Bent()), q=x[:2], p=x[2:], step=step, steps=steps)
        return jnp.concatenate([sol.q[-1], sol.p[-1]])

    x = np.array([0.5, 0.3, 0.4, -0.7])
    J, omega = np.asarray(jax.jit(jax.jacfwd(end))(jnp.asarray(x))), np.kron([[0, 1], [-1, 0]], np.eye(2))
    assert np.abs(J.T @ omega @ J - omega).max() < 1e-13
    exact = solve_ivp(hamilton, (0, 1), x, method="DOP853", rtol=1e-12, atol=1e-13).y[:, -1]
    errors = [np.abs(end(x, n, 1 / n) - exact).max() for n in (20, 40, 80)]
    assert np.log2(np.array(errors)[:-1] / np.array(errors)[1:]) == pytest.approx(2.0, abs=0.1)


# ---------------------------------------------------------------------- on a group: Suslov's problem with a potential

INERTIA, BODY_AXIS = np.diag([1.0, 2.0, 3.0]), np.array([0.3, 0.5, 0.8])
SO3 = dx.SO3()


def up_in_the_body(g):
    """Rᵀ e_z of a unit quaternion (w, x, y, z)."""
    w, x, y, z = g
    return jnp.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)])


def suslov_lagrangian(g, v):
    xi = SO3.to_algebra(g, v)
    return xi @ INERTIA @ xi / 2 - jnp.array([0.4, 0.1, 1.0]) @ up_in_the_body(g)


# ω·a = 0 in the body, and a damping torque −γω that grows with time
suslov = dx.ManifoldLagrangian(
    suslov_lagrangian,
    SO3,
    one_forms=lambda g: SO3.covector(g, jnp.asarray(BODY_AXIS))[None],
    forces=lambda t, g, v: SO3.covector(g, -0.2 * (1 + t) * SO3.to_algebra(g, v)),
)


def suslov_ode(t, y):
    """Euler's equations with λ from a·ω̇ = 0: I ω̇ = I ω × ω + torque of gravity and friction + λ a; ġ = g (0, ω)/2."""
    g, omega = y[:4], y[4:]
    w, a = g[0], g[1:]
    up = np.array([2 * (a[0] * a[2] - w * a[1]), 2 * (a[1] * a[2] + w * a[0]), 1 - 2 * (a[0] ** 2 + a[1] ** 2)])
    torque = np.cross(up, [0.4, 0.1, 1.0]) - 0.2 * (1 + t) * omega  # V = c·Γ, Γ̇ = Γ × ω: the torque is Γ × c
    free = np.linalg.solve(INERTIA, np.cross(INERTIA @ omega, omega) + torque)
    lifted = np.linalg.solve(INERTIA, BODY_AXIS)
    multiplier = -(BODY_AXIS @ free) / (BODY_AXIS @ lifted)
    turn = np.concatenate([[-a @ omega], w * omega + np.cross(a, omega)]) / 2
    return np.concatenate([turn, free + multiplier * lifted]), multiplier


body_momentum = jax.jit(SO3.body_momentum)


def suslov_start():
    g = np.array([0.5, 0.5, -0.5, 0.5])
    omega = np.cross(BODY_AXIS, [1.0, -1.0, 0.4])
    return g, omega


@cache
def suslov_motion():
    """t ↦ (g, ω), by DOP853."""
    start = np.concatenate(suslov_start())
    found = solve_ivp(lambda t, y: suslov_ode(t, y)[0], (0, 1), start, "DOP853", dense_output=True, rtol=1e-12, atol=1e-13)
    return found.sol


@pytest.mark.parametrize(
    ("map", "constraints"),
    [
        *((dx.LieGroupExp(SO3), method) for method in METHODS),
        pytest.param(dx.RiemannianExp(SO3), "resolve", marks=pytest.mark.soak),
    ],
)
@pytest.mark.soak
def test_suslovs_problem_on_the_group_against_eulers_equations(map, constraints):
    g, omega = suslov_start()
    exact, errors = suslov_motion(), []
    v = np.asarray(SO3.left_translate(jnp.asarray(g), jnp.asarray(omega)))
    for steps in (20, 40, 80):
        sol = dx.simulate(suslov, dx.DiscreteDirac(map, constraints), q=g, v=v, step=1 / steps, steps=steps)
        assert sol.ok and np.abs(np.linalg.norm(sol.q, axis=1) - 1).max() < 1e-15 * steps
        assert np.abs((sol.q * sol.p).sum(axis=1)).max() < 1e-14
        if constraints == "resolve":
            assert np.abs(sol.constraint_residual()).max() < 1e-13
        momentum = np.asarray(body_momentum(sol.q[-1], sol.p[-1]))
        turned = INERTIA @ exact(1.0)[4:]
        means = (sol.multipliers[1:, 0] + sol.multipliers[:-1, 0]) / 2  # of neighbours, at the node between them
        forces = np.array([suslov_ode(t, exact(t))[1] for t in np.asarray(sol.t)[1:-1]])
        errors.append([np.abs(sol.q[-1] - exact(1.0)[:4]).max(), np.abs(momentum - turned).max(), np.abs(means - forces).max()])
    assert np.log2(np.array(errors)[:-1] / np.array(errors)[1:]) == pytest.approx(2.0, abs=0.25)


@pytest.mark.soak
def test_engines_and_batches_agree_on_a_sphere():
    edge = dx.ManifoldLagrangian(lambda q, v: v @ v / 2 - q[2], dx.Sphere(3), lambda q: jnp.stack([q[2], 0.3 * q[0], q[1]])[None])
    q, v = np.array([[0.6, 0.0, 0.8], [0.0, 0.6, 0.8]]), np.array([[0.8, 0.3, -0.6], [0.5, 0.8, -0.6]])
    for constraints in METHODS:
        run = {"step": 0.05, "steps": 5, "project": True}
        scheme = dx.DiscreteDirac(dx.SphereProjection(), constraints)
        native, xla = (dx.simulate(edge, scheme, q=q, v=v, engine=engine, **run) for engine in ("native", "xla"))
        one = dx.simulate(edge, scheme, q=q[1], v=v[1], engine="native", **run)
        assert native.ok.all() and xla.ok.all()
        assert np.abs(native.q - xla.q).max() < 1e-13 and np.abs(native.multipliers - xla.multipliers).max() < 1e-10
        assert np.array_equal(one.q, native.q[1])


# ---------------------------------------------------------------------- a ball that rolls on a sphere: S² × SO(3)

MASS, MOMENT, RADIUS, GAP, GRAVITY = 1.5, 0.3, 0.4, 1.4, 0.9  # GAP: the distance of the centres
BALL_SPACE = dx.Product(dx.Sphere(3), SO3)


def turned(g, body):
    """R(g) ξ."""
    w, a = g[0], g[1:]
    return body + 2 * w * jnp.cross(a, body) + 2 * jnp.cross(a, jnp.cross(a, body))


def slip(q, v):
    """The velocity of the ball's point of contact, GAP ṅ − RADIUS ω × n: of its three components two are independent."""
    return GAP * v[:3] - RADIUS * jnp.cross(turned(q[3:], SO3.to_algebra(q[3:], v[3:])), q[:3])


def ball_lagrangian(q, v):
    xi = SO3.to_algebra(q[3:], v[3:])
    return MASS * GAP**2 * v[:3] @ v[:3] / 2 + MOMENT * xi @ xi / 2 - MASS * GRAVITY * GAP * q[2]


ball = dx.ManifoldLagrangian(ball_lagrangian, BALL_SPACE, lambda q: jax.jacfwd(lambda v: slip(q, v))(jnp.zeros(7)))


def ball_ode(t, y, spin):
    """(m + k/r²) D n̈ = (k/r)(ω·n) n × ṅ − m g e_z, tangentially; ω·n is constant."""
    n, v = y[:3], y[3:]
    push = MOMENT / RADIUS * spin * np.cross(n, v) - MASS * GRAVITY * np.array([0.0, 0.0, 1.0])
    push = push - n * (n @ push)
    return np.concatenate([v, push / ((MASS + MOMENT / RADIUS**2) * GAP) - n * (v @ v)])


@pytest.mark.parametrize("constraints", METHODS)
@pytest.mark.soak
def test_a_ball_rolls_on_a_sphere(constraints):
    """By a product map; the redundant third row of the constraint is found and left out."""
    n, rate, spin = np.array([0.6, 0.0, 0.8]), np.array([0.4, 0.5, -0.3]), 2.0
    g = np.array([1.0, 0.0, 0.0, 0.0])
    omega = spin * n + GAP / RADIUS * np.cross(n, rate)
    v = np.concatenate([rate, np.asarray(SO3.left_translate(jnp.asarray(g), jnp.asarray(omega)))])
    exact = solve_ivp(ball_ode, (0, 1), np.concatenate([n, rate]), args=(spin,), method="DOP853", rtol=1e-12, atol=1e-13).y[:, -1]
    map = dx.ProductMap((dx.SphereProjection(), 3), (dx.LieGroupExp(SO3), 4))
    errors = []
    for steps in (20, 40, 80):
        run = {"q": np.concatenate([n, g]), "v": v, "step": 1 / steps, "steps": steps}
        sol = dx.simulate(ball, dx.DiscreteDirac(map, constraints), **run)
        assert sol.ok and len(sol.stats["redundant_constraints"]) == 1
        if constraints == "resolve":
            assert np.abs(sol.constraint_residual()).max() < 1e-13
        errors.append(np.abs(sol.q[-1, :3] - exact[:3]).max())
    assert np.log2(np.array(errors)[:-1] / np.array(errors)[1:]) == pytest.approx(2.0, abs=0.15)


@pytest.mark.parametrize("constraints", METHODS)
def test_a_knife_edge_on_the_circle_and_the_plane_by_a_product_map(constraints):
    """Its Lagrangian and one-form in an angle and two lengths: the run in coordinates by the midpoint map."""
    edge = dx.LagrangeDirac(lambda q, v: v @ v / 2 + 0.4 * q[1], lambda q: jnp.array([[0.0, jnp.sin(q[0]), -jnp.cos(q[0])]]))
    run = {"q": [0.4, 0.0, 0.0], "v": [3.0, np.cos(0.4), np.sin(0.4)], "step": 0.05, "steps": 60}  # more than a turn
    map = dx.ProductMap((dx.RiemannianExp(dx.Circle()), 1), (dx.Midpoint(), 2))
    one, other = (dx.simulate(edge, dx.DiscreteDirac(m, constraints), **run) for m in (map, dx.Midpoint()))
    assert one.ok and np.abs(one.q - other.q).max() < 1e-12 and np.abs(one.p - other.p).max() < 1e-12


# ---------------------------------------------------------------------- mistakes


@pytest.mark.parametrize(
    "system, map, data, message",
    [
        (suslov, dx.SphereProjection(), {"q": [1.0, 0, 0, 0], "v": [0.0, 0, 0, 0]}, r"the system is on SO3.*is on Sphere"),
        (
            dx.LagrangeDirac(lambda q, v: v @ v / 2), dx.SphereProjection(), {"q": [1.0, 0, 0], "v": [0.0, 1, 0]},
            "state the Lagrangian on the manifold",
        ),
        (suslov, dx.LieGroupExp(SO3), {"q": [1.0, 0, 0, 0], "v": [0.0, 1, 0, 0]}, "off the constraint"),
        (suslov, dx.LieGroupExp(SO3), {"q": [1.0, 0, 0, 0], "v": [1.0, 0, 0, 0]}, "v is not tangent"),
        (
            dx.ManifoldLagrangian(lambda q, v: v @ v / 2, dx.Sphere(3), lambda q: q[None]), dx.SphereProjection(),
            {"q": [1.0, 0, 0], "v": [0.0, 1, 0]}, "has no direction at the initial data",
        ),
    ],
)  # fmt: skip
def test_mistakes(system, map, data, message):
    with pytest.raises(ValueError, match=message):
        dx.simulate(system, dx.DiscreteDirac(map), **data, step=0.1, steps=2)


def test_projection_of_initial_data_onto_the_constraint():
    run = {"q": [1.0, 0, 0, 0], "v": [0.0, 1, 0.2, 0], "step": 0.1, "steps": 2, "project": True}
    sol = dx.simulate(suslov, dx.DiscreteDirac(dx.LieGroupExp(SO3), "resolve"), **run)
    assert np.abs(sol.constraint_residual()).max() < 1e-14


def test_constraints_and_forces_go_along_or_are_refused():
    """In coordinates they are pulled back; in the group's reduction forces have no place."""
    run = {"step": 0.1, "steps": 2}
    disk = dx.ManifoldLagrangian(
        lambda q, v: v @ v / 2, dx.Sphere(2), lambda q: jnp.stack([-q[1], q[0]])[None], affine=lambda q: -jnp.ones(1),
        forces=lambda t, q, v: -v,
    )  # fmt: skip
    angle = dx.in_coordinates(disk, lambda y: jnp.concatenate([jnp.cos(y), jnp.sin(y)]))
    sol = dx.simulate(angle, dx.DiscreteDirac(), q=[0.3], v=[1.0], **run)
    assert sol.q[:, 0] == pytest.approx([0.3, 0.4, 0.5]) and sol.multipliers[:, 0] == pytest.approx([1.0, 1.0])
    on_circle = dx.simulate(disk, dx.DiscreteDirac(dx.SphereProjection()), q=[1.0, 0.0], v=[0.0, 1.0], **run)
    assert np.linalg.norm(on_circle.q, axis=1) == pytest.approx(1.0)
    assert on_circle.multipliers.mean() == pytest.approx(1.0, abs=1e-2)  # those of Method 1 alternate around it
    with pytest.raises(ValueError, match="forces"):
        dx.reduce(suslov, SO3)


def test_a_circle_of_latitude_is_a_holonomic_constraint_on_the_sphere():
    """Without forces the motion on it is uniform; the height stays to roundoff, the angle is of second order."""
    height, rate = 0.6, 1.3
    radius = np.sqrt(1 - height**2)
    system = dx.ManifoldLagrangian(lambda q, v: v @ v / 2, dx.Sphere(3), holonomic=lambda q: q[2:] ** 3 - height**3)
    data = {"q": [radius, 0.0, height], "v": [0.0, radius * rate, 0.0]}
    missed = []
    for steps in (20, 40):
        sol = dx.simulate(system, dx.DiscreteDirac(dx.SphereProjection(), "resolve"), **data, step=1 / steps, steps=steps)
        assert sol.ok and np.abs(sol.constraint_residual()).max() < 1e-13 and np.abs(sol.q[:, 2] - height).max() < 1e-14
        missed.append(abs(np.arctan2(sol.q[-1, 1], sol.q[-1, 0]) - rate))
    assert missed[1] < 1e-12 or np.log2(missed[0] / missed[1]) == pytest.approx(2.0, abs=0.1)
    with pytest.raises(TypeError, match="do not keep holonomic constraints"):
        dx.simulate(system, dx.PlusLagrangeDirac(), **data, step=0.05, steps=2)
    off = {"q": [0.81, 0.0, np.sqrt(1 - 0.81**2)], "v": [0.0, 1.0, 0.0]}
    moved = dx.simulate(system, dx.DiscreteDirac(dx.SphereProjection(), "resolve"), **off, project=True, step=0.05, steps=2)
    assert np.abs(moved.constraint_residual()).max() < 1e-13 and moved.q[0, 2] == pytest.approx(height, abs=1e-14)
