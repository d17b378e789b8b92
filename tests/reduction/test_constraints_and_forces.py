"""Reduction of systems with constraints, forces and time that the symmetry leaves alone: the unreduced system as oracle."""

import jax.numpy as jnp
import numpy as np
import pytest

import dirax as dx
from dirax.gallery import charged_particle, heisenberg, rolling_disk

DISK, HEISENBERG, PARTICLE = rolling_disk.EXAMPLE, heisenberg.EXAMPLE, charged_particle.EXAMPLE
OUTGOING = dx.LagrangeDAlembert(momentum="outgoing")
TWIST = np.array([[0.2, 0.1, -0.3], [-0.3, 0.4, 0.1], [0.1, -0.2, 0.2]])
STEPS = 500


def compared(system, scheme, fibre, twisted: bool, **settings):
    """The unreduced and the lifted reduced run, and the reduced one; all fields of the first two equal to 1e-10."""
    n = len(settings["q"])
    horizontal = TWIST[: len(fibre), : n - len(fibre)] if twisted else None
    settings = {"steps": STEPS, "engine": "native", **settings}
    unreduced = dx.simulate(system, scheme, **settings)
    quotient = dx.simulate(dx.reduce(system, dx.LinearConnection(fibre, horizontal)), scheme, **settings)
    lifted = dx.reconstruct(quotient)
    assert unreduced.ok and quotient.ok and set(lifted.fields) == set(unreduced.fields)
    for name, values in unreduced.fields.items():
        # multipliers and constraints are quotients of roundoff by the step
        tolerance = 1e-10 if name in ("q", "p", "work") else 1e-8
        assert np.abs(lifted.fields[name] - values).max() < tolerance * max(1.0, np.abs(values).max()), name
    return unreduced, lifted, quotient


@pytest.mark.parametrize(
    ("scheme", "twisted"), [(dx.PlusLagrangeDirac(), False), (dx.MinusLagrangeDirac("midpoint"), True), (OUTGOING, True)]
)
@pytest.mark.soak_of(but=["scheme2-True"])
def test_rolling_disk_without_its_place(scheme, twisted):
    """x and y of the contact point are cyclic; the rolling force moves their momenta."""
    _, _, quotient = compared(
        DISK.system, scheme, [0, 1], twisted, q=DISK.initial["q"], v=DISK.initial["v"], params=DISK.params, step=1e-3
    )
    assert np.ptp(quotient.mu[:, 0]) > 0.3
    assert np.abs(quotient.constraint).max() < 1e-12


@pytest.mark.soak
def test_rolling_disk_without_potential_has_its_angle_too():
    free = dict(DISK.params) | {"V": 0.0}
    start = {"q": DISK.initial["q"], "v": DISK.initial["v"], "params": free, "step": 0.01}
    assert dx.cyclic_coordinates(DISK.system, DISK.initial["q"], params=free) == (0, 1, 2)
    assert dx.cyclic_coordinates(DISK.system, DISK.initial["q"], params=DISK.params) == (0, 1)
    _, _, quotient = compared(DISK.system, dx.LagrangeDAlembert(), [0, 1, 2], True, **start)
    assert quotient.x.shape == (STEPS + 1, 1)
    with pytest.raises(ValueError, match=r"one_forms is not invariant under translation of q\[3\]: the motion of its one-forms"):
        dx.simulate(dx.reduce(DISK.system, dx.LinearConnection([0, 3])), dx.LagrangeDAlembert(), steps=2, **start)


@pytest.mark.soak
def test_heisenberg_without_its_height():
    start = {"q": [1.0, 0.0, 0.1], "v": [0.5, 1.0, -1.0], "step": 0.01}
    assert dx.check_invariance(HEISENBERG.system, dx.Translations([2]), q=start["q"])
    compared(HEISENBERG.system, dx.PlusLagrangeDirac(), [2], True, project=True, **start)


@pytest.mark.soak
def test_holonomic_constraint_force_and_time():
    """A cart on a moving belt of springs with a pendulum on a rod: X cyclic, x² + y² = 1, drag, and a driven length of L."""

    def lagrangian(t, q, v):
        speed = v[1:] + jnp.array([v[0], 0.0])
        return v[0] ** 2 + speed @ speed / 2 - (2 + jnp.cos(3 * t)) * q[2]

    cart = dx.LagrangeDirac(
        lagrangian,
        holonomic=lambda q: jnp.array([q[1:] @ q[1:] - 1.0]),
        forces=lambda t, q, v: jnp.array([0.3 * jnp.sin(t) - 0.1 * v[0], 0.0, -0.2 * v[2]]),
    )
    start = {"q": [0.0, 0.6, -0.8], "v": [0.3, 0.4, 0.3], "step": 0.01}
    _, lifted, quotient = compared(cart, dx.LagrangeDAlembert(), [0], True, **start)
    assert np.abs(lifted.q[:, 1] ** 2 + lifted.q[:, 2] ** 2 - 1).max() < 1e-13
    assert np.ptp(quotient.mu) > 0.05 and np.ptp(quotient.work) > 0.01


@pytest.mark.parametrize("rule", ["right", "trapezoidal"])
@pytest.mark.soak
def test_momentum_changes_by_the_group_part_of_the_force(rule):
    """Drag in space alone leaves the charge; a force along θ adds its impulses, here c·t, to it."""
    push = 0.25
    for along, twisted in ((0.0, True), (push, False)):
        dragged = dx.LagrangeDirac(
            charged_particle.lagrangian,
            forces=lambda t, q, v, params, along=along: jnp.append(-0.1 * v[:3], along),
        )
        start = {"q": np.zeros(4), "v": [1.0, 0.0, 1.0, 1.0], "params": PARTICLE.params, "step": 0.02}
        _, _, quotient = compared(dragged, dx.LagrangeDAlembert(rule), [3], twisted, **start)
        assert quotient.mu[:, 0] - quotient.mu[0, 0] == pytest.approx(along * quotient.t, abs=1e-12)


@pytest.mark.soak
def test_forces_and_constraints_that_break_the_symmetry():
    start = {"q": [0.1, 0.2], "v": [0.3, 0.0], "step": 0.1, "steps": 2}
    free = lambda q, v: v @ v / 2
    spring = dx.LagrangeDirac(free, forces=lambda t, q, v: -q)
    with pytest.raises(ValueError, match=r"forces is not invariant under translation of q\[1\]: its derivative by q\[1\] = 1"):
        dx.simulate(dx.reduce(spring, dx.LinearConnection([1])), dx.LagrangeDAlembert(), **start)
    ramp = dx.LagrangeDirac(free, holonomic=lambda q: jnp.array([q[0] - q[1]]))
    assert dx.check_invariance(ramp, dx.Translations([1]), q=start["q"]).of == "holonomic"
    belt = dx.LagrangeDirac(free, lambda q: jnp.array([[1.0, 0.0]]), affine=lambda q: q[1:])
    assert not dx.check_invariance(belt, dx.Translations([1]), q=start["q"])
    assert dx.check_invariance(belt, dx.Translations([0]), q=start["q"])
    assert dx.cyclic_coordinates(belt, start["q"]) == (0,)
