"""Quotients of Σ × G with a curved Σ, in charts of Σ, beside the motion on Σ × G, other connections, and SciPy."""

from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import dirax as dx
from dirax.diagnostics.replay_lines import replayed
from dirax.diagnostics.structure_lines import membership, structure_of

SPHERE, SO3 = dx.Sphere(3), dx.SO3()
H = 0.1
INERTIA = jnp.array([1.0, 2.0, 3.0])
POLE = np.array([0.0, 0.0, 1.0])  # where angles on the sphere end


def of_body(x, rate, spin):
    """A point on a sphere that is fixed in a free body, coupled to its spin, which the body's turns leave alone."""
    kinetic = rate @ rate / 2 + spin @ (INERTIA * spin) / 2 + 0.4 * spin @ jnp.cross(x, rate)
    return kinetic + 0.3 * x[0] * spin[1] ** 2 - 2 * x[2]


BODY = dx.ManifoldLagrangian(lambda q, v: of_body(q[:3], v[:3], SO3.to_algebra(q[3:], v[3:])), dx.Product(SPHERE, SO3))
TILTED = dx.GroupConnection(SO3, lambda x0, x1: SO3.group_exp(0.3 * jnp.cross(x0, x1) + 0.2 * (x1 - x0)))
G0, RATE, SPIN = SO3.group_exp(jnp.array([0.2, -0.4, 0.1])), np.array([1.2, 0.3, 0.0]), np.array([0.5, 1.0, -0.3])
FROM: dict[str, Any] = {"q": np.append(POLE, G0), "v": np.append(RATE, SO3.left_translate(G0, jnp.asarray(SPIN)))}


@pytest.fixture(scope="module")
def body():
    """The motion on S² × SO(3), and on its quotient with two connections."""
    run = FROM | {"step": 0.05, "steps": 60}
    symmetries = (SO3, TILTED)
    return [dx.simulate(system, dx.LagrangeDAlembert(), **run) for system in (BODY, *(dx.reduce(BODY, s) for s in symmetries))]


@pytest.mark.soak
def test_a_body_with_a_point_on_a_sphere(body):
    """Both gauges are the unreduced motion, from the pole through several charts."""
    whole, plain, tilted = body
    for reduced in (plain, tilted):
        assert reduced.ok and len(np.unique(reduced.chart, axis=0)) > 3
        back = dx.reconstruct(reduced)
        np.testing.assert_allclose(back.q, whole.q, atol=5e-13)
        np.testing.assert_allclose(back.p, whole.p, atol=5e-12)
        np.testing.assert_allclose(reduced.energy(), whole.energy(), rtol=1e-12)
        spatial = np.array(
            [SO3.matrix(g) @ mu for g, mu in zip(jnp.asarray(reduced.g[::12]), jnp.asarray(reduced.mu[::12]), strict=True)]
        )
        assert np.ptp(spatial, axis=0).max() < 1e-13 < 0.1 < np.ptp(reduced.mu, axis=0).max()
    assert np.min(whole.q[:, 2]) < -0.5
    np.testing.assert_allclose(plain.x, tilted.x, atol=5e-13)  # the shape knows no gauge; w and the vertical part do
    assert np.abs(plain.w - tilted.w).max() > 0.1 < np.abs(plain.vertical - tilted.vertical).max() / 0.05


def test_the_tilted_momenta_and_vertical_parts_by_hand(body):
    """w = p_x + A(x)ᵀμ with A(x)ẋ = 0.3 x × ẋ + 0.2 ẋ, and v = (h⁰_d)⁻¹ g0⁻¹ g1."""
    _, plain, tilted = body
    for k in (7, 31):
        x, mu = tilted.x[k], tilted.mu[k]
        shift = 0.3 * np.cross(mu, x) + 0.2 * mu
        np.testing.assert_allclose(tilted.w[k] - plain.w[k], shift - x * (x @ shift), atol=1e-12)
        f = SO3.multiply(SO3.inverse(plain.g[k]), plain.g[k + 1])
        lift = TILTED.lift_of_shapes(jnp.asarray(x), jnp.asarray(tilted.x[k + 1]))
        np.testing.assert_allclose(tilted.vertical[k], SO3.group_log(SO3.multiply(SO3.inverse(lift), f)), atol=1e-13)


@pytest.mark.soak
def test_the_order_beside_hamels_equations_in_space(body):
    """(∂L/∂ẋ)˙ = ∂L/∂x + λx with |x| = 1, (∂L/∂ω)˙ = ∂L/∂ω × ω, by SciPy in R³ × R³."""
    slopes, hessians = jax.jit(jax.grad(of_body, (0, 1, 2))), jax.jit(jax.hessian(lambda x, z: of_body(x, z[:3], z[3:]), 1))
    mixed = jax.jit(jax.jacfwd(lambda x, z: jax.grad(lambda z: of_body(x, z[:3], z[3:]))(z)))

    def right(t, y):
        x, rate, spin = np.split(y, 3)
        z = y[3:]
        along, _, momentum = slopes(x, rate, spin)
        force = np.concatenate([along, np.cross(momentum, spin)]) - mixed(x, z) @ rate
        normal = np.append(x, np.zeros(3))
        matrix = np.block([[np.asarray(hessians(x, z)), -normal[:, None]], [normal[None], np.zeros((1, 1))]])
        return np.concatenate([rate, np.linalg.solve(matrix, np.append(force, -rate @ rate))[:6]])

    exact = solve_ivp(right, (0, 3.0), np.concatenate([POLE, RATE, SPIN]), rtol=1e-11, atol=1e-12, method="DOP853").y[:3, -1]
    errors = [np.linalg.norm(body[1].x[-1] - exact)]
    for steps in (120, 240):
        run = FROM | {"step": 3.0 / steps, "steps": steps}
        errors.append(np.linalg.norm(dx.simulate(dx.reduce(BODY, SO3), dx.LagrangeDAlembert(), **run).x[-1] - exact))
    assert -np.diff(np.log2(errors)) == pytest.approx([2, 2], abs=0.1)


ROW = lambda q: jnp.array([-q[1], q[0], 0.3, 1.0])
TURNING = lambda q, v: v @ v / 2 + 0.3 * v[3] * (q[0] * v[1] - q[1] * v[0]) - 3 * q[2]
SPACE = dx.Product(SPHERE, dx.Circle())
FREE, TIED = (dx.ManifoldLagrangian(TURNING, SPACE, forms) for forms in (None, lambda q: ROW(q)[None]))
BENT = dx.DiscreteConnection(lambda a, b: b[3:] - a[3:] - (a[2:3] + b[2:3]) * (b[:1] - a[:1]) / 2, [3])


@pytest.mark.parametrize(
    ("system", "scheme", "connection"),
    [
        (FREE, dx.PlusLagrangeDirac(), dx.LinearConnection([3], [[0.3, -0.2, 0.5]])),
        (TIED, dx.MinusLagrangeDirac("right"), BENT),
    ],
    ids=["free (+), linear", "constrained (−), bent"],
)
@pytest.mark.soak_of("free (+), linear")
def test_by_a_circle_connections_are_functions_of_points_in_space(system, scheme, connection):
    q, rate = np.append(POLE, 0.4), np.array([1.5, 0.3, 0.0])
    v = np.append(rate, 0.5 if system is FREE else -np.asarray(ROW(q))[:3] @ rate)
    run: dict[str, Any] = {"q": q, "v": v, "step": H, "steps": 40}
    whole = dx.simulate(system, scheme, **run)
    reduced = dx.simulate(dx.reduce(system, connection), scheme, **run)
    assert reduced.ok and len(np.unique(reduced.chart, axis=0)) > 3
    back = dx.reconstruct(reduced)
    np.testing.assert_allclose(back.q, whole.q, atol=1e-12)
    np.testing.assert_allclose(back.p, whole.p, atol=1e-12)
    if system is FREE:
        assert np.ptp(reduced.mu) == 0.0
        return
    np.testing.assert_allclose(back.multipliers, whole.multipliers, atol=1e-12)
    assert np.ptp(reduced.mu) > 0.5
    report = dx.verify(reduced)
    of_structure = ("(−)-discrete Dirac structure", "structural relation φ*Ω = Ω + dβ")
    for line in ("steps replayed", "action sum stationary", *of_structure):
        assert report[line].verdict == "ok" and (report[line].value or 0.0) < 1e-14, report[line]
    reduced.fields["mu"] = reduced.mu + 1e-9 * (np.arange(41) == 7)[:, None]
    whole = dx.reconstruct(reduced)
    lines = replayed(reduced, None), *membership(whole, structure_of(whole), None)
    assert {line.quantity for line in lines if line.verdict == "VIOLATED"} >= {"steps replayed", "saved p and multipliers"}


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: dx.reduce(TIED, dx.LinearConnection([2])), r"q\[2\], a coordinate of Sphere.*in which translations do not act"),
        (lambda: dx.reduce(TIED, dx.LinearConnection([4])), r"fibre \[4\] does not fit a system of 4 coordinates"),
        (lambda: dx.reduce(TIED, dx.LinearConnection([3], [[1.0]])), r"horizontal must have shape \(1, 3\)"),
        (lambda: dx.reduce(TIED, SO3), r"Q = Σ × G, but SO3 is no factor of Sphere × Torus: take a factor of it"),
        (lambda: dx.GroupConnection(cast(Any, SPHERE)), r"group must be one such as dx.SO3\(\)"),
        (lambda: dx.GroupConnection(SO3, lambda x: x), r"lift"),
        (
            lambda: dx.reduce(BODY, dx.GroupConnection(SO3, lambda x0, x1: SO3.group_exp(x1))),
            r"h⁰_d\(x, x\) = e fails by 0\.\d+ at x",
        ),
        (lambda: dx.reduce(BODY, dx.GroupConnection(SO3, lambda x0, x1: x1)), r"of shape \(4,\), but it returned shape \(3,\)"),
        (
            lambda: dx.reduce(BODY, dx.GroupConnection(SO3, lambda x0, x1: jnp.append(x1 - x0, 2.0))),
            r"lift\(x0, x1\) is no element of SO3",
        ),
        (
            lambda: dx.reduce(dx.ManifoldLagrangian(lambda q, v: v @ v / 2, dx.Product(SO3, SPHERE, SO3)), SO3),
            r"SO3 is 2 factors of SO3 × Sphere × SO3, numbers \[0, 2\]: say which",
        ),
        (lambda: dx.reduce(dx.reduce(BODY, SO3), SO3), "name the whole symmetry at once"),
        (
            lambda: dx.simulate(dx.reduce(BODY, SO3), dx.DiscreteRouth(), **FROM, step=H, steps=1),
            "dx.DiscreteRouth steps quotients in coordinates",
        ),
        (
            lambda: dx.simulate(
                dx.reduce(dx.ManifoldLagrangian(lambda q, v: v @ v / 2 - q[3], BODY.manifold), SO3),
                dx.PlusLagrangeDirac(), **FROM, step=H, steps=1,
            ),
            r"(?s)the lagrangian is not invariant under left translations by generator \d of SO3.*step the system itself",
        ),
        (
            lambda: dx.simulate(
                dx.reduce(FREE, dx.LinearConnection([3])),
                dx.PlusLagrangeDirac(lambda q0, q1, h: (q1 - q0) @ (q1 - q0) / (2 * h) - h * jnp.cos(q0[3])),
                q=np.append(POLE, 0.4), v=np.append(RATE, 0.5), step=H, steps=1,
            ),
            "the discrete_lagrangian is not invariant under left translations by generator 0 of Euclidean",
        ),
    ],
)  # fmt: skip
def test_errors_say_what_came_and_the_way_out(make, message):
    with pytest.raises((TypeError, ValueError), match=message):
        make()
