"""The multistep method of the benchmarks, a scheme stated from outside."""

import jax.numpy as jnp
import numpy as np
import pytest
from benchmarks.multistep import ALPHA, AT_ONCE, Multistep, betas

import dirax as dx

FREQUENCIES = np.array([1.0, 0.7])
PUBLISHED = [90987349, -229596838, 812627169, -1628539944, 2714971338, -3041896548]
"""53222400 β_1, …, 53222400 β_6 of order 12 (Quinlan and Tremaine 1990)."""


def test_its_coefficients():
    """Those that were published; α has a double zero at 1 and simple ones on the circle."""
    found = np.array(betas())
    np.testing.assert_allclose(53222400 * found[:6], PUBLISHED, rtol=1e-14)
    np.testing.assert_array_equal(found, found[::-1])
    double, rest = np.polydiv(ALPHA, [1, -2, 1])
    assert not rest.any()
    zeros = np.roots(double)
    np.testing.assert_allclose(np.abs(zeros), 1.0, atol=1e-12)
    assert np.abs(zeros[:, None] - zeros + 10.0 * np.eye(len(zeros))).min() > 0.1


def errors(h):
    """The largest errors of q and p in seven periods of an oscillator with two frequencies, begun with exact positions."""
    positions = lambda t: np.cos(FREQUENCIES * t[:, None])
    momenta = lambda t: -FREQUENCIES * np.sin(FREQUENCIES * t[:, None])
    begun = h * np.arange(len(ALPHA) - 1)
    system = dx.LagrangeDirac(lambda q, v, params: (jnp.sum(v**2) - jnp.sum((FREQUENCIES * q) ** 2)) / 2)
    start = {"q": positions(begun)[-1], "p": momenta(begun)[-1], "params": positions(begun)}
    sol = dx.simulate(system, Multistep(), step=AT_ONCE * h, steps=round(44.0 / (AT_ONCE * h)), engine="native", **start)
    t = begun[-1] + sol.t
    return np.abs(sol.q - positions(t)).max(), np.abs(sol.p - momenta(t)).max()


def test_it_is_of_order_12():
    long, short = np.array(errors(0.12)), np.array(errors(0.1))
    assert np.all(short < 2e-13)
    assert np.log(long / short) / np.log(1.2) == pytest.approx(12.0, abs=0.5)
