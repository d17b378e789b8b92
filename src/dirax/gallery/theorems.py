"""What the papers prove, measured: one row a theorem, by formulas in NumPy that use nothing of dirax but what it computed."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from dirax.text.tables import plain

HOLDS, FAILS = "holds", "DOES NOT HOLD"

COMPLEX_STEP = 1e-30
"""A complex step so small that the imaginary part of f(x + iε d)/ε is the derivative of an analytic f, to roundoff."""


@dataclass(frozen=True)
class Theorem:
    """One theorem: where it stands, what it says, and to how much it holds, relative to the terms that cancel.

    `limit` is what roundoff explains; `control` is the same number where the theorem must fail, NaN where nothing was tried:
    it holds where the first is at most `limit` and the second is far above it.
    """

    name: str
    says: str
    holds_to: float
    control: float = np.nan
    limit: float = 1e-12

    @property
    def verdict(self) -> str:
        """HOLDS, or FAILS."""
        told_apart = np.isnan(self.control) or self.control > 1e3 * self.limit
        return HOLDS if self.holds_to <= self.limit and told_apart else FAILS

    def to_dict(self) -> dict[str, Any]:
        """The row as plain Python values, fit for JSON."""
        names = ("name", "says", "holds_to", "control", "limit", "verdict")
        return plain({name: getattr(self, name) for name in names})

    @property
    def cells(self) -> tuple[str, str, str, str, str]:
        """The row of a printed table, under `HEADER`."""
        control = "" if np.isnan(self.control) else f"{self.control:.1e}"
        return self.name, self.says, f"{self.holds_to:.1e}", control, self.verdict


HEADER = ("theorem", "says", "holds to", "control", "verdict")


def largest(values: Any) -> float:
    """The largest absolute value; infinity where one is not a number."""
    size = np.abs(np.asarray(values, dtype=float))
    return float(np.max(size, initial=0.0)) if np.all(np.isfinite(size)) else np.inf


def derivative(function: Callable, x: np.ndarray, direction: np.ndarray) -> Any:
    """The derivative of an analytic function of NumPy's along a direction, by a complex step."""
    return np.imag(function(np.asarray(x) + 1j * COMPLEX_STEP * np.asarray(direction))) / COMPLEX_STEP


def gradient(function: Callable, x: np.ndarray) -> np.ndarray:
    """The derivatives along all coordinates, the last axis of the result."""
    return np.stack([derivative(function, x, direction) for direction in np.eye(np.size(x))], axis=-1)


def kernel(matrix: np.ndarray) -> np.ndarray:
    """An orthonormal basis, by columns, of the kernel of a matrix of full row rank."""
    return np.linalg.svd(matrix)[2][matrix.shape[0] :].T


def projector(basis: Sequence[Any] | np.ndarray) -> np.ndarray:
    """The orthogonal projector onto the span of independent columns, by which subspaces are compared."""
    basis = np.asarray(basis)
    return basis @ np.linalg.pinv(basis)
