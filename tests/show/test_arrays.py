"""Arrays of a page: nothing is lost but what is said to be."""

import base64
import zlib

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given

from dirax.show.arrays import DIGITS, KINDS, Arrays, rounded
from dirax.show.series import kept_rows

finite = st.floats(allow_nan=False, allow_infinity=False, width=32)


def read(arrays: Arrays, record: dict) -> np.ndarray:
    """What the page's script does, in NumPy."""
    kind = KINDS[record["kind"]]
    bytes_ = zlib.decompress(base64.b64decode(arrays.text()))[record["at"] :][: record["count"] * kind.itemsize]
    whole = np.frombuffer(bytes_, np.uint8).reshape(kind.itemsize, -1).T.copy().view(f"<u{kind.itemsize}").ravel()
    return (np.cumsum(whole, dtype=whole.dtype) if record["delta"] else whole).view(kind)


@given(st.lists(st.lists(finite, min_size=1, max_size=20), min_size=1, max_size=4), st.sampled_from(sorted(KINDS)))
@pytest.mark.soak
def test_every_bit_comes_back(vectors, kind):
    arrays = Arrays()
    given = [np.array(v).astype(KINDS[kind]) if kind[0] == "f" else np.arange(len(v)).astype(KINDS[kind])[::-1] for v in vectors]
    records = [arrays.add(v, kind) for v in given]
    for vector, record in zip(given, records, strict=True):
        np.testing.assert_array_equal(read(arrays, record), vector)


def test_smooth_arrays_are_stored_by_their_differences():
    arrays = Arrays()
    record = arrays.add(np.sin(np.arange(2000) * 1e-3))
    assert record["delta"]
    assert len(arrays.text()) < 0.9 * 4 / 3 * 8 * 2000


def test_only_vectors_are_taken():
    with pytest.raises(ValueError, match=r"shape \(2, 2\)"):
        Arrays().add(np.zeros((2, 2)))


@given(st.floats(min_value=1e-30, max_value=1e30) | st.floats(min_value=-1e30, max_value=-1e-30))
def test_rounded_numbers_print_as_the_exact_ones(x):
    assert f"{float(rounded(np.array([x]))[0]):.{DIGITS}g}" == f"{x:.{DIGITS}g}"


def test_thinning_keeps_the_extremum_of_every_piece(rng=np.random.default_rng(0)):
    values = rng.normal(size=(50_000, 3))
    values[31_234, 1], values[17, 2] = 40.0, -40.0
    values[40_000:, 0] = np.nan
    kept = kept_rows(values, 3000)
    assert kept is not None and len(kept) < 4000
    assert {0, 31_234, 17, 49_999} <= set(kept.tolist())
    np.testing.assert_array_equal(np.nanmax(values[kept], axis=0), np.nanmax(values, axis=0))
    np.testing.assert_array_equal(np.nanmin(values[kept], axis=0), np.nanmin(values, axis=0))
    for piece in range(20):  # and of every piece of time, not only of the whole
        rows = np.arange(2500 * piece, 2500 * (piece + 1))
        inside = np.intersect1d(rows, kept)
        assert values[inside, 1].max() == values[rows, 1].max()


def test_short_tables_are_kept_whole():
    assert kept_rows(np.zeros((100, 2)), 100) is None
