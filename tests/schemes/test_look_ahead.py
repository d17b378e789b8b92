"""The lift of Theta(1.0) with constraints beside SciPy's root of its equations by hand, and the Lagrangian scheme it is."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import brentq

import dirax as dx

H = 0.05
LIFT = dx.DiscreteDirac(dx.cotangent_lift(dx.Theta(1.0)))
MASS = np.array([[2.0, 0.3, 0.0], [0.3, 1.5, 0.1], [0.0, 0.1, 1.0]])


def forms(q):
    return jnp.stack([jnp.sin(q[2]), -jnp.cos(q[2]), 0.3 * q[0]])[None]


def hamiltonian(q, p, params=1.0):
    return p @ jnp.linalg.solve(MASS, p) / 2 + params * (jnp.cos(q[0]) + q[1] ** 2 / 2)


STRUCTURE = dx.induced_dirac(forms, 3)
PARTS = dx.DiracSystem(STRUCTURE, lambda x, params: hamiltonian(x[:3], x[3:], params))
Q = np.array([0.1, 0.2, 0.3])
ROW = np.asarray(forms(Q))[0]
V = np.array([0.4, 0.2, 0.6])
V = V - np.linalg.solve(MASS, ROW) * (ROW @ V) / (ROW @ np.linalg.solve(MASS, ROW))
P = MASS @ V


def by_hand(q, p, steps):
    """(q, p) with p incoming: one step is p' = p + W(q)ᵀs, Δq = h M⁻¹p', W(q1) Δq = 0, p1 = p' − h ∂V/∂q(q1)."""
    row = lambda q: np.array([np.sin(q[2]), -np.cos(q[2]), 0.3 * q[0]])
    rows = []
    for _ in range(steps):
        outgoing = lambda s, q=q, p=p: p + row(q) * s
        end = lambda s, q=q, outgoing=outgoing: q + H * np.linalg.solve(MASS, outgoing(s))
        s = brentq(lambda s, q=q, end=end: row(end(s)) @ (end(s) - q), -0.5, 0.5, xtol=1e-15, rtol=1e-15)
        rows.append(np.concatenate([q, outgoing(s)]))
        q, p = end(s), outgoing(s) - H * np.array([-np.sin(end(s)[0]), end(s)[1], 0.0])
    return np.array(rows)


@pytest.mark.parametrize("engine", ["native", pytest.param("xla", marks=pytest.mark.soak)])
@pytest.mark.soak
def test_the_equations_by_hand(engine):
    sol = dx.simulate(PARTS, LIFT, x=np.concatenate([Q, P]), params=1.0, step=H, steps=30, engine=engine)
    np.testing.assert_allclose(sol.x[:-1], by_hand(Q, P, 30), atol=1e-12)
    report = dx.verify(sol)
    assert report.ok and report["discretization-map Dirac structure"].verdict == "ok"


@pytest.mark.soak
def test_the_lagrangian_scheme_and_the_same_system_as_a_hamilton_dirac():
    lagrangian = lambda q, v: v @ MASS @ v / 2 - jnp.cos(q[0]) - q[1] ** 2 / 2
    run = {"q": Q, "p": P, "step": H, "steps": 30}
    theirs = dx.simulate(dx.LagrangeDirac(lagrangian, forms), dx.PlusLagrangeDirac("right", momentum="outgoing"), **run)
    ours = dx.simulate(dx.HamiltonDirac(lambda q, p: hamiltonian(q, p), forms), LIFT, **run)
    np.testing.assert_allclose(ours.x, np.concatenate([theirs.q, theirs.p], axis=1), atol=1e-13)
    # the force of step k acts at q_{k+1}: the impulse −μ_{k+1} of the Lagrangian step
    np.testing.assert_allclose(H * ours.multipliers[:-1], -theirs.multipliers[1:], atol=1e-13)
    assert dx.verify(ours).ok


def test_redundant_constraints_and_time():
    twice = lambda t, q: jnp.concatenate([forms(q), 2.0 * forms(q)])
    driven = lambda t, q, p: hamiltonian(q, p) + jnp.sin(t) * q[0]
    one = dx.simulate(dx.HamiltonDirac(driven, lambda t, q: forms(q)), LIFT, q=Q, p=P, step=H, steps=10)
    two = dx.simulate(dx.HamiltonDirac(driven, twice), LIFT, q=Q, p=P, step=H, steps=10)
    assert one.ok
    np.testing.assert_allclose(one.x, two.x, atol=1e-13)
    plain = dx.simulate(dx.HamiltonDirac(hamiltonian, forms), LIFT, q=Q, p=P, params=1.0, step=H, steps=10)
    assert np.abs(one.x - plain.x).max() > 1e-3


def test_first_order_in_q_and_p():
    """Against the midpoint map in short steps, of order 2."""
    ends = []
    for scheme, steps in ((LIFT, 200), (LIFT, 400), (dx.DiscreteDirac(), 3200)):
        sol = dx.simulate(PARTS, scheme, x=np.concatenate([Q, P]), params=1.0, step=1.0 / steps, steps=steps)
        ends.append(sol.x[-1])
    for part in (slice(3), slice(3, 6)):
        first, second = (np.abs(end - ends[2])[part].max() for end in ends[:2])
        assert np.log2(first / second) == pytest.approx(1.0, abs=0.1)


def test_the_adjoint_is_the_inverse_of_a_step_back():
    """H is even in p, so that ρ(q, p) = (q, −p) turns Φ_h into Φ_{−h}: the adjoint leads from ρx_5 to ρx_0."""
    mirror = np.array([1.0] * 3 + [-1.0] * 3)
    there = dx.simulate(PARTS, LIFT, x=np.concatenate([Q, P]), params=1.0, step=H, steps=5)
    back = dx.simulate(PARTS, dx.Adjoint(LIFT), x=mirror * there.x[5], params=1.0, step=H, steps=5, check_initial=False)
    np.testing.assert_allclose(back.x, mirror * there.x[::-1], atol=1e-13)


def test_what_is_refused():
    start = {"x": np.concatenate([Q, P]), "params": 1.0, "step": H, "steps": 2}
    with pytest.raises(ValueError, match="steps of different sizes do not compose"):
        dx.simulate(PARTS, dx.Composition(LIFT, "suzuki4"), **start)
    with pytest.raises(ValueError, match="off the constraint"):
        dx.simulate(PARTS, LIFT, **{**start, "x": np.concatenate([Q, P + 0.1])})
    stuck = dx.HamiltonDirac(lambda q, p: q[0] * q[1], lambda q: jnp.array([[1.0, 0.0]]))  # W ∂H/∂p = 0 whatever p is
    with pytest.raises(ValueError, match=r"dx\.HamiltonDirac, which dx\.PlusHamiltonDirac"):
        dx.simulate(stuck, dx.DiscreteDirac(), q=[0.1, 0.2], p=[0.0, 0.0], step=H, steps=2)
