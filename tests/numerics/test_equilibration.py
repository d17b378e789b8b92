"""Equilibration: condition numbers by the closed form of 2 × 2 matrices."""

import jax.numpy as jnp
import numpy as np

from dirax.numerics.equilibration import condition_number


def test_the_condition_of_singular_matrices_is_infinite():
    """Without a warning, which is an error here."""
    matrices = np.array([np.eye(2), [[1.0, 1.0], [1.0, -1.0]], [[1.0, 0.0], [2.0**-90, 0.0]], np.zeros((2, 2))])
    for xp in (np, jnp):
        np.testing.assert_allclose(condition_number(xp.asarray(matrices), xp), [1.0, 1.0, np.inf, np.inf], rtol=1e-12)
