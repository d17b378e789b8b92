"""Functions through the scalar graph and NumPy against JAX itself: what a start computes without a compiler."""

import itertools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dirax as dx
from dirax.engines import step_program
from dirax.engines.step_program import linearized
from dirax.program import scalar_program
from dirax.program.evaluation import in_numpy as module
from dirax.program.evaluation.functions import in_numpy, program_of
from dirax.program.graph import Graph, GraphTooLarge
from dirax.program.linear_solves import LARGE, equilibrated_inverse, pseudo_inverse, pseudo_inverses, scaled_pseudo_inverse, solve
from dirax.program.roots import nearest_root
from dirax.program.rules import by_numpy
from dirax.schemes.step import Shape, make_step_equation

symmetric = lambda a: a + a.T
CASES = {
    "singular values": lambda a, x: (scaled_pseudo_inverse(a @ a.T) @ x, jnp.linalg.svd(a, compute_uv=False)),
    "a pseudo-inverse": lambda a, x: pseudo_inverse(a[:2], 1e-12) @ x[:2],
    "eigenvalues": lambda a, x: jnp.linalg.eigh(symmetric(a))[0] + jnp.linalg.pinv(symmetric(a)) @ x,
    "a root": lambda a, x: nearest_root(lambda u: jnp.sinh(u) + 0.1 * jnp.sin(a @ u) - x, jnp.zeros(3)),
    "a root of linear equations": lambda a, x: nearest_root(lambda u: (a @ a.T + jnp.eye(3)) @ u - x, x),
    "a root by halved steps": lambda a, x: nearest_root(lambda u: jnp.arctan(9.0 * (u - x)) + a[0, 0] ** 2 * (u - x), x + 2.0),
    "the best point where there is no root": lambda a, x: nearest_root(lambda u: u * u + x[:1] * a[0, :1], jnp.ones(1)),
    "linear equations": lambda a, x: (
        solve(a, x),
        solve(a @ a, a.T),
        jnp.isfinite(solve(a * jnp.maximum(a[0, 0], 0.0), x)).astype(float),
    ),
    "linear equations side by side": lambda a, x: (
        jax.vmap(lambda row: solve(a, row))(a),
        jax.vmap(lambda s: solve(a + s * jnp.eye(3), x))(jnp.arange(2.0)),
        jax.grad(lambda x: solve(a, x**2) @ x)(x),
    ),
    "a derivative of linear equations": lambda a, x: jax.jacfwd(lambda x: solve(a + jnp.diag(x), x**2))(x),
    "a loop of unknown length": lambda a, x: jax.lax.while_loop(
        lambda c: jnp.max(jnp.abs(c[0])) > 1e-3, lambda c: (c[0] / 3, c[1] + 1), (a @ x, 0)
    ),
    "loops side by side, each of its own length": lambda a, x: jax.vmap(
        lambda row: jax.vmap(
            lambda most: jax.lax.while_loop(
                lambda c: jnp.max(jnp.abs(c[0])) < most + 1.5, lambda c: (1.3 * c[0], c[1] + 1.0, c[2] @ a), (row, 0.0, a)
            )
        )(jnp.arange(4.0))
    )(a),
    "entries in the order of Fortran": lambda a, x: (
        a.ravel(order="F") * jnp.arange(9.0),
        jax.grad(lambda a: jnp.sum((a @ a).reshape((9,), order="F") ** 3 * jnp.arange(9.0)))(a),
    ),
    "a derivative through a root": lambda a, x: jax.jacfwd(
        lambda x: nearest_root(lambda u: u**3 + u + 0.1 * (a @ u) - x, jnp.zeros(3))
    )(x),
}


def test_roots_of_many_equations_take_no_dense_matrix(monkeypatch):
    """Along a chain, of equations that have one solution; as plain NumPy has them."""
    monkeypatch.setattr(by_numpy, "_inverted", lambda *given: pytest.fail("a matrix of all of them is inverted"))
    left = lambda u, x: u + u**3 - 0.2 * (jnp.roll(u, 1) + jnp.roll(u, -1)) - x
    x = np.random.default_rng(5).normal(size=(3, 150))
    u = in_numpy(lambda x: nearest_root(lambda u: left(u, x), jnp.zeros(150)), [x], "roots of many equations")
    beside = np.roll(u, 1, axis=1) + np.roll(u, -1, axis=1)
    np.testing.assert_allclose(u + u**3 - 0.2 * beside, x, rtol=0, atol=2e-15)


@pytest.mark.parametrize("name", CASES)
@pytest.mark.soak_of(
    but=[
        "a pseudo-inverse",
        "eigenvalues",
        "a loop of unknown length",
        "loops side by side, each of its own length",
        "entries in the order of Fortran",
    ]
)
def test_entries_of_a_batch_are_what_jax_computes(name, monkeypatch):
    monkeypatch.setattr(module, "LANES", 4)
    rng = np.random.default_rng(3)
    a, x = rng.normal(size=(7, 3, 3)), rng.normal(size=(7, 3))
    found, expected = in_numpy(CASES[name], [a, x], name), jax.jit(jax.vmap(CASES[name]))(a, x)
    for mine, theirs in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(mine, theirs, rtol=1e-11, atol=1e-12)


@pytest.mark.parametrize(("name", "inversions"), [("a root of linear equations", 1), ("a root", None)])
def test_a_derivative_that_is_the_same_everywhere_is_inverted_once(name, inversions, monkeypatch):
    found, inverted = [], by_numpy._inverted
    monkeypatch.setattr(by_numpy, "_inverted", lambda matrices: found.append(matrices) or inverted(matrices))
    rng = np.random.default_rng(5)
    in_numpy(CASES[name], [rng.normal(size=(7, 3, 3)), rng.normal(size=(7, 3))], name)
    assert len(found) == inversions if inversions else len(found) > 2


@pytest.mark.parametrize("name", ["a root", "linear equations", "a derivative through a root"])
def test_one_entry_again_and_again_has_the_same_bits(name, monkeypatch):
    monkeypatch.setattr(scalar_program, "OFTEN", 2)
    rng = np.random.default_rng(4)
    a, x = rng.normal(size=(1, 3, 3)), rng.normal(size=(1, 3))
    first, *later = (jax.tree.leaves(in_numpy(CASES[name], [a, x], ("again", name))) for _ in range(4))
    found = program_of(CASES[name], [jax.ShapeDtypeStruct(y.shape[1:], y.dtype) for y in (a, x)], ("again", name))
    assert found is not None and "in_floats" in vars(found[0])
    for other in later:
        for one, two in zip(first, other, strict=True):
            assert one.tobytes() == two.tobytes() and one.shape == two.shape


def test_what_has_no_rule_is_left_to_the_compiler():
    x, z = np.ones((2, 3)), np.array([3 + 4j, 1j])
    assert in_numpy(jnp.abs, [z], "a size") is None and in_numpy(jnp.sin, [x], "a sine") is not None
    np.testing.assert_array_equal(in_numpy(lambda z: jnp.ones(()), [z], "none of it"), [1.0, 1.0])
    assert in_numpy(jnp.sort, [x], "sort") is None
    assert jax.jit(lambda y: jnp.zeros(()) if in_numpy(lambda x: x * y, [x], "captured") is None else y)(2.0) == 0.0


@pytest.mark.parametrize("limit", [0, 10**9], ids=["on the graph", "in numbers"])
def test_the_first_step_is_linearized_as_jax_does_it(limit, monkeypatch):
    monkeypatch.setattr(step_program, "IN_NUMBERS", limit)
    system = dx.LagrangeDirac(
        lambda q, v, g: v @ v / 2 * (1 + q[0] ** 2) + g * jnp.where(q[1] > 0, jnp.cos(q[1]), 1 - q[1] ** 2 / 2),
        lambda q: jnp.stack([jnp.sin(q)]),
    )
    equation: Any = make_step_equation(dx.LagrangeDAlembert(), system, Shape(2, 1))
    draw = np.random.default_rng(1)
    u, state = draw.normal(size=(5, 3)), draw.normal(size=(5, equation.stages[0][0].state_size))
    t, h, g = np.zeros(5), np.full(5, 0.1), np.linspace(1, 2, 5)
    found = linearized(equation, g, True, u, state, t, h)
    assert found is not None
    expected = jax.vmap(lambda u, x, g: equation.residual(u, x, 0.0, 0.1, g))(u, state, g)
    slopes = jax.vmap(lambda u, x, g: jax.jacfwd(lambda u: equation.residual(u, x, 0.0, 0.1, g))(u))(u, state, g)
    np.testing.assert_allclose(found[0], expected, rtol=1e-13, atol=1e-13)
    np.testing.assert_allclose(found[1], slopes, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("shape", [(2, 4), (4, 2), (3, 3), (1, 3), (0, 3)])
def test_pseudo_inverses_side_by_side_are_those_of_each(shape):
    matrices = np.random.default_rng(5).normal(size=(300, *shape))
    if 0 not in shape:
        matrices[1], matrices[2], matrices[3] = 0.0, 1e-200 * matrices[2], 1e200 * matrices[3]
        matrices[4], matrices[5, 1:] = 1.0, 1e-9 * matrices[5, 1:]
    for mine, matrix in zip(pseudo_inverses(matrices, 1e-12), matrices, strict=True):
        size = np.max(np.abs(matrix), initial=0.0) or 1.0
        assert mine.shape == shape[::-1]
        np.testing.assert_allclose(size * mine, np.linalg.pinv(matrix / size, 1e-12), rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("rank", [LARGE, LARGE - 1])
def test_large_pseudo_inverses_by_jax(rank):
    """Without singular values where there surely are no small ones."""
    random = np.random.default_rng(5)
    left, right = (np.linalg.qr(random.normal(size=(LARGE, LARGE)))[0] for _ in range(2))
    matrix = (left[:, :rank] * np.linspace(1, 2, rank)) @ right[:, :rank].T
    found, units = jax.jit(lambda a: equilibrated_inverse(jnp, a, 1e-9))(matrix)
    inverse = (right[:, :rank] / np.linspace(1, 2, rank)) @ left[:, :rank].T
    if rank == LARGE:
        np.testing.assert_allclose(found, inverse, atol=1e-13)
    else:  # the smallest in units of the unknowns
        right_side = matrix @ np.ones(LARGE)
        np.testing.assert_allclose(matrix @ (found @ right_side), right_side, atol=1e-12)
        assert np.linalg.norm(found @ right_side / units) < np.linalg.norm(inverse @ right_side / units) * (1 + 1e-12)


@pytest.mark.parametrize(("name", "by"), [("a root", "damped_step"), ("a pseudo-inverse", "pseudo_inverses")])
def test_what_is_asked_of_the_same_entries_again_is_found_once(name, by, monkeypatch):
    """As the energy and a hidden constraint ask for the velocities of the same rows; and never that of other entries."""
    asked, find = [], getattr(by_numpy, by)
    monkeypatch.setattr(by_numpy, by, lambda *given, **named: asked.append(0) or find(*given, **named))
    rng, function = np.random.default_rng(8), CASES[name]
    a, x = rng.normal(size=(7, 3, 3)), rng.normal(size=(7, 3))
    found = lambda a: in_numpy(lambda a, x: jax.tree.leaves(function(a, x))[0], [a, x], (name, "asked again", len(asked)))
    first, once = found(a), len(asked)
    again = found(a.copy())
    np.testing.assert_array_equal(again, first)
    assert once == len(asked) > 0
    again[:] = np.nan
    np.testing.assert_array_equal(found(a), first)
    other = found(np.where(np.arange(7)[:, None, None] == 3, 1.5 * a, a))
    assert len(asked) > once
    np.testing.assert_array_equal(np.all(other == first, axis=1), np.arange(7) != 3)


def test_a_step_as_large_as_a_graph_may_be_has_derivatives_in_numbers():
    graph = Graph(60)
    x = [graph.input(f"x{i}") for i in range(12)]
    outputs = [graph.make("cos", graph.mul(a, b)) for a, b in itertools.pairwise(x)]
    graph.limit = len(graph)
    known = module.Values(graph, 2)
    values = np.linspace(0.1, 1.0, 24).reshape(2, 12)
    known.bind(np.array(x), values)
    expected = jax.vmap(jax.jacfwd(lambda x: jnp.cos(x[:-1] * x[1:])))(values)
    np.testing.assert_allclose(known.slopes(outputs, x), expected, atol=1e-15)
    with pytest.raises(GraphTooLarge):
        graph.make("sin", x[0])
        graph.make("tanh", x[0])
