"""The benchmark bicycle against the digits that were published of it."""

import numpy as np
import pytest
from scipy.optimize import brentq, least_squares, root
from scipy.spatial.transform import Rotation

import dirax as dx
from dirax.gallery import bicycle

EIGENVALUES = np.array(  # Meijaard et al. 2007, Table 2, at 5 m/s
    [-0.32286642900409, -0.77534188219585 + 4.46486771378823j, -0.77534188219585 - 4.46486771378823j, -14.07838969279822]
)

CIRCLES = ((-0.399075868479, 1.208744650950, 3.868576816254), (-0.812289319365, 2.442248923819, 5.856867788678))
"""Lean, rate of turning and speed of the two circles with the handlebar at .3 rad, of the page on riding a bicycle."""


def at_speed(speed):
    return dx.linearize(bicycle.MODEL.system, bicycle.straight(speed), symmetries=bicycle.SYMMETRIES)


def of_lean_and_steer(found):
    """The four eigenvalues beside that of the speed, which is zero."""
    values = found.eigenvalues
    return np.delete(values, np.argmin(np.abs(values)))


@pytest.mark.soak
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


def test_the_eigenvalues_from_rest_to_ten_metres_a_second_are_those_of_the_published_matrices():
    """M q̈ + v C₁ q̇ + (g K₀ + v² K₂) q = 0 of lean and steer, Meijaard et al. 2007, eq. (6.2)."""
    mass = np.array([[80.81722, 2.31941332208709], [2.31941332208709, 0.29784188199686]])
    first = np.array([[0.0, 33.86641391492494], [-0.85035641456978, 1.68540397397560]])
    still = np.array([[-80.95, -2.59951685249872], [-2.59951685249872, -0.80329488458618]])
    riding = np.array([[0.0, 76.59734589573222], [0.0, 2.65431523794604]])
    for speed in (0.0, 0.5, 1.0, 2.5, 4.0, 5.5, 7.0, 8.5, 10.0):
        across = -np.linalg.solve(mass, np.hstack([9.81 * still + speed**2 * riding, speed * first]))
        expected = np.linalg.eigvals(np.vstack([np.eye(2, 4, 2), across]))
        found = at_speed(speed).eigenvalues
        assert max(np.abs(found - value).min() for value in expected) < 2e-12


def newton_euler_defect(q, v):
    """Heights of the contacts and their slip, and what forces at them leave of the equations of Newton and Euler for all bodies,
    of the torques about the axles and the steering axis, of bodies that circle at a constant rate; relative to the weight."""
    turn = Rotation.from_euler("ZXY", [q["frame.yaw"], q["frame.roll"], q["frame.pitch"]]).as_matrix()
    tilt = bicycle.TILT
    steering = turn @ [-np.sin(tilt), 0.0, np.cos(tilt)]
    turned = Rotation.from_rotvec(q["steer"] * steering).as_matrix() @ turn
    up, rate = np.array([0.0, 0.0, 1.0]), v["frame.yaw"]
    rear = np.array([q["frame.x"], q["frame.y"], q["frame.z"]])
    axis_at = rear + turn @ [1.1, 0.0, -0.3]
    front = axis_at + turned @ (np.array([1.02, 0.0, 0.05]) - [1.1, 0.0, -0.3])
    middle = rear + np.cross(up, [v["frame.x"], v["frame.y"], 0.0]) / rate

    def inertia(xx, yy, zz, xz):
        return np.array([[xx, 0, xz], [0, yy, 0], [xz, 0, zz]])

    parts = [  # mass, inertia, attitude, place, rate about the axle, in front
        (85.0, inertia(9.2, 11.0, 2.8, -2.4), turn, rear + turn @ [0.3, 0, 0.6], 0.0, False),
        (2.0, inertia(0.0603, 0.12, 0.0603, 0.0), turn, rear, v["rear wheel"], False),
        (4.0, inertia(0.05892, 0.06, 0.00708, 0.00756), turned, axis_at + turned @ [-0.2, 0, 0.7], 0.0, True),
        (3.0, inertia(0.1405, 0.28, 0.1405, 0.0), turned, front, v["front wheel"], True),
    ]
    contacts, defects = [], []
    for centre, axle, radius, spin in (
        (rear, turn[:, 1], 0.3, v["rear wheel"]),
        (front, turned[:, 1], 0.35, v["front wheel"]),
    ):
        low = (up @ axle) * axle - up
        contacts.append(centre + radius * low / np.linalg.norm(low))
        slip = rate * np.cross(up, centre - middle) + np.cross(rate * up + spin * axle, contacts[-1] - centre)
        defects += [contacts[-1][2], slip[0], slip[1]]
    rows, wanted = [], []

    def balance(about, bodies, touching, along=None):
        """Moments about a point, along a direction or all three."""
        needed = np.zeros(3)
        for mass, own, attitude, place, spin, _ in bodies:
            momentum = attitude @ own @ attitude.T @ (rate * up + spin * attitude[:, 1])
            pulled = mass * (rate**2 * np.cross(up, np.cross(up, place - middle)) + 9.81 * up)
            needed = needed + np.cross(place - about, pulled) + rate * np.cross(up, momentum)
        arms = np.zeros((3, 6))
        for k in touching:
            arms[:, 3 * k : 3 * k + 3] = np.cross(contacts[k] - about, np.eye(3)).T
        pick = np.eye(3) if along is None else np.array([along])
        rows.append(pick @ arms)
        wanted.append(pick @ needed)

    rows.append(np.hstack([np.eye(3), np.eye(3)]))
    wanted.append(sum(m * (rate**2 * np.cross(up, np.cross(up, p - middle)) + 9.81 * up) for m, _, _, p, _, _ in parts))
    balance(np.zeros(3), parts, (0, 1))
    balance(axis_at, [part for part in parts if part[5]], (1,), steering)
    balance(rear, parts[1:2], (0,), turn[:, 1])
    balance(front, parts[3:], (1,), turned[:, 1])
    matrix, sought = np.vstack(rows), np.concatenate(wanted)
    forces = np.linalg.lstsq(matrix, sought, rcond=None)[0]
    return np.concatenate([defects, (matrix @ forces - sought) / (94 * 9.81)])


def circling_by_newton_and_euler(steer, near):
    """The circular motion at this angle of steering near such numbers, by their equations alone."""
    names = ("frame.roll", "frame.pitch", "frame.z", "frame.yaw", "frame.x", "frame.y", "rear wheel", "front wheel")

    def defect(x):
        q = dict(zip(names[:3], x[:3], strict=True)) | {"frame.x": 0.0, "frame.y": 0.0, "frame.yaw": 0.0, "steer": steer}
        return newton_euler_defect(q, dict(zip(names[3:], x[3:], strict=True)))

    return least_squares(defect, near, method="lm", xtol=1e-15, ftol=1e-15, gtol=1e-15).x


def named(values):
    return dict(zip(bicycle.MODEL.coordinates, values, strict=True))


def circling(steer, near):
    """The circular motion near this lean and rate, its data, and what Newton and Euler find from numbers beside them."""

    def missed(x):
        found = bicycle.MODEL.accelerations(**bicycle.circling(steer, *x))
        return [found["frame.roll"], found["steer"]]

    solved = root(missed, near, tol=1e-12)
    assert np.abs(solved.fun).max() < 1e-10
    data = bicycle.circling(steer, *solved.x)
    q, v = named(data["q"]), named(data["v"])
    assert np.abs(newton_euler_defect(q, v)).max() < 1e-11
    assert dx.linearize(bicycle.MODEL.system, data, symmetries=bicycle.SYMMETRIES).residual < 1e-12
    ours = [q["frame.roll"], q["frame.pitch"], q["frame.z"], *(v[name] for name in ("frame.yaw", "frame.x", "frame.y"))]
    ours = np.array([*ours, v["rear wheel"], v["front wheel"]])
    aside = ours * (1 + 0.01 * np.random.default_rng(5).normal(size=8))
    assert circling_by_newton_and_euler(steer, aside) == pytest.approx(ours, abs=1e-11)
    return *solved.x, abs(v["rear wheel"] * bicycle.REAR)


@pytest.mark.soak
def test_circular_motions_are_relative_equilibria_by_newton_and_euler():
    """Two families (Basu-Mandal et al. 2007): one leaves straight riding at the capsize speed, one lies down as it speeds up."""
    near = 6.0 / (1.02 / np.cos(bicycle.TILT))
    slight = circling(0.001, np.array([-(6.0 * near) / 9.81, near]) * 0.001)
    assert slight[2] == pytest.approx(6.02426201538837, abs=1e-4)
    for circle in CIRCLES:
        assert circling(0.3, np.round(circle[:2], 2)) == pytest.approx(circle, abs=1e-11)
    other = bicycle.circling(0.1, -0.2, 0.5)
    assert np.abs(newton_euler_defect(named(other["q"]), named(other["v"]))).max() > 1e-3


@pytest.mark.soak
def test_the_discrete_equations_have_these_eigenvalues_to_second_order():
    place, midpoint = bicycle.straight(5.0), dx.LagrangeDAlembert()
    errors = []
    for step in (0.01, 0.005):
        found = dx.linearize(bicycle.MODEL.system, place, midpoint, step=step, symmetries=bicycle.SYMMETRIES)
        errors.append(np.abs(of_lean_and_steer(found) - EIGENVALUES).max())
    assert np.log2(errors[0] / errors[1]) == pytest.approx(2.0, abs=0.05) and errors[1] < 5e-3
    assert len(found.multipliers) == 5 and np.abs(found.multipliers).max() == pytest.approx(1.0, abs=1e-11)


@pytest.mark.soak
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


@pytest.mark.parametrize("manoeuvre", bicycle.MANOEUVRES, ids=lambda example: example.name)
@pytest.mark.soak_of(but=["bicycle M3"])
def test_the_manoeuvres_of_the_iftomm_library_are_within_its_score(manoeuvre):
    """M1, M2 and M3: pushed to the side with a rate of roll, 20 s; 100 (E_max − E_min)/E_0 is to be below 1e-3."""
    sol = manoeuvre.simulate()
    energy = sol.energy()
    assert sol.ok and sol.t[-1] == pytest.approx(20.0) and 100 * np.ptp(energy) / energy[0] < 1e-3
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
