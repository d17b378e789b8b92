"""Hard cases for nonholonomic integrators: their equations by hand, and what long runs do to the energy."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import dirax as dx
from dirax.diagnostics.drift import judge
from dirax.gallery import contact_particle, transmission

METHOD_2 = dx.DiscreteDirac(constraints="resolve")


def contact_by_hand(t, w, beta, kappa):
    """(x, y, z, ẋ, ẏ) of the contact particle: the multiplier λ of dz − y dx eliminated by z̈ = ẏ ẋ + y ẍ."""
    x, y, z, vx, vy = w
    fx = -x - kappa * np.sin(y + z) + beta * vy
    fy = -y - kappa * x * np.cos(y + z) - beta * vx
    fz = -kappa * (x * np.cos(y + z) + z)
    multiplier = (vy * vx + y * fx - fz) / (1 + y**2)
    return [vx, vy, y * vx, fx - y * multiplier, fy]


def transmission_by_hand(t, w, beta):
    """(x, y, ξ, ẋ, ξ̇) of the transmission: ẏ = sin ξ ẋ, ÿ = cos ξ ξ̇ ẋ + sin ξ ẍ."""
    x, y, angle, vx, rate = w
    vy, s, c = np.sin(angle) * vx, np.sin(angle), np.cos(angle)
    fx, fy = -x + beta * rate, -y + beta * y * rate
    turn = -s - beta * vx - beta * y * vy
    multiplier = (c * rate * vx + s * fx - fy) / (1 + s**2)
    return [vx, vy, rate, fx - s * multiplier, turn]


CASES = [
    (contact_particle.EXAMPLE, contact_particle.CASES["integrable"], contact_by_hand, (0, 1)),
    (contact_particle.EXAMPLE, contact_particle.CASES["irreversible"], contact_by_hand, (0, 1)),
    (transmission.EXAMPLE, transmission.CASES["irreversible"], transmission_by_hand, (0, 2)),
]


@pytest.mark.parametrize(("example", "params", "by_hand", "free"), CASES)
@pytest.mark.soak_of(but=["example1-params1-contact_by_hand-free1"])
def test_method_2_converges_to_the_equations_by_hand(example, params, by_hand, free):
    q, v = example.initial["q"], example.initial["v"]
    start = np.concatenate([q, v[list(free)]])
    end = solve_ivp(by_hand, (0, 2.0), start, args=tuple(params.values()), rtol=1e-12, atol=1e-13).y[:3, -1]
    errors = []
    for steps in (20, 40, 80):
        sol = example.simulate(METHOD_2, step=2.0 / steps, steps=steps, params=params)
        errors.append(np.abs(sol.q[-1] - end).max())
        assert np.abs(sol.constraint_residual()).max() < 1e-14
    assert -np.diff(np.log2(errors)) == pytest.approx([2.0, 2.0], abs=0.15)


def test_what_drives_the_integrable_cases_moves_by_itself():
    """y of the contact particle is a harmonic oscillator; the pendulum of the transmission keeps its own energy."""
    sol = contact_particle.EXAMPLE.simulate(dx.Composition(METHOD_2, "suzuki4"), step=0.05, steps=100)
    q, v = contact_particle.EXAMPLE.initial["q"], contact_particle.EXAMPLE.initial["v"]
    np.testing.assert_allclose(sol.q[:, 1], q[1] * np.cos(sol.t) + v[1] * np.sin(sol.t), atol=1e-6)
    sol = transmission.EXAMPLE.simulate(step=0.05, steps=400)
    pendulum = np.asarray(sol.p)[:, 2] ** 2 / 2 - np.cos(sol.q[:, 2])
    assert np.ptp(pendulum) < 2e-4


LONG = [
    (contact_particle.EXAMPLE, contact_particle.CASES["integrable"], 1e-7),
    (contact_particle.EXAMPLE, contact_particle.CASES["perturbed, reversible"], 1e-4),
    (transmission.EXAMPLE, transmission.CASES["integrable"], 1e-4),
]


@pytest.mark.soak
@pytest.mark.parametrize(("example", "params", "band"), LONG)
def test_energy_stays_in_its_band_where_the_system_is_reversible(example, params, band):
    sol = example.simulate(METHOD_2, steps=1_000_000, save_every=50, params=params)
    energy = np.asarray(sol.energy())
    found = judge(np.asarray(sol.t), energy, np.asarray(sol.q), 1e-13)
    assert sol.ok and found.verdict == "bounded" and np.ptp(energy) < band, found
