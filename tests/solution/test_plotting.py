"""Plots show the solution's own numbers, labelled, and leave matplotlib as they found it."""

import jax
import matplotlib
import numpy as np
import pytest
from matplotlib.figure import Figure

import dirax as dx
from dirax import gallery
from dirax.solution import plotting
from dirax.solution.section import crossings
from dirax.solution.style import new_figure, save_figure

MIDPOINT = dx.LagrangeDAlembert()
DISK = gallery.get("rolling-disk").simulate(step=0.01, steps=300)
BATCH_Q = np.array([[0.0, 0.1 + 0.01 * k] for k in range(14)])
BATCH = gallery.get("henon-heiles").simulate(q=BATCH_Q, v=np.full((14, 2), 0.2), steps=50)


def lines(ax):
    return [np.asarray(line.get_data()) for line in ax.lines if len(line.get_xdata()) > 1]


def test_trajectory_in_the_plane_of_named_or_numbered_coordinates():
    ax = plotting.plot_trajectory(DISK, "x", "y")
    assert np.array_equal(lines(ax)[0], DISK.q[:, :2].T)
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("$x$", "$y$") and ax.get_aspect() == 1.0
    ax = plotting.plot_trajectory(DISK, 3, -2)
    assert np.array_equal(lines(ax)[0], DISK.q[:, [3, 2]].T)
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("$φ$ (rad)", "$θ$ (rad)") and ax.get_aspect() == "auto"


def test_coordinates_momenta_and_phase_plane():
    ax = plotting.plot_coordinate(DISK, "φ", field="p")
    assert np.array_equal(lines(ax)[0], [DISK.t, DISK.p[:, 3]]) and ax.get_ylabel() == "$p_{φ}$"
    ax = plotting.plot_phase(DISK, "θ")
    assert np.array_equal(lines(ax)[0], [DISK.q[:, 2], DISK.p[:, 2]])
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("$θ$ (rad)", "$p_{θ}$")


def test_energy_with_its_error_on_a_logarithmic_scale():
    figure = plotting.plot_energy(DISK)
    left, right = figure.axes
    energy = DISK.energy()
    assert np.array_equal(lines(left)[0], [DISK.t, energy]) and right.get_yscale() == "log"
    error = lines(right)[0][1]
    assert np.isnan(error[0]) and error[1:] == pytest.approx(np.abs(energy[1:] / energy[0] - 1), rel=1e-9)


def test_constraint_and_the_envelope_of_long_series():
    ax = plotting.plot_constraint(DISK, ax=new_figure()[1])
    residual = np.abs(DISK.constraint_residual()).max(axis=1)
    shown = lines(ax)[0][1]
    assert np.array_equal(shown[residual > 0], residual[residual > 0]) and np.all(np.isnan(shown[residual == 0]))
    values = np.concatenate([[1.0], 1.0 + np.random.default_rng(0).random(12_345)])
    _, ax = new_figure()
    plotting.plot_error(ax, np.arange(values.size), values)
    t, error = lines(ax)[0]
    assert t.size == plotting.ENVELOPE and np.nanmax(error) == np.max(values - 1)
    assert np.all(np.diff(t) >= 12) and np.all(np.diff(t) <= 13)
    with pytest.raises(ValueError, match="no constraints"):
        plotting.plot_constraint(BATCH)


def test_a_batch_is_drawn_whole():
    ax = plotting.plot_trajectory(BATCH, label="stars")
    assert len(lines(ax)) == 14 and np.array_equal(lines(ax)[5], BATCH.q[5].T)
    assert [text for text in ax.get_legend_handles_labels()[1]] == ["stars"]
    assert all(line.get_alpha() for line in ax.lines if len(line.get_xdata()) > 1)


def test_a_solution_without_names_shows_numbers_and_unknown_names_are_refused():
    bare = gallery.get("kepler").simulate(steps=5)
    bare.metadata.clear()
    assert plotting.plot_trajectory(bare).get_xlabel() == "$q_{0}$"
    with pytest.raises(ValueError, match="no coordinate 'z': give an index from 0 to 3 or one of x, y, θ, φ"):
        plotting.plot_trajectory(DISK, "z")
    with pytest.raises(ValueError, match="no coordinate 7"):
        plotting.plot_coordinate(DISK, 7)


def test_state_vectors_are_drawn_too():
    body = gallery.get("rigid-body").simulate(steps=20)
    assert np.array_equal(lines(plotting.plot_trajectory(body))[0], body.x[:, :2].T)
    with pytest.raises(ValueError, match="phase plane"):
        plotting.plot_phase(body)


def test_no_global_state_is_touched(tmp_path):
    before = dict(matplotlib.rcParams)
    figure = plotting.plot_energy(DISK, label="disk")
    figure.axes[0].legend()
    save_figure(figure, tmp_path / "energy.png")
    assert isinstance(figure, Figure) and dict(matplotlib.rcParams) == before
    assert (tmp_path / "energy.png").read_bytes().startswith(b"\x89PNG")
    again = plotting.plot_energy(DISK, figure=figure)
    assert again is figure and len(figure.axes[0].lines) == 2


def test_methods_of_the_solution_are_these_functions():
    assert np.array_equal(lines(DISK.plot_trajectory("θ", "φ"))[0], DISK.q[:, [2, 3]].T)
    alone, pair = Figure().subplots(), Figure().subplots(1, 2)
    assert DISK.plot_energy(ax=alone).axes == [alone] and DISK.plot_energy(ax=pair).axes == list(pair)
    assert alone.get_ylabel().startswith("energy") and pair[1].get_yscale() == "log"
    assert len(DISK.plot_energy().axes) == 2 and DISK.plot_constraint().get_yscale() == "log"


def test_picture_of_the_readme(tmp_path):
    from dirax.gallery.picture import draw, picture

    picture(tmp_path / "disk.png", step=0.02, end=2.0)
    assert (tmp_path / "disk.png").stat().st_size > 10_000
    left, right = draw(0.02, 2.0).axes
    assert [line.get_label() for line in left.lines][-1] == "exact" and len(lines(left)) == 4
    assert np.nanmax(lines(right)[2][1]) < 1e-3 < 1e-2 < min(np.nanmax(lines(right)[k][1]) for k in (0, 1))


def test_a_path_in_space_and_axes_that_cannot_hold_it():
    particle = gallery.get("charged-particle").simulate(steps=40)
    ax = plotting.plot_trajectory(particle, "x", "y", "z")
    assert np.allclose(np.array(ax.lines[0].get_data_3d()), particle.q[:, :3].T)
    assert (ax.get_xlabel(), ax.get_zlabel()) == ("$x$", "$z$")
    with pytest.raises(ValueError, match='projection "3d"'):
        plotting.plot_trajectory(particle, 0, 1, 2, ax=new_figure()[1])


def test_momenta_of_symmetries_move_from_zero_and_without_them_p_is_drawn():
    ax = plotting.plot_momenta(DISK)
    assert np.array_equal(lines(ax)[0], [DISK.t, DISK.p[:, 3] - DISK.p[0, 3]]) and ax.get_ylabel() == "$J - J(0)$"
    assert ax.get_legend_handles_labels()[1] == ["$p_{φ}$"]
    ax = plotting.plot_momenta(gallery.get("double-pendulum").simulate(steps=5))
    assert len(lines(ax)) == 2 and ax.get_ylabel() == "momentum $p$"
    with pytest.raises(ValueError, match="momenta need p"):
        plotting.plot_momenta(gallery.get("rigid-body").simulate(steps=5))


def test_a_section_has_the_states_at_the_value():
    t = np.linspace(0, 20, 201)
    states = np.stack([np.sin(t), np.cos(t)], axis=1)
    found = crossings(t, states, 0, 0.5, 1)
    assert found == pytest.approx(np.tile([0.5, np.sqrt(0.75)], (len(found), 1)), abs=3e-6) and len(found) == 4
    assert len(crossings(t, states, 0, 0.5, 0)) == 7 and np.all(crossings(t, states, 0, 0.5, -1)[:, 1] < 0)
    ax = plotting.plot_section(BATCH, "y", "p_y", through="x", value=0.1)
    shown = sum(len(line.get_xdata()) for line in ax.lines)
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("$y$", "$p_{y}$") and shown == 14
    points = np.arange(8.0).reshape(2, 4)
    ax = plotting.plot_section(BATCH, "y", "p_x", points=points)
    assert np.array_equal(lines(ax)[0], points[:, [1, 2]].T)
    with pytest.raises(ValueError, match="give through="):
        plotting.plot_section(BATCH)
    with pytest.raises(ValueError, match="4 numbers"):
        plotting.plot_section(BATCH, points=np.zeros((3, 2)))


def test_nothing_is_drawn_inside_of_transformations():
    def end(x):
        sol = gallery.get("henon-heiles").simulate(q=[x, 0.1], v=[0.2, 0.2], steps=3)
        with pytest.raises(ValueError, match=r"draw it outside of jax\.grad"):
            sol.plot()
        return sol.q[-1, 0]

    assert np.isfinite(jax.grad(end)(0.1))


def test_one_coordinate_is_drawn_over_time_and_none_is_said():
    one = dx.simulate(dx.LagrangeDirac(lambda q, v: v @ v / 2 - q @ q / 2), MIDPOINT, q=[1.0], v=[0.0], step=0.1, steps=5)
    assert np.array_equal(lines(plotting.plot_trajectory(one))[0], [one.t, one.q[:, 0]])
    shape = dx.LagrangeDirac(lambda q, v: v @ v / 2 - q[1] ** 2)
    run = {"q": [0.0, 1.0], "v": [0.4, 0.2], "step": 0.1, "steps": 5}
    by_one, by_all = (
        dx.simulate(dx.reduce(system, dx.LinearConnection(group)), MIDPOINT, **run)
        for system, group in ((shape, [0]), (dx.LagrangeDirac(lambda q, v: v @ v / 2), [0, 1]))
    )
    assert np.array_equal(lines(plotting.plot_coordinate(by_one))[0], [by_one.t, by_one.x[:, 0]])
    with pytest.raises(ValueError, match=r"no coordinates.*dx.reconstruct"):
        plotting.plot_trajectory(by_all)
