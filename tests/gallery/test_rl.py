"""[RL] reproduced: its printed numbers, its Lagrangian from positions in space, its helix from an ODE solver."""

from typing import Any

import jax
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import dirax as dx
from dirax.gallery import charged_particle, double_spherical_pendulum, rodriguez_leok
from dirax.gallery.reproduction import AGREES, DIFFERS, NEW, WRONG
from dirax.gallery.rodriguez_leok_figures import second_mass

PARTICLE: Any = charged_particle.EXAMPLE
PENDULUM: Any = double_spherical_pendulum.EXAMPLE


@pytest.fixture(scope="module")
def reproduction():
    return rodriguez_leok.reproduction()


def test_the_paper_comes_out_but_for_its_energy(reproduction):
    verdicts = {row.quantity: row.verdict for row in reproduction.rows}
    assert reproduction.ok and DIFFERS not in verdicts.values()
    assert [name for name, verdict in verdicts.items() if verdict == WRONG] == ["pendulum: Figure 4, top"]
    assert [verdicts[f"particle: error, N = {n}"] for n in (10, 50, 100, 200)] == [AGREES] * 4
    assert verdicts["pendulum: energy E"] == AGREES and verdicts["pendulum: (θ1, φ1, θ2, φ2) at t = 100"] == NEW
    assert sorted(reproduction.figures) == ["figure_01", "figure_03", "figure_04"]


def test_end_state_of_the_pendulum(reproduction):
    row = next(row for row in reproduction.rows if row.quantity == "pendulum: (θ1, φ1, θ2, φ2) at t = 100")
    assert row.numbers["q"] == pytest.approx([-15.6278509, 3.03575496, 0.80410817, 2.51133911], abs=1e-7)
    momenta = next(row for row in reproduction.rows if "momenta" in row.quantity)
    assert momenta.numbers["p"] == pytest.approx([-0.5, 0, 0.5, 1], abs=1e-12)


def test_pendulum_lagrangian_is_that_of_two_masses_in_space():
    p = {name: float(value) for name, value in PENDULUM.params.items()}

    def height_and_speed(length, azimuth, angle, azimuth_rate, angle_rate):
        place = length * np.array([np.sin(angle) * np.cos(azimuth), np.sin(angle) * np.sin(azimuth), np.cos(angle)])
        along = length * np.array([np.cos(angle) * np.cos(azimuth), np.cos(angle) * np.sin(azimuth), -np.sin(angle)])
        around = length * np.sin(angle) * np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
        return place, along * angle_rate + around * azimuth_rate

    rng = np.random.default_rng(3)
    for _ in range(5):
        q, v = rng.normal(size=4), rng.normal(size=4)
        r1, v1 = height_and_speed(p["l1"], q[0] - q[2], q[1], v[0] - v[2], v[1])
        r2, v2 = height_and_speed(p["l2"], q[0] + q[2], q[3], v[0] + v[2], v[3])
        kinetic = p["m1"] * v1 @ v1 / 2 + p["m2"] * (v1 + v2) @ (v1 + v2) / 2
        expected = kinetic - p["g"] * (p["m1"] * r1[2] + p["m2"] * (r1 + r2)[2])
        assert float(PENDULUM.system.lagrangian(q, v, p)) == pytest.approx(expected, rel=1e-12)
        assert second_mass(q[None], p)[0] == pytest.approx(r1 + r2, rel=1e-12, abs=1e-9)


def test_exact_helix_solves_the_equations_of_motion():
    params = {"m": 1.7, "B0": 0.6}
    q, v = np.array([0.3, -0.2, 0.5, 1.0]), np.array([0.8, 0.4, -0.3, 0.9])
    grad = jax.jit(jax.grad(lambda q, v: PARTICLE.system.lagrangian(q, v, params), argnums=(0, 1)))
    hessian = jax.jit(jax.hessian(lambda q, v: PARTICLE.system.lagrangian(q, v, params), argnums=(0, 1)))

    def rate(t, state):
        force, _ = grad(state[:4], state[4:])
        blocks = hessian(state[:4], state[4:])
        return np.concatenate([state[4:], np.linalg.solve(blocks[1][1], force - blocks[1][0] @ state[4:])])

    t = np.linspace(0, 3, 7)
    oracle = solve_ivp(rate, (0, 3), np.concatenate([q, v]), "DOP853", t, rtol=1e-12, atol=1e-12).y[:4].T
    assert np.abs(charged_particle.exact(t, q, v, params) - oracle).max() < 1e-10
    with pytest.raises(ValueError, match="charge is 0"):
        charged_particle.exact(1.0, np.zeros(4), np.array([1.0, 0, 0, 0]))


def test_routh_at_the_gallery_run(reproduction):
    row = next(row for row in reproduction.rows if row.quantity == "pendulum: speed, reduced")
    assert set(row.numbers["microseconds a step"]) == {"unreduced", "reduced", "Routh"}
    assert isinstance(rodriguez_leok.REDUCED_PENDULUM, dx.ReducedLagrangeDirac)
