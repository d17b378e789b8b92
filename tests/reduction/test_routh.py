"""Discrete Routh equations, connections that are not linear, constraints and bad input in reduction."""

import jax.numpy as jnp
import numpy as np
import pytest

import dirax as dx
from dirax.gallery import charged_particle, double_spherical_pendulum, rolling_disk
from dirax.reduction.connection import DiscreteConnection
from dirax.reduction.symmetry import cyclic_coordinates
from dirax.schemes.routh import DiscreteRouth

TWISTED = [[0.3, -0.2, 0.1]]
CURVED = DiscreteConnection(
    lambda q0, q1: q1[3:] - q0[3:] + (q0[:1] + 2 * q1[:1]) * (q1[1:2] - q0[1:2]) + (q1[2:3] - q0[2:3]) ** 2, fibre=[3]
)
PARTICLE, PENDULUM, DISK = charged_particle.EXAMPLE, double_spherical_pendulum.EXAMPLE, rolling_disk.EXAMPLE


def run(example, system, scheme, steps=500, **changes):
    settings = {**example.initial, "params": dict(example.params), "step": example.step, "steps": steps}
    return dx.simulate(system, scheme, **{**settings, **changes})


@pytest.fixture(scope="module")
def particle():
    return run(PARTICLE, PARTICLE.system, dx.PlusLagrangeDirac("midpoint"))


@pytest.mark.parametrize(
    ("scheme", "connection"),
    [
        (dx.PlusLagrangeDirac, dx.LinearConnection([3], TWISTED)),
        (dx.PlusLagrangeDirac, CURVED),
        (dx.MinusLagrangeDirac, CURVED),
        (DiscreteRouth, dx.LinearConnection([3])),
        (DiscreteRouth, CURVED),
    ],
)
def test_particle_on_the_quotient_is_the_particle(particle, scheme, connection):
    quotient = run(PARTICLE, dx.reduce(PARTICLE.system, connection), scheme("midpoint"))
    lifted = dx.reconstruct(quotient)
    assert np.abs(lifted.q - particle.q).max() < 1e-10 and np.abs(lifted.p - particle.p).max() < 1e-10
    assert np.all(quotient.mu == quotient.mu[0])
    vertical = connection.one_form(particle.q[7], particle.q[8])
    assert quotient.vertical[7] == pytest.approx(np.asarray(vertical), abs=1e-11)


@pytest.mark.parametrize("horizontal", [TWISTED])
def test_routh_pendulum_is_the_unreduced_one(horizontal):
    unreduced = run(PENDULUM, PENDULUM.system, dx.PlusLagrangeDirac("midpoint"))
    quotient = run(PENDULUM, dx.reduce(PENDULUM.system, dx.LinearConnection([0], horizontal)), DiscreteRouth("midpoint"))
    assert quotient.equation.unknowns == 3
    assert np.abs(dx.reconstruct(quotient).q - unreduced.q).max() < 1e-10


def test_routh_where_l_is_not_quadratic_in_the_group_velocity():
    relativistic = dx.LagrangeDirac(lambda q, v: -jnp.sqrt(1 - v[0] ** 2 - q[0] ** 2 * v[1] ** 2) + 0.2 / q[0])
    start = {"q": [1.0, 0.0], "v": [0.1, 0.5], "step": 0.02, "steps": 300}
    unreduced = dx.simulate(relativistic, dx.PlusLagrangeDirac("midpoint"), **start)
    reduced = dx.reduce(relativistic, dx.LinearConnection(cyclic_coordinates(relativistic, [1.0, 0.0], radius=0.3)))
    quotient = dx.simulate(reduced, DiscreteRouth("midpoint"), **start)
    assert quotient.ok and np.abs(dx.reconstruct(quotient).q - unreduced.q).max() < 1e-11


@pytest.mark.parametrize(
    ("scheme", "connection"),
    [
        (dx.PlusLagrangeDirac(), dx.LinearConnection([0, 1])),
        (dx.MinusLagrangeDirac("midpoint"), dx.LinearConnection([0, 1], [[0.2, 0.1], [-0.3, 0.4]])),
    ],
)
def test_rolling_disk_with_its_place_removed_is_the_rolling_disk(scheme, connection):
    """Constraints that respect the symmetry: x and y of the contact point are cyclic, the rolling force moves their momenta."""
    start = {name: DISK.initial[name] for name in ("q", "v")}
    unreduced = run(DISK, DISK.system, scheme, **start)
    quotient = run(DISK, dx.reduce(DISK.system, connection), scheme, **start)
    lifted = dx.reconstruct(quotient)
    assert np.abs(lifted.q - unreduced.q).max() < 1e-10 and np.abs(lifted.p - unreduced.p).max() < 1e-10
    assert np.abs(quotient.multipliers - unreduced.multipliers).max() < 1e-6 * np.abs(unreduced.multipliers).max()
    assert np.ptp(quotient.mu[:, 0]) > 1.0


def test_mistakes():
    start = {"params": dict(PENDULUM.params), "v": np.full(4, 0.1), "step": 0.01, "steps": 3}
    with pytest.raises(ValueError, match="orbits of the group are not free at the initial point"):
        dx.simulate(dx.reduce(PENDULUM.system, dx.LinearConnection([0])), DiscreteRouth(), q=np.array([0.0, 0, 1, 0]), **start)
    with pytest.raises(TypeError, match=r"made by dx\.reduce"):
        dx.simulate(PENDULUM.system, DiscreteRouth(), **{**start, "q": np.ones(4)})
    with pytest.raises(ValueError, match="fixes μ, which the forces of the 2 constraints"):
        run(DISK, dx.reduce(DISK.system, dx.LinearConnection([0, 1])), DiscreteRouth(), 3)
    drifting = dx.LagrangeDirac(lambda q, v: v[0] ** 2 / 2 + v[0] * v[1])
    with pytest.raises(ValueError, match="group inertia"):
        dx.simulate(dx.reduce(drifting, dx.LinearConnection([1])), DiscreteRouth(), q=[0.0, 0.0], v=[0.1, 0.2], step=0.1, steps=3)
    broken = DiscreteConnection(lambda q0, q1: q1[3:] - q0[3:] + q0[:1], fibre=[3])
    with pytest.raises(ValueError, match=r"ω_d\(q, q\) = 0 fails by"):
        run(PARTICLE, dx.reduce(PARTICLE.system, broken), DiscreteRouth(), 3)
    twice = DiscreteConnection(lambda q0, q1: 2 * (q1[3:] - q0[3:]), fibre=[3])
    with pytest.raises(ValueError, match=r"ω_d\(q0 \+ g0, q1 \+ g1\)"):
        run(PARTICLE, dx.reduce(PARTICLE.system, twice), DiscreteRouth(), 3)
