"""Roots in brackets, many at once."""

import numpy as np

from dirax.numerics.brackets import bracketed_roots


def test_roots_are_found_to_the_last_digits_however_flat_the_function_is():
    roots = np.array([0.3, 0.5, 1e-9, 0.9, 0.25, 1.0])
    powers = np.array([1, 3, 1, 7, 1, 1])
    scales = np.array([1e-200, 1.0, 1e200, 1.0, -1.0, 1.0])

    def function(x, which):
        return scales[which] * np.sign(x - roots[which]) * np.abs(x - roots[which]) ** powers[which]

    which = np.arange(6)
    a, b = np.zeros(6), np.ones(6)
    found = bracketed_roots(function, a, b, function(a, which), function(b, which))
    assert np.max(np.abs(found - roots)) <= 2e-15


def test_no_brackets_have_no_roots():
    none = np.zeros(0)
    assert bracketed_roots(lambda x, which: x, none, none, none, none).shape == (0,)
