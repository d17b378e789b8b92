"""Blocks of unknowns that are found one after the other, and the elimination of matrices that have them."""

import itertools

import jax.numpy as jnp
import numpy as np
import pytest

import dirax as dx
from dirax import gallery
from dirax.engines.blocks import FEWEST, blocks
from dirax.engines.contract import Problem
from dirax.engines.native.kernels import kernels
from dirax.engines.newton_step import Factors, newton_corrections
from dirax.engines.pivot_order import pivot_order, symmetric_signs
from dirax.engines.policy import engine_of
from dirax.engines.step_program import step_program
from dirax.gallery import bicycle
from dirax.program.graph import Graph


@pytest.fixture
def random():
    return np.random.default_rng(7)


def triangular(sizes, random):
    """A matrix in block triangular form with rows and columns mixed, and which rows and columns belong to each block."""
    ends = np.cumsum([0, *sizes])
    k = ends[-1]
    matrix = random.uniform(0.3, 1.7, (k, k)) * (random.random((k, k)) < 0.4)
    for a, b in itertools.pairwise(ends):
        matrix[a:b, b:] = 0.0
        matrix[a:b, a:b] = random.uniform(0.3, 1.7, (b - a, b - a)) + 3.0 * np.eye(b - a)
    rows, columns = random.permutation(k), random.permutation(k)
    members = [(set(np.argsort(rows)[a:b].tolist()), set(np.argsort(columns)[a:b].tolist())) for a, b in itertools.pairwise(ends)]
    return matrix[rows][:, columns], members


@pytest.mark.parametrize("sizes", [(9,), (7, 8), (6, 6, 11), (8, 7, 6, 9)])
def test_the_blocks_of_a_matrix(sizes, random):
    matrix, members = triangular(sizes, random)
    found = blocks(matrix != 0)
    of = lambda pairs: {(frozenset(rows), frozenset(columns)) for rows, columns in pairs}
    assert of(found) == of(members)
    known: set[int] = set()
    for rows, columns in found:
        assert len(rows) == len(columns) >= FEWEST
        known |= set(columns)
        assert set(np.flatnonzero(matrix[rows].any(axis=0)).tolist()) <= known
    assert known == set(range(len(matrix)))


def test_small_blocks_are_joined_and_singular_matrices_are_one(random):
    assert len(blocks(np.tril(np.ones((20, 20), bool)))) == 20 // FEWEST
    there = np.ones((9, 9), bool)
    there[:, 4] = False
    assert len(blocks(there)) == 1


@pytest.mark.parametrize("sizes", [(7,), (6, 7), (6, 6, 8)])
def test_elimination_by_blocks_against_numpy(sizes, random):
    matrix, _ = triangular(sizes, random)
    g, k = Graph(), len(matrix)
    nodes = [[g.input(f"{i},{j}") if entry else g.zero for j, entry in enumerate(row)] for i, row in enumerate(matrix)]
    right, values = [g.input(f"b{i}") for i in range(k)], random.normal(size=k)
    factors = Factors(g, nodes, pivot_order(g, nodes))
    inputs = {f"{i},{j}": matrix[i, j] for i in range(k) for j in range(k)} | {f"b{i}": values[i] for i in range(k)}
    found = g.evaluate(factors.solve(g, right), inputs)
    np.testing.assert_allclose(found, np.linalg.solve(matrix, values), rtol=1e-11)
    assert g.evaluate([factors.stable], inputs) == [True]
    bounds = g.evaluate(factors.bounds(g, right), inputs | {f"b{i}": abs(values[i]) for i in range(k)})
    assert np.all(np.asarray(bounds) >= np.abs(found))


def test_entries_that_always_cancel_are_no_pivots():
    """Rows (m, −m/h) and (k, −k/h): the elimination of either unknown of the first leaves nothing of the other in the second."""
    g = Graph()
    m, k, c, h = (g.input(name) for name in ("m", "k", "c", "h"))
    over = lambda x: g.neg(g.div(x, h))
    matrix = [[m, over(m), g.zero], [k, over(k), c], [c, m, k]]
    (order,) = pivot_order(g, matrix)
    numbers = {"m": 2.0, "k": 0.7, "c": 1.3, "h": 0.01}
    right = [g.constant(x) for x in (1.0, 2.0, 3.0)]
    dense = np.array(g.evaluate([entry for row in matrix for entry in row], numbers), float).reshape(3, 3)
    factors = Factors(g, matrix, [order])
    assert g.evaluate([factors.stable], numbers) == [True]
    np.testing.assert_allclose(g.evaluate(factors.solve(g, right), numbers), np.linalg.solve(dense, [1.0, 2.0, 3.0]), rtol=1e-12)


def saddle_point(g, one, two, line):
    """Nodes of [M, −Gᵀ; G, 0]: two rods of length 1, the second on the first and as heavy, and the velocity of its end across a
    line, of which each is an angle. The lower half is that of the upper one in other words."""
    sin, cos, mass = lambda x: g.make("sin", x), lambda x: g.make("cos", x), g.input("m")
    across = [g.sub(g.mul(sin(x), cos(line)), g.mul(cos(x), sin(line))) for x in (one, two)]
    along, beside = g.mul(mass, g.mul(cos(one), cos(two))), g.mul(mass, g.mul(sin(one), sin(two)))
    return [
        [g.add(mass, mass), g.add(along, beside), across[0]],
        [g.mul(mass, g.add(g.mul(sin(one), sin(two)), g.mul(cos(one), cos(two)))), mass, across[1]],
        [*[g.mul(cos(x), g.sub(sin(line), g.mul(cos(line), g.div(sin(x), cos(x))))) for x in (one, two)], g.zero],
    ]


def test_pivots_of_masses_with_constraints_vanish_nowhere(random):
    """They are on the diagonal, masses first, whereas an entry of G that is large at some angles is zero at others."""
    g, names = Graph(), ("one", "two", "line")
    matrix = saddle_point(g, *[g.input(name) for name in names])
    assert symmetric_signs(g, matrix) == [1, 1, -1]
    (order,) = pivot_order(g, matrix)
    assert pivot_order(g, [[g.neg(entry) for entry in row] for row in matrix]) == [order]
    assert set(order[:2]) == {(0, 0), (1, 1)} and order[2] == (2, 2)
    values = (1.0, 2.0, 3.0)
    factors = Factors(g, matrix, [order])
    outputs = [*factors.solve(g, [g.constant(x) for x in values]), factors.stable]
    for angles in (*np.eye(3) * np.pi / 2, *random.uniform(-np.pi, np.pi, (20, 3))):
        numbers = dict(zip(names, angles, strict=True)) | {"m": 0.7}
        dense = np.array(g.evaluate([entry for row in matrix for entry in row], numbers), float).reshape(3, 3)
        *found, stable = g.evaluate(outputs, numbers)
        assert stable
        np.testing.assert_allclose(found, np.linalg.solve(dense, values), rtol=1e-11)


@pytest.mark.soak
def test_the_bicycle_is_eliminated_alike_wherever_it_heads(random):
    """The pivots of its accelerations and multipliers, in the midst of a step of Method 2, upright and straight: entries of
    constraints by pitch, roll and steer vanish, and others where it heads along an axis."""
    system, n, m, c = bicycle.MODEL.system, 9, 4, 2
    equation = dx.make_step_equation(dx.DiscreteDirac(constraints="resolve"), system, dx.Shape(n, m, c))
    assert isinstance(equation, dx.StepEquation)
    program = step_program(equation, None, False)
    assert program.jacobians  # now the graph has them
    g = program.graph.copy()
    base = newton_corrections(g, program, 0).blocks[0]
    places = equation.unknown_layout.split(jnp.arange(equation.unknowns))
    (part,) = [one for one in base if set(places.a.tolist()) <= set(one.places)]
    names, many = bicycle.MODEL.coordinates, 201
    q = {name: random.uniform(-1.0, 1.0, many) for name in names} | {"frame.yaw": np.linspace(0.0, 2.0 * np.pi, many)}
    q |= {name: np.zeros(many) for name in ("frame.roll", "frame.pitch", "steer")}
    numbers = {str(g.value[node]): random.normal(size=many) for node in g.reachable(part.outputs) if g.op[node] == "input"}
    numbers |= {f"state{i}": q[name] for i, name in enumerate(names)} | {f"u{i}": np.zeros(many) for i in places.moved}
    numbers |= {f"size{i}": np.ones(many) for i in range(equation.unknowns)}
    assert g.evaluate([part.stable], numbers)[0].all()


def test_of_symmetric_matrices_half_is_eliminated():
    def differences(name):
        g = Graph()
        factors = Factors(g, [[g.input(name(i, j)) for j in range(6)] for i in range(6)], [[(i, i) for i in range(6)]])
        return sum(g.op[node] == "sub" for node in g.reachable(factors.nodes))

    assert differences(lambda i, j: f"{i},{j}") == 55  # Σ m², m = 1, …, 5
    assert differences(lambda i, j: f"{min(i, j)},{max(i, j)}") == 35  # Σ m(m + 1)/2


def test_entries_are_the_same_only_where_they_are_so_everywhere():
    """|x| and √x² are x at points that are positive, and x + 1e-30 y is x where y is not large."""
    g = Graph()
    x, y, two = g.input("x"), g.input("y"), g.constant(2.0)
    square, more = g.make("sqrt", g.mul(x, x)), g.add(x, g.mul(g.constant(1e-30), y))
    for other in (y, g.make("abs", x), square, more, g.zero):
        assert symmetric_signs(g, [[two, x], [other, two]]) is None
    for other, found in ((g.sub(g.add(x, y), y), [1, 1]), (g.sub(y, g.add(x, y)), [1, -1])):
        assert symmetric_signs(g, [[two, x], [other, two]]) == found
    assert symmetric_signs(g, [[two, square], [square, two]]) == [1, 1]


@pytest.mark.soak
def test_saved_velocities_are_a_block_of_their_own():
    """The unknowns of a constrained step are those that move it and those of the saved momentum, which are linear."""
    case = gallery.get("hanging-chain")
    sol = case.simulate(dx.LagrangeDAlembert(), steps=40, engine="native")
    made = kernels(sol.equation, sol.params, False)
    made.check()
    assert made.plan is not None
    (corrections,) = made.plan.corrections
    assert [one.linear for (one,) in corrections.blocks] == [False, True]
    assert sorted(place for (one,) in corrections.blocks for place in one.places) == list(range(sol.equation.unknowns))
    plain = case.simulate(dx.LagrangeDAlembert(), steps=40, engine="xla")
    np.testing.assert_allclose(sol.q, plain.q, rtol=1e-11, atol=1e-11)
    np.testing.assert_allclose(sol.p, plain.p, rtol=1e-10, atol=1e-10 * np.abs(plain.p).max())


@pytest.mark.soak
def test_method_2_corrects_accelerations_after_the_step_that_hardly_depends_on_them():
    case, scheme = gallery.get("hanging-chain"), dx.DiscreteDirac(constraints="resolve")
    sol = case.simulate(scheme, steps=40, engine="native")
    made = kernels(sol.equation, sol.params, False)
    made.check()
    assert made.plan is not None
    (corrections,) = made.plan.corrections
    base, *others = corrections.blocks
    layout = sol.equation.unknown_layout
    of_the_flow = layout.split(np.arange(sol.equation.unknowns)).a
    assert len(base) == 2 and set(of_the_flow.tolist()) <= set(base[1].places)
    assert [len(parts) for parts in others] == [1, 1]
    plain = case.simulate(scheme, steps=40, engine="xla")
    for name in ("q", "p", "multipliers"):
        scale = np.abs(plain.fields[name]).max()
        np.testing.assert_allclose(sol.fields[name], plain.fields[name], rtol=1e-10, atol=1e-10 * scale)


def of_two_parts(residual, guess, **more):
    """An equation for 2 FEWEST unknowns, which begin with a guess, of a state (2,) that stays."""
    size = 2 * FEWEST
    return dx.StepEquation(
        start=lambda data, h, params: (data["x"], jnp.full(size, guess)),
        residual=residual,
        advance=lambda u, x, t, h, params: x,
        unpack=lambda x, u, t, h, params: {"x": x, "u": u},
        state_size=2,
        unknowns=size,
        fields={"x": dx.Field((2,)), "u": dx.Field((size,), "step")},
        **more,
    )


@pytest.mark.parametrize(("coupling", "needed"), [(1e-3, False), (30.0, True)])
def test_entries_that_are_called_weak_and_are_not(coupling, needed):
    """Newton's method goes on with the whole Jacobian where it does not converge without them."""
    k = FEWEST

    def residual(u, x, t, h, params):
        first, second = u[:k], u[k:]
        return jnp.concatenate([first + first**3 / 8.0 + coupling * jnp.roll(second, 1) - x[0], 2.0 * second - first - x[1]])

    equation = of_two_parts(residual, 0.0, weak=((range(k), range(k, 2 * k)),))
    out = engine_of("native").run(Problem(equation, np.array([1.0, 0.5]), (np.zeros(2 * k),), 0.1, 0.0, 3))
    assert out.completed[0] == 3 and ("whole Jacobian" in out.notes.get("iteration", "")) == needed
    u = out.fields["u"][0, -1]
    np.testing.assert_allclose(u[:k] + u[:k] ** 3 / 8.0 + coupling * u[k:], 1.0, rtol=1e-14)
    np.testing.assert_allclose(2.0 * u[k:] - u[:k], 0.5, rtol=1e-14)


def test_an_equation_with_the_sign_of_a_later_unknown_is_not_solved_before_it():
    """Its derivative by that unknown is zero, so that the Jacobian alone is block triangular."""
    k = FEWEST

    def residual(u, x, t, h, params):
        first, second = u[:k], u[k:]
        return jnp.concatenate([first**3 - x[0] + 0.1 * jnp.sign(second), 2.0 * second + first - x[1]])

    equation = of_two_parts(residual, 1.0)
    runs = [
        engine_of(name).run(Problem(equation, np.array([8.0, 1.0]), (np.ones(2 * k),), 0.1, 0.0, 2)) for name in ("native", "xla")
    ]
    for out in runs:
        u = out.fields["u"][0, 0]
        np.testing.assert_allclose(u[:k] ** 3, 8.1, rtol=1e-14)
        np.testing.assert_allclose(u[k:], (1.0 - u[:k]) / 2.0, rtol=1e-14)
