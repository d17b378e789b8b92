"""Dirac structures at every point: conventions, the induced one on T*Q, integrability against closed forms."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import dirax as dx
from dirax.geometry.linear import LinearDirac
from dirax.geometry.structures import DiracStructure, canonical_two_form, induced_dirac
from dirax.program.user_functions import constant_entries

POINT = np.array([0.3, -0.7, 1.1, 0.4])


def hat(x):
    """Λ(x) with Λ(x)v = x × v."""
    return jnp.array([[0.0, -x[2], x[1]], [x[2], 0.0, -x[0]], [-x[1], x[0], 0.0]])


def rolling(q):
    """The vertical rolling disk of [PY], q = (x, y, θ, φ), R = 1."""
    return jnp.array([[1.0, 0.0, -jnp.cos(q[3]), 0.0], [0.0, 1.0, -jnp.sin(q[3]), 0.0]])


def rolling_distribution(q):
    return jnp.array([[jnp.cos(q[3]), jnp.sin(q[3]), 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]]).T


def turning_form(q):
    return q[0] * canonical_two_form(2) + jnp.outer(q, q[::-1]) - jnp.outer(q[::-1], q)


# Every constructor says pointwise what the linear one says, and its kernel pair the same once more.


REPRESENTATIONS = {
    "two_form": (turning_form,),
    "bivector": (turning_form,),
    "subspace": (rolling_distribution,),
    "subspace_and_form": (rolling_distribution, turning_form),
    "annihilator": (rolling, turning_form),
    "codistribution_and_bivector": (rolling_distribution, turning_form),
    "kernel": (turning_form, lambda q: -jnp.eye(4)),
    "image": (lambda q: jnp.eye(4), lambda q: turning_form(q).T),
}


@pytest.mark.parametrize("name", REPRESENTATIONS)
@pytest.mark.soak_of("two_form", "bivector", "subspace", "annihilator", "kernel")
def test_at_a_point(name):
    functions = REPRESENTATIONS[name]
    structure = getattr(DiracStructure, f"from_{name}")(*functions)
    linear = getattr(LinearDirac, f"from_{name}")(*(function(POINT) for function in functions))
    assert structure.at(POINT).equals(linear, 1e-13)
    points = POINT + np.linspace(0.0, 1.0, 5)[:, None]

    @jax.jit
    def evaluate(q, points):
        return structure.kernel(q), jax.vmap(structure.at)(points), jax.jacfwd(lambda q: structure.at(q).scattering)(q)

    (F, E), batch, tangent = evaluate(POINT, points)
    A, B = linear.image()
    assert np.max(np.abs(F @ A + E @ B)) < 1e-13
    assert np.linalg.matrix_rank(np.concatenate([F, E], axis=1)) == 4
    assert np.all(batch.is_dirac(1e-13))
    assert batch.scattering.shape == (5, 4, 4)
    assert structure.at(points[3]).equals(LinearDirac(batch.scattering[3]), 1e-13)
    # Smooth: the derivative of the scattering matrix of the pair is finite and tangent to the orthogonal matrices.
    rotation = np.einsum("ijl,kj->ikl", tangent, linear.scattering)
    assert np.max(np.abs(rotation + np.swapaxes(rotation, 0, 1))) < 1e-12


def test_kernel_conventions():
    structure = DiracStructure.from_two_form(lambda q: canonical_two_form(2))
    F, E = structure.kernel(POINT)
    assert np.array_equal(F, canonical_two_form(2).T) and np.array_equal(E, -np.eye(4))
    F, E = DiracStructure.from_bivector(hat).kernel(POINT[:3])
    assert np.array_equal(F, np.eye(3)) and np.array_equal(E, -hat(POINT[:3]))
    assert DiracStructure.from_bivector(hat).at(POINT[:3]).contains(np.cross(POINT[:3], [1.0, 2.0, 3.0]), [1.0, 2.0, 3.0])


def test_params_reach_the_functions_that_take_them():
    structure = DiracStructure.from_annihilator(lambda q, params: params["radius"] * rolling(q), turning_form)
    same = DiracStructure.from_annihilator(rolling, turning_form)
    assert structure.at(POINT, {"radius": 3.0}).equals(same.at(POINT), 1e-13)
    scaled = DiracStructure.from_bivector(lambda x, params: params * hat(x))
    assert np.allclose(scaled.kernel(POINT[:3], 2.0)[1], -2.0 * hat(POINT[:3]))
    assert scaled.integrability_defect(POINT[:3], 2.0) < 1e-13


@pytest.mark.parametrize(
    ("structure", "point", "error", "words"),
    [
        (lambda: DiracStructure.from_two_form(lambda x: jnp.eye(4)), POINT, ValueError, r"two_form is not skew.*2\.000e\+00"),
        (lambda: DiracStructure.from_two_form(turning_form), POINT[:3], TypeError, r"two_form\(x\) could not be traced.*\(3,\)"),
        (lambda: DiracStructure.from_bivector(hat), POINT, ValueError, "for dimension 3, but x has 4"),
        (lambda: DiracStructure.from_bivector(hat, n=3), POINT[:2], ValueError, r"x has shape \(2,\).*\(3,\)"),
        (lambda: DiracStructure.from_bivector(hat), np.ones((5, 3)), ValueError, "vmap"),
        (lambda: DiracStructure.from_bivector(np.eye(3)), POINT, TypeError, "bivector must be a function"),
        (lambda: DiracStructure.from_bivector(lambda: None), POINT, TypeError, "bivector must have the signature"),
        (lambda: DiracStructure.from_kernel(lambda x: jnp.eye(4), lambda x: jnp.eye(4)), POINT, ValueError, "not isotropic"),
        (lambda: DiracStructure.from_subspace(lambda x: jnp.ones((4, 2))), POINT, ValueError, "basis has rank 1"),
        (lambda: induced_dirac(lambda q: jnp.ones((1, 3)), 2), POINT, ValueError, r"one_forms returned shape \(1, 3\)"),
    ],
)
def test_bad_input_is_named(structure, point, error, words):
    with pytest.raises(error, match=words):
        structure().at(point)


# The structure on T*Q.


def test_induced_structure_is_py_25():
    rng = np.random.default_rng(1)
    structure = induced_dirac(rolling, 4)
    q, p, multipliers = POINT, rng.normal(size=4), rng.normal(size=2)
    linear = structure.at(np.concatenate([q, p]))
    assert linear.n == 8 and linear.is_dirac(1e-14)
    W = np.asarray(rolling(q))
    q_dot = np.asarray(rolling_distribution(q)) @ rng.normal(size=2)
    p_dot = rng.normal(size=4)
    eta, xi = W.T @ multipliers - p_dot, q_dot
    v = np.concatenate([q_dot, p_dot])
    assert linear.contains(v, np.concatenate([eta, xi]))
    assert not linear.contains(v, np.concatenate([eta + 1e-6 * q_dot, xi]))  # η + ṗ outside of Δ°
    assert not linear.contains(v, np.concatenate([eta, xi + 1e-6]))  # ξ ≠ q̇
    sliding = v + np.concatenate([1e-6 * W[0], np.zeros(4)])
    assert not linear.contains(sliding, np.concatenate([eta, sliding[:4]]))  # q̇ outside of Δ
    assert linear.distribution().shape == (8, 6)


def test_induced_structure_without_constraints_is_canonical():
    z = np.arange(6.0)
    canonical = LinearDirac.from_two_form(canonical_two_form(3))
    assert induced_dirac(None, 3).at(z).equals(canonical)
    assert induced_dirac(lambda q: jnp.zeros((0, 3)), 3).at(z).equals(canonical)
    q_dot, p_dot = np.array([1.0, 2.0, 3.0]), np.array([4.0, 5.0, 6.0])
    assert canonical.contains([*q_dot, *p_dot], [*-p_dot, *q_dot])


# Integrability.


def quadratic(coefficients, x):
    return jnp.einsum("aij,i,j->a", coefficients, x, x)


coefficients = st.integers(0, 2**32 - 1).map(lambda seed: np.random.default_rng(seed).normal(size=(5, 5, 5)))


def closed_form(x, params):
    """dθ for a one-form θ with quadratic coefficients: (dθ)_ij = ∂_i θ_j − ∂_j θ_i."""
    derivative = jax.jacfwd(lambda x: quadratic(params, x))(x)
    return derivative.T - derivative


def poisson_tensor(x, params):
    """On R³ the bivector α ↦ f ∇C × α is Poisson for all functions f and C."""
    gradient = jax.grad(lambda x: quadratic(params[0:1, :3, :3], x)[0] + jnp.sum(x**3))(x)
    return (1.0 + quadratic(params[1:2, :3, :3], x)[0]) * hat(gradient)


def holonomic(x, params):
    """dg¹ and f dg² + g¹ dg¹: their kernel is tangent to the level sets of g¹ and g²."""
    first, second = jax.jacfwd(lambda x: quadratic(params[:2], x) + jnp.array([x[0], x[1]]))(x)
    return jnp.stack([first, (2.0 + jnp.sin(x[3])) * second + x[2] * first])


INTEGRABLE = {
    "closed two-form": (DiracStructure.from_two_form(closed_form), 5),
    "Poisson bivector": (DiracStructure.from_bivector(poisson_tensor), 3),
    "holonomic constraints": (DiracStructure.from_annihilator(holonomic), 5),
    "a closed form on the leaves": (DiracStructure.from_annihilator(holonomic, closed_form), 5),
    "holonomic constraints on T*Q": (induced_dirac(lambda q, params: holonomic(q, params)[:1], 5), 10),
}


@pytest.mark.parametrize("name", INTEGRABLE)
@pytest.mark.soak
def test_integrable_structures_have_no_defect(name):
    structure, n = INTEGRABLE[name]

    @settings(max_examples=30, deadline=None)
    @given(coefficients, st.lists(st.floats(-1, 1), min_size=n, max_size=n).map(np.array))
    def check(params, x):
        assert structure.integrability_defect(x, params) < 1e-10

    check()


@pytest.mark.soak
def test_defects_in_closed_form():
    points = np.random.default_rng(4).normal(size=(20, 3))
    x, y, _ = points.T

    def defects(structure):
        return jax.jit(jax.vmap(structure.integrability_defect))(points)

    # ω = x dy∧dz, dω = dx∧dy∧dz; v = (I − ωᵀ)⁻¹ d on orthonormal waves d, of determinant 1/(1 + x²).
    form = DiracStructure.from_two_form(lambda x: x[0] * jnp.array([[0.0, 0, 0], [0, 0, 1], [0, -1, 0]]))
    assert np.allclose(defects(form), np.sqrt(6) / (1 + x**2), rtol=1e-12)
    # Λ♯α = a × α with a = (−y, 0, 1): the Jacobiator is a·curl a = 1; α = (Λ − I)⁻¹ d.
    bivector = DiracStructure.from_bivector(lambda x: hat(jnp.array([-x[1], 0.0, 1.0])))
    assert np.allclose(defects(bivector), np.sqrt(6) / (2 + y**2), rtol=1e-12)
    # Heisenberg: w = (y, −x, −1); for unit vectors X, Y in Δ and α = w/|w|, ⟨α, [X, Y]⟩ = ± w·curl w/|w|².
    heisenberg = DiracStructure.from_annihilator(lambda x: jnp.array([[x[1], -x[0], -1.0]]))
    assert np.allclose(defects(heisenberg), 2 * np.sqrt(6) / (1 + x**2 + y**2), rtol=1e-12)


@pytest.mark.soak
def test_rolling_disk_is_not_integrable():
    # X = (cos φ, sin φ, 1, 0)/√2 and Y = ∂_φ are orthonormal; |[X, Y]| = 1/√2 and it is orthogonal to Δ.
    on_q = DiracStructure.from_annihilator(rolling)
    assert np.isclose(on_q.integrability_defect(POINT), np.sqrt(6 / 2), rtol=1e-12)
    by_basis = DiracStructure.from_subspace(rolling_distribution)
    assert np.isclose(by_basis.integrability_defect(POINT), np.sqrt(6 / 2), rtol=1e-12)
    assert induced_dirac(rolling, 4).integrability_defect(np.concatenate([POINT, POINT])) > 0.1


def test_courant_tensor_against_a_frame_made_by_hand():
    """Sections written down for the rolling disk on T*Q; their tensor, brought to the orthonormal frame of D."""
    z = np.concatenate([POINT, [0.5, -0.2, 0.9, 0.1]])
    structure = induced_dirac(rolling, 4)

    def sections(z):
        W, X = rolling(z[:4]), rolling_distribution(z[:4])
        zero, one = jnp.zeros((4, 4)), jnp.eye(4)
        vectors = jnp.block([[X, zero, jnp.zeros((4, 2))], [jnp.zeros((4, 2)), one, jnp.zeros((4, 2))]])
        covectors = jnp.block([[jnp.zeros((4, 2)), -one, W.T], [X, zero, jnp.zeros((4, 2))]])
        return vectors, covectors

    vectors, covectors = (np.asarray(part) for part in sections(z))
    assert np.all(structure.at(z).contains(vectors.T[:, None], covectors.T[:, None]))
    dv, da = (np.asarray(part) for part in jax.jit(jax.jacfwd(sections))(z))

    def lie(i, j, k):
        """⟨L_{X_i} α_j, X_k⟩ = X_i(α_j(X_k)) − α_j([X_i, X_k])."""
        derivative = da[:, j] @ vectors[:, i] @ vectors[:, k] + covectors[:, j] @ dv[:, k] @ vectors[:, i]
        bracket = dv[:, k] @ vectors[:, i] - dv[:, i] @ vectors[:, k]
        return derivative - covectors[:, j] @ bracket

    indices = range(8)
    tensor = np.array([[[lie(i, j, k) + lie(j, k, i) + lie(k, i, j) for k in indices] for j in indices] for i in indices])
    assert np.allclose(tensor, -np.swapaxes(tensor, 0, 1), atol=1e-13)
    A, B = structure.at(z).image()
    change = np.linalg.lstsq(np.concatenate([vectors, covectors]), np.concatenate([A, B]), rcond=None)[0]
    expected = np.einsum("abc,ai,bj,ck->ijk", tensor, change, change, change)
    assert np.allclose(structure.courant_tensor(z), expected, atol=1e-12)
    assert np.isclose(structure.integrability_defect(z), np.linalg.norm(expected), rtol=1e-12)


# New structures from old ones.


def test_cotangent_lift_of_a_change_of_coordinates_is_symplectic():
    def lift(z):
        q, p = z[:2], z[2:]

        def point(q):
            return jnp.array([q[0] + q[1] ** 2, jnp.sinh(q[1])])

        return jnp.concatenate([point(q), jnp.linalg.solve(jax.jacfwd(point)(q).T, p)])

    canonical = induced_dirac(None, 2)
    assert canonical.pull_back(lift).at(POINT).equals(canonical.at(POINT), 1e-13)
    # through the general route, which does not know of two-forms
    general = DiracStructure.from_kernel(lambda z: canonical_two_form(2).T, lambda z: -jnp.eye(4)).pull_back(lift)
    assert general.representation == "kernel"
    assert general.at(POINT).equals(canonical.at(POINT), 1e-12)
    assert general.integrability_defect(POINT) < 1e-12


@pytest.mark.soak
def test_pull_back_of_constraints_and_of_integrability():
    def immersion(y):
        return jnp.array([y[0] + y[1] * y[2], y[1], jnp.sin(y[2]), y[0] * y[2]])

    y = np.array([0.2, 0.5, -0.3])
    pulled = DiracStructure.from_annihilator(rolling).pull_back(immersion)
    by_hand = DiracStructure.from_annihilator(lambda y: rolling(immersion(y)) @ jax.jacfwd(immersion)(y))
    assert pulled.at(y).equals(by_hand.at(y), 1e-12)
    assert np.isclose(pulled.integrability_defect(y), by_hand.integrability_defect(y), rtol=1e-10)
    closed = DiracStructure.from_annihilator(lambda x: jnp.array([[x[1], x[0], 0.0, 1.0]])).pull_back(immersion)
    assert closed.integrability_defect(y) < 1e-12


def test_product():
    first, second = DiracStructure.from_bivector(hat, n=3), DiracStructure.from_annihilator(rolling, n=4)
    both = first.product(second)
    x = np.concatenate([[0.6, 0.0, 0.8], POINT])
    assert both.n == 7
    assert both.at(x).equals(first.at(x[:3]).direct_sum(second.at(x[3:])), 1e-14)
    assert np.isclose(both.integrability_defect(x), second.integrability_defect(POINT), rtol=1e-12)
    with pytest.raises(ValueError, match="give n="):
        first.product(DiracStructure.from_annihilator(rolling))


def test_mass_and_spring_through_their_ports_are_the_oscillator():
    """Mass: ṗ = force, velocity = ∂H/∂p at its port. Spring: q̇ = velocity, −∂H/∂q at its port."""
    mass = DiracStructure.from_bivector(lambda p: jnp.array([[0.0, 1.0], [-1.0, 0.0]]), n=1, ports=1)
    spring = DiracStructure.from_annihilator(lambda q: jnp.array([[1.0, -1.0]]), n=1, ports=1)
    joined = mass.compose(spring)
    assert joined.n == 2 and joined.ports == 0
    x = np.array([0.3, 0.2])  # (p, q): ṗ = −H_q, q̇ = H_p
    assert joined.at(x).equals(LinearDirac.from_bivector([[0.0, -1.0], [1.0, 0.0]]), 1e-14)
    assert joined.integrability_defect(x) < 1e-14
    with pytest.raises(ValueError, match="ports"):
        mass.integrability_defect(x[:1])


def test_a_composition_of_constant_structures_is_constant_where_it_is_traced():
    part = DiracStructure.from_bivector(lambda x: jnp.array([[0.0, 1.0, 1.0], [-1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]]), n=2, ports=1)
    joined, x = part.compose(part), np.array([0.3, 0.2, 0.1, 0.4])
    traced = jax.jit(joined.kernel)
    assert np.array_equal(constant_entries(lambda x: jnp.stack(joined.kernel(x)), x), joined.kernel(x))
    assert np.array_equal(traced(x), joined.kernel(x))
    of_params = DiracStructure.from_bivector(lambda x, params: params * jnp.array([[0.0, 1.0], [-1.0, 0.0]]), n=1, ports=1)
    mixed = of_params.compose(of_params)
    assert np.allclose(jax.jit(mixed.kernel)(x[:2], 2.0), mixed.kernel(x[:2], 2.0), atol=1e-14)


@pytest.mark.parametrize(
    "change, error, message",
    [
        ({"other": 3}, TypeError, "composed with another one, but a int"),
        ({"ports": 0}, TypeError, "ports must be a list of whole numbers"),
        ({"other_ports": [0.5]}, TypeError, "other_ports must be a list of whole numbers"),
        ({"common": "efforts"}, ValueError, "'covectors' or 'vectors' was expected"),
    ],
)
def test_what_is_no_composition(change, error, message):
    part = DiracStructure.from_bivector(lambda x: jnp.array([[0.0, 1.0], [-1.0, 0.0]]), n=1, ports=1)
    with pytest.raises(error, match=message):
        part.compose(**{"other": part, "ports": [0], "other_ports": [0], **change})


def test_open_ports_keep_their_places():
    """Two structures with two ports each, one joined: the fibre is (x, x', free port of each)."""
    rng = np.random.default_rng(2)
    forms = [rng.normal(size=(k, k)) for k in (4, 5)]
    first, second = (DiracStructure.from_two_form(lambda x, form=form: form - form.T, n=len(form) - 2, ports=2) for form in forms)
    joined = first.compose(second, [1], [0])
    assert joined.n == 5 and joined.ports == 2
    x = np.zeros(5)
    linear = first.at(x[:2]).compose(second.at(x[2:]), [3], [3])  # (x, free port, x', free port')
    order = [0, 1, 3, 4, 5, 2, 6]
    assert joined.at(x).equals(LinearDirac(linear.scattering[np.ix_(order, order)]), 1e-12)
    with pytest.raises(ValueError, match="other_ports is"):
        first.compose(second, [1], [2])
    with pytest.raises(ValueError, match="cannot be joined"):
        first.compose(second, [1], [0, 1])


def test_structures_are_shown_by_their_functions():
    plane = dx.DiracStructure.from_bivector(lambda x: jnp.array([[0.0, 1.0], [-1.0, 0.0]]), n=2)
    induced = dx.induced_dirac(lambda q, params: q[None], 2)
    assert repr(plane) == "DiracStructure(bivector=lambda(x), n=2)"
    assert repr(dx.induced_dirac(None, 2)) == "DiracStructure(canonical, n=4)"
    assert repr(induced) == "DiracStructure(induced by one_forms=lambda(q, params), n=4)"
    assert repr(plane.product(induced)) == f"DiracStructure({plane!r} and {induced!r}, n=6)"
    assert repr(plane.pull_back(lambda y: y)) == f"DiracStructure(pull-back of {plane!r} by lambda(y))"
    assert "0x" not in repr(dx.DiracSystem(plane, lambda x: x @ x))
