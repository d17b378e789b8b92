"""Roots inside of a step as unknowns of it: the same steps, by every engine."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dirax as dx
from dirax.engines.lifted import lifted
from dirax.program.lifted_roots import LiftedJaxpr, Unliftable, has_roots
from dirax.program.roots import nearest_root
from dirax.schemes.step import make_step_equation
from dirax.systems.shape import Shape

INERTIA = np.array([1.0, 2.0, 3.0])
MOMENTUM = [0.5, 0.3, 0.4]

kinetic = lambda xi, params: jnp.sqrt(1.0 + params["scale"] * xi @ (INERTIA * xi))
closed_form = lambda mu, params: -jnp.sqrt(1.0 - mu @ (mu / INERTIA) / params["scale"])
"""h of l = √(1 + s ξ·Iξ): μ = s Iξ/l, so that ⟨μ, ξ⟩ − l = −√(1 − μ·I⁻¹μ/s)."""

BY_ROOTS = dx.EulerPoincare(dx.SO3(), kinetic).lie_poisson()
BY_FORMULA = dx.LiePoisson(dx.SO3(), closed_form)

SCHEMES = {
    "collocation": dx.Collocation(2),
    "discrete Dirac": dx.DiscreteDirac(),
    "discrete Euler-Poincaré": dx.DiscreteEulerPoincare(),
    "energy collocation": dx.EnergyCollocation(1),
    "discrete gradient": dx.DiscreteGradient(),
    "composition": dx.Composition(dx.DiscreteDirac(), "suzuki4"),
    "variable steps": dx.VariableSteps(dx.DiscreteDirac(), density=lambda mu: 1.0 + mu[0] ** 2),
}


def run(system, scheme, momentum=MOMENTUM, scale=1.3, steps=40, **more):
    return dx.simulate(system, scheme, x=momentum, step=0.05, steps=steps, params={"scale": scale}, **more)


@pytest.mark.parametrize("scheme", SCHEMES.values(), ids=SCHEMES)
@pytest.mark.soak_of(but=["discrete gradient", "composition"])
def test_steps_with_roots_are_those_of_the_formula_of_the_root(scheme):
    found, known = run(BY_ROOTS, scheme), run(BY_FORMULA, scheme)
    assert found.stats["engine"] == known.stats["engine"] == "native"
    for name in known.fields:
        assert found.fields[name] == pytest.approx(known.fields[name], rel=0, abs=3e-13), name


def test_such_a_run_is_verified_and_goes_on():
    sol = run(BY_ROOTS, SCHEMES["collocation"])
    report = dx.verify(sol)
    assert {line.quantity: line.verdict for line in report.lines}["steps replayed"] == "ok"
    assert np.array_equal(sol.extend(10).x, run(BY_ROOTS, SCHEMES["collocation"], steps=50).x)
    known = run(BY_FORMULA, SCHEMES["collocation"])
    assert sol.at(0.33).x == pytest.approx(known.at(0.33).x, abs=1e-13)


@pytest.mark.soak
def test_its_derivatives_are_those_of_the_formula_of_the_root():
    def end(system, momentum, scale):
        return jnp.sum(run(system, SCHEMES["collocation"], momentum, scale).x[-1] ** 2 * INERTIA)

    of = lambda system: jax.grad(lambda *values: end(system, *values), (0, 1))(jnp.array(MOMENTUM), 1.3)
    for found, known in zip(of(BY_ROOTS), of(BY_FORMULA), strict=True):
        assert np.asarray(found) == pytest.approx(np.asarray(known), abs=1e-12)


@pytest.mark.soak
def test_engines_agree_on_a_batch_with_parameters_of_its_own():
    momenta, scales = np.outer([1.0, 0.9, 0.5], MOMENTUM), np.array([1.3, 1.5, 1.1])
    of = lambda system, engine: run(system, SCHEMES["discrete Dirac"], momenta, scales, engine=engine, batch_params=True)
    native = of(BY_ROOTS, "native")
    assert native.x == pytest.approx(of(BY_ROOTS, "xla").x, abs=1e-14)
    assert native.x == pytest.approx(of(BY_FORMULA, "native").x, abs=1e-13)


def of_circuit(netlist, count):
    system = dx.circuit(netlist)
    scheme = dx.VariableSteps(dx.DiscreteDirac(), density=lambda x: 1.0 + x @ x)
    shape = Shape(*system.sizes({"x": jnp.ones(count), "t": 0.0}, None))
    equation = make_step_equation(scheme, system, shape)
    return equation, lifted(equation, None, False)


DIODE = lambda u: 1e-3 * jnp.expm1(10.0 * u)


def test_the_unknowns_of_a_lifted_step_are_its_own_and_those_of_its_roots():
    equation, whole = of_circuit([("C", 1, 0, 1.0), ("L", 1, 0, 2.0), ("R", 1, 0, DIODE)], 2)
    assert whole.unknowns == equation.unknowns + 2 * 3  # rates and the potential, at both ends of the step
    assert [*whole.unknown_layout] == [*equation.unknown_layout, "root_0", "root_1"]
    assert whole.labels[-1] == "equation 2 of root 1 inside of the step"
    assert lifted(equation, None, False) is whole and lifted(whole, None, False) is whole


def test_roots_that_their_equations_leave_free_stay_inside():
    equation, whole = of_circuit([("C", 1, 0, 1.0), ("C", 1, 0, 2.0), ("L", 1, 0, 2.0), ("R", 1, 0, DIODE)], 3)
    assert whole is equation


def test_roots_in_a_loop_stay_inside():
    def looped(x):
        return jax.lax.fori_loop(0, 3, lambda _, x: nearest_root(lambda u: u + u**3 - x, x), x)

    closed = jax.make_jaxpr(looped)(jnp.ones(2))
    assert has_roots(closed.jaxpr)
    with pytest.raises(Unliftable):
        LiftedJaxpr(closed)


@pytest.mark.parametrize("count", [3, 70])
@pytest.mark.soak
def test_roots_side_by_side_and_their_derivatives(count):
    """Those of u + a u³ = b, in the middle of a derivative, for each of the a; asked for twice."""
    root = lambda a, b: nearest_root(lambda u: u + a * u**3 - b, b)
    sums = lambda a, b: jnp.sum(jax.vmap(lambda a: root(a, b))(a) ** 2)
    both = lambda a, b: sums(a, b) + jax.grad(sums)(a, b) @ a
    a, b = np.linspace(0.1, 0.5, count), np.array([1.0, 2.0])
    lift = LiftedJaxpr(jax.make_jaxpr(both)(a, b))
    assert [kind.shape for kind in lift.kinds] == [(count, 2)]
    roots = lift.roots([a, b])
    value, defect = lift.part(0, 1)([*roots, a, b])
    assert np.max(np.abs(defect)) < 1e-15
    assert roots[0] + a[:, None] * roots[0] ** 3 == pytest.approx(np.broadcast_to(b, (count, 2)), abs=1e-15)
    slopes = -(roots[0] ** 3) / (1.0 + 3.0 * a[:, None] * roots[0] ** 2)
    expected = np.sum(roots[0] ** 2) + np.sum(2.0 * roots[0] * slopes * a[:, None])
    assert float(value) == pytest.approx(float(expected), rel=1e-14)


@pytest.mark.parametrize("scheme", [dx.Collocation(2), dx.DiscreteDirac()], ids=["collocation", "discrete Dirac"])
@pytest.mark.soak
def test_a_motion_whose_momentum_comes_to_have_no_velocity_ends_there(scheme):
    """The momenta of √(1 + ξ·Iξ) are bounded, gravity drives one out of them, and the root goes to infinity."""
    body = dx.EulerPoincare(dx.SO3(), lambda xi, a: jnp.sqrt(1.0 + xi @ (INERTIA * xi)) - 5.0 * a[2], advected=3)
    start = body.state([0.3, 0.3, 0.2], [0.8, 0.0, 0.6])
    sol = dx.simulate(body.lie_poisson(), scheme, x=start, step=0.05, steps=40, engine="native")
    assert not sol.ok and sol.rows < 12
    assert sol.stats["max_residual"] < 1e-10
    assert np.all(np.abs(sol.x) < 2.0)


@pytest.mark.parametrize("flux", [-5e-4, -5e-3])
@pytest.mark.soak_of("-0.0005")
def test_a_root_that_is_not_there_at_the_guess_of_a_long_step(flux):
    """A guess that leads a coil beyond what a diode lets back; x by shorter steps is the same up to their error."""
    circuit = dx.circuit([("L", 1, 0, 1.0), ("R", 1, 0, DIODE), ("C", 2, 0, 1.0), ("R", 2, 0, 1.0)])
    scheme = dx.VariableSteps(dx.DiscreteDirac(), density=lambda x: 1.0 + x @ x)
    sol = dx.simulate(circuit, scheme, x=[0.1, flux], step=0.05, steps=40)
    assert sol.ok and sol.stats["engine"] == "native"
    assert sol.x[:, 0] == pytest.approx(0.1 * np.exp(-sol.t), rel=1e-3)
