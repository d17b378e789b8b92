"""(D, 𝓛) with 𝓛 from dH, from dL and from Morse families, beside the systems that they are, SciPy, and equations by hand."""

import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import fsolve

import dirax as dx
from dirax.diagnostics.explicit_solution import explicit_solution

H = 0.05
FORMS = lambda q: jnp.stack([jnp.sin(q[2]), -jnp.cos(q[2]), 0.3 * q[0]])[None]
MASS = lambda q: jnp.array([[2.0 + jnp.cos(q[2]), 0.3, 0.0], [0.3, 1.5, 0.1], [0.0, 0.1, 1.0]])
CANONICAL = dx.induced_dirac(None, 3)
Q, V = np.array([0.1, 0.2, 0.4]), np.array([0.5, -0.3, 0.6])
from_lagrangian = dx.LagrangianSubmanifold.from_lagrangian


def driven(q, v, params):
    return v @ MASS(q) @ v / 2 + v[0] ** 4 / 12 - params * (jnp.sin(q[0]) + q[1] ** 2 * q[2])


def lagrangian(q, v):
    return driven(q, v, 1.0)


def run(system, scheme=None, **start):
    return dx.simulate(system, scheme or dx.DiscreteDirac(), step=H, steps=20, **start)


def test_the_graph_of_dh_is_the_dirac_system():
    spin = dx.DiracStructure.from_bivector(lambda x: jnp.cross(x, jnp.eye(3), axisb=0, axisc=0))
    energy = lambda x, params: x @ (x / jnp.array([1.0, 2.0, 3.0])) / 2 + params * x[0] ** 4
    x = [0.6, -0.3, 0.8]
    ours = run(dx.GeneralizedDiracSystem(spin, dx.LagrangianSubmanifold.from_hamiltonian(energy)), x=x, params=0.2)
    theirs = run(dx.DiracSystem(spin, energy), x=x, params=0.2)
    np.testing.assert_allclose(ours.x, theirs.x, atol=1e-14)
    np.testing.assert_allclose(ours.energy(), theirs.energy(), atol=1e-14)


@pytest.mark.parametrize("map", [dx.Midpoint(), dx.cotangent_lift(dx.Theta(0.25))])
@pytest.mark.soak
def test_dl_is_the_lagrangian_system(map):
    """With a quartic kinetic energy, whose Legendre transform has no formula; p, energy, and s = Δq/h at the base point."""
    system = dx.GeneralizedDiracSystem(CANONICAL, from_lagrangian(driven, 3))
    ours = run(system, dx.DiscreteDirac(map), q=Q, v=V, params=1.3)
    theirs = run(dx.LagrangeDirac(driven), dx.DiscreteDirac(map), q=Q, v=V, params=1.3)
    np.testing.assert_allclose(ours.x, np.concatenate([theirs.q, theirs.p], axis=1), atol=1e-12)
    np.testing.assert_allclose(ours.energy(), theirs.energy(), atol=1e-12)
    np.testing.assert_allclose(ours.multipliers, np.diff(theirs.q, axis=0) / H, atol=1e-11)
    assert dx.verify(ours)["discretization-map Dirac structure"].verdict == "ok"


@pytest.mark.soak
def test_constraints_are_those_of_the_dirac_structure():
    row = np.asarray(FORMS(Q))[0]
    v = V - row * (row @ V) / (row @ row)
    ours = run(dx.GeneralizedDiracSystem(dx.induced_dirac(FORMS, 3), from_lagrangian(lagrangian, 3)), q=Q, v=v)
    theirs = run(dx.LagrangeDirac(lagrangian, FORMS), q=Q, v=v)
    np.testing.assert_allclose(ours.x, np.concatenate([theirs.q, theirs.p], axis=1), atol=1e-12)


@pytest.mark.soak
def test_a_singular_lagrangian():
    """L = ⟨α(q), q̇⟩ − H(q), α not linear: Method 1 of [BLM] §6 from p = α(q), and the chain of (x, s)."""
    alpha = lambda q: jnp.array([-jnp.sin(q[1]), q[0] + q[0] ** 3 / 3])
    energy = lambda q: q @ q / 2 + q[0] ** 4
    system = dx.GeneralizedDiracSystem(dx.induced_dirac(None, 2), from_lagrangian(lambda q, v: alpha(q) @ v - energy(q), 2))
    q = np.array([0.6, 0.2])
    ours = run(system, x=np.concatenate([q, alpha(q)]))
    theirs = run(dx.PhaseSpaceLagrangian(alpha, energy), q=q)
    np.testing.assert_allclose(ours.x, np.concatenate([theirs.q, theirs.p], axis=1), atol=1e-12)
    chain = dx.constraint_algorithm(system, near=np.concatenate([q, alpha(q)]))
    q = jnp.asarray(chain.point[:2])
    rate = np.asarray(jax.jacfwd(alpha)(q))
    expected = np.linalg.solve(rate - rate.T, np.asarray(jax.grad(energy)(q)))  # (∂_jα_i − ∂_iα_j) q̇ʲ = −∂_iH
    np.testing.assert_allclose(np.asarray(chain.field(chain.point))[:2], -expected, atol=1e-12)
    assert (chain.verdict, chain.dimension) == ("determined", 2)


def test_a_morse_family_by_hand():
    """F = H(x) + s g(x) on R³ with the bracket of so(3): ẋ = x × ∂F/∂x, g = 0 at the midpoint, by SciPy."""
    spin = dx.DiracStructure.from_bivector(lambda x: jnp.cross(x, jnp.eye(3), axisb=0, axisc=0))
    inertia = np.array([1.0, 2.0, 3.0])
    family = lambda x, s: x @ (x / inertia) / 2 + s[0] * (x[0] - x[1] * x[2] - 0.2) + s[0] ** 2 / 2
    system = dx.GeneralizedDiracSystem(spin, dx.LagrangianSubmanifold.from_morse_family(family, 1))
    sol = run(system, x=[0.3, 0.5, -0.4])

    def missed(z, x0):
        x1, s = z[:3], z[3]
        x = (x0 + x1) / 2
        covector = x / inertia + s * np.array([1.0, -x[2], -x[1]])
        return np.concatenate([x1 - x0 - H * np.cross(x, covector), [x[0] - x[1] * x[2] - 0.2 + s]])

    x = np.array([0.3, 0.5, -0.4])
    for k in range(20):
        x = fsolve(missed, np.append(x, 0.0), args=(x,), full_output=True, xtol=1e-13)[0][:3]
        np.testing.assert_allclose(sol.x[k + 1], x, atol=1e-12)
    # s² makes F regular in s: H with s = −g put in is the Hamiltonian of the same system
    plain = dx.DiracSystem(spin, lambda x: x @ (x / inertia) / 2 - (x[0] - x[1] * x[2] - 0.2) ** 2 / 2)
    np.testing.assert_allclose(sol.x, run(plain, x=[0.3, 0.5, -0.4]).x, atol=1e-13)


def test_submanifolds_are_lagrangian():
    """Their tangent spaces against finite differences of points, and the canonical form on them."""
    q, v = Q, V
    made = from_lagrangian(lagrangian, 3)
    p = np.asarray(jax.grad(lagrangian, 1)(q, v))
    x = np.concatenate([q, p])
    np.testing.assert_allclose(made.covector(x, v), np.concatenate([-np.asarray(jax.grad(lagrangian)(q, v)), v]), atol=1e-14)
    np.testing.assert_allclose(made.defect(x, v), 0.0, atol=1e-14)
    basis = np.asarray(made.tangent(x, v))
    assert basis.shape == (12, 6) and np.linalg.matrix_rank(basis) == 6 and float(made.lagrangian_defect(x, v)) < 1e-12
    point = jax.jit(lambda q, v: jnp.concatenate([q, jax.grad(lagrangian, 1)(q, v), -jax.grad(lagrangian)(q, v), v]))
    for direction in np.eye(6):
        step = 1e-6 * direction
        moved = (point(q + step[:3], v + step[3:]) - point(q - step[:3], v - step[3:])) / 2e-6
        outside = moved - basis @ np.linalg.lstsq(basis, moved, rcond=None)[0]
        np.testing.assert_allclose(outside, 0.0, atol=1e-8)
    graph = dx.LagrangianSubmanifold.from_hamiltonian(lambda x: jnp.sin(x[0]) * x[1])
    assert float(graph.lagrangian_defect([0.3, 0.7], [])) < 1e-14 and graph.morse_rank([0.3, 0.7], []) == 0


def test_mistakes():
    with pytest.raises(TypeError, match=r"dx\.GeneralizedDiracSystem\(structure, submanifold\)"):
        dx.DiracSystem(CANONICAL, from_lagrangian(lagrangian, 3))
    with pytest.raises(TypeError, match="from_hamiltonian"):
        dx.GeneralizedDiracSystem(CANONICAL, lambda x: x @ x)
    with pytest.raises(TypeError, match=r"must be a dx\.DiracStructure"):
        dx.GeneralizedDiracSystem(np.eye(2), from_lagrangian(lagrangian, 3))
    with pytest.raises(ValueError, match="number k of the entries of s"):
        dx.LagrangianSubmanifold.from_morse_family(lambda x, s: 0.0, -1)
    system = dx.GeneralizedDiracSystem(CANONICAL, from_lagrangian(lagrangian, 3))
    with pytest.raises(ValueError, match=r"must have shape \(3,\), the n of from_lagrangian"):
        run(system, q=Q[:2], v=V[:2])
    with pytest.raises(ValueError, match=r"must have shape \(6,\), 2n of from_lagrangian"):
        run(system, x=Q)
    twice = dx.LagrangianSubmanifold.from_morse_family(lambda x, s: x @ x / 2 + (s[0] + s[1]) * x[0], 2)
    with pytest.raises(ValueError, match=r"no Morse family at the initial point.*rank 1 of 2"):
        run(dx.GeneralizedDiracSystem(dx.induced_dirac(None, 1), twice), x=[0.0, 1.0])
    vector = dx.LagrangianSubmanifold.from_morse_family(lambda x, s: x * s[0], 1)
    with pytest.raises(ValueError, match="must return a scalar"):
        run(dx.GeneralizedDiracSystem(dx.induced_dirac(None, 1), vector), x=[0.0, 1.0])
    with pytest.raises(ValueError, match="structure has dimension 6, but x has 4"):
        run(dx.GeneralizedDiracSystem(CANONICAL, dx.LagrangianSubmanifold.from_hamiltonian(lambda x: x @ x)), x=np.ones(4))


@pytest.mark.soak
def test_matrices_of_no_dirac_structure():
    """They are refused where a run begins, and `verify` finds the place where they cease to be those of one."""
    of_energy = dx.LagrangianSubmanifold.from_hamiltonian(lambda x: x @ x / 2)
    one = lambda x: jnp.eye(2)
    for wrong, words in [
        (dx.DiracStructure.from_bivector(one), "bivector is not skew"),
        (dx.DiracStructure.from_kernel(one, one), "not isotropic"),
    ]:
        with pytest.raises(ValueError, match=words):
            run(dx.GeneralizedDiracSystem(wrong, of_energy), x=[1.0, 0.0])
    skew_above = lambda x: jnp.array([[0.0, 1.0], [-1.0, jnp.minimum(x[0] - 0.9, 0.0)]])
    sol = run(dx.GeneralizedDiracSystem(dx.DiracStructure.from_bivector(skew_above), of_energy), x=[1.0, 0.0])
    assert sol.ok and not dx.verify(sol).ok and "bivector is not skew" in str(dx.verify(sol))


def test_method_1_of_a_constrained_family_warns_that_its_index_is_three():
    """A pendulum by H(x) + s g(x): its momenta did not converge and its multipliers grew like 1/h, without a word. Two
    constraints whose bracket does not vanish are of index 2, and have none."""
    structure = dx.DiracStructure.from_bivector(lambda x: dx.canonical_two_form(2))
    energy = lambda x: x[2:] @ x[2:] / 2 + 9.8 * x[1]
    held = lambda g, count: dx.GeneralizedDiracSystem(
        structure, dx.LagrangianSubmanifold.from_morse_family(lambda x, s: energy(x) + s @ g(x), count)
    )
    pendulum, run = held(lambda x: (x[:2] @ x[:2] - 1)[None], 1), {"step": 0.05, "steps": 20}
    x = np.array([np.sin(1), -np.cos(1), 0.5 * np.cos(1), 0.5 * np.sin(1)])
    with pytest.warns(RuntimeWarning, match="GeneralizedDiracSystem are of index 3 or more: Method 1 does not keep"):
        sol = dx.simulate(pendulum, dx.DiscreteDirac(), x=x, **run)
    of = lambda report: {line.quantity: line.verdict for line in report.lines}
    report = dx.verify(sol)
    assert of(report)["final manifold"] == "VIOLATED" and not report.ok
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        chain = dx.constraint_algorithm(pendulum, near=x)
        sol = dx.simulate(chain.resolved(), dx.DiscreteDirac(), x=chain.point, **run)
        assert np.abs(np.sum(sol.x[:, :2] ** 2, axis=1) - 1.0).max() < 1e-2
        falling = dx.simulate(held(lambda x: x[jnp.array([0, 2])], 2), dx.DiscreteDirac(), x=[0.0, 1.0, 0.0, 0.3], **run)
        np.testing.assert_allclose(falling.x[-1], [0.0, 1.3 - 4.9, 0.0, 0.3 - 9.8], atol=1e-12)
        assert "final manifold" not in of(dx.verify(falling))


@pytest.mark.soak
def test_the_motion_of_constraints_of_any_index_is_a_reference():
    """That of the constraint algorithm: of index 3 Method 1 comes to something else, which its own refinement does not show; of a
    closed port it comes to the motion of the reduced circuit."""
    structure = dx.DiracStructure.from_bivector(lambda x: dx.canonical_two_form(2))
    family = lambda x, s: x[2:] @ x[2:] / 2 + 9.8 * x[1] + s[0] * (x[:2] @ x[:2] - 1)
    pendulum = dx.GeneralizedDiracSystem(structure, dx.LagrangianSubmanifold.from_morse_family(family, 1))
    x, times = np.array([np.sin(1), -np.cos(1), 0.5 * np.cos(1), 0.5 * np.sin(1)]), np.array([0.5, 1.0])
    angle = solve_ivp(lambda t, y: [y[1], -9.8 * np.sin(y[0])], (0, 1), [1, 0.5], rtol=1e-12, atol=1e-13, t_eval=times).y
    expected = np.stack([np.sin(angle[0]), -np.cos(angle[0]), angle[1] * np.cos(angle[0]), angle[1] * np.sin(angle[0])], axis=1)
    np.testing.assert_allclose(explicit_solution(pendulum, {"x": x})(times)["x"], expected, atol=1e-10)
    steps = {"step_sizes": [0.1, 0.05, 0.025], "time": 1.0}
    with pytest.warns(RuntimeWarning, match="index 3"):
        found = dx.convergence(pendulum, dx.DiscreteDirac(), x=x, **steps)
    assert found.agrees is False and "does not come to the explicit equations" in found.notes[0]

    capacitors = lambda x: x[0] ** 2 / 2 + x[0] ** 4 / 8 + x[1] ** 2 / 4 + x[2] ** 2 / 2
    J, B = np.array([[0.0, 0.0, 1.0], [0.0, 0.0, 0.0], [-1.0, 0.0, 0.0]]), np.array([[1.0], [-1.0], [0.0]])
    parallel = dx.PortHamiltonian(capacitors, J, B=B, closed=True)
    found = dx.convergence(parallel, dx.DiscreteDirac(), x=[0.5, 1.125, 0.3], **steps)
    assert found.agrees and "explicit" in found.reference and abs(found.order - 2) < 0.01
