"""Retractions of Lie groups, the coadjoint action and semidirect products, against their matrices and finite differences."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import expm

import dirax as dx
from dirax.geometry.group_retractions import coadjoint, pulled_back, retraction
from lie_groups import basis_of

GROUPS = (dx.SO2(), dx.SE2(), dx.SO3(), dx.SE3())


def vectors(group, count, seed=0):
    return [jnp.asarray(v) for v in np.random.default_rng(seed).uniform(-1, 1, (count, group.dimension))]


@pytest.mark.parametrize("group", GROUPS)
def test_retractions_are_those_of_matrices(group):
    basis = basis_of(group)
    one = np.eye(basis.shape[1])
    for zeta in vectors(group, 3):
        z = np.tensordot(zeta, basis, axes=1)
        found = {name: np.asarray(group.matrix(retraction(group, name)(zeta))) for name in ("exp", "cayley")}
        assert found["exp"] == pytest.approx(expm(z), abs=1e-14)
        assert found["cayley"] == pytest.approx(np.linalg.solve(one - z / 2, one + z / 2), abs=1e-14)
    with pytest.raises(ValueError, match="'exp' or 'cayley', but 'log'"):
        retraction(group, "log")


@pytest.mark.parametrize("group", GROUPS)
@pytest.mark.soak_of(but=["group0"])
def test_coadjoint_action_and_tangent_of_a_retraction(group):
    basis = basis_of(group)
    size = np.sum(basis**2, axis=(1, 2))
    matrix = lambda g: np.asarray(group.matrix(g))
    zeta, momentum, eta = vectors(group, 3, seed=1)
    for name in ("exp", "cayley"):
        tau = jax.jit(retraction(group, name))
        g = tau(zeta)
        conjugated = matrix(g) @ np.tensordot(eta, basis, axes=1) @ np.linalg.inv(matrix(g))
        along = np.einsum("aij,ij->a", basis, conjugated) / size
        assert np.vdot(coadjoint(group, g, momentum), eta) == pytest.approx(np.vdot(momentum, along), abs=1e-14)
        e = 1e-4
        difference = (matrix(tau(zeta + e * eta)) - matrix(tau(zeta - e * eta))) / (2 * e)
        trivialized = np.einsum("aij,ij->a", basis, difference @ np.linalg.inv(matrix(g))) / size
        pulled = jax.jit(lambda zeta, mu, tau=tau: pulled_back(group, tau, zeta, mu))(zeta, momentum)
        assert np.vdot(pulled, eta) == pytest.approx(np.vdot(momentum, trivialized), abs=1e-7)


@pytest.mark.parametrize("group", GROUPS[1:])
@pytest.mark.soak_of(but=["group0"])
def test_bivector_is_poisson_and_its_casimirs_are_in_the_kernel(group):
    """Jacobi's identity Λ_il ∂_l Λ_jk + cyclic = 0, exactly linear in x."""
    space = dx.SemidirectProduct(group, advected=2 if group.dimension == 3 and group.translations else 3)
    x = jnp.asarray(np.random.default_rng(2).uniform(-1, 1, space.size))
    value, slope = jax.jit(lambda x: (space.bivector(x), jax.jacfwd(space.bivector)(x)))(x)
    value, slope = np.asarray(value), np.asarray(slope)
    assert value == pytest.approx(-value.T, abs=1e-15)
    jacobi = np.einsum("il,jkl->ijk", value, slope)
    assert np.abs(jacobi + jacobi.transpose(1, 2, 0) + jacobi.transpose(2, 0, 1)).max() < 1e-14
    d = space.dimension
    casimirs = [np.concatenate([np.zeros(d), x[d:]])]  # |a|²
    if group.dimension == 3 and not group.translations:
        casimirs.append(np.concatenate([x[3:], x[:3]]))  # μ·a
    assert max(np.abs(value @ c).max() for c in casimirs) < 1e-15


def test_mistakes():
    with pytest.raises(ValueError, match="a multiple of 2"):
        dx.SemidirectProduct(dx.SE2(), advected=3)
    with pytest.raises(TypeError, match="representation must be a function"):
        dx.SemidirectProduct(dx.SE2(), advected=3, representation=1.0)
    system = dx.EulerPoincare(dx.SO3(), lambda xi, a: xi @ xi, advected=4, representation=lambda m, a: m @ a[:3])
    with pytest.raises(ValueError, match=r"representation\(matrix, a\) must return shape \(4,\)"):
        dx.simulate(system, dx.DiscreteEulerPoincare(), x=np.ones(7), step=0.1, steps=1)


@pytest.mark.parametrize(
    ("act", "words"),
    [
        (lambda m, a: m.T @ a, r"one of the group, \(gh\)·a"),
        (lambda m, a: m @ a * (1.0 + a @ a), "linear in a"),
        (lambda m, a: m @ a + 1e-5, "linear in a"),
        (lambda m, a: 0.0 * a, r"e·a = a: it is off by .* where its values are"),
        (lambda m, a: m @ a * (1.0 + 1e-5 * jnp.trace(m)), "one of the group"),
    ],
)
def test_what_is_no_representation_is_refused(act, words):
    """Such systems ran with ok=True; verify called them not symplectic."""
    top = dx.EulerPoincare(dx.SO3(), lambda xi, a: xi @ xi / 2 - a[2], advected=3, representation=act)
    with pytest.raises(ValueError, match=words):
        dx.simulate(top, dx.DiscreteEulerPoincare(), x=[0.1, 0.2, 0.3, 0.0, 0.6, 0.8], step=0.1, steps=2)
