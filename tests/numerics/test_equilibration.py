"""Scales of rows and columns: with other units, by powers of two, the scaled matrix is the same to the last bit."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dirax.numerics.equilibration import balanced_inverse, condition_number, geometric_scales

COUPLED = np.array([[1.3, 1.5e-7], [1.5e-7, 0.4]])
SADDLE = np.array([[2.0, 0.0, 1.0], [0.0, 3e-9, 1e-3], [1.0, 1e-3, 0.0]])
TRIANGULAR = np.array([[1.0, 3e-13, 0.0], [0.0, 0.7, 5.0], [0.0, 4.0, -0.3]])


@pytest.mark.parametrize("matrix", [COUPLED, SADDLE, TRIANGULAR])
@pytest.mark.parametrize("xp", [np, jnp])
@pytest.mark.soak_of("jax.numpy-matrix0", "jax.numpy-matrix1")
def test_scaled_matrices_in_other_units(matrix, xp):
    """A weak entry, that alone connects two parts of a matrix, says how their units are to each other."""
    find = lambda matrix: geometric_scales(matrix, xp)
    scales = jax.jit(find) if xp is jnp else find

    def scaled(matrix):
        rows, columns = scales(xp.abs(xp.asarray(matrix)))
        return np.asarray(matrix / rows / columns)

    units = np.array([2.0**-40, 2.0**55, 2.0**3])[: len(matrix)]
    for other in (matrix * units, matrix * units[:, None], matrix * units * units[:, None]):
        np.testing.assert_array_equal(scaled(other), scaled(matrix))


def test_an_inverse_keeps_its_small_entries_in_other_units():
    (a, b), (_, c) = COUPLED
    exact = np.array([[c, -b], [-b, a]]) / (a * c - b * b)
    for unit in (1.0, 2.0**30, 2.0**-100):
        units = np.array([1.0, unit])
        found = balanced_inverse(COUPLED * units * units[:, None])
        np.testing.assert_allclose(found * units * units[:, None], exact, rtol=1e-14)
        assert condition_number(COUPLED * units * units[:, None]) == condition_number(COUPLED)


@pytest.mark.soak
def test_the_condition_of_singular_matrices_is_infinite():
    """Without a warning, which is an error here."""
    matrices = np.array([np.eye(2), [[1.0, 1.0], [1.0, -1.0]], [[1.0, 0.0], [2.0**-90, 0.0]], np.zeros((2, 2))])
    for xp in (np, jnp):
        np.testing.assert_allclose(condition_number(xp.asarray(matrices), xp), [1.0, 1.0, np.inf, np.inf], rtol=1e-12)


@pytest.mark.parametrize("xp", [np, jnp])
@pytest.mark.soak_of("jax.numpy")
def test_entries_near_the_smallest_floats_have_scales(xp):
    """A step at the end of a trajectory that comes to rest: its scales were no floats, and nothing could be said of the step."""
    matrix = xp.asarray([[0.0, -9.5e-306], [9.5e-306, -3.9e-263]])
    rows, columns = geometric_scales(xp.abs(matrix), xp)
    assert xp.all(xp.isfinite(1.0 / rows)) and xp.all(xp.isfinite(1.0 / columns))
    assert condition_number(matrix, xp) == condition_number(matrix * 2.0**900, xp) < 3.0
