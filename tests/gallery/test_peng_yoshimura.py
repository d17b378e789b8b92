"""[PY] reproduced: its table and its figures, against the numbers known of them."""

import math

import numpy as np
import pytest

from dirax.gallery import peng_yoshimura, rolling_disk
from dirax.gallery.reproduction import AGREES, DIFFERS, WRONG, compared, reproduce


@pytest.fixture(scope="module")
def paper():
    heard = []
    found = peng_yoshimura.reproduction(lambda fraction, text: heard.append(fraction))
    assert heard == sorted(heard) and heard[0] >= 0 and heard[-1] < 1
    return found


@pytest.fixture(scope="module")
def rows(paper):
    return {row.quantity: row for row in paper.rows}


END = {
    "+": {"θ": 502.8505732333817, "x": -1.4295644891416, "y": -2.2326919734974},
    "−": {"θ": 492.6224966390171, "x": -1.8217193418493, "y": -2.0521984078154},
}
"""Positions at t = 50, computed elsewhere from the paper's equations."""


@pytest.mark.parametrize("sign", END)
@pytest.mark.parametrize("name", ["θ", "x", "y"])
def test_positions_at_50(rows, sign, name):
    row = rows[f"disk ({sign}): {name}(50)"]
    assert row.verdict == AGREES
    assert row.numbers["computed"] == pytest.approx(END[sign][name], abs=1e-6)
    assert row.numbers["paper"] == pytest.approx(END[sign][name], abs=1e-6)


@pytest.mark.parametrize("sign", END)
def test_every_step_lies_in_the_discrete_dirac_structure_and_keeps_the_constraint(rows, sign):
    for quantity in ("discrete Dirac structure", "rolling constraint", "momentum p_φ"):
        assert rows[f"disk ({sign}): {quantity}"].verdict == AGREES
    assert rows[f"disk ({sign}): discrete Dirac structure"].numbers["defect"] < 1e-14
    assert rows[f"disk ({sign}): rolling constraint"].numbers["largest"] < 1e-14


def test_continuous_solution_at_50(rows):
    numbers = rows["disk, continuous: θ, x, y at t = 50"].numbers
    assert [numbers[k] for k in "θxy"] == pytest.approx([497.53121842, -1.61792584, -2.1385646], abs=1e-7)


@pytest.mark.parametrize("sign, band", [("+", (0.0, 2.62)), ("−", (-2.42, 0.09))])
def test_the_energy_drifts_although_the_paper_calls_it_good(rows, sign, band):
    row = rows[f"disk ({sign}): energy"]
    assert row.verdict == WRONG and row.numbers["verify"] == "drifts"
    assert row.numbers["slope"] * (1 if sign == "+" else -1) > 0.04
    change = rows[f"disk ({sign}): E − E(0) for t ≤ 50"].numbers
    assert (change["smallest"], change["largest"]) == pytest.approx(band, abs=0.006)


def test_the_long_run_of_plus_gains_energy_by_the_thousandfold(rows):
    """E(1000) from the paper's recursion at h = .01, iterated in plain Python."""
    q0 = rolling_disk.TWO_POINTS["q0"]
    q1 = q0 + 0.01 * rolling_disk.EXAMPLE.initial["v"]
    last, end = (peng_yoshimura.iterate_printed("+", q0, q1, 0.01, steps) for steps in (99_999, 100_000))
    v = (end - last) / 0.01
    energy = (v[0] ** 2 + v[1] ** 2) / 2 + v[2] ** 2 / 8 + v[3] ** 2 / 4 + 10 * math.sin(last[2])
    numbers = rows["disk (+): E at t = 1000, h = .01"].numbers
    assert numbers["first"] == pytest.approx(62.75, abs=1e-9)
    assert numbers["last"] == pytest.approx(energy, rel=1e-6) and energy > 1e5


def test_heisenberg_numbers(rows):
    assert [rows[f"Heisenberg: {k}(1000)"].numbers["computed"] for k in "xyz"] == pytest.approx([5001, 10000, -9999.9], abs=1e-6)
    energy = rows["Heisenberg: energy |q_{k+1} − q_k|²/2h²"].numbers
    assert energy["energy"] == pytest.approx(112.5, abs=1e-9) and energy["relative drift"] <= 5e-11
    assert rows["Heisenberg: momentum"].numbers["largest change"] < 1e-12
    assert rows["disk (+): momentum p_φ"].numbers["p_φ"] == pytest.approx(0.5 * (1.0481976 - math.pi / 3) / 1e-3, rel=1e-12)


def test_nothing_differs_and_the_table_is_complete(paper):
    assert paper.ok and len(paper.rows) == 31
    text, described = str(paper), paper.to_dict()
    assert all(row.quantity in text and (not row.note or row.note[:20] in text) for row in paper.rows)
    assert max(map(len, text.splitlines())) < 150
    assert described["figures"] == [f"figure_{k:02d}" for k in range(9, 21)] and described["ok"] is True
    assert all(isinstance(value, float | str) for row in described["rows"] for value in row["numbers"].values())


def test_figures_show_the_papers_quantities_on_its_axes(paper):
    data = {name: [np.asarray(line.get_data()) for ax in fig.axes for line in ax.lines] for name, fig in paper.figures.items()}
    axes = {name: fig.axes for name, fig in paper.figures.items()}
    for first in (9, 13):
        x, y = data[f"figure_{first:02d}"][0]
        assert math.hypot(x[-1] - x[0], y[-1] - y[0]) > 0 and axes[f"figure_{first:02d}"][0].get_aspect() == 1.0
        assert (-20 < x.min() < -15) and (14 < y.max() < 16)  # the range of the paper's axes
        t, energy = data[f"figure_{first + 1}"][0]
        assert t[-1] == pytest.approx(100, abs=0.01) and energy[0] == pytest.approx(0.06275, abs=2e-4)  # h · 62.75
        assert axes[f"figure_{first + 1}"][0].get_ylim() == (-1, 1) and axes[f"figure_{first + 1}"][1].get_yscale() == "log"
        assert np.nanmax(data[f"figure_{first + 1}"][1][1]) > 0.05  # the energy's own error is far from small
        assert data[f"figure_{first + 2}"][0][1] == pytest.approx(x)
        assert data[f"figure_{first + 3}"][0][1] == pytest.approx(0.5000244, abs=1e-6)
    t, position = data["figure_17"][1]
    assert position == pytest.approx(10 * t, abs=1e-6)
    assert [values[1][0] for values in data["figure_18"]] == pytest.approx([5, 10, -10])
    assert [values[1][-1] for values in data["figure_19"]] == pytest.approx([5, 10, -10])
    assert data["figure_20"][0][1] == pytest.approx(112.5) and np.nanmax(data["figure_20"][1][1]) < 5e-11
    assert all(label for figure in axes.values() for ax in figure for label in (ax.get_xlabel(), ax.get_ylabel()))


def test_printed_equations_by_hand():
    """One step of (60) with x and y eliminated, for a disk that rolls straight on: φ = 0, so ẋ = θ̇, 1.25 θ̈ = −10 cos θ."""
    h, start, second = 0.1, np.zeros(4), np.array([0.02, 0.0, 0.02, 0.0])
    for sign in "+-":
        end = peng_yoshimura.iterate_printed(sign, start, second, h, 2)
        theta = 2 * 0.02 - h**2 * 10 * math.cos(0.02) / 1.25
        assert end == pytest.approx([theta, 0.0, theta, 0.0], abs=1e-15)


def test_a_number_that_differs_is_said_to_differ():
    assert compared("a", 1.0, 1.0 + 1e-7, 1e-6).verdict == AGREES
    assert compared("a", 1.0, 1.0 + 1e-5, 1e-6).verdict == DIFFERS
    assert compared("a", 1.0, float("nan"), 1e-6).verdict == DIFFERS
    with pytest.raises(ValueError, match="choose one of PY"):
        reproduce("nothing")
