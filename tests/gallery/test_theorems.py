"""The rows of theorems in `dirax reproduce`: all hold, and a row that must not is told."""

from importlib import import_module

import numpy as np
import pytest

from dirax.gallery.reproduction import Reproduction
from dirax.gallery.theorem_numbers import derivative, kernel
from dirax.gallery.theorems import FAILS, HOLDS, Theorem


@pytest.mark.parametrize(("paper", "rows"), [("peng_yoshimura", 8), ("rodriguez_leok", 13), ("barbero_linan", 11)])
def test_the_theorems_of_a_paper_hold(paper, rows):
    found = import_module(f"dirax.gallery.{paper}_theorems").theorems()
    assert len(found) >= rows and len({row.name for row in found}) == len(found)
    assert [row.name for row in found if row.verdict != HOLDS] == []
    assert max(row.holds_to for row in found) < 1e-13


def test_what_does_not_hold_is_told():
    assert Theorem("a", "b", 1e-6).verdict == Theorem("a", "b", np.inf).verdict == FAILS
    assert Theorem("a", "b", np.nan).verdict == FAILS
    assert Theorem("a", "b", 1e-16, 1e-15).verdict == FAILS  # a control that holds as well says nothing
    assert Theorem("a", "b", 1e-16, 1e-3).verdict == HOLDS
    good, bad = (Reproduction("PY", "a paper", (), {}, (Theorem("T 1", "says", size),)) for size in (1e-16, 1e-3))
    assert good.ok and not bad.ok and "holds to" in str(good) and "1.0e-03" in str(bad)
    assert bad.to_dict()["theorems"][0]["verdict"] == FAILS


def test_its_numerics():
    """A complex step against a derivative by hand; a kernel."""
    x, v = np.array([0.3, 0.7]), np.array([1.0, -2.0])
    exact = np.cos(0.3 * 0.7) * (0.7 * v[0] + 0.3 * v[1])
    assert abs(derivative(lambda x: np.sin(x[0] * x[1]), x, v) - exact) < 1e-16
    row = np.array([[1.0, 2.0, 3.0]])
    assert np.abs(row @ kernel(row)).max() < 1e-15 and kernel(row).shape == (3, 2)
