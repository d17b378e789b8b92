"""LagrangeDirac: Legendre transform and its inverse, energy, projection, completed initial data, sizes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import dirax as dx
from dirax.numerics.ranks import rank_of_equations
from dirax.program.linear_solves import scaled_pseudo_inverse
from dirax.program.roots import nearest_root

numbers = st.floats(-3, 3, allow_subnormal=False)
vectors = st.tuples(*[numbers] * 3).map(np.array)

RELATIVISTIC = dx.LagrangeDirac(lambda q, v, params: -params * jnp.sqrt(1 - v @ v) - jnp.cos(q[0]))
DEGENERATE = dx.LagrangeDirac(lambda q, v: (v[0] + v[1]) ** 2 / 2 - q[2] * v[2], lambda q: jnp.array([[1.0, -2.0, 1.0]]))


@settings(max_examples=60)
@given(vectors, vectors, st.floats(0.1, 10))
@pytest.mark.soak
def test_inverse_legendre_of_a_relativistic_particle(q, p, m):
    """p = m v/√(1 − v²); far out, Newton from v = 0 would leave |v| < 1."""
    v = inverse(jnp.array(q), jnp.array(p), m)
    np.testing.assert_allclose(v, p / np.sqrt(m**2 + p @ p), atol=4e-16)


inverse = jax.jit(RELATIVISTIC.inverse_legendre)


def test_energy_of_a_relativistic_particle():
    q, v, m = jnp.array([0.3, 0.0]), jnp.array([0.8, -0.5]), 2.0
    gamma = 1 / np.sqrt(1 - 0.89)
    np.testing.assert_allclose(RELATIVISTIC.legendre(q, v, m), m * gamma * v, rtol=1e-14)
    np.testing.assert_allclose(RELATIVISTIC.energy(q, v, m), m * gamma + np.cos(0.3), rtol=1e-14)
    row = {"q": q, "p": m * gamma * v}
    np.testing.assert_allclose(RELATIVISTIC.energy_at(row, m), m * gamma + np.cos(0.3), rtol=1e-14)
    np.testing.assert_allclose(
        RELATIVISTIC.generalized_energy(q, v, jnp.array([1.0, 2.0]), m), 0.8 - 1.0 + m / gamma + np.cos(0.3), rtol=1e-14
    )


@pytest.mark.soak
def test_derivatives_of_the_inverse_legendre_transform():
    q, p, m = jnp.zeros(2), jnp.array([0.7, -0.4]), 1.5
    exact = lambda p, m: p / jnp.sqrt(m**2 + p @ p)
    solved = lambda p, m: RELATIVISTIC.inverse_legendre(q, p, m)
    derivatives = jax.jit(lambda p, m: (jax.jacrev(solved, (0, 1))(p, m), jax.jacfwd(jax.jacrev(solved))(p, m)))(p, m)
    np.testing.assert_allclose(derivatives[0][0], jax.jacfwd(exact)(p, m), rtol=1e-12, atol=1e-14)
    np.testing.assert_allclose(derivatives[0][1], jax.jacfwd(exact, 1)(p, m), rtol=1e-12, atol=1e-14)
    np.testing.assert_allclose(derivatives[1], jax.hessian(exact)(p, m), rtol=1e-11, atol=1e-13)


@settings(max_examples=40)
@given(vectors, vectors)
def test_the_nearest_velocity_of_a_degenerate_lagrangian(q, guess):
    """Only v0 + v1 is in p: what is taken is nearest to the guess."""
    p = np.array([1.4, 1.4, -q[2]])
    v = nearest(jnp.array(q), jnp.array(p), None, jnp.array(guess))
    share = (1.4 - guess[0] - guess[1]) / 2
    np.testing.assert_allclose(v, guess + np.array([share, share, 0.0]), atol=1e-14)


nearest = jax.jit(DEGENERATE.inverse_legendre)


@pytest.mark.soak
def test_momenta_of_a_degenerate_lagrangian_are_completed_by_the_constraint():
    """v0 + v1 = 1.4 and v0 − 2 v1 + v2 = 0, of which the least-norm v2 is not zero."""
    data = {"q": jnp.array([0.0, 0.0, 0.5]), "p": jnp.array([1.4, 1.4, -0.5])}
    full = jax.jit(lambda data: DEGENERATE.complete(data, None, False))(data)
    v = np.asarray(full["v"])
    assert v[0] + v[1] == pytest.approx(1.4, abs=1e-15)
    assert DEGENERATE.initial_defect(full, None) == pytest.approx(0.0, abs=1e-15)
    np.testing.assert_array_equal(full["p"], data["p"])


SKEWED = dx.LagrangeDirac(
    lambda q, v, m: (m * v[0] ** 2 + v[1] ** 2 + 2 * v[2] ** 2) / 2,
    lambda q: jnp.stack([jnp.stack([jnp.cos(q[0]), 1.0, q[1]])]),
)


@settings(max_examples=40)
@given(vectors, vectors, st.floats(0.1, 5))
def test_projection_of_velocities_is_orthogonal_in_the_metric(q, v, m):
    """Mass matrix diag(m, 1, 2): Gauss' principle, M (v − Pv) ∈ im Wᵀ."""
    w = np.array([np.cos(q[0]), 1.0, q[1]])
    projected = np.asarray(project(jnp.array(q), jnp.array(v), m))
    assert abs(w @ projected) < 1e-13
    force = np.array([m, 1.0, 2.0]) * (v - projected)
    np.testing.assert_allclose(force, w * (force @ w) / (w @ w), atol=1e-13)
    np.testing.assert_allclose(project(jnp.array(q), jnp.array(projected), m), projected, atol=1e-14)


project = jax.jit(SKEWED.project_velocity)


def test_projection_for_a_degenerate_lagrangian_is_euclidean():
    v = DEGENERATE.project_velocity(jnp.zeros(3), jnp.array([1.0, 1.0, 1.0]))
    np.testing.assert_allclose(v, [1.0, 1.0, 1.0], atol=1e-15)
    v = DEGENERATE.project_velocity(jnp.zeros(3), jnp.array([6.0, 0.0, 0.0]))
    np.testing.assert_allclose(v, np.array([6.0, 0.0, 0.0]) - np.array([1.0, -2.0, 1.0]), atol=1e-14)


def test_sizes_and_constraint_matrix():
    data = {"q": jnp.zeros(3), "v": jnp.zeros(3)}
    assert DEGENERATE.sizes(data, None) == (3, 1)
    assert dx.LagrangeDirac(lambda q, v: v @ v / 2).sizes(data, None) == (3, 0)
    assert dx.LagrangeDirac(lambda q, v: v @ v / 2).constraint_matrix(jnp.zeros(3)).shape == (0, 3)
    row = {"q": jnp.zeros(3), "p": jnp.array([2.0, 2.0, 0.0])}
    np.testing.assert_allclose(DEGENERATE.constraint_at(row, None), [1.0 - 2.0], atol=1e-14)  # of the least-norm velocity


# ------------------------------------------------------------------------------------------------ the algebra underneath


def test_roots_do_not_depend_on_units():
    """Masses between 1e-9 and 2e7, and a cubic term that makes Newton iterate."""
    matrix = np.zeros((4, 4))
    matrix[:2, :2] = [[2e7, 1e7], [1e7, 1.5e7]]
    matrix[2, 2], matrix[3, 3] = 1e-9, 1.0
    root = np.array([1.0, -2.0, 3.0, 0.7])
    function = lambda v: matrix @ v + jnp.array([0.0, 0.0, 1e-9, 1.0]) * v**3
    found = nearest_root(lambda v: function(v) - function(root), jnp.zeros(4))
    np.testing.assert_allclose(found, root, rtol=1e-14)


def test_without_a_root_the_last_improvement_comes_back():
    found = nearest_root(lambda v: jnp.stack([v[0] - 1.0, 0.0 * v[1] + 1.0]), jnp.array([0.0, 5.0]))
    np.testing.assert_allclose(found, [1.0, 5.0], atol=1e-12)
    assert jnp.isfinite(nearest_root(lambda v: jnp.sqrt(v) + 1.0, jnp.array([1.0])))


@settings(max_examples=40)
@given(st.integers(0, 2**32 - 1), st.integers(2, 3), st.integers(2, 3), st.integers(0, 3))
@pytest.mark.soak
def test_pseudo_inverse_and_rank_of_badly_scaled_matrices(seed, k, l, rank):
    generator = np.random.default_rng(seed)
    rank = min(rank, k, l)
    units = 10.0 ** generator.integers(-8, 8, size=k)[:, None], 10.0 ** generator.integers(-8, 8, size=l)[None, :]
    plain = generator.normal(size=(k, rank)) @ generator.normal(size=(rank, l))
    matrix = units[0] * plain * units[1]
    inverse = np.asarray(pseudo_inverse(jnp.array(matrix)))
    np.testing.assert_allclose(matrix @ inverse @ matrix / units[0] / units[1], plain, atol=1e-7)
    assert rank_of_equations(matrix[None])[0][0] == rank
    if rank < l:
        direction = rank_of_equations(matrix[None])[1][0]
        assert np.max(np.abs(plain @ (direction / np.max(np.abs(direction * units[1])) * units[1][0]))) < 1e-7


pseudo_inverse = jax.jit(scaled_pseudo_inverse)
