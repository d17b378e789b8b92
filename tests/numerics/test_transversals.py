"""Scales by the largest transversal: its product, by all permutations; other units; noise beside saddle points."""

import itertools

import numpy as np
import pytest

from dirax.numerics.equilibration import geometric_scales
from dirax.numerics.ranks import rank_of_equations
from dirax.numerics.transversals import transversal_scales


def scaled(matrix):
    rows, columns = transversal_scales(matrix)
    return matrix / rows / columns


@pytest.mark.parametrize("seed", range(6))
def test_the_largest_product_has_entries_near_1(seed):
    rng = np.random.default_rng(seed)
    matrix = np.ldexp(rng.uniform(0.5, 1.0, (4, 4)), rng.integers(-40, 40, (4, 4))) * (rng.uniform(size=(4, 4)) < 0.7)
    products = {p: np.prod(matrix[range(4), p]) for p in itertools.permutations(range(4))}
    if not any(products.values()):
        for found, wanted in zip(transversal_scales(matrix), geometric_scales(np.abs(matrix)), strict=True):
            np.testing.assert_array_equal(found, wanted)
        return
    best = max(products, key=products.get)
    for units in (1.0, np.ldexp(1.0, rng.integers(-90, 90, (4, 1))) * np.ldexp(1.0, rng.integers(-90, 90, 4))):
        found = scaled(matrix * units)
        assert np.max(found) < 1.0
        assert np.all(found[range(4), best] >= 2.0**-4)  # one that is about as large may have been taken


def test_the_rank_of_a_saddle_point_beside_noise():
    """q̇ = p/m and ṗ = Gᵀλ with G q̇ = 0, in SI units of a molecule, and what is left of zeros; without the mass it is singular."""
    mass, noise = 1e-25, np.random.default_rng(0).normal(size=(5, 5)) * 10.0 ** np.random.default_rng(1).uniform(-99, -45, (5, 5))
    G, eye, zero = np.array([[1.4e-10, -1.8e-10]]), np.eye(2), np.zeros((2, 2))
    matrix = lambda slope: np.block([[zero, -eye, G.T], [eye, -slope * eye, 0 * G.T], [G, 0 * G, np.zeros((1, 1))]])
    assert rank_of_equations(matrix(mass)[None] + noise)[0] == 5
    assert rank_of_equations(matrix(0.0)[None])[0] == 4
