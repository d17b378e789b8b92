"""The gallery's first systems against scipy, closed forms and the numbers known of them."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import dirax as dx
from dirax import gallery
from dirax.gallery import heisenberg, kepler, rolling_disk

DISK, KEPLER = gallery.get("rolling-disk"), gallery.get("kepler")


def integrate(field, start, t):
    """The solution of ẏ = field(t, y) at the times t, (rows, dim)."""
    tight = {"method": "DOP853", "rtol": 1e-13, "atol": 1e-13}
    return solve_ivp(field, (0.0, t[-1]), start, t_eval=t, **tight).y.T


def test_names_are_found_in_any_spelling_and_unknown_ones_get_the_nearest():
    assert {"rolling-disk", "heisenberg", "kepler", "double-pendulum", "henon-heiles"} <= set(gallery.names())
    assert gallery.get("Rolling_Disk") is gallery.get("rolling disk") is DISK
    assert gallery.get("Hénon–Heiles").name == "henon-heiles"
    with pytest.raises(ValueError, match="did you mean 'double-pendulum'"):
        gallery.get("doublependulum")
    with pytest.raises(ValueError, match="there are rolling-disk"):
        gallery.get("zzz")


@pytest.mark.parametrize("name", gallery.names())
def test_every_example_is_complete(name):
    example = gallery.get(name)
    assert example.name == name and example.title and example.source and example.step > 0 and example.steps >= 1
    sizes = {np.shape(value)[-1] for value in example.initial.values() if np.ndim(value)}
    assert all(0 <= index < len(example.coordinates) for index in example.plane)
    assert len({coordinate.name for coordinate in example.coordinates}) == len(example.coordinates)
    assert sizes == {len(example.coordinates)}
    assert isinstance(example.scheme, dx.AbstractScheme)


def test_parameters_and_data_are_replaced_and_the_solution_is_labelled():
    sol = DISK.simulate(steps=2, step=0.01, params={"m": 2.0}, scheme=dx.MinusLagrangeDirac())
    assert sol.params["m"] == 2.0 and sol.params["R"] == 1.0
    assert sol.metadata["coordinates"] == ["x", "y", "θ", "φ"] and sol.metadata["units"]["q"] == ["", "", "rad", "rad"]
    sol = KEPLER.simulate(steps=2, q=[1.0, 0.0], p=[0.0, 1.0])
    assert set(sol.initial) == {"q", "p"}


# ------------------------------------------------------------------------------------------------------ rolling disk


def disk_field(t, y, w=1.0, f0=np.pi / 3, m=1.0, R=1.0, I=0.25, V=10.0):
    """(x, y, θ, θ̇)˙ with φ = f0 + w t put in."""
    angle = f0 + w * t
    return [R * np.cos(angle) * y[3], R * np.sin(angle) * y[3], y[3], -V * np.cos(y[2]) / (I + m * R**2)]


def test_disk_exact_solution_is_that_of_scipy():
    t = np.array([0.0, 0.003, 0.7, 5.0, 20.0, 50.0])
    found = rolling_disk.exact(t, **DISK.initial)
    expected = integrate(disk_field, [0.0, 0.0, 0.0, 10.0], t)
    assert np.abs(found[:, :3] - expected[:, :3]).max() < 5e-10
    assert found[:, 3] == pytest.approx(np.pi / 3 + t, abs=1e-13)
    assert found[-1, [2, 0, 1]] == pytest.approx([497.53121842, -1.61792584, -2.1385646], abs=1e-7)  # known of this run


def test_disk_exact_solution_of_other_data_and_parameters():
    params = {"m": 2.0, "R": 0.5, "I": 0.4, "V": 3.0}
    q, v = np.array([1.0, -2.0, 0.3, -0.4]), np.array([0.0, 0.0, -6.0, -1.7])
    t = np.linspace(0.0, 8.0, 5)
    expected = integrate(lambda t, y: disk_field(t, y, -1.7, -0.4, **params), [1.0, -2.0, 0.3, -6.0], t)
    assert np.abs(rolling_disk.exact(t, q, v, params)[:, :3] - expected[:, :3]).max() < 1e-10
    with pytest.raises(ValueError, match="rotates"):
        rolling_disk.exact(t, q, np.array([0.0, 0.0, 1.0, 1.0]))


@pytest.mark.parametrize("scheme", [dx.LagrangeDAlembert(), dx.PlusLagrangeDirac()])
def test_disk_converges_to_its_exact_solution(scheme):
    errors = [
        np.abs(DISK.simulate(scheme, step=2 / steps, steps=steps).q[-1] - rolling_disk.exact([2.0], **DISK.initial)[0]).max()
        for steps in (400, 800, 1600)
    ]
    order = 1.0 if isinstance(scheme, dx.PlusLagrangeDirac) else 2.0
    assert -np.diff(np.log2(errors)) == pytest.approx([order, order], abs=0.1)


# -------------------------------------------------------------------------------------------------------- Heisenberg


def test_heisenberg_runs_along_a_straight_line_without_constraint_force():
    """μ = 0: p_{k+1} − p_k and the difference of the constraint leave μ_k (1 + x_k² + y_k²) = 0."""
    example = gallery.get("heisenberg")
    for scheme in (dx.PlusLagrangeDirac(), dx.MinusLagrangeDirac()):
        sol = example.simulate(scheme, **heisenberg.TWO_POINTS, steps=1000)
        line = heisenberg.TWO_POINTS["q0"] + np.arange(1001)[:, None] * np.array([0.05, 0.1, -0.1])
        assert np.abs(sol.q - line).max() < 1e-10 and np.abs(sol.multipliers).max() < 1e-12
    q, v = example.initial["q"], example.initial["v"]
    assert v[2] == pytest.approx(q[1] * v[0] - q[0] * v[1]) and v @ v / 2 == 112.5


# ------------------------------------------------------------------------------------------------- unconstrained ones


@pytest.mark.parametrize(
    "q, v",
    [
        (KEPLER.initial["q"], KEPLER.initial["v"]),
        (np.array([0.3, -0.8]), np.array([-0.5, -0.9])),  # clockwise, off the axes
        (np.array([1.0, 0.0]), np.array([0.0, 1.0])),  # a circle
    ],
)
def test_kepler_exact_solution_is_that_of_scipy(q, v):
    t = np.linspace(0.0, 13.0, 9)
    expected = integrate(lambda t, y: [*y[2:], *(-y[:2] / np.hypot(*y[:2]) ** 3)], [*q, *v], t)[:, :2]
    assert np.abs(kepler.exact(t, q, v) - expected).max() < 1e-10


def test_kepler_known_values():
    q, v = KEPLER.initial["q"], KEPLER.initial["v"]
    assert kepler.exact([2 * np.pi, np.pi], q, v) == pytest.approx(np.array([[0.4, 0.0], [-1.6, 0.0]]), abs=1e-12)
    assert kepler.exact([2 * np.pi / np.sqrt(2)], q, v * np.sqrt(2), {"mu": 2.0})[0] == pytest.approx([0.4, 0.0], abs=1e-12)
    sol = KEPLER.simulate(steps=500)
    assert sol.energy()[0] == pytest.approx(-0.5, abs=1e-14)
    assert np.asarray(sol.momentum_map(kepler.rotation)) == pytest.approx(0.8, abs=1e-12)
    with pytest.raises(ValueError, match="ellipses"):
        kepler.exact([1.0], q, 10 * v)


def double_pendulum_field(t, y, g=9.81):
    """Newton's equations of two masses of 1 kg on rods of 1 m, solved for the accelerations by hand."""
    a, b, u, w = y
    d = a - b
    below = 2 - np.cos(d) ** 2
    first = (-2 * g * np.sin(a) + g * np.sin(b) * np.cos(d) - np.sin(d) * (w**2 + u**2 * np.cos(d))) / below
    second = (2 * np.sin(d) * u**2 + 2 * g * (np.sin(a) * np.cos(d) - np.sin(b)) + np.sin(d) * np.cos(d) * w**2) / below
    return [u, w, first, second]


def henon_heiles_field(t, y):
    """−∇V of V = (x² + y²)/2 + x² y − y³/3."""
    return [y[2], y[3], -y[0] - 2 * y[0] * y[1], -y[1] - y[0] ** 2 + y[1] ** 2]


@pytest.mark.parametrize(
    "name, field, end, steps",
    [("double-pendulum", double_pendulum_field, 1.0, 200), ("henon-heiles", henon_heiles_field, 10.0, 200)],
)
def test_equations_are_those_written_by_hand(name, field, end, steps):
    """Midpoint, extrapolated once from steps h and h/2, is within its fourth-order remainder of scipy."""
    example = gallery.get(name)
    coarse, fine, finest = (example.simulate(step=end / steps / n, steps=steps * n).q[-1] for n in (1, 2, 4))
    exact = integrate(field, [*example.initial["q"], *example.initial["v"]], np.array([0.0, end]))[-1, :2]
    plain = np.abs([coarse - exact, fine - exact, finest - exact]).max(axis=1)
    assert plain[:-1] / plain[1:] == pytest.approx([4.0, 4.0], rel=0.1)
    extrapolated = np.abs([(4 * fine - coarse) / 3 - exact, (4 * finest - fine) / 3 - exact]).max(axis=1)
    assert extrapolated[1] < plain[2] / 50 and extrapolated[0] / extrapolated[1] > 10


def test_henon_heiles_starts_on_its_energy_surface():
    q, v = (gallery.get("henon-heiles").initial[name] for name in "qv")
    potential = (q @ q) / 2 + q[0] ** 2 * q[1] - q[1] ** 3 / 3
    assert v @ v / 2 + potential == pytest.approx(1 / 8, abs=1e-15)
