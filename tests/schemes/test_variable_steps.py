"""Variable steps: Kepler's orbits of eccentricity .99 against Kepler's equation, reversibility, engines, batches, derivatives."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import dirax as dx
from dirax.diagnostics.replay_lines import replayed
from dirax.engines.steps_in_numbers import StepsInNumbers
from dirax.gallery.kepler import EXAMPLE, exact
from dirax.gallery.rolling_disk import EXAMPLE as ROLLING_DISK

E = 0.99
Q, V = np.array([1 - E, 0.0]), np.array([0.0, np.sqrt((1 + E) / (1 - E))])
PERIOD = 2 * np.pi


def density(q):
    """That of Hairer and Söderlind for Kepler's problem."""
    return (q @ q) ** -0.75


LOW = dx.VariableSteps(dx.Collocation(1), density)
SCHEME = dx.VariableSteps(dx.Collocation(4), density)
RUN = {"q": Q, "v": V, "params": EXAMPLE.params}


@pytest.fixture(scope="module")
def sol():
    return dx.simulate(EXAMPLE.system, SCHEME, step=0.1, steps=1200, **RUN)


def test_steps_follow_the_motion(sol):
    assert sol.ok and sol.t[-1] > 10 * PERIOD
    np.testing.assert_array_less(np.abs(sol.step_density * (sol.q**2).sum(axis=1) ** 0.75 - 1.0), 3e-3)
    np.testing.assert_array_less(0.0, np.diff(sol.t))
    assert np.max(np.abs(sol.q - exact(sol.t, Q, V))) < 1e-5


def test_twenty_times_fewer_steps(sol):
    orbits, steps = 3, 16_000
    of_orbits = sol.t < orbits * PERIOD
    error = np.max(np.abs(sol.q[of_orbits] - exact(sol.t[of_orbits], Q, V)))
    fixed = dx.simulate(EXAMPLE.system, dx.Collocation(4), step=PERIOD / steps, steps=orbits * steps, **RUN)
    assert error < np.max(np.abs(fixed.q - exact(fixed.t, Q, V)))
    assert np.sum(of_orbits) < orbits * steps / 100


def drift(sol):
    """Of the mean energy, from the first quarter of a run to the last, and the band that the energy stays in."""
    quarters = np.array_split(sol.energy(), 4)
    return abs(np.mean(quarters[-1]) - np.mean(quarters[0])), np.ptp(quarters[0])


def test_energy_does_not_drift():
    long = dx.simulate(EXAMPLE.system, SCHEME, step=0.2, steps=60_000, save_every=7, **RUN)  # a thousand orbits
    moved, band = drift(long)
    assert band < 1e-6 and moved < 0.02 * band


@pytest.mark.soak
def test_energy_does_not_drift_over_a_hundred_thousand_orbits():
    long = dx.simulate(EXAMPLE.system, SCHEME, step=0.2, steps=5_900_000, save_every=397, **RUN)
    moved, band = drift(long)
    assert long.t[-1] > 1e5 * PERIOD and band < 1e-6 and moved < 0.02 * band


@pytest.mark.soak
def test_run_back_returns_to_the_start(sol):
    steps = StepsInNumbers.of(sol.equation, sol.given_params, False)
    params, state = np.ones((1, 1)), np.concatenate([Q, V, [density(Q)], [0.0]])[None]
    u, t, first = [np.tile(V, 4)[None]], np.zeros(1), state
    for h in [0.1] * 60 + [-0.1] * 60:  # half an orbit there and back
        made = steps.step(state, u, t, h, params)
        state, u = made.after, made.unknowns
    np.testing.assert_allclose(state, first, rtol=0, atol=2e-10 * np.max(np.abs(first)))


def test_verify_measures_it(sol):
    lines = dx.verify(sol[:400])
    assert lines["steps replayed"].verdict == lines["steps taken back"].verdict == "ok"
    assert lines["symplecticity of one step"].verdict == "not checked"


def test_a_scheme_that_is_not_self_adjoint_claims_nothing():
    one = dx.VariableSteps(dx.DiscreteDirac(dx.Theta(0.3)), density)
    run = dx.simulate(EXAMPLE.system, one, step=0.05, steps=40, **RUN)
    assert dx.verify(run)["steps taken back"].verdict == "not checked"


def test_engines_and_batches():
    q, v = np.stack([Q, [0.5, 0.1], Q]), np.stack([V, [0.0, 1.3], V])
    run = {"step": 0.1, "steps": 150, "params": EXAMPLE.params}
    batch = dx.simulate(EXAMPLE.system, LOW, q=q, v=v, **run)
    other = dx.simulate(EXAMPLE.system, LOW, q=q, v=v, engine="xla", **run)
    assert batch.t.shape == (3, 151)
    for lane in range(3):
        single = dx.simulate(EXAMPLE.system, LOW, q=q[lane], v=v[lane], **run)
        for name in batch.fields:
            assert np.array_equal(batch.fields[name][lane], single.fields[name])
        assert np.array_equal(batch[lane].t, single.t)
    np.testing.assert_allclose(batch.q, other.q, atol=1e-9)
    np.testing.assert_allclose(batch.t, other.t, rtol=1e-10)
    with pytest.raises(ValueError, match="times of their own"):
        batch[0.0:1.0]


def test_between_rows_and_events(sol):
    t = np.linspace(0.0, 3 * PERIOD, 50)
    moments = sol.at(t)
    np.testing.assert_allclose(moments.clock, t, atol=1e-12)
    assert np.max(np.abs(moments.q - exact(t, Q, V))) < 1e-3
    apsis = dx.Event(lambda q, v: q @ v, direction=+1)
    run = dx.simulate(EXAMPLE.system, SCHEME, step=0.1, steps=300, events=[apsis], **RUN)
    assert len(run.events) == 2
    np.testing.assert_allclose(run.events.t, [PERIOD, 2 * PERIOD], rtol=1e-6)
    with pytest.raises(ValueError, match="inside the run"):
        sol.at(sol.t[-1] + 1.0)


def test_files_and_longer_runs(sol, tmp_path):
    batch = dx.simulate(
        EXAMPLE.system, SCHEME, q=np.stack([Q, Q / 2]), v=np.stack([V, V / 2]), params=EXAMPLE.params, step=0.1, steps=30
    )
    for ending in (".zarr", ".nc"):
        batch.save(tmp_path / f"batch{ending}")
        loaded = dx.load(tmp_path / f"batch{ending}", system=EXAMPLE.system, scheme=SCHEME)
        assert np.array_equal(loaded.t, batch.t) and dx.verify(loaded).ok
    assert np.array_equal(batch.to_dataframe()["t"].to_numpy(), batch.t.ravel())
    assert "time" not in batch.to_xarray().coords and np.array_equal(batch.to_xarray().clock, batch.t)
    assert np.array_equal(sol.to_xarray().time, sol.t)
    assert np.array_equal(sol.to_xarray().q.sel(time=sol.t[20]), sol.q[20])
    longer = batch.extend(5)
    assert np.array_equal(longer.q[:, :31], batch.q) and longer.t.shape == (2, 36)
    thin = dx.simulate(EXAMPLE.system, SCHEME, step=0.1, steps=30, save_every=7, **RUN)
    assert np.array_equal(thin.t[:4], sol.t[:28:7])


@pytest.mark.parametrize("engine", ["native", pytest.param("xla", marks=pytest.mark.soak)])
def test_derivatives(engine):
    @jax.jit
    def end(x):
        run = dx.simulate(
            EXAMPLE.system, LOW, q=jnp.stack([x, 0.2]), v=[0.1, 1.1], params=EXAMPLE.params, step=0.1, steps=30, engine=engine
        )
        return run.q[-1, 1] + 2.0 * run.t[-1] + (run.at(1.0).q[0] if engine == "native" else 0.0)

    d = 1e-3
    by_differences = (8 * (end(0.8 + d) - end(0.8 - d)) - (end(0.8 + 2 * d) - end(0.8 - 2 * d))) / (12 * d)
    assert abs(jax.grad(end)(0.8) - by_differences) < 1e-8 * abs(by_differences)


@pytest.mark.soak
def test_the_local_frequency_is_the_density_of_kepler():
    own = dx.simulate(EXAMPLE.system, dx.VariableSteps(dx.Collocation(2)), step=0.1 * 5**0.25, steps=60, **RUN)
    given = dx.simulate(EXAMPLE.system, dx.VariableSteps(dx.Collocation(2), density), step=0.1, steps=60, **RUN)
    np.testing.assert_allclose(own.step_density, 5**0.25 * given.step_density, rtol=1e-10)
    np.testing.assert_allclose(own.t, given.t, rtol=1e-9)
    x = dx.DiracSystem(dx.DiracStructure.from_two_form(lambda x: jnp.array([[0.0, 1.0], [-1.0, 0.0]])), lambda x: 2.0 * x @ x)
    of_points = dx.simulate(x, dx.VariableSteps(dx.Collocation(2)), x=[0.3, 0.1], step=0.1, steps=5)
    np.testing.assert_allclose(of_points.step_density, 4.0 * 2**0.25, rtol=1e-12)  # ‖(4J)²‖^(1/2)


def hamiltonian(x):
    return x @ x / 2 + 0.25 * x[0] ** 4 + 0.15 * (x[0] * x[1]) ** 2 + 0.2 * x[0] * x[2]


def two_form(x):
    upper = jnp.array([[0, 0.3 * x[2], 1 + 0.2 * x[0] ** 2, 0], [0, 0, 0.1, 1], [0, 0, 0, 0.2], [0, 0, 0, 0]])
    return upper - upper.T


def of_points(x):
    return 1.0 + x[0] ** 2


@pytest.mark.parametrize(
    ("system", "start"),
    [
        (dx.DiracSystem(dx.DiracStructure.from_two_form(two_form), hamiltonian), {"x": [0.4, 0.3, -0.2, 0.5]}),
        (
            dx.PhaseSpaceLagrangian(lambda q: jnp.array([q[1] + q[1] ** 3, 0.0]), lambda q: q @ q / 2 + 0.3 * q[0] ** 3),
            {"q": [0.4, 0.3]},
        ),
    ],
)
@pytest.mark.soak_of("system0-start0")
def test_steps_of_a_two_form_run_natively_and_are_checked(system, start):
    sol = dx.simulate(system, dx.VariableSteps(dx.DiscreteDirac(), of_points), **start, step=0.05, steps=40)
    assert sol.stats["engine"] == "native"
    name = "x" if "x" in sol.fields else "q"
    rows = sol.fields[name]
    np.testing.assert_allclose(sol.step_density, [of_points(row) for row in rows], rtol=1e-3)
    report = dx.verify(sol)
    assert report.ok and report["steps replayed"].verdict == report["steps taken back"].verdict == "ok"
    damaged = np.array(rows)
    damaged[20, 1] *= 1.001
    assert dx.verify(sol.replace(fields={**sol.fields, name: damaged}))["steps replayed"].verdict == "VIOLATED"


def test_degenerate_two_forms_are_refused_with_the_way_out():
    """H = (x² + a⁴/2)/2 with ω = da ∧ db in a and b alone: ẋ is determined up to the other two coordinates."""
    turn = np.random.default_rng(0).normal(size=(4, 4))
    flat = np.zeros((4, 4))
    flat[0, 1], flat[1, 0] = 1.0, -1.0
    for basis in (np.eye(4), turn):
        form = basis.T @ flat @ basis
        system = dx.DiracSystem(dx.DiracStructure.from_two_form(lambda x, form=form: jnp.asarray(form)), hamiltonian)
        with pytest.raises(ValueError, match=r"determine ẋ.*from_kernel"):
            dx.simulate(system, dx.VariableSteps(dx.DiscreteDirac(), of_points), x=[0.4, 0.3, -0.2, 0.5], step=0.05, steps=5,
                        check_initial=False)  # fmt: skip


def test_time_is_that_of_the_system():
    """q̇ = v, L = v²/2 + q cos t: q(t) = 1 − cos t from rest."""
    driven = dx.LagrangeDirac(lambda t, q, v: v @ v / 2 + q[0] * jnp.cos(t))
    run = dx.simulate(
        driven, dx.VariableSteps(dx.Collocation(4), lambda t, q: 2.0 + jnp.sin(t)), q=[0.0], v=[0.0], step=0.2, steps=60, t0=0.0
    )
    np.testing.assert_allclose(run.q[:, 0], 1.0 - np.cos(run.t), atol=1e-10)


def test_nonholonomic_steps_of_both_kinds_come_to_the_same_motion():
    disk = ROLLING_DISK
    start, ends = disk.initial | {"params": disk.params}, []
    for scheme in (dx.LagrangeDAlembert(), dx.DiscreteDirac(constraints="resolve")):
        variable = dx.VariableSteps(scheme, lambda q: 1.0 + 0.5 * jnp.sin(q[2]))
        run = dx.simulate(disk.system, variable, step=0.02, steps=200, **start)
        assert np.ptp(run.energy()) < 1e-3 * abs(run.energy()[0]) and dx.verify(run)["steps taken back"].verdict == "ok"
        moment = run.at(2.0)
        assert abs(moment.clock - 2.0) < 1e-13
        ends.append(moment.q)
    np.testing.assert_allclose(*ends, atol=2e-2)


def test_compositions_of_variable_steps_have_their_order():
    errors, sizes = [], [0.08, 0.04, 0.02]
    composed = dx.Composition(dx.VariableSteps(dx.DiscreteDirac(), density), "suzuki4")
    q, v = np.array([0.4, 0.0]), np.array([0.0, 2.0])
    for h in sizes:
        run = dx.simulate(EXAMPLE.system, composed, q=q, v=v, params=EXAMPLE.params, step=h, steps=round(4 / h))
        errors.append(np.max(np.abs(run.q - exact(run.t, q, v))))
    assert abs(np.polyfit(np.log(sizes), np.log(errors), 1)[0] - 4.0) < 0.3


@pytest.mark.parametrize(
    "scheme, error, words",
    [
        (lambda: dx.VariableSteps(dx.Collocation(2), lambda q: -1.0), ValueError, "density must be positive"),
        (lambda: dx.VariableSteps(dx.Collocation(2), lambda q: jnp.nan), ValueError, "density must be positive"),
        (lambda: dx.VariableSteps(dx.Collocation(2), lambda q: q), ValueError, "density.* must return a scalar"),
        (lambda: dx.VariableSteps(dx.Collocation(2), 3.0), TypeError, "density must be a function"),
        (lambda: dx.VariableSteps(dx.Collocation, density), TypeError, "scheme must be a dirax scheme"),
        (lambda: dx.VariableSteps(dx.Composition(dx.DiscreteDirac(), "suzuki4"), density), TypeError, "compose the variable"),
    ],
)
@pytest.mark.soak_of("<lambda>-ValueError-density must be positive0")
def test_bad_input(scheme, error, words):
    with pytest.raises(error, match=words):
        dx.simulate(EXAMPLE.system, scheme(), step=0.1, steps=5, **RUN)


def test_more_bad_input():
    with pytest.raises(ValueError, match="not from two points"):
        dx.simulate(EXAMPLE.system, SCHEME, q0=Q, q1=Q, params=EXAMPLE.params, step=0.1, steps=5)
    with pytest.raises(ValueError, match="common times"):
        dx.convergence(EXAMPLE.system, SCHEME, step_sizes=[0.1, 0.05, 0.025], time=0.1, **RUN)
    falls = dx.VariableSteps(dx.Collocation(2), lambda q: 0.3 - q @ q)
    ended = dx.simulate(EXAMPLE.system, falls, step=0.01, steps=50, **RUN)
    assert not ended.ok and "density has come down" in ended.message


def test_the_local_frequency_does_not_depend_on_units():
    """A length beside an angle, and a circuit of charge and flux: the clock is the same in any units, to the last bit."""
    arm = dx.LagrangeDirac(
        lambda q, v, l: (v[0] ** 2 + l**2 * v[1] ** 2) / 2 - q[0] ** 2 / 2 - 0.4 * l * q[0] * q[1] - l**2 * q[1] ** 2
    )
    circuit = dx.PortHamiltonian(
        lambda x, f: f * x[0] ** 2 / 2 + x[1] ** 2 / f / 2,
        J=jnp.array([[0.0, 1.0], [-1.0, 0.0]]),
        R=lambda x, f: jnp.diag(jnp.stack([0.0 * f, 0.3 * f])),
    )
    run = {"step": 0.05, "steps": 20}
    for system, start in ((arm, lambda l: {"q": [l, 0.0], "v": [0.0, 0.3]}), (circuit, lambda f: {"x": [1.0, 0.0]})):
        one, other = (dx.simulate(system, SCHEME_OF_LOCAL_FREQUENCY, params=u, **start(u), **run) for u in (1.0, 2.0**-20))
        np.testing.assert_array_equal(one.t, other.t)


SCHEME_OF_LOCAL_FREQUENCY = dx.VariableSteps(dx.Collocation(2))


@pytest.mark.parametrize("scheme", [dx.LagrangeDAlembert(), dx.Collocation(2, nodes="lobatto")])
@pytest.mark.soak
def test_impulses_over_the_lengths_of_their_steps_are_means_of_the_force(scheme):
    """The tension of a pendulum, of second order as the mean of the step, of first as the value at the row."""
    pendulum = dx.LagrangeDirac(lambda q, v: v @ v / 2 - q[1], holonomic=lambda q: jnp.array([(q @ q - 1.0) / 2]))
    start, errors = {"q": [np.sin(1.2), -np.cos(1.2)], "v": [0.0, 0.0]}, []
    motion = solve_ivp(
        lambda t, y: [y[1], -np.sin(y[0])], (0.0, 4.0), [1.2, 0.0], method="DOP853", rtol=1e-12, atol=1e-13, dense_output=True
    )
    tension = lambda t: motion.sol(t)[1] ** 2 + np.cos(motion.sol(t)[0])
    for h in (0.04, 0.02, 0.01):
        sol = dx.simulate(pendulum, dx.VariableSteps(scheme, lambda q: 1.3 + q[0]), step=h, steps=round(2.0 / h), **start)
        np.testing.assert_allclose(sol.step_length, np.diff(sol.t), atol=1e-14)
        mean = (tension(sol.t[:-1]) + 4 * tension(sol.t[:-1] + sol.step_length / 2) + tension(sol.t[1:])) / 6
        forces = sol.multipliers[:, 0] / sol.step_length
        errors.append([np.max(np.abs(forces - mean)), np.max(np.abs(forces - tension(sol.t[:-1])))])
        few = dx.simulate(
            pendulum, dx.VariableSteps(scheme, lambda q: 1.3 + q[0]), step=h, steps=round(2.0 / h), save_every=5, **start
        )
        np.testing.assert_allclose(few.multipliers[:, 0] / few.step_length, forces[::5], atol=1e-9)
    np.testing.assert_allclose(np.log2(np.divide(errors[:-1], errors[1:])), [[2, 1], [2, 1]], atol=0.1)


def test_lengths_of_composed_steps_are_summed():
    pendulum = dx.LagrangeDirac(lambda q, v: v @ v / 2 - q[1], holonomic=lambda q: jnp.array([q @ q - 1.0]))
    scheme = dx.Composition(dx.VariableSteps(dx.LagrangeDAlembert(), lambda q: 1.3 + q[0]))
    sol = dx.simulate(pendulum, scheme, q=[0.6, -0.8], v=[0.4, 0.3], step=0.05, steps=20)
    np.testing.assert_allclose(sol.step_length, np.diff(sol.t), atol=1e-14)
    assert "step_length" not in LOW.step_equation(EXAMPLE.system, dx.Shape(2)).fields


def test_on_a_sphere():
    """Natively, of order 2, and a shifted point is seen: a search for the velocity in every step was left to XLA."""
    lagrangian = lambda q, v: v @ v / 2 * (1 + 0.3 * q[0] ** 2) - 0.8 * q[2] - 0.2 * q[0]
    system, start = dx.ManifoldLagrangian(lagrangian, dx.Sphere(3)), {"q": [0.6, 0.0, -0.8], "v": [0.4, 0.7, 0.3]}
    exact = dx.simulate(system, dx.Collocation(2), **start, step=0.01, steps=130).q[-1]
    scheme, errors = dx.VariableSteps(dx.LagrangeDAlembert(), density=lambda q: 2.0 + q[0]), []
    for n in (80, 160):
        sol = dx.simulate(system, scheme, **start, step=4.0 / n, steps=n)
        assert sol.ok and sol.stats["engine"] == "native"
        errors.append(np.max(np.abs(sol.at(1.3).q - exact)))
    assert np.log2(errors[0] / errors[1]) == pytest.approx(2.0, abs=0.1)
    assert dx.verify(sol).ok
    q = sol.q.copy()
    q[50] += 1e-8 * np.array([0.8, 0.0, 0.6])
    assert replayed(sol.replace(fields=sol.fields | {"q": q}), None).verdict == "VIOLATED"


def test_constraints_that_follow_from_others_are_named():
    twice = dx.LagrangeDirac(lambda q, v: v @ v / 2 - q[1], holonomic=lambda q: jnp.array([1.0, 2.0]) * (q @ q - 1.0))
    with pytest.raises(ValueError, match=r"must not follow from others, as number 1 does .*: leave it out"):
        scheme = dx.VariableSteps(dx.LagrangeDAlembert(), lambda q: 1 + q @ q)
        dx.simulate(twice, scheme, q=[0.6, -0.8], v=[0.0, 0.0], step=0.05, steps=3)
