"""simulate(): rows and times, batches, parameters, gradients, transformations, starts, progress, reuse of compiled code."""

import dataclasses
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dirax as dx
from dirax import gallery

PLUS = dx.PlusLagrangeDirac()
OSCILLATOR = dx.LagrangeDirac(lambda q, v: (v @ v - q @ q) / 2)
SPRING = dx.LagrangeDirac(lambda q, v, params: (params["m"] * v @ v - params["k"] * q @ q) / 2)
SKATE = dx.LagrangeDirac(
    lambda q, v, params: v @ v / 2 - params * q[0], lambda q: jnp.array([[jnp.sin(q[2]), -jnp.cos(q[2]), 0.0]])
)
ENGINES = pytest.mark.parametrize("engine", ["xla", "native"])


def symplectic_euler(q, v, h, steps, omega=1.0):
    """What the left rule makes of q̈ = −ω²q: p_{k+1} = p_k − hω²q_k, q_{k+1} = q_k + h p_{k+1}; rows (q, p) at every step."""
    rows = [(q, v)]
    for _ in range(steps):
        v = v - h * omega**2 * q
        q = q + h * v
        rows.append((q, v))
    return np.array(rows)


# ---------------------------------------------------------------------------------------------------------- rows and times


@ENGINES
@pytest.mark.parametrize("steps, every", [(1, 1), (7, 1), (12, 3), (13, 3), (5, 100), (1, 7)])
@pytest.mark.soak_of("1-1-xla")
def test_rows_and_times(steps, every, engine):
    """steps + 1 rows; with save_every the multiples of it, and the last row always."""
    sol = dx.simulate(OSCILLATOR, PLUS, q=[1.0], v=[0.5], step=0.1, steps=steps, save_every=every, t0=3.0, engine=engine)
    kept = np.unique(np.append(np.arange(0, steps + 1, every), steps))
    exact = symplectic_euler(1.0, 0.5, 0.1, steps)[kept]
    assert sol.q.shape == (len(kept), 1) and sol.ok is True and sol.message == ""
    np.testing.assert_allclose(sol.t, 3.0 + 0.1 * kept, rtol=1e-15)
    np.testing.assert_allclose(np.concatenate([sol.q, sol.p], 1), exact, rtol=1e-13)
    assert sol.stats["steps"] == steps and sol.stats["engine"] == engine


@ENGINES
def test_many_rows_go_through_the_buffer_in_pieces(engine):
    steps = 30_000
    sol = dx.simulate(OSCILLATOR, PLUS, q=[1.0], v=[0.0], step=0.01, steps=steps, engine=engine)
    angle = 2 * np.arcsin(0.005)
    exact = np.cos((np.arange(steps + 1) + 0.5) * angle) / np.cos(angle / 2)
    np.testing.assert_allclose(sol.q[:, 0], exact, atol=1e-9)


@pytest.mark.parametrize("steps", [1, 2, 9])
def test_a_two_point_start_gives_rows_0_and_1(steps):
    q0, q1 = 1.0, 1.04
    sol = dx.simulate(OSCILLATOR, PLUS, q0=[q0], q1=[q1], step=0.1, steps=steps)
    q = [q0, q1]
    while len(q) < steps + 1:  # (q_{k+1} − 2 q_k + q_{k−1})/h² = −q_k
        q.append(2 * q[-1] - q[-2] - 0.01 * q[-1])
    np.testing.assert_allclose(sol.q[:, 0], q, rtol=1e-12)
    np.testing.assert_array_equal(sol.q[:2, 0], [q0, q1])
    np.testing.assert_allclose(sol.t, 0.1 * np.arange(steps + 1))
    np.testing.assert_allclose(sol.p[1:, 0], np.diff(q) / 0.1, rtol=1e-11)


def test_multipliers_belong_to_the_step_that_leaves_a_row():
    """With save_every the saved multiplier is that of the first step after the row, not of the last."""
    start = {"q": [0.0, 0.0, 0.3], "v": [np.cos(0.3), np.sin(0.3), 1.0], "params": 2.0, "step": 0.05, "steps": 10}
    every, third = (dx.simulate(SKATE, PLUS, **start, save_every=n) for n in (1, 3))
    assert every.multipliers.shape == (10, 1) and third.multipliers.shape == (4, 1)
    np.testing.assert_allclose(third.multipliers, every.multipliers[[0, 3, 6, 9]], atol=1e-13)
    np.testing.assert_allclose(third.q, every.q[[0, 3, 6, 9, 10]], atol=1e-13)


# ---------------------------------------------------------------------------------------------------- batches and parameters


@ENGINES
@pytest.mark.soak_of("xla")
def test_a_batch_is_its_trajectories(engine):
    q = np.linspace(0.5, 1.5, 5)[:, None]
    v = np.array([[0.2], [0.0], [-1.0], [3.0], [0.1]])
    run = lambda q, v: dx.simulate(OSCILLATOR, PLUS, q=q, v=v, step=0.1, steps=40, engine=engine)
    together = run(q, v)
    assert together.q.shape == (5, 41, 1) and together.ok.tolist() == [True] * 5 and together.message == [""] * 5
    for i in range(5):
        alone = run(q[i], v[i])
        np.testing.assert_allclose(together.q[i], alone.q, atol=1e-14)
        np.testing.assert_allclose(together.p[i], alone.p, atol=1e-14)


def test_one_entry_may_have_the_batch_axis_alone():
    sol = dx.simulate(OSCILLATOR, PLUS, q=[[1.0], [2.0]], v=[0.5], step=0.1, steps=3)
    for i, q in enumerate((1.0, 2.0)):
        np.testing.assert_allclose(sol.q[i, :, 0], symplectic_euler(q, 0.5, 0.1, 3)[:, 0], rtol=1e-14)


@ENGINES
@pytest.mark.soak_of("xla")
def test_parameters_with_a_batch_axis(engine):
    params = {"m": np.array([1.0, 2.0, 0.5]), "k": np.array([1.0, 1.0, 3.0])}
    sol = dx.simulate(SPRING, PLUS, q=[1.0], v=[0.0], params=params, batch_params=True, step=0.1, steps=20, engine=engine)
    for i in range(3):
        m, k = params["m"][i], params["k"][i]
        exact = symplectic_euler(1.0, 0.0, 0.1, 20, np.sqrt(k / m))
        np.testing.assert_allclose(sol.q[i, :, 0], exact[:, 0], rtol=1e-12)
        np.testing.assert_allclose(sol.p[i, :, 0], m * exact[:, 1], rtol=1e-12, atol=1e-15)
    energy = (sol.p[..., 0] ** 2 / params["m"][:, None] + params["k"][:, None] * sol.q[..., 0] ** 2) / 2
    np.testing.assert_allclose(sol.energy(), energy, rtol=1e-13)


def test_a_batch_of_one_keeps_its_axis():
    sol = dx.simulate(OSCILLATOR, PLUS, q=[[1.0]], v=[[0.0]], step=0.1, steps=2)
    assert sol.q.shape == (1, 3, 1) and sol.batch == 1 and sol.ok.shape == (1,)


# ------------------------------------------------------------------------------------------- gradients and transformations


def test_gradient_against_the_closed_form():
    """The left rule on the oscillator is linear: ∂q_N/∂(q_0, v_0) is a matrix power, ∂/∂k by hand through the recursion."""
    h, steps = 0.1, 25

    def end(q, v, k):
        params = {"m": 1.0, "k": k}
        return dx.simulate(SPRING, PLUS, q=jnp.stack([q]), v=jnp.stack([v]), params=params, step=h, steps=steps).q[-1, 0]

    value, gradient = jax.value_and_grad(end, argnums=(0, 1, 2))(0.7, -0.4, 2.0)
    k = 2.0
    step = np.array([[1 - h * h * k, h], [-h * k, 1.0]])
    power = np.linalg.matrix_power(step, steps)
    q, v, dq, dv = 0.7, -0.4, 0.0, 0.0  # and their derivatives with respect to k
    for _ in range(steps):
        dv, v = dv - h * (q + k * dq), v - h * k * q
        dq, q = dq + h * dv, q + h * v
    assert value == pytest.approx(q, rel=1e-13)
    np.testing.assert_allclose(gradient, [power[0, 0], power[0, 1], dq], rtol=1e-11)


@pytest.mark.parametrize("engine", ["native", "xla"])
@pytest.mark.soak_of("xla")
def test_a_second_gradient_compiles_nothing(engine, compiled):
    def end(q, step):
        sol = dx.simulate(SPRING, PLUS, q=q, v=[0.3], params={"m": 1.0, "k": 2.0}, step=step, steps=3, engine=engine)
        return jnp.sum(sol.q[-1])

    jax.grad(end)(jnp.array([1.0]), 0.1)
    first = len(compiled)
    jax.grad(end)(jnp.array([2.0]), 0.2)
    assert 0 < first == len(compiled)


@pytest.mark.soak
def test_gradient_with_constraints_against_finite_differences():
    """Initial position, velocity along the constraint and a parameter, for the final position, momentum and multiplier."""
    scheme = dx.LagrangeDAlembert()

    def loss(z):
        q, speed, turn, slope = jnp.stack([0.0, 0.1, z[0]]), z[1], z[2], z[3]
        v = jnp.stack([speed * jnp.cos(q[2]), speed * jnp.sin(q[2]), turn])
        sol = dx.simulate(SKATE, scheme, q=q, v=v, params=slope, step=0.1, steps=7, save_every=3)
        return jnp.sum(sol.q[-1] * jnp.array([1.0, 2.0, 3.0])) + sol.p[-1, 0] + sol.multipliers[-1, 0] / 0.1

    z = jnp.array([0.3, 1.2, 0.8, 1.5])
    run = jax.jit(jax.value_and_grad(loss))
    delta = 1e-5 * np.eye(4)
    finite = [(run(z + d)[0] - run(z - d)[0]) / 2e-5 for d in delta]
    np.testing.assert_allclose(run(z)[1], finite, rtol=1e-8)


def test_vmap_jit_and_traced_steps():
    """The oscillator's end point as a function of initial data and of the step itself."""

    def end(q, h):
        return dx.simulate(OSCILLATOR, PLUS, q=jnp.stack([q]), v=[0.0], step=h, steps=10).q[-1, 0]

    q, h = np.array([1.0, 2.0]), np.array([0.1, 0.2])
    ends = jax.jit(jax.vmap(end))(q, h)
    np.testing.assert_allclose(ends, [symplectic_euler(a, 0.0, b, 10)[-1, 0] for a, b in zip(q, h, strict=True)], rtol=1e-13)


def test_functions_that_close_over_a_traced_value():
    """Neither initial data nor params are traced here, only what the Lagrangian closes over."""

    def end(k):
        system = dx.LagrangeDirac(lambda q, v: (v @ v - k * q @ q) / 2)
        return dx.simulate(system, PLUS, q=[1.0], v=[0.0], step=0.1, steps=3).q[-1, 0]

    h, k = 0.1, 2.0
    slope, q, v, dq, dv = jax.grad(end)(k), 1.0, 0.0, 0.0, 0.0
    for _ in range(3):
        dv, v = dv - h * (q + k * dq), v - h * k * q
        dq, q = dq + h * dv, q + h * v
    assert slope == pytest.approx(dq, rel=1e-12)


def test_the_traced_run_is_the_run():
    start = {"q": np.array([0.0, 0.1, 0.3]), "v": np.array([np.cos(0.3), np.sin(0.3), 0.5])}
    run = lambda **data: dx.simulate(SKATE, dx.LagrangeDAlembert(), **data, params=1.0, step=0.1, steps=10, save_every=4)
    plain = run(**start)
    traced = jax.jit(lambda data: (lambda sol: (sol.t, sol.fields, sol.ok))(run(**data)))(start)
    np.testing.assert_allclose(traced[0], plain.t)
    for name in plain.fields:
        np.testing.assert_allclose(traced[1][name], plain.fields[name], atol=1e-13)
    assert bool(traced[2])


# ------------------------------------------------------------------------------------------------------- schemes in stages


class KickDrift(dx.AbstractScheme):
    """Symplectic Euler for the oscillator as a user would write it: explicit, so that there is nothing to solve."""

    def step_equation(self, system, shape):
        def advance(u, state, t, h, params):
            p = state[1] - h * state[0]
            return jnp.stack([state[0] + h * p, p])

        return dx.StepEquation(
            start=lambda data, h, params: (jnp.concatenate([data["q"], data["p"]]), jnp.zeros(0)),
            residual=lambda u, state, t, h, params: jnp.zeros(0),
            advance=advance,
            unpack=lambda state, u, t, h, params: {"q": state[:1], "p": state[1:]},
            state_size=2,
            unknowns=0,
            fields={"q": dx.Field((1,)), "p": dx.Field((1,))},
        )


@ENGINES
@pytest.mark.soak_of("xla")
def test_stages_of_different_sizes(engine):
    """Φ_{h/2} ∘ Φ*_{h/2} is Störmer–Verlet; its adjoint stage has two unknowns and the other none."""
    sol = dx.simulate(OSCILLATOR, dx.SymmetricComposition(KickDrift()), q=[1.0], v=[0.3], step=0.2, steps=30, engine=engine)
    assert [stage.unknowns for stage, _ in sol.equation.stages] == [2, 0]
    q, p, rows = 1.0, 0.3, [(1.0, 0.3)]
    for _ in range(30):  # first the adjoint (drift, then kick), then kick and drift, half a step each
        q = q + 0.1 * p
        p = p - 0.2 * q
        q = q + 0.1 * p
        rows.append((q, p))
    np.testing.assert_allclose(np.concatenate([sol.q, sol.p], 1), rows, atol=1e-13)


def test_inputs_drive_an_open_system():
    """ẋ = u(t) with u = 3t² by the midpoint rule: Σ h·3(t_k + h/2)²."""
    system = dx.PortHamiltonian(lambda x: x @ x / 2, J=np.zeros((1, 1)), B=np.ones((1, 1)))
    drive = lambda t, x: 3.0 * jnp.stack([t]) ** 2
    sol = dx.simulate(system, dx.DiscreteDirac(), x=[1.0], inputs=drive, step=0.1, steps=10)
    middles = 0.1 * np.arange(10) + 0.05
    np.testing.assert_allclose(sol.x[:, 0], 1 + np.append(0, np.cumsum(0.3 * middles**2)), rtol=1e-13)


# ---------------------------------------------------------------------------------------------- progress and compiled code


@ENGINES
def test_progress_is_reported_to_the_end(engine):
    seen = []
    dx.simulate(
        OSCILLATOR, PLUS, q=[1.0], v=[0.0], step=0.1, steps=500, save_every=3, engine=engine, progress=lambda *s: seen.append(s)
    )
    assert seen and seen[-1] == (500, 500)
    done = [step for step, _ in seen]
    assert done == sorted(done)


def test_a_progress_bar_is_shown_and_removed(capsys):
    assert dx.simulate(OSCILLATOR, PLUS, q=[1.0], v=[0.0], step=0.1, steps=50, progress=True).ok
    assert "Traceback" not in capsys.readouterr().err


@pytest.mark.soak
def test_equal_runs_compile_once(compiled):
    """Another step size, time, start or parameter value reuses the compiled code."""
    run = lambda **change: dx.simulate(
        SPRING,
        PLUS,
        **({"q": [1.0], "v": [0.0], "params": {"m": 1.0, "k": 2.0}, "step": 0.1, "steps": 10, "engine": "xla"} | change),
    )
    run()
    compiled.clear()
    run(step=0.05, t0=1.0)
    run(q=[2.0], v=[1.0], params={"m": 2.0, "k": 1.0})
    assert compiled == []
    run(q=[1.0, 2.0], v=[0.0, 0.0])
    assert compiled  # the listener does see compilations


@ENGINES
@pytest.mark.soak_of("xla")
def test_runs_are_reproducible(engine):
    run = lambda: dx.simulate(
        SKATE, PLUS, q=[0.0, 0.0, 0.3], v=[np.cos(0.3), np.sin(0.3), 1.0], params=2.0, step=0.05, steps=50, engine=engine
    )
    one, other = run(), run()
    for name in one.fields:
        np.testing.assert_array_equal(one.fields[name], other.fields[name])


@dataclasses.dataclass(frozen=True)
class Spring:
    """Params of one's own."""

    k: float


@dataclasses.dataclass
class Oscillator:
    spring: Spring
    m: float = 1.0


def test_params_are_dataclasses_that_nobody_has_registered():
    system = dx.LagrangeDirac(lambda q, v, params: (params.m * v @ v - params.spring.k * q @ q) / 2)
    given = {"q": [1.0], "v": [0.5], "step": 0.1, "steps": 5}
    sol = dx.simulate(system, PLUS, params=Oscillator(Spring(2.0), 3.0), **given)
    same = dx.simulate(SPRING, PLUS, params={"m": 3.0, "k": 2.0}, **given)
    np.testing.assert_array_equal(sol.q, same.q)
    np.testing.assert_allclose(sol.energy(), same.energy(), rtol=1e-15)
    end = lambda k: dx.simulate(system, PLUS, params=Oscillator(Spring(k)), **given).q[-1, 0]
    expected = (end(2.0 + 1e-5) - end(2.0 - 1e-5)) / 2e-5
    assert jax.grad(end)(2.0) == pytest.approx(expected, rel=1e-7)
    with pytest.raises(TypeError, match=r"params\.spring\.k is 'stiff'"):
        dx.simulate(system, PLUS, params=Oscillator(Spring("stiff")), **given)


@dataclasses.dataclass
class Incline:
    """A slope that is given in degrees, checks itself, and keeps what it makes of that."""

    slope: float
    steep: float = dataclasses.field(init=False)

    def __post_init__(self):
        if not abs(self.slope) < 90.0:
            raise ValueError("a slope falls by less than a right angle")
        self.slope = jnp.deg2rad(self.slope)
        self.steep, self._pull = jnp.sin(self.slope), 9.81 * jnp.sin(self.slope)


@pytest.mark.parametrize("engine", ["native", "xla"])
@pytest.mark.soak_of("xla")
def test_params_are_not_made_twice(engine):
    """What __post_init__ does to the numbers of a user was done again to its own result."""
    system = dx.LagrangeDirac(lambda q, v, on: v @ v / 2 - 9.81 * on.steep * q[0] / 2 - on._pull * q[0] / 2)
    given = {"q": [0.0], "v": [1.0], "step": 0.1, "steps": 10, "engine": engine}
    end = lambda on: dx.simulate(system, PLUS, params=on, **given).q[-1, 0]
    fall = end(Incline(30.0))
    assert abs(fall - (1.0 - 9.81 * np.sin(np.pi / 6) * 0.55)) <= 1e-14
    with pytest.raises(ValueError, match="right angle"):
        Incline(100.0)
    by_leaves = jax.jit(jax.grad(end))(Incline(30.0))
    assert by_leaves.slope == 0.0 and by_leaves.steep == pytest.approx(-9.81 * 0.55 / 2) == by_leaves._pull * 9.81


@pytest.mark.parametrize("engine", ["native", "xla", "sparse"])
@pytest.mark.soak_of(but=["xla"])
def test_a_last_row_that_needs_a_step_which_has_no_solution_is_warned_of(engine):
    """The saved momentum is that between two steps: with ok=True it was off by a fifth, without a word."""
    chain = gallery.get("hanging-chain")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert chain.simulate(step=4 * chain.step, steps=35, engine=engine).ok
    with pytest.warns(RuntimeWarning, match="the last row is made of the step after it"):
        chain.simulate(step=4 * chain.step, steps=36, engine=engine)
    failed, two = chain.simulate(step=4 * chain.step, steps=37, engine=engine), {k: [a, a] for k, a in chain.initial.items()}
    assert not failed.ok and "momenta and multipliers are made of the step that failed" in failed.message
    if engine != "native":  # the same from here on
        return
    batch = chain.simulate(step=4 * chain.step, steps=37, engine=engine, save_every=5, **two)
    assert "not to be trusted" not in batch.message[0]  # the last row that is kept was left by a good step
