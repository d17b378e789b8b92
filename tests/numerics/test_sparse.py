"""Loops compiled from Python, colours, and sparse elimination beside NumPy's."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.sparse as sp

from dirax.numerics.loops.compiler import Doubles, Longs
from dirax.numerics.loops.kernel import Kernel
from dirax.numerics.sparse.band import BandElimination
from dirax.numerics.sparse.border import BorderedElimination
from dirax.numerics.sparse.colours import column_colours
from dirax.numerics.sparse.elimination import StructurallySingular, elimination
from dirax.numerics.sparse.exchanged import ExchangedElimination
from dirax.numerics.sparse.fixed import FixedElimination

RNG = np.random.default_rng(0)


def running(sizes: Longs, x: Doubles, y: Doubles):
    """A loop with everything in it."""
    s = 0.0
    for i in range(sizes[0] - 1, -1, -1):
        y[i] = 0.0
        if (i % 2 == 0 and not x[i] > 4.0) or i == 3:
            s += abs(x[i]) * WEIGHT
        elif i > 8:
            continue
        else:
            s -= max(x[i], 1.0) / 2
        k = 0
        while k < i:
            k = k + 1
            if k == 2:
                break
        y[i] = s if k < 2 else -s


def test_a_loop_does_in_numpy_and_in_jax_what_it_does_in_python():
    kernel, x, expected = Kernel(running, 1, WEIGHT=3), RNG.normal(size=10) * 4, np.zeros(10)
    running.__globals__["WEIGHT"] = 3
    running(np.array([10]), x, expected)
    found = np.zeros(10)
    kernel(np.array([10]), x, found)
    assert found.tobytes() == expected.tobytes()
    shapes = [jax.ShapeDtypeStruct((10,), np.float64)]
    in_jax = jax.jit(lambda x: kernel.in_jax(shapes, np.array([10]), x)[0])
    assert np.asarray(in_jax(x)).tobytes() == expected.tobytes()
    both = np.asarray(jax.vmap(in_jax)(jnp.stack([x, x])))
    assert both[1].tobytes() == expected.tobytes()
    with pytest.raises(TypeError, match="contiguous"):
        kernel(np.array([10]), x[::2], found)


def ring(n: int) -> sp.csr_matrix:
    matrix = sp.diags([RNG.normal(size=n - 1), RNG.normal(size=n), RNG.normal(size=n - 1)], [-1, 0, 1]).tolil()
    matrix[0, n - 1], matrix[n - 1, 0] = 1.0, 2.0
    return matrix.tocsr()


def lattice(m: int) -> sp.csr_matrix:
    line = sp.diags([-np.ones(m - 1), 4 + RNG.random(m), -np.ones(m - 1)], [-1, 0, 1])
    ends = sp.diags([-np.ones(m - 1), -np.ones(m - 1)], [-1, 1])
    matrix = (sp.kron(sp.identity(m), line) + sp.kron(ends, sp.identity(m))).tocsr()
    matrix.data *= 1 + RNG.random(matrix.nnz) / 10
    return matrix


def saddle(matrix: sp.csr_matrix, constraints: int) -> sp.csr_matrix:
    """With one constraint on each pair of neighbours, of the first ones."""
    rows = np.repeat(np.arange(constraints), 2)
    g = sp.csr_matrix((RNG.normal(size=2 * constraints), (rows, np.arange(2 * constraints))), (constraints, matrix.shape[0]))
    return sp.bmat([[matrix, -g.T], [g, None]]).tocsr()


def without_pivots(matrix: sp.csr_matrix) -> sp.csr_matrix:
    """With a full diagonal in its pattern, of zeros."""
    n = matrix.shape[0]
    upper, (i, j) = matrix.tocoo(), (np.arange(2 * n),) * 2
    rows, columns = np.concatenate([upper.row, upper.col + n, i]), np.concatenate([upper.col + n, upper.row, j])
    return sp.csr_matrix((np.concatenate([upper.data, upper.data, np.zeros(2 * n)]), (rows, columns)), (2 * n, 2 * n))


def with_border(matrix: sp.csr_matrix) -> sp.csr_matrix:
    """With a full row and a full column, at different numbers."""
    n = matrix.shape[0]
    whole = matrix.tolil()
    whole[3], whole[:, 7] = RNG.normal(size=(1, n)), RNG.normal(size=(n, 1))
    return whole.tocsr()


MATRICES = {
    "tridiagonal, without a diagonal": (sp.diags([np.ones(39), np.ones(39)], [-1, 1]).tocsr(), BandElimination),
    "ring": (ring(60), BandElimination),
    "saddle point of a ring": (saddle(ring(60), 20), BandElimination),
    "lattice": (lattice(20), FixedElimination),
    "saddle point of a lattice": (saddle(lattice(20), 30), FixedElimination),
    "rows in another order": (ring(50)[RNG.permutation(50)], BandElimination),
    "full row and column": (with_border(ring(600)), BorderedElimination),
    "lattice, rows in another order": (lattice(30)[RNG.permutation(900)], ExchangedElimination),
    "lattice, pivots that are zero": (without_pivots(lattice(20)), FixedElimination),
}


@pytest.mark.parametrize("name", MATRICES)
@pytest.mark.soak_of("saddle point of a ring", "rows in another order")
def test_elimination(name):
    matrix, kind = MATRICES[name]
    matrix.sort_indices()
    n = matrix.shape[0]
    made = elimination(sp.csr_matrix((np.ones(matrix.nnz, bool), matrix.indices, matrix.indptr), matrix.shape))
    assert isinstance(made, kind)
    places = sp.csr_matrix((np.arange(1, matrix.nnz + 1), matrix.indices, matrix.indptr), matrix.shape)
    right, dense, size = RNG.normal(size=n), matrix.toarray(), np.array([n])
    factors = made.factors(np, made.tables(places), matrix.data.copy(), size)
    for transposed, a in ((False, dense), (True, dense.T)):
        found = made.solution(np, made.solve_tables, factors, right, size, transposed)
        np.testing.assert_allclose(found, np.linalg.solve(a, right), rtol=1e-9, atol=1e-9)


def test_structurally_singular_matrices_are_named():
    pattern = sp.csr_matrix(np.array([[1, 1, 1], [0, 0, 1], [0, 0, 1]], bool))
    with pytest.raises(StructurallySingular) as raised:
        elimination(pattern)
    assert len(raised.value.rows) == 1 and raised.value.rows[0] in (1, 2)


@pytest.mark.parametrize(("matrix", "most"), [(ring(60), 5), (lattice(20), 9), (sp.identity(30, format="csr"), 1)])
def test_no_row_has_two_columns_of_a_colour(matrix, most):
    colours = column_colours(sp.csr_matrix(matrix.astype(bool)))
    assert np.max(colours) < most
    for row in range(matrix.shape[0]):
        own = colours[matrix.indices[matrix.indptr[row] : matrix.indptr[row + 1]]]
        assert len(set(own.tolist())) == len(own)
