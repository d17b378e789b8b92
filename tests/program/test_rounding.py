"""The sizes of the terms of functions of many numbers."""

import jax
import jax.numpy as jnp
import numpy as np

import dirax.program.rules  # noqa: F401  (registers the rules)
from dirax.program.rounding import rounding


def test_xla_is_given_no_large_graph():
    """Of some ten thousand operations, which it would compile for minutes, the terms are found from derivatives."""
    x = jnp.linspace(0.1, 1.0, 48)
    products = lambda x: jnp.sum(jnp.sin(x[:, None] * x[None, :]), axis=0)
    terms = jax.jit(lambda x: rounding(products, x)).lower(x)
    assert terms.as_text().count("\n") < 1000
    expected = products(x) + jnp.abs(jax.jacfwd(products)(x)) @ jnp.abs(x)
    np.testing.assert_allclose(terms.compile()(x), expected, rtol=1e-13)
