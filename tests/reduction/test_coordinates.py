"""Systems in other coordinates, and the n-body problem without translations and rotations."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dirax as dx
from dirax.gallery import planar_n_body

BODIES = planar_n_body.EXAMPLE


def test_translations_of_all_bodies_are_removed_by_a_linear_change():
    """The midpoint equations commute with linear changes: the Cartesian run comes back, momenta too."""
    settings = {"params": BODIES.params, "step": 0.01, "steps": 500, "engine": "native"}
    cartesian = dx.simulate(BODIES.system, dx.PlusLagrangeDirac("midpoint"), **BODIES.initial, **settings)
    basis = dx.adapted_basis(dx.translation_symmetries(BODIES.system, BODIES.initial["q"], params=BODIES.params, radius=0.3))
    assert basis.shape == (6, 6) and np.ptp(basis[::2, 4:], axis=0) == pytest.approx([0, 0], abs=1e-9)
    adapted = dx.in_coordinates(BODIES.system, lambda y: basis @ y)
    twisted = dx.reduce(adapted, dx.LinearConnection([4, 5], [[0.3, 0.1, -0.2, 0.1], [0.0, 0.2, 0.1, -0.1]]))
    start = {name: np.linalg.solve(basis, value) for name, value in BODIES.initial.items()}
    lifted = dx.reconstruct(dx.simulate(twisted, dx.DiscreteRouth("midpoint"), **start, **settings))
    assert np.abs(lifted.q @ basis.T - cartesian.q).max() < 1e-10
    assert np.abs(lifted.p - cartesian.p @ basis).max() < 1e-10


def test_shape_coordinates_and_lagrange_s_solution():
    """Three unequal masses in an equilateral triangle turn like a rigid body: in Cartesian coordinates with error h², while
    on the quotient this is an equilibrium, which the discrete equations have exactly."""
    masses, side = np.array([1.0, 2.0, 0.5]), 1.3
    params, data = {"m": masses, "G": 1.0}, planar_n_body.lagrange(masses, side)
    y, w = jax.jvp(lambda q: planar_n_body.to_shape(q, params), (data["q"],), (data["v"],))
    assert np.asarray(planar_n_body.from_shape(y, params)) == pytest.approx(data["q"], abs=1e-14)
    assert float(y[0]) == pytest.approx(side, abs=1e-14) and np.asarray(y[3:5]) == pytest.approx([0, 0], abs=1e-14)
    four = np.random.default_rng(0).normal(size=8)
    back = planar_n_body.from_shape(planar_n_body.to_shape(four, {"m": np.arange(1.0, 5)}), {"m": np.arange(1.0, 5)})
    assert np.asarray(back) == pytest.approx(four, abs=1e-14)
    rate, end = np.sqrt(masses.sum() / side**3), 1.0  # unstable: a short run
    exact = planar_n_body.turned(rate * end, jnp.asarray(data["q"]).reshape(3, 2)).reshape(-1)
    reduced, errors = dx.reduce(planar_n_body.SYMMETRIC, dx.LinearConnection([3, 4, 5])), []
    for steps in (50, 100, 200):
        run = {"params": params, "step": end / steps, "steps": steps, "engine": "native"}
        sol = dx.reconstruct(dx.simulate(reduced, dx.DiscreteRouth("midpoint"), q=y, v=w, **run))
        assert np.abs(planar_n_body.from_shape(sol.q[-1], params) - exact).max() < 1e-12
        errors.append(np.abs(dx.simulate(planar_n_body.SYSTEM, dx.LagrangeDAlembert(), **data, **run).q[-1] - exact).max())
    assert np.log2(np.array(errors[:-1]) / errors[1:]) == pytest.approx([2, 2], abs=0.05)


def test_constraints_forces_and_time_are_pulled_back():
    """A skew linear change of a system that has everything: the same run, and the same multipliers and work."""

    def lagrangian(t, q, v, params):
        return v @ v / 2 + jnp.sin(q[0]) * v[1] - params * jnp.cos(t) * q[2]

    system = dx.LagrangeDirac(
        lagrangian,
        lambda q: jnp.array([[1.0, -q[2], 0.0]]),
        affine=lambda t, q: jnp.array([0.1 * jnp.sin(t)]),
        forces=lambda t, q, v: -0.2 * v,
    )
    change = np.array([[1.0, 0.4, 0.0], [0.0, 1.0, -0.3], [0.2, 0.0, 1.0]])
    q, v = np.array([0.3, 0.1, 0.5]), np.array([0.2, 0.4, -0.6])
    settings = {"params": 1.5, "step": 0.02, "steps": 100, "engine": "native"}
    here = dx.simulate(system, dx.LagrangeDAlembert(), q=q, v=v, **settings)
    moved = dx.in_coordinates(system, lambda y: change @ y)
    start = {"q": np.linalg.solve(change, q), "v": np.linalg.solve(change, v)}
    there = dx.simulate(moved, dx.LagrangeDAlembert(), **start, **settings)
    assert np.abs(there.q @ change.T - here.q).max() < 1e-12 and np.abs(there.p - here.p @ change).max() < 1e-12
    assert np.abs(there.multipliers - here.multipliers).max() < 1e-12 and np.abs(there.work - here.work).max() < 1e-12


def test_mistakes():
    with pytest.raises(ValueError, match="independent rows"):
        dx.adapted_basis([[1.0, 0.0, 1.0], [2.0, 0.0, 2.0]])
    with pytest.raises(TypeError, match=r"in_coordinates takes a dx\.LagrangeDirac"):
        dx.in_coordinates(3, lambda y: y)
