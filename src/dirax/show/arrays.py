"""Arrays for a page: one compressed block for all of them, in base64.

Neighbouring numbers of a trajectory are alike: an array is stored by the differences of its bit patterns, first bytes first,
and then deflated; browsers inflate by themselves. Differences of integers lose nothing.
"""

import base64
import zlib
from typing import Any

import numpy as np

KINDS = {"f8": np.dtype("<f8"), "f4": np.dtype("<f4"), "u4": np.dtype("<u4"), "i2": np.dtype("<i2")}
"""Types of elements, by the names that the page knows them by."""

DIGITS = 6
"""Significant digits that an array of float32 keeps: it holds numbers rounded to them, which print as the exact ones do."""


class Arrays:
    """Arrays collected for one page: `add` gives the record by which the page finds one."""

    def __init__(self):
        self._parts: list[bytes] = []
        self.size = 0
        """Bytes before compression."""

    def add(self, values: Any, kind: str = "f8") -> dict[str, Any]:
        """Take a vector, and return {kind, at, count, delta}: where its bytes are and how they were written."""
        array = np.ascontiguousarray(values, KINDS[kind])
        if array.ndim != 1:
            raise ValueError(f"one vector at a time is stored, but an array of shape {array.shape} was given.")
        written, delta = _written(array)
        record = {"kind": kind, "at": self.size, "count": len(array), "delta": delta}
        self._parts.append(written)
        self.size += len(written)
        return record

    def text(self) -> str:
        """All arrays, deflated, in base64."""
        return base64.b64encode(zlib.compress(b"".join(self._parts), 9)).decode("ascii")


def _written(array: np.ndarray) -> tuple[bytes, bool]:
    """Bytes of the same significance side by side, of the array or of its differences, whichever deflates better."""
    whole = array.view(f"<u{array.itemsize}")
    changes = np.concatenate([whole[:1], whole[1:] - whole[:-1]])
    plain, delta = (np.ascontiguousarray(a.view(np.uint8).reshape(-1, a.itemsize).T).tobytes() for a in (whole, changes))
    smaller = len(zlib.compress(delta, 1)) < len(zlib.compress(plain, 1))
    return (delta, True) if smaller else (plain, False)


def rounded(values: np.ndarray, digits: int = DIGITS) -> np.ndarray:
    """The values as float32, each rounded to so many significant digits before."""
    values = np.asarray(values, float)
    text = np.char.mod(f"%.{digits - 1}e", values.ravel())
    return text.astype(np.float64).reshape(values.shape).astype(np.float32)
