"""Collocation at Gauss nodes: tables, orders in q and p, structure, both iterations, both engines."""

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import dirax as dx
from dirax.schemes.collocation_tables import gauss, lobatto


def henon_heiles(q, v):
    return (v @ v) / 2 - (q @ q) / 2 - (q[0] ** 2 * q[1] - q[1] ** 3 / 3)


def double_pendulum(q, v, params):
    kinetic = v[0] ** 2 + v[1] ** 2 / 2 + v[0] * v[1] * jnp.cos(q[0] - q[1])
    return kinetic + params["g"] * (2 * jnp.cos(q[0]) + jnp.cos(q[1]))


PENDULUM = {"q": [1.0, 0.5], "v": [0.0, 0.3], "params": {"g": 9.8}}


def pendulum_reference(t, damping=0.0, pull=0.0):
    """(q, p, work) by DOP853 from the equations of motion written by hand; the force is −damping·v, pull·cos t on the first."""

    def rates(t, x):
        q, v, c, s = x[:2], x[2:4], np.cos(x[0] - x[1]), np.sin(x[0] - x[1])
        force = np.array([pull * np.cos(t), 0.0]) - damping * v
        right = np.array([-(v[1] ** 2) * s - 19.6 * np.sin(q[0]), v[0] ** 2 * s - 9.8 * np.sin(q[1])]) + force
        return [*v, *np.linalg.solve([[2.0, c], [c, 1.0]], right), force @ v]

    x = solve_ivp(rates, (0.0, t), [1.0, 0.5, 0.0, 0.3, 0.0], method="DOP853", rtol=3e-14, atol=1e-15).y[:, -1]
    c = np.cos(x[0] - x[1])
    return x[:2], np.array([2 * x[2] + c * x[3], c * x[2] + x[3]]), x[4]


@pytest.mark.parametrize("stages", [1, 2, 5, 8, 16])
@pytest.mark.soak_of("16")
def test_gauss_is_exact_to_the_last_bit(stages):
    # exact for polynomials of degree 47
    integral = lambda function, end: mpmath.quad(function, [0, end], method="gauss-legendre", maxdegree=4)
    with mpmath.workdps(60):
        found = gauss(stages)
        roots = [mpmath.findroot(lambda x: mpmath.legendre(stages, x), r) for r in np.polynomial.legendre.leggauss(stages)[0]]
        nodes = sorted((1 + r) / 2 for r in roots)
        for i, c in enumerate(nodes):
            others = [x for j, x in enumerate(nodes) if j != i]
            cardinal = lambda x, c=c, others=others: mpmath.fprod((x - y) / (c - y) for y in others)
            assert found.nodes[i] == float(c)
            assert found.weights[i] == pytest.approx(float(integral(cardinal, 1)), abs=2e-17)
            for k in {0, stages - 1}:
                assert found.matrix[k, i] == pytest.approx(float(integral(cardinal, nodes[k])), abs=2e-17)
    np.testing.assert_allclose(found.second, found.matrix @ found.matrix, atol=1e-15)
    np.testing.assert_allclose(found.conjugate, found.matrix, atol=1e-16)
    np.testing.assert_allclose(found.shares * found.weights, found.matrix, atol=1e-15)
    assert np.all(found.shares + found.shares.T == 1.0)


@pytest.mark.parametrize("stages", [2, 3, 6])
def test_lobatto_is_a_symplectic_pair(stages):
    found = lobatto(stages)
    b, a, conjugate = found.weights, found.matrix, found.conjugate
    assert found.nodes[0] == 0.0 and found.nodes[-1] == 1.0
    assert b @ found.nodes ** (2 * stages - 3) == pytest.approx(1 / (2 * stages - 2), abs=1e-16)
    np.testing.assert_allclose(b[:, None] * conjugate + (b[:, None] * a).T, np.outer(b, b), atol=1e-16)
    np.testing.assert_allclose(conjugate[:, -1], 0.0, atol=1e-16)


def orders(errors, h):
    return np.diff(np.log(errors)) / np.diff(np.log(h))


@pytest.mark.parametrize(("stages", "steps"), [(1, (80, 160, 320)), (2, (60, 90, 120)), (3, (48, 64, 96)), (4, (40, 48, 64))])
@pytest.mark.parametrize("forces", [False, True])
@pytest.mark.soak_of("False-1-steps0", "True-2-steps1", "True-3-steps2", "True-4-steps3")
def test_order_in_positions_momenta_and_work(stages, steps, forces):
    force = (lambda t, q, v, params: jnp.array([0.4 * jnp.cos(t), 0.0]) - 0.2 * v) if forces else None
    system = dx.LagrangeDirac(double_pendulum, forces=force)
    q, p, work = pendulum_reference(1.5, *((0.2, 0.4) if forces else ()))
    errors = []
    for n in steps:
        sol = dx.simulate(system, dx.Collocation(stages), step=1.5 / n, steps=n, **PENDULUM)
        assert sol.ok
        errors.append([np.max(np.abs(sol.q[-1] - q)), np.max(np.abs(sol.p[-1] - p))])
        if forces:
            errors[-1].append(abs(sol.work[-1] - work))
    measured = orders(np.array(errors).T, 1.5 / np.array(steps))
    assert np.all(np.abs(measured - 2 * stages) < 0.4) and np.all(np.abs(measured[:, -1] - 2 * stages) < 0.1), measured


@pytest.mark.parametrize(("stages", "steps"), [(2, (200, 400, 800)), (3, (60, 90, 120)), (4, (40, 60, 90))])
@pytest.mark.soak_of(but=["3-steps1"])
def test_lobatto_has_order_two_less_and_is_symplectic(stages, steps):
    force = lambda t, q, v, params: jnp.array([0.4 * jnp.cos(t), 0.0]) - 0.2 * v
    q, p, work = pendulum_reference(1.5, 0.2, 0.4)
    errors, scheme = [], dx.Collocation(stages, nodes="lobatto")
    for n in steps:
        sol = dx.simulate(dx.LagrangeDirac(double_pendulum, forces=force), scheme, step=1.5 / n, steps=n, **PENDULUM)
        errors.append([np.max(np.abs(sol.q[-1] - q)), np.max(np.abs(sol.p[-1] - p)), abs(sol.work[-1] - work)])
    measured = orders(np.array(errors).T, 1.5 / np.array(steps))
    assert np.all(np.abs(measured[:, -1] - (2 * stages - 2)) < 0.15), measured
    sol = dx.simulate(dx.LagrangeDirac(double_pendulum), scheme, step=0.05, steps=20, **PENDULUM)
    (line,) = [line for line in dx.verify(sol).lines if line.quantity == "symplecticity of one step"]
    assert line.verdict == "ok", line


def test_two_lobatto_nodes_are_stoermer_verlet():
    sol = dx.simulate(
        dx.LagrangeDirac(henon_heiles), dx.Collocation(2, "lobatto"), q=[0.3, 0.1], v=[0.2, 0.35], step=0.1, steps=9
    )
    verlet = dx.simulate(
        dx.LagrangeDirac(henon_heiles), dx.LagrangeDAlembert("trapezoidal"), q=[0.3, 0.1], v=[0.2, 0.35], step=0.1, steps=9
    )
    np.testing.assert_allclose(sol.q, verlet.q, atol=1e-15)
    np.testing.assert_allclose(sol.p, verlet.p, atol=1e-15)


def test_explicit_time_enters_at_the_nodes():
    system = dx.LagrangeDirac(lambda t, q, v: v[0] ** 2 / 2 + q[0] * jnp.exp(t))  # q̈ = eᵗ
    sol = dx.simulate(system, dx.Collocation(5), q=[0.0], v=[0.0], step=0.5, steps=4)
    np.testing.assert_allclose(sol.q[-1, 0], np.exp(2.0) - 3.0, atol=1e-12)


def test_accelerations_in_lanes_reach_roundoff_in_few_long_steps():
    system = dx.LagrangeDirac(henon_heiles)
    sol = dx.simulate(system, dx.Collocation(8), q=[0.3, 0.1], v=[0.2, 0.35], step=1.0, steps=100)
    assert "accelerations, 8 nodes" in sol.stats["iteration"]
    np.testing.assert_allclose(sol.q[-1], [-0.38098090588409234, -0.412866996164796], atol=1e-12)
    assert sol.stats["newton_iterations"] < 12 * 100


SYSTEMS = {
    "accelerations": (dx.LagrangeDirac(henon_heiles), {"q": [0.3, 0.1], "v": [0.2, 0.35]}, 0.25),
    "rates of a mass matrix": (dx.LagrangeDirac(double_pendulum), PENDULUM, 0.05),
    "not quadratic in v": (dx.LagrangeDirac(lambda q, v: jnp.cosh(v[0]) - q[0] ** 4 / 4), {"q": [0.7], "v": [0.4]}, 0.1),
    "rigid body": (
        dx.DiracSystem(
            dx.DiracStructure.from_bivector(lambda x: jnp.array([[0.0, -x[2], x[1]], [x[2], 0.0, -x[0]], [-x[1], x[0], 0.0]])),
            lambda x: x[0] ** 2 / 2 + x[1] ** 2 / 4 + x[2] ** 2 / 6,
        ),
        {"x": [0.3, 0.9, -0.4]},
        0.2,
    ),
    "port with resistance": (
        dx.PortHamiltonian(
            lambda x: x @ x / 2 + x[0] ** 4 / 4,
            J=lambda x: jnp.array([[0.0, 1.0], [-1.0, 0.0]]),
            R=lambda x: jnp.diag(jnp.array([0.0, 0.3])),
        ),
        {"x": [1.0, 0.2]},
        0.2,
    ),
    "phase-space Lagrangian": (
        dx.PhaseSpaceLagrangian(lambda q: jnp.array([-q[1] - q[1] ** 3 / 3, 0.0]), lambda q: q @ q / 2 + q[0] ** 4 / 4),
        {"q": [0.8, 0.1]},
        0.2,
    ),
}


ALSO_BY_XLA = "rigid body", "rates of a mass matrix"


@pytest.mark.parametrize("name", SYSTEMS)
@pytest.mark.soak_of("rates of a mass matrix", "rigid body")
def test_engines_agree_and_halved_steps_change_nothing_at_high_order(name):
    system, data, step = SYSTEMS[name]
    run = lambda h, n, **more: dx.simulate(system, dx.Collocation(5), step=h, steps=n, **data, **more)
    native, fine = run(step, 12, engine="native"), run(step / 2, 24, engine="native")
    arrays = run(step, 12, engine="xla") if name in ALSO_BY_XLA else native
    assert native.ok and arrays.ok and fine.ok
    for field, values in native.fields.items():
        np.testing.assert_allclose(values, arrays.fields[field], atol=3e-14, rtol=3e-14)
        np.testing.assert_allclose(values, fine.fields[field][::2], atol=1e-9, rtol=1e-9)


@pytest.mark.parametrize("name", ["accelerations", "rates of a mass matrix", "not quadratic in v"])
@pytest.mark.soak_of(but=["not quadratic in v"])
def test_steps_are_symplectic_and_self_adjoint(name):
    system, data, step = SYSTEMS[name]
    sol = dx.simulate(system, dx.Collocation(3), step=step, steps=30, **data)
    (line,) = [line for line in dx.verify(sol).lines if line.quantity == "symplecticity of one step"]
    assert line.verdict == "ok", line
    back = dx.simulate(system, dx.Collocation(3), q=sol.q[-1], p=-sol.p[-1], step=step, steps=30, params=data.get("params"))
    np.testing.assert_allclose(back.q[-1], np.asarray(data["q"]), atol=1e-12)


def test_quadratic_invariants_are_kept():
    system, data, step = SYSTEMS["rigid body"]
    sol = dx.simulate(system, dx.Collocation(2), step=step, steps=2000, **data)
    casimir = np.sum(sol.x**2, axis=-1)
    np.testing.assert_allclose(casimir, casimir[0], rtol=2e-14)


def test_a_trajectory_of_a_batch_has_the_bits_of_its_own_run_and_failures_stay_in_their_lane():
    system = dx.LagrangeDirac(lambda q, v: v @ v / 2 + 1.0 / q[0])  # falls into the centre at a time that depends on q
    q, v = [[1.0, 0.0], [0.2, 0.0], [2.0, 0.1]], [[0.0, 0.0], [0.0, 0.0], [0.1, 0.1]]
    batch = dx.simulate(system, dx.Collocation(4), q=q, v=v, step=0.02, steps=20, engine="native")
    assert batch.ok.tolist() == [True, False, True] and "step" in batch.message[1]
    for lane in (0, 2):
        alone = dx.simulate(system, dx.Collocation(4), q=q[lane], v=v[lane], step=0.02, steps=20, engine="native")
        np.testing.assert_array_equal(batch.q[lane], alone.q)
        np.testing.assert_array_equal(batch.p[lane], alone.p)


@pytest.mark.parametrize("lanes", [(), (3,)], ids=["one", "batch"])
def test_forces_that_depend_on_no_velocity_have_their_work(lanes):
    springs = dx.LagrangeDirac(lambda q, v: v @ v / 2, forces=lambda t, q, v: -q)
    start = {"q": np.full((*lanes, 2), 0.5), "v": np.full((*lanes, 2), 0.3)}
    sol = dx.simulate(springs, dx.Collocation(3), step=0.1, steps=20, engine="native", **start)
    np.testing.assert_allclose(sol.q[..., -1, :], 0.5 * np.cos(2.0) + 0.3 * np.sin(2.0), atol=1e-9)
    np.testing.assert_allclose(sol.work, (0.5 - np.sum(sol.q**2, -1)) / 2, atol=1e-9)


def test_rows_saved_now_and_then_are_those_of_every_step():
    system, data, step = SYSTEMS["rates of a mass matrix"]
    every = dx.simulate(system, dx.Collocation(4), step=step, steps=20, **data)
    some = dx.simulate(system, dx.Collocation(4), step=step, steps=20, save_every=6, **data)
    np.testing.assert_array_equal(some.q, every.q[[0, 6, 12, 18, 20]])


def test_the_energy_error_grows_like_a_random_walk():
    system = dx.LagrangeDirac(henon_heiles)
    sol = dx.simulate(system, dx.Collocation(8), q=[0.3, 0.1], v=[0.2, 0.35], step=0.5, steps=100_000, save_every=1000)
    energy = sol.energy()
    assert np.max(np.abs(energy - energy[0])) < 0.02 * np.sqrt(100_000) * 2.3e-16 * 10


@pytest.mark.parametrize("engine", ["native", pytest.param("xla", marks=pytest.mark.soak)])
def test_gradients_are_those_of_differences(engine):
    system = dx.LagrangeDirac(double_pendulum)

    steps = {"step": 0.1, "steps": 8, "engine": engine}

    def end(g):
        sol = dx.simulate(system, dx.Collocation(2), q=[1.0, 0.5], v=[0.0, 0.3], params={"g": g}, **steps)
        return sol.q[-1, 1]

    slope = jax.jit(jax.grad(end))(9.8)
    difference = (float(end(9.8 + 1e-4)) - float(end(9.8 - 1e-4))) / 2e-4
    assert float(slope) == pytest.approx(difference, rel=1e-7)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"stages": 0}, "from 1 to 16"),
        ({"stages": 17}, "from 1 to 16"),
        ({"stages": 2.0}, "whole number"),
        ({"stages": True}, "whole number"),
        ({"stages": 1, "nodes": "lobatto"}, "from 2 to 16 for lobatto"),
        ({"nodes": "radau"}, "'gauss' or 'lobatto'"),
    ],
)
def test_bad_arguments(arguments, words):
    with pytest.raises(ValueError, match=words):
        dx.Collocation(**arguments)


def test_whole_numbers_of_numpy_are_stages():
    assert dx.Collocation(np.int64(3)) == dx.Collocation(3)
    assert dx.EnergyCollocation(np.int64(2), np.int32(8)) == dx.EnergyCollocation(2, 8)


TURN = jnp.array([[0.0, 1.0], [-1.0, 0.0]])


@pytest.mark.parametrize(
    ("system", "start"),
    [
        (dx.circuit([("V", 1, 0, jnp.sin), ("R", 1, 2, 1.0), ("C", 2, 0, 1.0)]), {"x": [0.0]}),
        (dx.circuit([("L", 1, 0, 1.0), ("C", 1, 0, 1.0)]), {"x": [1.0, 0.0]}),
        (dx.PortHamiltonian(lambda x: x @ x / 2, TURN, [[1.0], [0.0]], closed=True), {"x": [0.0, 1.0]}),
        (dx.HamiltonDirac(lambda q, p: p @ p / 2, lambda q: jnp.array([[1.0, -1.0]])), {"q": [1.0, 1.0], "p": [0.5, 0.5]}),
    ],
)
@pytest.mark.parametrize("nodes", ["gauss", "lobatto"])
def test_where_constraints_are_not_kept_a_scheme_is_named_that_keeps_them(system, start, nodes):
    with pytest.raises(TypeError, match=r"does not keep the constraints of a \w+, which here are \d: take dx.DiscreteDirac\(\)"):
        dx.simulate(system, dx.Collocation(2, nodes), **start, step=0.1, steps=2)
    assert dx.simulate(system, dx.DiscreteDirac(), **start, step=0.1, steps=2).ok


def test_systems_that_it_does_not_step_are_refused():
    constrained = dx.LagrangeDirac(lambda q, v: v @ v / 2, lambda q: jnp.array([[q[1], -1.0]]))
    with pytest.raises(TypeError, match="does not keep constraints"):
        dx.simulate(constrained, dx.Collocation(2), q=[0.0, 0.0], v=[1.0, 0.0], step=0.1, steps=1)
    with pytest.raises(TypeError, match="Lobatto nodes are for Lagrangians"):
        dx.simulate(SYSTEMS["rigid body"][0], dx.Collocation(2, "lobatto"), x=[1.0, 0.0, 0.0], step=0.1, steps=1)
    with pytest.raises(ValueError, match="one-step method"):
        dx.simulate(dx.LagrangeDirac(henon_heiles), dx.Collocation(2), q0=[0.0, 0.0], q1=[0.1, 0.0], step=0.1, steps=1)
    sphere = dx.ManifoldLagrangian(lambda q, v: v @ v / 2, dx.Sphere(3))
    with pytest.raises(TypeError, match="Lobatto nodes are for coordinates"):
        dx.simulate(sphere, dx.Collocation(2, "lobatto"), q=[1.0, 0.0, 0.0], v=[0.0, 1.0, 0.0], step=0.1, steps=1)
    body = dx.EulerPoincare(dx.SO3(), lambda xi: xi @ xi / 2)
    with pytest.raises(TypeError, match="EulerPoincare was given"):
        dx.simulate(body, dx.Collocation(2), x=body.state([0.0, 1.0, 0.0]), step=0.1, steps=1)


@pytest.mark.parametrize("scheme", [dx.Collocation(3), dx.EnergyCollocation(2), dx.DiscreteDirac(constraints="resolve")])
@pytest.mark.soak_of(but=["scheme2"])
def test_a_structure_that_leaves_rates_open_is_refused(scheme):
    """Gauss ran, and verify called the constraint violated; the other named the inverse of a singular matrix."""
    knife = lambda q: jnp.array([[jnp.sin(q[2]), -jnp.cos(q[2]), 0.0]])
    system = dx.DiracSystem(dx.induced_dirac(knife, 3), lambda x: x[3:] @ x[3:] / 2 + x[0])
    with pytest.raises(ValueError, match=r"the matrix of ẋ has rank 5 of 6 .*resolved\(\) instead of the system"):
        dx.simulate(system, scheme, q=[0.0, 0.0, 0.3], p=[np.cos(0.3), np.sin(0.3), 0.7], step=0.05, steps=3)
