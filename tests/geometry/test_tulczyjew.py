"""Tulczyjew triples: inverses, commuting diagrams, what the arrows do to the symplectic forms, and the discrete flows."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dirax.geometry.discrete import InducedFiniteDifferenceDirac
from dirax.geometry.tulczyjew import (
    DiscreteEvolution,
    FiniteDifferenceTriple,
    GeneratingFunctionTriple,
    TulczyjewTriple,
    minus_legendre,
    plus_legendre,
    slot_derivatives,
)

SEEDS = st.integers(0, 2**32 - 1)
SIGNS = st.sampled_from(["+", "-"])
STEPS = st.floats(1e-2, 10.0)
FEW = settings(max_examples=10)  # where every example costs derivatives, or the law is linear
H = 0.1


def points(seed, count, n=3):
    return tuple(np.random.default_rng(seed).normal(size=(count, n)))


def agree(found, expected, tolerance=1e-12):
    for a, b in zip(found, expected, strict=True):
        np.testing.assert_allclose(a, b, atol=tolerance, rtol=tolerance)


def canonical(n):
    """The matrix of dq ∧ dp in (q, p)."""
    return np.block([[np.zeros((n, n)), np.eye(n)], [-np.eye(n), np.zeros((n, n))]])


def pulled_back(arrow, point, n=2):
    """The canonical two-form of a cotangent bundle of dimension 4n, pulled back by an arrow at a point."""
    jacobian = np.asarray(jacobian_of(arrow)(np.concatenate(point)))
    return jacobian.T @ canonical(2 * n) @ jacobian


@functools.cache
def jacobian_of(arrow):
    """The derivative of an arrow, of the four parts of its argument in one array."""
    return jax.jit(jax.jacfwd(lambda x: jnp.concatenate(arrow(*jnp.split(x, 4)))))


def lagrangian(q, v):
    return jnp.exp(jnp.sin(q[0])) * (v @ v) / 2 + jnp.cos(q @ v) + q[1] * v[2] - q @ q


def discrete_lagrangian(q0, q1):
    """h L((q0 + q1)/2, (q1 − q0)/h) of a pendulum-like L with a metric that depends on q."""
    q, v = (q0 + q1) / 2, (q1 - q0) / H
    return H * ((1.5 + jnp.sin(q[0])) * (v @ v) / 2 + q[0] * v[1] - jnp.sum(jnp.cos(q)))


def legendre_of(transform):
    return lambda q0, q1: transform(discrete_lagrangian, q0, q1)


def skate(q):
    return jnp.array([[jnp.sin(q[2]), -jnp.cos(q[2]), 0.3]])


# ------------------------------------------------------------------------------------------------------- the continuous triple


@given(SEEDS)
def test_the_continuous_arrows_and_their_inverses(seed):
    triple, (q, p, dq, dp) = TulczyjewTriple(), points(seed, 4)
    agree(triple.flat(q, p, dq, dp), (q, p, -dp, dq))
    agree(triple.kappa(q, p, dq, dp), (q, dq, dp, p))
    agree(triple.flat_inverse(*triple.flat(q, p, dq, dp)), (q, p, dq, dp))
    agree(triple.kappa_inverse(*triple.kappa(q, p, dq, dp)), (q, p, dq, dp))
    agree(triple.gamma(*triple.kappa(q, p, dq, dp)), triple.flat(q, p, dq, dp))
    agree(triple.gamma_inverse(*triple.gamma(q, dq, dp, p)), (q, dq, dp, p))


@given(SEEDS)
def test_the_flat_of_the_triple_is_that_of_the_canonical_two_form(seed):
    q, p, dq, dp = points(seed, 4)
    *_, beta, gamma = TulczyjewTriple().flat(q, p, dq, dp)
    np.testing.assert_allclose(np.concatenate([beta, gamma]), np.concatenate([dq, dp]) @ canonical(3))


@given(SEEDS)
def test_kappa_intertwines_the_projections(seed):
    """π_TQ ∘ κ = Tπ_Q and ϱ ∘ κ = τ_T*Q, the two diagrams that determine κ ([PY] §4.2); the latter by a vertical lift."""
    q, p, dq, dp = points(seed, 4)
    a, velocity, alpha_q, alpha_v = TulczyjewTriple().kappa(q, p, dq, dp)
    np.testing.assert_array_equal(np.concatenate([a, velocity]), np.concatenate([q, dq]))
    u = np.random.default_rng(seed).normal(size=3)
    vertical_lift = np.concatenate([np.zeros(3), u])  # d/dt (q, q̇ + t u)
    assert np.concatenate([alpha_q, alpha_v]) @ vertical_lift == pytest.approx(p @ u)


@FEW
@given(SEEDS)
def test_kappa_and_flat_carry_the_symplectic_form_of_tulczyjew(seed):
    """κ*Ω_{T*TQ} = dq ∧ dṗ + dq̇ ∧ dp = −(Ω♭)*Ω_{T*T*Q}."""
    triple, point = TulczyjewTriple(), points(seed, 4, n=2)
    zero, one = np.zeros((2, 2)), np.eye(2)
    form = np.block([[zero, zero, zero, one], [zero, zero, -one, zero], [zero, one, zero, zero], [-one, zero, zero, zero]])
    np.testing.assert_array_equal(pulled_back(triple.kappa, point), form)
    np.testing.assert_array_equal(pulled_back(triple.flat, point), -form)


@FEW
@given(SEEDS)
@pytest.mark.soak
def test_the_dirac_differential_states_the_euler_lagrange_equations(seed):
    """(q̇, ṗ; d_D L) ∈ graph Ω♭ iff p = ∂L/∂v, ṗ = ∂L/∂q, q̇ = v: both sides of the diagram over T(T*Q)."""
    triple, (q, v) = TulczyjewTriple(), points(seed, 2)
    step = 1e-6
    value = jax.jit(lagrangian)
    difference = lambda f, x: np.array([(f(x + step * e) - f(x - step * e)) / (2 * step) for e in np.eye(3)])
    dq_L, p = difference(lambda x: value(x, v), q), difference(lambda x: value(q, x), v)
    agree(triple.dirac_differential(lagrangian, q, v), (q, p, -dq_L, v), 1e-8)
    agree(triple.dirac_differential(lagrangian, q, v), triple.flat(q, p, v, dq_L), 1e-8)


# -------------------------------------------------------------------------------------------------------- the triple of [PY]


@given(SEEDS, SIGNS, STEPS)
def test_the_finite_difference_arrows_and_their_inverses(seed, sign, h):
    triple, (q0, p0, q1, p1, far) = FiniteDifferenceTriple(step=h, sign=sign), points(seed, 5)
    assert (triple.sign, triple.step) == (sign, h)
    expected = (q1, p1, -(far - p1) / h, (q1 - q0) / h) if sign == "+" else (q0, p0, -(p0 - far) / h, (q1 - q0) / h)
    agree(triple.flat(q0, p0, q1, p1, far), expected)
    agree(triple.kappa(q0, p0, q1, p1), (q0, q1, -p0, p1))
    agree(triple.kappa_inverse(*triple.kappa(q0, p0, q1, p1)), (q0, p0, q1, p1))
    agree(triple.gamma(*triple.kappa(q0, p0, q1, p1), far), expected)
    near = p1 if sign == "+" else p0
    agree(triple.flat_inverse(*expected), (q0, q1, near, far), 1e-11)


@FEW
@given(SEEDS, SIGNS)
def test_the_graph_of_the_flat_is_the_unconstrained_discrete_dirac_structure(seed, sign):
    q0, p0, q1, p1, far = points(seed, 5)
    *_, beta, gamma = FiniteDifferenceTriple(step=H, sign=sign).flat(q0, p0, q1, p1, far)
    momenta = (p1, far) if sign == "+" else (far, p0)
    structure = InducedFiniteDifferenceDirac(step=H, sign=sign)
    assert structure.contains(q0, q1, momenta, beta, gamma)
    assert not structure.contains(q0, q1, momenta, beta + 0.1, gamma)


@FEW
@given(SEEDS)
def test_kappa_d_carries_the_difference_of_the_symplectic_forms(seed):
    """(κ^d)*Ω_{T*(Q×Q)} = dq1 ∧ dp1 − dq0 ∧ dp0: the pairs of a symplectic map are a Lagrangian submanifold."""
    point = points(seed, 4, n=2)
    zero, form = np.zeros((4, 4)), canonical(2)
    expected = np.block([[-form, zero], [zero, form]])
    for triple in (FiniteDifferenceTriple(step=H), GeneratingFunctionTriple()):
        np.testing.assert_array_equal(pulled_back(triple.kappa, point), expected)


@FEW
@given(SEEDS)
@pytest.mark.soak
def test_the_graph_of_the_flow_of_a_discrete_lagrangian_is_the_image_of_its_differential(seed):
    """κ^d ∘ ι = dL_d ([PY] Definition 6.1), ι(q0, q1) = (F⁻L_d, F⁺L_d)."""
    q0, q1 = points(seed, 2)
    z0, z1 = minus_legendre(discrete_lagrangian, q0, q1), plus_legendre(discrete_lagrangian, q0, q1)
    found = FiniteDifferenceTriple(step=H).kappa(*z0, *z1)
    agree(found, (q0, q1, *slot_derivatives(discrete_lagrangian, q0, q1)))


def test_legendre_transforms_and_dirac_differentials_by_hand():
    """L_d = h(v²/2 − V(q0)), v = (q1 − q0)/h: D1 = −v − hV'(q0), D2 = v; [PY] (46), (47)."""
    h, slope = 0.5, lambda q: 3 * q**2
    ld = lambda a, b: jnp.sum((b - a) ** 2) / (2 * h) - h * jnp.sum(a**3)
    a, b, c = np.array([1.0]), np.array([2.0]), np.array([4.0])
    agree(plus_legendre(ld, a, b), ([2.0], [2.0]))
    agree(minus_legendre(ld, a, b), ([1.0], [2.0 + h * 3.0]))
    # over b: D2(a, b) = 2, D1(b, c) = −4 − h·12 = −10, D2(b, c) = 4; D1(a, b) = −3.5
    plus = FiniteDifferenceTriple(step=h, sign="+").dirac_differential(ld, a, b, c)
    agree(plus, ([2.0], [2.0], [-(4.0 - 10.0) / h], [2.0]))
    minus = FiniteDifferenceTriple(step=h, sign="-").dirac_differential(ld, a, b, c)
    agree(minus, ([2.0], [10.0], [-(2.0 - 3.5) / h], [4.0]))
    assert slope(2.0) == 12.0


# -------------------------------------------------------------------------------------------------------- the triple of [RL]


@given(SEEDS, SIGNS)
def test_the_generating_function_arrows_and_their_inverses(seed, sign):
    triple, (q0, p0, q1, p1) = GeneratingFunctionTriple(sign), points(seed, 4)
    expected = (q0, p1, p0, q1) if sign == "+" else (p0, q1, -q0, -p1)
    assert triple.sign == sign
    agree(triple.flat(q0, p0, q1, p1), expected)
    agree(triple.flat_inverse(*expected), (q0, p0, q1, p1))
    agree(triple.kappa_inverse(*triple.kappa(q0, p0, q1, p1)), (q0, p0, q1, p1))
    agree(triple.gamma(q0, q1, -p0, p1), expected)
    agree(triple.gamma_inverse(*expected), (q0, q1, -p0, p1))


@FEW
@given(SEEDS, SIGNS)
def test_all_generating_function_arrows_are_symplectic_up_to_sign(seed, sign):
    """−d(κ^d*Θ) = d(Ω♭_{d±}*Θ) on T*Q × T*Q ([RL] §2.3.1)."""
    triple, point = GeneratingFunctionTriple(sign), points(seed, 4, n=2)
    np.testing.assert_array_equal(pulled_back(triple.flat, point), -pulled_back(triple.kappa, point))
    np.testing.assert_array_equal(pulled_back(triple.gamma, point), -canonical(4))


@FEW
@given(SEEDS, SIGNS)
def test_the_discrete_dirac_differentials_of_rl(seed, sign):
    """D^±L_d is the differential of the Legendre transform of L_d: S(q0, p1) = p1·q1 − L_d, S(p0, q1) = −p0·q0 − L_d."""
    q0, q1 = points(seed, 2)
    d1, d2 = slot_derivatives(discrete_lagrangian, q0, q1)
    found = GeneratingFunctionTriple(sign).dirac_differential(discrete_lagrangian, q0, q1)
    agree(found, (q0, d2, -d1, q1) if sign == "+" else (-d1, q1, -q0, -d2))


# ------------------------------------------------------------------------------------------------- evolution operators and flows


@pytest.fixture(scope="module", params=["+", "-"])
def constrained(request):
    return DiscreteEvolution(discrete_lagrangian, skate, step=H, sign=request.param)


@pytest.mark.parametrize("sign", ["+", "-"])
@pytest.mark.soak_of("-")
def test_without_constraints_flows_are_the_discrete_hamiltonian_map(sign):
    """[PY] (42): φ = F⁺L_d ∘ (F⁻L_d)⁻¹, so it takes F⁻L_d(q0, q1) to F⁺L_d(q0, q1); and it is symplectic.

    The evolution operators are sections of the projections ([PY] Definition 6.6).
    """
    free = DiscreteEvolution(discrete_lagrangian, step=H, sign=sign)
    before, after = map(legendre_of, (minus_legendre, plus_legendre))

    @jax.jit
    def operators(q0, u):
        z0, z1 = before(q0, q0 + H * u), after(q0, q0 + H * u)
        return free.minus_operator(*z0, u), free.plus_operator(*z1, u), (*z0, *z1)

    for seed in range(10):
        forwards, backwards, both = operators(*points(seed, 2))
        agree(forwards, both, 1e-11)
        agree(backwards, both, 1e-11)
    step = lambda z: jnp.concatenate(free.flow(z[:3], z[3:]))
    jacobian = np.asarray(jax.jit(jax.jacfwd(step))(jnp.concatenate(points(1, 2))))
    np.testing.assert_allclose(jacobian.T @ canonical(3) @ jacobian, canonical(3), atol=1e-11)


@pytest.mark.soak_of("+")
def test_a_path_of_the_constrained_flow_is_in_the_discrete_dirac_structure(constrained):
    """[PY] Definition 6.7, Theorem 6.8: (X^{d±}, d_D^±L_d) ∈ D^{d±}, with the Legendre momenta of the same sign."""
    sign = constrained.structure.sign
    q, v = np.array([0.1, 0.2, 0.4]), np.array([0.9, 0.3, 0.0])
    v[2] = -(np.asarray(skate(q))[0, :2] @ v[:2]) / 0.3
    near = q + H * v
    p = plus_legendre(discrete_lagrangian, q - H * v, q)[1] if sign == "+" else minus_legendre(discrete_lagrangian, q, near)[1]
    flow, path = jax.jit(constrained.flow), [(q, np.asarray(p))]
    for _ in range(4):
        path.append(tuple(map(np.asarray, flow(*path[-1], v))))
    legendre = jax.jit(legendre_of(plus_legendre if sign == "+" else minus_legendre))
    structure = constrained.structure
    differential = jax.jit(
        lambda *three: FiniteDifferenceTriple(step=H, sign=sign).dirac_differential(discrete_lagrangian, *three)
    )
    for (qa, pa), (qb, pb), (qc, pc) in zip(path[1:], path[2:], path[3:], strict=False):
        ends = ((qa, qb), pb) if sign == "+" else ((qb, qc), pb)
        np.testing.assert_allclose(legendre(*ends[0])[1], ends[1], atol=1e-12)
        *_, beta, gamma = differential(qa, qb, qc)
        pair, momenta = ((qa, qb), (pb, pc)) if sign == "+" else ((qb, qc), (pa, pb))
        defects = structure.membership_defect(*pair, momenta, beta, gamma)
        assert max(float(jnp.max(jnp.abs(d))) for d in defects) < 1e-10
        assert structure.contains(*pair, momenta, beta, gamma)
        unconstrained = InducedFiniteDifferenceDirac(step=H, sign=sign)
        assert not unconstrained.contains(*pair, momenta, beta, gamma)
    back = jax.jit(constrained.inverse_flow)(*path[3], v)
    agree(back, path[2], 1e-10)


@pytest.mark.soak
def test_the_minus_flow_is_the_plus_flow_backwards():
    """Reversing time, L_d(a, b) → L_d(b, a), exchanges (+) and (−), flow and inverse flow, p and −p."""
    reverse = lambda a, b: discrete_lagrangian(b, a)
    plus = DiscreteEvolution(discrete_lagrangian, skate, step=H, sign="+")
    minus = DiscreteEvolution(reverse, skate, step=H, sign="-")
    q, p = np.array([0.1, 0.2, 0.4]), np.array([1.1, 0.3, -0.2])
    q1, p1 = jax.jit(plus.flow)(q, p)
    back_q, back_p = jax.jit(minus.inverse_flow)(q, -p)
    agree((q1, p1), (back_q, -back_p), 1e-11)


def test_a_momentum_that_cannot_be_reached_gives_nan():
    bounded = DiscreteEvolution(lambda a, b: H * jnp.sum(jnp.arctan((b - a) / H)), step=H)
    assert np.all(np.isnan(bounded.flow(np.array([0.0]), np.array([5.0]))[0]))


def test_a_bad_sign_is_refused():
    for make in (lambda: FiniteDifferenceTriple(step=H, sign="x"), lambda: GeneratingFunctionTriple("x")):
        with pytest.raises(ValueError, match='sign must be "'):
            make()
