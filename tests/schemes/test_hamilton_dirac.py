"""Discrete Hamilton–Dirac systems beside the Lagrangian schemes of the Legendre transform, DOP853, and equations by hand."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import dirax as dx

SCHEMES = [(dx.PlusHamiltonDirac(), dx.PlusLagrangeDirac("left")), (dx.MinusHamiltonDirac(), dx.MinusLagrangeDirac("right"))]
FORMS = lambda q: jnp.stack([jnp.sin(q[2]), -jnp.cos(q[2]), 0.3 * q[0]])[None]
MASS = lambda q: jnp.array([[2.0 + jnp.cos(q[2]), 0.3, 0.0], [0.3, 1.5, 0.2 * q[1]], [0.0, 0.2 * q[1], 1.0]])
POTENTIAL = lambda q: jnp.sin(q[0]) + q[1] ** 2 * q[2] / 2


def lagrangian(q, v):
    return v @ MASS(q) @ v / 2 - POTENTIAL(q)


def hamiltonian(q, p):
    return p @ jnp.linalg.solve(MASS(q), p) / 2 + POTENTIAL(q)


START = {"q": np.array([0.1, 0.2, 0.4]), "p": np.array([0.7, 0.1, 0.5])}


@pytest.mark.parametrize(("scheme", "other", "engine"), [*((*pair, "native") for pair in SCHEMES), (*SCHEMES[0], "xla")])
@pytest.mark.soak
def test_equivalent_to_the_lagrangian_schemes(scheme, other, engine):
    """With a mass matrix of q and a nonintegrable constraint: q, p, multipliers and the discrete constraint."""
    run = {**START, "project": True, "step": 0.02, "steps": 40}
    ours = dx.simulate(dx.HamiltonDirac(hamiltonian, FORMS), scheme, **run, engine=engine)
    theirs = dx.simulate(dx.LagrangeDirac(lagrangian, FORMS), other, q=run["q"], p=ours.p[0], step=0.02, steps=40)
    assert ours.ok and theirs.ok
    for name in ("q", "p", "multipliers", "constraint"):
        np.testing.assert_allclose(getattr(ours, name), getattr(theirs, name), atol=1e-12)
    np.testing.assert_allclose(ours.energy(), theirs.energy(), atol=1e-12)


@pytest.mark.parametrize("scheme", [scheme for scheme, _ in SCHEMES])
@pytest.mark.soak
def test_first_order_and_symplectic_without_constraints(scheme):
    system = dx.HamiltonDirac(hamiltonian)
    force = lambda t, x: np.concatenate([np.asarray(a) for a in (lambda of_q, of_p: (of_p, -of_q))(
        *system.slopes(0.0, jnp.asarray(x[:3]), jnp.asarray(x[3:]), None))])  # fmt: skip
    exact = solve_ivp(force, (0, 1), np.concatenate([START["q"], START["p"]]), method="DOP853", rtol=1e-11, atol=1e-11).y[:, -1]
    errors = []
    for steps in (100, 200):
        sol = dx.simulate(system, scheme, **START, step=1 / steps, steps=steps)
        errors.append([np.abs(sol.q[-1] - exact[:3]).max(), np.abs(sol.p[-1] - exact[3:]).max()])
    np.testing.assert_allclose(np.log2(np.divide(*errors)), 1.0, atol=0.1)
    report = dx.verify(sol)
    assert report.ok and report["symplecticity of one step"].verdict == "ok"


def test_a_degenerate_hamiltonian():
    """H = p₀q₁: no Lagrangian on TQ; q₀(t) = q₀ + q₁t, p₁(t) = p₁ − p₀t exactly, by either scheme."""
    system = dx.HamiltonDirac(lambda q, p: p[0] * q[1])
    for scheme, _ in SCHEMES:
        sol = dx.simulate(system, scheme, q=[1.0, 2.0], p=[3.0, 4.0], step=0.1, steps=10)
        np.testing.assert_allclose([*sol.q[-1], *sol.p[-1]], [3.0, 2.0, 3.0, 1.0], rtol=1e-14)


def test_time_and_parameters_and_discretization_maps():
    system = dx.HamiltonDirac(lambda t, q, p, params: p @ p / 2 + params * jnp.cos(t) * q[0], lambda q: jnp.array([[0.0, 1.0]]))
    for scheme in (dx.PlusHamiltonDirac(), dx.MinusHamiltonDirac(), dx.DiscreteDirac()):
        sol = dx.simulate(system, scheme, q=[0.0, 0.0], p=[1.0, 0.0], params=0.3, step=1e-3, steps=1000)
        q = sol.q[-1] if hasattr(sol, "q") else sol.x[-1][:2]
        exact = 1.0 + 0.3 * (np.cos(1.0) - 1.0)
        np.testing.assert_allclose(q, [exact, 0.0], atol=1e-3 if scheme != dx.DiscreteDirac() else 1e-6)


def test_mistakes():
    system = dx.HamiltonDirac(hamiltonian, FORMS)
    with pytest.raises(ValueError, match="constraint"):
        dx.simulate(system, dx.PlusHamiltonDirac(), **START, step=0.1, steps=1)
    with pytest.raises(TypeError, match=r"steps a dx\.HamiltonDirac, but a LagrangeDirac was given"):
        dx.simulate(dx.LagrangeDirac(lagrangian), dx.PlusHamiltonDirac(), **START, step=0.1, steps=1)
    with pytest.raises(ValueError, match="compositions of it have no higher order"):
        composed = dx.Composition(dx.PlusHamiltonDirac(), "suzuki4")
        dx.simulate(system, composed, **START, project=True, step=0.1, steps=1)
    with pytest.raises(ValueError, match="must return a scalar"):
        dx.simulate(dx.HamiltonDirac(lambda q, p: p), dx.PlusHamiltonDirac(), **START, step=0.1, steps=1)
    with pytest.raises(ValueError, match="starts from q=, p="):
        dx.simulate(system, dx.PlusHamiltonDirac(), q=[0.0, 0.0, 0.0], v=[0.0, 0.0, 0.0], step=0.1, steps=1)
