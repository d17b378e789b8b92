"""What every engine owes to trajectories that fail (`dirax/engines/contract.py`), asked of each of them alike."""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dirax as dx
from dirax.engines.auto import Auto
from dirax.engines.contract import NOT_CONVERGED, NOT_FINITE, OK, Problem, cut, saved_steps
from dirax.engines.native import Native
from dirax.engines.sparse.engine import Sparse
from dirax.engines.xla import Xla
from dirax.schemes.step import Field, StepEquation
from engines.reference_engine import Reference

ENGINES: dict[str, dx.AbstractEngine] = {
    "native": Native(),
    "xla": Xla(),
    "plain": Xla(scalars="never"),
    "auto": Auto(),
    "sparse": Sparse(),
    "reference": Reference(),
}


def every(soak):
    """The engines, some of them only in the soak tests."""
    return [pytest.param(e, id=name, marks=[pytest.mark.soak] if name in soak else []) for name, e in ENGINES.items()]


EVERY = pytest.mark.parametrize("engine", every(soak=("plain",)))  # which runs small batches as "xla" does

H, DRIFT = 0.1, 0.2
EULER = StepEquation(  # backward Euler of ẋ = ⅕ + √(1 − x), whose step has no solution beyond 1
    start=lambda data, h, params: (data["x"], data["x"]),
    residual=lambda u, x, t, h, params: u - x - h * (DRIFT + jnp.sqrt(1 - u)),
    advance=lambda u, x, t, h, params: u,
    unpack=lambda x, u, t, h, params: {"x": x, "rate": (u - x) / h, "t": jnp.stack([t])},
    state_size=1,
    unknowns=1,
    fields={"x": Field((1,)), "rate": Field((1,), place="step"), "t": Field((1,))},
)


def exact(x: float, steps: int) -> np.ndarray:
    """The states of the trajectory from x as long as there are any: a quadratic equation for √(1 − u)."""
    rows = [x]
    while len(rows) <= steps and (left := 1 - rows[-1] - DRIFT * H) >= 0:
        rows.append(1 - ((np.sqrt(H * H + 4 * left) - H) / 2) ** 2)
    return np.array(rows)


HEALTHY, FAILING, AT_ONCE = (-9.0, -20.0, -15.0), (0.2, 0.8), 1.5
MIXED = [HEALTHY[0], FAILING[0], HEALTHY[1], AT_ONCE, HEALTHY[2], FAILING[1]]
SOUND = [0, 2, 4]


def euler(x: Any, steps: int = 20, **more) -> Problem:
    state = np.asarray(x, dtype=float)[..., None]
    return Problem(EULER, state, (state,), H, 0.5, steps, batch=len(state) if state.ndim == 2 else None, **more)


def assert_rows(fields: dict, lane: int, p: Problem, states: np.ndarray) -> None:
    """The rows of a trajectory whose states these are: as computed up to the end, NaN after it."""
    numbers, end = saved_steps(p).astype(int), len(states) - 1
    kept = numbers <= end
    np.testing.assert_allclose(fields["x"][lane, kept, 0], states[numbers[kept]], rtol=1e-13)
    np.testing.assert_allclose(fields["t"][lane, kept, 0], 0.5 + H * numbers[kept], rtol=1e-15)
    assert np.all(np.isnan(fields["x"][lane, ~kept])) and np.all(np.isnan(fields["t"][lane, ~kept]))
    leaving = numbers[:-1] < end  # the rows that a good step leaves
    rates = np.diff(states) / H
    np.testing.assert_allclose(fields["rate"][lane, leaving, 0], rates[numbers[:-1][leaving]], rtol=1e-11, atol=1e-12)
    assert np.all(np.isnan(fields["rate"][lane, ~leaving]))


@EVERY
@pytest.mark.parametrize("save_every", [1, 3])
@pytest.mark.soak_of(but=["3-native"])
def test_a_batch_in_which_some_fail(engine, save_every):
    p = euler(MIXED, save_every=save_every)
    outcome, states = engine.run(p), [exact(x, p.steps) for x in MIXED]
    ends = [len(s) - 1 for s in states]
    assert ends[3] == 0 and 0 < ends[5] < ends[1] < p.steps  # in the first step, and on the way
    assert outcome.completed.tolist() == ends and not outcome.interrupted
    assert outcome.status.tolist() == [OK if end == p.steps else NOT_FINITE for end in ends]
    assert np.all(outcome.iterations[SOUND] >= p.steps) and np.all(outcome.max_residual < 1e-13)
    for lane, s in enumerate(states):
        assert_rows(outcome.fields, lane, p, s)
        np.testing.assert_allclose(outcome.closing["x"][lane], s[-1:], rtol=1e-13)
        np.testing.assert_allclose(outcome.closing["t"][lane], 0.5 + H * ends[lane], rtol=1e-15)
        np.testing.assert_allclose(outcome.last_state[lane], s[-1:], rtol=1e-13)
        np.testing.assert_allclose(outcome.last_unknowns[lane], s[-1:], rtol=1e-13)


@EVERY
@pytest.mark.soak_of(but=["native"])
def test_neighbours_keep_their_bits(engine):
    mixed = engine.run(euler(MIXED, save_every=3))
    sound = engine.run(euler([HEALTHY[0], -3.0, HEALTHY[1], -4.0, HEALTHY[2], -5.0], save_every=3))
    for name in mixed.fields:
        assert mixed.fields[name][SOUND].tobytes() == sound.fields[name][SOUND].tobytes(), name
        assert mixed.closing[name][SOUND].tobytes() == sound.closing[name][SOUND].tobytes(), name


@EVERY
@pytest.mark.parametrize("x", [HEALTHY[0], FAILING[0], AT_ONCE])
@pytest.mark.soak_of("-9.0-xla", "-9.0-sparse", "0.2-xla", "0.2-auto", "0.2-sparse")
def test_one_trajectory_ends_with_its_last_good_row(engine, x):
    p = euler(x, save_every=3)
    outcome, states = engine.run(p), exact(x, p.steps)
    end = len(states) - 1
    assert outcome.completed.tolist() == [end]
    assert_rows(outcome.fields, 0, p, states)
    numbers, fields = cut(p, outcome)
    assert numbers.tolist() == sorted({*range(0, end + 1, 3), end})
    np.testing.assert_allclose(fields["x"][0, :, 0], states[numbers.astype(int)], rtol=1e-13)
    assert fields["rate"].shape == (1, len(numbers) - 1, 1) and np.all(np.isfinite(fields["rate"]))


@EVERY
@pytest.mark.soak_of(but=["native"])
def test_every_kind_of_failure_stays_in_its_lane(engine):
    """u₀² = c₀, c₁(u₁ − x₁) = 0: solvable, without a root, with a singular Jacobian, not a number, solvable."""
    equation = StepEquation(
        start=EULER.start,
        residual=lambda u, x, t, h, c: jnp.stack([u[0] ** 2 - c[0], c[1] * (u[1] - x[1])]),
        advance=EULER.advance,
        unpack=lambda x, u, t, h, c: {"x": x},
        state_size=2,
        unknowns=2,
        fields={"x": Field((2,))},
    )
    c = np.array([[4.0, 1.0], [-1.0, 1.0], [4.0, 0.0], [np.nan, 1.0], [9.0, 2.0]])
    state = np.array([[0.3, 1.0 + i] for i in range(5)])
    outcome = engine.run(Problem(equation, state, (state,), H, 0.0, 6, params=c, batch=5, batch_params=True))
    assert outcome.status.tolist() == [OK, NOT_CONVERGED, NOT_FINITE, NOT_FINITE, OK]
    assert outcome.completed.tolist() == [6, 0, 0, 0, 6]
    expected = [[2.0, 1.0], [0.3, 2.0], [0.3, 3.0], [0.3, 4.0], [3.0, 5.0]]
    np.testing.assert_allclose(outcome.last_state, expected, rtol=1e-15)
    np.testing.assert_allclose(outcome.closing["x"], expected, rtol=1e-15)


@EVERY
@pytest.mark.parametrize("batch", [False, True])
@pytest.mark.soak_of("False-reference", "True-xla", "True-sparse")
def test_an_interruption_keeps_what_was_computed(engine, batch):
    steps = 40_000
    x = [-1e12, -2e12] if batch else -1e12
    seen = []

    def stop(done, total):
        seen.append((done, total))
        raise KeyboardInterrupt

    p = euler(x, steps=steps, save_every=300)
    outcome = engine.run(p, stop)
    assert outcome.interrupted and np.all(outcome.status == OK)
    assert seen[0][1] == steps
    (done,) = set(outcome.completed.tolist())
    assert 0 < done < steps
    whole, rows = engine.run(euler(x, steps=done, save_every=300)), -(-done // 300)
    for name, values in outcome.fields.items():
        np.testing.assert_array_equal(values[:, :rows], whole.fields[name][:, :rows])
        first_after = done // 300 + 1 if p.is_node(name) else rows
        assert np.all(np.isnan(values[:, first_after:]))
        np.testing.assert_array_equal(outcome.closing["x"], whole.closing["x"])
    np.testing.assert_array_equal(outcome.last_state, whole.last_state)


def traced(engine, x, **more):
    """The fields, and how it ended, under a transformation."""
    state = x[:, None]
    outcome = engine.run_traced(Problem(EULER, state, (state,), H, 0.5, 20, batch=len(x), **more))
    return outcome.fields, outcome.completed, outcome.status


def assert_the_same(engine, save_every, fields, completed, status):
    outcome = engine.run(euler(MIXED, save_every=save_every))
    np.testing.assert_array_equal(completed, outcome.completed)
    np.testing.assert_array_equal(status, outcome.status)
    for name, values in outcome.fields.items():
        np.testing.assert_allclose(fields[name], values, rtol=1e-12, atol=1e-12)  # NaN where it has NaN


@EVERY
@pytest.mark.soak
def test_traced_runs_hold_the_same(engine):
    assert_the_same(engine, 1, *jax.jit(functools.partial(traced, engine))(jnp.array(MIXED)))


@pytest.mark.parametrize("engine", every(soak=("plain", "reference")))
@pytest.mark.soak_of(but=["native"])
def test_derivatives_are_those_of_the_good_steps(engine):
    """Of all rows that there are, of every third step, which hold the same as without JAX's transformations.

    With x = 1 − w² a step is w ↦ w', so that x' depends on x by w/(w' + h/2)·w'/w.
    """

    def total(x):
        fields, *ends = traced(engine, x, save_every=3)
        return jnp.sum(jnp.where(jnp.isnan(fields["x"]), 0.0, fields["x"])), (fields, *ends)

    slopes, found = jax.jit(jax.grad(total, has_aux=True))(jnp.array(MIXED))
    assert_the_same(engine, 3, *found)
    assert np.all(np.isfinite(slopes))
    for lane, x in enumerate(MIXED):
        states = exact(x, 20)
        roots, factor, expected = np.sqrt(1 - np.minimum(states, 1.0)), 1.0, 0.0
        for k in range(len(states)):
            factor *= roots[k] / (roots[k] + H / 2) if k else 1.0  # u − h√(1 − u) = x + h/5 differentiated
            expected += factor if k % 3 == 0 or k == 20 else 0.0
        assert slopes[lane] == pytest.approx(expected, rel=1e-10)


@pytest.mark.parametrize("engine", [Reference(), "native", "xla", Native(), Xla(scalars="never")])
@pytest.mark.soak_of(but=["native", "engine3"])
def test_simulate_takes_an_engine_or_its_name(engine):
    """An open gate: Kepler's problem by each, with a composition, against the others."""
    kepler = dx.LagrangeDirac(lambda q, v, k: v @ v / 2 + k / jnp.sqrt(q @ q))
    run = {"q": [1.0, 0.0], "v": [0.0, 1.1], "params": 1.0, "step": 0.05, "steps": 12, "save_every": 5}
    for scheme in (dx.LagrangeDAlembert(), dx.SymmetricComposition(dx.PlusLagrangeDirac())):
        sol = dx.simulate(kepler, scheme, **run, engine=engine)
        assert sol.ok and sol.stats["engine"] == getattr(engine, "name", engine)
        np.testing.assert_allclose(sol.q, dx.simulate(kepler, scheme, **run).q, rtol=1e-12, atol=1e-12)


def test_what_is_no_engine_is_refused():
    run = {"q": [1.0], "v": [0.0], "step": 0.1, "steps": 1}
    system = dx.LagrangeDirac(lambda q, v: (v @ v - q @ q) / 2)
    for wrong, error, words in (
        ("gpu", ValueError, "'auto', 'xla', 'native', 'sparse', or a dx.AbstractEngine, but 'gpu'"),
        (Native, TypeError, "the class Native itself was given: add parentheses"),
        (3, ValueError, "but 3 was given"),
    ):
        with pytest.raises(error, match=words):
            dx.simulate(system, dx.LagrangeDAlembert(), **run, engine=wrong)
    with pytest.raises(TypeError, match="linear_solver must be"):
        Xla(linear_solver=jnp.linalg.solve)
    with pytest.raises(ValueError, match="scalars must be"):
        Xla(scalars="always")
