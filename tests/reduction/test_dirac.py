"""Reduced Dirac structures and the reduced variational principle give the equations that the schemes solve ([RL] §§4, 5)."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dirax as dx

H, STEPS = 0.1, 4
CONNECTION = dx.LinearConnection([0, 3], [[0.3, -0.2], [0.1, 0.4]])
PLUS, MINUS = (dx.ReducedGeneratingFunctionDirac(CONNECTION, sign) for sign in "+-")


def lagrangian(q, v):
    """Regular, not a product, and free of q[0] and q[3]."""
    rotor = (v[3] + q[1] * v[2] - 0.3 * v[0]) ** 2 / 2
    return rotor + (1 + q[1] ** 2) * v[0] ** 2 / 2 + v[0] * v[2] * jnp.sin(q[1]) + v[1] ** 2 + v[2] ** 2 - jnp.cos(q[2] - q[1])


def ld(q0, q1):
    return H * lagrangian((q0 + q1) / 2, (q1 - q0) / H)


@pytest.fixture(scope="module", params=[dx.PlusLagrangeDirac, dx.MinusLagrangeDirac])
def rows(request):
    system = dx.reduce(dx.LagrangeDirac(lagrangian), CONNECTION)
    start = {"q": [0.0, 0.4, 1.0, 0.2], "v": [0.5, -0.3, 0.8, 0.6], "step": H, "steps": STEPS}
    sol = dx.simulate(system, request.param("midpoint"), **start)
    return {name: np.asarray(sol.fields[name]) for name in ("x", "w", "mu", "g", "vertical")}


def close(left, right):
    return all(np.abs(np.asarray(a) - np.asarray(b)).max() < 1e-12 for a, b in zip(left, right, strict=True))


@pytest.mark.soak
def test_every_step_lies_in_the_plus_structure(rows):
    for k in range(STEPS):
        x, w, mu, g = (rows[name][k] for name in ("x", "w", "mu", "g"))
        x1, w1, mu1, g1 = (rows[name][k + 1] for name in ("x", "w", "mu", "g"))
        differential = PLUS.dirac_differential(ld, x, x1, rows["vertical"][k])
        pair = (x, w, mu, CONNECTION.join(jnp.asarray(x1), jnp.asarray(g1 - g)), w1, mu1)
        assert close(PLUS.flat(pair), differential)
        assert not close(PLUS.flat((x, w + 1e-6, *pair[2:])), differential)


@pytest.mark.soak_of("MinusLagrangeDirac")
def test_every_step_lies_in_the_minus_structure(rows):
    for k in range(STEPS):
        x, w, mu, g = (rows[name][k] for name in ("x", "w", "mu", "g"))
        x1, w1, mu1, g1 = (rows[name][k + 1] for name in ("x", "w", "mu", "g"))
        differential = MINUS.dirac_differential(ld, x, -rows["vertical"][k], x1)
        pair = (CONNECTION.join(jnp.asarray(x), jnp.asarray(g - g1)), w, mu, x1, w1, mu1)
        assert close(MINUS.flat(pair), differential)
        assert not close(MINUS.flat((*pair[:4], w1, mu1 + 1e-6)), differential)


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.soak
def test_trajectories_make_the_reduced_action_stationary(rows, sign):
    """(5.8) and (5.10): the derivative in all free variables is 0 on a trajectory, and is not next to it."""
    x, w, mu, g, vertical = (jnp.asarray(rows[name]) for name in ("x", "w", "mu", "g", "vertical"))

    def action(inner_x, inner_g, moved_x, moved_g, w, mu):
        nodes = jnp.concatenate([x[:1], inner_x, x[-1:]])
        group = jnp.concatenate([g[:1], inner_g, g[-1:]])
        total = jnp.zeros(())
        for k in range(STEPS):
            if sign > 0:
                point = CONNECTION.join(nodes[k + 1], group[k + 1] - group[k])
                total += PLUS.energy(ld, nodes[k], moved_x[k], moved_g[k], point, w[k + 1], mu[k + 1])
            else:
                point = CONNECTION.join(nodes[k], group[k] - group[k + 1])
                total += MINUS.energy(ld, moved_x[k], moved_g[k], nodes[k + 1], w[k], mu[k], point)
        return total

    moved = (x[1:], vertical) if sign > 0 else (x[:-1], -vertical)
    gradient = jax.jit(jax.grad(action, argnums=range(6)))
    size = lambda slopes: max(float(jnp.max(jnp.abs(s))) for s in slopes)
    # the momentum of (−) enters with the other sign: E_{d−} = L_d + ⟨p0, q0 − q0⁻⟩ has −p for its stationary value
    factor = 1.0 if sign > 0 else -1.0
    on = gradient(x[1:-1], g[1:-1], *moved, factor * w, factor * mu)
    assert size(on) < 1e-12
    assert size(gradient(x[1:-1] + 1e-4, g[1:-1], *moved, factor * w, factor * mu)) > 1e-6
