"""Collocation at Lobatto nodes with constraints: orders of positions, momenta and multipliers, the constraints, symplecticity."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import dirax as dx
from dirax import gallery


def reference(lagrangian, rows, forces, q, v, t):
    """(q, p, work) at t and λ as a function of the time, by DOP853 from the equations with multipliers."""
    n = len(q)

    @jax.jit
    def solved(t, x):
        q, v = x[:n], x[n : 2 * n]
        mass = jax.hessian(lambda v: lagrangian(q, v))(v)
        force = forces(t, q, v)
        free = jax.grad(lagrangian)(q, v) + force - jax.jvp(lambda q: jax.grad(lagrangian, 1)(q, v), (q,), (v,))[1]
        w, drift = rows(q), jax.jvp(lambda q: rows(q) @ v, (q,), (v,))[1]
        matrix = jnp.block([[mass, w.T], [w, jnp.zeros((len(w), len(w)))]])
        return jnp.append(jnp.linalg.solve(matrix, jnp.concatenate([free, -drift])), force @ v)

    rates = lambda t, x: np.concatenate([x[n : 2 * n], np.asarray(solved(t, x))[[*range(n), -1]]])
    found = solve_ivp(rates, (0.0, t), [*q, *v, 0.0], method="DOP853", rtol=1e-13, atol=1e-14, dense_output=True)
    x = found.y[:, -1]
    p = np.asarray(jax.grad(lagrangian, 1)(x[:n], x[n : 2 * n]))
    return x[:n], p, x[-1], lambda t: np.asarray(solved(t, found.sol(t)))[n:-1]


def two_bobs(q, v):
    return v @ v / 2 + 0.3 * q[0] ** 2 * v[2] ** 2 - 9.8 * (q[1] + q[3]) - 0.2 * q[0] * q[2] ** 2


def rods(q):
    return jnp.array([q[0] ** 2 + q[1] ** 2 - 1.0, (q[2] - q[0]) ** 2 + (q[3] - q[1]) ** 2 - 1.0])


def hanging(angles):
    """The bobs at two angles."""
    first = jnp.stack([jnp.sin(angles[0]), -jnp.cos(angles[0])])
    return jnp.concatenate([first, first + jnp.stack([jnp.sin(angles[1]), -jnp.cos(angles[1])])])


def rolling(q, v):
    return v @ v / 2 + q[1] ** 2 * v[0] ** 2 / 2 + 0.4 * q[0] * v[2] - q @ q / 2 - 0.1 * q[0] ** 3


def one_forms(q):
    return jnp.array([[q[1], 0.3 * jnp.sin(q[0]), 1.0]])


def around_a_ball(q):
    return jnp.array([q[0] ** 2 + q[1] ** 2 + q[3] ** 2 + 0.3 * q[0] * q[2] - 1.0])


def one_forms_too(q):
    return jnp.array([[q[1], 0.3 * jnp.sin(q[0]), 1.0, 0.5 * q[3]]])


def both_rows(q):
    return jnp.concatenate([one_forms_too(q), jax.jacobian(around_a_ball)(q)])


def sliding(q, v):
    return v @ v / 2 + 0.3 * q[0] ** 2 * v[2] ** 2 + 0.4 * q[0] * v[1] - q @ q / 2 - 0.2 * q[0] * q[2] ** 2


def pushed(t, q, v):
    return -0.1 * v + jnp.zeros_like(v).at[1].set(jnp.sin(t))


ANGLES, RATES = np.array([1.0, 0.5]), np.array([0.5, -0.3])
ON_THE_BALL = np.array([0.5, 0.4, 0.3, np.sqrt(1.0 - 0.25 - 0.16 - 0.045)])
ROWS = np.array([[0.4, 0.3 * np.sin(0.5), 1.0, 0.5 * ON_THE_BALL[3]], [1.0 + 0.3 * 0.3, 0.8, 0.3 * 0.5, 2.0 * ON_THE_BALL[3]]])
"""`both_rows` there."""
ALONG = np.array([0.3, 0.8, -0.5, 0.4])
ALONG -= np.linalg.pinv(ROWS) @ ROWS @ ALONG
ARMS = np.stack([np.sin(ANGLES), -np.cos(ANGLES)], axis=1)
TURNING = RATES[:, None] * np.stack([np.cos(ANGLES), np.sin(ANGLES)], axis=1)
START = {
    "holonomic": (np.cumsum(ARMS, axis=0).ravel(), np.cumsum(TURNING, axis=0).ravel()),
    "nonholonomic": (np.array([0.5, 0.4, 0.1]), np.array([0.3, 0.2, -(0.4 * 0.3 + 0.3 * np.sin(0.5) * 0.2)])),
    "both": (ON_THE_BALL, ALONG),
}
KINDS = {
    "holonomic": (two_bobs, jax.jacobian(rods), dx.LagrangeDirac(two_bobs, holonomic=rods, forces=pushed)),
    "nonholonomic": (rolling, one_forms, dx.LagrangeDirac(rolling, one_forms, forces=pushed)),
    "both": (sliding, both_rows, dx.LagrangeDirac(sliding, one_forms_too, holonomic=around_a_ball, forces=pushed)),
}


@functools.cache
def pushed_reference(kind):
    """(q, p, work) and λ at 1, and the mean of λ until then."""
    lagrangian, rows, _ = KINDS[kind]
    *ends, multiplier = reference(lagrangian, rows, pushed, *START[kind], 1.0)
    times = np.linspace(0.0, 1.0, 201)
    return ends, multiplier(1.0), np.trapezoid([multiplier(t) for t in times], times, axis=0)


STEPS = {2: (100, 200), 3: (40, 80), 4: (14, 28)}
OF_ONE_FORMS, OF_HOLONOMIC = {2: 2, 3: 2, 4: 4}, {2: 1, 3: 2, 4: 3}
"""The orders of λ at the nodes that are measured, by stages: less than the 2s − 2 of the rest."""
OF_MULTIPLIERS = {
    "holonomic": [OF_HOLONOMIC],
    "nonholonomic": [OF_ONE_FORMS],
    "both": [OF_ONE_FORMS, OF_HOLONOMIC],
}


@pytest.mark.parametrize(
    "kind, stages",
    [
        *((kind, 4) for kind in ("holonomic", "nonholonomic")),
        *((kind, 3) for kind in KINDS),
        *(pytest.param(kind, 2, marks=pytest.mark.soak) for kind in KINDS),
        pytest.param("both", 4, marks=pytest.mark.soak),
    ],
)
@pytest.mark.soak
def test_orders_and_constraints(kind, stages):
    _, _, system = KINDS[kind]
    q, v = START[kind]
    ends, multiplier, mean = pushed_reference(kind)
    errors = []
    for n in STEPS[stages]:
        sol = dx.simulate(system, dx.Collocation(stages, "lobatto"), q=q, v=v, step=1.0 / n, steps=n)
        assert sol.ok
        found = (sol.q[-1], sol.p[-1], sol.work[-1])
        off = [np.max(np.abs(a - b)) for a, b in zip(found, ends, strict=True)]
        of_multipliers = np.abs(sol.reactions[-1, -1] - multiplier)
        errors.append([*off, *np.max(of_multipliers.reshape(len(OF_MULTIPLIERS[kind]), -1), axis=1)])
    measured = np.log2(np.divide(*errors))
    assert np.all(np.abs(measured[:3] - (2 * stages - 2)) < 0.35), measured
    assert np.all(np.abs(measured[3:] - [orders[stages] for orders in OF_MULTIPLIERS[kind]]) < 0.5), measured
    defect = jax.jit(jax.vmap(lambda q, p: system.constraint_at({"q": q, "p": p}, None)))(sol.q, sol.p)
    assert np.max(np.abs(defect)) < 1e-14
    impulse = np.sum(np.asarray(sol.multipliers), axis=0)
    np.testing.assert_allclose(impulse, mean, rtol=2e-3)


@pytest.mark.parametrize(
    ("name", "of_multipliers"),
    [("cartesian-double-pendulum", OF_HOLONOMIC), pytest.param("rolling-disk", OF_ONE_FORMS, marks=pytest.mark.soak)],
)
@pytest.mark.soak
def test_orders_on_the_gallery(name, of_multipliers):
    example, end = gallery.get(name), 0.5
    system, params = example.system.lagrangian_form(), example.params
    lagrangian = lambda q, v: system.lagrangian.at(0.0, q, v, params)
    rows = lambda q: system.constraints.matrix(0.0, q, params)
    q, v = (np.asarray(example.initial[of]) for of in ("q", "v"))
    *expected, _, multiplier = reference(lagrangian, rows, lambda t, q, v: jnp.zeros_like(q), q, v, end)
    errors = []
    for n in (20, 40):
        sol = dx.simulate(system, dx.Collocation(3, "lobatto"), q=q, v=v, step=end / n, steps=n, params=params)
        found = zip((sol.q[-1], sol.p[-1], sol.reactions[-1, -1]), (*expected, multiplier(end)), strict=True)
        errors.append([np.max(np.abs(a - b)) for a, b in found])
    assert np.all(np.abs(np.log2(np.divide(*errors)) - [4, 4, of_multipliers[3]]) < 0.3), errors


def test_two_stages_are_rattle():
    q, v = START["holonomic"]
    system = dx.LagrangeDirac(lambda q, v: v @ v / 2 - 9.8 * (q[1] + q[3]), holonomic=rods)
    run = lambda scheme: dx.simulate(system, scheme, q=q, v=v, step=0.02, steps=20)
    ours, theirs = run(dx.Collocation(2, "lobatto")), run(dx.LagrangeDAlembert("trapezoidal"))
    np.testing.assert_allclose(ours.q, theirs.q, atol=1e-13)
    np.testing.assert_allclose(ours.p, theirs.p, atol=1e-13)


@pytest.mark.soak
def test_symplectic_on_the_constraint_manifold():
    system = dx.LagrangeDirac(two_bobs, holonomic=rods)

    def point(z):
        q, v = hanging(z[:2]), jax.jvp(hanging, (z[:2],), (z[2:],))[1]
        return q, system.legendre(q, v)

    def moved(z):
        q, p = point(z)
        sol = dx.simulate(system, dx.Collocation(2, "lobatto"), q=q, p=p, step=0.1, steps=1, engine="xla", check_initial=False)
        return sol.q[-1], sol.p[-1]

    def pulled_back(function):
        q, p = jax.jacobian(function)(jnp.concatenate([ANGLES, RATES]))
        return np.asarray(q.T @ p - p.T @ q)

    before, after = pulled_back(point), pulled_back(moved)
    assert np.max(np.abs(before)) > 0.5
    np.testing.assert_allclose(after, before, atol=1e-12)


@pytest.mark.parametrize("kind", ["nonholonomic", pytest.param("holonomic", marks=pytest.mark.soak)])
@pytest.mark.soak
def test_self_adjoint_and_the_same_on_both_engines(kind):
    lagrangian = KINDS[kind][0]
    even = lambda q, v: (lagrangian(q, v) + lagrangian(q, -v)) / 2  # reversible
    system = dx.LagrangeDirac(even, holonomic=rods) if kind == "holonomic" else dx.LagrangeDirac(even, one_forms)
    q, v = START[kind]
    native, arrays = (
        dx.simulate(system, dx.Collocation(3, "lobatto"), q=q, v=v, step=0.05, steps=20, engine=engine)
        for engine in ("native", "xla")
    )
    for field, values in native.fields.items():
        np.testing.assert_allclose(values, arrays.fields[field], atol=1e-10 if field == "reactions" else 1e-12)
    back = dx.simulate(system, dx.Collocation(3, "lobatto"), q=native.q[-1], p=-native.p[-1], step=0.05, steps=20)
    # λ at the start of the way back is not the λ at the end of the way there, by its error
    np.testing.assert_allclose(back.q[-1], q, atol=1e-11 if kind == "holonomic" else 1e-5)


def test_what_it_does_not_keep_is_refused():
    with pytest.raises(TypeError, match="at Gauss nodes does not keep constraints"):
        dx.simulate(KINDS["nonholonomic"][2], dx.Collocation(3), q=[0.0, 0.0, 0.0], v=[0.0, 1.0, 0.0], step=0.1, steps=1)


def test_compositions_of_lobatto_nodes_with_one_forms_are_not_promised_more_than_order_four():
    """Kahan and Li's of order 6 has 4.0: λ of the step before is a part of the state."""
    rows = lambda q: jnp.stack([jnp.sin(q[2]), -jnp.cos(q[2]), 0.0])[None]
    skate = dx.LagrangeDirac(lambda q, v: v @ v / 2 + 0.2 * v[0] * v[2] - jnp.cos(q[0]) - q[1] ** 2 / 2, rows)
    start = {"q": [0.1, 0.2, 0.3], "v": [np.cos(0.3), np.sin(0.3), 0.5]}
    run = lambda scheme, n: dx.simulate(skate, scheme, **start, step=2.0 / n, steps=n).q[-1]
    exact = run(dx.Composition(dx.LagrangeDAlembert(), "suzuki8"), 64)
    lobatto = dx.Composition(dx.Collocation(2, nodes="lobatto"), "kahan-li6")
    with pytest.warns(RuntimeWarning, match=r"compositions of Collocation\(stages=2, nodes='lobatto'\) have order 4 here"):
        errors = [np.abs(run(lobatto, n) - exact).max() for n in (16, 32)]
    assert np.log2(errors[0] / errors[1]) == pytest.approx(4.0, abs=0.1)
