"""Derivatives of native runs: against the xla engine, a closed form and finite differences; forward, backward, twice."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dirax as dx
from dirax.engines.contract import Problem
from dirax.engines.native import Native
from dirax.engines.native.gradients import differentiate, tangents_on_host
from dirax.geometry.squared_angles import arc_over_sine
from dirax.program.interpreter import UnsupportedPrimitive
from dirax.schemes.step import Field, StepEquation

MIDPOINT = dx.LagrangeDAlembert()


def pendulums(q, v, params):
    kinetic = params["m"] * v[0] ** 2 + v[1] ** 2 / 2 + v[0] * v[1] * jnp.cos(q[0] - q[1])
    return kinetic + params["g"] * (2 * jnp.cos(q[0]) + jnp.cos(q[1]))


PENDULUMS = dx.LagrangeDirac(pendulums)
DISK = dx.LagrangeDirac(
    lambda q, v, g: (v[0] ** 2 + v[1] ** 2) / 2 + v[2] ** 2 / 8 + v[3] ** 2 / 4 - g * jnp.sin(q[2]),
    lambda q: jnp.array([[1.0, 0.0, -jnp.cos(q[3]), 0.0], [0.0, 1.0, -jnp.sin(q[3]), 0.0]]),
)
OPEN = dx.PortHamiltonian(
    lambda x, k: k * x[0] ** 4 / 4 + x @ x / 2, J=np.array([[0.0, 1.0], [-1.0, 0.0]]), B=np.array([[0.0], [1.0]])
)
GRAVITY = {"m": 1.0, "g": 9.81}


def rows_of(sol) -> jax.Array:
    """Every saved array in one."""
    return jnp.concatenate([jnp.ravel(sol.fields[name]) for name in sorted(sol.fields)])


def swing(engine, q, v, params, h: Any = 0.02, scheme: Any = MIDPOINT, **more: Any):
    return dx.simulate(PENDULUMS, scheme, q=q, v=v, params=params, step=h, engine=engine, **({"steps": 30} | more))


def roll(engine, q, v, g, **more):
    return dx.simulate(DISK, dx.PlusLagrangeDirac(), q=q, v=v, params=g, step=1e-3, engine=engine, project=True, **more)


def driven(engine, x, k, h):
    inputs = lambda t, x, k: jnp.stack([jnp.cos(3 * t) * k])
    return dx.simulate(OPEN, dx.DiscreteGradient(), x=x, params=k, step=h, steps=25, t0=0.3, engine=engine, inputs=inputs)


POINT = (jnp.array([1.0, 0.5]), jnp.array([0.0, 0.5]))
SPREAD = (jnp.array([[1.0, 0.5], [0.3, 2.0], [-1.0, 0.1]]), jnp.array([[0.0, 0.5], [1.0, 0.0], [0.2, -0.4]]))
SEVERAL = {"m": jnp.array([1.0, 1.1, 0.9]), "g": jnp.array([9.81, 5.0, 1.6])}
RUNS = {
    "every row": (lambda e, *z: swing(e, *z), (*POINT, GRAVITY, 0.02)),
    "some rows": (lambda e, *z: swing(e, *z, save_every=7), (*POINT, GRAVITY, 0.02)),
    "batch": (lambda e, *z: swing(e, *z, save_every=4, steps=20), (*SPREAD, GRAVITY, 0.02)),
    "batch of parameters": (lambda e, *z: swing(e, *z, batch_params=True, steps=20), (*SPREAD, SEVERAL, 0.02)),
    "composition": (
        lambda e, *z: swing(e, *z, scheme=dx.Composition(MIDPOINT, "yoshida4"), steps=12, save_every=5),
        (*POINT, GRAVITY, 0.02),
    ),
    "two equations": (
        lambda e, *z: swing(e, *z, scheme=dx.SymmetricComposition(dx.PlusLagrangeDirac()), steps=12),
        (*POINT, GRAVITY, 0.02),
    ),
    "constraints": (
        lambda e, *z: roll(e, *z, steps=30, save_every=4),
        (jnp.array([0.0, 0.0, 0.0, 1.0]), jnp.array([5.0, 8.0, 10.0, 1.0]), 10.0),
    ),
    "time and inputs": (driven, (jnp.array([1.0, -0.5]), 0.7, 0.05)),
}


QUICK = ("batch of parameters",)


@pytest.mark.parametrize("name", [name if name in QUICK else pytest.param(name, marks=pytest.mark.soak) for name in RUNS])
@pytest.mark.soak
def test_cotangents_of_all_rows_are_the_xla_engines(name):
    """With random weights on every saved number: positions, momenta and multipliers, by initial data, params and step."""
    run, point = RUNS[name]
    weights = np.random.default_rng(0).normal(size=10_000)

    def loss(engine, *z):
        rows = rows_of(run(engine, *z))
        return rows @ weights[: rows.shape[0]]

    arguments = tuple(range(len(point)))
    mine = jax.jit(jax.grad(lambda *z: loss("native", *z), arguments))(*point)
    theirs = jax.jit(jax.grad(lambda *z: loss("xla", *z), arguments))(*point)
    for a, b in zip(jax.tree.leaves(mine), jax.tree.leaves(theirs), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-10, atol=1e-10 * float(np.max(np.abs(b))))
    # forward: the same derivative along a direction
    direction = jax.tree.map(lambda a: jnp.cos(jnp.arange(jnp.size(a), dtype=float)).reshape(jnp.shape(a)), point)
    along = jax.jit(lambda *z: jax.jvp(lambda *z: loss("native", *z), z, direction)[1])(*point)
    products = jax.tree.leaves(jax.tree.map(lambda a, b: jnp.sum(a * b), theirs, direction))
    scale = sum(float(np.sum(np.abs(np.asarray(a) * np.asarray(b)))) for a, b in zip(
        jax.tree.leaves(theirs), jax.tree.leaves(direction), strict=True))  # fmt: skip
    assert abs(float(along - sum(products))) < 1e-10 * scale


def end_of_swing(engine):
    """(q, p) after 12 steps, as a function of q, v and the parameters, and a point."""
    end = lambda s: jnp.concatenate([s.q[-1], s.p[-1]])
    return lambda z: end(swing(engine, z[:2], z[2:4], {"m": z[4], "g": z[5]}, steps=12)), jnp.array(
        [1.0, 0.5, 0.0, 0.5, 1.0, 9.81]
    )


@pytest.mark.soak
def test_second_derivatives():
    (mine, z), (theirs, _) = end_of_swing("native"), end_of_swing("xla")
    curvature = lambda f: jax.jit(jax.hessian(lambda z: f(z)[2]))(z)
    np.testing.assert_allclose(curvature(mine), curvature(theirs), rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize(
    ("engine", "holonomic"),
    [("native", False), *(pytest.param(*both, marks=pytest.mark.soak) for both in (("xla", False), ("native", True)))],
)
@pytest.mark.soak
def test_second_derivatives_of_a_nonlinear_run(engine, holonomic):
    """Forward and reverse, and for a batch: beside differences of the first."""
    more = {"holonomic": lambda q: jnp.array([(q @ q - 1) / 2])} if holonomic else {}
    system = dx.LagrangeDirac(lambda q, v, params: v @ v / 2 - params * q[1] ** 2, **more)
    q0 = jnp.array([np.sin(0.5), -np.cos(0.5)])

    def end(k):
        sol = dx.simulate(system, MIDPOINT, q=q0, v=jnp.zeros(2), params=k, step=0.05, steps=3, engine=engine)
        return sol.q[-1] ** 2 @ jnp.array([1.0, 2.0])

    slope, k, d = jax.grad(end), 9.81, 1e-4
    ways = jax.jit(lambda k: (jax.value_and_grad(slope)(k), jax.jacfwd(slope)(k), jax.vmap(jax.grad(slope))(jnp.stack([k, k]))))
    wanted = (ways(k + d)[0][0] - ways(k - d)[0][0]) / (2 * d)
    (_, twice), *others = ways(k)
    for found in (twice, *others):
        np.testing.assert_allclose(found, wanted, rtol=1e-7)


@pytest.mark.parametrize(
    "scheme",
    [MIDPOINT, dx.Composition(MIDPOINT, "suzuki4"), dx.DiscreteDirac(constraints="resolve"), dx.Collocation(2)],
    ids=["midpoint", "composed", "Method 2", "Gauss"],
)
@pytest.mark.soak_of(but=["Method 2"])
def test_second_derivatives_are_native_in_every_way_and_symmetric(scheme, monkeypatch):
    """Of data, parameters, the step and the time, with forces and explicit time: the run with its tangent is another such run.
    XLA took fifteen seconds for what takes three."""
    monkeypatch.setattr(differentiate, "_reference", lambda *_: pytest.fail("by XLA"))
    driven = dx.LagrangeDirac(
        lambda q, v, k: v @ v / 2 + jnp.cos(q[0]) * v[0] * v[1] / 2 - k * q[0] ** 4 - q @ q / 2,
        forces=lambda t, q, v, k: jnp.stack([jnp.sin(k * t), -0.1 * v[1]]),
    )

    def end(z):
        run = {"q": z[:2], "v": jnp.array([0.1, 0.2]), "params": z[2], "step": z[3], "t0": z[4], "steps": 4}
        sol = dx.simulate(driven, scheme, **run)
        return sol.q[-1] @ jnp.array([1.0, 2.0]) + sol.p[-1, 1] ** 2 + jnp.sum(sol.q[:, 0] ** 2)

    z = jnp.array([0.3, 0.4, 0.7, 0.05, 0.2])
    both = jax.jit(jax.jacfwd(lambda z: (jax.grad(end)(z),) * 2, has_aux=True))
    found, slope = both(z)[0], lambda z: both(z)[1]
    wanted = np.stack([(slope(z + d) - slope(z - d)) / 2e-5 for d in 1e-5 * np.eye(5)])
    np.testing.assert_allclose(found, wanted, rtol=1e-7, atol=1e-7 * np.max(np.abs(wanted)))
    np.testing.assert_allclose(found, found.T, rtol=1e-11, atol=1e-11 * np.max(np.abs(wanted)))
    if scheme == MIDPOINT:
        others = jax.jit(lambda z: [jax.jacfwd(jax.jacfwd(end))(z), jax.jacrev(jax.jacrev(end))(z)])(z)
        for other in others:
            np.testing.assert_allclose(other, found, rtol=1e-11, atol=1e-11 * np.max(np.abs(wanted)))


@pytest.mark.soak
def test_third_derivatives():
    quartic = dx.LagrangeDirac(lambda q, v, k: v @ v / 2 - k * q[0] ** 4 / 4 - q[0] ** 2 * q[1] - q @ q / 2)
    end = lambda z: dx.simulate(quartic, MIDPOINT, q=z[:2], v=jnp.ones(2), params=z[2], step=0.05, steps=20).q[-1, 1]
    z, curvature = jnp.array([0.3, 0.4, 0.7]), jax.jit(jax.hessian(end))
    wanted = np.stack([(curvature(z + d) - curvature(z - d)) / 2e-4 for d in 1e-4 * np.eye(3)], axis=-1)
    np.testing.assert_allclose(jax.jacfwd(jax.hessian(end))(z), wanted, atol=1e-7 * np.max(np.abs(wanted)))


@pytest.mark.soak
def test_jit_and_vmap():
    (mine, z), (theirs, _) = end_of_swing("native"), end_of_swing("xla")
    expected = jax.jit(jax.jacrev(theirs))(z)
    for transform in (jax.jacrev, lambda f: jax.jit(jax.jacrev(f)), lambda f: jax.jit(jax.jacfwd(f))):
        np.testing.assert_allclose(transform(mine)(z), expected, rtol=1e-11, atol=1e-12)
    steps = np.array([0.01, 0.02])  # another step in each lane of a vmap
    by_step = lambda h, e: swing(e, *POINT, GRAVITY, h, steps=10).p[-1].sum()
    found, expected = (jax.jit(jax.vmap(jax.grad(by_step), (0, None)), static_argnums=1)(steps, e) for e in ("native", "xla"))
    np.testing.assert_allclose(found, expected, rtol=1e-11)


def test_derivatives_of_a_long_run_against_the_closed_form(monkeypatch):
    """Oscillator, 3000 steps in many segments: q_k = q cos kθ + v/ω sin kθ with θ = 2 arctan(hω/2)."""
    monkeypatch.setattr(tangents_on_host, "SEGMENT_BYTES", 5000)
    system = dx.LagrangeDirac(lambda q, v, omega: (v @ v - omega**2 * q @ q) / 2)
    end = lambda q, v, omega: dx.simulate(
        system, MIDPOINT, q=jnp.stack([q]), v=jnp.stack([v]), params=omega, step=0.1, steps=3000, save_every=500, engine="native"
    ).q[-1, 0]  # fmt: skip
    q, v, omega, k = 0.8, -0.3, 1.7, 3000
    angle, turn = k * 2 * np.arctan(0.1 * omega / 2), k * 0.1 / (1 + (0.1 * omega / 2) ** 2)
    by_omega = (-q * np.sin(angle) + v / omega * np.cos(angle)) * turn - v / omega**2 * np.sin(angle)
    expected = np.array([np.cos(angle), np.sin(angle) / omega, by_omega])
    np.testing.assert_allclose(jax.grad(end, (0, 1, 2))(q, v, omega), expected, rtol=1e-10)
    forward = [jax.jvp(end, (q, v, omega), tuple(row))[1] for row in np.eye(3)]
    np.testing.assert_allclose(forward, expected, rtol=1e-10)


@jax.custom_jvp
def rounded(x):
    return jnp.round(x)


rounded.defjvp(lambda primals, tangents: (rounded(*primals), (1 + rounded(*primals)) * tangents[0]))


@jax.custom_vjp
def reversed_flow(x):
    return 1.0 * x


reversed_flow.defvjp(lambda x: (1.0 * x, None), lambda _, flow: (-flow,))


@jax.custom_vjp
def clipped_flow(x):
    return 1.0 * x


clipped_flow.defvjp(lambda x: (1.0 * x, None), lambda _, flow: (jnp.clip(flow, -9.0, 9.0),))
RULES = {
    "stop_gradient": (lambda k: jax.lax.stop_gradient(k) + 0 * k, "native"),
    "custom_jvp": (rounded, "native"),
    "custom_vjp": (reversed_flow, "native"),
    "a rule that is not linear": (clipped_flow, "xla"),
    "rules of jax.nn": (lambda k: jax.nn.logsumexp(jnp.stack([k, 1.0])) + jax.nn.softplus(k) * jax.nn.relu(k), "native"),
}


@pytest.mark.parametrize("name", RULES)
@pytest.mark.soak_of("stop_gradient", "custom_vjp")
def test_functions_keep_the_rules_of_their_derivatives(name):
    """A force f(k) for one second: the momentum moves as JAX says that f does; and so inside of a Lagrangian."""
    f, engine = RULES[name]
    forced = dx.LagrangeDirac(lambda q, v, k: v @ v / 2, forces=lambda t, q, v, k: jnp.stack([f(k)]))
    inside = dx.LagrangeDirac(lambda q, v, k: v @ v / 2 + f(k) * q[0])

    def end(k, system):
        sol = dx.simulate(system, MIDPOINT, q=jnp.zeros(1), v=jnp.zeros(1), params=k, step=0.25, steps=4)
        assert sol.stats["engine"] == engine
        return sol.p[-1, 0]

    slopes = jax.jit(lambda k: [jax.grad(f)(k), *(jax.grad(end)(k, system) for system in (forced, inside))])(1.7)
    np.testing.assert_allclose(slopes[1:], slopes[0], rtol=1e-12)


@pytest.mark.soak
def test_a_trajectory_that_ends_keeps_its_derivative_and_spoils_no_other():
    """L = v²/2 − q + 10⁻⁴√q falls out of its domain; up to there against central differences."""
    falling = dx.LagrangeDirac(lambda q, v: v @ v / 2 - q[0] + 1e-4 * jnp.sqrt(q[0]))

    def rows(q):
        sol = dx.simulate(falling, MIDPOINT, q=q, v=jnp.array([[40.0], [-1.0]]), step=0.01, steps=200, save_every=20)
        return jnp.where(jnp.isnan(sol.q), 0.0, sol.q)[..., 0]

    q = np.array([[1.0], [0.5]])
    slopes = jax.jit(jax.jacrev(rows))(q)[..., 0]
    nudge = 1e-5 * np.eye(2)[:, :, None]
    expected = np.stack([(rows(q + d) - rows(q - d)) / 2e-5 for d in nudge], axis=-1)
    assert int(np.sum(slopes[1, :, 1] != 0)) == int(np.ceil((np.sqrt(2) - 1) / 0.2))  # the rows before q = 1/2 − t − t²/2 is zero
    np.testing.assert_allclose(slopes, expected, rtol=1e-8, atol=1e-8)


def test_small_pivots_are_exchanged_in_derivatives_too():
    """The matrix [[s, 1], [1, s]] with s = 1e-20 and 1e20: ∂u/∂x is its inverse."""
    equation = StepEquation(
        start=lambda data, h, c: (data["x"], data["x"]),
        residual=lambda u, x, t, h, c: jnp.stack([jnp.exp(c) * u[0] + u[1], u[0] + jnp.exp(c) * u[1]]) - x,
        advance=lambda u, x, t, h, c: u,
        unpack=lambda x, u, t, h, c: {"x": x},
        state_size=2,
        unknowns=2,
        fields={"x": Field((2,))},
    )

    def last(x, s):
        p = Problem(equation, x, (x,), 0.1, 0.0, 1, params=s)
        return Native().run_traced(p).fields["x"][0, -1]

    for s in (np.log(1e-20), np.log(1e20), 0.4):
        matrix = np.array([[np.exp(s), 1.0], [1.0, np.exp(s)]])
        slopes = jax.jit(jax.jacrev(last))(jnp.array([1.0, 2.0]), s)
        np.testing.assert_allclose(slopes, np.linalg.inv(matrix), rtol=1e-12, atol=1e-25)


@pytest.mark.soak
def test_what_the_kernel_cannot_take_is_run_by_xla_under_auto():
    system = dx.LagrangeDirac(lambda q, v: v @ v / 2 - jnp.sum(jnp.sort(q) ** 2 * jnp.array([1.0, 2.0])))
    run = lambda q, e: dx.simulate(system, MIDPOINT, q=q, v=jnp.zeros(2), step=0.1, steps=3, engine=e)
    engines = []
    slope = jax.grad(lambda q: (engines.append((s := run(q, "auto")).stats), s.q[-1].sum())[1])(jnp.array([1.0, 0.5]))
    assert np.all(np.isfinite(slope)) and engines[0]["engine"] == "xla" and "sort" in engines[0]["not_native"]
    with pytest.raises(UnsupportedPrimitive, match="sort"):
        jax.grad(lambda q: run(q, "native").q[-1].sum())(jnp.array([1.0, 0.5]))


def test_a_formula_moves_as_its_slopes_say_in_every_order():
    """φ/sin φ of sin² and cos² of φ/2 knows its slope by the first alone, and is asked where the two do not add up to one."""
    bent = dx.LagrangeDirac(lambda q, v: v @ v / 2 - arc_over_sine(0, q @ q / 4, 1.0 - q[0] / 2))
    run = {"v": [0.1, 0.3], "step": 0.1, "steps": 2}
    native, xla = (lambda z, e=engine: dx.simulate(bent, MIDPOINT, q=z, engine=e, **run).p[-1, 0] for engine in ("native", "xla"))
    z, ways = jnp.array([0.4, 0.7]), ((jax.jacfwd, jax.grad), (jax.grad, jax.grad), (jax.jacfwd, jax.jacfwd))
    slope_along = lambda f, inner, s: inner(f)(z + s * jnp.array([0.6, 0.8]))
    wanted = jax.jit(lambda s: jax.jvp(lambda s: slope_along(xla, jax.grad, s), (s,), (1.0,)))(0.0)
    found = jax.jit(
        lambda s: (jax.grad(native)(z + s), [outer(lambda s, i=inner: slope_along(native, i, s)[1])(s) for outer, inner in ways])
    )(0.0)
    np.testing.assert_allclose(found[0], wanted[0], rtol=1e-12)
    np.testing.assert_allclose(found[1], wanted[1][1], rtol=1e-11)


@pytest.mark.soak
@pytest.mark.parametrize("way", ["group", "exponential of a sphere"])
def test_second_derivatives_where_steps_take_logarithms(way):
    """On manifolds gradients have parts across them, which depend on how functions go on there: all orders agree on it."""
    if way == "group":
        group, inertia, w = dx.SO3(), jnp.array([1.0, 2.0, 3.0]), jnp.array([0.3, 0.5, 1.2])
        spin = lambda q, v: group.to_algebra(q, v)
        system, scheme = (
            dx.ManifoldLagrangian(lambda q, v: spin(q, v) @ (inertia * spin(q, v)) / 2, group),
            dx.LagrangeDAlembert(),
        )
        half = lambda a: jnp.stack([jnp.cos(a / 2), 0.6 * jnp.sin(a / 2), 0.8 * jnp.sin(a / 2), 0 * a])
        along = lambda q: 0.5 * jnp.concatenate([-(q[1:] @ w)[None], q[0] * w + jnp.cross(q[1:], w)])
        start = lambda a: {"q": half(a), "v": along(half(a))}
    else:
        system, scheme = (
            dx.ManifoldLagrangian(lambda q, v: v @ v / 2, dx.Sphere(3)),
            dx.DiscreteDirac(dx.RiemannianExp(dx.Sphere(3))),
        )
        turned = lambda c, s: jnp.stack([c, 0.6 * s, 0.8 * s])
        start = lambda a: {
            "q": turned(jnp.cos(a), jnp.sin(a)),
            "v": turned(-jnp.sin(a), jnp.cos(a)) + 0.2 * jnp.array([0.0, 0.8, -0.6]),
        }
    end = lambda a: dx.simulate(system, scheme, step=0.05, steps=2, **start(a)).p[-1, 0]
    slope = jax.jit(jax.grad(end))
    wanted = (slope(0.4 + 1e-4) - slope(0.4 - 1e-4)) / 2e-4
    for outer, inner in ((jax.jacfwd, jax.grad), (jax.grad, jax.grad), (jax.jacfwd, jax.jacfwd)):
        assert float(jax.jit(outer(inner(end)))(0.4)) == pytest.approx(float(wanted), abs=1e-7)
