"""Port-Hamiltonian systems: power balance of the midpoint map, inputs, closed ports, interconnection as composition."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import expm
from scipy.sparse import csr_matrix

import dirax as dx

J, B = np.array([[0.0, 1.0], [-1.0, 0.0]]), np.array([[0.0], [1.0]])


def mass(k=1.0, m=1.0, damping=None):
    R = None if damping is None else np.diag([0.0, damping])
    return dx.PortHamiltonian(lambda x: x[1] ** 2 / (2 * m) + k * x[0] ** 2 / 2, J=J, B=B, R=R)


def test_power_balance_of_the_midpoint_map_and_what_it_is_not():
    """h⟨ȳ, ū⟩ = ⟨dH(x̄), Δx⟩ ([BLM] §7.1) at every step; for H = x⁴ it is not the change of H."""
    system = dx.PortHamiltonian(lambda x: x[1] ** 2 / 2 + x[0] ** 4, J=J, B=B, R=np.diag([0.0, 0.1]))
    sol = dx.simulate(system, dx.DiscreteDirac(), x=[1.0, 0.0], step=0.1, steps=50, inputs=lambda t, x: jnp.cos(t)[None])
    stored, supplied, dissipated = sol.power.T
    middle, rate = (sol.x[1:] + sol.x[:-1]) / 2, np.diff(sol.x, axis=0) / 0.1
    assert np.abs(stored - 4 * middle[:, 0] ** 3 * rate[:, 0] - middle[:, 1] * rate[:, 1]).max() < 1e-12
    assert np.abs(supplied - np.cos(sol.t[:-1] + 0.05) * middle[:, 1]).max() < 1e-13
    assert np.abs(stored - supplied + dissipated).max() < 1e-12
    assert np.abs(np.diff(sol.energy()) - 0.1 * stored).max() > 1e-4


def test_a_joint_is_the_composition_of_the_dirac_structures():
    """The structure of the whole, from its own J and by `LinearDirac.compose` of the parts with ports."""

    def open_structure(sign):
        # fibre (x, port): ẋ = J dH ± B e, flow ∓y; composition has equal efforts e and flows that cancel
        return dx.LinearDirac.from_bivector(np.block([[J, sign * B], [-sign * B.T, np.zeros((1, 1))]]))

    whole = dx.interconnect(mass(), mass(), [0], [0], sizes=(2, 2), kind="joint")
    composed = open_structure(1).compose(open_structure(-1), ports=[2], other_ports=[2])
    # joint: ẋ = J dH + (B, −B)λ with (B, −B)ᵀdH = 0 is a Dirac structure on R⁴
    x = jnp.zeros(4)
    column, flow = np.asarray(whole.closed_matrix(x)), np.asarray(whole.J(x, None))
    projector = np.eye(4) - column @ np.linalg.pinv(column)
    F = np.concatenate([projector, np.zeros((1, 4))])
    E = np.concatenate([-projector @ flow, column.T])
    rows = [i for i in range(5) if np.linalg.matrix_rank(np.delete(np.hstack([F, E]), i, 0)) == 4][:1]
    joint = dx.LinearDirac.from_kernel(np.delete(F, rows, 0), np.delete(E, rows, 0))
    assert joint.equals(composed)


def test_feedback_of_two_masses_against_the_matrix_exponential():
    whole = dx.interconnect(mass(k=1.0), mass(k=2.0, m=3.0), [0], [0], sizes=(2, 2))
    matrix = np.array([[0, 1, 0, 0], [-1, 0, 0, -1 / 3], [0, 0, 0, 1 / 3], [0, 1, -2, 0]])  # u = −y_other, u_other = y
    start, errors = np.array([1.0, 0.0, 0.5, 0.2]), []
    exact = expm(matrix * 2.0) @ start
    for steps in (50, 100):
        sol = dx.simulate(whole, dx.DiscreteDirac(), x=start, step=2 / steps, steps=steps)
        errors.append(np.abs(sol.x[-1] - exact).max())
        assert np.ptp(sol.energy()) < 1e-13
    assert np.log2(errors[0] / errors[1]) == pytest.approx(2.0, abs=0.02)


def test_ports_left_over_stay_open_and_losses_add():
    two = dx.PortHamiltonian(lambda x: x @ x / 2, J=J, B=np.array([[0.0, 1.0], [1.0, 0.0]]))
    whole = dx.interconnect(two, mass(damping=0.3), [0], [0], sizes=(2, 2))
    x = jnp.array([0.1, 0.2, 0.3, 0.4])
    assert whole.open_matrix(x) == pytest.approx(np.array([[1.0], [0.0], [0.0], [0.0]]))
    assert np.asarray(whole.R(x, None)) == pytest.approx(np.diag([0.0, 0.0, 0.0, 0.3]))
    assert whole.sizes({"x": x}, None) == (4, 0)


@pytest.mark.parametrize(
    "change, message",
    [
        ({"ports": [1]}, "do not all exist"),
        ({"ports": [0, 0], "other_ports": [0, 0]}, "different columns"),
        ({"ports": []}, "needs a partner"),
        ({"kind": "glue"}, "'feedback', 'joint'"),
        ({"one": dx.PortHamiltonian(lambda x: x @ x, J=J)}, "no ports"),
        ({"one": dx.PortHamiltonian(lambda x: x @ x, J=J, B=B, closed=True)}, "closed port meets nothing"),
        ({"one": mass().with_inputs(lambda t, x: x[:1])}, "already driven"),
    ],
)
def test_ports_that_do_not_fit(change, message):
    with pytest.raises(ValueError, match=message):
        dx.interconnect(**{"one": mass(), "other": mass(), "ports": [0], "other_ports": [0], "sizes": (2, 2), **change})


@pytest.mark.parametrize(
    "change, error, message",
    [
        ({"sizes": 4}, TypeError, "sizes must be a list of whole numbers"),
        ({"sizes": (2,)}, ValueError, "lengths of the two x"),
        ({"sizes": (3, 1)}, ValueError, r"as sizes has it: J must have shape \(3, 3\)"),
        ({"ports": 0}, TypeError, "ports must be a list of whole numbers"),
        ({"other_ports": [0.5]}, TypeError, "other_ports must be a list of whole numbers"),
        ({"one": dx.PortHamiltonian(lambda x: x @ x, J=J, B=lambda x, params: params["b"] * B)}, TypeError, "pass params="),
    ],
)
def test_what_does_not_say_which_ports_meet(change, error, message):
    with pytest.raises(error, match=message):
        dx.interconnect(**{"one": mass(), "other": mass(), "ports": [0], "other_ports": [0], "sizes": (2, 2), **change})


@pytest.mark.parametrize("kind", ["feedback", "joint"])
def test_sparse_systems_are_joined_to_a_sparse_one_and_to_others(kind):
    ends = np.array([[0.0, 1.0], [1.0, 0.0]])
    system = lambda own: dx.PortHamiltonian(lambda x: x @ x / 2, J=own(J), B=own(ends), R=own(np.diag([0.0, 0.3])))
    join = lambda one, other: dx.interconnect(one, other, [1], [0], sizes=(2, 2), kind=kind)
    dense, sparse = system(np.asarray), system(csr_matrix)
    expected = join(dense, dense)
    for whole, all_sparse in ((join(sparse, sparse), True), (join(sparse, dense), False)):
        for name in ("J", "B", "R"):
            found = getattr(whole, name)(jnp.zeros(4), None)
            assert np.array_equal(found, getattr(expected, name)(jnp.zeros(4), None))
            assert hasattr(found, "matrix") == all_sparse
        assert whole.closed == expected.closed and whole.sizes({"x": jnp.zeros(4)}, None)[0] == 4


def test_some_ports_closed_and_some_driven():
    """A free particle in the plane, closed in y and pushed in x."""
    system = dx.PortHamiltonian(
        lambda x: x[2:] @ x[2:] / 2, J=dx.canonical_two_form(2), B=jnp.eye(4)[:, 2:], closed=[1], inputs=lambda t, x: jnp.ones(1)
    )  # fmt: skip
    sol = dx.simulate(system, dx.DiscreteDirac(), x=[0.0, 0.0, 0.5, 0.0], step=0.1, steps=20)
    assert sol.x[-1] == pytest.approx([0.5 * 2 + 2.0, 0.0, 2.5, 0.0], abs=1e-13)
    assert np.abs(sol.multipliers).max() < 1e-13
    with pytest.raises(ValueError, match="one number an open port"):
        dx.simulate(
            system, dx.DiscreteDirac(), x=[0.0, 0.0, 0.5, 0.0], step=0.1, steps=2, inputs=lambda t, x: jnp.ones(2)
        )  # fmt: skip
    with pytest.raises(ValueError, match="different columns of B"):
        wrong = dx.PortHamiltonian(lambda x: x @ x, J=J, B=B, closed=[1])
        dx.simulate(wrong, dx.DiscreteDirac(), x=[0.0, 1.0], step=0.1, steps=2)


def test_method_2_of_closed_ports_names_the_chain():
    system = dx.PortHamiltonian(lambda x: x @ x / 2, J=dx.canonical_two_form(2), B=jnp.eye(4)[:, 2:3], closed=True)
    with pytest.raises(ValueError, match="constraint_algorithm"):
        dx.simulate(system, dx.DiscreteDirac(constraints="resolve"), x=[0.0, 1, 0, 1], step=0.1, steps=2)


@pytest.mark.parametrize(
    "change, message",
    [
        ({"J": np.array([[0.0, 1.0], [-1.0, 0.1]])}, r"J is not skew at the initial point: max \|J \+ Jᵀ\| = 0.2"),
        ({"R": np.array([[0.1, 0.2], [0.0, 0.1]])}, r"R is not symmetric.*0.2"),
        ({"R": np.array([[0.1, 0.2], [0.2, 0.1]])}, "R is not positive semidefinite.*lowest eigenvalue is -0.1"),
        ({"J": csr_matrix(J), "R": np.array([[0.1, 0.2], [0.0, 0.1]])}, r"R is not symmetric.*0.2"),
        ({"R": csr_matrix([[0.1, 0.0], [0.0, -0.2]])}, "R is not positive semidefinite: it has -0.2 on its diagonal"),
    ],
)
def test_structures_that_are_none(change, message):
    system = dx.PortHamiltonian(lambda x: x @ x / 2, **{"J": J, **change})
    for scheme in (dx.DiscreteDirac(), dx.DiscreteGradient()):
        with pytest.raises(ValueError, match=message):
            dx.simulate(system, scheme, x=[0.0, 1.0], step=0.1, steps=2)


@pytest.mark.parametrize(
    "metric, message",
    [
        (lambda q: jnp.diag(jnp.array([1.0, -1.0])), "not positive definite.*lowest eigenvalue is -1"),
        (lambda q: jnp.diag(jnp.array([1.0, 0.0])), "not positive definite.*dx.LagrangeDirac"),
        (lambda q: jnp.array([[1.0, 0.5], [0.0, 1.0]]), "not symmetric.*0.5"),
    ],
)
def test_metrics_that_are_none(metric, message):
    system = dx.NonholonomicMechanics(metric, lambda q: 0.0 * q[0], lambda q: jnp.array([[1.0, 0.0]]))
    with pytest.raises(ValueError, match=message):
        dx.simulate(system, dx.DiscreteDirac(), q=[0.0, 0.0], v=[0.0, 1.0], step=0.1, steps=2)


def test_open_ports_of_a_dirac_structure_have_to_be_connected():
    mass = dx.DiracStructure.from_bivector(lambda p: jnp.array([[0.0, 1.0], [-1.0, 0.0]]), n=1, ports=1)
    with pytest.raises(ValueError, match="1 ports are open; connect them by `compose`"):
        dx.simulate(dx.DiracSystem(mass, lambda p: p @ p / 2), dx.DiscreteDirac(), x=[1.0], step=0.1, steps=2)
