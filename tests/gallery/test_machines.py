"""Machines of the gallery against published digits, their integrals, and closed solutions."""

import itertools

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import dirax as dx
from dirax import gallery
from dirax.gallery import (
    andrews_squeezer,
    bricard,
    car_axis,
    chaplygin_sphere,
    euler_disk,
    flyball_governor,
    four_bar,
    n_four_bar,
    n_trailer,
    rattleback,
    robot_arm,
    slider_crank,
    snakeboard_gait,
    tippe_top,
    trikke,
)


@pytest.mark.soak
def test_andrews_squeezer_ends_where_the_test_set_says():
    """Symmetric steps, extrapolated twice; the reference of the IVP test set."""
    ends = [andrews_squeezer.EXAMPLE.simulate(step=0.03 / n, steps=n, save_every=n).q[-1] for n in (4000, 8000, 16000)]
    once = [(4 * b - a) / 3 for a, b in itertools.pairwise(ends)]
    assert np.abs(ends[-1] - andrews_squeezer.REFERENCE).max() < 2e-6
    assert np.abs((16 * once[1] - once[0]) / 15 - andrews_squeezer.REFERENCE).max() < 4e-9


@pytest.mark.soak
def test_the_car_axis_ends_where_the_test_set_says():
    sol = car_axis.EXAMPLE.simulate(dx.Collocation(4, "lobatto"), step=3 / 2000, steps=2000, save_every=2000)
    assert sol.ok and np.abs(sol.q[-1] - car_axis.REFERENCE).max() < 2e-12


@pytest.mark.soak
def test_the_slider_crank_ends_where_the_test_set_says():
    """Symmetric steps, extrapolated once; the elastic coordinates are millionths of a metre."""
    coarse, fine = (slider_crank.EXAMPLE.simulate(step=0.1 / n, steps=n, save_every=n).q[-1] for n in (40_000, 80_000))
    assert (4 * fine - coarse) / 3 == pytest.approx(slider_crank.REFERENCE, abs=3e-10)


def test_a_row_of_windows_folds_through_its_singular_position_as_one_pendulum():
    """All uprights turn alike, ((N + 1)/3 + N) θ̈ = ((N + 1)/2 + N) g sin θ, also past the flat position, twice."""
    windows, example = 4, n_four_bar.EXAMPLE
    ratio = ((windows + 1) / 2 + windows) / ((windows + 1) / 3 + windows)
    exact = solve_ivp(lambda t, y: [y[1], ratio * 9.81 * np.sin(y[0])], (0, 2.5), [0.0, 1.0], rtol=1e-12, atol=1e-12).y[0, -1]
    sol = example.simulate(step=0.005, steps=500)
    energy = sol.energy()
    assert sol.ok and exact > 3 * np.pi / 2 and np.abs(sol.constraint_residual()).max() < 1e-11
    assert sol.q[-1] == pytest.approx(exact * np.sign(sol.q[-1]), abs=2e-3)
    assert energy[0] == pytest.approx(n_four_bar.energy(windows), rel=1e-14) and np.ptp(energy) < 1e-4 * energy[0]


@pytest.mark.soak
def test_forty_windows_fall_as_one_pendulum():
    """The benchmark's size: 81 coordinates and 80 constraints, by sparse elimination."""
    windows, model = 40, n_four_bar.model(40)
    ratio = ((windows + 1) / 2 + windows) / ((windows + 1) / 3 + windows)
    field = lambda t, y: [y[1], ratio * 9.81 * np.sin(y[0])]
    exact = solve_ivp(field, (0, 0.25), [0.0, 1.0], rtol=1e-12, atol=1e-12).y[0, -1]
    start = model.state({}, {"upright 0": 1.0})
    sol = dx.simulate(model.system, dx.LagrangeDAlembert(), **start, step=0.005, steps=50)
    energy = sol.energy()
    assert sol.ok and sol.stats["engine"] == "sparse" and np.abs(sol.constraint_residual()).max() < 1e-11
    assert energy[0] == pytest.approx(n_four_bar.energy(windows), rel=1e-14) and np.ptp(energy) < 1e-4 * energy[0]
    assert sol.q[-1] == pytest.approx(exact * np.sign(sol.q[-1]), abs=2e-3)


def test_trailers_follow_and_settle_on_their_circles():
    """θ̇_k = v_{k−1} sin(θ_{k−1} − θ_k)/d_k at the start, and R_k² = R_{k−1}² − d_k² in the end."""
    model, example = n_trailer.MODEL, n_trailer.EXAMPLE
    start = model.state({"steer": 0.3, "trailer 1": 0.4, "trailer 2": -0.2}, {"car.x": 2.0})
    v, speed, angle = dict(zip(model.coordinates, start["v"], strict=True)), 2.0, 0.0
    rate = v["car.angle"]
    assert rate == pytest.approx(speed * np.tan(0.3) / n_trailer.WHEELBASE)
    for name, length, bend in zip(n_trailer.TRAILERS, n_trailer.LENGTHS, (0.4, -0.2, 0.0), strict=True):
        rate = speed * np.sin(-bend) / length
        speed *= np.cos(bend)
        angle += v[name]
        assert v["car.angle"] + angle == pytest.approx(rate, abs=1e-12)
    sol = example.simulate(step=0.02, steps=1000)
    turning, radius = n_trailer.STEERED, n_trailer.WHEELBASE / np.tan(n_trailer.STEERED)
    assert sol.ok and sol.q[-1, 3] == pytest.approx(turning, abs=2e-3)
    for bend, length in zip(sol.q[-1, 4:], n_trailer.LENGTHS, strict=True):
        assert np.sin(-bend) == pytest.approx(length / radius, abs=5e-3)
        radius = np.sqrt(radius**2 - length**2)


@pytest.mark.parametrize("ridden", [snakeboard_gait, trikke])
@pytest.mark.soak_of(but=["dirax.gallery.trikke"])
def test_gaits_ride_ahead_on_their_skates_alone(ridden):
    """Motors do all the work, skates none: the energy is their work; and no skate slides at the middle of a step."""
    sol = ridden.EXAMPLE.simulate(steps=1000)
    assert sol.ok and np.abs(sol.constraint_residual()).max() < 1e-13 and sol.q[-1, 0] > 0.8
    assert sol.energy() - sol.work == pytest.approx(sol.energy()[0], abs=2e-2)
    still = ridden.EXAMPLE.simulate(steps=100, **{"v": np.zeros(len(sol.q[0])), "q": 0 * sol.q[0]}, step=1e-4)
    assert np.abs(still.q[-1, :2]).max() < 1e-3


@pytest.mark.soak
def test_the_parallelogram_is_a_pendulum():
    sol = four_bar.EXAMPLE.simulate(step=0.005, steps=400)
    field = lambda t, y: [y[1], -1.2 * 9.81 * np.sin(y[0])]
    exact = solve_ivp(field, (0.0, 2.0), [0.8, 0.0], rtol=1e-12, atol=1e-12).y[0, -1]
    assert sol.q[-1] == pytest.approx([exact, -exact, exact], abs=2e-4)
    assert sol.q[:, 0] + sol.q[:, 1] == pytest.approx(0.0, abs=1e-13)
    assert four_bar.MODEL.constraints == ("closing hinge: x", "closing hinge: z")


def test_one_demand_of_the_last_hinge_of_bricard_is_redundant():
    example = bricard.EXAMPLE
    names = bricard.MODEL.redundant(example.initial["q"])
    assert len(bricard.MODEL.constraints) == 5 and len(names) == 1 and names[0].startswith("last hinge")
    smaller = bricard.MODEL.without(*names)
    assert len(smaller.constraints) == 4 and smaller.redundant(example.initial["q"]) == ()
    report = dx.verify(example.simulate(dx.PlusLagrangeDirac(), steps=6))
    assert report.ok, report  # the constraint that is left out has the roundoff of those from which it follows


def test_chaplygins_sphere_keeps_its_angular_momentum_in_space():
    sol = chaplygin_sphere.EXAMPLE.simulate(steps=2000, save_every=200)
    seen = chaplygin_sphere.MODEL.observables(sol, about_contact=chaplygin_sphere.about_contact)
    assert np.ptp(seen["about_contact"], axis=0).max() < 1e-12 and np.abs(sol.q[-1, 4:]).max() > 0.1
    assert np.ptp(seen["energy"]) < 1e-5 and np.ptp(seen["angular_momentum"], axis=0).max() > 1e-3


def test_eulers_disk_runs_round_as_moffatt_says():
    """Its steady motion is a relative equilibrium, with one frequency of nutation, and at another rate it is none."""
    place = euler_disk.steady(0.3)
    assert place["v"][:2] == pytest.approx([-place["v"][2] * place["q"][1], 0.0], abs=1e-12)
    found = dx.linearize(euler_disk.MODEL.system, place, symmetries=euler_disk.SYMMETRIES)
    assert found.residual < 1e-12 and found.stable
    assert np.sort(np.abs(found.eigenvalues.imag))[-2] > 10.0
    other = euler_disk.MODEL.state(
        {"disc.roll": place["q"][3]}, {"disc.yaw": 1.1 * place["v"][2], "disc.roll": 0.0, "disc.spin": place["v"][4]}
    )
    with pytest.raises(ValueError, match="no relative equilibrium"):
        dx.linearize(euler_disk.MODEL.system, other, symmetries=euler_disk.SYMMETRIES)


@pytest.mark.soak
def test_the_rattleback_turns_round_one_way_only():
    changes = {}
    for spin in (-5.0, 5.0):
        start = rattleback.MODEL.state({"stone.roll": 0.01, "stone.pitch": 0.01}, {"stone.yaw": spin})
        sol = rattleback.EXAMPLE.simulate(**start, step=2e-3, steps=2500)
        changes[spin] = np.diff(sol.q[::25, 3]) / 0.05
        assert sol.ok and np.ptp(sol.energy()) < 1e-2 * sol.energy()[0]
    assert changes[-5.0][0] < -4.0 and changes[-5.0].max() > 1.0
    assert changes[5.0].min() > 4.0


def test_the_tippe_top_turns_over_and_keeps_jelletts_integral():
    sol = tippe_top.EXAMPLE.simulate(steps=10_000, save_every=500)
    upright = lambda q, v: tippe_top.MODEL.frames(q, v)["top"].turn[2, 2]
    seen = tippe_top.MODEL.observables(sol, jellett=tippe_top.jellett, upright=upright)
    assert seen["upright"][0] > 0.99 and seen["upright"].min() < 0.0
    assert np.ptp(seen["jellett"]) < 1e-3 * seen["jellett"][0] and np.all(np.diff(sol.energy()) < 1e-9)


@pytest.mark.soak
def test_the_governor_turns_freely_and_its_damper_takes_energy():
    sol = flyball_governor.EXAMPLE.simulate(steps=1000, save_every=20)
    seen = flyball_governor.MODEL.observables(sol)
    about = seen["angular_momentum"][:, 2]
    assert np.ptp(about) < 1e-12 * about[0] and np.abs(sol.q[:, 2] + sol.q[:, 4]).max() < 1e-10
    assert np.abs(sol.constraint_residual()).max() < 1e-12 and np.ptp(sol.q[:, 1]) > 0.01
    assert seen["energy"][-1] < seen["energy"][0] - 0.1
    assert seen["energy"] - sol.work == pytest.approx(seen["energy"][0], rel=1e-4)


@pytest.mark.soak
def test_the_arm_keeps_its_angular_momentum_about_the_base():
    """Nothing turns its first hinge; and its energy stays, of which the links throw much to and fro."""
    sol = robot_arm.EXAMPLE.simulate(steps=1000, save_every=100)
    height = lambda q, v: robot_arm.MODEL.potential_energy(q)
    seen = robot_arm.MODEL.observables(sol, height=height)
    about = seen["angular_momentum"][:, 2]
    assert np.ptp(sol.p[:, 0]) < 1e-12 and about == pytest.approx(sol.p[:, 0], abs=1e-12) and about[0] > 0.5
    assert np.ptp(sol.energy()) < 1e-3 * np.ptp(seen["height"]) and np.ptp(seen["height"]) > 5.0


@pytest.mark.parametrize("name", ["bicycle", "andrews-squeezer", "euler-disk"])
def test_machines_are_drawn(name):
    example = gallery.get(name)
    kinds = {part.kind for part in example.scene.parts}
    assert all(part.settings["radius"] < 0.1 for part in example.scene.parts if part.kind in ("point", "rod"))
    assert kinds >= {"bicycle": {"disk", "plane"}, "andrews-squeezer": {"rod", "spring"}, "euler-disk": {"disk"}}[name]
