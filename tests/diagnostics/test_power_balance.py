"""The power balance and the books of systems with ports, as `dx.verify` reports them."""

import re

import jax.numpy as jnp
import numpy as np
import pytest

import dirax as dx

J = np.array([[0.0, 1.0], [-1.0, 0.0]])
R = np.diag([0.0, 0.2])
B = np.array([[0.0], [1.0]])


def hamiltonian(x):
    return x[1] ** 2 / 2 + x[0] ** 2 / 2 + x[0] ** 4 / 4


def driven(scheme, steps=400, **changes):
    system = dx.PortHamiltonian(hamiltonian, J, B, R)
    force = lambda t, x: 0.3 * jnp.sin(1.1 * t)[None]
    return dx.simulate(system, scheme, x=[1.0, 0.0], step=0.05, steps=steps, inputs=force, **changes)


def test_a_discrete_gradient_keeps_its_books():
    sol = driven(dx.DiscreteGradient())
    report = dx.verify(sol)
    step, whole = report["power balance of every step"], report["books of the energy"]
    assert (step.verdict, whole.verdict) == ("ok", "ok") and report.ok
    # by hand: H and the work of the force, without the report's own sums
    x, h = np.asarray(sol.x), 0.05
    energy = x[:, 1] ** 2 / 2 + x[:, 0] ** 2 / 2 + x[:, 0] ** 4 / 4
    gradient = np.diff(x[:, 0]) / h  # ẋ_1 = ∇̄H_2 is the output
    supplied = h * np.sum(0.3 * np.sin(1.1 * (sol.t[:-1] + h / 2)) * gradient)
    dissipated = h * np.sum(0.2 * gradient**2)
    assert whole.details["supplied"] == pytest.approx(supplied, rel=1e-11)
    assert whole.details["dissipated"] == pytest.approx(dissipated, rel=1e-11)
    assert energy[-1] - energy[0] == pytest.approx(supplied - dissipated, abs=1e-12)
    assert report["energy"].verdict == "not checked"  # driven and damped: it has no business to be constant


def test_a_conserved_energy_is_judged_too():
    closed = dx.PortHamiltonian(hamiltonian, J)
    report = dx.verify(dx.simulate(closed, dx.DiscreteGradient(), x=[1.0, 0.0], step=0.1, steps=800))
    assert report["energy"].verdict == "bounded" and report["books of the energy"].verdict == "ok"


def test_the_midpoint_map_balances_its_own_power_and_has_no_books():
    report = dx.verify(driven(dx.DiscreteDirac()))
    assert report["power balance of every step"].verdict == "ok"
    with pytest.raises(KeyError):
        report["books of the energy"]


@pytest.mark.parametrize("changed", ["x", "work", "power"])
@pytest.mark.soak_of("x", "power")
def test_cooked_books_are_found(changed):
    sol = driven(dx.DiscreteGradient(), steps=50)
    values = np.array(sol.fields[changed])
    values[20, 0] *= 1 + 1e-9
    sol.fields[changed] = values
    report = dx.verify(sol)
    lines = [report["power balance of every step"].verdict, report["books of the energy"].verdict]
    assert "VIOLATED" in lines and not report.ok


def test_batches_and_saved_rows():
    system = dx.PortHamiltonian(hamiltonian, J, R=R)
    start = np.array([[1.0, 0.0], [0.0, 2.0], [0.5, -0.5]])
    report = dx.verify(dx.simulate(system, dx.DiscreteGradient("mean-value"), x=start, step=0.1, steps=60, save_every=7))
    assert report["power balance of every step"].verdict == report["books of the energy"].verdict == "ok"


@pytest.mark.parametrize("scheme", [dx.DiscreteGradient(), dx.DiscreteDirac(), dx.EnergyCollocation()])
@pytest.mark.soak_of(but=["scheme1"])
def test_a_system_at_rest_balances(scheme):
    """Nothing is stored, supplied or dissipated: 0/0 was a violation."""
    system = dx.PortHamiltonian(hamiltonian, J, B, R)
    sol = dx.simulate(system, scheme, x=[0.0, 0.0], step=0.05, steps=20, inputs=lambda t, x: jnp.zeros(1))
    report = dx.verify(sol)
    assert np.all(np.asarray(sol.x) == 0.0) and report.ok
    assert [line.value for line in report.lines if "balance" in line.quantity or "books" in line.quantity] in ([0.0], [0.0, 0.0])


@pytest.mark.soak
def test_books_over_a_million_steps():
    sol = driven(dx.DiscreteGradient(), steps=1_000_000, save_every=1000)
    line = dx.verify(sol)["books of the energy"]
    assert line.verdict == "ok" and line.value < 1e-14


@pytest.mark.parametrize("batch", [False, True])
@pytest.mark.soak_of("False")
def test_a_resistance_that_becomes_negative_on_the_way_is_said(batch):
    """R is asked for where a run begins; here it creates energy where x < 1/2, and every balance is kept."""
    system = dx.PortHamiltonian(
        lambda x: x @ x / 2,
        J=jnp.array([[0.0, 1.0], [-1.0, 0.0]]),
        R=lambda x: jnp.diag(jnp.stack([0.0 * x[0], 0.1 * (x[0] - 0.5)])),
    )
    start = np.array([[1.0, 0.0], [1.0, 0.2]]) if batch else np.array([1.0, 0.0])
    sol = dx.simulate(system, dx.DiscreteGradient(), x=start, step=0.05, steps=400)
    line = dx.verify(sol)["premise"]
    assert line.verdict == "VIOLATED" and "R is not positive semidefinite: its lowest" in line.explanation
    time = float(re.match("at t = ([0-9.]+)", line.explanation)[1])
    row = round(time / 0.05)
    assert (sol.x[0] if batch else sol.x)[row, 0] < 0.5
    early = dx.simulate(system, dx.DiscreteGradient(), x=start, step=0.05, steps=10)
    assert all(line.quantity != "premise" for line in dx.verify(early).lines)
