"""The linear theory of [RL] §§2–5 from its definitions: lifts, adjoints, trivializations, the images of D^{d±} and D^±L_d."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dirax as dx

S, K = 3, 2
CONNECTION = dx.LinearConnection([1, 3], np.random.default_rng(5).normal(size=(K, S)))
PLUS, MINUS = (dx.ReducedGeneratingFunctionDirac(CONNECTION, sign) for sign in "+-")
RNG = np.random.default_rng(7)
Q0, Q1, P0, P1 = RNG.normal(size=(4, S + K))
X0, X1 = RNG.normal(size=(2, S))
G0, G1, MU = RNG.normal(size=(3, K))
H = 0.2


def lagrangian(q, v):
    """Free of q[1] and q[3], coupled in everything else."""
    mass = 1 + jnp.cos(q[0]) ** 2
    return mass * (v[1] + q[2] * v[0]) ** 2 / 2 + (v[3] - v[1] * jnp.sin(q[4])) ** 2 / 2 + v @ v / 2 - jnp.cos(q[0] - q[2]) * q[4]


def ld(q0, q1):
    return H * lagrangian((2 * q0 + q1) / 3, (q1 - q0) / H)


def close(left, right, tolerance=1e-13):
    return all(np.abs(np.asarray(a) - np.asarray(b)).max() < tolerance for a, b in zip(left, right, strict=True))


def moved(q, g):
    return CONNECTION.join(CONNECTION.split(q)[0], CONNECTION.split(q)[1] + g)


def test_horizontal_lift_its_parts_and_their_adjoints():
    """§2.2.1: h_d(q0, x0) = g0, h_d(g + q0, x1) = g + h_d(q0, x1), (2.5), and (2.4) by pairing."""
    x0, g0 = CONNECTION.split(Q0)
    lift = CONNECTION.horizontal_lift
    assert close([lift(Q0, x0), lift(moved(Q0, G1), X1)], [g0, G1 + lift(Q0, X1)])
    assert close([CONNECTION.lift_of_point(Q0) + CONNECTION.lift_of_shape(X1)], [lift(Q0, X1)])
    zero = CONNECTION.join(jnp.zeros(S), jnp.zeros(K))
    assert close([CONNECTION.lift_of_point(Q0), CONNECTION.lift_of_shape(X1)], [lift(Q0, jnp.zeros(S)), lift(zero, X1)])
    assert close([CONNECTION.lift_of_shapes(X0, X1)], [lift(CONNECTION.join(X0, jnp.zeros(K)), X1)])
    pairings = [CONNECTION.adjoint_of_point(X0, MU) @ Q0, CONNECTION.momentum_shift(X0, MU) @ X1]
    assert close(pairings, [MU @ CONNECTION.lift_of_point(Q0), MU @ CONNECTION.lift_of_shape(X1)])


def test_trivializations_have_inverses_are_equivariant_and_give_the_connection():
    """(3.2), (3.3), (3.6), (3.7), Remarks 3.1 and 3.3, and the actions that they induce."""
    forward, backward = CONNECTION.trivialize_pair(Q0, Q1), CONNECTION.trivialize_pair_backward(Q0, Q1)
    assert close([CONNECTION.untrivialize_pair(*forward), CONNECTION.untrivialize_pair_backward(*backward)], [Q1, Q0])
    assert close([forward[2], backward[1]], [CONNECTION.one_form(Q0, Q1), CONNECTION.one_form(Q1, Q0)])
    for trivialize, where in ((CONNECTION.trivialize_pair, 0), (CONNECTION.trivialize_pair_backward, 2)):
        here, there = list(trivialize(Q0, Q1)), trivialize(moved(Q0, G0), moved(Q1, G0))
        here[where] = moved(here[where], G0)
        assert close(here, there)
    q, w, mu = CONNECTION.trivialize_covector(Q0, P0)
    assert close([CONNECTION.untrivialize_covector(CONNECTION.split(q)[0], w, mu)], [P0])
    assert close(CONNECTION.trivialize_covector(moved(Q0, G0), P0), (moved(Q0, G0), w, mu))
    assert close([mu], [dx.Translations([1, 3]).momentum_map(Q0, P0)])  # Lemma 2.2


# ----------------------------------------------------------------- D^{d±} and D^±L_d on T*Q, carried over by λ̂_d and λ̌_d


def unpacked(q, w, mu):
    """λ̂_d⁻¹ on (q, w, μ)."""
    return q, CONNECTION.untrivialize_covector(CONNECTION.split(q)[0], w, mu)


def in_trivialization(q, p, covector):
    """A covector (∂/∂q, ∂/∂p) at (q, p) as one (∂/∂q, ∂/∂w, ∂/∂μ) at λ̂_d(q, p): (λ̂_d⁻¹)*."""
    point = CONNECTION.trivialize_covector(q, p)
    return jax.vjp(unpacked, *point)[1](covector)


def plus_covector(q0, p1, on_q, on_p):
    """[(q0, w1, μ1), (p, x, ξ)] of a covector (on_q, on_p) at z+ = (q0, p1), in the quotient (3.11) by g0."""
    x0, g0 = CONNECTION.split(q0)
    _, w1, mu1 = CONNECTION.trivialize_covector(q0, p1)
    p, x, xi = in_trivialization(q0, p1, (on_q, on_p))
    return x0, w1, mu1, p, x, xi - g0


def minus_covector(p0, q1, on_p, on_q):
    """[(w0, μ0, q1), (x, ξ, p)] of a covector (on_p, on_q) at z− = (p0, q1), in the quotient of Remark 3.5 by g1."""
    x1, g1 = CONNECTION.split(q1)
    _, w0, mu0 = CONNECTION.trivialize_covector(q1, p0)
    p, x, xi = in_trivialization(q1, p0, (on_q, on_p))
    return w0, mu0, x1, x, xi + g1, p


def test_reduced_structures_are_the_images_of_the_unreduced():
    """Propositions 3.8 and 3.10: α = (q0, p1; p0, q1), and (p0, q1; −q0, −p1), by derivatives of λ̂_d instead of formulas."""
    (_, w0, mu0), (_, w1, mu1) = CONNECTION.trivialize_covector(Q0, P0), CONNECTION.trivialize_covector(Q1, P1)
    (x0, g0), (x1, g1) = CONNECTION.split(Q0), CONNECTION.split(Q1)
    pair = (x0, w0, mu0, moved(Q1, -g0), w1, mu1)
    assert close(PLUS.flat(pair), plus_covector(Q0, P1, P0, Q1))
    pair = (moved(Q0, -g1), w0, mu0, x1, w1, mu1)
    assert close(MINUS.flat(pair), minus_covector(P0, Q1, -Q0, -P1))


def test_reduced_differentials_are_the_images_of_the_unreduced():
    """Propositions 4.3 and 4.4: D⁺L_d = (q0, D2 L_d; −D1 L_d, q1), and D⁻L_d = (−D1 L_d, q1; −q0, −D2 L_d)."""
    d0, d1 = jax.grad(ld, argnums=(0, 1))(Q0, Q1)
    assert close([CONNECTION.split(d0)[1]], [-CONNECTION.split(d1)[1]])  # invariance
    x0, x1, vertical = CONNECTION.split(Q0)[0], CONNECTION.split(Q1)[0], CONNECTION.one_form(Q0, Q1)
    assert close(PLUS.dirac_differential(ld, x0, x1, vertical), plus_covector(Q0, d1, -d0, Q1))
    vertical = CONNECTION.one_form(Q1, Q0)
    assert close(MINUS.dirac_differential(ld, x0, vertical, x1), minus_covector(-d0, Q1, -Q0, -d1))


def test_reduced_lagrangians_and_the_derivatives_of_lemmas_4_5_and_4_7():
    """l_{d±}([q0, q1]) = L_d(q0, q1), and ∂L_d by those of l_{d±} and h_d."""
    d0, d1 = jax.grad(ld, argnums=(0, 1))(Q0, Q1)
    _, x1, g1 = CONNECTION.trivialize_pair(Q0, Q1)
    x0 = CONNECTION.split(Q0)[0]
    plus = lambda x0, x1, g1: PLUS.lagrangian(ld, x0, x1, g1)
    minus = lambda x0, g0, x1: MINUS.lagrangian(ld, x0, g0, x1)
    assert float(plus(x0, x1, g1)) == pytest.approx(float(ld(Q0, Q1)), abs=1e-13)
    g0 = CONNECTION.one_form(Q1, Q0)
    assert float(minus(x0, g0, x1)) == pytest.approx(float(ld(Q0, Q1)), abs=1e-13)
    a, b, mu = jax.grad(plus, argnums=(0, 1, 2))(x0, x1, g1)
    from_plus = (a - lift_first(mu), -mu), (b - lift_second(mu), mu)
    b, mu, a = jax.grad(minus, argnums=(0, 1, 2))(x0, g0, x1)
    from_minus = (b - lift_second(mu), mu), (a - lift_first(mu), -mu)
    for left, right in (from_plus, from_minus):
        assert close(left, CONNECTION.split(d0), 1e-12) and close(right, CONNECTION.split(d1), 1e-12)


def lift_first(mu):
    """⟨μ, h⁰_d(·, 0)⟩."""
    return jax.grad(lambda x: mu @ CONNECTION.lift_of_shapes(x, jnp.zeros(S)))(jnp.zeros(S))


def lift_second(mu):
    """⟨μ, h⁰_d(0, ·)⟩."""
    return jax.grad(lambda x: mu @ CONNECTION.lift_of_shapes(jnp.zeros(S), x))(jnp.zeros(S))


def by_point(mu):
    """⟨μ, h_d((0, ·), 0)⟩."""
    zero = jnp.zeros(S)
    return jax.grad(lambda g: mu @ CONNECTION.horizontal_lift(CONNECTION.join(zero, g), zero))(jnp.zeros(K))


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.soak_of("1")
def test_printed_lagrange_poincare_dirac_equations(sign):
    """(4.6) and (4.8), line by line, on a trajectory of the scheme; and not next to it.

    (4.8) is the mirror image of (4.6): the near point is q_k, the far one q_{k+1}. It is printed for momenta of the opposite
    sign, ∂l_{d−}/∂g0 = μ_k, where Proposition 4.4 has −∂L_d/∂g0.
    """
    system = dx.reduce(dx.LagrangeDirac(lagrangian), CONNECTION)
    scheme = dx.PlusLagrangeDirac if sign > 0 else dx.MinusLagrangeDirac
    v = np.array([0.3, 0.5, -0.4, 0.2, 0.1])
    sol = dx.simulate(system, scheme(lambda a, b, h: ld(a, b)), q=Q0, v=v, step=H, steps=5, engine="native")

    def reduced(far, near, vertical):
        if sign > 0:
            return PLUS.lagrangian(ld, far, near, vertical)
        return MINUS.lagrangian(ld, near, vertical, far)

    @jax.jit
    def missed(near, far, vertical):
        (x, w, mu, g), (x_far, w_far, mu_far, g_far) = near, far
        of_far, of_near, of_group = jax.grad(reduced, argnums=(0, 1, 2))(x_far, x, vertical)
        lines = [
            of_near - lift_second(of_group) + CONNECTION.momentum_shift(x, of_group) - w,
            of_group - mu,
            -of_far + lift_first(of_group) - w_far + CONNECTION.momentum_shift(x_far, mu_far),
            by_point(of_group) - mu_far,
            vertical + CONNECTION.lift_of_point(CONNECTION.join(x_far, 0 * g)) - (g - g_far) + CONNECTION.lift_of_shape(x),
        ]
        return jnp.max(jnp.abs(jnp.concatenate(lines)))

    def row(k):
        x, w, mu, g = (jnp.asarray(sol.fields[name][k]) for name in ("x", "w", "mu", "g"))
        return [x, sign * w, sign * mu, g]

    for k in range(5):
        near, far = (row(k + 1), row(k)) if sign > 0 else (row(k), row(k + 1))
        vertical = jnp.asarray(sign * sol.vertical[k])  # ω_d(q1, q0) = −ω_d(q0, q1), h_d being linear
        assert float(missed(near, far, vertical)) < 1e-12
        for part in range(4):
            assert float(missed([a + 1e-6 * (i == part) for i, a in enumerate(near)], far, vertical)) > 1e-7
