"""dx.prepare and repeated runs: the bits of a first run, and every premise of it, whatever changes from call to call."""

import copy
import pickle
import time

import cloudpickle
import jax.numpy as jnp
import numpy as np
import pytest

import dirax as dx
from dirax import gallery
from dirax.run.batch_plan import BatchPlan
from dirax.run.plan import Plan

STEP = {"step": 0.1, "steps": 3}
HENON = dx.LagrangeDirac(lambda q, v: (v @ v - q @ q) / 2 - (q[0] ** 2 * q[1] - q[1] ** 3 / 3))
MASS = dx.LagrangeDirac(lambda q, v, params: jnp.sum(params["m"] * v * v) / 2 - jnp.sum(jnp.cos(q)))
SKATE = dx.LagrangeDirac(lambda q, v: v @ v / 2 - q[0], lambda q: jnp.array([[jnp.sin(q[2]), -jnp.cos(q[2]), 0.0]]))
MIDPOINT = dx.LagrangeDAlembert()


@pytest.fixture
def planned(monkeypatch):
    """How many runs began by a plan."""
    found = []

    def counting(problem):
        def counted(*arguments):
            made = problem(*arguments)
            found.extend([made] * (made is not None))
            return made

        return counted

    for kind in (Plan, BatchPlan):
        monkeypatch.setattr(kind, "problem", counting(kind.problem))
    return found


def assert_same(a, b):
    assert list(a.fields) == list(b.fields) and a.ok == b.ok
    np.testing.assert_array_equal(a.t, b.t)
    for name in a.fields:
        np.testing.assert_array_equal(a.fields[name], b.fields[name])


def fresh(system, scheme, **arguments):
    """A first run."""
    dx.clear_caches()
    return dx.simulate(system, scheme, **arguments)


@pytest.mark.parametrize("name", ["rolling-disk", "henon-heiles", "heavy-top", "cartesian-double-pendulum", "lc-ladder"])
@pytest.mark.soak_of(but=["henon-heiles", "heavy-top"])
def test_later_runs_of_the_gallery_have_the_bits_of_the_first(name, planned):
    example = gallery.get(name)
    dx.clear_caches()
    first, again, other, by_plan = (example.simulate(steps=4, step=f * example.step) for f in (1.0, 1.0, 1.5, 1.25))
    assert len(planned) == 1 and not np.array_equal(first.t, by_plan.t)
    assert_same(first, again)
    assert_same(other, example.simulate(steps=4, step=1.5 * example.step))
    dx.clear_caches()
    assert_same(by_plan, example.simulate(steps=4, step=1.25 * example.step))


def test_other_data_steps_times_and_rows(planned):
    run = dx.prepare(HENON, MIDPOINT, q=[0.3, 0.1], v=[0.2, 0.35], **STEP)
    changes = {"q": [0.1, 0.2], "step": 0.05, "steps": 7, "t0": 2.0, "save_every": 3}
    found, at_once = run(**changes), run()
    assert len(planned) >= 2
    assert_same(found, fresh(HENON, MIDPOINT, **{"q": [0.3, 0.1], "v": [0.2, 0.35], **changes}))
    assert_same(at_once, fresh(HENON, MIDPOINT, q=[0.3, 0.1], v=[0.2, 0.35], **STEP))
    assert found.rows == 4 and found.t[0] == 2.0 and found.stats["steps"] == 7


def test_other_params_and_other_kinds_of_data(planned):
    run = dx.prepare(MASS, MIDPOINT, q=[0.3, 0.1], v=[0.2, 0.35], params={"m": 1.0}, **STEP)
    for params in ({"m": 2.0}, {"m": np.float64(0.5)}, {"m": np.array([1.0, 3.0])}):
        assert_same(run(params=params), fresh(MASS, MIDPOINT, q=[0.3, 0.1], v=[0.2, 0.35], params=params, **STEP))
    given = {"q": [0.3, 0.1], "p": [0.2, 0.4]}
    assert_same(run(**given), fresh(MASS, MIDPOINT, **given, params={"m": 1.0}, **STEP))
    batch = {"q": [[0.3, 0.1], [0.2, 0.2]]}
    np.testing.assert_array_equal(run(**batch, v=np.ones((2, 2))).q[0], run(q=[0.3, 0.1], v=[1.0, 1.0]).q)


@pytest.mark.parametrize(
    "system, data, params, changes, message",
    [
        (HENON, {"q": [0.3, 0.1], "v": [0.2, 0.3]}, None, {"q": [0.3, np.nan]}, "q must be finite"),
        (HENON, {"q": [0.3, 0.1], "v": [0.2, 0.3]}, None, {"q": [0.3]}, "must have the same length"),
        (HENON, {"q": [0.3, 0.1], "v": [0.2, 0.3]}, None, {"step": -1.0}, "step must be a positive"),
        (HENON, {"q": [0.3, 0.1], "v": [0.2, 0.3]}, None, {"p": [1.0, 1.0], "v": [1.0, 1.0]}, "p=, v= was given"),
        (MASS, {"q": [0.3, 0.1], "v": [0.2, 0.3]}, {"m": 1.0}, {"params": {"m": 0.0}}, "singular"),
        (MASS, {"q": [0.3, 0.1], "v": [0.2, 0.3]}, {"m": 1.0}, {"params": {"m": np.inf}}, "params must be finite"),
        (SKATE, {"q": [0.0] * 3, "v": [1.0, 0, 1]}, None, {"v": [1.0, 0.5, 1.0]}, "off the constraint"),
        (
            dx.LagrangeDirac(lambda q, v: v @ v / 2 + jnp.sum(jnp.sqrt(q))),
            {"q": [1.0], "v": [1.0]}, None, {"q": [-1.0]}, "lagrangian is nan",
        ),
    ],
)  # fmt: skip
@pytest.mark.soak_of("system4-data4-params4-changes4-singular")
def test_every_premise_is_checked(system, data, params, changes, message, planned):
    run = dx.prepare(system, MIDPOINT, **data, params=params, **STEP)
    run()
    assert planned
    with pytest.raises(ValueError, match=message):
        run(**changes)


@pytest.mark.parametrize("batch_params", [False, True])
def test_batches_begin_by_a_plan_with_the_bits_of_a_first_run(batch_params, planned):
    random = np.random.default_rng(0)

    def drawn():  # the batch is that of the data, or of the params alone
        points, masses = ((2, 2), (9, 2)) if batch_params else ((2, 9, 2), (2,))
        q, v = random.normal(size=points)
        return {"q": q, "v": v, "params": {"m": random.uniform(1.0, 2.0, masses)}}

    given = {"batch_params": batch_params, "save_every": 2}
    changes = {**drawn(), "step": 0.05, "steps": 5, "t0": 1.0}
    run = dx.prepare(MASS, MIDPOINT, **drawn(), **given, **STEP)
    found, at_once = run(**changes), dx.simulate(MASS, MIDPOINT, **changes, **given)
    assert len(planned) == 2 and found.rows == 4 and found.t[0] == 1.0
    assert_equal_batches(found, at_once)
    if not batch_params:
        run(**{**changes, "params": {"m": np.array([3.0, 4.0])}})
        assert len(planned) == 3
    assert_equal_batches(found, fresh(MASS, MIDPOINT, **changes, **given))


@pytest.mark.parametrize(
    "system, data, params, changes, message",
    [
        (
            MASS, {"q": [[0.3, 0.1]] * 3, "v": [0.2, 0.3]}, {"m": np.ones(3)}, {"params": {"m": np.array([1.0, 2.0, 0.0])}},
            "singular",
        ),
        (
            SKATE, {"q": np.zeros((3, 3)), "v": [1.0, 0, 1]}, None, {"v": [[1.0, 0, 1], [1, 0.5, 1], [1, 0, 1]]},
            "of trajectory 1 are off",
        ),
        (
            dx.LagrangeDirac(lambda q, v: v @ v / 2 + jnp.sum(jnp.sqrt(q))),
            {"q": np.ones((3, 1)), "v": [1.0]}, None, {"q": [[1.0], [1.0], [-1.0]]}, "lagrangian is nan .* of trajectory 2",
        ),
    ],
)  # fmt: skip
@pytest.mark.soak_of("system0-data0-params0-changes0-singular")
def test_every_premise_of_a_batch_is_checked(system, data, params, changes, message, planned):
    run = dx.prepare(system, MIDPOINT, **data, params=params, batch_params=params is not None, **STEP)
    assert run().ok.all() and planned
    with pytest.raises(ValueError, match=message):
        run(**changes)


@pytest.mark.soak
def test_a_singular_lagrangian_is_asked_again_for_its_final_manifold(planned):
    """∂²L/∂v² is singular for m₁ = 0, and then sin q₁ = 0: what was accepted there once says nothing of another point."""
    run = dx.prepare(MASS, MIDPOINT, q=[0.3, 0.0], v=[0.2, 0.0], params={"m": np.ones(2)}, **STEP)
    singular = {"m": np.array([1.0, 0.0])}
    assert run(params=singular).ok and not planned
    with pytest.raises(ValueError, match="off its final constraint manifold"):
        run(q=[0.3, 0.1], params=singular)


def test_what_is_no_number_is_not_taken():
    run = dx.prepare(HENON, MIDPOINT, q=[0.3, 0.1], v=[0.2, 0.3], **STEP)
    with pytest.raises(TypeError, match="but engine= was given: prepare another one"):
        run(engine="xla")


def test_functions_that_index_by_values_are_checked_each_time(planned):
    system = dx.LagrangeDirac(lambda q, v, params: v @ v / 2 - q[params] ** 2)
    run = dx.prepare(system, MIDPOINT, q=[0.3, 0.1], v=[0.2, 0.3], params=1, **STEP)
    assert run().ok and not planned
    with pytest.raises(ValueError, match="reads an entry"):
        run(params=2)


@pytest.mark.parametrize("scheme", [MIDPOINT, dx.Composition(MIDPOINT, "suzuki4"), dx.Collocation(stages=3)])
@pytest.mark.parametrize("first, more, every", [(6, 5, 1), (6, 6, 3), (7, 6, 3), (2, 1, 5)])
def test_extending_has_the_bits_of_one_run(scheme, first, more, every):
    given = {"q": [0.3, 0.1], "v": [0.2, 0.35], "step": 0.2, "save_every": every, "t0": 1.0}
    sol = dx.simulate(HENON, scheme, **given, steps=first).extend(more)
    whole = dx.simulate(HENON, scheme, **given, steps=first + more)
    assert_same(sol, whole)
    for name in ("steps", "newton_iterations", "max_residual"):
        assert sol.stats[name] == whole.stats[name]
    assert_same(sol.extend(2), dx.simulate(HENON, scheme, **given, steps=first + more + 2))


@pytest.mark.parametrize("engine", ["native", "xla"])
@pytest.mark.soak_of("xla")
def test_extending_batches_and_two_points(engine):
    rng = np.random.default_rng(0)
    given = {"q": rng.uniform(size=(5, 2)), "v": rng.uniform(size=(5, 2)), "step": 0.1, "save_every": 2, "engine": engine}
    sol, whole = (dx.simulate(HENON, MIDPOINT, **given, steps=steps) for steps in (5, 12))
    sol = sol.extend(7)
    assert_equal_batches(sol, whole)
    two = {"q0": [0.3, 0.1], "q1": [0.31, 0.12], "step": 0.1, "engine": engine}
    assert_same(dx.simulate(HENON, MIDPOINT, **two, steps=4).extend(3), dx.simulate(HENON, MIDPOINT, **two, steps=7))


def assert_equal_batches(a, b):
    assert list(a.message) == list(b.message)
    for name in a.fields:
        np.testing.assert_array_equal(a.fields[name], b.fields[name])


def test_a_failed_trajectory_stays_as_it_is_when_the_others_go_on():
    edge = dx.LagrangeDirac(lambda q, v: v @ v / 2 + jnp.sum(jnp.sqrt(q)))
    given = {"q": [[1.0], [0.25]], "v": [[0.0], [-1.0]], "step": 0.1}
    sol, whole = (dx.simulate(edge, MIDPOINT, **given, steps=steps) for steps in (6, 9))
    assert list(whole.ok) == [True, False]
    assert_equal_batches(sol.extend(3), whole)
    assert_same(sol[1], dx.simulate(edge, MIDPOINT, q=[0.25], v=[-1.0], step=0.1, steps=6).extend(3))


def test_extending_what_does_not_know_how_it_was_run():
    sol = dx.simulate(HENON, MIDPOINT, q=[0.3, 0.1], v=[0.2, 0.3], **STEP)
    with pytest.raises(ValueError, match="extend that"):
        sol[0:2].extend(3)
    with pytest.raises(ValueError, match="steps must be a whole number"):
        sol.extend(0)
    assert len(sol.extend(np.int64(2)).q) == len(sol.q) + 2


def test_stats_account_for_the_time_of_a_call():
    system = dx.LagrangeDirac(lambda q, v: (v @ v - q @ q) / 2 - jnp.sum(jnp.cos(q)) * jnp.sin(q[0]) * v[1])
    for _ in range(2):
        began = time.perf_counter()
        sol = dx.simulate(system, MIDPOINT, q=[0.3, 0.1], v=[0.2, 0.3], step=1e-3, steps=200_000)
        wall = time.perf_counter() - began
        accounted = sum(value for name, value in sol.stats.items() if name.endswith("_seconds"))
        assert 0.95 * wall <= accounted <= wall


def free_motion(q, v):
    return v @ v / 2


def test_a_prepared_run_is_pickled_as_what_it_was_made_from():
    run = dx.prepare(dx.LagrangeDirac(free_motion), MIDPOINT, q=[0.1], v=[0.2], **STEP)
    by_lambda = dx.prepare(HENON, MIDPOINT, q=[0.1, 0.2], v=[0.2, 0.1], **STEP)
    first = run()
    for other in (pickle.loads(pickle.dumps(run)), copy.deepcopy(run)):
        assert_same(other(), first)
    assert_same(pickle.loads(cloudpickle.dumps(by_lambda))(), by_lambda())
