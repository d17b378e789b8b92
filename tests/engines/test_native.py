"""The native engine against the xla engine, and its own promises: determinism, failures, caches."""

import dataclasses
import os
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import dirax as dx
from dirax.engines import policy, step_program
from dirax.engines.contract import NOT_CONVERGED, NOT_FINITE, OK, Problem
from dirax.engines.native import Native, at_once, shared
from dirax.engines.native import kernels as of_steps
from dirax.engines.native import run as driver
from dirax.engines.native.ir.emitter import LONG, Body, Emitter, Module
from dirax.engines.native.ir.lower import Region
from dirax.engines.native.kernels import QUICK, SOON, kernels
from dirax.engines.native.loops.sizes import sizes_module
from dirax.engines.native.loops.step_loop import kernel_module
from dirax.engines.steps_in_numbers import StepsInNumbers
from dirax.engines.xla import Xla
from dirax.program import machine_code as llvm
from dirax.program.graph import Graph
from dirax.program.interpreter import UnsupportedPrimitive
from dirax.schemes.step import Field, Shape, StepEquation, StepSequence, make_step_equation

native, xla = Native(), Xla()


@pytest.fixture(autouse=True)
def _kernels_in_a_folder_of_their_own(tmp_path_factory, monkeypatch):
    monkeypatch.setenv("DIRAX_CACHE", str(tmp_path_factory.getbasetemp() / "kernels"))


def planar_pendulums(q, v):
    cross = v[0] * v[1] * jnp.cos(q[0] - q[1])
    return v[0] ** 2 + v[1] ** 2 / 2 + cross + 2 * 9.81 * jnp.cos(q[0]) + 9.81 * jnp.cos(q[1])


def rolling_disk(q, v):
    return (v[0] ** 2 + v[1] ** 2) / 2 + v[2] ** 2 / 8 + v[3] ** 2 / 4 - 10 * jnp.sin(q[2])


def rolling(q):
    return jnp.array([[1.0, 0.0, -jnp.cos(q[3]), 0.0], [0.0, 1.0, -jnp.sin(q[3]), 0.0]])


MIDPOINT = dx.LagrangeDAlembert()
DISK = ([0.0, 0.0, 0.0, np.pi / 3], [5.0, 75**0.5, 10.0, 1.0])
SYSTEMS = {  # name: Lagrangian, one-forms, scheme, q, v, h, steps, growth of roundoff
    "harmonic oscillator": (lambda q, v: (v @ v - q @ q) / 2, None, MIDPOINT, [1.0, 0.0], [0.0, 0.5], 0.01, 1000, 1e-12),
    "planar double pendulum": (planar_pendulums, None, MIDPOINT, [1.0, 0.5], [0.0, 0.5], 0.005, 400, 1e-11),
    "Kepler": (lambda q, v: v @ v / 2 + 1 / jnp.sqrt(q @ q), None, MIDPOINT, [1.0, 0.0], [0.0, 1.1], 0.01, 1000, 1e-11),
    "Hénon–Heiles": (
        lambda q, v: (v @ v - q @ q) / 2 - q[0] ** 2 * q[1] + q[1] ** 3 / 3,
        None, dx.LagrangeDAlembert("trapezoidal"), [0.1, 0.1], [0.3, 0.1], 0.05, 1000, 1e-11,
    ),
    "rolling disk, plus": (rolling_disk, rolling, dx.PlusLagrangeDirac(), *DISK, 0.001, 600, 1e-11),
    "rolling disk, minus": (rolling_disk, rolling, dx.MinusLagrangeDirac(), *DISK, 0.001, 600, 1e-11),
    "rolling disk, midpoint": (rolling_disk, rolling, MIDPOINT, *DISK, 0.001, 600, 1e-11),
    "Heisenberg": (
        lambda q, v: v @ v / 2, lambda q: jnp.array([[-q[1], q[0], 1.0]]),
        dx.PlusLagrangeDirac(), [1.0, 0.0, 0.1], [5.0, 10.0, -10.0], 0.01, 600, 1e-10,
    ),
}  # fmt: skip


def problem(name: str, **changes) -> Problem:
    lagrangian, one_forms, scheme, q, v, h, steps, _ = SYSTEMS[name]
    q, v = jnp.asarray(q), jnp.asarray(v)
    m = 0 if one_forms is None else one_forms(q).shape[0]
    equation = make_step_equation(scheme, dx.LagrangeDirac(lagrangian, one_forms), Shape(len(q), m))
    p = jax.grad(lagrangian, argnums=1)(q, v)
    first_alone = np.zeros(equation.state_size - 2 * len(q))  # what the first state has beyond (q, p)
    state, guess = np.concatenate([q, p, first_alone]), np.concatenate([v, np.zeros(m)])
    return dataclasses.replace(Problem(equation, state, (guess,), h, 0.0, steps, save_every=7), **changes)


def spread(p: Problem, size: int) -> Problem:
    """A batch around the initial state."""
    rng = np.random.default_rng(5)
    state = np.asarray(p.state) * (1 + 0.01 * rng.standard_normal((size, len(p.state))))
    guesses = tuple(np.tile(np.asarray(g), (size, 1)) for g in p.guess)
    return dataclasses.replace(p, state=state, guess=guesses, batch=size)


def assert_close(a, b, tolerance: float) -> None:
    assert a.fields.keys() == b.fields.keys()
    for name, values in a.fields.items():
        other = np.asarray(b.fields[name])
        assert values.shape == other.shape, name
        np.testing.assert_allclose(values, other, rtol=tolerance, atol=tolerance * max(1.0, np.nanmax(np.abs(other), initial=0)))


def assert_same_bits(a, b, rows_a=slice(None), rows_b=slice(None)) -> None:
    for mine, other in ((a.fields, b.fields), (a.closing, b.closing)):
        for name in mine:
            assert mine[name][rows_a].tobytes() == other[name][rows_b].tobytes(), name
    for name in ("completed", "status", "iterations", "max_residual", "last_state", "last_unknowns"):
        assert getattr(a, name)[rows_a].tobytes() == getattr(b, name)[rows_b].tobytes(), name


@pytest.mark.parametrize("name", SYSTEMS)
@pytest.mark.soak_of(but=["harmonic oscillator"])
def test_both_engines_agree_to_roundoff_growth(name):
    p, growth = problem(name), SYSTEMS[name][-1]
    mine, theirs = native.run(p), xla.run(p)
    assert_close(mine, theirs, growth)
    assert mine.status[0] == OK and mine.completed[0] == p.steps
    assert abs(int(mine.iterations[0]) - int(theirs.iterations[0])) <= 0.02 * p.steps
    np.testing.assert_allclose(mine.last_state, theirs.last_state, rtol=growth, atol=growth)
    assert mine.engine == "native" and mine.notes["unknowns"] == p.equation.unknowns and mine.notes["operations"] > 10


@pytest.mark.parametrize("name", ["planar double pendulum", "rolling disk, midpoint"])
@pytest.mark.soak_of("rolling disk, midpoint")
def test_bits_do_not_depend_on_batch_lane_width_threads_or_repetition(name, monkeypatch):
    batch = spread(problem(name, steps=60), 11)
    monkeypatch.setattr(driver, "WORTH_THREADS", 0.0)
    monkeypatch.setattr(driver, "FIRST_CHUNK", 20 * 11)
    whole = native.run(batch)
    assert np.all(whole.status == OK)
    assert_same_bits(whole, native.run(batch))
    for threads in ("1", "3"):
        monkeypatch.setenv("DIRAX_THREADS", threads)
        assert_same_bits(whole, native.run(batch))
    part = lambda lanes: dataclasses.replace(
        batch, state=batch.state[lanes], guess=(batch.guess[0][lanes],), batch=len(batch.state[lanes])
    )
    order = np.random.default_rng(1).permutation(11)
    assert_same_bits(native.run(part(order)), whole, rows_b=order)
    for lanes in (slice(0, 1), slice(3, 5), slice(2, 6), slice(0, 8)):  # 1, 2, 4 and 8 wide where the processor is
        assert_same_bits(native.run(part(lanes)), whole, rows_b=lanes)
    alone = dataclasses.replace(batch, state=batch.state[4], guess=(batch.guess[0][4],), batch=None)
    assert_same_bits(native.run(alone), whole, rows_b=slice(4, 5))


def test_a_chunk_boundary_leaves_no_trace(monkeypatch):
    p = problem("planar double pendulum")
    whole = native.run(p)
    monkeypatch.setattr(driver, "FIRST_CHUNK", 1)
    monkeypatch.setattr(driver, "CHUNK_SECONDS", 1e-9)
    calls = []
    assert_same_bits(native.run(p, lambda done, total: calls.append((done, total))), whole)
    assert calls == [(i + 1, p.steps) for i in range(p.steps)]


def implicit(residual, advance=lambda u, state, t, h, params: u, size=1, **more) -> StepEquation:
    return StepEquation(
        start=lambda data, h, params: (data["x"], data["x"]),
        residual=residual,
        advance=advance,
        unpack=lambda state, u, t, h, params: {"x": state},
        state_size=size,
        unknowns=size,
        fields={"x": Field((size,))},
        **more,
    )


def small(equation, state, h=0.1, steps=20, **more) -> Problem:
    state = np.asarray(state, dtype=float)
    guess = tuple(state[..., : stage.unknowns] for stage, _ in equation.stages)
    return Problem(equation, state, guess, h, 0.0, steps, batch=len(state) if state.ndim == 2 else None, **more)


@pytest.mark.soak
def test_failing_lanes_stop_at_their_last_good_step_and_the_others_go_on():
    # backward Euler of ẋ = √(1 − x) + drift: NaN beyond 1
    equation = implicit(lambda u, x, t, h, params: u - x - h * (0.2 + jnp.sqrt(1 - u)))
    p = small(equation, [[-9.0], [0.2], [-20.0], [0.8], [-15.0]], save_every=3)
    mine, theirs = native.run(p), xla.run(p)
    assert mine.status.tolist() == np.asarray(theirs.status).tolist()
    assert set(mine.status.tolist()) == {OK, NOT_FINITE}
    assert mine.completed.tolist() == np.asarray(theirs.completed).tolist()
    np.testing.assert_allclose(mine.last_state, theirs.last_state, rtol=1e-13)
    np.testing.assert_allclose(mine.closing["x"], theirs.closing["x"], rtol=1e-13)
    reached = mine.completed[:, None] >= np.minimum(np.arange(p.rows) * p.save_every, p.steps)
    np.testing.assert_allclose(mine.fields["x"][reached], np.asarray(theirs.fields["x"])[reached], rtol=1e-13)
    alone = native.run(dataclasses.replace(p, state=p.state[1], guess=(p.guess[0][1],), batch=None))
    assert alone.completed[0] == mine.completed[1] and alone.last_state.tobytes() == mine.last_state[1:2].tobytes()


def test_iteration_cap_and_singular_jacobian():
    no_root = implicit(lambda u, x, t, h, params: u**2 + 1 + x)
    outcome = native.run(small(no_root, [0.3]))
    assert outcome.status[0] == NOT_CONVERGED and outcome.completed[0] == 0 and outcome.iterations[0] == 50
    assert outcome.fields["x"][0, 0, 0] == 0.3
    singular = implicit(lambda u, x, t, h, params: jnp.stack([u[0] + u[1], u[0] + u[1]]) - x, size=2)
    outcome = native.run(small(singular, [1.0, 2.0]))
    assert outcome.status[0] == NOT_FINITE and outcome.completed[0] == 0


def test_small_pivots_are_exchanged_at_run_time():
    """A fixed order cannot be right for both lanes: the matrix is [[s, 1], [1, s]] with s = 1e-20 and 1e20."""

    def residual(u, x, t, h, params):
        s = jnp.exp(params)
        return jnp.stack([s * u[0] + u[1] + u[0] ** 3 * 1e-3, u[0] + s * u[1]]) - x

    s = np.log([1e-20, 1e20, 1.5])
    p = small(implicit(residual, size=2), [[1.0, 2.0]] * 3, steps=1, params=s, batch_params=True)
    outcome = native.run(p)
    assert np.all(outcome.status == OK)
    for lane in range(3):
        u = outcome.fields["x"][lane, 1]
        scale = np.exp(s[lane])
        matrix = np.array([[scale, 1.0], [1.0, scale]])
        left = matrix @ u + [u[0] ** 3 * 1e-3, 0.0] - [1.0, 2.0]
        assert np.all(np.abs(left) <= 1e-14 * (np.abs(matrix) @ np.abs(u) + 3))


def test_explicit_methods_time_and_parameters():
    """Explicit midpoint of ẋ = a cos(ω t) x against the closed form."""

    def advance(u, x, t, h, params):
        slope = lambda x, t: params["a"] * jnp.cos(params["w"] * t) * x
        return x + h * slope(x + h / 2 * slope(x, t), t + h / 2)

    equation = StepEquation(
        start=lambda data, h, params: (data["x"], jnp.zeros(0)),
        residual=lambda u, x, t, h, params: jnp.zeros(0),
        advance=advance,
        unpack=lambda x, u, t, h, params: {"x": x, "t": t},
        state_size=1,
        unknowns=0,
        fields={"x": Field((1,)), "t": Field(())},
    )
    params = {"a": np.array([0.5, 1.0, -0.3]), "w": np.array([1.0, 2.0, 3.0]), "whole": np.array([1, 2, 3])}
    p = Problem(
        equation, np.ones((3, 1)), (np.zeros((3, 0)),), 1e-3, 0.5, 2000, 100, first_step=1,
        params=params, batch=3, batch_params=True,
    )  # fmt: skip
    outcome = native.run(p)
    t = 0.5 + 1e-3 * (1 + np.minimum(np.arange(p.rows) * 100, 2000))
    np.testing.assert_allclose(outcome.fields["t"], np.tile(t, (3, 1)), rtol=1e-14)
    a, w = params["a"][:, None], params["w"][:, None]
    exact = np.exp(a / w * (np.sin(w * t) - np.sin(w * t[0])))
    np.testing.assert_allclose(outcome.fields["x"][..., 0], exact, atol=2e-6)
    one = dataclasses.replace(
        p, state=p.state[1], guess=(p.guess[0][1],), params={k: v[1] for k, v in params.items()}, batch=None, batch_params=False
    )
    assert native.run(one).fields["x"].tobytes() == outcome.fields["x"][1:2].tobytes()


@pytest.mark.soak
def test_sequences_of_equations_agree_with_xla():
    """Euler forward and backward in turn, and Suzuki's five stages of one equation."""
    force = lambda x, t: jnp.stack([x[1], -jnp.sin(x[0]) + 0.1 * jnp.cos(t)])
    backward = implicit(lambda u, x, t, h, params: u - x - h * force(u, t + h), size=2)
    forward = StepEquation(
        start=lambda data, h, params: (data["x"], jnp.zeros(0)),
        residual=lambda u, x, t, h, params: jnp.zeros(0),
        advance=lambda u, x, t, h, params: x + h * force(x, t),
        unpack=lambda x, u, t, h, params: {"x": x},
        state_size=2, unknowns=0, fields={"x": Field((2,))},
    )  # fmt: skip
    middle = implicit(lambda u, x, t, h, params: u - x - h * force((u + x) / 2, t + h / 2), size=2)
    s = 1 / (4 - 4 ** (1 / 3))
    for equation in (
        StepSequence(((forward, 0.5), (backward, 0.5))),
        StepSequence(tuple((middle, f) for f in (s, s, 1 - 4 * s, s, s))),
    ):
        p = small(equation, [[0.3, 0.0], [1.0, 0.5], [2.0, -0.1]], steps=50, save_every=4)
        mine, theirs = native.run(p), xla.run(p)
        assert_close(mine, theirs, 1e-12)
        assert np.all(mine.status == OK)
        alone = dataclasses.replace(p, state=p.state[2], guess=tuple(g[2] for g in p.guess), batch=None)
        assert_same_bits(native.run(alone), mine, rows_b=slice(2, 3))


@settings(max_examples=2, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(1, 5))
@pytest.mark.soak
def test_random_equations_agree_with_xla(seed, size):
    rng = np.random.default_rng(seed)
    a, b, c = rng.standard_normal((3, size, size)) / np.sqrt(size)
    kinds = rng.integers(0, 4, size)
    functions = (jnp.sin, jnp.tanh, lambda x: x / (1 + x * x), lambda x: jnp.where(x > 0, x, jnp.expm1(x)))

    def field(x, t):
        y = b @ x + jnp.cos(t)
        return a @ jnp.stack([functions[k](y[i]) for i, k in enumerate(kinds)]) + 0.1 * (c @ x)

    equation = implicit(lambda u, x, t, h, params: u - x - h * field((u + x) / 2, t + h / 2), size=size)
    p = small(equation, rng.standard_normal((2, size)), steps=30)
    mine, theirs = native.run(p), xla.run(p)
    assert mine.status.tolist() == [OK, OK]
    assert_close(mine, theirs, 1e-11)


def test_an_interruption_keeps_what_was_computed(monkeypatch):
    monkeypatch.setattr(driver, "FIRST_CHUNK", 100)

    def interrupt(done, total):
        raise KeyboardInterrupt

    p = problem("Kepler")
    outcome, whole = native.run(p, interrupt), native.run(p)
    assert outcome.interrupted and outcome.completed.tolist() == [100] and outcome.status.tolist() == [OK]
    rows = 100 // p.save_every + 1
    assert outcome.fields["q"][:, :rows].tobytes() == whole.fields["q"][:, :rows].tobytes()
    assert np.all(np.isnan(outcome.fields["q"][:, rows:]))
    np.testing.assert_array_equal(outcome.closing["q"], outcome.last_state[:, :2])


@pytest.mark.soak
def test_code_of_few_operations_is_quick_from_the_beginning(monkeypatch):
    monkeypatch.setenv("DIRAX_CACHE", "off")
    levels = compiled_levels(monkeypatch)
    for few, level in ((1000, QUICK), (10, SOON)):
        monkeypatch.setattr(of_steps, "FEW", few)
        dx.clear_caches()
        native.run(problem("rolling disk, midpoint", steps=2))
        assert levels.pop(0) == level
        levels.clear()


def test_kernels_are_cached_on_disk_and_damaged_entries_are_made_again(tmp_path, monkeypatch):
    monkeypatch.setenv("DIRAX_CACHE", str(tmp_path))
    p = problem("Hénon–Heiles", steps=30)
    forget = dx.clear_caches
    forget()
    first = native.run(p)
    (entry,) = (path for path in (tmp_path / "kernels").iterdir() if path.name != ".key")  # a second run adds that of sizes
    assert not first.notes["kernel_cached"] and native.run(p).notes["kernel_cached"]
    forget()
    again = native.run(p)
    assert again.notes["kernel_cached"] and again.notes["operations"] == first.notes["operations"]
    assert_same_bits(again, first)
    good = entry.read_bytes()
    for damaged in (good[:-1], good[:40] + b"\0" + good[41:], b""):
        entry.write_bytes(damaged)
        forget()
        redone = native.run(p)
        assert not redone.notes["kernel_cached"] and entry.read_bytes() == good
        assert_same_bits(redone, first)
    monkeypatch.setenv("DIRAX_CACHE", "off")
    forget()
    assert not native.run(p).notes["kernel_cached"]


@pytest.mark.parametrize("name", ["rolling disk, midpoint", "Hénon–Heiles"])
@pytest.mark.parametrize("size", [None, 11])
@pytest.mark.soak_of("None-rolling disk, midpoint", "11-rolling disk, midpoint")
def test_code_that_is_ready_soon_has_the_bits_of_quick_code(name, size, monkeypatch):
    monkeypatch.setenv("DIRAX_CACHE", "off")
    levels = compiled_levels(monkeypatch)
    p = problem(name, steps=40) if size is None else spread(problem(name, steps=40), size)
    dx.clear_caches()
    soon = native.run(p)
    dx.clear_caches()
    quick = native.run(p.with_numbers(often=True))
    assert levels == [SOON, QUICK, SOON]  # the last one is that of the sizes
    assert_same_bits(soon, quick)


def test_quick_code_is_compiled_once_it_pays(tmp_path, monkeypatch):
    """After runs that took long together, or in one; what is quick and on the disk is taken for a few steps as well."""
    monkeypatch.setenv("DIRAX_CACHE", str(tmp_path))
    monkeypatch.setattr(of_steps, "SIZING", 1e9)
    levels, p = compiled_levels(monkeypatch), problem("harmonic oscillator", steps=60)
    dx.clear_caches()
    run = native.prepared(p)
    first = run(p)
    monkeypatch.setattr(of_steps, "PRICE", 1e-12)
    second, third = run(p), run(p)
    assert levels == [SOON, QUICK]
    assert [o.notes["kernel_cached"] for o in (first, second, third)] == [False, False, True]
    assert second.compile_seconds > 0.0 == third.compile_seconds
    assert_same_bits(first, second)
    dx.clear_caches()
    assert native.run(p).notes["kernel_cached"] and levels == [SOON, QUICK]
    dx.clear_caches()
    monkeypatch.setenv("DIRAX_CACHE", "off")
    monkeypatch.setattr(driver, "FIRST_CHUNK", 20)  # in the midst of a run
    midst = native.run(p)
    assert_same_bits(first, midst)
    assert levels[2:] == [SOON, QUICK] and midst.compile_seconds > midst.run_seconds > 0.0
    dx.clear_caches()
    monkeypatch.setattr(of_steps, "MANY", 100)
    native.run(p.with_numbers(steps=101))
    lagrangian, _, scheme, q, v, h, *_ = SYSTEMS["harmonic oscillator"]
    dx.prepare(dx.LagrangeDirac(lagrangian), scheme, q=q, v=v, step=h, steps=1)
    assert levels[4:] == [QUICK, QUICK, SOON]


def test_the_kernel_of_sizes_is_counted_among_what_is_compiled(monkeypatch):
    """It is compiled once runs have spent a part of what that takes, by the operations that the step really has."""
    monkeypatch.setenv("DIRAX_CACHE", "off")
    monkeypatch.setattr(of_steps, "PRICE", 1e9)
    p = problem("planar double pendulum", steps=20)
    dx.clear_caches()
    run = native.prepared(p)
    run(p)
    made = kernels(p.equation, p.params, p.batch_params)
    made.sizing = 0.9 * of_steps.SIZING * made.operations
    assert made.of_sizes(1) == (None, True)
    made.sizing = 1.1 * of_steps.SIZING * made.operations
    second, third = run(p), run(p)
    assert second.compile_seconds > 0.0 == third.compile_seconds
    assert_same_bits(second, third)


@pytest.mark.soak
def test_a_step_near_the_limit_of_nodes_has_its_sizes_and_derivatives(monkeypatch):
    """The nodes that these need beside the step's own are not counted: whatever is asked of it after the first run is found."""
    system = dx.LagrangeDirac(lambda q, v, params: params * (v @ v) / 2 - params * jnp.sum(jnp.cos(q)) - q[0] * q[1])
    given = {"q": [1.0, 0.5], "v": [0.0, 0.5], "step": 0.01, "steps": 20}
    run = lambda k, **more: dx.simulate(system, MIDPOINT, params=k, **given | more)
    dx.clear_caches()
    nodes: dict[of_steps.Kernels, int] = {}
    planned = of_steps.Kernels._planned
    with_its_nodes = lambda self: nodes.setdefault(self, len(planned(self).graph)) and planned(self)
    monkeypatch.setattr(of_steps.Kernels, "_planned", with_its_nodes)
    monkeypatch.setenv("DIRAX_CACHE", "off")
    free = run(1.5), jax.grad(lambda k: jnp.sum(run(k).q ** 2))(1.5)
    monkeypatch.setattr(step_program, "NODE_LIMIT", max(nodes.values()))
    monkeypatch.setattr(policy, "MOST_TRACED", 0)
    monkeypatch.setattr(of_steps, "SIZING", 0.0)
    dx.clear_caches()
    for k in (1.0, 1.1, 1.2):
        assert run(k).stats["engine"] == "native"
    assert run(1.5).q.tobytes() == free[0].q.tobytes()
    prepared = dx.prepare(system, MIDPOINT, params=1.0, **given)
    assert prepared(params=1.5).q.tobytes() == free[0].q.tobytes()
    assert run(1.5, q=np.tile([1.0, 0.5], (65, 1))).ok.all()
    loss = lambda k: jnp.sum(run(k, engine="native").q ** 2)
    assert jax.grad(loss)(1.5) == free[1] == jax.jit(jax.value_and_grad(loss))(1.5)[1]


def test_long_code_is_in_short_blocks():
    """LLVM takes a time that grows with the square of a block's length where code is to be ready soon."""
    g, body = Graph(), Body(Module(fma=True))
    last = x = g.input("x")
    for _ in range(3 * LONG):
        last = g.make("sqrt", g.add(last, x))
    region = Region(Emitter(body, 1), g)
    region.bind(x, "%x")
    region.require([last])
    assert len(body.lines) > 6 * LONG
    assert max(len(block.splitlines()) for block in re.split(r"^\w+:$", "\n".join(body.lines), flags=re.MULTILINE)) < LONG + 5


def compiled_levels(monkeypatch) -> list[int]:
    """The levels at which kernels are compiled from now on, those of few operations as those of many."""
    shared.addresses(), at_once.Orders()  # what is compiled once in a process
    levels, compiled = [], llvm.object_code
    monkeypatch.setattr(of_steps, "FEW", 0)

    def noted(text, level):
        levels.append(level)
        return compiled(text, level=level)

    monkeypatch.setattr(llvm, "object_code", noted)
    return levels


def test_what_cannot_be_compiled_is_named_with_its_line():
    def residual(u, x, t, h, params):
        roots = jnp.linalg.eigvalsh(jnp.outer(u, u))  # the line that the message names
        return u - x - h * roots

    p = small(implicit(residual, size=2), [1.0, 2.0])
    reason = native.supports(p)
    assert reason is not None and "eigh" in reason and f"{os.path.basename(__file__)}:" in reason
    with pytest.raises(UnsupportedPrimitive, match="eigh"):
        native.run(p)
    assert native.supports(problem("Kepler")) is None


@pytest.mark.parametrize("module", [kernel_module, sizes_module], ids=["steps", "sizes"])
def test_the_stages_of_a_composition_have_their_code_once(module):
    texts = []
    for name in ("yoshida4", "suzuki8"):  # 3 and 125 stages
        equation = make_step_equation(dx.Composition(MIDPOINT, name), dx.LagrangeDirac(SYSTEMS["Kepler"][0]), Shape(2, 0))
        texts.append(len(module(kernels(equation, None, False)._planned(), 1, fma=True)))
    assert texts[1] < 3 * texts[0]


def test_the_kernel_compiles_for_aarch64():
    p = problem("rolling disk, plus")
    plan = kernels(p.equation, None, False)._planned()
    for width in (1, 2):
        text = llvm.object_code(kernel_module(plan, width, fma=True), ("aarch64-unknown-linux-gnu", "generic", ""), assembly=True)
        assert "fmadd" in text if width == 1 else "fmla" in text or "fmls" in text
        assert "\nrun:" in text


@pytest.mark.parametrize("name", ["harmonic oscillator", "Kepler"])
def test_compensated_summation_stops_the_drift_of_conserved_quantities(name):
    """Energy of the oscillator and angular momentum in the Kepler problem are conserved exactly but for rounding."""
    conserved = {
        "harmonic oscillator": lambda q, p: np.sum(q**2 + p**2, axis=-1) / 2,
        "Kepler": lambda q, p: q[..., 0] * p[..., 1] - q[..., 1] * p[..., 0],
    }[name]
    plain = problem(name, steps=200_000, save_every=1000)
    drift = {}
    for compensated in (False, True):
        outcome = native.run(dataclasses.replace(plain, compensated=compensated))
        values = conserved(outcome.fields["q"][0], outcome.fields["p"][0])
        drift[compensated] = np.max(np.abs(values - values[0])) / abs(values[0])
    assert drift[True] < 8 * np.finfo(float).eps  # of which the rounding of the saved rows is half
    assert drift[False] > 10 * drift[True]


def test_compensated_runs_agree_with_plain_ones_and_do_not_depend_on_the_batch():
    p = dataclasses.replace(spread(problem("rolling disk, plus", steps=100), 5), compensated=True)
    whole, plain = native.run(p), native.run(dataclasses.replace(p, compensated=False))
    assert_close(whole, plain, 1e-12)
    alone = dataclasses.replace(p, state=p.state[3], guess=(p.guess[0][3],), batch=None)
    assert_same_bits(native.run(alone), whole, rows_b=slice(3, 4))


@pytest.mark.parametrize("engine", [native, xla])
@pytest.mark.soak_of("engine1")
def test_every_kind_of_failure_stays_in_its_lane(engine):
    """u₀² = c₀, c₁(u₁ − x₁) = 0: solvable, without a root, with a singular Jacobian, not a number, solvable."""
    equation = implicit(lambda u, x, t, h, c: jnp.stack([u[0] ** 2 - c[0], c[1] * (u[1] - x[1])]), size=2)
    c = np.array([[4.0, 1.0], [-1.0, 1.0], [4.0, 0.0], [np.nan, 1.0], [9.0, 2.0]])
    p = small(equation, [[0.3, 1.0 + i] for i in range(5)], steps=6, params=c, batch_params=True)
    outcome = engine.run(p)
    assert np.asarray(outcome.status).tolist() == [OK, NOT_CONVERGED, NOT_FINITE, NOT_FINITE, OK]
    assert np.asarray(outcome.completed).tolist() == [6, 0, 0, 0, 6]
    expected = [[2.0, 1.0], [0.3, 2.0], [0.3, 3.0], [0.3, 4.0], [3.0, 5.0]]
    np.testing.assert_allclose(outcome.last_state, expected, rtol=1e-15)
    np.testing.assert_allclose(np.asarray(outcome.closing["x"]), expected, rtol=1e-15)


@pytest.mark.parametrize("step", [0.2, 1.0])
@pytest.mark.soak_of("1.0")
def test_a_first_guess_behind_an_exponential_wall_is_no_solution(step):
    """There Newton's method comes down by a constant a step, for more updates than it has: it fails, and says so."""
    wall = dx.LagrangeDirac(lambda q, v, params: v[0] ** 2 / 2 - jnp.exp(params["a"] * q[0]) / params["a"])
    draw = np.random.default_rng(0)
    a, v = np.exp(draw.uniform(0, 4, 256)), draw.uniform(1, 20, (256, 1))
    start = {"q": -step * v * draw.uniform(1, 3, (256, 1)), "v": v, "params": {"a": a}, "batch_params": True}
    sol = dx.simulate(wall, dx.LagrangeDAlembert(), **start, step=step, steps=6, engine="native")
    q, p = np.asarray(sol.q)[..., 0], np.asarray(sol.p)[..., 0]
    velocity = np.diff(q) / step
    force = step / 2 * np.exp(a[:, None] * (q[:, :-1] + q[:, 1:]) / 2)
    missed = np.abs(p[:, :-1] - velocity - force) / (np.abs(p[:, :-1]) + np.abs(velocity) + force)
    assert np.nanmax(missed) < 1e-9 and 0 < np.sum(sol.ok) < 256
    assert np.all(np.isfinite(q[sol.ok]))


BODIES = np.array([0, 0, 1.2, 0, 0.6, 1.1])


def bodies(trap):
    """Three bodies in the plane with the potential r⁻¹² − r⁻⁶, in a trap; and that potential."""

    def potential(q):
        i, j = np.triu_indices(3, 1)
        apart = jnp.sum((q.reshape(3, 2)[i] - q.reshape(3, 2)[j]) ** 2, axis=1)
        return jnp.sum(apart**-6 - apart**-3) + trap * q @ q / 2

    return dx.LagrangeDirac(lambda q, v: v @ v / 2 - potential(q)), potential


def test_a_first_guess_between_two_bodies_gives_no_sizes():
    """Where two of three bodies nearly meet at a first guess, the terms there are no measure of roundoff at the solution."""
    (system, potential), h = bodies(1.0), 0.4
    draw = np.random.default_rng(11)
    starts = [(BODIES + 0.1 * draw.normal(size=6), 1.5 * draw.normal(size=6)) for _ in range(54)]
    force, solved = jax.jit(jax.vmap(jax.grad(potential))), 0
    for q, v in [starts[i] for i in (0, 22, 53)]:
        sol = dx.simulate(system, dx.DiscreteDirac(), q=q, v=v, step=h, steps=3, engine="native")
        pull = h * np.asarray(force((sol.q[:-1] + sol.q[1:]) / 2))
        missed, terms = np.abs(np.diff(sol.p, axis=0) + pull), np.abs(sol.p[1:]) + np.abs(sol.p[:-1]) + np.abs(pull)
        assert np.all(np.max(missed, axis=1) <= 1e-9 * np.max(terms, axis=1))
        solved += sol.rows > 1
    assert solved


@pytest.mark.soak
def test_a_step_that_is_singular_at_its_first_guess_alone_is_taken():
    """The matrix of a long step may be singular where two bodies nearly meet: that says nothing of the Lagrangian."""
    system, potential = bodies(0.0)
    q = np.array([0.06276237, 0.01395781, 1.17679126, -0.10015474, 0.61158643, 1.06730199])
    v = np.array([2.21501677, 0.74635929, -0.86769064, -0.32712642, -0.22428694, -4.26135685])
    sol = dx.simulate(system, dx.LagrangeDAlembert(), q=[q, BODIES], v=[v, 0 * v], step=0.4, steps=3)
    middle, velocity = (sol.q[0, 1:] + sol.q[0, :-1]) / 2, np.diff(sol.q[0], axis=0) / 0.4
    pull = 0.2 * np.asarray(jax.vmap(jax.grad(potential))(jnp.asarray(middle)))
    assert np.all(sol.ok)
    np.testing.assert_allclose(sol.p[0, :-1], velocity + pull, atol=1e-9 * np.max(np.abs(pull)))


@pytest.mark.soak
def test_a_place_near_a_singular_jacobian_is_no_solution():
    """There unknowns have any size: residuals are measured by sizes that are sure."""
    (system, _), h = bodies(0.0), 0.4
    q, v = (
        np.array(
            [
                -0.16126217540869092,
                0.04128695313297544,
                1.1214502717004151,
                0.17566032046188712,
                0.49333028925891326,
                0.9483054570283299,
            ]
        ),
        np.array(
            [
                -0.11786860928129683,
                -0.6053262067781735,
                -1.5928010176783007,
                -0.08642939653937219,
                0.13639926152320564,
                0.004152625990252928,
            ]
        ),
    )
    sol = dx.simulate(system, dx.DiscreteDirac(), q=q, v=v, step=h, steps=1, engine="native")
    stage = sol.equation.stages[0][0]
    state, guess = stage.start({"q": jnp.asarray(q), "v": jnp.asarray(v), "p": jnp.asarray(v), "t": 0.0}, h, None)
    steps = StepsInNumbers.of(sol.equation, None, False)
    begun, none = (np.asarray(state)[None], [np.asarray(guess)[None]], np.zeros(1)), np.zeros((1, 0))
    (unknowns,), _, good = steps.solved(*begun, h, none)
    missed = np.asarray(stage.residual(jnp.asarray(unknowns[0]), state, 0.0, h, None))
    assert not sol.ok
    assert not good[0] or np.max(np.abs(missed)) < 1e-6


def test_matrices_whose_products_are_whole_numbers_but_for_roundoff():
    """Harmonic modes through Hartley's matrix A, which is symmetric and orthogonal: entries of A K A differ from one another by
    whole numbers over 16 and roundoff."""
    n, steps, h = 16, 20, 0.3
    angles = 2 * np.pi * np.outer(range(n), range(n)) / n
    A, k = (np.cos(angles) + np.sin(angles)) / np.sqrt(n), np.arange(1.0, n + 1) ** 2
    system = dx.LagrangeDirac(lambda q, v: v @ v / 2 - jnp.sum(k * (A @ q) ** 2) / 2)
    q, w = np.linspace(-1, 1, n) ** 3 + 0.3, np.cos(np.arange(n))
    rate = np.block([[np.zeros((n, n)), np.eye(n)], [-(A.T * k) @ A, np.zeros((n, n))]])
    ahead, back = np.eye(2 * n) + h / 2 * rate, np.eye(2 * n) - h / 2 * rate
    exact = np.linalg.matrix_power(np.linalg.solve(back, ahead), steps)[:n, :n]

    def last(q):
        sol = dx.simulate(system, dx.LagrangeDAlembert(), q=q, v=np.zeros(n), step=h, steps=steps, engine=native)
        assert isinstance(q, jax.core.Tracer) or sol.stats["newton_iterations"] <= 2 * steps
        return sol.q[-1]

    np.testing.assert_allclose(last(q), exact @ q, atol=1e-12)
    slope = jax.grad(lambda q: jnp.sum(jnp.sin(last(q))))(jnp.asarray(q)) @ w
    np.testing.assert_allclose(slope, np.cos(exact @ q) @ (exact @ w), rtol=1e-9)
