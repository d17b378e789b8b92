"""Discrete mechanics on Q × Q beside derivatives by hand, SciPy, and the schemes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import fsolve

import dirax as dx

H = 0.1
MASS = np.array([[2.0, 0.3, 0.1], [0.3, 1.0, 0.0], [0.1, 0.0, 1.5]])
ROW = lambda q: np.array([np.sin(q[2]), -np.cos(q[2]), 0.3 * q[0]])
Q0, Q1 = np.array([0.1, 0.2, 0.3]), np.array([0.16, 0.21, 0.38])


def ld(q0, q1):
    return H * ((q1 - q0) @ MASS @ (q1 - q0) / H**2 / 2 - jnp.cos(q0[0]) - q0[1] ** 2 * q1[2])


def d1(q0, q1):
    return -MASS @ (q1 - q0) / H - H * np.array([-np.sin(q0[0]), 2 * q0[1] * q1[2], 0.0])


def d2(q0, q1):
    return MASS @ (q1 - q0) / H - H * np.array([0.0, 0.0, q0[1] ** 2])


FORMS = lambda q: jnp.stack([jnp.sin(q[2]), -jnp.cos(q[2]), 0.3 * q[0]])[None]
FREE = dx.DiscreteLagrangianSystem(ld)


def test_forms_by_hand():
    zero = np.zeros(3)
    np.testing.assert_allclose(FREE.plus_form(Q0, Q1), np.concatenate([zero, d2(Q0, Q1)]), atol=1e-14)
    np.testing.assert_allclose(FREE.minus_form(Q0, Q1), np.concatenate([-d1(Q0, Q1), zero]), atol=1e-14)
    mixed = MASS / H  # −∂²L_d/∂q0∂q1
    mixed[1, 2] += H * 2 * Q0[1]
    omega = np.block([[np.zeros((3, 3)), mixed], [-mixed.T, np.zeros((3, 3))]])
    np.testing.assert_allclose(FREE.two_form(Q0, Q1), omega, atol=1e-12)
    # −dΘ of both one-forms
    for form in (FREE.plus_form, FREE.minus_form):
        slope = jax.jacfwd(lambda z, form=form: form(z[:3], z[3:]))(jnp.concatenate([Q0, Q1]))
        np.testing.assert_allclose(slope - slope.T, omega, atol=1e-12)
    found = FREE.dirac_structure(Q0, Q1)
    v = np.arange(6.0)
    assert bool(found.is_dirac()) and bool(found.contains(v, omega.T @ v)) and not bool(found.contains(v, omega @ v))


@pytest.mark.parametrize(("sign", "scheme"), [("+", dx.PlusLagrangeDirac), ("-", dx.MinusLagrangeDirac)])
@pytest.mark.soak_of("+-PlusLagrangeDirac")
def test_the_flow(sign, scheme):
    """Against SciPy's root of (20), and rows of the schemes; D_DEL L_d lies in Δ°."""
    pairs = dx.DiscreteLagrangianSystem(ld, FORMS, sign=sign)

    def missed(z):
        q2, mu = z[:3], z[3]
        return np.append(d2(Q0, Q1) + d1(Q1, q2) - mu * ROW(Q1), ROW(q2 if sign == "+" else Q1) @ (q2 - Q1))

    expected = fsolve(missed, np.append(2 * Q1 - Q0, 0.0), full_output=True, xtol=1e-13)[0][:3]
    q1, q2 = pairs.flow(Q0, Q1)
    np.testing.assert_allclose(q1, Q1)
    np.testing.assert_allclose(q2, expected, atol=1e-12)
    np.testing.assert_allclose(pairs.constraint(q1, q2), 0.0, atol=1e-14)
    force = np.asarray(pairs.euler_lagrange(Q0, q1, q2))
    np.testing.assert_allclose(force, ROW(Q1) * (force @ ROW(Q1)) / (ROW(Q1) @ ROW(Q1)), atol=1e-12)
    system = dx.LagrangeDirac(lambda q, v: v @ v / 2, FORMS)  # L_d is given
    run = {"q0": Q0, "q1": Q1, "step": H, "steps": 2, "check_initial": False}
    sol = dx.simulate(system, scheme(lambda q0, q1, h: ld(q0, q1)), **run)
    np.testing.assert_allclose(sol.q[2], q2, atol=1e-13)


@pytest.mark.soak
def test_the_flow_is_symplectic_without_constraints_and_not_with():
    z = jnp.concatenate([Q0, Q1])
    for pairs, symplectic in ((FREE, True), (dx.DiscreteLagrangianSystem(ld, FORMS), False)):
        flow = lambda z, pairs=pairs: jnp.concatenate(pairs.flow(z[:3], z[3:]))
        J, after = jax.jit(jax.jacfwd(flow))(z), flow(z)
        change = J.T @ pairs.two_form(after[:3], after[3:]) @ J - pairs.two_form(Q0, Q1)
        assert (float(jnp.abs(change).max()) < 1e-11) == symplectic


def test_constrained_structure_and_mistakes():
    found = dx.DiscreteLagrangianSystem(ld, FORMS).dirac_structure(Q0, Q1)
    assert bool(found.is_dirac()) and found.distribution().shape == (6, 4)
    with pytest.raises(ValueError, match='sign must be "\\+" or "-"'):
        dx.DiscreteLagrangianSystem(ld, sign="plus")
    with pytest.raises(ValueError, match=r"must have one shape \(n,\), but their shapes are \(3,\), \(2,\)"):
        FREE.two_form(Q0, Q1[:2])
    with pytest.raises(TypeError, match="discrete_lagrangian"):
        dx.DiscreteLagrangianSystem(lambda q: 0.0)
