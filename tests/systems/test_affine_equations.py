"""Linear equations whose coefficients depend on x: what is constant is eliminated, the rest solved by rows and columns."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dirax.systems.affine_equations import explicit, pivots, solved

CONSTANT = np.array([[2.0, 1.0, 0.0], [0.0, 3.0, 0.0], [4.0, 5.0, 0.0]])  # rows over the first three unknowns, of rank 2


def equations(x, params):
    """Five equations of (3 + 2) unknowns: three with constant coefficients of the first, one that moves, one that is zero."""
    bottom = jnp.stack([jnp.stack([jnp.sin(x[0]), x[1], 1 + x[0] ** 2]), jnp.zeros(3)])
    right = jnp.stack([jnp.stack([x[0], 1.0 + x[1]]), jnp.stack([x[1], x[0]]), jnp.zeros(2), jnp.ones(2) * x[1], jnp.zeros(2)])
    matrix = jnp.concatenate([jnp.concatenate([jnp.asarray(CONSTANT), bottom]), right], axis=1)
    return matrix, jnp.stack([x[0], x[1], x[0] * x[1], jnp.cos(x[0]), x[1] - params])


def entries():
    known = np.full((5, 5), np.nan)
    known[:3, :3], known[2, 3:], known[4] = CONSTANT, 0.0, 0.0
    return known


@pytest.mark.parametrize("by", [np.asarray, jax.jit], ids=["numbers", "traced"])
@pytest.mark.soak_of("numbers")
def test_the_constant_part_is_solved_and_the_rest_is_equivalent(by):
    system = explicit(equations, entries(), 3)
    x = np.array([0.4, 0.7])
    family, rest = (f if by is np.asarray else by(f) for f in (system.family, system.rest))
    (w, basis), (matrix, right) = family(x, 0.3), rest(x, 0.3)
    assert system.rank == 2 and basis.shape == (5, 3) and matrix.shape == (3, 3)
    whole, whole_right = map(np.asarray, equations(x, 0.3))
    c = np.array([0.3, -1.2, 2.0])
    residual = whole @ (np.asarray(w) + np.asarray(basis) @ c) - whole_right
    left = np.asarray(matrix) @ c - np.asarray(right)
    assert np.sort(np.abs(residual))[:2] == pytest.approx([0.0, 0.0], abs=1e-15)  # the two that were solved
    assert np.sort(np.abs(residual))[2:] == pytest.approx(np.sort(np.abs(left)), abs=1e-15)


@pytest.mark.parametrize("rank", [0, 1, 2, 3])
@pytest.mark.soak_of(but=["2"])
def test_solution_conditions_and_kernel(rank):
    """A of this rank at every x, (4, 5): against the normal equations of NumPy."""
    rng = np.random.default_rng(rank)
    left, right = rng.normal(size=(4, rank)), rng.normal(size=(rank, 5))
    matrix = lambda x: jnp.asarray(left) * (1 + x[0] ** 2) @ jnp.asarray(right) * jnp.exp(x[1])
    at = np.array([0.2, -0.3])
    inside = lambda x: matrix(x) @ jnp.cos(jnp.arange(5.0) + x[0])
    for off in (0.0, 1.0):
        system = lambda x, params, off=off: (matrix(x), inside(x) + off * jnp.sin(jnp.arange(4.0)))
        found = solved(system, np.asarray(matrix(at)), rank, np.full((4, 5), np.nan))
        x = at + 0.3
        a, b = map(np.asarray, system(x, None))
        y, s, kernel = (np.asarray(f(x, None)) for f in (found.solution, found.conditions, found.kernel))
        assert found.count == 4 - rank == s.size and kernel.shape == (5, 5 - rank)
        assert np.abs(a @ kernel).max(initial=0.0) < 1e-13 and np.linalg.matrix_rank(kernel) == 5 - rank
        solvable = np.abs(b - a @ np.linalg.lstsq(a, b, rcond=1e-12)[0]).max() < 1e-12
        assert solvable == (off == 0.0) == (np.abs(s).max() < 1e-12)
        if solvable:
            assert a @ y == pytest.approx(b, abs=1e-12)


def test_a_row_that_is_zero_everywhere_says_its_condition_where_the_others_fail():
    """x_0 y = 1 and 0 = x_1: the second is known at x_0 = 0 too."""
    system = lambda x, params: (jnp.stack([x[:1], jnp.zeros(1)]), jnp.stack([jnp.ones(()), x[1]]))
    found = solved(system, np.array([[0.5], [0.0]]), 1, np.array([[np.nan], [0.0]]))
    assert found.conditions(np.array([0.0, 0.3]), None) == pytest.approx([0.3])


def test_pivots_are_sparse_and_regular():
    arrow = np.eye(6) + np.eye(6)[:, [0]] + np.eye(6)[[0]]  # full first row and column: they are left until they are all
    rows, columns = pivots(arrow)
    assert sorted(rows) == sorted(columns) == list(range(6)) and 0 not in (*rows[:3], *columns[:3])
    rng = np.random.default_rng(1)
    low = rng.normal(size=(7, 3)) @ rng.normal(size=(3, 6)) * np.logspace(-6, 6, 6)
    rows, columns = pivots(low)
    assert len(rows) == len(columns) == 3 and np.linalg.cond(low[np.ix_(rows, columns)] / np.logspace(-6, 6, 6)[columns]) < 1e3
    assert [part.size for part in pivots(np.zeros((3, 2)))] == [0, 0]
