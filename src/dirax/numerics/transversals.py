"""Scales of the rows and columns of a square matrix that bring the largest product of entries, one a row and column, to 1.

They do for chains of units what no means and no largest entries can: roundoff of zeros beside small masses, which are of all
sizes, stands in no largest product.
"""

import numpy as np

from dirax.numerics.equilibration import geometric_scales


def transversal_scales(matrix: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Powers of two (k, 1) and (1, k) by which rows and columns are to be divided so that all entries of the transversal with the
    largest product are about 1, and no other entry is larger (Duff and Koster 2001); `geometric_scales` where there is none."""
    from scipy.sparse import csgraph, csr_matrix  # imported when it is used

    rows, columns = geometric_scales(np.abs(matrix))
    scaled = np.abs(matrix) / rows / columns
    exponents = np.where(scaled > 0.0, np.frexp(scaled)[1].astype(float), -np.inf)
    there = np.nonzero(scaled)
    sizes = exponents[there]
    try:
        weights = csr_matrix((np.max(sizes, initial=0.0) + 1.0 - sizes, there), shape=scaled.shape)
        _, taken = csgraph.min_weight_full_bipartite_matching(weights)
    except ValueError:  # every product has a zero
        return rows, columns
    # logarithms r, c with r_i + c_j ≥ e_ij, where equality holds for the entries that were taken: c follows from r, and the
    # differences of r are bounded from both sides by longest paths; they are put between these
    own = exponents[np.arange(len(taken)), taken]
    bounds = exponents[:, taken] - own
    r = np.floor((_longest(bounds) - _longest(bounds.T)) / 2.0)  # which keeps the inequalities
    c = np.empty_like(r)
    c[taken] = own - r
    power = lambda exponents: np.ldexp(1.0, exponents.astype(int))
    return rows * power(r)[:, None], columns * power(c)[None]


def _longest(steps: np.ndarray) -> np.ndarray:
    """The longest way to each of k places, from anywhere, where the step from j to i is steps[i, j] long."""
    found = np.zeros(len(steps))
    for _ in range(len(steps)):
        longer = np.max(found + steps, axis=1, initial=0.0)
        if np.all(longer <= found):
            break
        found = np.maximum(found, longer)
    return found
