"""A few of the systems of `make fuzz`, and that the fuzz finds what is wrong."""

import numpy as np
import pytest

import dirax as dx
from fuzz import examine as fuzz
from fuzz.systems import Kind, RandomSystem

CASES = [(1, "collocation"), (2, "plus"), (3, "suzuki4")]


@pytest.mark.parametrize(("seed", "name"), CASES)
def test_nothing_is_wrong(seed, name):
    system, params, start = fuzz.random_case(seed)
    assert fuzz.examine(system, name, params, start) == []


def test_also_in_batches_on_the_other_engine_and_in_derivatives():
    system, params, start = fuzz.random_case(1)
    assert fuzz.examine(system, "midpoint", params, start, deep=True) == []


def test_a_wrong_order_is_found(monkeypatch):
    """Of a system alone, and of each of a batch."""
    cases = {seed: fuzz.random_case(seed)[1:] for seed in (1, 13)}
    system, params, start = fuzz.random_case(1)
    assert fuzz.examine_together(system, "plus", cases) == {1: [], 13: []}
    monkeypatch.setitem(fuzz.SCHEMES, "plus", fuzz.Promise(dx.PlusLagrangeDirac(), 2))
    assert any("order: q" in what for what in fuzz.examine(system, "plus", params, start))
    assert all("order: q" in wrong[0] for wrong in fuzz.examine_together(system, "plus", cases).values())


@pytest.mark.soak
@pytest.mark.parametrize("seed", range(24))
def test_every_kind_by_every_scheme(seed):
    system, params, start = fuzz.random_case(seed, kinds=24)
    wrong = {name: fuzz.examine(system, name, params, start, deep=True) for name in fuzz.SCHEMES}
    assert {name: w for name, w in wrong.items() if w and not w[0].startswith("refused")} == {}


def test_initial_data_satisfy_the_constraints():
    system = RandomSystem(Kind(4, m=1, c=1, affine=True, moving=True))
    params, start = system.parameters(np.random.default_rng(0))
    rows, rest = map(np.asarray, system.velocity_rows(0.0, start["q"], params))
    assert np.max(np.abs(rows @ start["v"] + rest)) < 1e-14
    assert abs(float(system.position(0.0, start["q"], params)[0])) < 1e-14
