"""Functions of arrays by sites: their loops do what JAX does, and what is not made of sites is told so."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dirax.engines.sparse.site_loops import loops
from dirax.program.sites.courses import NotBySites
from dirax.program.sites.jacobian import entries_of_jacobian
from dirax.program.sites.walk import sites_of

RNG = np.random.default_rng(0)
N = 43  # no multiple of a vector
Q, P = RNG.normal(size=N), RNG.normal(size=2 * N)
MASSES, EDGES = RNG.uniform(1, 2, N), (np.arange(N - 1), np.arange(1, N))


def energy(q):
    d = jnp.diff(jnp.concatenate([jnp.zeros(1), q, jnp.zeros(1)]))
    return jnp.sum(jnp.cos(q)) + jnp.sum(d**4)


DRAWN = RNG.permutation(400) % N


def lattice(q, rows=7):
    u = q.reshape(rows, -1)
    along, across = jnp.diff(u, axis=0), jnp.diff(u, axis=1)
    return jnp.sum(along**4) + jnp.sum(jnp.cos(across)) + jnp.sum(u[1:, 1:] * u[:-1, :-1])


def waves(p):
    """Of a complex lattice, some of whose couplings are complex numbers, written in several ways."""
    z = jax.lax.complex(p[:N], p[N:])
    coupled = jnp.exp(1j * MASSES) * jnp.conj(z) * jnp.roll(z, 1)
    return (
        jnp.sum(jnp.abs(z[1:] - z[:-1]) ** 2) + jnp.sum(jnp.abs(z) ** 4) + jnp.real(jnp.sum(jnp.where(p[:N] > 0, coupled, z**2)))
    )


@jax.custom_jvp
def steep(x):
    return jnp.sin(x)


steep.defjvp(lambda primals, tangents: (steep(*primals), (3 + steep(*primals)) * tangents[0]))
FUNCTIONS = {
    "chain": (jax.grad(energy), Q),
    "masses": (lambda q: MASSES * jnp.roll(q, 1) / (2 + jnp.sin(q)), Q),
    "edges": (lambda q: jax.ops.segment_sum(q[EDGES[0]] * q[EDGES[1]], EDGES[1], N), Q),
    "links": (lambda p: jnp.linalg.norm(jnp.diff(p.reshape(-1, 2), axis=0), axis=1), P),
    "one in two": (jax.grad(lambda p: jnp.sum(p[1::2] ** 3) + jnp.sum(p[::-1] ** 2 * p)), P),
    "turned": (lambda p: jnp.einsum("ij,nj->ni", jnp.array([[0.6, 0.8], [-0.8, 0.6]]), p.reshape(-1, 2)).ravel(), P),
    "masked": (lambda q: jnp.where(jnp.arange(N) % 2 == 0, q, jnp.where(q > 0, jnp.exp(q), -q)), Q),
    "total": (lambda q: q / jnp.sum(q**2), Q),
    "drawn": (lambda q: q[DRAWN] * q[DRAWN[::-1]] + jnp.roll(q, 2)[DRAWN], Q),
    "lattice": (jax.grad(lattice), P[: 7 * 9]),
    "lattice by columns": (lambda p: p[:63].reshape(7, 9).ravel(order="F") * jnp.sin(p[:63]), P),
    "beside nothing": (lambda q: jnp.concatenate([jnp.sin(q)[:42].reshape(6, 7), jnp.zeros((6, 0))], axis=1), Q),
    "totals": (lambda p: jnp.einsum("ij,ij->i", p[:70].reshape(1, 70), jnp.sin(p[10:80]).reshape(1, 70)) * p[:5], P),
    "totals of rows": (lambda p: jnp.sum(jnp.outer(jnp.arange(1.0, 4.0), p) ** 2, axis=1), P),
    "few": (lambda q: jnp.sum(jnp.sin(q[:8, None] - q[None, :8]), axis=1), Q),
    "sums beside a chain": (lambda p: jnp.append(jax.grad(energy)(p[:-1]) + p[-1], p[-1] * energy(p[:-1]) + p @ jnp.sin(p)), P),
    "sums over edges": (lambda q: jnp.append(jnp.sin(q), jnp.sum(q[DRAWN] * q[DRAWN[::-1]]) * jnp.sum(q**3)), P),
    "complex": (jax.grad(waves), P[: 2 * N]),
    "rules": (lambda q: steep(q) * jax.lax.stop_gradient(q) + jax.nn.softplus(q), np.linspace(-2.0, 2.2, 50)),
}


@pytest.mark.parametrize("name", FUNCTIONS)
@pytest.mark.soak_of(
    but=["links", "turned", "masked", "total", "lattice by columns", "beside nothing", "totals of rows", "rules", "complex"]
)
def test_loops_over_sites_do_what_jax_does(name):
    function, given = FUNCTIONS[name]
    sites = sites_of(function, jax.ShapeDtypeStruct(given.shape, float))
    (found,) = loops(sites, 1, sites.results, sites.sizes)(given)
    expected = np.asarray(function(jnp.asarray(given))).ravel()
    np.testing.assert_allclose(found, expected, rtol=1e-14, atol=1e-14)


@pytest.mark.parametrize(
    "name", ["chain", "masses", "edges", "rules", "one in two", "lattice", "sums beside a chain", "sums over edges", "complex"]
)
@pytest.mark.soak_of(but=["edges", "complex"])
def test_entries_of_the_jacobian_are_all_of_it(name):
    function, given = FUNCTIONS[name]
    sites = sites_of(function, jax.ShapeDtypeStruct(given.shape, float))
    entries, rows, columns = entries_of_jacobian(sites)
    (values,) = loops(sites, 1, [entries], [len(rows)])(given)
    matrix = np.zeros((sites.sizes[0], given.size))
    matrix[rows, columns] = values
    np.testing.assert_allclose(matrix, jax.jacfwd(function)(jnp.asarray(given)), rtol=1e-13, atol=1e-13)


@pytest.mark.parametrize(
    ("function", "why"),
    [
        (lambda q: q[jnp.argsort(q)], "sort"),
        (lambda q: jnp.cumsum(q), "cumsum"),
        (lambda q: jnp.stack([jnp.sin(k * q[k % N]) for k in range(100)]), "different expressions"),
        (lambda q: q[(q[0] > 0).astype(int) + jnp.arange(3)], "depend on values"),
    ],
)
def test_what_is_not_made_of_sites_is_told_so(function, why):
    with pytest.raises(NotBySites, match=why):
        sites_of(function, jax.ShapeDtypeStruct((N,), float))


@pytest.mark.parametrize(
    ("function", "why"),
    [
        (lambda q: q / jnp.sum(q**2), "many equations depend on a sum"),
        (lambda p: jnp.append(p[1:], jnp.sum(jnp.sin(p - jnp.sum(p)))), "a sum of sums"),
        (lambda p: jnp.append(p[1:], jnp.sum(p[0] * p)), "added to one entry"),
    ],
)
def test_jacobians_that_are_not_made_of_sites_are_told_so(function, why):
    with pytest.raises(NotBySites, match=why):
        entries_of_jacobian(sites_of(function, jax.ShapeDtypeStruct((2 * N,), float)))
