"""Index sets through jaxprs, beside the Jacobian itself: as many entries as it has, and none less."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dirax as dx
from dirax.program.sparsity import Dense, pattern_of
from dirax.program.tracing import pulled_back
from dirax.schemes.step import Shape, make_step_equation

N = 16
EDGES = np.arange(N - 1)


def padded(q):
    d = jnp.diff(jnp.concatenate([jnp.zeros(1), q, jnp.zeros(1)]))
    return jnp.sum(d**2 / 2 + d**4 / 5)


def links(q):
    d = jnp.diff(jnp.concatenate([jnp.zeros((1, 2)), q.reshape(-1, 2)]), axis=0)
    return (jnp.sum(d * d, axis=1) - 1) / 2


def written(q):
    """A matrix of zeros with some entries, as people write it."""
    matrix = jnp.zeros((N, N)).at[EDGES, EDGES + 1].set(jnp.sin(q[1:])).at[EDGES + 1, EDGES].set(-2.0)
    return matrix @ q


POTENTIALS = {
    "padded differences": padded,
    "roll": lambda q: jnp.sum(1 - jnp.cos(jnp.roll(q, -1) - q)),
    "gathers": lambda q: jnp.sum((q[jnp.arange(N - 1) + 1] - q[jnp.arange(N - 1)]) ** 4),
    "segment_sum": lambda q: jnp.sum(jnp.sin(jax.ops.segment_sum((q[1:] - q[:-1]) ** 2, EDGES // 2, num_segments=N))),
    "lattice": lambda q: jnp.sum(jnp.diff(q.reshape(4, 4), axis=0) ** 2) + jnp.sum(jnp.diff(q.reshape(4, 4), axis=1) ** 4),
    "vmap": lambda q: jnp.sum(jax.vmap(lambda a, b: jnp.where(a > b, (a - b) ** 3, jnp.exp(a - b)))(q[1:], q[:-1])),
    "einsum": lambda q: jnp.einsum("i,i,i->", q, q, jnp.roll(q, 2)),
    "mask": lambda q: jnp.sum(jnp.where(np.arange(N) % 3 == 0, q * jnp.roll(q, 1), 0.0)),
    "constant matrix": lambda q: q @ jnp.asarray(np.eye(N, k=3)) @ q,
}
FUNCTIONS = {name: jax.grad(function) for name, function in POTENTIALS.items()} | {
    "derivatives of constraints": lambda q: jax.jacrev(links)(q).ravel(),
    "forces of constraints": lambda q: jax.jacrev(links)(q).T @ jnp.cos(links(q)),
    "pulled back": lambda q: pulled_back(links, q, jnp.cos(links(q))),
    "matrix written into zeros": written,
    "complex numbers": jax.grad(lambda q: jnp.sum(jnp.abs(jax.lax.complex(q, jnp.roll(q, 1))) ** 3)),
    "small solves": lambda q: jax.vmap(lambda a: jnp.linalg.solve(jnp.eye(2) * 3 + jnp.outer(a, a), a))(q.reshape(-1, 2)).ravel(),
    "axes that are repeated": lambda q: (q.reshape(1, 4, 4) * jnp.asarray(np.eye(3))[:, :, None, None][:, 0]).ravel(),
}
LARGER = {"small solves"}


@pytest.mark.parametrize("name", FUNCTIONS)
@pytest.mark.soak_of(but=["constant matrix", "complex numbers"])
def test_has_the_entries_of_the_jacobian(name):
    function, rng = FUNCTIONS[name], np.random.default_rng(0)
    pattern = pattern_of(function, jax.ShapeDtypeStruct((N,), float)).toarray()
    entries = np.any([np.asarray(jax.jacfwd(function)(rng.normal(size=N))) != 0 for _ in range(4)], axis=0)
    assert not np.any(entries & ~pattern)
    if name not in LARGER:
        assert np.array_equal(entries, pattern)


@pytest.mark.soak
def test_steps_are_read_through_the_primitives_of_dirax():
    system = dx.LagrangeDirac(lambda q, v: v @ v / 2 - padded(q), holonomic=lambda q: links(q)[::4])
    equation: dx.StepEquation = make_step_equation(dx.LagrangeDAlembert(), system, Shape(N, 0, 2))
    rng, k, s = np.random.default_rng(1), equation.unknowns, equation.state_size
    residual = lambda u, state, t, h: equation.residual(u, state, t, h, None)
    given = rng.normal(size=k), rng.normal(size=s), 0.3, 0.1
    entries = np.asarray(jax.jacfwd(residual)(*given)) != 0
    pattern = pattern_of(residual, *(jax.ShapeDtypeStruct(np.shape(a), float) for a in given)).toarray()
    assert np.array_equal(entries, pattern)


def test_whole_numbers_among_the_parameters_are_looked_at():
    function = lambda q, edges: jnp.diff(q)[edges] ** 2
    unknowns, edges = jax.ShapeDtypeStruct((4,), float), np.array([2, 0])
    assert pattern_of(function, unknowns, edges).toarray().tolist() == [[0, 0, 1, 1], [1, 1, 0, 0]]
    with pytest.raises(Dense, match="indices"):
        pattern_of(function, unknowns, jax.ShapeDtypeStruct((2,), int))


@pytest.mark.soak
def test_what_depends_on_everything_is_dense():
    size = 4000
    with pytest.raises(Dense, match="too many"):
        pattern_of(lambda q: q * jnp.sum(q), jax.ShapeDtypeStruct((size,), float))
