"""Functions with options that change what they mean: by the scalar graph as by JAX, and where their derivatives have entries."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax
from jax.scipy import special

from dirax.program.evaluation.functions import in_numpy
from dirax.program.sparsity import pattern_of

X = np.random.default_rng(1).normal(size=(3, 4))
AT = jnp.array([0, 9, -1])
TABLE = jnp.arange(7.0) ** 2
FUNCTIONS = {
    "order": lambda x: x.ravel(order="F") * jnp.arange(12.0),
    "reshape": lambda x: x.reshape((2, 6), order="F"),
    "reverse": lambda x: lax.cumsum(x, axis=1, reverse=True) + lax.cumprod(x, axis=1, reverse=True),
    "where": lambda x: jnp.sum(x, axis=0, where=x > 0) + jnp.max(x, axis=0, where=x > 0, initial=-2.0),
    "variance": lambda x: jnp.var(x, axis=1, ddof=1, keepdims=True) + jnp.std(x, axis=1, keepdims=True),
    "take": lambda x: jnp.concatenate(
        [jnp.take(x, jnp.array([0, 2, 5]), axis=1, mode=mode).ravel() for mode in ("clip", "wrap")]
    ),
    "get": lambda x: x[0].at[AT].get(mode="fill", fill_value=7.0) + x[0].at[AT].get(mode="clip"),
    "set": lambda x: x[0].at[AT].set(x[1, :3], mode="drop") + x[0].at[AT].set(x[1, :3], mode="clip"),
    "add": lambda x: x[0].at[AT].add(x[1, :3], mode="drop") * x[0].at[jnp.array([0, 0, 1])].add(x[1, :3]),
    "multiply": lambda x: x[0].at[jnp.array([0, 3])].min(x[1, :2]) + x[0].at[jnp.array([0, 3])].max(x[1, :2]),
    "slices": lambda x: lax.dynamic_slice(x[0], (jnp.int32(9),), (2,)) + lax.dynamic_slice(x[0], (jnp.int32(-2),), (2,)),
    "segments": lambda x: jax.ops.segment_sum(x.ravel()[:6], jnp.array([0, 2, 2, 1, 0, 9]), num_segments=3),
    "triangle": lambda x: lax.linalg.triangular_solve(
        x[:, :3] + 3 * jnp.eye(3), x.T, left_side=False, lower=True, transpose_a=True, unit_diagonal=True
    ),
    "cholesky": lambda x: jnp.linalg.cholesky(x @ x.T + jnp.eye(3) + jnp.diag(x[0, :2], 1), symmetrize_input=False),
    "rounding": lambda x: jnp.round(10 * x, 1) + jnp.remainder(x, -0.3) + jnp.fmod(x, 0.3) + x // 0.3 + jnp.trunc(5 * x),
    "whole numbers": lambda x: (3.7 * x).astype(jnp.int8).astype(float) + ((jnp.arange(4.0) - 3) // 2)[None] * x,
    "clamp": lambda x: lax.clamp(-0.3, x, 0.4) + jnp.clip(x, None, 0.1) + jnp.heaviside(x, 0.5),
    "pad": lambda x: jnp.concatenate([jnp.pad(x[0], 2, mode=m) for m in ("edge", "reflect", "symmetric", "wrap", "linear_ramp")]),
    "borders": lambda x: lax.pad(x, 1.0, [(-1, 2, 1), (0, -1, 0)]),
    "interpolation": lambda x: jnp.interp(x, jnp.linspace(-2, 2, 7), TABLE, left=1.0, right=3.0),
    "search": lambda x: jnp.searchsorted(jnp.array([-1.0, 0.0, 0.0, 1.0]), jnp.append(x, 0.0), side="right").astype(float),
    "products": lambda x: jnp.einsum("ij,kj,ki->k", x, x, x @ x.T) + jnp.tensordot(x, x, axes=([0, 1], [0, 1])),
    "moves": lambda x: jnp.roll(x, (1, -2), (0, 1)) + jnp.moveaxis(x[None], 0, 2)[..., 0] + jnp.rot90(x, 3).T[::-1, ::-1],
    "diagonals": lambda x: jnp.trace(x, offset=1) + jnp.triu(x, 1) + jnp.tril(x, -1),
    "loops": lambda x: lax.scan(lambda c, a: (0.5 * c + a, c), jnp.zeros(4), x, reverse=True)[1],
    "branches": lambda x: lax.switch(7, [lambda x: x, lambda x: 2 * x, lambda x: x**2], x),
    "activations": lambda x: jax.nn.gelu(x, approximate=False) + jax.nn.gelu(x) + jax.nn.softmax(x, axis=0) + jax.nn.selu(x),
    "special": lambda x: special.logsumexp(x, axis=0, b=2.0, keepdims=True) + special.entr(jnp.abs(x)) + special.log_ndtr(x),
    "constants": lambda x: (jnp.arange(4) ** 2 + ((jnp.arange(4) << 1) & 3)).astype(float)[None] * x,
    "order of constants": lambda x: x[:, jnp.argsort(jnp.array([3, 1, 2, 0]))],
    "axes": lambda x: jax.vmap(lambda a: a * jnp.arange(3.0), 1, 1)(x),
}  # fmt: skip


@pytest.mark.parametrize("name", FUNCTIONS)
@pytest.mark.soak_of(
    but=[
        "order",
        "reshape",
        "set",
        "multiply",
        "slices",
        "triangle",
        "borders",
        "interpolation",
        "moves",
        "diagonals",
        "branches",
        "axes",
    ]
)
def test_options_are_heard(name):
    function = FUNCTIONS[name]
    slope = lambda x: jax.jacfwd(lambda x: jnp.ravel(function(x)))(x)
    value, jacobian = (np.asarray(jax.jit(f)(X)) for f in (function, slope))
    np.testing.assert_allclose(in_numpy(function, [X[None]], (function,))[0], value, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(in_numpy(slope, [X[None]], (function, 1))[0], jacobian, rtol=1e-11, atol=1e-11)
    entries = pattern_of(lambda u: jnp.ravel(function(u.reshape(X.shape))), X.ravel()).toarray()
    assert not np.any((jacobian.reshape(entries.shape) != 0.0) & ~entries)
