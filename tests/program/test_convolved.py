"""Convolutions as scalar programs, against JAX, and where their derivatives have entries."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

import dirax as dx
from dirax.program.evaluation.functions import in_numpy
from dirax.program.sparsity import pattern_of

CASES = [
    dict(window_strides=(1,), padding="SAME"),
    dict(window_strides=(2,), padding=[(3, -1)], lhs_dilation=(3,), rhs_dilation=(2,)),
    dict(window_strides=(1,), padding="VALID", feature_group_count=2),
    dict(window_strides=(1,), padding="VALID", batch_group_count=2),
    dict(window_strides=(2, 1), padding=[(1, 2), (0, -1)], rhs_dilation=(1, 2)),
    dict(window_strides=(1, 1), padding="SAME", dimension_numbers=("NHWC", "HWIO", "NHWC")),
]


@pytest.mark.parametrize("case", CASES)
@pytest.mark.soak_of("case5")
def test_values_and_derivatives(case):
    two = len(case["window_strides"]) == 2
    channels = 4 if "feature_group_count" in case else 2
    left, right = (2, channels, *((6, 5) if two else (9,))), (4, 2, *((3, 2) if two else (3,)))
    if "dimension_numbers" in case:
        left, right = (2, 6, 5, 2), (3, 2, 2, 4)
    rng = np.random.default_rng(0)
    a, b = rng.normal(size=left), rng.normal(size=right)
    convolved = lambda a, b: lax.conv_general_dilated(a, b, **case)
    of_squares = lambda a, b: jax.grad(lambda a, b: jnp.sum(convolved(a, b) ** 2), (0, 1))(a, b)
    for function in (convolved, lambda a, b: jnp.concatenate([x.ravel() for x in of_squares(a, b)])):
        found = in_numpy(function, [a[None], b[None]], (function,))
        np.testing.assert_allclose(found[0], jax.jit(function)(a, b), rtol=1e-13, atol=1e-13)


def test_a_field_on_a_line():
    """A discrete wave equation by a convolution, natively, and its bands."""
    bend = lambda q: jnp.convolve(q, jnp.array([1.0, -2.0, 1.0]), mode="same")
    data = {"q": np.sin(np.arange(8.0)), "v": np.zeros(8), "step": 0.1, "steps": 20, "engine": "native"}
    string = lambda force: dx.LagrangeDirac(lambda q, v: v @ v / 2 + q @ force(q) / 2)
    run = lambda force: dx.simulate(string(force), dx.LagrangeDAlembert(), **data)
    padded = lambda q: jnp.pad(q, 1)
    np.testing.assert_allclose(run(bend).q, run(lambda q: padded(q)[2:] - 2.0 * q + padded(q)[:-2]).q, atol=1e-13)
    bands = pattern_of(bend, jnp.zeros(30)).toarray()
    assert np.array_equal(bands, np.abs(np.subtract.outer(np.arange(30), np.arange(30))) <= 1)
