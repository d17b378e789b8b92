"""Functions by their scalar programs under JAX's transformations: against JAX itself, which compiles them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dirax.program.on_host import on_host
from dirax.program.roots import nearest_root
from dirax.program.tracing import gradient

X, A = jnp.array([[0.3, -0.2], [1.1, 0.4]]), jnp.array([[0.7], [1.3]])


def energy(x, a):
    return jnp.cos(x[0]) * a[0] + jnp.exp(x[1] * a[0]) * x[0] ** 2 + jnp.abs(x[1])


def found(x, a):
    """A derivative, a root that depends on it, a function of edges, something that stands still, and nothing."""
    slope = gradient(energy)(x, a)
    root = nearest_root(lambda u: u + 0.1 * jnp.sin(u) * a - slope, jnp.zeros(2))
    return {"root": root, "size": jnp.arcsin(jnp.tanh(root[0])) * a[0], "fixed": jnp.ones(3), "none": jnp.zeros((0, 2))}


def host(x, a):
    result = on_host(found, [x, a], "tested")
    assert result is not None
    return result


def by_jax(x, a):
    return jax.vmap(found)(x, a)


def close(ours, theirs, digits=12):
    jax.tree.map(lambda u, v: np.testing.assert_allclose(u, v, rtol=10.0**-digits, atol=10.0**-digits), ours, theirs)


@pytest.mark.soak
def test_values_and_first_derivatives_of_several_entries():
    along = jnp.array([[0.2, 0.5], [-0.1, 0.3]]), jnp.array([[0.4], [0.0]])
    ours, theirs = (jax.jit(lambda x, a, f=f: jax.jvp(f, (x, a), along))(X, A) for f in (host, by_jax))
    close(ours, theirs)
    flow = jax.tree.map(lambda a: jnp.cos(jnp.arange(float(a.size))).reshape(a.shape), ours[0])
    product = lambda a, b: sum(float(jnp.vdot(u, v)) for u, v in zip(*map(jax.tree.leaves, (a, b)), strict=True))
    back = jax.jit(lambda x, a: jax.vjp(host, x, a)[1](flow))(X, A)
    close(product(back, along), product(flow, ours[1]))
    close(jax.vjp(lambda a: host(X, a), A)[1](flow)[0], back[1])  # by one of them alone


def test_second_derivatives_and_axes_of_vmap():
    def cost(x):
        result = host(x, A)
        return jnp.sum(jnp.sin(result["root"]) ** 2) + jnp.sum(result["size"])

    several = jnp.stack([X, *(X + sign * 1e-5 * unit for unit in np.eye(4).reshape(4, 2, 2) for sign in (1, -1))])
    slopes = jax.jit(jax.vmap(jax.grad(cost)))(several)
    close(slopes[1], jax.grad(cost)(several[1]), 15)
    differences = (slopes[1::2] - slopes[2::2]).reshape(2, 2, 2, 2) / 2e-5
    close(jnp.transpose(jax.jit(jax.hessian(cost))(X), (2, 3, 0, 1)), differences, 8)


def test_what_is_no_scalar_program_is_left_to_others():
    assert jax.jit(lambda x: jnp.zeros(on_host(lambda x: jnp.arccos(jax.lax.complex(x, x)).real, [x], "acos") is None))(
        X
    ).shape == (1,)
    assert jax.jit(lambda x: jnp.zeros(on_host(lambda x: x * x, [jnp.tile(x, 100)], "many") is None))(X).shape == (1,)
    closing = lambda x: jnp.zeros(on_host(lambda y: y * x[0], [x], "closed over") is None)
    assert jax.jit(closing)(X).shape == (1,)


@pytest.mark.parametrize("whole", [2, 3])
def test_whole_numbers_stand_still(whole):
    power = lambda f: lambda x: jnp.sum(f(x, jnp.full((2,), whole)))
    ours = power(lambda x, n: on_host(lambda x, n: x**2 * n.astype(float), [x, n], "whole"))
    close(jax.grad(ours)(X), 2 * whole * X)


@pytest.mark.soak
def test_cotangents_have_the_dtypes_of_what_they_are_of():
    """Of operands of single precision beside those of double precision, of several entries, also of the tangents."""
    wide = lambda x, a: {"both": jnp.sin(x) * a.astype(float)[0], "one": a.astype(float) ** 2}
    ours = lambda x, a: on_host(wide, [x, a], "of two dtypes")
    narrow = A.astype(jnp.float32)
    flow = jax.tree.map(jnp.cos, ours(X, narrow))
    for back in (lambda x, a: jax.vjp(ours, x, a)[1](flow), jax.jit(lambda x, a: jax.vjp(ours, x, a)[1](flow))):
        found, expected = back(X, narrow), jax.vjp(jax.vmap(wide), X, narrow)[1](flow)
        assert [a.dtype for a in found] == [np.float64, np.float32]
        close(found, expected, 6)
    cost = lambda a: jnp.sum(ours(X, a)["one"] * ours(X, a)["both"])
    single, double = jax.jit(lambda narrow, wide: [jax.hessian(cost)(a) for a in (narrow, wide)])(narrow, A)
    assert single.dtype == np.float32
    close(single, double, 5)
