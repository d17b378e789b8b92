"""Large systems of the gallery beside what is known of them; each runs on the sparse engine."""

import itertools

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.sparse as sp

import dirax as dx
from dirax.gallery import hanging_chain, lc_ladder, oscillator_chain, sine_gordon, wave_line, wave_sheet


def test_toda_keeps_its_eigenvalues_and_is_the_limit_of_small_amplitudes():
    sites, toda = 160, oscillator_chain.toda_chain()
    run = {"v": np.zeros(sites), "step": 0.05, "steps": 40, "save_every": 10}
    changes = []
    for step in (0.1, 0.05):
        finer = {"step": step, "steps": round(2 / step)}
        sol = dx.simulate(
            toda, dx.Composition(dx.LagrangeDAlembert(), "yoshida4"), q=oscillator_chain.first_mode(sites, 2.0), **run | finer
        )
        assert sol.stats["engine"] == "sparse"
        values = np.array([oscillator_chain.toda_eigenvalues(*row) for row in zip(sol.q, sol.p, strict=True)])
        changes.append(np.max(np.abs(values - values[0])))
    assert changes[1] < 1e-4 and 12 < changes[0] / changes[1] < 20  # of fourth order
    linear = dx.LagrangeDirac(lambda q, v: v @ v / 2 - jnp.sum((jnp.roll(q, -1) - q) ** 2) / 2)
    for amplitude, most in ((1e-2, 1e-3), (1e-3, 1e-4)):
        of = {"q": amplitude * np.cos(np.arange(sites)), **run}
        near, other = (dx.simulate(s, dx.LagrangeDAlembert(), **of).q for s in (toda, linear))
        assert np.max(np.abs(near - other)) < most * amplitude * 20


@pytest.mark.soak
def test_ten_thousand_sites_carry_the_kink():
    errors = []
    for sites in (2500, 10_000):
        data = sine_gordon.start(sites, length=60.0, at=-10.0)
        sol = dx.simulate(
            sine_gordon.line(60.0), dx.LagrangeDAlembert(), **data, step=0.02 * 2500 / sites, steps=sites // 50, save_every=10
        )
        exact, _ = sine_gordon.kink(sine_gordon.places(sites, 60.0), sol.t[-1], start=-10.0)
        assert sol.ok and sol.stats["engine"] == "sparse"
        errors.append(np.max(np.abs(sol.q[-1] - exact)))
    assert errors[1] < 1e-5 and 12 < errors[0] / errors[1] < 20  # of second order in space and time


def test_two_links_are_a_double_pendulum():
    def lagrangian(a, w):  # angles to the vertical of links of length ½ with masses ½
        speed = (w[0] ** 2 + (w[0] ** 2 + w[1] ** 2 + 2 * w[0] * w[1] * jnp.cos(a[0] - a[1]))) / 16
        return speed + hanging_chain.GRAVITY * (2 * jnp.cos(a[0]) + jnp.cos(a[1])) / 4

    errors = []
    for step in (2e-3, 1e-3):
        run = {"step": step, "steps": round(0.3 / step)}
        chain = dx.simulate(hanging_chain.SYSTEM, dx.LagrangeDAlembert(), q=hanging_chain.straight(2, 1.0), v=np.zeros(4), **run)
        angles = dx.simulate(dx.LagrangeDirac(lagrangian), dx.LagrangeDAlembert(), q=[1.0, 1.0], v=[0.0, 0.0], **run).q[-1]
        first = np.array([np.sin(angles[0]), -np.cos(angles[0])]) / 2
        second = first + np.array([np.sin(angles[1]), -np.cos(angles[1])]) / 2
        errors.append(np.max(np.abs(chain.q[-1] - np.concatenate([first, second]))))
    assert errors[1] < 1e-5 and 3.5 < errors[0] / errors[1] < 4.5


def test_a_straight_chain_hangs_still_and_keeps_its_energy():
    still = hanging_chain.straight(500, 0.0)
    sol = dx.simulate(hanging_chain.SYSTEM, dx.LagrangeDAlembert(), q=still, v=0 * still, step=1e-3, steps=5)
    assert sol.stats["engine"] == "sparse" and np.max(np.abs(sol.q - still)) < 1e-11
    tension = -sol.multipliers[1:] / 1e-3 / 500  # of the links: the weight of what is below, (1 − s) g
    below = hanging_chain.GRAVITY * np.arange(500, 0, -1) / 500
    np.testing.assert_allclose(np.abs(tension), np.broadcast_to(below, tension.shape), rtol=1e-6)


def test_power_balances_on_a_hundred_thousand_cells():
    cells = 50_000
    drive = lambda t, x: jnp.stack([jnp.cos(3e3 * t), 1.0 + 0.0 * t])
    sol = dx.simulate(
        wave_line.line(cells), dx.DiscreteDirac(), x=wave_line.pulse(cells), inputs=drive, step=1 / cells, steps=6, save_every=3
    )
    stored, supplied, dissipated = np.moveaxis(sol.fields["power"], -1, 0)
    assert sol.ok and sol.stats["solver"] == "tridiagonal" and np.all(dissipated == 0)
    assert np.max(np.abs(stored - supplied)) <= 1e-12 * cells  # of |dH||ẋ|, which is of the size of the cells' number
    assert np.max(np.abs(supplied)) > 0.1


@pytest.mark.soak
def test_waves_go_as_d_alembert_says():
    errors = []
    for cells in (400, 800):
        sol = dx.simulate(
            wave_line.line(cells), dx.DiscreteDirac(), x=wave_line.pulse(cells, 0.3), step=1 / cells, steps=cells // 4
        )
        errors.append(np.max(np.abs(sol.x[-1] - wave_line.pulse(cells, 0.3 + 0.25))))
    assert errors[1] < 1e-3 and 3.5 < errors[0] / errors[1] < 4.5


def along_a_line(sections):
    """The greatest error of a pulse of voltage on an LC line after .3 of its length."""
    steps, width = 3 * sections // 10, sections / 20
    sol = dx.simulate(
        dx.circuit(lc_ladder.ladder(sections)), dx.DiscreteDirac(), x=lc_ladder.pulse(sections, 0.3 * sections, width),
        step=1.0, steps=steps, save_every=steps,
    )  # fmt: skip
    assert sol.ok and sol.stats["engine"] == "sparse" and sol.stats["solver"] == "band"
    return np.max(np.abs(sol.x[-1] - lc_ladder.pulse(sections, 0.3 * sections + steps, width)))


def test_a_pulse_goes_along_a_line_of_a_netlist():
    assert 1e-3 < along_a_line(300) < 2e-2


@pytest.mark.soak
def test_a_pulse_goes_along_a_line_of_ten_thousand_cells():
    errors = [along_a_line(sections) for sections in (2500, 5000, 10_000)]
    assert errors[-1] < 2e-5 and all(3.8 < a / b < 4.2 for a, b in itertools.pairwise(errors))


@pytest.mark.soak
def test_a_sheet_swings_in_its_modes():
    columns, rows, h, steps = 20, 12, 0.3, 10
    x, frequency = wave_sheet.mode(columns, rows, 1, 2)
    sol = dx.simulate(wave_sheet.sheet(columns, rows), dx.DiscreteDirac(), x=x, step=h, steps=steps)
    phase = 2 * np.arctan(frequency * h / 2) * np.arange(steps + 1)  # of the midpoint rule
    cells = columns * rows
    assert sol.stats["engine"] == "sparse" and np.ptp(sol.energy()) < 1e-14 * sol.energy()[0]
    np.testing.assert_allclose(sol.x[:, :cells], np.cos(phase)[:, None] * x[:cells], rtol=0, atol=1e-13)


def test_two_sheets_joined_along_a_side_are_one():
    def with_ports(columns, rows):
        """The structure on (x, ports): v = Λα with α = (dH, u) and v = (ẋ, −y)."""
        J, B = (matrix.toarray() for matrix in wave_sheet.structure(columns, rows))
        return np.block([[J, B], [-B.T, np.zeros((2 * rows, 2 * rows))]])

    rows, first, second = 2, with_ports(2, 2), with_ports(3, 2)
    n, m = len(first) - 2 * rows, len(second) - 2 * rows
    left = m + np.arange(rows)  # the side of the second sheet that E is given along, and F comes out of
    swapped_v, swapped_a = second.copy(), np.eye(len(second))
    swapped_v[left], swapped_a[left] = np.eye(len(second))[left], second[left]
    joined = dx.LinearDirac.from_bivector(first).compose(
        dx.LinearDirac.from_image(swapped_v, swapped_a), (n + rows + np.arange(rows)).tolist(), left.tolist()
    )
    whole, (E, F, G) = with_ports(5, 2), (10, 10, 5)
    part = lambda a, b: [*range(2 * a, 2 * b), *range(E + 2 * a, E + 2 * b), *range(E + F + a, E + F + b)]
    ports = E + F + G + np.arange(2 * rows)
    order = [*part(0, 2), *ports[:rows], *part(2, 5), *ports[rows:]]
    assert joined.equals(dx.LinearDirac.from_bivector(whole[np.ix_(order, order)]), 1e-12)


@pytest.mark.soak
def test_power_balances_on_a_sheet_of_a_hundred_thousand_cells():
    columns, rows = 400, 250
    drive = lambda t, x: jnp.concatenate([jnp.sin(t) * jnp.ones(rows), jnp.zeros(rows)])
    x, _ = wave_sheet.mode(columns, rows, 3, 5)
    sol = dx.simulate(wave_sheet.sheet(columns, rows), dx.DiscreteDirac(), x=x, inputs=drive, step=0.3, steps=6)
    energy, supplied = sol.energy(), sol.power[:, 1]
    assert np.max(np.abs(np.diff(energy) - 0.3 * supplied)) <= 1e-12 * np.max(energy) and np.max(np.abs(supplied)) > 1.0


@pytest.mark.soak
def test_a_lattice_swings_in_its_modes():
    size, h, steps = 200, 0.2, 10

    def lagrangian(q, v):
        q = jnp.pad(q.reshape(size, size), 1)
        springs = jnp.sum(jnp.diff(q[:, 1:-1], axis=0) ** 2) + jnp.sum(jnp.diff(q[1:-1], axis=1) ** 2)
        return (v @ v - springs) / 2

    angles = np.pi * np.array([3, 5]) / (size + 1)
    q = np.outer(*(np.sin(angle * np.arange(1, size + 1)) for angle in angles)).ravel()
    sol = dx.simulate(dx.LagrangeDirac(lagrangian), dx.LagrangeDAlembert(), q=q, v=0 * q, step=h, steps=steps)
    phase = 2 * np.arctan(np.hypot(*np.sin(angles / 2)) * h) * np.arange(steps + 1)
    np.testing.assert_allclose(sol.q, np.cos(phase)[:, None] * q, rtol=0, atol=1e-12)


def test_modes_of_a_sheet_turn_by_the_angle_of_the_gauss_method():
    """Of linear equations energy-preserving collocation is Gauss's, whose steps of a mode are R(iωh), of modulus 1."""
    rows, h, steps = 12, 0.4, 30
    x, frequency = wave_sheet.mode(rows, rows, 1, 2)
    sol = dx.simulate(wave_sheet.sheet(rows, rows), dx.EnergyCollocation(2), x=x, step=h, steps=steps)
    z = 1j * frequency * h
    turned = np.angle((1 + z / 2 + z**2 / 12) / (1 - z / 2 + z**2 / 12))
    expected = np.cos(turned * np.arange(steps + 1))[:, None] * x[: rows**2]
    assert sol.ok and sol.stats["engine"] == "sparse" and sol.stats["by_sites"]
    np.testing.assert_allclose(sol.x[:, : rows**2], expected, rtol=0, atol=1e-12)
    energy = sol.energy()
    assert np.max(np.abs(energy - energy[0])) < 4e-15 * energy[0]


def lc_line(sections):
    """A line of inductors and capacitors whose voltage is not in proportion to the charge: x = (charges, fluxes)."""
    along = sp.eye_array(sections, format="csr") - sp.eye_array(sections, k=-1, format="csr")
    J = sp.csr_matrix(sp.block_array([[None, along.T], [-along, None]]))
    return dx.PortHamiltonian(lambda x: x @ x / 2 + 0.1 * jnp.sum(x[:sections] ** 4), J)


@pytest.mark.soak
def test_a_nonlinear_line_of_ten_thousand_sections_keeps_its_energy():
    sections = 10_000
    x = lc_ladder.pulse(sections, 3000.0, 20.0)
    sol = dx.simulate(lc_line(sections), dx.EnergyCollocation(2), x=x, step=0.5, steps=20, save_every=10)
    energy = sol.energy()
    assert sol.ok and sol.stats["engine"] == "sparse" and sol.stats["by_sites"]
    assert np.max(np.abs(energy - energy[0])) < 1e-14 * energy[0] and sol.stats["energy_defect"] < 1e-14
    place = lambda x: np.sum(np.arange(sections) * x[:sections] ** 2) / np.sum(x[:sections] ** 2)
    assert 9 < place(sol.x[-1]) - place(sol.x[0]) < 13  # a section in a unit of time, and faster where the voltage is high
