"""Linear Dirac structures against numpy's null spaces, and the laws of [BLM] §2.1 on random ones.

Oracles work on bases of V ⊕ V* with numpy's SVD; they know neither the scattering matrix nor the kernel pairs.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dirax.geometry.linear import LinearDirac
from dirax.geometry.subspaces import PontryaginSubspace, pseudo_inverse
from dirax.numerics.ranks import UndecidableRank

FAST = settings(max_examples=30, deadline=None)
DIMENSIONS = st.sampled_from([2, 3, 5, 8])  # a few, for the sake of compile time; all of 2, …, 12 below
NEARLY_DEGENERATE = (1e-3, 1e-5, 1e-7)


# Oracles: subspaces of R^{2n} as numpy arrays of spanning columns.


def span(columns, tolerance=1e-9):
    """Orthogonal projector onto the span of columns, and its dimension."""
    left, values, _ = np.linalg.svd(columns)
    rank = int(np.sum(values > tolerance * max(1.0, values.max(initial=0.0))))
    return left[:, :rank] @ left[:, :rank].T, rank


def null_space(matrix, tolerance=1e-9):
    _, values, right = np.linalg.svd(matrix)
    return right[int(np.sum(values > tolerance * max(1.0, values.max(initial=0.0)))) :].T


def orthogonal_by_null_space(A, B):
    """D^⊥ as the solutions (w, β) of Bᵀw + Aᵀβ = 0."""
    return null_space(np.concatenate([B.T, A.T], axis=1))


def pulled_back(A, B, phi):
    solutions = null_space(np.concatenate([phi, -A], axis=1))
    w, s = solutions[: phi.shape[1]], solutions[phi.shape[1] :]
    return np.concatenate([w, phi.T @ B @ s])


def pushed_forward(A, B, phi):
    solutions = null_space(np.concatenate([phi.T, -B], axis=1))
    beta, s = solutions[: phi.shape[0]], solutions[phi.shape[0] :]
    return np.concatenate([phi @ A @ s, beta])


def composed(A1, B1, A2, B2, ports, other_ports, tolerance=1e-9):
    """Common covectors, opposite vectors at the ports; the solutions (s1, s2) seen from the other coordinates."""
    match = np.block([[A1[ports], A2[other_ports]], [B1[ports], -B2[other_ports]]])
    s = null_space(match, tolerance)
    s1, s2 = s[: A1.shape[1]], s[A1.shape[1] :]
    kept1, kept2 = np.delete(np.arange(len(A1)), ports), np.delete(np.arange(len(A2)), other_ports)
    return np.concatenate([A1[kept1] @ s1, A2[kept2] @ s2, B1[kept1] @ s1, B2[kept2] @ s2])


def stacked(structure):
    return np.concatenate([np.asarray(part) for part in structure.image()], axis=-2)


def gap(structure, columns):
    """Spectral distance between the projectors of a structure and of a span; also asserts its dimension."""
    projector, rank = span(columns)
    assert rank == structure.n
    own = stacked(structure)
    return np.linalg.norm(own @ own.T - projector, 2)


# Random structures.


def random_orthogonal(rng, n, *batch):
    return np.linalg.qr(rng.normal(size=(*batch, n, n)))[0]


def random_skew(rng, n, rank=None):
    """A skew matrix of even rank with singular values between 0.2 and 5."""
    rank = 2 * (n // 2) if rank is None else rank
    blocks = np.zeros((n, n))
    for i in range(0, rank, 2):
        blocks[i, i + 1] = np.exp(rng.uniform(-1.6, 1.6))
    Q = random_orthogonal(rng, n)
    return Q @ (blocks - blocks.T) @ Q.T


def random_map(rng, rows, columns, rank):
    """A matrix of the given rank, with nonzero singular values between 0.3 and 3."""
    values = np.exp(rng.uniform(-1.2, 1.1, size=rank))
    return (random_orthogonal(rng, rows)[:, :rank] * values) @ random_orthogonal(rng, columns)[:, :rank].T


def rotation_blocks(angles, n):
    """Block-diagonal orthogonal matrices (..., n, n) of plane rotations, and a last 1 where n is odd."""
    O = np.zeros((*angles.shape[:-1], n, n))
    for i in range(n // 2):
        c, s = np.cos(angles[..., i]), np.sin(angles[..., i])
        O[..., 2 * i, 2 * i], O[..., 2 * i, 2 * i + 1] = c, -s
        O[..., 2 * i + 1, 2 * i], O[..., 2 * i + 1, 2 * i + 1] = s, c
    if n % 2:
        O[..., -1, -1] = 1.0
    return O


def random_image(rng, O):
    """(A, B) of the Dirac structure v + α = O (v − α), in a random basis of condition up to about 50."""
    n, batch = O.shape[-1], O.shape[:-2]
    Q = random_orthogonal(rng, n, *batch)
    O = Q @ O @ np.swapaxes(Q, -1, -2)
    S = np.exp(rng.uniform(-2, 2, size=(*batch, n)))[..., None, :] * random_orthogonal(rng, n, *batch)
    S = random_orthogonal(rng, n, *batch) @ S
    return (O + np.eye(n)) / 2 @ S, (O - np.eye(n)) / 2 @ S


@st.composite
def images(draw, dimensions=DIMENSIONS, near=True):
    """(A, B) of a Dirac structure: every angle may be generic, degenerate (0, π) or, with `near`, nearly so."""
    n = draw(dimensions)
    kinds = [None, 0.0, np.pi]
    if near:
        kinds += [*(np.pi - e for e in NEARLY_DEGENERATE), *NEARLY_DEGENERATE]
    chosen = draw(st.lists(st.sampled_from(kinds), min_size=n // 2, max_size=n // 2))
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    angles = np.array([rng.uniform(0.3, 2.8) if kind is None else kind for kind in chosen])
    return random_image(rng, rotation_blocks(angles, n) * draw(st.sampled_from([1.0, -1.0])))


generators = st.integers(0, 2**32 - 1).map(np.random.default_rng)


# The constructors say what they are said to say.


@FAST
@given(DIMENSIONS, generators, st.data())
def test_graph_of_a_two_form(n, rng, data):
    form = random_skew(rng, n, 2 * data.draw(st.integers(0, n // 2)))
    structure = LinearDirac.from_two_form(form)
    assert gap(structure, np.concatenate([np.eye(n), form.T])) < 1e-12
    v = rng.normal(size=n)
    assert structure.contains(v, form.T @ v)
    assert not structure.contains(v, form.T @ v + 1e-6 * rng.normal(size=n))
    assert np.allclose(structure.two_form(), form, atol=1e-12)


@FAST
@given(DIMENSIONS, generators, st.data())
def test_graph_of_a_bivector(n, rng, data):
    bivector = random_skew(rng, n, 2 * data.draw(st.integers(0, n // 2)))
    structure = LinearDirac.from_bivector(bivector)
    assert gap(structure, np.concatenate([bivector, np.eye(n)])) < 1e-12
    assert np.allclose(structure.bivector(), bivector, atol=1e-12)


def test_canonical_form_gives_hamiltons_equations():
    form = np.block([[np.zeros((2, 2)), np.eye(2)], [-np.eye(2), np.zeros((2, 2))]])
    q_dot, p_dot = np.array([0.3, -1.1]), np.array([0.7, 2.0])
    assert LinearDirac.from_two_form(form).contains([*q_dot, *p_dot], [*-p_dot, *q_dot])
    assert LinearDirac.from_bivector(form).contains([*q_dot, *p_dot], [*-p_dot, *q_dot])


@FAST
@given(DIMENSIONS, generators, st.data())
def test_distributions_with_and_without_a_form(n, rng, data):
    k = data.draw(st.integers(0, n))
    basis, form = random_map(rng, n, k, min(n, k)), random_skew(rng, n)
    annihilator = null_space(basis.T)
    plain = np.block([[basis, np.zeros((n, n - k))], [np.zeros((n, k)), annihilator]])
    with_form = np.block([[basis, np.zeros((n, n - k))], [form.T @ basis, annihilator]])
    assert gap(LinearDirac.from_subspace(basis), plain) < 1e-12
    assert gap(LinearDirac.from_annihilator(annihilator.T), plain) < 1e-12
    assert gap(LinearDirac.from_subspace_and_form(basis, form), with_form) < 1e-12
    assert gap(LinearDirac.from_annihilator(annihilator.T, form), with_form) < 1e-12
    dual = np.block([[form @ basis, annihilator], [basis, np.zeros((n, n - k))]])
    assert gap(LinearDirac.from_codistribution_and_bivector(basis, form), dual) < 1e-12


# D = D^⊥ and the representations.


@FAST
@given(images())
def test_equal_to_its_orthogonal(image):
    structure = LinearDirac.from_image(*image)
    assert gap(structure, np.concatenate(image)) < 1e-10
    assert gap(structure, orthogonal_by_null_space(*image)) < 1e-10
    assert gap(structure.orthogonal(), np.concatenate(image)) < 1e-10
    assert structure.is_dirac(1e-13) and structure.is_isotropic(1e-13) and structure.is_coisotropic(1e-13)
    assert structure.subspace().is_dirac(1e-13)


@FAST
@given(images(), generators)
def test_kernel_and_image_round_trips_in_any_basis(image, rng):
    structure = LinearDirac.from_image(*image)
    F, E = structure.kernel()
    A, B = structure.image()
    assert np.max(np.abs(F @ A + E @ B)) < 1e-13
    mixed = random_map(rng, structure.n, structure.n, structure.n)
    assert LinearDirac.from_kernel(mixed @ F, mixed @ E).equals(structure, 1e-10)
    assert LinearDirac.from_image(A @ mixed, B @ mixed).equals(structure, 1e-10)
    assert np.max(np.abs(F @ F.T + E @ E.T - np.eye(structure.n))) < 1e-13


@FAST
@given(images())
@pytest.mark.soak
def test_the_pair_of_proposition_2_3_determines_the_structure(image):
    structure = LinearDirac.from_image(*image)
    basis, form = structure.distribution(), structure.two_form()
    expected, dimension = span(np.linalg.qr(np.concatenate(image))[0][: structure.n], 2e-9)
    assert basis.shape[1] == dimension
    assert np.linalg.norm(basis @ basis.T - expected, 2) < 1e-7  # an angle of 1e-7 magnifies roundoff to 1e-9
    # ω_D(u, v) = α(v) for (u, α) ∈ D and v ∈ F_D, in the paper's words.
    size = max(1.0, np.max(np.abs(form)))
    assert np.max(np.abs(image[0].T @ form @ basis - image[1].T @ basis), initial=0.0) < 1e-8 * size
    assert LinearDirac.from_subspace_and_form(basis, form).equals(structure, 1e-8)
    cobasis, bivector = structure.codistribution(), structure.bivector()
    assert LinearDirac.from_codistribution_and_bivector(cobasis, bivector).equals(structure, 1e-8)


@pytest.mark.parametrize("n", range(2, 13))
@pytest.mark.soak_of(but=["2"])
def test_ten_thousand_random_structures(n):
    """D = D^⊥, round trips between all representations and composition to 1e-10; 3 × 304 structures a dimension."""
    rng = np.random.default_rng(n)
    count, pairs = 304, n // 2
    exact = np.where(np.arange(pairs) % 3 == 0, np.pi, np.where(np.arange(pairs) % 3 == 1, 0.0, np.nan))
    near = np.array([np.pi - 1e-5, np.nan, 1e-5, np.pi, 0.0, np.pi - 1e-4])[:pairs]
    partner = None  # the generic structures, for the compositions
    for fixed in (np.full(pairs, np.nan), exact, near):
        drawn = rng.uniform(0.3, 2.8, size=(count, pairs))
        angles = np.where(np.isnan(fixed), drawn, fixed)
        A, B = random_image(rng, rotation_blocks(angles, n))
        structure = LinearDirac.from_image(A, B)
        own = stacked(structure)
        projector = own @ np.swapaxes(own, -1, -2)

        orthonormal = np.linalg.svd(np.concatenate([A, B], axis=-2), full_matrices=False)[0]
        assert np.max(np.abs(orthonormal @ np.swapaxes(orthonormal, -1, -2) - projector)) < 1e-10
        equations = np.concatenate([np.swapaxes(B, -1, -2), np.swapaxes(A, -1, -2)], axis=-1)
        complement = np.linalg.svd(equations)[2][..., n:, :]
        assert np.max(np.abs(np.swapaxes(complement, -1, -2) @ complement - projector)) < 1e-10
        assert np.max(structure.orthogonal().distance(structure)) < 1e-10

        mixed = random_orthogonal(rng, n, count) * np.exp(rng.uniform(-1, 1, size=(count, 1, n)))
        F, E = structure.kernel()
        assert np.max(LinearDirac.from_kernel(mixed @ F, mixed @ E).distance(structure)) < 1e-10
        assert np.max(LinearDirac.from_image(*structure.image()).distance(structure)) < 1e-10
        basis, form = structure.distribution(), structure.two_form()
        assert basis.shape == (count, n, n - 2 * np.sum(fixed == np.pi))
        assert np.max(LinearDirac.from_subspace_and_form(basis, form).distance(structure)) < 1e-10
        cobasis, bivector = structure.codistribution(), structure.bivector()
        assert cobasis.shape[-1] == 2 * np.sum(fixed != 0.0)  # the last angle of an odd dimension is 0
        dual = LinearDirac.from_codistribution_and_bivector(cobasis, bivector)
        assert np.max(dual.distance(structure)) < 1e-10

        ports = max(1, n // 3)
        partner = partner or jax.tree.map(lambda leaf: jnp.roll(leaf, 1, axis=0), structure)
        joined = structure.compose(partner, range(ports), range(n - ports, n))
        assert joined.n == 2 * (n - ports)
        assert np.max(joined.orthogonal().distance(joined)) < 1e-10
        own, other = stacked(joined), stacked(partner)
        for i in range(0, count, 8):
            expected, rank = span(composed(A[i], B[i], other[i, :n], other[i, n:], range(ports), range(n - ports, n)))
            assert rank == joined.n
            assert np.linalg.norm(own[i] @ own[i].T - expected, 2) < 1e-10


# Pull-back, push-forward, composition.


maps = st.tuples(st.sampled_from([2, 3, 5, 8, 12]), st.sampled_from([2, 4, 7, 12]), st.sampled_from([2, 3, 6]))


def outcome(build):
    """The structure, or None where its rank is said to be undecidable."""
    try:
        return build()
    except UndecidableRank:
        return None


@FAST
@given(maps, st.booleans(), st.data())
def test_pull_back_and_push_forward_against_null_spaces(shape, near, data):
    n, k, _ = shape
    structure = LinearDirac.from_image(*data.draw(images(st.just(n), near=near)))
    rng = data.draw(generators)
    into = random_map(rng, n, k, data.draw(st.integers(0, min(n, k))))
    onto = random_map(rng, k, n, data.draw(st.integers(0, min(n, k))))
    A, B = np.split(stacked(structure), 2)
    for build, expected in (
        (lambda: structure.pull_back(into), pulled_back(A, B, into)),
        (lambda: structure.push_forward(onto), pushed_forward(A, B, onto)),
    ):
        result = outcome(build)
        assert near or result is not None
        if result is not None:
            assert result.is_dirac(1e-12)
            if near and span(expected)[1] != result.n:
                continue  # a singular value at its fixed tolerance: what the null spaces span is no Dirac structure
            assert gap(result, expected) < (1e-5 if near else 1e-10)


@FAST
@given(maps, st.data())
@pytest.mark.soak
def test_pull_back_and_push_forward_are_functorial(shape, data):
    n, k, l = shape
    rng = data.draw(generators)
    form, bivector = random_skew(rng, n), random_skew(rng, n)
    outer = random_map(rng, n, k, data.draw(st.integers(0, min(n, k))))
    inner = random_map(rng, k, l, data.draw(st.integers(0, min(k, l))))
    F = random_map(rng, n, n, data.draw(st.integers(0, n)))
    for structure in (
        LinearDirac.from_two_form(form),
        LinearDirac.from_bivector(bivector),
        LinearDirac.from_subspace(null_space(F)),
    ):
        assert structure.pull_back(outer).pull_back(inner).equals(structure.pull_back(outer @ inner), 1e-10)
        steps = structure.push_forward(outer.T).push_forward(inner.T)
        assert steps.equals(structure.push_forward(inner.T @ outer.T), 1e-10)
        assert structure.pull_back(np.eye(n)).equals(structure, 1e-12)
        assert structure.push_forward(np.eye(n)).equals(structure, 1e-12)
    assert LinearDirac.from_two_form(form).pull_back(outer).equals(LinearDirac.from_two_form(outer.T @ form @ outer))
    pushed = LinearDirac.from_bivector(bivector).push_forward(outer.T)
    assert pushed.equals(LinearDirac.from_bivector(outer.T @ bivector @ outer))


joints = st.sampled_from([(2, 3, 1), (4, 4, 2), (6, 5, 3), (5, 9, 4), (12, 7, 5), (3, 3, 3)])


@FAST
@given(joints, st.booleans(), st.data())
@pytest.mark.soak
def test_composition_is_dirac_and_symmetric(shape, near, data):
    n, m, c = shape
    first = LinearDirac.from_image(*data.draw(images(st.just(n), near=near)))
    second = LinearDirac.from_image(*data.draw(images(st.just(m), near=near)))
    rng = data.draw(generators)
    ports, other_ports = rng.permutation(n)[:c].tolist(), rng.permutation(m)[:c].tolist()
    joined = outcome(lambda: first.compose(second, ports, other_ports))
    assert near or joined is not None
    if joined is None or joined.n == 0:
        return
    tolerance = 1e-5 if near else 1e-10
    assert joined.n == n + m - 2 * c
    assert joined.is_dirac(1e-12)
    expected = composed(*np.split(stacked(first), 2), *np.split(stacked(second), 2), ports, other_ports)
    assert gap(joined, expected) < tolerance
    swapped = second.compose(first, other_ports, ports)
    order = np.concatenate([np.arange(m - c, joined.n), np.arange(m - c)])
    assert np.linalg.norm(swapped.scattering[np.ix_(order, order)] - joined.scattering, 2) < tolerance
    # Opposite vectors and common covectors change places under v ↔ α, which maps O to −O.
    dual = LinearDirac(-first.scattering).compose(LinearDirac(-second.scattering), ports, other_ports, common="vectors")
    assert np.linalg.norm(dual.scattering + joined.scattering, 2) < tolerance


@FAST
@given(images(st.just(4), near=False), images(st.just(5), near=False), images(st.just(3), near=False))
@pytest.mark.soak
def test_composition_is_associative(first, second, third):
    D1, D2, D3 = (LinearDirac.from_image(*image) for image in (first, second, third))
    left = D1.compose(D2, [2, 3], [0, 1]).compose(D3, [4], [0])
    right = D1.compose(D2.compose(D3, [4], [0]), [2, 3], [0, 1])
    assert left.n == 6
    assert left.equals(right, 1e-10)


@pytest.mark.parametrize("epsilon", [0.0, 1e-4, 1e-3, 0.5])
def test_composition_next_to_a_degenerate_one(epsilon):
    """Two planes of R² joined in both coordinates of a three-dimensional structure, at an angle ε from not transversal."""
    tilted = np.array([[1.0, 0.0], [0.0, 1.0], [0.0, epsilon]])  # (x, y, ε y): the port z follows y with ratio ε
    first, second = LinearDirac.from_subspace(tilted), LinearDirac.from_subspace(np.zeros((1, 0)))
    joined = first.compose(second, [2], [0])  # z = 0, which is y = 0 if ε ≠ 0, and says nothing if ε = 0
    expected = np.eye(2)[:, :1] if epsilon else np.eye(2)
    assert joined.equals(LinearDirac.from_subspace(expected), 1e-15 / (epsilon**2 or 1.0))


def test_composition_says_so_where_it_hangs_on_roundoff():
    """The singular value is ε²/2 here: a perturbation of the structure by δ changes the result by δ/ε²."""
    tilted = LinearDirac.from_subspace([[1.0, 0.0], [0.0, 1.0], [0.0, 1e-6]])
    point = LinearDirac.from_subspace(np.zeros((1, 0)))
    with pytest.raises(UndecidableRank, match="composition"):
        tilted.compose(point, [2], [0])
    with pytest.raises(UndecidableRank, match=r"composition.*angle"):
        LinearDirac.from_subspace([[1.0, 0.0], [0.0, 1.0], [0.0, 1e-8]]).compose(point, [2], [0])
    tilted = LinearDirac.from_subspace([[1.0, 0.0], [0.0, 1.0], [0.0, 1e-5]])
    assert tilted.compose(point, [2], [0], tolerance=1e-14).equals(LinearDirac.from_subspace([[1.0], [0.0]]), 1e-5)
    with pytest.raises(UndecidableRank, match="pull-back"):
        LinearDirac.from_subspace(np.zeros((1, 0))).pull_back([[1e-6]])


def test_direct_sum():
    first, second = LinearDirac.from_two_form([[0.0, 2.0], [-2.0, 0.0]]), LinearDirac.from_subspace([[1.0], [1.0]])
    both = first.direct_sum(second)
    assert both.contains([1.0, 1.0, 3.0, 3.0], [-2.0, 2.0, 5.0, -5.0])
    assert not both.contains([1.0, 1.0, 3.0, 2.0], [-2.0, 2.0, 5.0, -5.0])
    assert both.is_dirac()


# Subspaces that are not Dirac.


def test_port_hamiltonian_sets_of_blm_22_and_23():
    """The open set is coisotropic; its orthogonal is the graph of J restricted to Bᵀα = 0. The closed one is Dirac."""
    rng = np.random.default_rng(0)
    n, m = 5, 2
    J, inputs = random_skew(rng, n), rng.normal(size=(n, m))
    open_set = PontryaginSubspace.from_image(
        np.concatenate([J, inputs], axis=1), np.concatenate([np.eye(n), np.zeros((n, m))], axis=1)
    )
    assert open_set.dimension == n + m
    assert open_set.is_coisotropic() and not open_set.is_isotropic() and not open_set.is_dirac()
    allowed = null_space(inputs.T)
    below = open_set.orthogonal()
    assert below.dimension == n - m and below.is_isotropic() and not below.is_coisotropic()
    assert np.all(below.contains((J @ allowed).T[:, None], allowed.T[:, None]))
    assert not below.contains(J @ inputs[:, 0], inputs[:, 0])
    closed = PontryaginSubspace.from_image(
        np.concatenate([J @ allowed, inputs], axis=1), np.concatenate([allowed, np.zeros((n, m))], axis=1)
    )
    assert closed.is_dirac()
    assert LinearDirac.from_codistribution_and_bivector(allowed, J).equals(LinearDirac.from_image(*closed.image()))


def test_subspace_drops_dependent_columns_and_sees_undecidable_ones():
    A, B = np.eye(3)[:, [0, 0, 1]], np.zeros((3, 3))
    assert PontryaginSubspace.from_image(A, B).dimension == 2
    with pytest.raises(UndecidableRank):
        PontryaginSubspace.from_image(A + 1e-10 * np.eye(3)[:, [0, 2, 0]], B)


# Errors name the defect.


@pytest.mark.parametrize(
    ("build", "words"),
    [
        (lambda: LinearDirac.from_two_form([[0.0, 1.0], [1.0, 0.0]]), r"two_form is not skew.*2\.000e\+00"),
        (lambda: LinearDirac.from_bivector(1e-3 * np.eye(2)), r"bivector is not skew.*2\.000e-03"),
        (lambda: LinearDirac.from_two_form(np.zeros((2, 3))), r"two_form has shape \(2, 3\); a square"),
        (lambda: LinearDirac.from_two_form(np.zeros(3)), r"two_form has shape \(3,\)"),
        (lambda: LinearDirac.from_two_form([[0.0, np.nan], [np.nan, 0.0]]), "not finite"),
        (lambda: LinearDirac.from_subspace([[1.0, 2.0], [2.0, 4.0], [0.0, 0.0]]), "basis has rank 1, not 2.*singular"),
        (lambda: LinearDirac.from_subspace(np.ones((2, 3))), "transposed"),
        (lambda: LinearDirac.from_subspace_and_form(np.eye(3)[:, :1], np.zeros((2, 2))), "dimension 3 but two_form"),
        (lambda: LinearDirac.from_annihilator([[1.0, 0.0], [1.0, 0.0]]), "one_forms has rank 1, not 2"),
        (lambda: LinearDirac.from_kernel(np.eye(2), 0.5 * np.eye(2)), r"not isotropic: E Fᵀ \+ F Eᵀ.*8\.000e-01"),
        (lambda: LinearDirac.from_image(np.eye(2), np.eye(2)), r"not isotropic: AᵀB \+ BᵀA.*1\.000e\+00"),
        (lambda: LinearDirac.from_kernel(np.diag([1.0, 0.0]), np.zeros((2, 2))), "has rank 1, not n = 2"),
        (lambda: LinearDirac.from_kernel(np.eye(2), np.eye(3)), "both must be"),
        (lambda: LinearDirac.from_subspace(np.eye(2)).pull_back(np.ones((3, 1))), r"\(\.\.\., 2, dim W\)"),
        (lambda: LinearDirac.from_subspace(np.eye(2)).push_forward(np.ones((1, 3))), r"\(\.\.\., dim W, 2\)"),
        (lambda: LinearDirac.from_subspace(np.eye(2)).compose(LinearDirac.from_subspace(np.eye(2)), [2]), "ports is"),
        (lambda: LinearDirac.from_subspace(np.eye(2)).contains([1.0], [1.0]), r"both must be \(\.\.\., 2\)"),
    ],
)
def test_bad_input_is_named_with_its_defect(build, words):
    with pytest.raises(ValueError, match=words):
        build()


def test_complex_input_is_refused():
    with pytest.raises(TypeError, match="complex"):
        LinearDirac.from_two_form([[0.0, 1j], [-1j, 0.0]])


@pytest.mark.parametrize("size", [1e-9, 1e-10, 1e-11])
def test_undecidable_rank_names_the_singular_values_and_accepts_a_tolerance(size):
    structure = LinearDirac.from_bivector(size * np.array([[0.0, 1.0], [-1.0, 0.0]]))
    with pytest.raises(UndecidableRank, match=r"projection of D on V.*singular values"):
        structure.distribution()
    with pytest.raises(UndecidableRank):
        structure.two_form()
    assert structure.distribution(tolerance=1e-6).shape == (2, 0)
    assert structure.distribution(tolerance=1e-14).shape == (2, 2)
    assert structure.distribution(rank=2).shape == (2, 2)
    assert np.allclose(structure.two_form(tolerance=1e-14)[0, 1], 1 / size, rtol=1e-4)
    with pytest.raises(UndecidableRank):
        LinearDirac.from_subspace([[1.0, 1.0], [0.0, size]])


def test_rank_that_varies_over_a_batch():
    batch = LinearDirac.from_bivector([[[0.0, 1.0], [-1.0, 0.0]], [[0.0, 0.0], [0.0, 0.0]]])
    with pytest.raises(ValueError, match="varies over the batch"):
        batch.distribution()
    assert np.allclose(batch.two_form(), [[[0.0, 1.0], [-1.0, 0.0]], [[0.0, 0.0], [0.0, 0.0]]])


# Traced use.


def test_under_jit_and_vmap_as_in_eager_mode():
    rng = np.random.default_rng(3)
    forms = np.stack([random_skew(rng, 4) for _ in range(5)])
    basis, phi = random_map(rng, 4, 2, 2), random_map(rng, 4, 3, 2)

    @jax.jit
    @jax.vmap
    def combine(form):
        structure = LinearDirac.from_subspace_and_form(basis, form)
        joined = structure.compose(LinearDirac.from_two_form(form), [0], [1])
        return structure, structure.pull_back(phi), structure.push_forward(phi.T), joined, structure.distribution(rank=2)

    structure, pulled, pushed, joined, distribution = combine(forms)
    assert structure.scattering.shape == (5, 4, 4) and np.all(structure.is_dirac()) and np.all(joined.is_dirac())
    eager = LinearDirac.from_subspace_and_form(basis, forms)
    assert np.all(structure.equals(eager, 1e-13))
    assert np.all(pulled.equals(eager.pull_back(phi), 1e-12))
    assert np.all(pushed.equals(eager.push_forward(phi.T), 1e-12))
    assert np.all(joined.equals(eager.compose(LinearDirac.from_two_form(forms), [0], [1]), 1e-12))
    assert np.allclose(distribution @ np.swapaxes(distribution, -1, -2), span(basis)[0])
    with pytest.raises(ValueError, match="rank"):
        jax.jit(lambda form: LinearDirac.from_two_form(form).distribution())(forms[0])


def test_unchecked_input_under_tracing_is_told_by_is_dirac():
    build = jax.jit(lambda matrix: LinearDirac.from_two_form(matrix))
    assert build(np.array([[0.0, 1.0], [-1.0, 0.0]])).is_dirac()
    broken = build(np.array([[0.0, 1.0], [-0.5, 0.0]]))
    assert not broken.is_dirac() and not broken.is_isotropic() and not broken.is_coisotropic()


@pytest.mark.soak
def test_derivatives():
    rng = np.random.default_rng(8)
    factors = random_map(rng, 4, 2, 2), random_map(rng, 2, 3, 2)
    tangents = rng.normal(size=(4, 2)), rng.normal(size=(2, 3))

    def along(s):  # rank two throughout
        return (factors[0] + s * tangents[0]) @ (factors[1] + s * tangents[1])

    step = 1e-5
    inverse, derivative = jax.jit(lambda s: jax.jvp(lambda s: pseudo_inverse(along(s)), (s,), (1.0,)))(0.0)
    assert np.allclose(inverse, np.linalg.pinv(along(0.0)), atol=1e-13)
    # numpy's own pinv, with the third singular value, which is roundoff, cut off
    difference = (np.linalg.pinv(along(step), rcond=1e-10) - np.linalg.pinv(along(-step), rcond=1e-10)) / (2 * step)
    assert np.allclose(derivative, difference, atol=1e-8)
    form, phi, tangent = random_skew(rng, 4), random_map(rng, 4, 3, 3), rng.normal(size=(4, 3))

    def pulled(phi):
        return LinearDirac.from_two_form(form).pull_back(phi).two_form()

    derivative = jax.jit(lambda phi: jax.jvp(pulled, (phi,), (tangent,))[1])(phi)
    assert np.allclose(derivative, tangent.T @ form @ phi + phi.T @ form @ tangent, atol=1e-11)
