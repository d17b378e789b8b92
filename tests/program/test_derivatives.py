"""Derivatives on the scalar graph are JAX's; functions of the user are traced once; outside of tracing nothing changes."""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.extend.core import jaxpr_as_fun

import dirax as dx
from dirax.geometry.squared_angles import arc_over_sine, norm, radial
from dirax.program.evaluation.functions import in_numpy, program_of
from dirax.program.evaluation.in_numpy import Values
from dirax.program.graph_derivatives import gradient as gradient_of_nodes
from dirax.program.graph_derivatives import jacobian as derivatives_of_nodes
from dirax.program.roots import nearest_root
from dirax.program.rules import by_numpy
from dirax.program.tracing import along, closed_over, gradient, jacobian, once

POINT = np.array([0.3, 0.9, -0.4])
SCALARS = {
    "polynomial": lambda q: q[0] ** 2 * q[1] - q[1] ** 3 / 3 + q[2] ** 5 + q[0] ** -3,
    "powers": lambda q: q[1] ** 2.5 / q[0] ** 0.5 + (q @ q) ** 1.5 + q[1] ** q[0],
    "functions": lambda q: jnp.sin(q[0]) * jnp.exp(q[1]) / jnp.cosh(q[2]) + jnp.arctan2(q[0], q[2]) * jnp.log1p(q[1]),
    "matrices": lambda q: q @ jnp.outer(q, jnp.tanh(q)) @ q + jnp.sum(jnp.linalg.norm(jnp.stack([q, 2 * q]), axis=1)),
    "indices": lambda q: q[jnp.array([2, 0, 1])] @ q.at[1].set(q[0] * q[2]),
    "branches": lambda q: (
        jnp.where(q[0] > 0.1, jnp.sqrt(jnp.where(q[0] > 0.1, q[0], 1.0)), q[1]) + jnp.where(q[2] > 0, q[0], q[1])
    ),
    "a rule of its own": lambda q: radial(1, q @ q) * radial(0, 2 * q[0] ** 2) + norm(q) ** 3,
    "two arguments with a rule": lambda q: arc_over_sine(0, q[0] ** 2, 1 - q[0] ** 2) * q[1],
    "a corner": lambda q: jnp.abs(q[2]) * jnp.maximum(q[0], q[1]),
    "a solve": lambda q: q @ jnp.linalg.solve(jnp.diag(1 + q**2) + 0.1, q),
    "no dependence": lambda q: jnp.ones(()) + 0.0 * jnp.floor(q[0]),
    "a decomposition that is compared": lambda q: jnp.where(jnp.linalg.eigvalsh(jnp.outer(q, q))[0] < 1.0, q[0] ** 2, q[1]),
    "what is held": lambda q: jax.lax.stop_gradient(q[0]) * q[1],
}
VECTORS = {
    "wide": lambda q: jnp.stack([q @ q, q[0] * q[1]]),
    "tall": lambda q: jnp.concatenate([q * q[0], jnp.sin(q), jnp.where(q > 0, q**3, -q)]),
    "a matrix": lambda q: jnp.outer(q, jnp.exp(q)),
    "steps": lambda q: q * jnp.round(3 * q) + jnp.floor(q) * jnp.ceil(q) + jnp.sign(q) * q**2,
    "what is compared": lambda q: jnp.where(jnp.max(jnp.abs(jax.lax.stop_gradient(q))) < jnp.linalg.norm(q), q**2, -q),
}


def by_jax(function, *point):
    """The same by XLA."""
    return np.asarray(jax.jit(function)(*(point or (POINT,))))


def on_graph(function, *point):
    """The value of a function that is traced in scalars, at one point."""
    found = in_numpy(function, [np.asarray(x, float)[None] for x in point], function)
    assert found is not None
    return jax.tree.map(lambda leaf: leaf[0], found)


@pytest.mark.parametrize("name", SCALARS)
def test_gradients_are_those_of_jax(name):
    f = SCALARS[name]
    assert on_graph(gradient(f), POINT) == pytest.approx(by_jax(jax.grad(f)), rel=1e-14, abs=1e-14)


@pytest.mark.parametrize("name", ["polynomial", "powers", "branches", "a rule of its own", "a corner"])
@pytest.mark.soak_of("a rule of its own")
def test_second_derivatives_are_those_of_jax(name):
    f = SCALARS[name]
    assert on_graph(jacobian(gradient(f)), POINT) == pytest.approx(by_jax(jax.hessian(f)), rel=1e-12, abs=1e-12)


@pytest.mark.parametrize("name", VECTORS)
@pytest.mark.parametrize("reverse", [False, True])
def test_jacobians_and_directions_are_those_of_jax(name, reverse):
    f, v = VECTORS[name], np.array([1.0, -2.0, 0.5])
    expected = by_jax(jax.jacfwd(f))
    assert on_graph(jacobian(f, reverse=reverse), POINT) == pytest.approx(expected, rel=1e-14, abs=1e-14)
    assert on_graph(lambda q, v: along(f, (q,), (v,)), POINT, v) == pytest.approx(expected @ v, rel=1e-14, abs=1e-14)


IN_NUMBERS = [*list(SCALARS)[:8], *VECTORS]


@pytest.mark.parametrize("few", [False, True])
@pytest.mark.parametrize("name", IN_NUMBERS)
def test_derivatives_in_numbers_are_those_of_jax(name, few, monkeypatch):
    """Of large functions no graph of the derivative is made: forward, or backward from fewer results than there are numbers."""
    monkeypatch.setattr(by_numpy, "LARGE_FOR_FEW" if few else "LARGE_DERIVATIVE", 0)
    f, points = (SCALARS | VECTORS)[name], np.stack([POINT, 1.1 * POINT])
    found = program_of(jacobian(f), [jax.ShapeDtypeStruct((3,), np.float64)], ("in numbers", name), few)
    assert found is not None and found[0].opaque
    expected = np.stack([np.asarray(jax.jacfwd(f)(point)) for point in points])
    assert found[0].in_numpy([points])[0] == pytest.approx(expected, rel=1e-14, abs=1e-14)


def test_what_a_result_does_not_depend_on_is_known_to_be_zero_of_derivatives_in_numbers(monkeypatch):
    monkeypatch.setattr(by_numpy, "LARGE_DERIVATIVE", 0)
    f = lambda q: jnp.concatenate([q[:9] * q[1:10], jnp.sin(q[:1])])
    made, _ = program_of(jacobian(f), [jax.ShapeDtypeStruct((10,), np.float64)], "zeros of derivatives")
    unknown = np.isnan(made.constants(made.results[0]))
    expected = np.eye(10) + np.eye(10, k=1)
    expected[9] = np.eye(10)[0]
    np.testing.assert_array_equal(unknown, expected != 0)


def test_an_infinite_derivative_of_a_branch_that_is_not_taken_counts_for_nothing(monkeypatch):
    monkeypatch.setattr(by_numpy, "LARGE_DERIVATIVE", 0)
    f = lambda q: jnp.where(q[0] > 0.0, jnp.sqrt(q[0]), q[1]) + q[2]
    assert on_graph(jacobian(f), np.zeros(3)) == pytest.approx([0.0, 1.0, 1.0], abs=0)


def test_functions_that_say_the_same_have_one_jaxpr():
    def traced(factor, power=2, inner=jnp.sin):
        again = lambda q: jnp.sum(jnp.asarray(factor) * inner(q) ** power)
        return closed_over(lambda q: jax.jit(again)(q) + again(q[:2]), [POINT])[0]

    first = traced(np.array([2.0]))
    assert traced(np.array([2.0])) is first
    assert traced(np.array([-2.0])) is not first and traced(np.array([2.0]), 3) is not first
    assert traced(np.array([0.0])) is not traced(np.array([-0.0]))
    assert traced(np.array([2.0]), inner=jnp.cos) is not first


def test_a_function_of_several_arguments_and_of_what_it_captured():
    def slopes(q, h, k):
        double = 2 * q  # captured, and traced
        return gradient(lambda q, h: k * jnp.sum(jnp.sin(q * double)) * h**3, (0, 1))(q, h)

    dq, dh = on_graph(slopes, POINT, 0.5, 3.0)
    assert dq == pytest.approx(3 * 0.125 * 2 * POINT * np.cos(2 * POINT**2), rel=1e-14)
    assert dh == pytest.approx(3 * 3 * 0.25 * np.sum(np.sin(2 * POINT**2)), rel=1e-14)


def test_an_operand_that_is_itself_an_expression_is_not_looked_into():
    """d/dy (−y z) at y = −x is −z, though −(−x) z is x z on the graph."""
    f = lambda x, z: gradient(lambda y: -y * z)(-x)
    assert on_graph(f, 2.0, 3.0) == -3.0


@pytest.mark.parametrize("name", ["functions", "a rule of its own", "branches"])
@pytest.mark.soak
def test_the_primitive_is_differentiated_and_vectorized_by_jax(name):
    """What JAX traces has one equation a derivative, which is jax.grad to every transformation."""
    f = SCALARS[name]
    jaxpr = jax.make_jaxpr(gradient(f))(POINT)
    assert "dirax_derivative" in str(jaxpr)
    evaluated = lambda q: jaxpr_as_fun(jaxpr)(q)[0]
    rows = jnp.stack([POINT, POINT + 0.1])
    assert jax.jit(evaluated)(POINT) == pytest.approx(by_jax(jax.grad(f)), rel=1e-14)
    assert evaluated(POINT) == pytest.approx(by_jax(jax.grad(f)), rel=1e-14)
    assert by_jax(jax.vmap(evaluated), rows) == pytest.approx(by_jax(jax.vmap(jax.grad(f)), rows), rel=1e-14)
    assert by_jax(jax.jacfwd(evaluated)) == pytest.approx(by_jax(jax.hessian(f)), rel=1e-12)
    assert by_jax(jax.jacrev(evaluated)) == pytest.approx(by_jax(jax.hessian(f)), rel=1e-12)


@pytest.mark.parametrize("name", VECTORS)
@pytest.mark.soak
def test_a_direction_is_differentiated_and_vectorized_by_jax(name):
    f, v = VECTORS[name], np.array([1.0, -2.0, 0.5])
    ours = lambda q, v: along(f, (q,), (v,))
    theirs = lambda q, v: jax.jvp(f, (q,), (v,))[1]
    assert "dirax_directional" in str(jax.make_jaxpr(ours)(POINT, v))
    rows = np.stack([POINT, POINT + 0.1])
    over_rows = lambda f: jax.vmap(f, (0, None))
    cases = [(jax.jit, POINT), (jax.jacfwd, POINT), (jax.jacrev, POINT), (lambda f: jax.jacfwd(f, 1), POINT), (over_rows, rows)]
    for transform, q in cases:
        expected = by_jax(transform(theirs), q, v)
        assert by_jax(transform(ours), q, v) == pytest.approx(expected, rel=1e-12, abs=1e-14)
        assert transform(ours)(q, v) == pytest.approx(expected, rel=1e-12, abs=1e-14)


def test_outside_a_trace_jax_differentiates():
    seen = []
    slope = gradient(lambda q: seen.append(q) or q @ q)(POINT)
    assert slope == pytest.approx(2 * POINT) and len(seen) == 1
    with pytest.raises(TypeError, match="scalar"):
        jax.make_jaxpr(gradient(lambda q: q))(POINT)


def test_a_function_is_traced_once_within_a_run_and_again_in_the_next():
    traced = []

    def lagrangian(q, v):
        traced.append(1)
        return v @ v / 2 - jnp.sum(1 - jnp.cos(q)) * SLOPE[0]

    def end():
        system = dx.LagrangeDirac(lambda q, v: lagrangian(q, v))
        return dx.simulate(system, dx.LagrangeDAlembert(), q=[1.0], v=[0.0], step=0.1, steps=20, engine="native").q[-1, 0]

    SLOPE = [1.0]
    first, count = end(), len(traced)
    assert count == 1
    SLOPE[0] = 4.0  # what a function reads from elsewhere is read again for a new system
    assert end() != first
    assert len(traced) == 2 * count


def test_functions_and_methods_are_traced_once_and_called_plainly():
    seen = []

    @dataclass(frozen=True)
    class Scaled:
        by: float

        @once
        def times(self, x):
            """x times the factor."""
            seen.append(x)
            return self.by * x

    assert Scaled(2.0).times(1.0) == 2.0 and seen == [1.0]
    assert Scaled.times.__doc__ == "x times the factor."
    twice = lambda x: Scaled(2.0).times(Scaled(2.0).times(x)) + Scaled(3.0).times(x)
    assert jax.jit(twice)(1.0) == 7.0
    assert len(seen) == 3  # once for each factor


def test_derivatives_of_a_root_of_first_and_second_order():
    """u = the root of u³ + a u = b: u' = 1/(3u² + a) by b, −u/(3u² + a) by a; second derivatives from these."""

    def root(a, b):
        return nearest_root(lambda u: u**3 + a * u - b, jnp.ones(1))[0]

    a, b = 0.7, 2.1
    u = float(by_jax(root, a, b))
    assert u**3 + a * u == pytest.approx(b, rel=1e-15)
    slope = 1 / (3 * u**2 + a)
    assert by_jax(jax.grad(root), a, b) == pytest.approx(-u * slope, rel=1e-14)
    assert by_jax(jax.jacfwd(root, 1), a, b) == pytest.approx(slope, rel=1e-14)
    assert by_jax(jax.grad(jax.grad(root, 1), 1), a, b) == pytest.approx(-6 * u * slope**3, rel=1e-13)
    assert jax.jit(jax.vmap(jax.grad(root, 1), (None, 0)))(a, jnp.array([b, b])) == pytest.approx([slope] * 2, rel=1e-14)


CONTACTS = {
    "where": lambda x: jnp.where(x > 0.5, x - 0.5, 0.0),
    "maximum": lambda x: jnp.maximum(x - 0.5, 0.0) / 1.5,
    "minimum": lambda x: -jnp.minimum(0.5 - x, 0.0),
    "two": lambda x: jnp.maximum(x - 0.5, 0.0) + 2.0 * jnp.maximum(x - 0.7, 0.0),
}


@pytest.mark.parametrize("contact", CONTACTS)
@pytest.mark.parametrize("power", [1.5, 2.5, 3.5, 2.3])
def test_the_stiffness_of_a_contact_is_zero_in_free_flight(contact, power):
    """The function is constant there, and so are its derivatives, of any order that JAX itself finds for the first."""
    gap = CONTACTS[contact]
    made, _ = program_of(gradient(lambda x: gap(x) ** power), [jax.ShapeDtypeStruct((), np.float64)], (contact, power))
    (force,), (x,) = (nodes.ravel().tolist() for nodes in (*made.results, *made.inputs))
    (row,) = derivatives_of_nodes(made.graph, [force], [x])
    (backward,) = gradient_of_nodes(made.graph, {force: made.graph.one}, [x])
    (third,) = derivatives_of_nodes(made.graph, [row[0]], [x]) if 0 in row else ({},)
    nodes = [row.get(0, made.graph.zero), backward, third.get(0, made.graph.zero)]
    with np.errstate(all="ignore"):
        assert np.array(made.graph.evaluate(nodes, {made.graph.value[x]: np.float64(0.0)})) == pytest.approx(np.zeros(3), abs=0)
    numbers = Values(made.graph, 1)
    numbers.bind(made.inputs[0], np.zeros((1, 1)))
    assert numbers.slopes([force], [x]).item() == 0.0


@pytest.mark.parametrize("power", [1.5, 2.5, 3.5])
def test_half_powers_have_the_slope_of_a_power_at_zero_and_elsewhere(power):
    """(c|x|)^p, of which x = 0 is an edge of the root alone."""
    made, _ = program_of(lambda x: (3.0 * jnp.abs(x)) ** power, [jax.ShapeDtypeStruct((), np.float64)], power)
    (row,) = derivatives_of_nodes(made.graph, made.results[0].ravel().tolist(), made.inputs[0].ravel().tolist())
    for x in (0.0, 0.7, -2.0):
        (found,) = made.graph.evaluate([row[0]], {made.graph.value[made.inputs[0].item()]: np.float64(x)})
        assert found == pytest.approx(power * 3.0**power * abs(x) ** (power - 1) * np.sign(x), rel=1e-15)


def test_the_norm_has_no_derivative_at_zero():
    """Its square is zero there with its slope, but it is not constant near by: ∞·0 is no number."""
    made, _ = program_of(lambda q: jnp.sqrt(q @ q), [jax.ShapeDtypeStruct((2,), np.float64)], "norm")
    (row,) = derivatives_of_nodes(made.graph, made.results[0].ravel().tolist(), made.inputs[0].tolist())
    with np.errstate(all="ignore"):
        assert np.isnan(
            made.graph.evaluate([row[0]], dict.fromkeys(map(made.graph.value.get, made.inputs[0].tolist()), np.float64(0)))
        )


@pytest.mark.parametrize("engine", ["native", "xla"])
@pytest.mark.soak_of("xla")
def test_a_hertz_contact_flies_freely(engine):
    """V = 200 max(x − ½, 0)^2.5: no force acts where the contact is open."""
    potential = lambda x: 200.0 * jnp.maximum(x - 0.5, 0.0) ** 2.5
    system = dx.LagrangeDirac(lambda q, v: v @ v / 2 - potential(q[0]))
    solution = dx.simulate(system, dx.LagrangeDAlembert(), q=[0.0], v=[1.0], step=0.01, steps=3, engine=engine)
    assert solution.ok and solution.q[:, 0] == pytest.approx(solution.t, abs=1e-15)


@pytest.mark.soak
def test_a_loop_of_unknown_length_is_differentiated_forwards():
    def potential(q):
        until = lambda s: s[0] < 3.0 + jnp.abs(q[0])
        return jax.lax.while_loop(until, lambda s: (s[0] + 1.0, jnp.sin(s[1]) + q[0]), (0.0, q[1]))[1]

    system = dx.LagrangeDirac(lambda q, v: v @ v / 2 - potential(q))
    plain = dx.LagrangeDirac(lambda q, v: v @ v / 2 - (jnp.sin(jnp.sin(jnp.sin(jnp.sin(q[1]) + q[0]) + q[0]) + q[0]) + q[0]))
    run = lambda system: dx.simulate(system, dx.LagrangeDAlembert(), q=[0.3, 0.2], v=[0.1, 0.0], step=0.01, steps=5)
    np.testing.assert_allclose(run(system).p, run(plain).p, rtol=1e-13)
