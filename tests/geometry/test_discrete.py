"""The three notions of discrete Dirac structure, against their definitions written out in numpy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import dirax as dx
from dirax.geometry.discrete import (
    DiscretizationMapDirac,
    FiniteDifferenceDirac,
    GeneratingFunctionDirac,
    InducedFiniteDifferenceDirac,
)
from dirax.geometry.finite_difference import annihilator_projector, projector_slope
from dirax.geometry.linear import LinearDirac
from dirax.geometry.maps import Midpoint, SphereProjection, Theta
from dirax.geometry.structures import DiracStructure

SEEDS = st.integers(0, 2**32 - 1)
SIGNS = st.sampled_from(["+", "-"])
STEPS = st.floats(1e-3, 10.0)
SOME = settings(max_examples=15)


def two_form(x):
    """A two-form on R^4 that is neither constant nor closed, of rank 2 where x0 = 0."""
    a = jnp.array([[0.0, 1.0, x[2], 0.0], [0.0, 0.0, x[0] * x[1], 2.0], [0.0, 0.0, 0.0, x[0]], [0.0, 0.0, 0.0, 0.0]])
    return a - a.T


def one_forms(x):
    return jnp.array([[jnp.sin(x[1]), 1.0, x[2], 0.0], [1.0, 0.0, x[3], -x[0]]])


def forms_on_q(q):
    """The vertical rolling disk's."""
    return jnp.array([[1.0, 0.0, 0.0, -jnp.cos(q[2])], [0.0, 1.0, 0.0, -jnp.sin(q[2])]])


def null_space(matrix):
    _, values, right = np.linalg.svd(matrix)
    return right[int(np.sum(values > 1e-9)) :].T


def element(sign, h, rng, two_form, matrix_of):
    """A random ((x0, x1), α) ∈ D^{d±}, made from the definition: ẋ ∈ ker W, α = ω(ẋ, ·) + Wᵀμ at the base point."""
    base = rng.normal(size=4)
    w, omega = np.asarray(matrix_of(base)), np.asarray(two_form(base))
    velocity = null_space(w) @ rng.normal(size=4 - len(w))
    covector = velocity @ omega + rng.normal(size=len(w)) @ w
    pair = (base - h * velocity, base) if sign == "+" else (base, base + h * velocity)
    return *pair, covector


@SOME
@given(SEEDS, SIGNS, STEPS)
@pytest.mark.soak
def test_finite_difference_members_are_those_of_the_definition(seed, sign, h):
    rng = np.random.default_rng(seed)
    D = FiniteDifferenceDirac(two_form, one_forms, step=h, sign=sign)
    x0, x1, covector = element(sign, h, rng, two_form, one_forms)
    constraint, force = D.membership_defect(x0, x1, covector)
    size = np.max(np.abs([x0, x1])) / h
    assert np.max(np.abs(constraint)) < 1e-14 * (1 + size) * 10
    assert np.max(np.abs(force)) < 1e-14 * (1 + size) * 100
    assert D.contains(x0, x1, covector)
    base = np.asarray(D.base_point(x0, x1))
    np.testing.assert_array_equal(base, x1 if sign == "+" else x0)
    # off the distribution, and off the annihilator
    along = null_space(np.asarray(one_forms(base)))[:, 0]
    normal = np.asarray(one_forms(base))[0]
    assert not D.contains(x0, x1, covector + along)
    moved = (x0 - h * normal, x1) if sign == "+" else (x0, x1 + h * normal)
    assert not D.contains(*moved, covector)
    assert np.linalg.norm(D.membership_defect(*moved, covector)[0]) == pytest.approx(
        np.linalg.norm(np.asarray(one_forms(base)) @ normal), rel=1e-6
    )
    assert np.linalg.norm(D.membership_defect(x0, x1, covector + along)[1]) == pytest.approx(1.0, rel=1e-6)


@SOME
@given(SEEDS, SIGNS)
def test_finite_difference_structures_are_their_own_orthogonal(seed, sign):
    """[PY] Theorem 5.7: the pairing of any two elements over one point vanishes, and the dimension is that of M."""
    rng, h = np.random.default_rng(seed), 0.1
    D = FiniteDifferenceDirac(two_form, one_forms, step=h, sign=sign)
    first = element(sign, h, rng, two_form, one_forms)
    x = first[1] if sign == "+" else first[0]
    w = np.asarray(one_forms(x))
    velocity = null_space(w) @ rng.normal(size=2)
    covector = velocity @ np.asarray(two_form(x)) + rng.normal(size=2) @ w
    second = (x - h * velocity, x, covector) if sign == "+" else (x, x + h * velocity, covector)
    assert abs(float(D.orthogonal_defect(first, second))) < 1e-11
    structure = D.at(x)
    assert structure.is_dirac()
    assert structure.n == 4
    # the distribution and the two-form that determine it are those it was made of ([BLM] Proposition 2.3)
    basis = np.asarray(structure.distribution())
    np.testing.assert_allclose(w @ basis, 0.0, atol=1e-12)
    restricted = basis.T @ np.asarray(structure.two_form()) @ basis
    np.testing.assert_allclose(restricted, basis.T @ np.asarray(two_form(x)) @ basis, atol=1e-12)


def test_pairing_flat_and_two_form_by_hand():
    """ω = dx ∧ dy on R²: ω♭(ẋ, ẏ) = (−ẏ, ẋ); ẋ^± = (x1 − x0)/h."""
    D = FiniteDifferenceDirac(lambda x: jnp.array([[0.0, 1.0 + x[0]], [-1.0 - x[0], 0.0]]), step=0.5, sign="+")
    x0, x1 = jnp.array([0.0, 0.0]), jnp.array([1.0, 2.0])
    np.testing.assert_array_equal(D.velocity(x0, x1), [2.0, 4.0])
    np.testing.assert_array_equal(D.flat(x0, x1), [-8.0, 4.0])  # at x1, where 1 + x = 2
    assert float(D.pairing(jnp.array([3.0, 1.0]), x0, x1)) == 10.0
    assert float(D.discrete_two_form(x0, x1, jnp.array([1.0, 1.0]))) == -4.0
    minus = FiniteDifferenceDirac(D.two_form.function, step=0.5, sign="-")
    np.testing.assert_array_equal(minus.flat(x0, x1), [-4.0, 2.0])  # at x0, where 1 + x = 1
    assert minus.constraint(x0, x1).shape == (0,)


@SOME
@given(SEEDS, SIGNS, STEPS)
@pytest.mark.soak
def test_induced_members_are_those_of_proposition_5_17(seed, sign, h):
    rng = np.random.default_rng(seed)
    D = InducedFiniteDifferenceDirac(forms_on_q, step=h, sign=sign)
    base, momenta = rng.normal(size=4), (rng.normal(size=4), rng.normal(size=4))
    w = np.asarray(forms_on_q(base))
    velocity = null_space(w) @ rng.normal(size=2)
    q0, q1 = (base - h * velocity, base) if sign == "+" else (base, base + h * velocity)
    rate = (momenta[1] - momenta[0]) / h
    beta, gamma = -rate + rng.normal(size=2) @ w, velocity
    assert D.contains(q0, q1, momenta, beta, gamma)
    scale = 1 + np.max(np.abs(rate)) + np.max(np.abs([q0, q1])) / h
    for defect in D.membership_defect(q0, q1, momenta, beta, gamma):
        assert np.max(np.abs(defect)) < 1e-13 * scale
    np.testing.assert_array_equal(D.base_point(q0, q1, momenta)[1], momenta[0] if sign == "+" else momenta[1])
    # each condition alone
    other = rng.normal(size=4)
    assert not D.contains(q0, q1, momenta, beta, gamma + other * scale)
    assert not D.contains(q0, q1, momenta, beta + null_space(w)[:, 0] * scale, gamma)
    np.testing.assert_allclose(D.membership_defect(q0, q1, momenta, beta, gamma + other)[1], other, atol=1e-13 * scale)


@SOME
@given(SEEDS, SIGNS)
def test_induced_structures_are_dirac_and_agree_with_the_general_ones(seed, sign):
    """[PY] Theorem 5.16: over a point it is D of Theorem 5.7 for the canonical form and the lifted distribution."""
    rng = np.random.default_rng(seed)
    D = InducedFiniteDifferenceDirac(forms_on_q, step=0.1, sign=sign)
    q0, q1, momenta = rng.normal(size=4), rng.normal(size=4), (rng.normal(size=4), rng.normal(size=4))
    base = q1 if sign == "+" else q0
    structure = D.at(base)
    assert structure.is_dirac()
    canonical = np.block([[np.zeros((4, 4)), np.eye(4)], [-np.eye(4), np.zeros((4, 4))]])
    lifted = np.concatenate([null_space(np.asarray(forms_on_q(base))), np.zeros((4, 2))])
    basis = np.concatenate([lifted, np.eye(8)[:, 4:]], axis=1)
    assert structure.distance(LinearDirac.from_subspace_and_form(basis, canonical)) < 1e-12
    # the flat is the twisted one, and pairs with vectors as Ω(ẑ, ·)
    velocity, w = np.concatenate(D.velocity(q0, q1, momenta)), rng.normal(size=8)
    np.testing.assert_allclose(np.concatenate(D.flat(q0, q1, momenta)), velocity @ canonical, atol=1e-13)
    assert float(D.discrete_two_form(q0, q1, momenta, (w[:4], w[4:]))) == pytest.approx(velocity @ canonical @ w)
    assert float(D.pairing(w[:4], w[4:], q0, q1, momenta)) == pytest.approx(velocity @ w)
    p = momenta[0] if sign == "+" else momenta[1]
    assert float(D.canonical_one_form(q0, q1, momenta)) == pytest.approx(p @ velocity[:4])


def test_the_twisted_differences_give_the_symplectic_euler_methods():
    """[PY] Remark 5.9: with H = p²/2 + V(q), (+) is p2 = p1 − hV'(q1), q1 = q0 + h p1; (−) the other one."""
    h, force = 0.1, lambda q: -np.sin(q)
    plus = InducedFiniteDifferenceDirac(step=h, sign="+")
    q0, p1 = np.array([0.3]), np.array([0.7])
    q1 = q0 + h * p1
    p2 = p1 + h * force(q1)
    assert plus.contains(q0, q1, (p1, p2), -force(q1), p1)
    minus = InducedFiniteDifferenceDirac(step=h, sign="-")
    before = np.array([0.7])
    p0 = before + h * force(q0)
    assert minus.contains(q0, q0 + h * p0, (before, p0), -force(q0), p0)


@given(SEEDS, st.integers(0, 3), st.integers(1, 5))
def test_annihilator_projectors(seed, rank, rows):
    """P = Pᵀ = P² with image Wᵀ, also for dependent one-forms."""
    rng = np.random.default_rng(seed)
    w = rng.normal(size=(rows, rank)) @ rng.normal(size=(rank, 5))
    onto = np.asarray(annihilator_projector(jnp.asarray(w)))
    expected = np.linalg.lstsq(w, w, rcond=1e-10)[0] if rows else np.zeros((5, 5))
    np.testing.assert_allclose(onto, expected, atol=1e-9)
    np.testing.assert_allclose(onto @ onto, onto, atol=1e-9)
    np.testing.assert_allclose(onto, onto.T, atol=1e-9)


def test_annihilator_projectors_have_derivatives_where_singular_values_coincide():
    point, direction = np.array([0.1, 0.2, 0.3, 0.4]), np.array([1.0, -1.0, 0.5, 2.0])
    project = lambda q: annihilator_projector(jnp.array([[1.0, 0.0, 0.0, q[2] - 0.3], [0.0, 1.0, 0.0, 0.0]]))
    _, derivative = jax.jvp(project, (jnp.asarray(point),), (jnp.asarray(direction),))
    e = np.eye(4)
    expected = 0.5 * (np.outer(e[0], e[3]) + np.outer(e[3], e[0]))
    np.testing.assert_allclose(derivative, expected, atol=1e-14)


@pytest.mark.parametrize("kind", [FiniteDifferenceDirac, InducedFiniteDifferenceDirac])
def test_bad_signs_steps_and_one_forms_are_refused(kind):
    with pytest.raises(ValueError, match=r'sign must be "\+" or "-"'):
        kind(two_form, step=0.1, sign="plus")
    with pytest.raises(ValueError, match="step must be a finite number other than 0"):
        kind(two_form, step=0.0)
    bad = InducedFiniteDifferenceDirac(lambda q: q[:2], step=0.1)
    with pytest.raises(ValueError, match=r"one_forms returned shape \(2,\)"):
        bad.constraint(jnp.zeros(4), jnp.ones(4))
    with pytest.raises(ValueError, match=r"two_form\(x\) is not skew: max \|M \+ Mᵀ\| = 2"):
        FiniteDifferenceDirac(lambda x: jnp.eye(2), step=0.1).flat(jnp.zeros(2), jnp.ones(2))
    with pytest.raises(ValueError, match='sign must be "'):
        GeneratingFunctionDirac("*")


# ------------------------------------------------------------------------------------------------------ generating functions


@jax.jit
def mixed(a, b):
    """A function of mixed variables whose second derivatives are nowhere special."""
    return a @ b + jnp.sum(jnp.sin(a) * b**2) / 3 + jnp.cos(a[0] + 2 * b[1])


@SOME
@given(SEEDS, SIGNS)
def test_generating_functions_generate_members(seed, sign):
    rng = np.random.default_rng(seed)
    D = GeneratingFunctionDirac(sign)
    base = (jnp.asarray(rng.normal(size=2)), jnp.asarray(rng.normal(size=2)))
    z0, z1 = D.generated(mixed, base)
    covector = jax.grad(mixed, argnums=(0, 1))(*base)
    assert D.contains(z0, z1, base, covector)
    assert not D.contains(z0, z1, base, (covector[0] + 1e-3, covector[1]))
    (q0, p0), (q1, p1) = z0, z1
    if sign == "+":  # S(q0, p1): p0 = ∂S/∂q0, q1 = ∂S/∂p1
        pairs = [(q0, base[0]), (p1, base[1]), (p0, covector[0]), (q1, covector[1])]
    else:  # S(p0, q1): q0 = −∂S/∂p0, p1 = −∂S/∂q1
        pairs = [(p0, base[0]), (q1, base[1]), (q0, -covector[0]), (p1, -covector[1])]
    for found, expected in pairs:
        np.testing.assert_array_equal(found, expected)
    for found, expected in zip(D.base_point(z0, z1), base, strict=True):
        np.testing.assert_array_equal(found, expected)


@settings(max_examples=5)
@given(SEEDS, SIGNS)
def test_generated_relations_are_symplectic(seed, sign):
    """Ω_1 − Ω_0 vanishes on the graph: for tangents u, w of (z0, z1)(base), dq1∧dp1(u, w) = dq0∧dp0(u, w)."""
    rng = np.random.default_rng(seed)
    D = GeneratingFunctionDirac(sign)
    base = jnp.asarray(rng.normal(size=4))

    def graph(b):
        (q0, p0), (q1, p1) = D.generated(mixed, (b[:2], b[2:]))
        return jnp.concatenate([q0, p0, q1, p1])

    tangent = np.asarray(jax.jit(jax.jacfwd(graph))(base))
    form = np.block([[np.zeros((2, 2)), np.eye(2)], [-np.eye(2), np.zeros((2, 2))]])
    before, after = tangent[:4], tangent[4:]
    np.testing.assert_allclose(after.T @ form @ after, before.T @ form @ before, atol=1e-12)
    assert np.linalg.norm(before.T @ form @ before) > 1e-3


# ----------------------------------------------------------------------------------------------------------- discretization maps


def euler_top(x):
    return jnp.array([[0.0, -x[2], x[1]], [x[2], 0.0, -x[0]], [-x[1], x[0], 0.0]])


@SOME
@given(SEEDS, STEPS, st.sampled_from([0.0, 0.5, 1.0]))
def test_discretization_map_members_on_a_vector_space(seed, h, theta):
    rng = np.random.default_rng(seed)
    D = DiscretizationMapDirac(DiracStructure.from_bivector(euler_top), Theta(theta), step=h)
    x, alpha = rng.normal(size=3), rng.normal(size=3)
    velocity = np.cross(x, alpha)  # Λ(x)α = x × α
    x0, x1 = x - theta * h * velocity, x + (1 - theta) * h * velocity
    assert D.contains(x0, x1, alpha)
    assert not D.contains(x0, x1, alpha + np.array([0.1, -0.2, 0.3]))
    scale = 1e-14 * (1 + np.max(np.abs([x0, x1])) / h) * (1 + np.max(np.abs(alpha)))
    assert np.max(np.abs(D.membership_defect(x0, x1, alpha))) < 20 * scale
    for found, expected in zip(D.pair(x, velocity), (x0, x1), strict=True):
        np.testing.assert_allclose(found, expected, atol=1e-13 * (1 + h))
    # over the base point it is the structure itself: unlike the pairs, it is Dirac
    assert D.at(x0, x1).is_dirac()
    assert D.at(x0, x1).distance(LinearDirac.from_bivector(euler_top(x))) < 1e-10 * (1 + h)


@SOME
@given(SEEDS)
@pytest.mark.soak
def test_the_free_rigid_body_on_the_sphere_is_a_member(seed):
    """[BLM] (4): (ξ1 − ξ0)/h = ((ξ0 + ξ1)/2) × I⁻¹((ξ0 + ξ1)/‖ξ0 + ξ1‖), with the projection map of the sphere."""
    rng, h, inertia = np.random.default_rng(seed), 0.1, np.array([1.0, 2.0, 3.0])
    xi0 = rng.normal(size=3)
    xi0 /= np.linalg.norm(xi0)
    xi1 = xi0
    for _ in range(200):
        middle = (xi0 + xi1) / 2
        xi1 = xi0 + h * np.cross(middle, middle / np.linalg.norm(middle) / inertia)
    D = DiscretizationMapDirac(DiracStructure.from_bivector(euler_top), SphereProjection(), step=h)
    x, v = D.velocity(xi0, xi1)
    assert np.linalg.norm(x) == pytest.approx(1.0, abs=1e-14)
    assert D.contains(xi0, xi1, np.asarray(x) / inertia)
    assert np.max(np.abs(D.membership_defect(xi0, xi1, np.asarray(x) / inertia))) < 1e-13
    assert not D.contains(xi0, xi1, np.asarray(x))
    np.testing.assert_allclose(np.asarray(v), np.cross(x, x / inertia), atol=1e-13)


def test_discretization_map_structures_refuse_other_objects():
    structure = DiracStructure.from_bivector(euler_top)
    with pytest.raises(TypeError, match="structure must be a DiracStructure"):
        DiscretizationMapDirac(euler_top, Midpoint())
    with pytest.raises(TypeError, match="map must be a discretization map"):
        DiscretizationMapDirac(structure, Midpoint)


@pytest.mark.parametrize("rank", [0, 1, 2, "dependent"])
@pytest.mark.soak_of(but=["0", "2"])
def test_the_slope_of_a_projected_covector(rank):
    """∂(P(q)α)/∂q by the formula of Golub and Pereyra against central differences of P(q)α, by singular values."""
    w = np.random.default_rng(5).normal(size=(2, 4, 4))

    def one_forms(q):
        rows = jnp.stack([jnp.sin(w[i] @ q) + i for i in range(2)])
        return {0: rows[:0], 1: rows[:1], 2: rows, "dependent": jnp.concatenate([rows, q[0] * rows[:1]])}[rank]

    q, covector = np.array([0.3, -0.7, 1.1, 0.4]), np.array([1.0, 0.5, -2.0, 0.3])
    found = projector_slope(one_forms, jnp.asarray(q), jnp.asarray(covector))
    at = lambda q: np.asarray(annihilator_projector(one_forms(jnp.asarray(q)))) @ covector
    differences = [(at(q + 1e-6 * e) - at(q - 1e-6 * e)) / 2e-6 for e in np.eye(4)]
    assert np.asarray(found) == pytest.approx(np.stack(differences, axis=1), abs=1e-8)
    assert rank == 0 or np.abs(found).max() > 0.1


def test_points_are_lists_and_whole_numbers_too():
    """As everywhere else: some of these ended in errors of JAX's."""
    form, whole = lambda x: jnp.array([[0.0, 1.0], [-1.0, 0.0]]), np.array([1, 2])
    on_pairs = dx.FiniteDifferenceDirac(form, step=0.1)
    assert on_pairs.contains([0, 0], [0.1, 0.2], [-2, 1])
    np.testing.assert_allclose(on_pairs.membership_defect([0, 0], [0.1, 0.2], [-2, 1])[1], 0.0, atol=1e-14)
    induced = dx.InducedFiniteDifferenceDirac(lambda q: jnp.array([[1.0, q[0]]]), step=0.1)
    assert induced.at([0, 0]).contains(jnp.zeros(4), jnp.array([1.0, 0.0, 0.0, 0.0]))
    by_map = dx.DiscretizationMapDirac(dx.DiracStructure.from_two_form(form), dx.Midpoint(), step=0.1)
    np.testing.assert_allclose(by_map.membership_defect([0, 0], [0.1, 0.2], [-2, 1]), 0.0, atol=1e-14)
    np.testing.assert_allclose(dx.plus_legendre(lambda a, b: (b - a) @ (b - a) / 2, whole, [3, 4])[1], [2.0, 2.0])
    (_, p, beta, _) = dx.TulczyjewTriple().dirac_differential(lambda q, v: v @ v / 2 - q @ q, whole, whole)
    np.testing.assert_allclose([p, beta], [[1.0, 2.0], [2.0, 4.0]])
    family = dx.LagrangianSubmanifold.from_morse_family(lambda x, s: s[0] * x[0], 1)
    np.testing.assert_allclose(family.covector(whole, [3]), [3.0, 0.0])
    with pytest.raises(ValueError, match=r"s must have shape \(1,\), the parameters of the family, but its shape is \(3,\)"):
        family.covector(whole, [1.0, 2.0, 3.0])
    with pytest.raises(ValueError, match=r"x and v must have one shape \(N,\).* \(2,\) and \(3,\)"):
        dx.check_discretization_map(dx.Midpoint(), whole, [1.0, 2.0, 3.0])
