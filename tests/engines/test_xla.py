"""The xla engine: closed forms and their gradients, chunks, batches, failures, interruption, honest residuals."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dirax as dx
from dirax.engines import sizes
from dirax.engines.contract import NOT_FINITE, OK, Problem
from dirax.engines.sizes import sizes_of, sizes_of_traced
from dirax.engines.xla import Xla, loop, run
from dirax.program.graph import GraphTooLarge
from dirax.schemes.step import Field, Shape, StepEquation, explicit_step, make_step_equation

XLA = Xla()
MIDPOINT = dx.LagrangeDAlembert()
OSCILLATOR = dx.LagrangeDirac(lambda q, v, omega: (v @ v - omega**2 * q @ q) / 2)


def pendulums(q, v, g):
    kinetic = v[0] ** 2 + v[1] ** 2 / 2 + v[0] * v[1] * jnp.cos(q[0] - q[1])
    return kinetic + g * (2 * jnp.cos(q[0]) + jnp.cos(q[1]))


PENDULUMS = dx.LagrangeDirac(pendulums)
SWING = {"q": np.array([1.0, 0.5]), "v": np.array([0.0, 0.5]), "step": 0.01, "params": 9.81, "engine": "xla"}


def problem(system, state, guess, h, steps, **keywords) -> Problem:
    n = np.shape(state)[-1] // 2
    equation = make_step_equation(MIDPOINT, system, Shape(n, 0))
    return Problem(equation, np.asarray(state), (np.asarray(guess),), h, 0.0, steps, **keywords)


def cayley(q, v, omega, h, t):
    """The midpoint rule turns (ωq, p) by θ = 2 arctan(hω/2) a step: q at the step of number t/h."""
    angle = 2 * np.arctan(h * omega / 2) * t / h
    return q * np.cos(angle) + v / omega * np.sin(angle)


# -------------------------------------------------------------------------------------------------- closed forms, gradients


@pytest.mark.soak
def test_the_midpoint_oscillator_is_a_cayley_map():
    sol = dx.simulate(OSCILLATOR, MIDPOINT, q=[1.0], v=[0.4], params=1.7, step=0.1, steps=5000, engine="xla")
    np.testing.assert_allclose(sol.q[:, 0], cayley(1.0, 0.4, 1.7, 0.1, sol.t), atol=1e-12)


@pytest.mark.parametrize("save_every", [pytest.param(1, marks=pytest.mark.soak), 7])
@pytest.mark.soak
def test_gradients_of_the_oscillator_against_the_closed_form(save_every):
    """With respect to initial data, params and the step itself, of every saved row at once, in reverse mode."""
    steps, weights = 40, np.random.default_rng(0).normal(size=len(range(0, 40, save_every)) + 1)
    numbers = np.append(np.arange(0, steps, save_every), steps)

    def loss(q, v, omega, h):
        run = {"params": omega, "step": h, "steps": steps, "save_every": save_every, "engine": "xla"}
        return dx.simulate(OSCILLATOR, MIDPOINT, q=jnp.stack([q]), v=jnp.stack([v]), **run).q[:, 0] @ weights

    q, v, omega, h = 0.8, -0.3, 1.7, 0.1
    theta, turn = 2 * np.arctan(h * omega / 2), 1 / (1 + (h * omega / 2) ** 2)  # dθ = turn·(h dω + ω dh)
    angle = numbers * theta
    by_angle = (-q * np.sin(angle) + v / omega * np.cos(angle)) * numbers * turn
    expected = [
        np.cos(angle) @ weights,
        np.sin(angle) / omega @ weights,
        (by_angle * h - v / omega**2 * np.sin(angle)) @ weights,
        by_angle * omega @ weights,
    ]
    np.testing.assert_allclose(jax.jit(jax.grad(loss, argnums=(0, 1, 2, 3)))(q, v, omega, h), expected, rtol=1e-10)


@pytest.mark.soak
def test_derivatives_of_a_nonlinear_trajectory_against_finite_differences():
    """A sum of the double pendulum's end as a function of (q, v, g): forward mode, reverse mode and central differences."""

    def end(z):
        sol = dx.simulate(PENDULUMS, MIDPOINT, q=z[:2], v=z[2:4], params=z[4], step=0.02, steps=30, engine="xla")
        return sol.q[-1] @ np.array([1.0, -0.7]) + sol.p[-1] @ np.array([0.4, 0.3])

    z, direction = np.array([1.0, 0.5, 0.0, 0.5, 9.81]), np.array([0.3, -0.5, 0.4, 0.2, 0.6])
    backward, forward = jax.jit(lambda z: (jax.grad(end)(z), jax.jvp(end, (z,), (direction,))[1]))(z)
    np.testing.assert_allclose(forward, backward @ direction, rtol=1e-11, atol=1e-13)
    differences = [(end(z + d) - end(z - d)) / 2e-5 for d in 1e-5 * np.eye(5)]  # runs of the engine's other loop
    np.testing.assert_allclose(backward, differences, rtol=1e-7, atol=1e-8)


def test_a_traced_run_is_the_run_from_the_host():
    """Under jit and under vmap, with a last row that is not a multiple of save_every."""
    run = {"params": 9.81, "step": 0.01, "steps": 23, "save_every": 5, "engine": "xla"}
    host = dx.simulate(PENDULUMS, MIDPOINT, q=np.array([[1.0, 0.5], [0.2, 0.1]]), v=np.zeros((2, 2)), **run)
    one = lambda q: (lambda sol: (sol.q, sol.p, sol.stats["newton_iterations"]))(
        dx.simulate(PENDULUMS, MIDPOINT, q=q, v=jnp.zeros(2), **run)
    )
    q, p, iterations = jax.jit(jax.vmap(one))(jnp.array([[1.0, 0.5], [0.2, 0.1]]))
    np.testing.assert_allclose(q, host.q, atol=1e-13)
    np.testing.assert_allclose(p, host.p, atol=1e-12)
    assert abs(int(iterations.sum()) - host.stats["newton_iterations"]) <= 4


# ------------------------------------------------------------------------------------------------------------ rows and time


def test_saving_less_is_subsampling():
    every = dx.simulate(PENDULUMS, MIDPOINT, **SWING, steps=300)
    seventh = dx.simulate(PENDULUMS, MIDPOINT, **SWING, steps=300, save_every=7)
    kept = np.append(np.arange(0, 300, 7), 300)
    for name in ("q", "p"):
        np.testing.assert_array_equal(seventh.fields[name], every.fields[name][kept])
    np.testing.assert_array_equal(seventh.t, every.t[kept])


@pytest.mark.parametrize("save_every", [1, 3])
@pytest.mark.soak_of("1")
def test_chunks_leave_no_trace(monkeypatch, save_every):
    """The bits of a run do not depend on where its chunks end, within rows or between them, nor on how many there are."""
    whole = dx.simulate(PENDULUMS, MIDPOINT, **SWING, steps=200, save_every=save_every)
    monkeypatch.setattr(loop, "CHUNK_ROWS", 16)
    monkeypatch.setattr(run, "FIRST_CHUNK", 7)
    monkeypatch.setattr(run, "CHUNK_SECONDS", 1e-9)
    calls = []
    pieces = dx.simulate(
        PENDULUMS, MIDPOINT, **SWING, steps=200, save_every=save_every, progress=lambda done, _: calls.append(done)
    )
    assert calls[:2] == [7, 8] and calls[-1] == 200
    for name in ("q", "p"):
        np.testing.assert_array_equal(pieces.fields[name], whole.fields[name])


def clock_equation() -> StepEquation:
    """An explicit step that writes down the time it is given."""
    return StepEquation(
        start=lambda data, h, params: (data["x"], jnp.zeros(0)),
        residual=explicit_step,
        advance=lambda u, state, t, h, params: jnp.stack([t, state[1] + 1.0]),
        unpack=lambda state, u, t, h, params: {"x": state, "now": jnp.stack([t])},
        state_size=2,
        unknowns=0,
        fields={"x": Field((2,)), "now": Field((1,))},
    )


@pytest.mark.parametrize("batch", [None, 2])
@pytest.mark.soak_of("2")
def test_time_is_the_number_of_steps_times_the_step(batch):
    """Not a running sum: k·h to the last bit, in the step and in the rows, after a two-point start as well."""
    state = np.zeros(2) if batch is None else np.zeros((batch, 2))
    guess = (np.zeros((*state.shape[:-1], 0)),)
    out = XLA.run(Problem(clock_equation(), state, guess, 0.1, 0.0, 1000, save_every=9, first_step=1, batch=batch))
    rows = 1 + np.append(np.arange(0, 1000, 9), 1000)
    for lane in range(batch or 1):
        np.testing.assert_array_equal(out.fields["now"][lane, :, 0], rows * 0.1)
        np.testing.assert_array_equal(out.fields["x"][lane, 1:, 0], (rows[1:] - 1) * 0.1)


# ------------------------------------------------------------------------------------------------ batches, failures, Ctrl-C


def falling_problem(states, steps, **keywords) -> Problem:
    """L = v²/2 − q + 10⁻⁴√q: trajectories fall out of the domain q ≥ 0 of L."""
    falling = dx.LagrangeDirac(lambda q, v: v @ v / 2 - q[0] + 1e-4 * jnp.sqrt(q[0]))
    states = np.asarray(states)
    return problem(falling, states, states[..., 1:], 0.01, steps, **keywords)


@pytest.mark.soak
def test_a_batch_is_its_trajectories_and_failures_stay_alone():
    """The others of a batch do not change a bit when one fails, and agree with single runs to roundoff."""
    healthy, failing = [1.0, 40.0], [0.5, -1.0]
    sound = XLA.run(falling_problem([healthy, [2.0, 30.0], healthy], 200, batch=3))
    mixed = XLA.run(falling_problem([healthy, failing, healthy], 200, batch=3))
    assert mixed.status.tolist() == [OK, NOT_FINITE, OK] and mixed.completed[[0, 2]].tolist() == [200, 200]
    for lane in (0, 2):
        for name in ("q", "p"):
            np.testing.assert_array_equal(mixed.fields[name][lane], sound.fields[name][lane])
    alone = XLA.run(falling_problem(failing, 200))
    good = alone.completed[0]
    assert mixed.completed[1] == good
    assert good == pytest.approx((np.sqrt(2.0) - 1.0) / 0.01, abs=3)  # where q = 1/2 − t − t²/2 is zero
    np.testing.assert_allclose(mixed.fields["q"][1, :good], alone.fields["q"][0, :good], atol=1e-13)


@pytest.mark.soak
def test_one_failure_in_a_large_batch_is_seen():
    """XLA's vectorized maximum over the lanes of a large batch loses NaNs: no judgement may rest on it."""
    n, lanes = 5, 1000
    bowl = dx.LagrangeDirac(lambda q, v: v @ v / 2 + jnp.sum(jnp.sqrt(q)) / 10)
    q = np.ones((lanes, n))
    v = np.zeros((lanes, n))
    v[700, 3] = -30.0
    sol = dx.simulate(bowl, MIDPOINT, q=q, v=v, step=0.01, steps=8, engine="xla")
    assert np.flatnonzero(~sol.ok).tolist() == [700]
    assert np.all(np.isfinite(sol.q[:700])) and np.all(np.isnan(sol.q[700, -1]))
    assert np.all(np.isfinite(sol.q[700, :3])) and np.all(sol.q[700, :3] > 0)


@pytest.mark.soak
def test_dead_trajectories_cost_nothing():
    """10¹⁵ steps would take a lifetime: the run ends with the last living trajectory."""
    out = XLA.run(falling_problem([[0.5, -1.0], [0.3, 0.0]], 10**15, save_every=10**14, batch=2))
    assert out.status.tolist() == [NOT_FINITE] * 2 and np.all(out.completed < 100)
    np.testing.assert_array_equal(out.closing["q"], out.last_state[:, :1])


def test_an_interrupted_run_keeps_what_was_computed(monkeypatch):
    monkeypatch.setattr(run, "FIRST_CHUNK", 50)
    monkeypatch.setattr(run, "CHUNK_SECONDS", 1e-9)
    swing = problem(OSCILLATOR, [1.0, 0.0], [0.0], 0.1, 10_000, params=1.0)
    seen = []

    def stop(done, total):
        seen.append(done)
        if len(seen) == 3:
            raise KeyboardInterrupt

    out = XLA.run(swing, stop)
    done = seen[-1]
    assert out.interrupted and out.completed[0] == done == 52
    np.testing.assert_allclose(out.fields["q"][0, :done, 0], cayley(1.0, 0.0, 1.0, 0.1, 0.1 * np.arange(done)), atol=1e-13)
    np.testing.assert_allclose(out.closing["q"][0], cayley(1.0, 0.0, 1.0, 0.1, 0.1 * done), atol=1e-13)


@pytest.mark.parametrize(
    "state", [[0.5, -1.0], pytest.param([0.00501, -1.0], marks=pytest.mark.soak)], ids=["on the way", "in the first step"]
)
@pytest.mark.soak
def test_a_failure_leaves_the_derivatives_of_the_others(state):
    """With respect to initial data and to a parameter that all share; the good rows of the one that fails keep theirs."""
    falling = dx.LagrangeDirac(lambda q, v, g: v @ v / 2 - g * q[0] + 1e-4 * jnp.sqrt(q[0]))
    run = {"step": 0.01, "steps": 60, "save_every": 10, "engine": "xla"}
    q, v = np.array([[1.0], [state[0]], [2.0]]), np.array([[40.0], [state[1]], [30.0]])

    def weighted(q, v, g, weights):
        sol = dx.simulate(falling, MIDPOINT, q=q, v=v, params=g, **run)
        rows = jnp.concatenate([sol.q, sol.p], axis=1)[..., 0]
        return weights @ jnp.sum(jnp.where(jnp.isnan(rows), 0.0, jnp.sin(rows)), axis=1)

    both, others, sound = jax.jit(jax.value_and_grad(weighted, argnums=(0, 1, 2))), np.array([0, 2]), np.array([0, 0, 2])
    slopes = lambda *given: both(*given)[1]
    mixed = slopes(q, v, 1.0, np.ones(3))
    assert all(np.all(np.isfinite(slope)) for slope in mixed)
    alone = slopes(q[sound], v[sound], 1.0, np.array([1.0, 0.0, 1.0]))
    for slope, other in zip(mixed[:2], alone[:2], strict=True):
        np.testing.assert_allclose(slope[others], other[others], rtol=1e-12)
    np.testing.assert_allclose(slopes(q, v, 1.0, np.array([1.0, 0.0, 1.0]))[2], alone[2], rtol=1e-12)
    d = 1e-6
    moved = [q + nudge * np.array([[0.0], [1.0], [0.0]]) for nudge in (d, -d)]
    values = [both(q, v, 1.0, np.array([0.0, 1.0, 0.0]))[0] for q in moved]
    np.testing.assert_allclose(mixed[0][1, 0], (values[0] - values[1]) / (2 * d), rtol=1e-5)


# ------------------------------------------------------------------------------------------- residuals, sizes, compiled code


def test_the_residual_reported_is_that_of_the_accepted_step():
    """Recomputed from the saved rows: p_k + D1 L_d(q_k, q_{k+1}) with v from the rows carries only the roundoff of q/h."""
    sol = dx.simulate(PENDULUMS, MIDPOINT, **SWING, steps=400)
    h = SWING["step"]
    ld = lambda q0, q1: h * pendulums((q0 + q1) / 2, (q1 - q0) / h, SWING["params"])
    left = jax.jit(jax.vmap(lambda p, q0, q1: p + jax.grad(ld)(q0, q1)))(sol.p[:-1], sol.q[:-1], sol.q[1:])
    assert np.max(np.abs(left)) < 1e-12
    # 10 units of roundoff of p, where the residual before the last update of Newton's method is 10⁻¹⁰ and more
    assert 0 < sol.stats["max_residual"] < 10 * np.finfo(float).eps * np.max(np.abs(sol.p))


@pytest.mark.soak
def test_a_chain_of_thirty_oscillators():
    """Above the size that is inverted by hand, against the Cayley map of every normal mode."""
    n, h, steps = 30, 0.1, 500
    stiffness = 2 * np.eye(n) - np.eye(n, k=1) - np.eye(n, k=-1)
    chain = dx.LagrangeDirac(lambda q, v: v @ v / 2 - q @ jnp.asarray(stiffness) @ q / 2)
    q, v = np.random.default_rng(1).normal(size=(2, n))
    sol = dx.simulate(chain, MIDPOINT, q=q, v=v, step=h, steps=steps, engine="xla")
    squares, modes = np.linalg.eigh(stiffness)
    exact = modes @ cayley(modes.T @ q, modes.T @ v, np.sqrt(squares), h, h * steps)
    np.testing.assert_allclose(sol.q[-1], exact, atol=1e-12)
    assert sol.stats["newton_iterations"] <= 2 * steps


@pytest.mark.soak
def test_one_compiled_function_serves_every_run_of_an_equation(compiled):
    """Other initial data, params, step, number of steps, time and rows saved: nothing is compiled again."""
    run = {"q": [1.0], "v": [0.0], "params": 1.0, "step": 0.1, "steps": 30, "engine": "xla"}
    dx.simulate(OSCILLATOR, MIDPOINT, **run)
    compiled.clear()
    others = ({"q": [2.0], "v": [1.0]}, {"params": 3.0}, {"step": 0.05, "t0": 2.0}, {"steps": 4500}, {"save_every": 4})
    for other in others:
        assert dx.simulate(OSCILLATOR, MIDPOINT, **(run | other)).ok
    assert compiled == []
    dx.simulate(OSCILLATOR, MIDPOINT, **(run | {"q": [[1.0], [2.0]], "v": [[0.0], [0.0]]}))
    assert compiled  # a batch is another function, so the listener does see compilations


def test_sizes_of_a_step_that_is_too_large_to_be_solved_in_numbers(monkeypatch):
    """The guess says how large they may be: under a transformation JAX could not be asked any more."""
    far = problem(OSCILLATOR, [1.0, 1e6], [1e-9], 0.1, 1, params=1.0)

    def too_large(*_):
        raise GraphTooLarge("more than 60000 scalar operations")

    at = sizes._entries(far, 0.0, np)
    assert sizes._closely(at)[0][0, 0] > 2 * sizes.FAR * 1e-9
    monkeypatch.setattr(sizes.StepsInNumbers, "of_program", too_large)
    assert 0.0 < sizes._closely(at)[0][0, 0] <= 2 * sizes.FAR * 1e-9


@pytest.mark.parametrize("batch", [None, 2])
@pytest.mark.soak_of("None")
def test_sizes_of_a_run_that_jax_traces_are_those_of_the_run(batch):
    """One by one and over axes of vmap, of the data, of the step and of a parameter."""
    state, guess = np.array([1.0, 0.5, 0.0, 1e-9]), np.array([1.0, 0.5])
    many = (lambda a: np.stack([a, 2.0 * a])) if batch else (lambda a: a)

    def sought(find, h, g, scale):
        given = problem(PENDULUMS, many(state), many(guess), h, 1, params=g, batch=batch)
        return find(given.with_numbers(state=many(state) * scale, guess=(many(guess) * scale,)))[0]

    h, g, scale = np.array([0.1, 0.01]), np.array([9.81, 1e3]), np.array([1.0, 1e-4])
    apart = [[sought(sizes_of, *one, s) for s in scale] for one in zip(h, g, strict=True)]
    traced = lambda h, g, s: sought(sizes_of_traced, h, g, s)
    found = jax.jit(jax.vmap(jax.vmap(traced, in_axes=(None, None, 0)), in_axes=(0, 0, None)))(h, g, scale)
    np.testing.assert_array_equal(found, apart)
    assert len(np.unique(apart)) > 2
    np.testing.assert_array_equal(jax.jacfwd(lambda h: traced(h, 9.81, 1.0))(0.1), 0.0)
