"""Reading and writing at known places is done for all entries at once, and is what JAX does."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dirax.program.evaluation.functions import in_numpy

X, U = np.arange(12.0).reshape(3, 4) + 1.0, np.array([10.0, 20.0, 30.0])
AT = np.array([2, 0, 2])
FAR = np.array([1, 7, -9])

FUNCTIONS = {
    "rows": lambda x, u: x[AT],
    "entries": lambda x, u: x[AT, AT],
    "windows": lambda x, u: jax.vmap(lambda i: jax.lax.dynamic_slice(x, (i, 1), (1, 2)))(jnp.asarray(AT)),
    "far and filled": lambda x, u: x.at[FAR].get(mode="fill", fill_value=-1.0),
    "far and clipped": lambda x, u: x.at[FAR].get(mode="clip"),
    "of whole numbers": lambda x, u: x[jnp.asarray(AT)[jnp.array([0, 1])]],
    "batched": lambda x, u: jax.vmap(lambda row, i: row[i])(x, jnp.asarray(AT)),
    "set": lambda x, u: x.at[AT, 1].set(u),
    "add": lambda x, u: x.at[AT, AT].add(u),
    "multiply rows": lambda x, u: x.at[AT].multiply(u[:, None]),
    "largest": lambda x, u: x.at[AT, 0].max(u),
    "dropped": lambda x, u: x.at[FAR, 0].add(u, mode="drop"),
    "clipped": lambda x, u: x.at[FAR, 0].add(u, mode="clip"),
    "batched writes": lambda x, u: jax.vmap(lambda row, i, v: row.at[i].add(v))(x, jnp.asarray(AT), u),
    "of a number": lambda x, u: jnp.zeros(()).at[()].add(u[0]),
    "derivative of reads": lambda x, u: jax.jacobian(lambda x: jnp.sum(x[AT] ** 2, axis=1))(x),
}


@pytest.mark.parametrize("name", FUNCTIONS)
@pytest.mark.soak_of("windows", "of whole numbers", "derivative of reads")
def test_known_places(name):
    function = FUNCTIONS[name]
    found = in_numpy(function, [np.stack([X, 2 * X]), np.stack([U, 3 * U])], (name, "known places"))
    assert found is not None
    np.testing.assert_array_equal(
        found, np.stack([function(jnp.asarray(X), jnp.asarray(U)), function(2 * jnp.asarray(X), 3 * U)])
    )
