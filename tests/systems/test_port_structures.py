"""The sets (22), (23) of [BLM] as objects, Proposition 7.1, and §7.2 with a projector of the user's, beside NumPy and SciPy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import null_space
from scipy.optimize import least_squares

import dirax as dx


def J(x):
    """Skew, of rank 4 in R⁵, no Poisson structure."""
    upper = jnp.array([[0, 1, x[2], 0, x[0]], [0, 0, 2, x[1], 0], [0, 0, 0, 1, x[3]], [0, 0, 0, 0, 3.0], [0] * 5])
    return upper - upper.T


def B(x):
    return jnp.array([[1.0, 0.0], [x[0], 1.0], [0.0, 0.0], [x[4], 2.0], [0.0, x[1]]])


X = np.array([0.3, -0.4, 0.8, 0.1, 0.6])
ENERGY = lambda x: x @ x / 2 + jnp.sin(x[0]) * x[1]


def spanned(subspace, A, covectors):
    """Whether two subspaces of V ⊕ V* are the same, by the ranks of their bases side by side."""
    other = np.concatenate([A, covectors])
    own = np.asarray(subspace.basis)
    ranks = [np.linalg.matrix_rank(a, tol=1e-9) for a in (own, other, np.concatenate([own, other], axis=1))]
    return len(set(ranks)) == 1


def test_open_ports_are_coisotropic_with_the_orthogonal_where_the_outputs_vanish():
    """(22) = {(Jα + Bu, α)}; (22)^⊥ = {(Jα, α) : Bᵀα = 0}, of which Proposition 7.1 prints all α."""
    found = dx.PortHamiltonian(ENERGY, J, B).dirac_structure(X)
    j, b, zero = np.asarray(J(X)), np.asarray(B(X)), np.zeros((5, 2))
    assert isinstance(found, dx.PontryaginSubspace) and found.dimension == 7
    assert spanned(found, np.concatenate([j, b], axis=1), np.concatenate([np.eye(5), zero], axis=1))
    assert bool(found.is_coisotropic()) and not bool(found.is_isotropic()) and not bool(found.is_dirac())
    kernel = null_space(b.T)
    assert spanned(found.orthogonal(), j @ kernel, kernel) and found.orthogonal().dimension == 3


def test_closed_ports_are_dirac():
    """(23) at a point and as a structure on M, by its elements; the equations are those of dx.DiracSystem."""
    system = dx.PortHamiltonian(ENERGY, J, B, closed=True)
    found, kernel = system.dirac_structure(X), null_space(np.asarray(B(X)).T)
    assert isinstance(found, dx.LinearDirac) and bool(found.is_dirac())
    for alpha in kernel.T:
        v = np.asarray(J(X)) @ alpha + np.asarray(B(X)) @ [0.3, -1.2]
        assert bool(found.contains(v, alpha)) and not bool(found.contains(v + np.eye(5)[2], alpha))
    assert bool(system.closed_dirac_structure().at(X).equals(found))
    # B need not have independent columns, nor have any
    twice = dx.PortHamiltonian(ENERGY, J, lambda x: jnp.concatenate([B(x), B(x)], axis=1), closed=True).dirac_structure(X)
    assert bool(twice.equals(found))
    assert bool(dx.PortHamiltonian(ENERGY, J).dirac_structure(X).equals(dx.LinearDirac.from_bivector(J(X))))


def test_some_ports_closed():
    found = dx.PortHamiltonian(ENERGY, J, B, closed=[0]).dirac_structure(X)
    kernel = null_space(np.asarray(B(X)).T[:1])
    ports = np.asarray(B(X))
    assert spanned(
        found, np.concatenate([np.asarray(J(X)) @ kernel, ports], axis=1), np.concatenate([kernel, np.zeros((5, 2))], axis=1)
    )
    assert bool(found.is_coisotropic()) and not bool(found.is_dirac()) and found.dimension == 6


# ------------------------------------------------------------------------------------------ §7.2: x = (q, p), μ(q) p = 0

SKATE = lambda q: jnp.array([jnp.sin(q[2]), -jnp.cos(q[2]), 0.2 * q[0]])
ENERGY_2 = lambda x: x[3:] @ x[3:] / 2 + jnp.cos(x[0]) + x[1] ** 2 / 2
PORT = lambda x: jnp.concatenate([jnp.zeros(3), SKATE(x[:3])])[:, None]
CLOSED = dx.PortHamiltonian(ENERGY_2, dx.canonical_two_form(3), PORT, closed=True)
START = np.array([0.1, 0.2, 0.3, 0.0, 0.0, 0.7])
START[3:5] = 0.5 * np.cos(0.3), 0.5 * np.sin(0.3)
START[3:] -= np.asarray(SKATE(START[:3])) * (np.asarray(SKATE(START[:3])) @ START[3:]) / np.sum(np.asarray(SKATE(START[:3])) ** 2)


def onto(x):
    """P(q, p) = (q, p − μᵀ(μμᵀ)⁻¹μp)."""
    mu = SKATE(x[:3])
    return jnp.concatenate([x[:3], x[3:] - mu * (mu @ x[3:]) / (mu @ mu)])


METHOD_2 = dx.DiscreteDirac(dx.ProjectedMap(dx.Midpoint(), onto, 5), constraints="resolve")


@pytest.mark.soak
def test_a_projector_on_the_closed_port():
    """Against R_d^{M0} inverted by SciPy at every step, with ẋ = J dH + Bu at its base point; and Method 2 of [BLM] §8.1."""
    h = 0.05
    sol = dx.simulate(CLOSED, METHOD_2, x=START, step=h, steps=20)
    assert sol.ok and sol.stats["engine"] == "native"
    assert np.abs(jax.vmap(lambda x: PORT(x)[:, 0] @ jax.grad(ENERGY_2)(x))(sol.x)).max() < 1e-14
    output = jax.jit(lambda x: PORT(x)[:, 0] @ x)
    P, slope = jax.jit(onto), jax.jit(jax.grad(output))
    for k in (0, 7, 19):
        x0, x1 = sol.x[k], sol.x[k + 1]
        missed = lambda z, x0=x0, x1=x1: np.concatenate([
            P(z[:6] - h * z[6:] / 2) - x0, P(z[:6] + h * z[6:] / 2) - x1, [output(z[:6]), slope(z[:6]) @ z[6:]]
        ])  # fmt: skip
        z = least_squares(missed, np.concatenate([(x0 + x1) / 2, (x1 - x0) / h]), xtol=1e-15, ftol=1e-15, gtol=1e-15)
        assert z.cost < 1e-26
        x, v = z.x[:6], z.x[6:]
        force = v - np.asarray(dx.canonical_two_form(3)) @ np.asarray(jax.grad(ENERGY_2)(x))
        np.testing.assert_allclose(force, np.asarray(PORT(x))[:, 0] * sol.multipliers[k, 0], atol=1e-11)
    nonholonomic = dx.NonholonomicMechanics(
        lambda q: jnp.eye(3), lambda q: jnp.cos(q[0]) + q[1] ** 2 / 2, lambda q: SKATE(q)[None]
    )
    method_2 = dx.DiscreteDirac(constraints="resolve")
    theirs = dx.simulate(nonholonomic, method_2, q=START[:3], p=START[3:], step=h, steps=20)
    np.testing.assert_allclose(sol.x, np.concatenate([theirs.q, theirs.p], axis=1), atol=1e-13)


def test_its_order():
    def field(t, x):
        q, p = x[:3], x[3:]
        mu, force = np.asarray(SKATE(q)), np.array([np.sin(q[0]), -q[1], 0.0])
        rate = np.array([np.cos(q[2]) * p[2], np.sin(q[2]) * p[2], 0.2 * p[0]])  # of μ along q̇ = p
        return np.concatenate([p, force - mu * (mu @ force + rate @ p) / (mu @ mu)])

    exact = solve_ivp(field, (0, 1), START, method="DOP853", rtol=1e-12, atol=1e-12).y[:, -1]
    errors = [np.abs(dx.simulate(CLOSED, METHOD_2, x=START, step=1 / n, steps=n).x[-1] - exact) for n in (40, 80)]
    for part in (slice(3), slice(3, 6)):
        assert np.log2(errors[0][part].max() / errors[1][part].max()) == pytest.approx(2.0, abs=0.1)


def test_mistakes():
    with pytest.raises(ValueError, match="with dissipation R"):
        dx.PortHamiltonian(ENERGY, J, B, R=np.eye(5)).dirac_structure(X)
    with pytest.raises(ValueError, match="whose ports are all closed"):
        dx.PortHamiltonian(ENERGY, J, B, closed=[0]).closed_dirac_structure()
    with pytest.raises(ValueError, match="J is not skew"):
        dx.PortHamiltonian(ENERGY, np.eye(5), B).dirac_structure(X)
    with pytest.raises(ValueError, match=r"B must have shape \(4, m\)"):
        dx.PortHamiltonian(lambda x: x @ x, np.zeros((4, 4)), np.ones((5, 1))).dirac_structure(X[:4])
    run = {"x": START, "step": 0.1, "steps": 2}
    other = lambda x: jnp.concatenate([x[:3], x[3:5], jnp.zeros(1)])
    with pytest.raises(ValueError, match="off the image of the projector"):
        dx.simulate(CLOSED, dx.DiscreteDirac(dx.ProjectedMap(dx.Midpoint(), other, 5), constraints="resolve"), **run)
    run["x"] = np.asarray(other(START))
    with pytest.raises(ValueError, match=r"is not the constraint manifold|off the constraint"):
        dx.simulate(CLOSED, dx.DiscreteDirac(dx.ProjectedMap(dx.Midpoint(), other, 5), constraints="resolve"), **run)
    smaller = lambda x: jnp.concatenate([x[:3], x[3:4], jnp.zeros(2)])
    with pytest.raises(ValueError, match="of dimension 5 of 6, but its image has dimension 4"):
        dx.simulate(CLOSED, dx.DiscreteDirac(dx.ProjectedMap(dx.Midpoint(), smaller, 4), constraints="resolve"), **run)
