"""The public objects of [RL] §3 beside their printed formulas, and by hand for a connection that is not linear."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dirax as dx

RNG = np.random.default_rng(3)
A = RNG.normal(size=(2, 2))
LINEAR = dx.LinearConnection([1, 2], A)  # q = (x0, g0, g1, x1)
X, G = np.array([0, 3]), np.array([1, 2])
Q0, Q1, P0, P1 = RNG.normal(size=(4, 4))
W, XI = RNG.normal(size=(2, 2))
SIGNS = ("+", "-")


def close(left, right, tolerance=1e-13):
    assert len(left) == len(right)
    for a, b in zip(left, right, strict=True):
        np.testing.assert_allclose(a, b, atol=tolerance)


def joined(x, g):
    q = np.zeros(4)
    q[X], q[G] = x, g
    return q


def test_adjoints_of_the_linear_trivializations_are_those_printed():
    """(3.4), (3.5), (3.8), (3.9) with h_d(q0, x1) = g0 + A(x1 − x0), written out; their mirror images; and by pairing."""
    plus, minus = (dx.PairTrivialization(LINEAR, sign) for sign in SIGNS)
    r = P1[G]
    close(plus.adjoint(P0, W, r), (P0 - joined(-A.T @ r, r), joined(W - A.T @ r, r)))
    close(plus.adjoint_inverse(P0, P1), (P0 + joined(-A.T @ r, r), P1[X] + A.T @ r, r))
    close(minus.adjoint(W, r, P0), (joined(W - A.T @ r, r), P0 - joined(-A.T @ r, r)))
    close(minus.adjoint_inverse(P1, P0), (P1[X] + A.T @ r, r, P0 + joined(-A.T @ r, r)))
    hat, check = (dx.CovectorTrivialization(LINEAR, sign) for sign in SIGNS)
    close(hat(Q0, P0), (Q0, P0[X] + A.T @ P0[G], P0[G]))
    close(hat.adjoint(P1, W, XI), (P1, joined(W, A @ W + XI)))
    close(hat.adjoint_inverse(P1, Q1), (P1, Q1[X], Q1[G] - A @ Q1[X]))
    close(check(P0, Q0), (P0[X] + A.T @ P0[G], P0[G], Q0))
    close(check.adjoint(W, XI, P1), (joined(W, A @ W + XI), P1))
    close(check.adjoint_inverse(Q1, P1), (Q1[X], Q1[G] - A @ Q1[X], P1))
    pair = lambda left, right: sum(float(np.dot(a, b)) for a, b in zip(left, right, strict=True))
    assert pair((P0, W, r), plus(Q0, Q1)) == pytest.approx(pair(plus.adjoint(P0, W, r), (Q0, Q1)), abs=1e-13)
    assert pair((P1, W, XI), hat(Q0, P0)) == pytest.approx(pair(hat.adjoint(P1, W, XI), (Q0, P0)), abs=1e-13)


@pytest.mark.parametrize("sign", SIGNS)
def test_pontryagin_trivialization(sign):
    """(5.2) and (5.4), and back."""
    given = (Q0, Q1, P0, P1) if sign == "-" else (Q0, Q1, P1, P0)
    six = dx.PontryaginTrivialization(LINEAR, sign)(*given)
    if sign == "+":
        q, p = given[2], given[3]
        expected = (Q0, Q1[X], Q1[G] - Q0[G] - A @ (Q1[X] - Q0[X]), q, p[X] + A.T @ p[G], p[G])
    else:
        p, q = given[2], given[3]
        expected = (Q0[X], Q0[G] - Q1[G] - A @ (Q0[X] - Q1[X]), Q1, p[X] + A.T @ p[G], p[G], q)
    close(six, expected)
    close(dx.PontryaginTrivialization(LINEAR, sign).inverse(*six), given)


# ------------------------------------------------------------- h⁰_d(x0, x1) = sin(a)(b' − b) + …, a connection that is not linear


def lift(x0, x1):
    a, b = x0
    c, d = x1
    return jnp.stack([(jnp.sin(a) + jnp.sin(c)) / 2 * (d - b), (c - a) * (1 + b * d)])


BENT = dx.DiscreteConnection(lambda q0, q1: q1[G] - q0[G] - lift(q0[X], q1[X]), fibre=[1, 2])


def matrix(x):
    """A(x) = D2 h⁰_d(x, x), by hand."""
    a, b = x
    return np.array([[0.0, np.sin(a)], [1 + b * b, 0.0]])


def slope(x, mu, y):
    """∂⟨μ, A(x) y⟩/∂x, by hand."""
    a, b = x
    return np.array([mu[0] * np.cos(a) * y[1], 2 * b * mu[1] * y[0]])


def test_structures_of_a_connection_that_is_not_linear():
    """The images of (q0, p1; p0, q1) and (p0, q1; −q0, −p1) by λ̂_d and the transpose of its inverse derivative, by hand."""
    x0, g0, x1, g1 = Q0[X], Q0[G], Q1[X], Q1[G]
    w0, w1 = P0[X] + matrix(x0).T @ P0[G], P1[X] + matrix(x1).T @ P1[G]
    points = (Q0, w0, P0[G]), (Q1, w1, P1[G])
    plus, minus = (dx.ReducedGeneratingFunctionDirac(BENT, sign) for sign in SIGNS)
    at = P1[X] + matrix(x0).T @ P1[G]  # p1 in the trivialization at q0
    expected = (x0, at, P1[G], P0 - joined(slope(x0, P1[G], x1), 0.0), x1, g1 - matrix(x0) @ x1 - g0)
    close(plus.flat(plus.tangent_quotient(*points)), expected)
    at = P0[X] + matrix(x1).T @ P0[G]
    expected = (at, P0[G], x1, -x0, -(g0 - matrix(x1) @ x0) + g1, -P1 + joined(slope(x1, P0[G], x0), 0.0))
    close(minus.flat(minus.tangent_quotient(*points)), expected)


H = 0.1


def lagrangian(q, v):
    """Free of q[1] and q[2]."""
    return v @ v / 2 + (v[1] + q[0] * v[3]) ** 2 / 2 + v[2] * v[0] * jnp.sin(q[3]) / 3 - jnp.cos(q[0] - q[3])


def ld(q0, q1):
    return H * lagrangian((q0 + q1) / 2, (q1 - q0) / H)


@pytest.mark.parametrize("connection", [LINEAR, BENT])
@pytest.mark.parametrize("sign", SIGNS)
@pytest.mark.soak_of(but=["+-connection0"])
def test_trajectories_lie_in_the_reduced_structure(connection, sign):
    scheme = (dx.PlusLagrangeDirac if sign == "+" else dx.MinusLagrangeDirac)("midpoint")
    system = dx.reduce(dx.LagrangeDirac(lagrangian), connection)
    sol = dx.simulate(system, scheme, q=0.3 * Q0, v=0.5 * Q1, step=H, steps=3)
    D = dx.ReducedGeneratingFunctionDirac(connection, sign)
    q = dx.reconstruct(sol).q
    trivialize = dx.PairTrivialization(connection, sign)
    for k in (0, 2):
        points = [(q[i], sol.w[i], sol.mu[i]) for i in (k, k + 1)]
        pair, of_pair = D.tangent_quotient(*points), trivialize(q[k], q[k + 1])
        parts = (of_pair[0][X], *of_pair[1:]) if sign == "+" else (*of_pair[:2], of_pair[2][X])
        assert float(D.lagrangian(ld, *parts)) == pytest.approx(float(ld(q[k], q[k + 1])), abs=1e-13)
        covector = D.dirac_differential(ld, *parts)
        assert bool(D.contains(pair, covector))
        assert not bool(D.contains((*pair[:4], pair[4] + 1e-6, pair[5]), covector))


@pytest.mark.parametrize("connection", [LINEAR, BENT])
def test_reduced_energies_are_the_energies(connection):
    """e_{d±} ∘ Λ_{d±} = E_{d±}, seen from group coordinate 0."""
    moved = lambda q, g: q + joined(0.0, g)
    plus, minus = (dx.ReducedGeneratingFunctionDirac(connection, sign) for sign in SIGNS)
    parts = dx.PontryaginTrivialization(connection)(moved(Q0, -Q0[G]), moved(Q1, -Q0[G]), moved(P0, -Q0[G]), P1)
    energy = ld(Q0, Q1) + P1 @ (P0 - Q1)
    assert float(plus.energy(ld, parts[0][X], *parts[1:])) == pytest.approx(float(energy), abs=1e-12)
    parts = dx.PontryaginTrivialization(connection, "-")(moved(Q0, -Q1[G]), moved(Q1, -Q1[G]), P0, moved(P1, -Q1[G]))
    energy = ld(Q0, Q1) + P0 @ (P1 - Q0)
    assert float(minus.energy(ld, *parts[:2], parts[2][X], *parts[3:])) == pytest.approx(float(energy), abs=1e-12)


def test_adjoints_of_a_connection_that_is_not_linear():
    at = dx.CovectorTrivialization(BENT)(Q0, P0)
    p, x, xi = dx.CovectorTrivialization(BENT).adjoint_inverse(P1, Q1, at=at)
    close((p, x, xi), (P1 - joined(slope(Q0[X], P0[G], Q1[X]), 0.0), Q1[X], Q1[G] - matrix(Q0[X]) @ Q1[X]))
    close(dx.CovectorTrivialization(BENT).adjoint(p, x, xi, at=at), (P1, Q1))
    by_x0, by_x1 = jax.jacfwd(lift, argnums=(0, 1))(jnp.asarray(Q0[X]), jnp.asarray(Q1[X]))
    found = dx.PairTrivialization(BENT).adjoint(P0, W, XI, at=(Q0, Q1))
    close(found, (P0 - joined(by_x0.T @ XI, XI), joined(W - by_x1.T @ XI, XI)))
    close(dx.PairTrivialization(BENT).adjoint_inverse(*found, at=(Q0, Q1)), (P0, W, XI))


def test_mistakes():
    for kind in (
        dx.PairTrivialization,
        dx.CovectorTrivialization,
        dx.PontryaginTrivialization,
        dx.ReducedGeneratingFunctionDirac,
    ):
        with pytest.raises(TypeError, match="connection must be one such as"):
            kind([0])
        with pytest.raises(ValueError, match='sign must be "\\+" or "-"'):
            kind(LINEAR, "plus")
    with pytest.raises(ValueError, match="must be vectors of one length n"):
        dx.PairTrivialization(LINEAR)(Q0, Q1[:3])
    with pytest.raises(ValueError, match="horizontal must have shape"):
        dx.PairTrivialization(LINEAR)(Q0[:3], Q1[:3])
    with pytest.raises(ValueError, match=r"w must have shape \(2,\) beside q of shape \(4,\)"):
        dx.CovectorTrivialization(LINEAR).inverse(Q0, W[:1], XI)
    with pytest.raises(ValueError, match="depends on the point"):
        dx.PairTrivialization(BENT).adjoint(P0, W, XI)
    D = dx.ReducedGeneratingFunctionDirac(LINEAR)
    with pytest.raises(ValueError, match="a pair is a tuple of six arrays, but 2"):
        D.flat((W, XI))
    with pytest.raises(ValueError, match="taken at three arrays, but 2"):
        D.dirac_differential(ld, W, XI)
    with pytest.raises(ValueError, match="six arrays after the discrete Lagrangian"):
        D.energy(ld, W, W, XI)
