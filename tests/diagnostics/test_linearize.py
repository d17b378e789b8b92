"""Linear equations of small motions against those written by hand."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dirax as dx


def test_a_pendulum_down_and_up():
    system = dx.LagrangeDirac(lambda q, v: v @ v / 2 + 4.0 * jnp.cos(q[0]))
    down = dx.linearize(system, {"q": [0.0], "v": [0.0]})
    assert down.eigenvalues == pytest.approx([2j, -2j], abs=1e-14) and down.stable and down.multipliers is None
    up = dx.linearize(system, {"q": [np.pi], "v": [0.0]})
    assert up.eigenvalues == pytest.approx([2.0, -2.0], abs=1e-14) and not up.stable
    assert np.abs(up.modes[1] / up.modes[0]) == pytest.approx([2.0, 2.0])


def test_it_prints_eigenvalues_multipliers_and_whether_it_is_stable():
    system = dx.LagrangeDirac(lambda q, v: v @ v / 2 + 4.0 * jnp.cos(q[0]))
    down = str(dx.linearize(system, {"q": [0.0], "v": [0.0]}))
    assert "equations of small motions: stable" in down and "2i\n" in down and down.endswith("− 2i") and "multiplier" not in down
    stepped = dx.linearize(system, {"q": [np.pi], "v": [0.0]}, dx.LagrangeDAlembert(), step=0.1)
    growing = (1 + 0.1) / (1 - 0.1)  # of the midpoint rule, for the rate 2: (1 + hλ/2)/(1 − hλ/2)
    lines = repr(stepped).splitlines()
    assert "of a step of 0.1: unstable" in lines[0] and lines[1].split() == ["eigenvalue", "multiplier", "its", "size"]
    assert lines[3].split() == [f"{np.log(growing) / 0.1:.6g}", f"{growing:.6g}", f"{growing:.6g}"]


def test_a_rod_with_its_length_as_a_constraint_swings_as_fast():
    """In x and y with x² + y² = 1 the tension counts: the frequency is √g, and there are two directions of four."""
    system = dx.LagrangeDirac(lambda q, v: v @ v / 2 - 9.0 * q[1], holonomic=lambda q: jnp.array([q @ q - 1.0]))
    found = dx.linearize(system, {"q": [0.0, -1.0], "v": [0.0, 0.0]})
    assert found.matrix.shape == (2, 2) and found.eigenvalues == pytest.approx([3j, -3j], abs=1e-14)


@pytest.mark.soak
def test_a_constraint_said_twice_changes_nothing():
    once = lambda q: jnp.array([q @ q - 1.0])
    twice = lambda q: jnp.array([q @ q - 1.0, 2.0 * q @ q - 2.0])
    place, found = {"q": [0.0, -1.0], "v": [0.0, 0.0]}, []
    for holonomic in (once, twice):
        system = dx.LagrangeDirac(lambda q, v: v @ v / 2 - 9.0 * q[1], holonomic=holonomic)
        found.append(dx.linearize(system, place, dx.LagrangeDAlembert(), step=0.1).eigenvalues)
        assert dx.linearize(system, place).eigenvalues == pytest.approx([3j, -3j], abs=1e-13)
    assert found[0] == pytest.approx(found[1], abs=1e-12) and found[0] == pytest.approx([3j, -3j], abs=0.05)


def test_forces_and_parameters():
    system = dx.LagrangeDirac(lambda q, v, p: v @ v / 2 - p["k"] * q @ q / 2, forces=lambda t, q, v, p: -p["c"] * v)
    found = dx.linearize(system, {"q": [0.0], "v": [0.0]}, params={"k": 4.0, "c": 5.0})
    assert found.eigenvalues == pytest.approx([-1.0, -4.0], abs=1e-13)


def test_a_circular_orbit_is_a_relative_equilibrium_of_turns():
    """Kepler in the frame that turns: 0 of the symmetry's quotient, and ±iω of the radius."""
    system = dx.LagrangeDirac(lambda q, v: v @ v / 2 + 1.0 / jnp.sqrt(q @ q))
    turns = lambda q: jnp.array([-q[1], q[0]])
    place = {"q": [2.0, 0.0], "v": [0.0, np.sqrt(0.5)]}
    found = dx.linearize(system, place, symmetries={"turns": turns})
    rate = np.sqrt(1 / 8)
    assert found.eigenvalues == pytest.approx([1j * rate, 0.0, -1j * rate], abs=1e-12)
    with pytest.raises(ValueError, match="no relative equilibrium"):
        dx.linearize(system, place)
    with pytest.raises(ValueError, match=r"must be symmetries"):
        dx.linearize(system, {"q": [2.0, 0.0], "v": [0.0, 0.0]} | place, symmetries=[turns, lambda q: jnp.ones(2)])


def test_a_symmetry_that_is_not_linear_in_q():
    """The orbit in log-polar coordinates (log r, φ) turned by a generator that bends: (0, 1) pushed by φ ↦ sinh φ."""
    lagrangian = lambda q, v: jnp.exp(2 * q[0]) * (v[0] ** 2 + v[1] ** 2 / jnp.sqrt(1 + q[1] ** 2) ** 2) / 2 + jnp.exp(-q[0])
    system = dx.LagrangeDirac(lagrangian)
    turns = lambda q: jnp.stack([jnp.zeros(()), jnp.sqrt(1 + q[1] ** 2)])
    place = {"q": [np.log(2.0), 0.7], "v": [0.0, np.sqrt(1 / 8) * np.sqrt(1 + 0.49)]}
    found = dx.linearize(system, place, symmetries=[turns])
    rate = np.sqrt(1 / 8)
    assert found.eigenvalues == pytest.approx([1j * rate, 0.0, -1j * rate], abs=1e-12)


@pytest.mark.parametrize("scheme", [dx.LagrangeDAlembert(), dx.Collocation(2), dx.Composition(dx.LagrangeDAlembert(), "suzuki4")])
def test_a_step_has_the_multipliers_of_its_stability_function(scheme):
    """Of an oscillator: Cayley's for midpoint, the (2, 2) Padé approximant for two Gauss nodes."""
    system, z = dx.LagrangeDirac(lambda q, v: v @ v / 2 - q @ q / 2), 0.3j
    found = dx.linearize(system, {"q": [0.0], "v": [0.0]}, scheme, step=0.3)
    midpoint = lambda z: (1 + z / 2) / (1 - z / 2)
    gamma = 1 / (4 - 4 ** (1 / 3))
    expected = {
        dx.LagrangeDAlembert: midpoint(z),
        dx.Collocation: (1 + z / 2 + z * z / 12) / (1 - z / 2 + z * z / 12),
        dx.Composition: midpoint(gamma * z) ** 4 * midpoint((1 - 4 * gamma) * z),
    }[type(scheme)]
    assert found.multipliers == pytest.approx([expected, np.conj(expected)], abs=1e-13)
    assert found.eigenvalues == pytest.approx(np.log([expected, np.conj(expected)]) / 0.3, abs=1e-12)


def test_a_system_on_its_final_manifold():
    """A port-Hamiltonian oscillator that decays: x in place of q and v."""
    system = dx.PortHamiltonian(
        lambda x: x @ x / 2, J=lambda x: jnp.array([[0.0, 1.0], [-1.0, 0.0]]), R=lambda x: jnp.diag(jnp.array([0.0, 0.2]))
    )
    found = dx.linearize(system, {"x": [0.0, 0.0]})
    assert found.eigenvalues == pytest.approx(np.roots([1.0, 0.2, 1.0]), abs=1e-13)
    with pytest.raises(ValueError, match="no relative equilibrium"):
        dx.linearize(system, {"x": [0.5, 0.0]})
    with pytest.raises(TypeError, match="with a Lagrangian"):
        dx.linearize(system, {"x": [0.0, 0.0]}, dx.DiscreteDirac(), step=0.1)


@pytest.mark.parametrize("at", [{"x": [1.0, 0.0]}, {"q": [1.0, 0.0]}, {}, [1.0, 0.0]])
def test_a_place_of_other_names_is_refused(at):
    with pytest.raises(ValueError, match=r"is linearized is \{\"q\": …, \"v\": …\}, but .* was given"):
        dx.linearize(dx.LagrangeDirac(lambda q, v: v @ v / 2 - q @ q / 2), at)


@pytest.mark.parametrize("step", [1e-2, 1e-4])
def test_a_step_along_symmetries_that_turn_is_refused_for_what_it_is(step):
    """A spherical pendulum that goes round at the angle .8: ω² = Ω² (1 + 3 cos² .8), Ω² = 1/cos .8."""
    system = dx.LagrangeDirac(lambda q, v: v @ v / 2 - q[2], holonomic=lambda q: jnp.array([q @ q - 1.0]))
    turning = np.sqrt(1 / np.cos(0.8))
    at = {"q": [np.sin(0.8), 0.0, -np.cos(0.8)], "v": [0.0, turning * np.sin(0.8), 0.0]}
    about = [lambda q: jnp.stack([-q[1], q[0], 0.0])]
    swing = turning * np.sqrt(1 + 3 * np.cos(0.8) ** 2)
    np.testing.assert_allclose(dx.linearize(system, at, symmetries=about).eigenvalues.imag, [swing, 0.0, -swing], atol=1e-12)
    with pytest.raises(ValueError, match="symmetries that turn are taken as shifts"):
        dx.linearize(system, at, dx.Collocation(2, nodes="lobatto"), step=step, symmetries=about)


def test_a_scheme_needs_a_step():
    system = dx.LagrangeDirac(lambda q, v: v @ v / 2)
    with pytest.raises(ValueError, match="give scheme= and step= together"):
        dx.linearize(system, {"q": [0.0], "v": [0.0]}, dx.LagrangeDAlembert())


def in_units(length, mass, time):
    """Two linked pendulums in x and y with friction, and a planet, with all numbers in units by powers of two."""

    def lagrangian(q, v, p):
        return p["m"] * (v @ v) / 2 - p["m"] * p["g"] * (q[1] + q[3])

    links = lambda q, p: jnp.stack([q[:2] @ q[:2] - p["l"] ** 2, (q[2:] - q[:2]) @ (q[2:] - q[:2]) - p["l"] ** 2])
    pendulums = dx.LagrangeDirac(lagrangian, holonomic=links, forces=lambda t, q, v, p: -p["c"] * v)
    planet = dx.LagrangeDirac(lambda q, v, p: p["m"] * ((v @ v) / 2 + p["mu"] / jnp.sqrt(q @ q)))
    params = {"l": length, "m": 1.5 * mass, "g": 9.0 * length / time**2, "c": 0.2 * mass / time, "mu": length**3 / time**2}
    hanging = {"q": np.array([0.0, -1.0, 1e-17, -2.0]) * length, "v": np.zeros(4)}
    orbit = {"q": np.array([2.0, 0.0]) * length, "v": np.array([0.0, np.sqrt(0.5)]) * length / time}
    return pendulums, hanging, planet, orbit, params, lambda q: jnp.array([-q[1], q[0]])


@pytest.mark.parametrize("units", [(2.0**-30, 2.0**-86, 2.0**-40), (2.0**37, 2.0**81, 2.0**25), (2.0**-50, 2.0**90, 2.0**3)])
@pytest.mark.soak_of(but=["units2"])
def test_linear_equations_in_other_units(units):
    """Nanometres and planets in metres: an orbit was called an equilibrium at rest, since 6e-3 is small beside 3e4."""
    found = {}
    for unit in ((1.0, 1.0, 1.0), units):
        pendulums, hanging, planet, orbit, params, turns = in_units(*unit)
        midpoint, step = dx.LagrangeDAlembert(), 0.1 * unit[2]
        found[unit] = rates = [
            dx.linearize(pendulums, hanging, params=params),
            dx.linearize(pendulums, hanging, midpoint, step=step, params=params),
            dx.linearize(planet, orbit, symmetries=[turns], params=params),
        ]
        assert [one.stable for one in rates] == [True] * 3
        with pytest.raises(ValueError, match="no relative equilibrium"):
            dx.linearize(planet, orbit, params=params)
        with pytest.raises(ValueError, match="no relative equilibrium"):
            dx.linearize(pendulums, hanging | {"q": np.array([0.6, -0.8, 0.6, -1.8]) * unit[0]}, params=params)
    for plain, scaled in zip(*found.values(), strict=True):
        assert scaled.eigenvalues * units[2] == pytest.approx(plain.eigenvalues, rel=1e-9, abs=1e-9)


def coupled(q, v, p):
    """A distance and an angle."""
    strain = q[0] ** 2 + 0.6 * p["l"] * q[0] * q[1] + 2.0 * (p["l"] * q[1]) ** 2
    return (p["m"] * v[0] ** 2 + p["J"] * v[1] ** 2 - p["k"] * strain) / 2


@pytest.mark.parametrize("scheme", [dx.LagrangeDAlembert(), dx.PlusLagrangeDirac(), dx.Collocation(2)])
@pytest.mark.soak_of("scheme0")
def test_a_step_about_zero_in_other_units(scheme):
    """A distance and an angle at rest, where no number says how large they are: μ = exp(iωh) of det(K − ω²M) = 0, up to h²."""
    rates = np.sqrt(np.linalg.eigvals(np.linalg.solve(np.diag([1.3, 0.4]), [[2.0, 0.6], [0.6, 4.0]])))
    for l in (1.0, 2.0**-20, 2.0**-30, 2.0**50):
        params = {"m": 1.3, "J": 0.4 * l**2, "k": 2.0, "l": l}
        found = dx.linearize(dx.LagrangeDirac(coupled), {"q": np.zeros(2), "v": np.zeros(2)}, scheme, step=1e-3, params=params)
        assert found.stable and np.abs(found.multipliers) == pytest.approx(np.ones(4), abs=1e-11)
        assert np.sort(found.eigenvalues.imag) == pytest.approx(np.sort([*rates, *-rates]), rel=1e-5)
        modes = found.modes[:, np.argmax(found.eigenvalues.imag)]
        assert np.abs(modes[0] / modes[1] / l) == pytest.approx(0.6 / (1.3 * rates.max() ** 2 - 2.0), rel=1e-5)


def test_a_weight_that_falls_from_zero_is_at_no_equilibrium_in_any_units():
    falling = dx.LagrangeDirac(lambda q, v, g: v @ v / 2 - g * q[0])
    for g in (9.8, 2.0**-60, 2.0**60):
        with pytest.raises(ValueError, match="no relative equilibrium"):
            dx.linearize(falling, {"q": np.zeros(1), "v": np.zeros(1)}, params=g)


@pytest.mark.parametrize("scheme", [None, dx.LagrangeDAlembert(), dx.Composition(dx.LagrangeDAlembert(), "suzuki4")])
@pytest.mark.parametrize("unit", [1.0, 2.0**-40])
@pytest.mark.soak_of(but=["1.0-None", "9.094947017729282e-13-None"])
def test_a_slow_motion_that_grows_is_seen_beside_a_fast_one(scheme, unit):
    """A pendulum up or down beside a mode of 1 MHz, and two masses on a spring, which move together as if free."""
    fast = 2 * np.pi * 1e6 / unit
    params = {"g": 9.81 / unit**2, "k": fast**2}
    pendulum = lambda up: dx.LagrangeDirac(lambda q, v, p: (v @ v - p["k"] * q[1] ** 2) / 2 - up * p["g"] * jnp.cos(q[0]))
    pair = dx.LagrangeDirac(lambda q, v, p: (v @ v - p["k"] * (q[1] - q[0]) ** 2) / 2)
    step = {} if scheme is None else {"scheme": scheme, "step": 0.1 / fast}
    verdicts = [
        dx.linearize(system, {"q": np.zeros(2), "v": np.zeros(2)}, **step, params=params).stable
        for system in (pendulum(1.0), pendulum(-1.0), pair)
    ]
    assert verdicts == [False, True, True]


@pytest.mark.parametrize("damping", [-1.0, 0.0, 1.0])
def test_weak_damping_of_a_fast_motion_says_whether_it_grows(damping):
    """Rates of a millionth of the frequency and less."""
    system = dx.LagrangeDirac(lambda q, v: (v @ v - 1e12 * q @ q) / 2, forces=lambda t, q, v: -damping * v)
    place = {"q": [0.0], "v": [0.0]}
    assert dx.linearize(system, place).stable == (damping >= 0.0)
    assert dx.linearize(system, place, dx.LagrangeDAlembert(), step=1e-8).stable == (damping >= 0.0)


def leaning(q, v):
    """Masses that depend on the place, in a field that pushes a one-form at its equilibrium."""
    kinetic = (1 + 0.3 * q[0] ** 2) * v[0] ** 2 / 2 + v[1] ** 2 / 2 + 0.7 * v[2] ** 2 + 0.3 * q[1] * v[0] - 0.2 * q[0] * v[2]
    return kinetic - q[0] ** 2 - q[1] ** 2 / 2 - 1.5 * q[2] ** 2 - 0.2 * q[0] * q[1] - 0.5 * q[0]


ONE_FORM = lambda q: jnp.array([[0.4 + 0.3 * q[1], 0.2 * q[0], 1.0]])
LEANING = dx.LagrangeDirac(leaning, ONE_FORM, forces=lambda t, q, v: -0.1 * v)


@pytest.fixture(scope="module")
def at_rest():
    """q = (a, b, .3) with ∂L/∂q = Wᵀλ, by Newton's method for (a, b, λ)."""

    def defect(z):
        q = jnp.stack([z[0], z[1], 0.3])
        return jax.grad(leaning)(q, jnp.zeros(3)) - ONE_FORM(q)[0] * z[2]

    linearized, z = jax.jit(lambda z: (jax.jacobian(defect)(z), defect(z))), np.array([0.0, 0.0, -0.5])
    for _ in range(20):
        z = z - np.linalg.solve(*linearized(z))
    return {"q": np.array([z[0], z[1], 0.3]), "v": np.zeros(3)}


@pytest.mark.parametrize(
    ("scheme", "error"),
    [
        (dx.Collocation(2, nodes="lobatto"), 2e-4),
        (dx.Collocation(3, nodes="lobatto"), 1e-6),
        (dx.EnergyCollocation(2, points=2), 1e-6),
    ],
)
@pytest.mark.soak_of(but=["scheme0-0.0002"])
def test_steps_with_multipliers_or_the_energy_in_their_state(scheme, error, at_rest):
    """A constraint that pushes where the system is at rest, and depends on the place. The multiplier in the state of collocation
    has an eigenvalue of its own, near 1 or −1, that is none of the system."""
    exact = dx.linearize(LEANING, at_rest).eigenvalues
    found = dx.linearize(LEANING, at_rest, scheme, step=0.02)
    assert found.stable and exact.shape == found.eigenvalues.shape == (5,)
    np.testing.assert_allclose(found.eigenvalues, exact, atol=error)


def test_what_grows_like_t_is_not_called_stable():
    """A free particle, one in a round valley, which moves along it, and one of a molecule's mass that does neither."""
    word = lambda lagrangian, q: str(dx.linearize(dx.LagrangeDirac(lagrangian), {"q": q, "v": np.zeros(len(q))})).splitlines()[0]
    free, valley = lambda q, v: v @ v / 2, lambda q, v: v @ v / 2 - (q @ q - 1) ** 2
    assert "may grow like t" in word(free, [0.3]) and "may grow like t" in word(valley, [1.0, 0.0])
    assert ": stable," in word(lambda q, v: 1e-26 * v @ v / 2 - 1e3 * q @ q, [0.0, 0.0])


@pytest.mark.parametrize(
    ("at", "text"),
    [
        ({"q": np.zeros((1, 2)), "v": np.zeros((1, 2))}, r"at one place, but q has shape \(1, 2\)"),
        ({"q": [0.0, np.nan], "v": [0.0, 0.0]}, r"q must be finite, but q\[1\] is nan"),
        ({"q": [0.0, 0.0, 0.0], "v": [0.0, 0.0]}, "the same length n"),
        ({"q": 0.0, "v": 0.0}, r"q must have shape \(n,\)"),
    ],
)
def test_a_place_that_is_none_is_said(at, text):
    with pytest.raises(ValueError, match=text):
        dx.linearize(dx.LagrangeDirac(lambda q, v: v @ v / 2 - q @ q), at)


def rolling():
    return dx.LagrangeDirac(
        lambda q, v: (v[0] ** 2 + v[1] ** 2) / 2 + v[2] ** 2 / 8 + v[3] ** 2 / 4,
        lambda q: jnp.stack([jnp.stack([1.0, 0.0, -jnp.cos(q[3]), 0.0]), jnp.stack([0.0, 1.0, -jnp.sin(q[3]), 0.0])]),
    )


OF_THE_DISK = [*(lambda q, k=k: jnp.zeros(4).at[k].set(1.0) for k in range(3)), lambda q: jnp.stack([-q[1], q[0], 0.0, 1.0])]


def test_a_disk_that_rolls_straight_on_drifts_whatever_its_heading():
    """All eigenvalues are zero, and the roundoff of the largest was taken for a rate: the verdicts changed with the heading. The
    position goes like t² times a rate of turning; nothing of that is left on the quotient."""
    disk, at = rolling(), lambda a, u: {"q": [0.0, 0.0, 0.0, a], "v": [u * np.cos(a), u * np.sin(a), u, 0.0]}
    for angle, speed in zip(np.linspace(0.1, 6.1, 12), np.geomspace(0.01, 100.0, 12), strict=True):
        found = dx.linearize(disk, at(angle, speed))
        assert found.stable and found.defective and found.matrix.shape == (6, 6)
        power = np.linalg.matrix_power(found.matrix / np.abs(found.matrix).max(), 3)
        np.testing.assert_allclose(power, 0.0, atol=1e-14)
        assert np.linalg.matrix_rank(found.matrix, tol=1e-9 * np.abs(found.matrix).max()) == 3
    quotient = dx.linearize(disk, at(0.5, 1.0), symmetries=OF_THE_DISK)
    assert quotient.stable and not quotient.defective and quotient.matrix.shape == (2, 2)


def test_a_disk_that_turns_on_the_spot_moves_along_a_symmetry():
    """Its constraints turn with it, which was found out afterwards only, as an error of the library."""
    at = {"q": [0.0, 0.0, 0.0, 2.0], "v": [0.0, 0.0, 0.0, 2.0]}
    with pytest.raises(ValueError, match=r"no relative equilibrium: .* or the symmetries="):
        dx.linearize(rolling(), at)
    found = dx.linearize(rolling(), at, symmetries=OF_THE_DISK[3:])
    assert found.stable and found.defective
    np.testing.assert_allclose(np.sort(found.eigenvalues.imag), [-2.0, 0.0, 0.0, 0.0, 2.0], atol=1e-7)


def test_a_ridge_whose_curvature_changes_on_the_way_is_no_equilibrium():
    """The acceleration is zero all along it."""
    ridge = dx.LagrangeDirac(lambda q, v: v @ v / 2 - (1 + 0.5 * jnp.sin(q[0])) * q[1] ** 2 / 2)
    with pytest.raises(ValueError, match="no relative equilibrium"):
        dx.linearize(ridge, {"q": [0.0, 0.0], "v": [1.0, 0.0]})
    assert dx.linearize(ridge, {"q": [0.0, 0.0], "v": [0.0, 0.0]}).stable


@pytest.mark.parametrize("turn", [[1.0, 0.0, 0.0, 0.0], [0.5, 0.5, -0.5, 0.5], [0.1, -0.7, 0.5, -0.5]])
def test_one_free_direction_among_several_zeros_is_found_however_a_body_is_turned(turn):
    """A body in a fluid that moves along its axis of largest added mass, and may begin to turn about it: of five zero eigenvalues
    one has no eigenvector of its own."""
    added, inertia = jnp.array([2.0, 3.0, 4.0]), jnp.array([1.0, 1.5, 0.8])

    def lagrangian(q, v):
        w, r, velocity = q[0], q[1:4], v[4:]
        rate = 2 * (w * v[1:4] - v[0] * r - jnp.cross(r, v[1:4]))
        own = velocity * (w * w - r @ r) + 2 * r * (r @ velocity) - 2 * w * jnp.cross(r, velocity)
        return own @ (added * own) / 2 + rate @ (inertia * rate) / 2 + (q[:4] @ v[:4]) ** 2 / 2

    body = dx.LagrangeDirac(lagrangian, holonomic=lambda q: jnp.stack([q[:4] @ q[:4] - 1]))
    q = np.array([*turn, 0.3, -0.4, 0.7])
    v = np.concatenate([np.zeros(4), 1.3 * np.array(dx.SO3().matrix(q[:4]))[:, 2]])
    shifts = [lambda q, k=k: jnp.zeros(7).at[k].set(1.0) for k in (4, 5, 6)]
    found = dx.linearize(body, {"q": q, "v": v}, symmetries=shifts)
    assert found.stable and found.defective


@pytest.mark.parametrize(
    "system",
    [
        dx.ManifoldLagrangian(lambda q, v: v @ v / 2 - q[2], dx.Sphere(3)),
        dx.EulerPoincare(dx.SO3(), lambda xi: xi @ (jnp.array([1.0, 2.0, 3.0]) * xi) / 2),
    ],
)
def test_systems_that_are_linearized_as_others_say_as_which(system):
    with pytest.raises(TypeError, match=r"is not linearized: .*lie_poisson\(\)"):
        dx.linearize(system, {"x": np.zeros(3)})


def test_a_lie_poisson_system_is_linearized():
    """About the middle axis of inertia, ω = (0, 1, 0)."""
    top = dx.EulerPoincare(dx.SO3(), lambda xi: xi @ (jnp.array([1.0, 2.0, 3.0]) * xi) / 2).lie_poisson()
    found = dx.linearize(top, {"x": [0.0, 2.0, 0.0]})
    np.testing.assert_allclose(found.eigenvalues[0], np.sqrt((2 - 1) * (3 - 2) / (1 * 3)), rtol=1e-12)
    assert not found.stable


@pytest.mark.parametrize(
    ("system", "at", "rates"),
    [
        (dx.LagrangeDirac(lambda q, v: v[0] ** 2 / 2 + q[1] * v[0] - q @ q / 2), [0.0, 0.0], [np.sqrt(0.5)]),
        (dx.LagrangeDirac(lambda q, v: q[1] * v[0] - (q[0] ** 2 + 4 * q[1] ** 2) / 2), [0.0, 0.0], [2.0]),
        (
            dx.PhaseSpaceLagrangian(lambda q: jnp.stack([q[1], 0.0 * q[0]]), lambda q: (q[0] ** 2 + 4 * q[1] ** 2) / 2),
            [0.0, 0.0],
            [2.0],
        ),
        (
            dx.LagrangeDirac(
                lambda q, v: q[1] * v[0] - (q[0] ** 2 + q[1] ** 2) / 2 + v[2] ** 2 / 2, lambda q: jnp.array([[-1.0, 0.0, 1.0]])
            ),
            [0.0, 0.0, 0.0],
            [np.sqrt(0.5), 0.0],
        ),
        (
            dx.LagrangeDirac(lambda q, v: (v[0] ** 2 + v[1] ** 2) / 2 - q[1] - q[2] * (q[0] ** 2 + q[1] ** 2 - 1)),
            [0.0, -1.0, 0.5],
            [1.0],
        ),
    ],
    ids=["one primary constraint", "linear in v", "the same on phase space", "with a one-form", "a tension that is a coordinate"],
)
def test_singular_lagrangians_are_linearized_on_their_final_manifold(system, at, rates):
    """Accelerations of least squares were taken for theirs: the second has ±2i, and 0, 0, 0, 0 were found."""
    found = dx.linearize(system, {"q": at, "v": [0.0] * len(at)})
    expected = sorted({sign * rate for rate in rates for sign in (-1, 1)})
    np.testing.assert_allclose(sorted(found.eigenvalues.imag), expected, atol=1e-12)
    np.testing.assert_allclose(found.eigenvalues.real, 0.0, atol=1e-12)


GAUGE = dx.LagrangeDirac(lambda q, v: (v[0] - v[1]) ** 2 / 2 - (q[0] - q[1]) ** 2 / 2)
ROD = dx.LagrangeDirac(lambda q, v: v @ v / 2 - q[1], holonomic=lambda q: jnp.stack([q @ q - 1]))
SKATE = dx.LagrangeDirac(lambda q, v: v @ v / 2, lambda q: jnp.stack([jnp.sin(q[2]), -jnp.cos(q[2]), 0 * q[0]])[None])
DRIVEN = dx.LagrangeDirac(lambda t, q, v: v @ v / 2 - (q[0] - jnp.sin(t)) ** 2 / 2)
CURRENT = dx.ImplicitSystem(E=lambda x: jnp.array([[1.0, 0.0]]), f=lambda x: jnp.stack([x[1] - x[0]]))


@pytest.mark.parametrize(
    ("system", "at", "text"),
    [
        (GAUGE, {"q": [0.0, 0.0], "v": [0.0, 0.0]}, "do not determine a motion"),
        (CURRENT, {"x": [0.0, 0.0]}, "no linear equations here .gauge freedom"),
        (ROD, {"q": [0.0, -1.2], "v": [0.0, 0.0]}, "off the constraint, whose residual is"),
        (SKATE, {"q": [0.0, 0.0, 0.0], "v": [1.0, 0.5, 0.0]}, "off the constraint, whose residual is"),
        (DRIVEN, {"q": [np.sin(0.3)], "v": [0.0], "t": 0.3}, "no relative equilibrium"),
    ],
    ids=["gauge freedom", "an input that is free", "off a rod", "sideways", "at rest for an instant"],
)
def test_places_without_linear_equations_are_refused(system, at, text):
    with pytest.raises(ValueError, match=text):
        dx.linearize(system, at)


def test_a_rotation_that_is_no_symmetry_is_refused_at_rest_too():
    system = dx.LagrangeDirac(lambda q, v: v @ v / 2 - q @ q / 2 + 0.1 * q[0] * q[1])
    with pytest.raises(ValueError, match="must be symmetries of the system, but along number 0 the Lagrangian changes"):
        dx.linearize(system, {"q": [0.0, 0.0], "v": [0.0, 0.0]}, symmetries=[lambda q: jnp.stack([-q[1], q[0]])])


def test_chains_of_four_that_grow_by_powers_of_the_time_are_not_called_unstable():
    """A truck with a trailer: rate of steering → steering → heading → sideways; roundoff makes 10⁻⁴ of its eigenvalue zero."""

    def blades(q):
        front = jnp.stack([-jnp.sin(q[2] + q[3]), jnp.cos(q[2] + q[3]), jnp.cos(q[3]), 0.0, 0.0])
        rear = jnp.stack([-jnp.sin(q[2]), jnp.cos(q[2]), 0.0, 0.0, 0.0])
        return jnp.stack([rear, front, jnp.stack([-jnp.sin(q[4]), jnp.cos(q[4]), 0.0, 0.0, -0.8])])

    masses = jnp.array([2.0, 2.0, 0.6, 0.1, 0.4])
    truck = dx.LagrangeDirac(lambda q, v: v @ (masses * v) / 2, blades)
    for angle in (0.0, 0.4, 1.1, 2.2):
        forward = {"q": [0.0, 0.0, angle, 0.0, angle], "v": [np.cos(angle), np.sin(angle), 0.0, 0.0, 0.0]}
        found = dx.linearize(truck, forward)
        assert found.stable and found.defective
        assert np.min(found.eigenvalues.real) == pytest.approx(-1 / 0.8, rel=1e-9)
        backward = forward | {"v": -np.array(forward["v"])}
        assert not dx.linearize(truck, backward).stable


@pytest.mark.parametrize("scheme", [None, dx.LagrangeDAlembert()])
def test_a_coordinate_without_mass_that_a_constraint_moves_is_no_singular_one(scheme):
    system = dx.LagrangeDirac(lambda q, v: v[0] ** 2 / 2 - q[0] ** 2 / 2, lambda q: jnp.array([[1.0, -1.0]]))
    step = {} if scheme is None else {"scheme": scheme, "step": 0.1}
    found = dx.linearize(system, {"q": [0.0, 0.0], "v": [0.0, 0.0]}, **step)
    frequency = 1.0 if scheme is None else 2 * np.arctan(0.05) / 0.1
    np.testing.assert_allclose(np.sort(found.eigenvalues.imag), [-frequency, 0.0, frequency], atol=1e-9)


def test_steps_of_their_own_length_are_not_linearized():
    oscillator = dx.LagrangeDirac(lambda q, v: v @ v / 2 - q @ q / 2)
    with pytest.raises(TypeError, match=r"dx\.VariableSteps has steps of their own length"):
        scheme = dx.VariableSteps(dx.LagrangeDAlembert(), lambda q: 1 + q @ q)
        dx.linearize(oscillator, {"q": [0.0], "v": [0.0]}, scheme, step=0.1)
