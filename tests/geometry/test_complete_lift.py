"""d_T ω, and [BLM] Proposition 6.2, (16)–(18), beside the printed sums of derivatives and beside flows."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dirax as dx

ALPHA = lambda q: jnp.stack([jnp.sin(q[1]) * q[2], q[0] ** 2, q[3] * q[0], jnp.cos(q[2]) + q[1]])
LINEAR = lambda q: jnp.array([[0.0, 1.0, 0.3, 0.0], [-1.0, 0.2, 0.0, 0.0], [0.0, 0.0, 0.0, 2.0], [0.5, 0.0, -1.0, 0.0]]) @ q
SYSTEM = lambda alpha: dx.PhaseSpaceLagrangian(alpha, lambda q: q @ q / 2 + q[0] ** 4)
Q, V = jnp.array([0.4, -0.3, 0.7, 0.2]), jnp.array([0.3, 0.5, -0.2, 0.1])


class Bent(dx.AbstractDiscretizationMap):
    """A map that is not a θ map."""

    def manifold(self, ambient_dimension):
        return dx.Euclidean(ambient_dimension)

    def forward(self, x, v):
        return x - v / 2 + 0.1 * jnp.sin(v * v) * x, x + v / 2 + 0.2 * v**2

    def backward(self, x0, x1):
        raise NotImplementedError

    def reach(self, x, v):
        return jnp.zeros(())


@pytest.mark.parametrize("map", [dx.Midpoint(), dx.Theta(0.3), Bent()], ids=["midpoint", "θ", "bent"])
@pytest.mark.parametrize("alpha", [ALPHA, LINEAR], ids=["bent α", "linear α"])
@pytest.mark.soak_of("bent \\u03b1-midpoint", "bent \\u03b1-\\u03b8", "bent \\u03b1-bent")
def test_the_printed_equations(map, alpha):
    """(16)–(18) index by index: ∂α_k/∂q^l at R¹ and R², twice antisymmetrized, since dq^i ∧ dq^j sees no more."""
    missed = dx.symplectic_equations(map, SYSTEM(alpha).two_form, Q, V)
    slope = lambda q: np.asarray(jax.jacfwd(alpha)(q))  # ∂α_k/∂q^l
    ends = map.forward(Q, V)
    by_q, by_v = (jax.jacfwd(map.forward, which)(Q, V) for which in (0, 1))
    products = {}
    for name, (left, right) in {"(16)": (by_q, by_q), "(17)": (by_q, by_v), "(18)": (by_v, by_v)}.items():
        # −dα ∧ at R¹ and +dα at R², dα = −∂α_k/∂q^l dq^k ∧ dq^l
        products[name] = sum(
            sign * np.einsum("kl,ki,lj->ij", slope(end) - slope(end).T, np.asarray(a), np.asarray(b))
            for sign, end, a, b in zip((1, -1), ends, left, right, strict=True)
        )
    second = np.asarray(jax.jvp(lambda q: jax.jacfwd(alpha)(q), (Q,), (V,))[1])
    expected = (
        products["(16)"] - (second.T - second),
        products["(17)"] - (slope(Q).T - slope(Q)),
        products["(18)"],
    )
    for found, known in zip(missed, expected, strict=True):
        np.testing.assert_allclose(found, known, atol=1e-13)


def test_the_midpoint_map_is_symplectic_for_constant_forms_and_no_other_theta():
    """Proposition 6.3 and Remark 6.4."""
    largest = lambda theta, alpha: max(
        float(jnp.abs(a).max()) for a in dx.symplectic_equations(dx.Theta(theta), SYSTEM(alpha).two_form, Q, V)
    )
    assert largest(0.5, LINEAR) < 1e-15
    assert largest(0.5, lambda q: LINEAR(q) + jax.grad(lambda q: jnp.sin(q[0] * q[3]))(q)) < 1e-14  # α + dS
    assert largest(0.3, LINEAR) > 0.1 and largest(0.5, ALPHA) > 0.01


def test_the_complete_lift_is_the_derivative_along_flows():
    """d_T ω(Tu, Tw) at (x, ẋ) is the derivative of ω(u, w) along a curve of tangent vectors with rates (x, ẋ)."""
    form = SYSTEM(ALPHA).two_form
    u, du, w, dw = np.random.default_rng(0).normal(size=(4, 4))
    moving = lambda t: (u + t * du) @ form(Q + t * V) @ (w + t * dw)
    lifted = np.concatenate([u, du]) @ np.asarray(dx.complete_lift(form, Q, V)) @ np.concatenate([w, dw])
    assert lifted == pytest.approx(float(jax.grad(moving)(0.0)), abs=1e-13)


@pytest.mark.soak
def test_verify_says_where_the_two_form_of_the_final_manifold_is_preserved():
    """By Method 2: constant dα, dα that changes, θ ≠ ½."""
    lotka_volterra = dx.PhaseSpaceLagrangian(
        lambda q: jnp.array([jnp.log(q[1]) / q[0], -jnp.log(q[0]) / q[1]]) / 2,
        lambda q: q[0] - jnp.log(q[0]) + q[1] - 2 * jnp.log(q[1]),
    )
    vortex = dx.PhaseSpaceLagrangian(lambda q: jnp.array([-q[1], q[0]]) / 2, lambda q: (q @ q) ** 2 / 4)
    lines = [
        dx.verify(dx.simulate(system, dx.DiscreteDirac(map, constraints="resolve"), q=[1.0, 0.5], step=0.1, steps=30))[
            "symplecticity of one step"
        ]
        for system, map in ((vortex, dx.Midpoint()), (lotka_volterra, dx.Midpoint()), (vortex, dx.Theta(0.3)))
    ]
    assert lines[0].verdict == "ok" and lines[0].value < 1e-14
    assert lines[1].verdict == "not checked" and "Proposition 6.3" in lines[1].explanation and lines[1].value > 1e-5
    assert lines[2].verdict == "not checked" and "Remark 6.4" in lines[2].explanation and lines[2].value > 1e-3


def test_mistakes():
    with pytest.raises(ValueError, match="of one length"):
        dx.complete_lift(SYSTEM(ALPHA).two_form, Q, V[:2])
    with pytest.raises(ValueError, match="two_form"):
        dx.complete_lift(ALPHA, Q, V)
