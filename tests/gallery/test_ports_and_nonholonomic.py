"""Gallery systems with ports and with nonholonomic constraints, against closed solutions."""

import jax.numpy as jnp
import numpy as np
import pytest

import dirax as dx
from dirax import gallery
from dirax.gallery import lc_ladder, mass_spring_damper, rolling_ball

METHODS = (dx.DiscreteDirac(), dx.DiscreteDirac(constraints="resolve"))


@pytest.mark.parametrize("name", ["knife-edge", "chaplygin-sleigh"])
@pytest.mark.soak_of("knife-edge")
def test_exact_solutions_are_followed_with_order_2_by_both_methods(name):
    example = gallery.get(name)
    for scheme in METHODS:
        errors = []
        for steps in (100, 200):
            sol = example.simulate(scheme, step=4 / steps, steps=steps)
            errors.append(np.abs(sol.q - example.exact(sol.t, **example.initial)).max())
        assert np.log2(errors[0] / errors[1]) == pytest.approx(2.0, abs=0.05) and errors[1] < 2e-3
    assert np.abs(sol.constraint_residual()).max() < 5e-15


def test_the_ball_falls_with_five_sevenths():
    sol = gallery.get("rolling-ball").simulate(step=0.01, steps=300)
    parameters = rolling_ball.PARAMS
    speed = lambda row: np.linalg.solve(np.asarray(rolling_ball.metric(jnp.asarray(sol.q[row]), parameters)), sol.p[row])
    v = speed(0)  # after projection onto the constraint
    assert np.abs(sol.q[:, :2] - rolling_ball.exact(sol.t, sol.q[0], v)).max() < 1e-4
    assert (sol.q[-1, 0] - sol.q[0, 0] - 3 * v[0]) == pytest.approx(5 / 14 * 0.1 * 9, abs=1e-4)
    spin = [np.asarray(rolling_ball.angular_velocity(jnp.asarray(sol.q[k]), None))[2] @ speed(k) for k in range(0, 301, 100)]
    assert np.ptp(spin) < 1e-4


def test_the_snakeboard_keeps_two_momenta_and_moves():
    example = gallery.get("snakeboard")
    for scheme in METHODS:
        sol = example.simulate(scheme, steps=500)
        assert np.ptp(sol.p[:, 3]) < 1e-13 and np.ptp(sol.p[:, 4]) < 1e-13
        assert np.ptp(sol.energy()) < 1e-3
    assert np.abs(sol.q[-1, :2]).max() > 1.0


def test_the_motor_against_its_closed_solution_and_its_power():
    example = gallery.get("dc-motor")
    sol = example.simulate()
    assert np.abs(sol.x - example.exact(sol.t, **example.initial)).max() < 1e-3
    supplied, dissipated = sol.work.T
    assert np.abs(sol.energy() - supplied + dissipated).max() < 1e-13 * supplied[-1]


def test_the_chain_of_masses_balances_its_energy():
    example = gallery.get("mass-spring-damper")
    sol = example.simulate(inputs=lambda t, x: 0.3 * jnp.sin(1.1 * t)[None], steps=500)
    energy, (supplied, dissipated) = sol.energy(), sol.work.T
    assert np.abs(energy - energy[0] - supplied + dissipated).max() < 1e-13
    with pytest.raises(ValueError, match="one number an open port"):
        example.simulate(inputs=lambda t, x: jnp.zeros(2))
    assert mass_spring_damper.chain(2).J.function(None).shape == (4, 4)


def test_the_ladder_has_its_frequencies():
    """Its modes by the matrix that the netlist gives, and one mode followed."""
    system = lc_ladder.circuit(lc_ladder.ladder(3))
    chain = dx.constraint_algorithm(system, np.zeros(6))
    assert (chain.verdict, chain.dimension) == ("determined", 6)
    matrix = np.stack([np.asarray(chain.field(jnp.asarray(e))) for e in np.eye(6)], axis=1)
    assert np.sort(np.abs(np.linalg.eigvals(matrix).imag))[::2] == pytest.approx(lc_ladder.frequencies(3), abs=1e-12)
    sol = gallery.get("lc-ladder").simulate(steps=200)
    assert np.ptp(sol.energy()) < 1e-13


def test_circuits_that_need_the_constraint_algorithm():
    """Two capacitors in parallel share their voltage; an inductor across a source alone; an RC circuit decays."""
    parallel = lc_ladder.circuit([("C", 1, 0, 1.0), ("C", 1, 0, 2.0), ("L", 1, 0, 0.5)])
    chain = dx.constraint_algorithm(parallel, np.array([0.3, 0.1, 0.2]))
    assert chain.dimension == 2 and chain.point[1] == pytest.approx(2 * chain.point[0])
    decay = lc_ladder.circuit([("C", 1, 0, 2.0), ("R", 1, 0, 0.5)])
    sol = dx.simulate(decay, dx.DiscreteDirac(), x=[1.0], step=0.01, steps=100)
    assert sol.x[-1, 0] == pytest.approx(np.exp(-1.0), abs=1e-5)
    with pytest.raises(ValueError, match="not connected to the ground"):
        lc_ladder.circuit([("C", 1, 0, 1.0), ("L", 2, 3, 1.0)])
    with pytest.raises(ValueError, match="an element is"):
        lc_ladder.circuit([("C", 1, 0, -1.0)])
