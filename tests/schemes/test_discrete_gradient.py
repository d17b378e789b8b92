"""Discrete gradients: exact energy balance, order 2, and their Dirac and closed forms."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import dirax as dx
from dirax import gallery
from dirax.schemes.discrete_gradient import DiscreteGradient

KINDS = ("gonzalez", "mean-value")
J, B, R = [[0.0, 1.0], [-1.0, 0.0]], [[0.0], [1.0]], [[0.0, 0.0], [0.0, 0.05]]
hamiltonian = lambda x: x[1] ** 2 / 2 - jnp.cos(x[0]) + x[0] ** 4 / 8
drive = lambda t, x: jnp.sin(1.3 * t)[None]
driven = dx.PortHamiltonian(hamiltonian, J=J, R=R, B=B, inputs=drive)
START = np.array([1.0, 0.3])


def by_hand(x):
    """H in numpy."""
    return x[..., 1] ** 2 / 2 - np.cos(x[..., 0]) + x[..., 0] ** 4 / 8


def balance(sol):
    """H_N − H_0 − supplied + dissipated, relative to what went through."""
    energy, work = by_hand(sol.x), sol.work
    return np.abs(energy - energy[0] - work[:, 0] + work[:, 1]).max() / np.abs(work).max()


@pytest.mark.parametrize("kind", KINDS)
def test_energy_balance_is_exact(kind):
    sol = dx.simulate(driven, DiscreteGradient(kind), x=START, step=0.1, steps=2000)
    assert balance(sol) < 1e-14
    stored, supplied, dissipated = sol.power.T
    assert np.abs(stored - supplied + dissipated).max() < 1e-12
    assert np.abs(np.diff(by_hand(sol.x)) - 0.1 * stored).max() < 1e-13
    # the powers are what the definitions say: u at the middle of the step, y = ∇̄H_2 = ẋ_1
    rate = np.diff(sol.x, axis=0) / 0.1
    assert np.abs(supplied - np.sin(1.3 * (sol.t[:-1] + 0.05)) * rate[:, 0]).max() < 1e-12
    assert np.abs(dissipated - 0.05 * rate[:, 0] ** 2).max() < 1e-12


@pytest.mark.parametrize("constant", [0.0, 1e4])
@pytest.mark.parametrize("scheme", [*map(DiscreteGradient, KINDS), DiscreteGradient("mean-value", 2)])
@pytest.mark.soak
def test_a_constant_in_the_hamiltonian_and_damping_leave_the_balance_exact(scheme, constant):
    """The roundoff of H hid its change in short steps, and what they missed added up to 1e-7 of the books."""

    def missed(hamiltonian, start, **run):
        system = dx.PortHamiltonian(lambda x, params: params + hamiltonian(x), J=J, B=B, R=[[0.0, 0.0], [0.0, 0.1]])
        sol = dx.simulate(system, scheme, x=start, params=constant, step=0.05, steps=1000, **run)
        report = dx.verify(sol)
        assert report.ok, report
        energy = np.array([hamiltonian(x) for x in np.asarray(sol.x)])
        return np.abs(energy - energy[0] - sol.work[:, 0] + sol.work[:, 1]).max() / (1.0 + constant)

    quartic = lambda x: x @ x / 2 + x[0] ** 4
    assert missed(quartic, [1.0, 0.0]) < 2e-15
    assert missed(quartic, [0.0, 0.0], inputs=lambda t, x: 0.1 * drive(t, x)) < 5e-16
    assert missed(lambda x: x[1] ** 2 / 2, [0.0, 0.0], inputs=lambda t, x: 0.2 * drive(t, x)) < 5e-16


@pytest.mark.soak
@pytest.mark.parametrize("kind", KINDS)
def test_energy_balance_over_a_million_steps(kind):
    sol = dx.simulate(driven, DiscreteGradient(kind), x=START, step=0.05, steps=1_000_000, save_every=1000)
    assert sol.ok and balance(sol) < 1e-12
    free = dx.PortHamiltonian(hamiltonian, J=J)
    sol = dx.simulate(free, DiscreteGradient(kind), x=START, step=0.05, steps=1_000_000, save_every=1000)
    energy = by_hand(sol.x)
    assert np.abs(energy / energy[0] - 1).max() < 1e-12


@pytest.mark.parametrize("kind", KINDS)
def test_second_order(kind):
    field = lambda t, x: [x[1], -np.sin(x[0]) - x[0] ** 3 / 2 - 0.05 * x[1] + np.sin(1.3 * t)]
    exact = solve_ivp(field, (0, 3), START, rtol=1e-12, atol=1e-12).y[:, -1]
    errors = []
    for steps in (30, 60, 120):
        sol = dx.simulate(driven, DiscreteGradient(kind), x=START, step=3 / steps, steps=steps)
        errors.append(np.abs(sol.x[-1] - exact).max())
    assert -np.diff(np.log2(errors)) == pytest.approx([2.0, 2.0], abs=0.1)


def test_the_two_are_equal_for_quadratic_and_differ_for_other_hamiltonians():
    oscillator = dx.PortHamiltonian(lambda x: x @ x / 2, J=J)
    ends = [dx.simulate(oscillator, DiscreteGradient(kind), x=START, step=0.2, steps=50).x[-1] for kind in KINDS]
    generator = 0.1 * np.array(J)
    cayley = np.linalg.solve(np.eye(2) - generator, np.eye(2) + generator)  # both are the midpoint rule there
    for end in ends:
        assert end == pytest.approx(np.linalg.matrix_power(cayley, 50) @ START, abs=1e-13)
    ends = [dx.simulate(driven, DiscreteGradient(kind), x=START, step=0.2, steps=50).x[-1] for kind in KINDS]
    assert np.abs(ends[0] - ends[1]).max() > 1e-4


def test_a_rigid_body_keeps_energy_and_casimir():
    inertia = jnp.array([1.0, 2.0, 3.0])
    so3 = dx.DiracStructure.from_bivector(lambda x: jnp.cross(x, jnp.eye(3), axisb=0, axisc=0))
    body = dx.DiracSystem(so3, lambda x: x @ (x / inertia) / 2 + x[0] ** 4 / 4)
    sol = dx.simulate(body, DiscreteGradient(), x=[0.3, 0.5, 0.8], step=0.1, steps=500)
    energy = sol.x**2 @ (1 / np.array([1.0, 2.0, 3.0])) / 2 + sol.x[:, 0] ** 4 / 4
    assert np.ptp(energy) < 5e-16
    assert np.ptp(np.linalg.norm(sol.x, axis=1)) < 1e-13  # ⟨x̄, ẋ_d⟩ = 0


def test_closed_ports_keep_the_energy_and_the_discrete_output_zero():
    """Two masses with different springs and a rigid joint."""
    mass = lambda k: dx.PortHamiltonian(lambda x: x[1] ** 2 / 2 + k * x[0] ** 4 / 4, J=J, B=B)
    pair = dx.interconnect(mass(1.0), mass(2.0), [0], [0], sizes=(2, 2), kind="joint")
    sol = dx.simulate(pair, DiscreteGradient(), x=[0.5, 0.1, 0.5, 0.1], step=0.02, steps=1000)
    assert np.ptp(sol.energy()) < 2e-16
    # the joint holds the two together: one mass of 2 on the sum of the springs
    assert np.abs(sol.x[:, 0] - sol.x[:, 2]).max() < 1e-13
    exact = solve_ivp(lambda t, y: [y[1], -1.5 * y[0] ** 3], (0, 20), [0.5, 0.1], rtol=1e-12, atol=1e-12).y[0, -1]
    assert sol.x[-1, 0] == pytest.approx(exact, abs=2e-4)


def test_a_system_that_comes_to_rest_is_not_pushed_by_roundoff():
    damped = dx.PortHamiltonian(lambda x: x @ x / 2 + 5.0, J=J, R=[[0.0, 0.0], [0.0, 1.0]])
    sol = dx.simulate(damped, DiscreteGradient(), x=START, step=0.1, steps=2000)
    assert sol.ok and np.abs(sol.x[-1]).max() < 1e-7
    assert np.all(np.diff(sol.work[:, 1]) >= 0)


def test_other_systems_and_kinds_are_refused():
    with pytest.raises(ValueError, match="'gonzalez', 'mean-value'"):
        DiscreteGradient("average")
    with pytest.raises(TypeError, match="which have a Hamiltonian of x"):
        dx.simulate(dx.LagrangeDirac(lambda q, v: v @ v), DiscreteGradient(), q=[0.0], v=[1.0], step=0.1, steps=1)


@pytest.mark.parametrize("step", [0.1, 0.01])
def test_a_driven_system_that_comes_to_rest_is_stepped_on(step):
    """The motor under constant voltage: at rest H does not change at all, and the correction divides roundoff by nothing."""
    sol = gallery.get("dc-motor").simulate(step=step, steps=3000)
    supplied, dissipated = sol.work.T
    energy = np.asarray(sol.energy())
    assert sol.ok, sol.message
    assert np.abs(energy - energy[0] - supplied + dissipated).max() < 1e-13 * supplied[-1]


@pytest.mark.parametrize(
    ("kind", "engine"),
    [*((kind, "native") for kind in KINDS), ("mean-value", "xla"), pytest.param("gonzalez", "xla", marks=pytest.mark.soak)],
)
@pytest.mark.soak_of(but=["mean-value-native"])
def test_a_system_at_rest_starts_and_one_that_comes_to_rest_goes_on(kind, engine):
    scheme = DiscreteGradient(kind)
    quadratic = lambda x: x @ x / 2
    free = dx.PortHamiltonian(quadratic, J=J, R=[[0.0, 0.0], [0.0, 1.5]])
    assert np.all(dx.simulate(free, scheme, x=np.zeros(2), step=0.1, steps=5, engine=engine).x == 0.0)
    sol = dx.simulate(free, scheme, x=[1.0, 0.5], step=0.5, steps=1000, engine=engine)
    assert sol.ok and np.abs(sol.x[-1]).max() < 1e-100
    small = dx.simulate(free, scheme, x=[1e-63, 5e-64], step=0.5, steps=20, engine=engine)
    np.testing.assert_allclose(small.x * 1e63, sol.x[:21], rtol=1e-12, atol=1e-14)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.soak_of("gonzalez")
def test_a_system_at_rest_is_driven_and_a_small_one_keeps_its_energy(kind):
    scheme = DiscreteGradient(kind)
    quadratic = lambda x: x @ x / 2
    driven = dx.PortHamiltonian(quadratic, J=J, R=R, B=B, inputs=lambda t, x: jnp.sin(t)[None])
    sol = dx.simulate(driven, scheme, x=np.zeros(2), step=0.05, steps=400)
    assert sol.ok
    field = lambda t, x: [x[1], -x[0] - 0.05 * x[1] + np.sin(t)]
    exact = solve_ivp(field, (0, 20), [0, 0], rtol=1e-10, atol=1e-12).y[:, -1]
    assert np.abs(sol.x[-1] - exact).max() < 5e-2
    energy = np.sum(sol.x**2, axis=1) / 2
    assert np.abs(energy - sol.work[:, 0] + sol.work[:, 1]).max() < 1e-13 * np.abs(sol.work).max()
    through = dx.simulate(dx.PortHamiltonian(quadratic, J=J), scheme, x=[1e-63, 0.0], step=0.1, steps=100)
    assert through.ok and np.abs(np.hypot(*through.x.T) * 1e63 - 1).max() < 1e-12


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.soak_of("gonzalez")
def test_it_is_self_adjoint(kind):
    """Its adjoint failed in the second step: the books since the start have no inverse."""
    scheme = DiscreteGradient(kind)
    sol, other = (dx.simulate(driven, s, x=START, step=0.05, steps=20) for s in (scheme, dx.Adjoint(scheme)))
    assert other.ok
    np.testing.assert_array_equal(sol.x, other.x)
    back = dx.simulate(dx.PortHamiltonian(hamiltonian, J=-np.array(J)), scheme, x=START, step=0.05, steps=1)
    ahead = dx.simulate(dx.PortHamiltonian(hamiltonian, J=J), scheme, x=back.x[-1], step=0.05, steps=1)
    np.testing.assert_allclose(ahead.x[-1], START, rtol=1e-14)


@pytest.mark.parametrize("kind", ["gonzalez", "mean-value"])
@pytest.mark.soak_of("gonzalez")
def test_units_of_charge_and_flux_do_not_mix(kind):
    """A nonlinear resonant circuit in other units of either, by powers of two: the same to the last bit."""

    def hamiltonian(x, params):
        charge, flux = x[0] / params["Q"], x[1] / params["F"]
        return params["U"] * (charge**2 / 2 + charge**4 / 4 + jnp.cosh(flux / 1.7) - 1.0)

    def run(Q, F, U):
        circuit = dx.PortHamiltonian(hamiltonian, jnp.array([[0.0, 1.0], [-1.0, 0.0]]))
        start, params = np.array([0.8 * Q, 0.5 * F]), {"Q": Q, "F": F, "U": U}
        return dx.simulate(circuit, dx.DiscreteGradient(kind), x=start, params=params, step=0.3 * Q * F / U, steps=50)

    plain = run(1.0, 1.0, 1.0)
    assert plain.ok and np.ptp(plain.energy()) < 3e-15
    for units in ((2.0**-40, 2.0**-30, 2.0**-33), (2.0**-20, 2.0**-50, 2.0**-33), (2.0**30, 2.0**-30, 2.0**7)):
        scaled = run(*units)
        assert scaled.ok and scaled.stats["newton_iterations"] == plain.stats["newton_iterations"]
        np.testing.assert_array_equal(np.asarray(scaled.x) / units[:2], plain.x)
