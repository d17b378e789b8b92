"""Where primitives with known indices read and write, against JAX; and that nothing is compiled to find that."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax
from jax.extend.core import Literal

from dirax.program.sites import walk as sites
from dirax.program.sparse_matrix import SparseMatrix
from dirax.program.sparsity import indexing, pattern_of
from dirax.program.sparsity import walk as sparsity

X = jnp.arange(1.0, 61.0).reshape(3, 4, 5)
NEAR, FAR = np.array([[0, 1], [2, 2], [1, 0]]), np.array([[0, 7], [-9, 2], [1, 3]])
FUNCTIONS = {
    "rows": lambda i: X[i],
    "columns": lambda i: X[:, i],
    "pairs": lambda i: X[i, :, i[..., ::-1]],
    "apart": lambda i: X[i, 1, :, None][:, :, 2:],
    "clipped": lambda i: X.at[i, i].get(mode="clip"),
    "filled": lambda i: X.at[:, i].get(mode="fill", fill_value=0.0),
    "along an axis": lambda i: jnp.take_along_axis(X, jnp.abs(i)[:, :1, None] % 5 + jnp.zeros((3, 4, 1), int), axis=2),
    "batch": lambda i: jax.vmap(lambda row, j: row[j])(X, i),
    "one": lambda i: X.at[i[0, 1], i[1, 1], i[2, 0]].set(X[i[0, 1], i[0, 0], i[1, 0]]),
    "slice": lambda i: lax.dynamic_slice(X, (i[0, 1], i[1, 0], i[2, 1]), (2, 3, 1)),
    "slice put": lambda i: lax.dynamic_update_slice(X, -X[:2, :3, 2:3], (i[0, 1], i[1, 0], i[2, 1])),
    "set": lambda i: X.at[i[:, 0], i[:, 1]].set(-1.0),
    "add": lambda i: X.at[i].add(X[:, None, :, :] * jnp.ones((1, 2, 1, 1))),
    "add clipped": lambda i: X.at[i, i].add(X[0, 0], mode="clip"),
    "add in a batch": lambda i: jax.vmap(lambda row, j: row.at[j].add(row[:2]))(X, i),
}  # fmt: skip


def compared(closed, *arguments):
    """The results of a jaxpr; what reads and writes in it is compared."""
    jaxpr, found = closed.jaxpr, 0
    values = dict(zip((*jaxpr.constvars, *jaxpr.invars), (*closed.consts, *arguments), strict=True))
    for equation in jaxpr.eqns:
        given = [a.val if isinstance(a, Literal) else values[a] for a in equation.invars]
        name, p = equation.primitive.name, equation.params
        if "jaxpr" in p:
            results, more = compared(p["jaxpr"], *given)
            found += more
        else:
            results = equation.primitive.bind(*given, **p)
            results = results if equation.primitive.multiple_results else [results]
        if name in ("gather", "dynamic_slice", "dynamic_update_slice"):
            arrays, indices = (given[:1], given[1:]) if name != "dynamic_update_slice" else (given[:2], given[2:])
            numbers = [np.asarray(a, int) for a in arrays]
            zero_outside = p | {"fill_value": 0} if name == "gather" else p
            expected = equation.primitive.bind(*map(jnp.asarray, (*numbers, *indices)), **zero_outside)
            np.testing.assert_array_equal(indexing.read(equation, numbers, [np.asarray(i) for i in indices]), expected)
            found += 1
        elif name.startswith("scatter"):
            x, indices, updates = map(np.asarray, given)
            places = indexing.places_of_updates(equation, indices, x.shape, updates.shape)
            inside, written = places > 0, np.array(x).ravel()
            put = np.add.at if name == "scatter-add" else np.put
            put(written, places[inside] - 1, updates.ravel()[inside])
            np.testing.assert_allclose(written.reshape(x.shape), results[0], rtol=1e-15)
            found += 1
        values |= dict(zip(equation.outvars, results, strict=True))
    return [a.val if isinstance(a, Literal) else values[a] for a in jaxpr.outvars], found


@pytest.mark.parametrize("indices", [NEAR, FAR], ids=["inside", "outside"])
@pytest.mark.parametrize("name", FUNCTIONS)
@pytest.mark.soak_of("rows-inside", "along an axis-inside", "one-inside", "set-inside")
def test_what_is_read_and_written(name, indices):
    _, found = compared(jax.make_jaxpr(FUNCTIONS[name])(indices), jnp.asarray(indices))
    assert found


def test_nothing_is_compiled_to_find_a_pattern(monkeypatch):
    """XLA took 20 ms for each of the operations on known indices, of which a sparse matrix has a dozen."""
    import scipy.sparse as sp

    def never(*_):
        raise AssertionError("an operation on known numbers is left to XLA")

    for module in (sparsity, sites):
        monkeypatch.setattr(module, "evaluated", never)
    matrix = SparseMatrix(sp.random(40, 40, 0.1, random_state=0) + sp.eye(40))
    function = lambda x: jnp.sin(matrix @ x)[::-1] + matrix.T @ x[np.arange(40)]
    found = pattern_of(function, np.zeros(40))
    entries = abs(matrix.matrix[::-1]) + abs(matrix.matrix.T)
    np.testing.assert_array_equal(found.toarray(), entries.toarray() > 0)
    sites.sites_of(function, np.zeros(40))
