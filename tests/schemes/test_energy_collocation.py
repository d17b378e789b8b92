"""Energy-preserving collocation: orders against motions found in another way, the energy and the books, both engines."""

from dataclasses import replace
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.sparse as sp
from scipy.integrate import solve_ivp

import dirax as dx
from dirax import gallery
from dirax.diagnostics.reversal_line import taken_back
from dirax.gallery import contact_particle, transmission
from dirax.schemes.collocation_tables import gauss, quadrature
from dirax.schemes.step import Shape

DATA = {"q": [0.5, 0.4, 0.1], "v": [0.3, 0.2, -0.12]}


def lagrangian(q, v):
    return v @ v / 2 + q[1] ** 2 * v[0] ** 2 / 2 + 0.4 * q[0] * v[2] - q @ q / 2 - 0.1 * q[0] ** 3


def one_forms(t, q):
    return jnp.array([[q[1] * jnp.cos(t), 0.3 * jnp.sin(q[0]), 1.0]])


def affine(t, q):
    return jnp.array([0.2 * q[1] * jnp.sin(t)])


def forces(t, q, v):
    return -0.1 * v + jnp.array([0.0, jnp.sin(t), 0.0])


FORCED = {
    False: dx.LagrangeDirac(lagrangian, lambda q: one_forms(0.0, q), forces=forces),
    True: dx.LagrangeDirac(lagrangian, one_forms, affine=affine, forces=forces),
}
"""By whether the constraint is moving."""


@cache
def reference(moving):
    """(q, p, work) at 1.5 by DOP853 from the equations with multipliers, the constraint differentiated by formulas of JAX."""
    start = FORCED[moving].complete({name: jnp.array(a) for name, a in DATA.items()}, None, True)
    b = affine if moving else (lambda t, q: jnp.zeros(1))
    rows = one_forms if moving else (lambda t, q: one_forms(0.0, q))

    @jax.jit
    def rates(t, x):
        q, v = x[:3], x[3:6]
        mass = jax.hessian(lambda v: lagrangian(q, v))(v)
        free = jax.grad(lagrangian)(q, v) + forces(t, q, v) - jax.jvp(lambda q: jax.grad(lagrangian, 1)(q, v), (q,), (v,))[1]
        defect = lambda t, q: rows(t, q) @ v + b(t, q)
        drift = jax.jvp(defect, (t, q), (1.0, v))[1]
        w = rows(t, q)
        found = jnp.linalg.solve(jnp.block([[mass, w.T], [w, jnp.zeros((1, 1))]]), jnp.concatenate([free, -drift]))
        reaction = -w.T @ found[3:]
        return jnp.concatenate([v, found[:3], jnp.array([(forces(t, q, v) + reaction) @ v])])

    x = solve_ivp(rates, (0.0, 1.5), [*start["q"], *start["v"], 0.0], method="DOP853", rtol=1e-13, atol=1e-14).y[:, -1]
    return x[:3], np.asarray(jax.grad(lagrangian, 1)(x[:3], x[3:6])), x[6]


def orders(errors, h):
    return np.diff(np.log(errors)) / np.diff(np.log(h))


@pytest.mark.parametrize(("stages", "steps"), [(1, (20, 40, 80)), (2, (10, 20, 40)), (3, (7, 10, 14))])
@pytest.mark.parametrize("moving", [False, True], ids=["linear", "affine in time"])
@pytest.mark.soak_of(but=["affine in time-3-steps2"])
def test_order_in_positions_momenta_and_work(stages, steps, moving):
    system, expected, errors = FORCED[moving], reference(moving), []
    for n in steps:
        sol = dx.simulate(system, dx.EnergyCollocation(stages), step=1.5 / n, steps=n, project=True, **DATA)
        assert sol.ok
        found = sol.q[-1], sol.p[-1], sol.work[-1]
        errors.append([np.max(np.abs(a - b)) for a, b in zip(found, expected, strict=True)])
    energy = sol.energy()
    np.testing.assert_allclose(energy - energy[0], sol.work, atol=2e-15)
    measured = orders(np.array(errors).T, 1.5 / np.array(steps))
    assert np.all(np.abs(measured[:, -1] - 2 * stages) < 0.25), measured


def frame(q):
    """A basis of the kernel of one_forms(0, q), of columns that are neither orthogonal nor of length 1."""
    w = one_forms(0.0, q)[0]
    return jnp.array([[1.0 + q[0] ** 2, 0.5], [0.3, 2.0], [-(1.0 + q[0] ** 2) * w[0] - 0.3 * w[1], -0.5 * w[0] - 2.0 * w[1]]])


@pytest.mark.parametrize(("stages", "steps"), [(2, (20, 40)), (3, (10, 14))])
@pytest.mark.soak_of("2-steps0")
def test_order_energy_and_constraint_in_a_frame_of_ones_own(stages, steps):
    system, expected, errors = FORCED[False], reference(False), []
    for n in steps:
        scheme = dx.EnergyCollocation(stages, frame=frame)
        sol = dx.simulate(system, scheme, step=1.5 / n, steps=n, project=True, **DATA)
        assert sol.ok and sol.stats["engine"] == "native"
        errors.append([np.max(np.abs(a - b)) for a, b in zip((sol.q[-1], sol.p[-1], sol.work[-1]), expected, strict=True)])
    assert np.all(np.abs(orders(np.array(errors).T, 1.5 / np.array(steps)) - 2 * stages) < 0.3), errors
    energy = sol.energy()
    np.testing.assert_allclose(energy - energy[0], sol.work, atol=2e-15)
    assert np.max(np.abs(sol.constraint_residual())) < 1e-15


def test_frames_that_are_no_basis_of_the_distribution_are_refused():
    system = dx.LagrangeDirac(lagrangian, lambda q: one_forms(0.0, q))
    run = lambda frame: dx.simulate(system, dx.EnergyCollocation(frame=frame), step=0.1, steps=1, project=True, **DATA)
    with pytest.raises(ValueError, match=r"shape \(3, 2\), a basis of the 2 directions that 1 one-forms leave free.*\(3, 3\)"):
        run(lambda q: jnp.eye(3))
    with pytest.raises(ValueError, match=r"independent, but at q = \[0.5 0.4 0.1\] their smallest singular value"):
        run(lambda q: jnp.stack([frame(q)[:, 0], 2.0 * frame(q)[:, 0]], axis=1))
    with pytest.raises(ValueError, match=r"kernel of the one-forms, but at q = .* one-form 0 takes column 1 to 0\.0"):
        run(lambda q: frame(q) + 0.01 * jnp.array([[0.0, 0.0], [0.0, 0.0], [0.0, 1.0]]))
    with pytest.raises(TypeError, match="the constraints are affine"):
        moving = dx.LagrangeDirac(lagrangian, lambda q: one_forms(0.0, q), affine=lambda q: jnp.array([0.1]))
        dx.simulate(moving, dx.EnergyCollocation(frame=frame), step=0.1, steps=1, project=True, **DATA)


IRREVERSIBLE = {"contact-particle": contact_particle.CASES, "transmission": transmission.CASES}


@pytest.mark.parametrize("name", IRREVERSIBLE)
@pytest.mark.soak
def test_energy_and_constraint_of_irreversible_systems(name):
    example = gallery.get(name)
    params = {**example.params, **IRREVERSIBLE[name]["irreversible"]}
    data = {name: example.initial[name] for name in ("q", "v")}
    system = example.system.lagrangian_form()
    sol = dx.simulate(
        system,
        dx.EnergyCollocation(),
        step=0.05,
        steps=20_000,
        save_every=500,
        params=params,
        project=True,
        engine="native",
        **data,
    )
    energy = sol.energy()
    assert sol.ok and np.max(np.abs(energy - energy[0])) < 5e-15
    velocity = jax.jit(lambda q, p: system.inverse_legendre(q, p, params))
    for q, p in zip(sol.q[::10], sol.p[::10], strict=True):
        assert np.max(np.abs(system.constraint_matrix(q, params) @ velocity(q, p))) < 1e-15
    assert sol.stats["energy_defect"] < 1e-14 and "8 points of the quadrature" in sol.stats["iteration"]


@pytest.mark.soak
def test_a_knife_edge_turns_through_every_direction():
    example = gallery.get("knife-edge")
    data = {"params": example.params, "project": True} | {name: example.initial[name] for name in ("q", "v")}
    sol = dx.simulate(example.system.lagrangian_form(), dx.EnergyCollocation(3), step=0.05, steps=400, **data)
    fine = dx.simulate(
        example.system, dx.Composition(dx.DiscreteDirac(constraints="resolve"), "suzuki4"), step=0.01, steps=2000, **data
    )
    energy = sol.energy()
    assert np.max(np.abs(energy - energy[0])) < 1e-14
    np.testing.assert_allclose(sol.q[::40], fine.q[::200], atol=2e-6)


@pytest.mark.soak
def test_a_lagrangian_that_is_not_quadratic_in_v():
    system = dx.LagrangeDirac(
        lambda q, v: jnp.cosh(v[0]) + v[1] ** 2 / 2 + v[2] ** 2 / 2 + 0.1 * (v[0] * v[1]) ** 2 - q @ q / 2,
        lambda q: jnp.array([[q[1], 0.0, -1.0]]),
    )
    data = {"q": [0.7, 0.2, 0.0], "v": [0.4, 0.1, 0.08]}
    sol = dx.simulate(system, dx.EnergyCollocation(3), step=0.1, steps=100, **data)
    fine = dx.simulate(system, dx.LagrangeDAlembert(), step=0.001, steps=10_000, save_every=100, **data)
    energy = sol.energy()
    assert np.max(np.abs(energy - energy[0])) < 1e-14
    np.testing.assert_allclose(sol.q, fine.q, atol=1e-5)


def so3(x):
    return jnp.array([[0.0, -x[2], x[1]], [x[2], 0.0, -x[0]], [-x[1], x[0], 0.0]])


def pendulum(q, v):
    kinetic = v[0] ** 2 + v[1] ** 2 / 2 + v[0] * v[1] * jnp.cos(q[0] - q[1])
    return kinetic + 9.8 * (2 * jnp.cos(q[0]) + jnp.cos(q[1]))


BODY = dx.EulerPoincare(dx.SO3(), lambda xi: xi @ (jnp.array([1.0, 2.0, 3.0]) * xi) / 2)
TOP = dx.EulerPoincare(dx.SO3(), lambda xi, a: xi @ (jnp.array([1.0, 1.0, 0.3]) * xi) / 2 - a[2], advected=3)
SYSTEMS = {
    "no constraints": (dx.LagrangeDirac(pendulum), {"q": [1.0, 0.5], "v": [0.0, 0.3]}, 0.05),
    "explicit time": (
        dx.LagrangeDirac(lambda t, q, v: pendulum(q, v) * (1 + 0.2 * jnp.sin(t))), {"q": [1.0, 0.5], "v": [0.0, 0.3]}, 0.05,
    ),
    "Poisson": (
        dx.DiracSystem(dx.DiracStructure.from_bivector(so3), lambda x: x[0] ** 2 / 2 + x[1] ** 2 / 4 + jnp.sin(x[2])),
        {"x": [0.3, 0.9, -0.4]}, 0.2,
    ),
    "almost Poisson": (
        dx.DiracSystem(dx.DiracStructure.from_bivector(lambda x: so3(x + x[::-1] ** 2)), lambda x: jnp.cos(x[0]) + x @ x / 2),
        {"x": [0.3, 0.9, -0.4]}, 0.2,
    ),
    "canonical": (
        dx.DiracSystem(dx.induced_dirac(None, 1), lambda x: x[1] ** 2 / 2 - jnp.cos(x[0])), {"q": [1.0], "p": [0.2]}, 0.2,
    ),
    "Lie–Poisson": (dx.LiePoisson(dx.SO3(), lambda m: m @ (m / jnp.array([1.0, 2.0, 3.0])) / 2), {"x": [0.3, 0.9, -0.4]}, 0.2),
    "Euler–Poincaré": (BODY, {"x": [0.3, 1.8, -1.2]}, 0.2),
    "heavy top": (TOP, {"x": [0.3, 0.8, 1.2, 0.0, 0.6, 0.8]}, 0.1),
    "ports": (
        dx.PortHamiltonian(
            lambda x: x @ x / 2 + x[0] ** 4 / 4,
            J=lambda x: jnp.array([[0.0, 1.0], [-1.0, 0.0]]),
            R=lambda x: jnp.diag(jnp.array([0.0, 0.3 + x[0] ** 2])),
            B=lambda x: jnp.array([[0.0], [1.0]]),
            inputs=lambda t, x: jnp.array([jnp.cos(t)]),
        ),
        {"x": [1.0, 0.2]}, 0.1,
    ),
    "phase-space Lagrangian": (
        dx.PhaseSpaceLagrangian(lambda q: jnp.array([-q[1] - q[1] ** 3 / 3, 0.0]), lambda q: q @ q / 2 + q[0] ** 4 / 4),
        {"q": [0.8, 0.1]}, 0.2,
    ),
}  # fmt: skip


LONG = ("heavy top", "Euler–Poincaré")
ALSO_BY_XLA = ("explicit time", "ports", *LONG)


@pytest.mark.parametrize("name", [pytest.param(n, marks=pytest.mark.soak) if n in LONG else n for n in SYSTEMS])
@pytest.mark.soak
def test_every_system_with_a_bracket(name):
    system, data, step = SYSTEMS[name]
    run = lambda scheme, h, n, **more: dx.simulate(system, scheme, step=h, steps=n, **data, **more)
    native = run(dx.EnergyCollocation(2), step, 20, engine="native")
    assert native.ok and native.stats["engine"] == "native"
    place = next(field for field in ("x", "q") if field in native.fields)
    if name in ALSO_BY_XLA:
        arrays = run(dx.EnergyCollocation(2), step, 20, engine="xla")
        assert arrays.ok
        for field, values in native.fields.items():
            if field != "energy_defect":
                np.testing.assert_allclose(values, arrays.fields[field], atol=1e-13, rtol=1e-13)
    energy = native.energy()
    work = np.asarray(native.fields.get("work", 0.0))
    work = work[:, 0] - work[:, 1] if work.ndim == 2 else work
    np.testing.assert_allclose(energy - energy[0], work, atol=3e-14 * max(1.0, np.max(np.abs(energy))))
    errors = []
    for stages in (2, 3):
        ends = [run(dx.EnergyCollocation(stages), step / k, 4 * k).fields[place][-1] for k in (1, 2, 16)]
        errors.append([np.max(np.abs(end - ends[2])) for end in ends[:2]])
    assert np.log2(errors[0][0] / errors[0][1]) > 3.7 and errors[1][1] < errors[0][1] / 20, errors


def test_the_books_of_ports_are_verified():
    system, data, step = SYSTEMS["ports"]
    sol = dx.simulate(system, dx.EnergyCollocation(3), step=step, steps=500, **data)
    (line,) = [line for line in dx.verify(sol).lines if line.quantity == "books of the energy"]
    assert line.verdict == "ok", line


def test_self_adjoint_with_one_forms_in_a_frame_alone():
    system = dx.LagrangeDirac(lagrangian, lambda q: one_forms(0.0, q))
    with pytest.raises(TypeError, match=r"give it frame="):
        dx.simulate(system, dx.Adjoint(dx.EnergyCollocation(1)), step=0.1, steps=1, project=True, **DATA)
    density = lambda q: 1 + q[0] ** 2
    lines = []
    for scheme in (dx.EnergyCollocation(1), dx.EnergyCollocation(1, frame=frame)):
        sol = dx.simulate(system, dx.VariableSteps(scheme, density), step=0.2, steps=5, project=True, **DATA)
        lines.append(taken_back(sol, None))
    without, framed = lines
    assert without.verdict == "not checked" and without.value > 1e-9 and "give it frame=" in without.explanation
    assert framed.verdict == "ok" and framed.quantity == "steps taken back"


@pytest.mark.parametrize("engine", ["native", pytest.param("xla", marks=pytest.mark.soak)])
@pytest.mark.soak
def test_at_rest_where_all_terms_of_the_energy_are_zero(engine):
    oscillator = dx.LagrangeDirac(lambda q, v: v @ v / 2 - q @ q / 2)

    def last(q):
        sol = dx.simulate(oscillator, dx.EnergyCollocation(2), q=q, v=jnp.zeros(1), step=0.1, steps=5, engine=engine)
        return sol.q[-1, 0]

    rest = dx.simulate(oscillator, dx.EnergyCollocation(2), q=[0.0], v=[0.0], step=0.1, steps=5, engine=engine)
    assert rest.ok and not np.any(rest.q) and not np.any(rest.energy_defect) and dx.verify(rest).ok
    np.testing.assert_allclose(jax.grad(last)(jnp.zeros(1)), np.cos(0.5), atol=1e-7)
    found = dx.linearize(oscillator, {"q": [0.0], "v": [0.0]}, dx.EnergyCollocation(2), step=0.1)
    np.testing.assert_allclose(found.eigenvalues, [1j, -1j], atol=1e-6)


def test_self_adjoint():
    system, data, step = SYSTEMS["no constraints"]
    sol = dx.simulate(system, dx.EnergyCollocation(2), step=step, steps=30, **data)
    back = dx.simulate(system, dx.EnergyCollocation(2), q=sol.q[-1], p=-sol.p[-1], step=step, steps=30)
    np.testing.assert_allclose(back.q[-1], data["q"], atol=1e-12)


class Stated(dx.AbstractScheme):
    """A step that is given."""

    equation: dx.StepEquation

    def step_equation(self, system, shape):
        return self.equation


@pytest.mark.soak
def test_stiff_bars_set_out_from_rest():
    """Rates that are nothing but roundoff of the stiff forces, by way of the momenta that these make, are at their root."""
    angles = np.linspace(1.0, 0.3, 6)
    hanging = np.cumsum(np.stack([np.sin(angles), -np.cos(angles)], axis=1), axis=0).ravel()

    def bars(q, v):
        points = q.reshape(6, 2)
        along = jnp.concatenate([points[:1], points[1:] - points[:-1]])
        stretch = jnp.sqrt(jnp.sum(along**2, axis=1)) - 1
        return v @ v / 2 - 200.0**2 / 2 * stretch @ stretch - 9.81 * jnp.sum(points[:, 1])

    run = {"q": hanging, "v": np.zeros(12), "step": 0.02, "steps": 2}
    sol = dx.simulate(dx.LagrangeDirac(bars), dx.EnergyCollocation(4), engine="native", **run)
    assert sol.ok and "simplified Newton" in sol.stats["iteration"] and sol.stats["newton_iterations"] < 130
    energy = sol.energy()
    assert np.max(np.abs(energy - energy[0])) < 1e-12


@pytest.mark.soak
def test_where_the_fixed_point_does_not_converge_newton_goes_on():
    stiff = dx.LagrangeDirac(
        lambda q, v: v @ v / 2 - 5000.0 * q[0] ** 2 / 2 - q[1] ** 4 / 4, lambda q: jnp.array([[0.0, q[0], 1.0]])
    )
    data = {"q": [1e-3, 1.0, 0.0], "v": [0.0, 0.1, -1e-4]}
    sol = dx.simulate(stiff, dx.EnergyCollocation(2), step=0.2, steps=50, engine="native", **data)
    energy = sol.energy()
    assert sol.ok and np.max(np.abs(energy - energy[0])) < 1e-13
    assert "simplified Newton" in sol.stats["iteration"] and "all unknowns" not in sol.stats["iteration"]
    flat = replace(dx.EnergyCollocation(2).step_equation(stiff, Shape(3, 1)), collocation=None)
    whole = dx.simulate(stiff, Stated(flat), step=0.2, steps=50, engine="native", **data)
    np.testing.assert_allclose(sol.q, whole.q, atol=1e-11)


@pytest.mark.parametrize("engine", ["native", pytest.param("xla", marks=pytest.mark.soak)])
@pytest.mark.soak
def test_gradients_are_those_of_differences(engine):
    system = dx.LagrangeDirac(lambda q, v, params: v @ v / 2 - params["k"] * q @ q / 2, lambda q: jnp.array([[q[1], 0.0, -1.0]]))

    def end(k):
        sol = dx.simulate(
            system,
            dx.EnergyCollocation(1, 4),
            q=[1.0, 0.5, 0.0],
            v=[0.1, 0.3, 0.05],
            params={"k": k},
            step=0.1,
            steps=4,
            engine=engine,
        )
        return sol.q[-1, 1]

    difference = (float(end(1.3 + 1e-4)) - float(end(1.3 - 1e-4))) / 2e-4
    assert float(jax.grad(end)(1.3)) == pytest.approx(difference, rel=1e-7)


def test_a_batch_and_a_stored_run(tmp_path):
    system, data, step = SYSTEMS["no constraints"]
    many = {name: np.array([value, np.multiply(value, 0.9)]) for name, value in data.items()}
    batch = dx.simulate(system, dx.EnergyCollocation(2), step=step, steps=10, **many)
    alone = dx.simulate(system, dx.EnergyCollocation(2), step=step, steps=10, **data)
    np.testing.assert_array_equal(batch.q[0], alone.q)
    alone.save(tmp_path / "run.nc")
    loaded = dx.load(tmp_path / "run.nc")
    np.testing.assert_array_equal(loaded.p, alone.p)
    assert loaded.stats["energy_defect"] == alone.stats["energy_defect"]


def test_what_the_quadrature_leaves_is_reported():
    system = dx.LagrangeDirac(lambda q, v: v @ v / 2 + jnp.cos(3 * q[0]))
    with pytest.warns(UserWarning, match="quadrature with 2 points is not exact"):
        sol = dx.simulate(system, dx.EnergyCollocation(2, points=2), q=[1.0], v=[0.5], step=0.3, steps=50)
    energy = sol.energy()
    assert 1e-6 < np.max(np.abs(np.diff(energy))) < 10 * sol.stats["energy_defect"]
    better = dx.simulate(system, dx.EnergyCollocation(2), q=[1.0], v=[0.5], step=0.3, steps=50)
    assert better.stats["energy_defect"] < 1e-12


def test_tables_of_the_quadrature():
    table, nodes = quadrature(3, 7), gauss(3)
    degree = np.arange(3)
    np.testing.assert_allclose(table.values @ nodes.nodes[:, None] ** degree, table.points[:, None] ** degree, atol=1e-15)
    np.testing.assert_allclose(
        table.matrix @ nodes.nodes[:, None] ** degree, table.points[:, None] ** (degree + 1) / (degree + 1), atol=1e-15
    )
    np.testing.assert_allclose(table.means @ table.points[:, None] ** degree, nodes.nodes[:, None] ** degree, atol=1e-14)
    np.testing.assert_allclose(table.end @ nodes.nodes[:, None] ** degree, 1.0, atol=1e-14)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"stages": 0}, "from 1 to 16"),
        ({"stages": 2.0}, "whole number"),
        ({"stages": 3, "points": 2}, "from the number of stages, 3"),
        ({"stages": 3, "points": 17}, "to 16"),
    ],
)
def test_bad_arguments(arguments, words):
    with pytest.raises(ValueError, match=words):
        dx.EnergyCollocation(**arguments)


def test_systems_that_it_does_not_step_are_refused():
    run = lambda system, **data: dx.simulate(system, dx.EnergyCollocation(), step=0.1, steps=1, **data)
    sphere = dx.LagrangeDirac(lambda q, v: v @ v / 2, holonomic=lambda q: jnp.array([q @ q - 1.0]))
    with pytest.raises(TypeError, match="does not keep holonomic constraints"):
        run(sphere, q=[1.0, 0.0], v=[0.0, 1.0])
    skewed = dx.DiracSystem(dx.DiracStructure.from_bivector(lambda x: jnp.array([[0.0, 1.0], [-0.9, 0.0]])), lambda x: x @ x / 2)
    for scheme in (dx.EnergyCollocation(), dx.Collocation(), dx.DiscreteDirac()):  # with none of them the energy would be kept
        with pytest.raises(ValueError, match=r"not (skew|antisymmetric)"):
            dx.simulate(skewed, scheme, x=[1.0, 0.0], step=0.1, steps=1)
    with pytest.raises(TypeError, match="ManifoldLagrangian was given"):
        run(dx.ManifoldLagrangian(lambda q, v: v @ v / 2, dx.Sphere(3)), q=[1.0, 0.0, 0.0], v=[0.0, 1.0, 0.0])
    suslov = dx.EulerPoincare(dx.SO3(), lambda xi: xi @ xi / 2, jnp.array([[1.0, 0.0, 0.0]]))
    with pytest.raises(TypeError, match="EulerPoincare was given"):
        run(suslov, x=suslov.state([0.0, 1.0, 0.0]))
    with pytest.raises(ValueError, match="one-step method"):
        run(SYSTEMS["no constraints"][0], q0=[0.0, 0.0], q1=[0.1, 0.0])


@pytest.mark.soak
def test_vortices_are_stepped_natively():
    """The matrix of their two-form is constant: the solves of all nodes are traced as one, which falls apart into theirs."""
    sol = gallery.get("vortices").simulate(dx.EnergyCollocation(2), steps=20)
    assert sol.stats["engine"] == "native" and np.ptp(sol.energy()) < 1e-14


@pytest.mark.soak
def test_the_snakeboard_passes_where_its_axles_stand_across():
    sol = gallery.get("snakeboard").simulate(dx.EnergyCollocation(2), steps=5000)
    across = np.cos(sol.q[:, 4])
    assert across.min() < -0.5 and np.ptp(sol.energy()) < 1e-14 and sol.stats["energy_defect"] < 1e-13


def test_a_distribution_that_changes_its_rank_is_refused_with_the_place():
    parallel = lambda q: jnp.array([[1.0, 0.0, 0.0, 0.0], [jnp.cos(q[3]), jnp.sin(q[3]), 0.0, 0.0]])  # where q[3] = 0
    system = dx.LagrangeDirac(lambda q, v: v @ v / 2 + q[0] * q[1] - q[2] ** 2 / 2, parallel)
    run = lambda q, v: dx.simulate(system, dx.EnergyCollocation(), q=q, v=v, step=0.125, steps=20)
    with pytest.raises(ValueError, match="depend"):
        run([0.3, 0.2, 0.1, 0.0], [0.0, 0.0, 0.1, 0.1])
    sol = run([0.3, 0.2, 0.1, -1.0], [0.0, 0.0, 0.1, 1.0])
    assert not sol.ok and "changes its rank" in sol.message and "near q = [" in sol.message
    assert run([0.3, 0.2, 0.1, -0.97], [0.0, 0.0, 0.1, 1.0]).ok


def chain_energy(q):
    d = jnp.diff(jnp.concatenate([jnp.zeros(1), q, jnp.zeros(1)]))
    return jnp.sum(d**2 / 2 + d**4 / 5)


def averaged_vector_field(data, h, force):
    """(q, p) after a step of the method of one stage: q' = (p_0 + p_1)/2, p' = ∫ F(q_0 + τ(q_1 − q_0)) dτ, by Simpson's rule."""
    q0, p0 = data
    q1, p1 = data
    for _ in range(60):
        mean = (force(q0) + 4 * force((q0 + q1) / 2) + force(q1)) / 6  # exact for a cubic force
        q1, p1 = q0 + h * (p0 + p1) / 2, p0 + h * mean
    return q1, p1


@pytest.mark.parametrize("kind", ["Lagrangian", "canonical bracket"])
@pytest.mark.soak_of(but=["Lagrangian"])
def test_chains_of_many_coordinates_are_sparse_and_keep_their_energy(kind):
    size, h = 150, 0.1
    q = np.sin(np.arange(size))
    force = lambda q: -np.asarray(slope(q))
    slope = jax.jit(jax.grad(chain_energy))
    if kind == "Lagrangian":
        system, data = dx.LagrangeDirac(lambda q, v: v @ v / 2 - chain_energy(q)), {"q": q, "v": 0 * q}
    else:
        unit = sp.identity(size)
        J = sp.csr_matrix(sp.bmat([[None, unit], [-unit, None]]))
        system = dx.PortHamiltonian(lambda x: x[size:] @ x[size:] / 2 + chain_energy(x[:size]), J)
        data = {"x": np.concatenate([q, 0 * q])}
    sol = dx.simulate(system, dx.EnergyCollocation(1, points=2), **data, step=h, steps=8)
    energy = sol.energy()
    assert sol.ok and sol.stats["engine"] == "sparse" and sol.stats["by_sites"]
    assert np.max(np.abs(energy - energy[0])) < 4e-15 * energy[0] and sol.stats["energy_defect"] < 1e-14
    x = np.concatenate([sol.q, sol.p], axis=1) if kind == "Lagrangian" else sol.x
    expected = averaged_vector_field((x[0, :size], x[0, size:]), h, force)
    np.testing.assert_allclose(x[1], np.concatenate(expected), rtol=0, atol=1e-14)


def many_ports(size=5):
    skew = sp.csr_matrix(sp.diags([np.ones(size - 1), -np.ones(size - 1)], [1, -1]))
    first = sp.csr_matrix(([1.0], ([0], [0])), (size, 1))
    drive = lambda t, x: jnp.stack([jnp.sin(t)])
    energy = lambda x: x @ x / 2 + jnp.sum(x**4) / 10
    system = dx.PortHamiltonian(energy, skew, first, sp.csr_matrix(sp.identity(size) / 10), inputs=drive)
    return system, {"x": np.sin(np.arange(size))}


def many_masses(size=2):
    """Masses that are not diagonal and change with q, not quadratic in v, with forces and explicit time."""

    def lagrangian(t, q, v):
        moved = jnp.diff(v)
        kinetic = v @ v / 2 + jnp.sum((0.3 + 0.1 * jnp.sin(q[1:])) * moved**2) + jnp.sum(v**4) / 50
        return kinetic - (1 + 0.1 * jnp.cos(t)) * chain_energy(q)

    q = np.sin(np.arange(size))
    return dx.LagrangeDirac(lagrangian, forces=lambda t, q, v: jnp.sin(t) - v / 10), {"q": q, "v": 0.2 * q[::-1]}


@pytest.mark.parametrize("made", [many_ports, many_masses])
@pytest.mark.soak
def test_steps_of_many_coordinates_are_those_of_few(made, monkeypatch):
    """The same step with other unknowns and equations."""
    run = lambda engine: dx.simulate(made()[0], dx.EnergyCollocation(2, points=4), **made()[1], step=0.1, steps=6, engine=engine)
    theirs = run("native")
    for kind in ("hamiltonian", "lagrangian"):
        monkeypatch.setattr(f"dirax.schemes.{kind}_energy_collocation_step.FEWEST_SPARSE", 2)
    dx.clear_caches()  # the same functions are the same system
    ours = run("sparse")
    assert ours.ok and theirs.ok and "iteration" in theirs.stats and ours.stats["unknowns"] in (2 * 5, (4 + 5) * 2)
    for name in ours.fields:
        if name != "energy_defect":
            np.testing.assert_allclose(ours.fields[name], theirs.fields[name], rtol=0, atol=1e-13, err_msg=name)
    energy, work = ours.energy(), ours.fields["work"]
    work = work[:, 0] - work[:, 1] if work.ndim == 2 else work
    np.testing.assert_allclose(energy - energy[0], work, rtol=0, atol=1e-14 * np.max(np.abs(energy)))


def test_a_large_bracket_that_is_not_antisymmetric_is_refused():
    size = 140
    x = np.sin(np.arange(size))
    skewed = sp.lil_matrix(sp.diags([np.ones(size - 1), -np.ones(size - 1)], [1, -1]))
    system = dx.PortHamiltonian(lambda x: x @ x / 2, sp.csr_matrix(skewed))
    equation = dx.EnergyCollocation(1).step_equation(system, Shape(size))
    equation.check({"x": x}, 0.1, None)
    skewed[7, 9] = 1e-3
    bracket = sp.csr_matrix(skewed)
    energy = system.energy_form(Shape(size))._replace(
        residual=lambda x, v, u, t, params, gradient: v - dx.PortHamiltonian(lambda x: x @ x, bracket).J(x) @ gradient, ports=None
    )
    step = replace(equation.residual.__self__, form=energy)
    with pytest.raises(ValueError, match=r"not antisymmetric .* at random"):
        step.check({"x": x}, 0.1, None)


@pytest.mark.soak
def test_three_one_forms_of_a_car_with_a_trailer_are_native():
    """Twenty solves of eight equations side by side were taken for one of 160, and left to XLA, which compiled for 46 s."""

    def one_forms(q):
        (_, _, heading, steer, trailer), zero = q, 0.0 * q[0]
        row = lambda *entries: jnp.stack([zero + e for e in entries])
        s, c = jnp.sin, jnp.cos
        return jnp.stack([
            row(s(heading), -c(heading), 0, 0, 0),
            row(s(heading + steer), -c(heading + steer), -c(steer), 0, 0),
            row(s(trailer), -c(trailer), 0, 0, 1.5),
        ])  # fmt: skip

    car = dx.LagrangeDirac(lambda q, v: v[:2] @ v[:2] + 0.3 * v[2] ** 2 + 0.05 * v[3] ** 2 + 0.2 * v[4] ** 2, one_forms)
    q, v = np.array([0.0, 0.0, 0.1, 0.2, 0.0]), np.array([1.0, 0.1, 0.2, 0.1, 0.0])
    sol = dx.simulate(car, dx.EnergyCollocation(1), q=q, v=v, project=True, step=0.05, steps=40)
    assert sol.stats["engine"] == "native" and np.ptp(sol.energy()) < 1e-14


@pytest.mark.parametrize("engine", ["native", pytest.param("xla", marks=pytest.mark.soak)])
def test_euler_poincare_equations_are_the_lie_poisson_ones(engine):
    run = {"x": [0.3, 0.8, 1.2, 0.0, 0.6, 0.8], "step": 0.1, "steps": 10, "engine": engine}
    ours, theirs = (dx.simulate(s, dx.EnergyCollocation(1), **run) for s in (TOP, TOP.lie_poisson()))
    np.testing.assert_allclose(ours.x, theirs.x, rtol=0, atol=1e-13)


def test_the_power_of_steps_of_their_own_length_is_balanced():
    oscillator = dx.PortHamiltonian(
        lambda x: x[0] ** 2 / 2 + x[0] ** 4 / 4 + x[1] ** 2 / 2,
        J=np.array([[0.0, 1.0], [-1.0, 0.0]]),
        B=np.array([[0.0], [1.0]]),
        R=np.diag([0.0, 0.1]),
        inputs=lambda t, x: jnp.array([jnp.sin(1.3 * t) / 2]),
    )
    scheme = dx.VariableSteps(dx.DiscreteGradient(), lambda x: 1 + 0.2 * x[0] ** 2)
    sol = dx.simulate(oscillator, scheme, x=[1.0, 0.3], step=0.05, steps=100)
    assert dx.verify(sol)["power balance of every step"].verdict == "ok"
    power = np.array(sol.power)
    power[50, 0] += 1e-6
    assert dx.verify(sol.replace(fields=sol.fields | {"power": power}))["power balance of every step"].verdict == "VIOLATED"


def test_steps_that_contract_slowly_are_solved():
    """In the field of a dipole the sizes of the rates are bounds 10⁴ times too large, and steps were left that still contracted:
    the energy changed by 9·10⁻¹² and by 10⁻¹⁰ of its terms in a step."""

    def field(q):
        moment, r = jnp.array([0.0, 0.2, 1.0]), jnp.sqrt(q @ q)
        return 3 * q * (moment @ q) / r**5 - moment / r**3

    def form(x):
        b = field(x[:3])
        turn = jnp.array([[0.0, -b[2], b[1]], [b[2], 0.0, -b[0]], [-b[1], b[0], 0.0]])
        return jnp.block([[-turn, -jnp.eye(3)], [jnp.eye(3), jnp.zeros((3, 3))]])

    system = dx.DiracSystem(dx.DiracStructure.from_two_form(form), lambda x: x[3:] @ x[3:] / 2 + 0.1 * x[2] ** 2)
    for step, most in [(0.05, 1e-11), (0.025, 1e-14)]:
        sol = dx.simulate(system, dx.EnergyCollocation(), x=[1.0, 0.2, 0.1, 0.1, 0.5, 0.3], step=step, steps=100)
        assert np.max(sol.energy_defect) < most
    assert dx.verify(sol)["steps replayed"].verdict == "ok"


def test_why_no_form_is_checked_is_said_of_moving_constraints_too():
    """Their work was taken for that of forces."""
    forms, moving = lambda q: jnp.stack([jnp.sin(q[2]), -jnp.cos(q[2]), 0 * q[0]])[None], lambda q: 0.2 * jnp.cos(q[2:])
    system = dx.LagrangeDirac(lambda q, v: v @ v / 2, forms, affine=moving)
    sol = dx.simulate(system, dx.EnergyCollocation(2), q=[0.0, 0.0, 0.3], v=[0.0, 0.2, 0.4], step=0.02, steps=10)
    assert "keeps the energy, and no two-form" in dx.verify(sol)["symplecticity of one step"].explanation


@pytest.mark.parametrize("place", [1e5, 1e7])
@pytest.mark.filterwarnings("error")
def test_far_from_the_origin_the_energy_is_kept_and_said_to_be(place):
    """Every quadrature of this system is exact; a last place of q changes H by more than roundoff of its terms."""
    system = dx.LagrangeDirac(lambda q, v: v @ v / 2 - (q[0] - place) ** 2 / 2)
    sol = dx.simulate(system, dx.EnergyCollocation(2), q=[place + 1.0], v=[0.0], step=0.01, steps=400)
    assert np.ptp(sol.energy()) < 1e-15 * place and abs(sol.energy()[-1] - 0.5) < 1e-14
    np.testing.assert_allclose(sol.q[-1, 0] - place, np.cos(4.0), atol=1e-10 + 1e-15 * place)
    assert dx.verify(sol).ok
