"""Composed Method 1 on manifolds with constraints: order of q, p and impulses, from explicit equations in the ambient space."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import dirax as dx

S2_R = dx.Product(dx.Sphere(3), dx.Euclidean(1))
MAPS = {
    "projection": dx.ProductMap((dx.SphereProjection(), 3), (dx.Midpoint(), 1)),
    "exponential": dx.ProductMap((dx.RiemannianExp(dx.Sphere(3)), 3), (dx.Midpoint(), 1)),
}


def lagrangian(q, v):
    """A point of the sphere and a slider, coupled."""
    inertias = v[:3] @ v[:3] / 2 + 0.6 * v[3] ** 2 * (1 + 0.2 * q[0] ** 2)
    return inertias + 0.3 * q[1] * v[0] * v[3] - 0.5 * q[2] - 0.3 * q[3] ** 2


def rows(q):
    return jnp.array([[0.3 * q[1], 0.2, 0.1 * q[3], 1.0]])


def affine(t, q):
    return jnp.array([0.1 * q[3] * jnp.cos(t)])


def curve(q):
    return jnp.array([q[3] - 0.5 * q[0] ** 2])


def drag(t, q, v):
    return -0.1 * v


Q, T = np.array([0.6, 0.0, 0.8, 0.18]), 1.0
CASES = {
    "one-form": {},
    "affine, forces": {"affine": affine, "forces": drag},
    "holonomic": {"holonomic": curve},
}


def at_end(v, affine=None, forces=None, holonomic=None):
    """q, p and the impulse of the one-form at T of the motion in R^4, with the sphere among the constraints: their multipliers
    follow from the second derivatives."""
    sphere = lambda q: (q[:3] @ q[:3] - 1)[None] / 2
    g = sphere if holonomic is None else lambda q: jnp.concatenate([sphere(q), holonomic(q)])
    matrix = lambda q: jnp.concatenate([rows(q), jax.jacfwd(g)(q)])
    momentum = jax.grad(lagrangian, 1)

    @jax.jit
    def slopes(t, y):
        q, v = y[:4], y[4:8]
        moved = lambda t, q: (matrix(q) @ v).at[:1].add(0.0 if affine is None else affine(t, q))
        force = jax.grad(lagrangian)(q, v) - jax.jacfwd(momentum)(q, v) @ v + (0.0 if forces is None else forces(t, q, v))
        w, turning = matrix(q), jax.jacfwd(moved, 1)(t, q) @ v + jax.jacfwd(moved)(t, q)
        whole = jnp.block([[jax.jacfwd(momentum, 1)(q, v), -w.T], [w, jnp.zeros((len(w), len(w)))]])
        found = jnp.linalg.solve(whole, jnp.concatenate([force, -turning]))
        return jnp.concatenate([v, found[:5]])

    y = solve_ivp(slopes, (0.0, T), np.concatenate([Q, v, [0.0]]), method="DOP853", rtol=1e-12, atol=1e-13).y[:, -1]
    return y[:4], np.asarray(momentum(y[:4], y[4:8])), y[8], np.asarray(jax.jacfwd(g)(y[:4]))


def off_span(covector, span):
    """A covector without its part in a span of others."""
    return covector - span.T @ np.linalg.solve(span @ span.T, span @ covector)


@pytest.mark.parametrize(
    ("case", "map"),
    [
        ("affine, forces", "projection"),
        ("holonomic", "projection"),
        *(pytest.param("one-form", map, marks=pytest.mark.soak) for map in MAPS),
    ],
)
@pytest.mark.soak_of("holonomic-projection")
def test_momenta_and_impulses_have_the_order_of_q(case, map):
    """What is off the constraints in p changes its sign in every plain step, and stayed of order 2."""
    system = dx.ManifoldLagrangian(lagrangian, S2_R, rows, **CASES[case])
    v = np.asarray(system.project_velocity(jnp.asarray(Q), jnp.array([0.4, 0.5, -0.3, 0.2])))
    q, p, impulse, normals = at_end(v, **CASES[case])
    errors = []
    for steps in (8, 16, 32):
        scheme = dx.Composition(dx.DiscreteDirac(MAPS[map]), "suzuki4")
        sol = dx.simulate(system, scheme, q=Q, v=v, step=T / steps, steps=steps)
        found = np.sum(sol.multipliers[:, 0]) * sol.step
        errors.append([np.abs(sol.q[-1] - q).max(), np.abs(off_span(sol.p[-1] - p, normals)).max(), abs(found - impulse)])
    slopes = -np.diff(np.log2(errors), axis=0)
    assert np.all(slopes > 3.6), (slopes, errors)
    assert np.abs(sol.constraint_residual()).max() < 1e-12 or case == "holonomic"
    assert map == "exponential" or case == "one-form" or dx.verify(sol).ok


def test_on_a_flat_manifold_it_is_that_of_the_lagrangian_in_coordinates():
    flat = lambda q, v: lagrangian(q, v) + v[2] * v[1] / 5
    start = {"q": Q, "v": np.array([0.4, 0.5, -0.3, 0.2])}
    start["v"][3] -= np.asarray(rows(Q))[0] @ start["v"]
    scheme = dx.Composition(dx.DiscreteDirac(), "suzuki4")
    systems = dx.LagrangeDirac(flat, rows), dx.ManifoldLagrangian(flat, dx.Euclidean(4), rows)
    one, other = (dx.simulate(system, scheme, **start, step=0.05, steps=20) for system in systems)
    for name in ("q", "p", "multipliers"):
        assert np.abs(one.fields[name] - other.fields[name]).max() < 1e-11, name


@pytest.mark.parametrize("engine", ["native", "xla"])
@pytest.mark.parametrize("map", [dx.SphereProjection(), dx.RiemannianExp(dx.Sphere(3))])
def test_short_steps_round_no_more_than_long_ones(engine, map):
    """A velocity from a difference of points has their roundoff by h, and gave it to p: 10⁻¹³ a step of h = 10⁻⁴."""
    pendulum = dx.ManifoldLagrangian(lambda q, v: v @ v / 2 - q[2], dx.Sphere(3))
    run = {"q": [0.0, 0.6, 0.8], "v": [0.5, 0.0, 0.0], "step": 1e-4, "steps": 1000, "engine": engine}
    energy = dx.simulate(pendulum, dx.DiscreteDirac(map), **run).energy()
    assert np.max(np.abs(np.diff(energy, 2))) < 3e-15


@pytest.mark.parametrize("step", [1e-2, 1e-4])
def test_method_2_of_points_on_a_rod_is_solved_on_the_native_engine(step):
    """The second half of its step is solved after the first, whose velocity is a difference of points over h."""
    rod = lambda q: jnp.stack([(q[:3] - q[3:]) @ (q[:3] - q[3:]) - 1.0])
    weights = lambda q, v: 0.6 * v[:3] @ v[:3] + 0.25 * v[3:] @ v[3:] - 9.81 * (1.2 * q[2] + 0.5 * q[5])
    system = dx.ManifoldLagrangian(weights, dx.Euclidean(6), holonomic=rod)
    start = {"q": [0.1, 0.2, 1.0, 0.1, 0.2, 0.0], "v": [0.3, -0.1, 0.2, 0.7, -0.4, 0.2]}
    sol = dx.simulate(system, dx.DiscreteDirac(dx.Midpoint(), constraints="resolve"), step=step, steps=100, **start)
    assert sol.stats["engine"] == "native" and dx.verify(sol)["steps replayed"].verdict == "ok"
    falling = np.sum(np.asarray(sol.p)[:, [2, 5]], axis=1) - (1.2 * 0.2 + 0.5 * 0.2 - 9.81 * 1.7 * sol.t)
    assert np.max(np.abs(np.diff(falling))) < 1e-14
