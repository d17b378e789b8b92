"""Inverses of many matrices: small and large ones, in any units, singular ones, and the sizes that they give."""

import numpy as np
import pytest
import threadpoolctl

from dirax.numerics.equilibration import balancing_scales
from dirax.numerics.inverses import LARGE, applied, applied_sizes, inverted, no_inverses, unknown
from dirax.numerics.one_thread import one_thread

RNG = np.random.default_rng(0)


def matrices(count, k):
    """Banded ones."""
    near = np.abs(np.subtract.outer(np.arange(k), np.arange(k))) < 3
    return RNG.standard_normal((count, k, k)) * near + 4.0 * np.eye(k)


@pytest.mark.parametrize("k", [3, LARGE + 7])
def test_they_solve_equations_in_any_units(k):
    a, x, (rows, columns) = matrices(5, k), RNG.standard_normal((5, k)), 10.0 ** RNG.integers(-6, 6, (2, k))
    right = rows * (a @ x[..., None])[..., 0]
    found = applied(inverted(rows[:, None] * a * columns), right) * columns
    np.testing.assert_allclose(found, x, rtol=1e-8, atol=1e-8)


@pytest.mark.parametrize("alone", [False, True])
def test_a_large_one_is_in_the_units_of_a_dense_one(alone):
    a = 10.0 ** RNG.integers(-6, 6, (3, LARGE, LARGE)) * matrices(3, LARGE)
    rows, columns = balancing_scales(np.abs(a) if alone else np.max(np.abs(a), axis=0)[None])
    for one, r, c in zip(inverted(a, alone), *(np.broadcast_to(s, (3, *s.shape[1:])) for s in (rows, columns)), strict=True):
        np.testing.assert_array_equal(one.rows, r[:, 0])
        np.testing.assert_array_equal(one.columns, c[0])


@pytest.mark.parametrize("k", [3, LARGE + 7])
def test_a_singular_one_gives_no_numbers_and_leaves_the_others_alone(k):
    a = matrices(3, k)
    a[1, :, 0] = 0.0
    a[2, 0, 0] = np.nan
    found = applied(inverted(a), np.ones((3, k)))
    assert np.all(np.isfinite(found[0]))
    assert not np.any(np.all(np.isfinite(found[1:]), axis=1))


@pytest.mark.parametrize("k", [3, LARGE + 7])
def test_unknown_ones(k):
    inverses = no_inverses(4, k)
    inverses[[0, 2]] = inverted(matrices(2, k))
    assert unknown(inverses).tolist() == [False, True, False, True]


def test_sizes_of_large_ones_are_about_those_of_all_signs():
    a, sizes = matrices(2, LARGE + 7), RNG.uniform(1.0, 2.0, (2, LARGE + 7))
    exact = np.einsum("rij,rj->ri", np.abs(np.linalg.inv(a)), sizes)
    found = applied_sizes(inverted(a), sizes)
    assert np.all(found <= exact * (1 + 1e-9))
    assert np.median(found / exact) > 0.5


def test_blas_has_one_thread_inside_and_its_own_again_outside():
    """Whoever comes in while others are inside, and whoever goes first."""
    count = lambda: [lib.num_threads for lib in threadpoolctl.ThreadpoolController().select(user_api="blas").lib_controllers]
    first, second = one_thread(), one_thread()
    with threadpoolctl.threadpool_limits(2, "blas"):
        first.__enter__()
        second.__enter__()
        assert set(count()) == {1}
        first.__exit__(None, None, None)
        assert set(count()) == {1}
        second.__exit__(None, None, None)
        assert set(count()) == {2}


def test_the_roundoff_of_zeros_sets_no_scales():
    """Diagonal matrices with roundoff of zero, of any size, above the diagonal."""
    rng, k = np.random.default_rng(0), 40
    roundoff = np.triu(10.0 ** rng.uniform(-40.0, -17.0, (k, k)) * rng.choice([-1.0, 0.0, 1.0], (k, k)), 1)
    diagonal = rng.uniform(0.5, 2.0, k)
    for alone in (False, True):
        np.testing.assert_allclose(inverted((np.diag(diagonal) + roundoff)[None], alone)[0], np.diag(1.0 / diagonal), atol=1e-14)
