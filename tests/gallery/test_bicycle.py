"""The benchmark bicycle against the digits that were published of it."""

import numpy as np
import pytest
from scipy.optimize import brentq

import dirax as dx
from dirax.gallery import bicycle

EIGENVALUES = np.array(  # Meijaard et al. 2007, Table 2, at 5 m/s
    [-0.32286642900409, -0.77534188219585 + 4.46486771378823j, -0.77534188219585 - 4.46486771378823j, -14.07838969279822]
)


def at_speed(speed):
    return dx.linearize(bicycle.MODEL.system, bicycle.straight(speed), symmetries=bicycle.SYMMETRIES)


def of_lean_and_steer(found):
    """The four eigenvalues beside that of the speed, which is zero."""
    values = found.eigenvalues
    return np.delete(values, np.argmin(np.abs(values)))


def test_eigenvalues_at_five_metres_a_second():
    found = at_speed(5.0)
    assert of_lean_and_steer(found) == pytest.approx(EIGENVALUES, abs=1e-11)
    assert found.matrix.shape == (5, 5) and found.residual < 1e-15 and found.stable


def test_weave_and_capsize_speeds():
    def weave(speed):
        values = at_speed(speed).eigenvalues
        return values[np.argmax(values.imag)].real

    # the coefficient of the characteristic polynomial that is the product of the four eigenvalues
    capsize = lambda speed: np.poly(at_speed(speed).matrix)[4]
    assert brentq(weave, 4.0, 4.5, xtol=1e-13) == pytest.approx(4.29238253634111, abs=1e-10)
    assert brentq(capsize, 5.9, 6.1, xtol=1e-13) == pytest.approx(6.02426201538837, abs=1e-10)


def test_the_discrete_equations_have_these_eigenvalues_to_second_order():
    place, midpoint = bicycle.straight(5.0), dx.LagrangeDAlembert()
    errors = []
    for step in (0.01, 0.005):
        found = dx.linearize(bicycle.MODEL.system, place, midpoint, step=step, symmetries=bicycle.SYMMETRIES)
        errors.append(np.abs(of_lean_and_steer(found) - EIGENVALUES).max())
    assert np.log2(errors[0] / errors[1]) == pytest.approx(2.0, abs=0.05) and errors[1] < 5e-3
    assert len(found.multipliers) == 5 and np.abs(found.multipliers).max() == pytest.approx(1.0, abs=1e-11)


def test_accelerations_of_the_nonlinear_benchmark():
    """Basu-Mandal, Chatterjee, Papadopoulos 2007, Table 1; their bicycle rides along −x, upright at ψ = π/2 and φ = π."""
    theta, psi, phi, steer = 0.0, 0.9501292851472, 3.1257073014894, 0.2311385135743
    q = [0.0, 0.0, 0.2440472102925, theta + np.pi, np.pi / 2 - psi, phi - np.pi, 0.0, steer, 0.0]
    rates = [0.7830033527065, -0.6068425835418, -0.0119185528069, 8.9129896614890, 0.4859824687093, 8.0133620584155]
    v = [-2.8069345714545, -0.1480982396001, 0.1058778746261, *rates]
    assert np.abs(bicycle.MODEL.system.constraints.defect(0.0, np.array(q), np.array(v), None)).max() < 1e-12
    expected = {
        **{"frame.x": -0.5041626315047, "frame.y": -0.3449706619454, "frame.z": -1.4604528332980},
        **{"frame.yaw": 0.8353281706379, "frame.roll": 7.8555281128244, "frame.pitch": 0.1205543897884},
        **{"steer": -4.6198904039403, "rear wheel": 1.8472554144217, "front wheel": 2.4548072904550},
    }
    assert bicycle.MODEL.accelerations(q, v) == pytest.approx(expected, abs=5e-12)


@pytest.mark.parametrize(("speed", "roll", "step"), [(4.0, 0.05, 0.01), (4.6, 0.5, 0.02), (8.0, 0.05, 0.02)])
def test_the_manoeuvres_of_the_iftomm_library_are_within_its_score(speed, roll, step):
    """M1, M2 and M3: pushed to the side with a rate of roll, 20 s; 100 (E_max − E_min)/E_0 is to be below 1e-3."""
    start = bicycle.MODEL.state({}, {"frame.x": speed, "frame.roll": roll, "frame.yaw": 0.0, "steer": 0.0})
    sol = bicycle.EXAMPLE.simulate(**start, step=step, steps=round(20 / step))
    energy = sol.energy()
    assert sol.ok and 100 * np.ptp(energy) / energy[0] < 1e-3
    assert np.abs(sol.constraint_residual()).max() < 1e-13


@pytest.mark.soak
def test_an_hour_of_riding_keeps_both_contacts():
    start = bicycle.MODEL.state({}, {"frame.x": 5.0, "frame.roll": 0.5, "frame.yaw": 0.0, "steer": 0.0})
    sol = bicycle.EXAMPLE.simulate(**start, step=0.02, steps=180_000, save_every=200)
    energy = sol.energy()
    assert sol.ok and np.abs(sol.constraint_residual()).max() < 1e-13 and 100 * np.ptp(energy) / energy[0] < 1e-3


def test_it_rides_with_both_wheels_on_the_ground():
    sol = bicycle.EXAMPLE.simulate(steps=400)
    assert sol.ok and np.abs(sol.constraint_residual()).max() < 1e-13
    assert np.ptp(sol.energy()) < 1e-6 * sol.energy()[0]
    with pytest.raises(ValueError, match=r"no relative equilibrium.*symmetries"):
        dx.linearize(bicycle.MODEL.system, bicycle.EXAMPLE.initial, symmetries=bicycle.SYMMETRIES)
