"""A change of units changes nothing but the units: scaled by powers of two, every result is the same to the last bit."""

import copy
import dataclasses
import functools
from collections.abc import Callable
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dirax as dx


@dataclass(frozen=True)
class Units:
    """Lengths, masses and times by powers of two: 2^length, 2^mass, 2^time."""

    length: int = 0
    mass: int = 0
    time: int = 0

    def of(self, dimension: tuple[int, int, int]) -> float:
        """The unit of a quantity of the dimension (length, mass, time)."""
        exponents = zip((self.length, self.mass, self.time), dimension, strict=True)
        return 2.0 ** sum(a * b for a, b in exponents)


ONE, LENGTH, MASS, TIME = (0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)
SPEED, ACCELERATION, STIFFNESS = (1, 0, -1), (1, 0, -2), (0, 1, -2)


known = functools.cache(lambda make: make())
"""The system that `make` makes, the same one every time: what was traced of it is found again."""


@dataclass(frozen=True)
class Measured:
    """A system whose numbers are all parameters, with the dimensions of its coordinates and of these; `run` has it in other
    units."""

    system: Callable
    coordinates: tuple
    data: dict
    params: dict
    step: float

    def run(self, units: Units, scheme, engine: str, system=None, **more):
        """The run in these units, of a system that may be known from other runs; or of this one."""
        q = np.array([units.of(d) for d in self.coordinates])
        rate = q / units.of(TIME)
        data = {name: np.asarray(a) * (q if name == "q" else rate) for name, a in self.data.items()}
        params = {name: value * units.of(dimension) for name, (value, dimension) in self.params.items()}
        settings = {"step": self.step * units.of(TIME), "steps": 60, "engine": engine} | more
        return dx.simulate(system or known(self.system), scheme, **data, params=params, **settings)

    def of_p(self, units: Units) -> np.ndarray:
        """The units of p: those of mass · length²/time by those of q."""
        return units.of((2, 1, -1)) / np.array([units.of(d) for d in self.coordinates])


def pendulum():
    return dx.LagrangeDirac(
        lambda q, v, params: params["m"] * (v @ v) / 2 - params["m"] * params["g"] * q[1],
        holonomic=lambda q, params: jnp.stack([q @ q - params["l"] ** 2]),
    )


def sleigh():
    def lagrangian(q, v, params):
        turn = params["m"] * params["a"] ** 2 * v[2] ** 2
        return params["m"] * (v[0] ** 2 + v[1] ** 2) / 2 + turn / 2 - params["k"] * (q[0] ** 2 + q[1] ** 2) / 2

    def forms(q, params):
        return jnp.stack([jnp.stack([-jnp.sin(q[2]), jnp.cos(q[2]), -params["a"]])])

    return dx.LagrangeDirac(lagrangian, forms, forces=lambda t, q, v, params: -params["c"] * v * jnp.array([1.0, 1.0, 0.0]))


def kepler():
    return dx.LagrangeDirac(lambda q, v, params: params["m"] * (v @ v) / 2 + params["m"] * params["mu"] / jnp.sqrt(q @ q))


PLANE = {"q": [0.6, -0.8], "v": [0.8, 0.6]}
PENDULUM = Measured(pendulum, (LENGTH, LENGTH), PLANE, {"l": (1.0, LENGTH), "m": (1.5, MASS), "g": (9.8, ACCELERATION)}, 0.02)
SLEIGH = Measured(
    sleigh,
    (LENGTH, LENGTH, ONE),
    {"q": [1.0, 0.1, 0.0], "v": [0.3, 0.35, 0.5]},
    {"m": (1.3, MASS), "a": (0.7, LENGTH), "k": (2.0, STIFFNESS), "c": (0.1, (0, 1, -1))},
    0.05,
)
KEPLER = Measured(kepler, (LENGTH, LENGTH), {"q": [1.0, 0.0], "v": [0.0, 1.2]}, {"m": (1.1, MASS), "mu": (1.0, (3, 0, -2))}, 0.1)

UNITS = (Units(length=-33), Units(mass=-87, time=-41), Units(length=38, mass=101, time=25))
CASES = [
    pytest.param(SLEIGH, dx.LagrangeDAlembert("trapezoidal", momentum="incoming"), id="sleigh-trapezoidal"),
    pytest.param(SLEIGH, dx.MinusLagrangeDirac(), id="sleigh-minus"),
    pytest.param(SLEIGH, dx.DiscreteDirac(), id="sleigh-method 1"),
    pytest.param(KEPLER, dx.Composition(dx.LagrangeDAlembert(), "suzuki4"), id="kepler-suzuki4"),
    pytest.param(KEPLER, dx.SymmetricComposition(dx.PlusLagrangeDirac()), id="kepler-symmetric"),
]


@pytest.mark.parametrize(("case", "scheme"), CASES)
@pytest.mark.parametrize("engine", ["native", "xla"])
@pytest.mark.soak_of(but=["native-kepler-suzuki4", "native-kepler-symmetric"])
def test_every_bit_in_other_units(case, scheme, engine):
    plain = case.run(Units(), scheme, engine, case.system())
    assert plain.ok
    for units in UNITS[: 1 if engine == "xla" else None]:
        scaled = case.run(units, scheme, engine, case.system())  # of which nothing is known from other units
        assert scaled.ok and scaled.stats["newton_iterations"] == plain.stats["newton_iterations"]
        q = np.array([units.of(d) for d in case.coordinates])
        np.testing.assert_array_equal(np.asarray(scaled.q) / q, plain.q)
        np.testing.assert_array_equal(np.asarray(scaled.p) / case.of_p(units), plain.p)


@pytest.mark.parametrize("units", UNITS)
@pytest.mark.soak_of("units0")
def test_a_prepared_run_in_other_units(units):
    """A plan knows the sizes of the numbers that it is called with, whatever it was called with before."""
    q, time = np.array([units.of(d) for d in SLEIGH.coordinates]), units.of(TIME)
    params = lambda mass: {n: a * units.of(d) * (mass if n == "m" else 1.0) for n, (a, d) in SLEIGH.params.items()}
    numbers = [
        {"q": np.array(SLEIGH.data["q"]) * q * size, "v": np.array(SLEIGH.data["v"]) * q / time, "params": params(mass)}
        for size, mass in ((1.0, 1.0), (1.25, 3e4), (0.0, 1e-7))
    ]
    settings = {"step": SLEIGH.step * time, "steps": 30, "check_initial": False, "engine": "native"}
    scheme = dx.LagrangeDAlembert()
    prepared = dx.prepare(SLEIGH.system(), scheme, **numbers[0], **settings)
    for given in (*numbers[1:], numbers[0]):
        again, alone = prepared(**given), dx.simulate(SLEIGH.system(), scheme, **given, **settings)
        assert alone.ok and again.stats["newton_iterations"] == alone.stats["newton_iterations"]
        for name in alone.fields:
            np.testing.assert_array_equal(again.fields[name], alone.fields[name])


@pytest.mark.parametrize("scheme", [dx.PlusLagrangeDirac(), dx.LagrangeDAlembert("trapezoidal")])
@pytest.mark.soak_of("scheme0")
def test_a_start_that_is_a_root(scheme):
    """The first momentum is a root, which a pseudo-inverse finds to a rounding: the run is the same up to that."""
    plain = PENDULUM.run(Units(), scheme, "native")
    for units in UNITS:
        scaled = PENDULUM.run(units, scheme, "native")
        assert abs(scaled.stats["newton_iterations"] - plain.stats["newton_iterations"]) < 20
        np.testing.assert_allclose(scaled.q / units.of(LENGTH), plain.q, rtol=1e-13, atol=1e-13)


@pytest.mark.soak
def test_what_fails_fails_in_any_units():
    """A pendulum of 1.2e-10 with h = .9, and Kepler's problem with h = .7, were "solved" while updates were compared with 1.
    Newton's method wanders before it fails, from a first momentum that is known to a rounding: at which step is not the same."""
    data = {"q": [np.sin(1.0), -np.cos(1.0)], "v": [0.0, 0.0]}
    wild = dataclasses.replace(PENDULUM, data=data, step=0.9)
    runs = [wild.run(units, dx.LagrangeDAlembert(), "native", steps=200) for units in (Units(), *UNITS)]
    assert all(not sol.ok and sol.rows < 10 and "did not converge" in sol.message for sol in runs)
    wild = dataclasses.replace(KEPLER, data={"q": [0.2, 0.0], "v": [0.0, 3.0]}, step=0.7)
    runs = [wild.run(units, dx.DiscreteDirac(), "native", steps=200) for units in (Units(), *UNITS)]
    assert len({(bool(sol.ok), sol.rows, sol.stats["newton_iterations"]) for sol in runs}) == 1


def test_data_off_the_constraint_are_off_it_in_any_units():
    for units in (Units(), Units(length=-33), Units(length=-50, time=-20)):
        off = dataclasses.replace(PENDULUM, data={"q": [0.6, -0.9], "v": [0.8, 0.6]})
        with pytest.raises(ValueError, match="off the constraint"):
            off.run(units, dx.LagrangeDAlembert(), "native")
        moving = dataclasses.replace(SLEIGH, data=SLEIGH.data | {"v": [0.3, 0.36, 0.5]})
        with pytest.raises(ValueError, match="off the constraint"):
            moving.run(units, dx.LagrangeDAlembert(), "native")


def bead():
    """A bead of mass 1 on a circle of the radius l, in (q, p)."""
    circle = lambda x, l: jnp.stack([x[:2] @ x[:2] - l**2])
    return dx.DiracSystem(dx.induced_dirac(None, 2), lambda x, l: x[2:] @ x[2:] / 2 + l * x[1], holonomic=circle)


def on_sphere():
    """A particle on the unit sphere that does not move along one axis: only times have units."""
    return dx.ManifoldLagrangian(lambda q, v: v @ v / 2, dx.Sphere(3), one_forms=lambda q: jnp.array([[0.0, 1.0, 0.0]]))


SKATE = lambda q: jnp.stack([jnp.stack([jnp.sin(q[2]), -jnp.cos(q[2]), 0 * q[2]])])
SIDEWAYS, FREE = lambda q: jnp.array([[0.0, 1.0]]), lambda x: x[2:] @ x[2:] / 2
ENERGY = lambda x: x[3:] @ x[3:] / 2
C, S = np.cos(0.3), np.sin(0.3)
EAST, FLAT = np.zeros(3), np.array([1.0, 1.0, 0.3])
HALF = lambda q: jnp.stack([-q[1], q[0]]) / 2
ROWS = np.random.default_rng(0).normal(size=(8, 16))
ALONG = np.linalg.svd(ROWS)[2]  # the last 8 rows are those that ROWS sends to zero, up to roundoff
DEFECTS = {  # system, scheme, data in a unit l that are on the constraint, and off it, and those that have no unit
    "dirac": (bead(), dx.DiscreteDirac(), {"x": [S, -C, 0.7 * C, 0.7 * S]}, {"x": [0.6, -0.7, 0.8, 0.6]}, {}),
    "skate": (dx.DiracSystem(dx.induced_dirac(SKATE, 3), ENERGY), dx.DiscreteDirac(), {"x": [0, 0, 0, 0.5, 0, 0.2]},
              {"x": [0, 0, 0, 0.5, 0.2, 0.2]}, {}),
    "hamilton": (dx.HamiltonDirac(lambda q, p: p @ p / 2, SKATE), dx.PlusHamiltonDirac(), {"p": [0.5, 1e-17, 0.2]},
                 {"p": [0.5, 0.2, 0.2]}, {"q": EAST}),
    "many rows": (dx.HamiltonDirac(lambda q, p: p @ p / 2, lambda q: jnp.asarray(ROWS)), dx.PlusHamiltonDirac(),
                  {"p": ALONG[-1]}, {"p": ALONG[-1] + 1e-6 * ALONG[0]}, {"q": np.zeros(16)}),
    "phase space": (dx.PhaseSpaceLagrangian(HALF, lambda q: q @ q / 2), dx.DiscreteDirac(), {"q": [1.0, 0.2], "p": [-0.1, 0.5]},
                    {"q": [1.0, 0.2], "p": [0.3, 0.3]}, {}),
    "implicit": (dx.ImplicitSystem(lambda x: jnp.diag(jnp.array([1.0, 0.0])), lambda x: jnp.stack([-x[1], 3 * x[1] - x[0]])),
                 dx.DiscreteDirac(), {"x": [0.3, 0.1]}, {"x": [1.0, 1.5]}, {}),
    "port": (dx.PortHamiltonian(lambda x: x @ x, np.array([[0, 1, 0], [-1, 0, 0], [0, 0, 0]]), B=np.array([[3.0], [0], [-1]]),
                                closed=True), dx.DiscreteDirac(), {"x": [0.1, 1.0, 0.3]}, {"x": [0.1, 1.0, 0.31]}, {}),
    "generalized": (dx.GeneralizedDiracSystem(dx.induced_dirac(SIDEWAYS, 2), dx.LagrangianSubmanifold.from_hamiltonian(FREE)),
                    dx.DiscreteDirac(), {"x": [0, 0, 0.5, 0]}, {"x": [0, 0, 0.5, 0.2]}, {}),
    "lie algebra": (dx.EulerPoincare(dx.SE2(), lambda xi: xi @ (FLAT * xi) / 2, [[0.0, 1.0, 0.0]]), dx.DiscreteEulerPoincare(),
                    {"x": [0.5, 1e-17, 0.06]}, {"x": [0.5, 0.2, 0.06]}, {}),
    "metric": (dx.NonholonomicMechanics(lambda q: jnp.eye(3), lambda q: 0.0 * q[0], SKATE), dx.DiscreteDirac(),
               {"v": [0.5, 0, 0.2]}, {"v": [0.5, 0.2, 0.2]}, {"q": EAST}),
    "sphere": (on_sphere(), dx.DiscreteDirac(dx.SphereProjection()), {"v": [0.0, 0.0, 0.5]}, {"v": [0.0, 0.2, 0.5]},
               {"q": [1.0, 0, 0]}),
}  # fmt: skip


@pytest.mark.parametrize("name", DEFECTS)
@pytest.mark.soak_of("skate", "many rows", "lie algebra")
def test_initial_data_of_every_system_are_judged_by_their_terms(name):
    """Defects were compared with 1: those of 1e-10 m were none, and roundoff of 1e9 m was one."""
    system, scheme, on, off, rest = DEFECTS[name]
    first = {"params": 1.0} if name == "dirac" else {}
    run = dx.prepare(system, scheme, **on, **rest, **first, step=0.02, steps=1)
    for l in (1e-10, 1.5e11):
        more, scaled = {n: l for n in first}, lambda data, l=l: {n: np.array(a) * l for n, a in data.items()}
        run(**scaled(on), **rest, **more, step=0.02 / max(l, 1.0))
        for project in (False, True) if name in ("skate", "implicit", "port") else (False,):
            with pytest.raises(ValueError, match="off the constraint") as error:
                dx.simulate(system, scheme, **scaled(off), **rest, **more, step=0.02, steps=1, project=project)
            assert ("constraint_algorithm" in str(error.value)) == ("project=True" not in str(error.value))
        with pytest.raises(ValueError, match="off the constraint"):
            run(**scaled(off), **rest, **more)


@pytest.mark.soak
def test_a_corrupted_trajectory_is_found_in_any_units():
    for units in (Units(), Units(length=-50)):
        sol = SLEIGH.run(units, dx.LagrangeDAlembert(), "native")
        q = np.array(sol.q)
        q[30, 1] *= 1.0 + 1e-9
        bad = copy.copy(sol)
        bad.fields = sol.fields | {"q": q}
        assert "VIOLATED" in [line.verdict for line in dx.verify(bad).lines]


def test_small_masses_beside_one_forms():
    """Largest entries cannot balance a saddle point: with masses of 2⁻⁸⁰ the first step was refused as singular."""
    for mass in (0, -80, 90):
        assert SLEIGH.run(Units(mass=mass), dx.LagrangeDAlembert(), "native").ok


@pytest.mark.soak
def test_verdicts_in_other_units():
    for case, scheme in ((PENDULUM, dx.LagrangeDAlembert()), (SLEIGH, dx.PlusLagrangeDirac())):
        for units in (Units(), UNITS[0], UNITS[2]):
            report = dx.verify(case.run(units, scheme, "native"))
            assert "VIOLATED" not in [line.verdict for line in report.lines]


@pytest.mark.soak
def test_a_bicycle_that_goes_nearly_straight():
    """The rate of a constraint whose terms all vanish at upright is judged by how fast they could be, not by roundoff."""

    def forms(q):
        x, _, turn, steer, *_ = q
        rear = jnp.stack([-jnp.sin(turn), jnp.cos(turn), 0 * x, 0 * x, 0 * x])
        return jnp.stack([rear, jnp.stack([-jnp.sin(turn + steer), jnp.cos(turn + steer), 1.2 * jnp.cos(steer), 0 * x, 0 * x])])

    inertia = jnp.array([10.0, 10.0, 2.0, 0.1, 10.0])
    bicycle = dx.LagrangeDirac(
        lambda q, v: v @ (inertia * v) / 2 - 98.1 * q[4],
        forms,
        holonomic=lambda q: jnp.stack([q[4] + 0.3 * jnp.cos(q[3]) - 0.3]),
    )
    for steer, rate in ((1e-5, -1e-4), (0.0, 0.0)):
        q, v = [0.0, 0.0, 0.0, steer, 0.0], [4.0, 0.0, 0.0, rate, 0.0]
        sol = dx.simulate(bicycle, dx.LagrangeDAlembert(), q=q, v=v, step=0.01, steps=60, project=True)
        lines = [line for line in dx.verify(sol).lines if steer or line.quantity != "steps replayed"]  # that sees 1e-32
        assert sol.ok and "VIOLATED" not in [line.verdict for line in lines]


def chain():
    """Three links of a machine, of centimetres and grams, one of them hanging straight."""

    def lagrangian(q, v):
        masses = jnp.repeat(jnp.array([0.05, 0.007, 0.003]), 2)
        return v @ (masses * v) / 2 - 9.81 * (masses * q)[1::2].sum()

    def links(q):
        a, b, c = q[:2], q[2:4], q[4:]
        return jnp.stack([a @ a - 0.03**2, (b - a) @ (b - a) - 0.02**2, (c - b) @ (c - b) - 0.04**2])

    return dx.LagrangeDirac(lagrangian, holonomic=links)


@pytest.mark.parametrize("step", [1e-3, 1e-5, 1e-6])
@pytest.mark.soak_of(but=["1e-06"])
def test_short_steps_of_a_composition_go_on_at_their_floor(step):
    q = np.array([0.018, -0.024, 0.038, -0.024, 0.038, -0.064])
    scheme = dx.Composition(dx.LagrangeDAlembert(), "kahan-li6")
    sol = dx.simulate(chain(), scheme, q=q, v=np.zeros(6), step=step, steps=60)
    assert sol.ok
    energy = np.asarray(sol.energy())
    assert np.max(np.abs(energy - energy[0])) < 1e-12


BALL = dx.LagrangeDirac(lambda q, v, p: p["m"] * (v @ v) / 2 - p["m"] * p["g"] * q[1])


@functools.cache
def walls(restitution):
    """A floor, and a wall that slopes."""
    return [dx.Impact(lambda q: q[1], restitution), dx.Impact(lambda q, params: params["l"] - q[0] - q[1] / 4, restitution)]


def balls(scheme, units, restitution, data, steps=400):
    """A ball between a floor and a wall that slopes, in units by powers of two: times, places and momenta in plain ones."""
    length, mass, time = (units.of(d) for d in (LENGTH, MASS, TIME))
    sol = dx.simulate(
        BALL, scheme, q=np.array(data["q"]) * length, v=np.array(data["v"]) * length / time, steps=steps, step=0.05 * time,
        params={"m": 1.5 * mass, "g": 1.1 * length / time**2, "l": 2.0 * length}, events=walls(restitution),
    )  # fmt: skip
    kept = sol.events.t / time, sol.q / length, sol.p * time / length / mass, sol.events.index
    return sol.ok, sol.message.split(":")[-1], sol.stats["newton_iterations"], *kept


TINY_BALL = Units(length=-30, mass=-86, time=-20)
"""About 1e-9 m, 1e-26 kg and µs."""


@pytest.mark.parametrize("restitution", [1.0, 0.5])
@pytest.mark.soak_of("0.5")
def test_impacts_in_other_units(restitution):
    """One that ends in a corner with ever more impacts, and one that begins on the floor."""
    for data in ({"q": [0.1, 1.0], "v": [0.9, 0.0]}, {"q": [0.0, 0.0], "v": [0.3, 0.7]}):
        plain = balls(dx.LagrangeDAlembert(), Units(), restitution, data)
        for units in (TINY_BALL, UNITS[2]):
            scaled = balls(dx.LagrangeDAlembert(), units, restitution, data)
            assert scaled[:3] == plain[:3] and len(scaled[3]) > 3
            for found, wanted in zip(scaled[3:], plain[3:], strict=True):
                np.testing.assert_array_equal(found, wanted)


def test_a_start_behind_a_wall_is_behind_it_in_any_units():
    for units in (Units(), TINY_BALL):
        with pytest.raises(ValueError, match=r"events\[0\] must not be negative at the start"):
            balls(dx.LagrangeDAlembert(), units, 1.0, {"q": [0.1, -1e-10], "v": [0.9, 1.0]})
        assert balls(dx.LagrangeDAlembert(), units, 1.0, {"q": [0.1, -1e-17], "v": [0.9, 1.0]}, steps=9)[0]


GRADIENT_UNITS = (Units(mass=-80), Units(length=-60, mass=60, time=-20))


@pytest.mark.parametrize("engine", ["native", "xla"])
@pytest.mark.soak
def test_derivatives_in_other_units(engine):
    """A sleigh that goes nearly along x: the entry 1e-8 of its one-form was a pivot with masses of 2⁻⁸⁰, and derivatives backward
    were off by 3e-7."""
    straight = dataclasses.replace(
        SLEIGH,
        data={"q": [0.0, 0.0, 1e-8], "v": [1.0, 1e-8, 0.0]},
        params=SLEIGH.params | {"a": (1e-9, LENGTH), "k": (0.0, STIFFNESS)},
    )
    system = straight.system()

    def end(v, m, q, params, step):
        data = {"q": q, "v": v, "params": params | {"m": m}, "step": step, "steps": 8, "engine": engine}
        return dx.simulate(system, dx.DiscreteDirac(), **data, check_initial=False).q[-1]

    def derivatives(units: Units, found: Callable):
        q, time = np.array([units.of(d) for d in straight.coordinates]), units.of(TIME)
        params = {name: value * units.of(d) for name, (value, d) in straight.params.items()}
        v = np.array(straight.data["v"]) * q / time
        by_v, by_m = found(v, params["m"], np.array(straight.data["q"]) * q, params, straight.step * time)
        return np.asarray(by_v) / q[:, None] * q / time, np.asarray(by_m) / q * units.of(MASS)

    for by in (jax.jacfwd, jax.jacrev) if engine == "native" else (jax.jacrev,):  # which XLA makes of the other
        of_end = jax.jit(by(end, (0, 1)))
        plain = derivatives(Units(), of_end)
        for units in GRADIENT_UNITS:
            for found, wanted in zip(derivatives(units, of_end), plain, strict=True):
                np.testing.assert_array_equal(found, wanted)


SKATE = lambda q: jnp.stack([jnp.stack([jnp.sin(q[2]), -jnp.cos(q[2]), 0 * q[2]])])
SMALL = ((1e-9, 1.0), (1.0, 1e-20))
"""A length and a mass: those of MEMS, and of molecules."""


@pytest.mark.parametrize(("length", "mass"), SMALL)
@pytest.mark.soak_of("1e-09-1.0")
def test_inertias_of_small_machines(length, mass):
    """Moments of inertia of 1e-19 beside masses of 1 are not roundoff: on a circle, from the closed form."""
    skate = dx.NonholonomicMechanics(lambda q, P: jnp.diag(jnp.stack([P["m"], P["m"], P["J"]])), lambda q, P: 0 * q[0], SKATE)
    inertia = 0.4 * mass * length**2
    settings = {"step": 0.05, "steps": 20, "params": {"m": mass, "J": inertia}}
    sol = dx.simulate(skate, dx.DiscreteDirac(), q=[0, 0, 0], v=[0.5 * length, 0, 1.0], **settings)
    np.testing.assert_allclose(sol.q[-1] / [length, length, 1], [0.5 * np.sin(1.0), 0.5 - 0.5 * np.cos(1.0), 1.0], rtol=1e-3)
    body = dx.EulerPoincare(
        dx.SE2(), lambda xi, P: P["J"] * xi[0] ** 2 / 2 + P["m"] * (xi[1:] @ xi[1:]) / 2, one_forms=[[0.0, 0.0, 1.0]]
    )
    x = np.array([inertia, mass * length, 0.0])
    sol = dx.simulate(body, dx.DiscreteEulerPoincare(), x=x, **settings)
    np.testing.assert_allclose(sol.x[-1], x, rtol=1e-12, atol=1e-12 * mass * length)


@pytest.mark.soak
def test_orbits_that_are_small_are_free():
    """In polar coordinates: at a radius of 1e-9 the angle has the inertia 1e-18, and at the origin none."""
    particle = dx.LagrangeDirac(lambda q, v, l: (v[0] ** 2 + q[0] ** 2 * v[1] ** 2) / 2 - (q[0] - l) ** 2)
    reduced = dx.reduce(particle, dx.LinearConnection(fibre=[1]))
    run = lambda l, r: dx.simulate(
        reduced, dx.DiscreteRouth(), q=[r * l, 0], v=[0.1 * l, 0.8], step=0.05, steps=20, params=l
    )  # fmt: skip
    for length in (1.0, 2.0**-30):
        with pytest.raises(ValueError, match="orbits of the group are not free"):
            run(length, 0.0)
    np.testing.assert_allclose(run(2.0**-30, 1.0).x * 2.0**30, run(1.0, 1.0).x, rtol=1e-13)


def test_a_metric_that_is_not_definite_is_none_in_any_units():
    for length in (1.0, 2.0**-33, 2.0**40):
        for metric, wrong in (([[1.0, 2.0], [2.0, 1.0]], "positive definite"), ([[1.0, 0.5], [0.3, 1.0]], "symmetric")):
            scaled = jnp.array(metric) * jnp.outer(*2 * [jnp.array([1.0, length])])
            system = dx.NonholonomicMechanics(lambda q, g=scaled: g, lambda q: 0 * q[0], lambda q: jnp.array([[1.0, 0.0]]))
            with pytest.raises(ValueError, match=f"not {wrong}"):
                dx.simulate(system, dx.DiscreteDirac(), q=[0, 0], v=[0, 1], step=0.1, steps=3)


PLANE_OF_PHASES = dx.DiracSystem(
    dx.induced_dirac(None, 2),
    lambda x, P: x[2:] @ x[2:] / P["m"] / 2 + P["m"] * P["g"] * x[1],
    holonomic=lambda x, P: jnp.stack([x[:2] @ x[:2] - P["l"] ** 2]),
)
"""The pendulum of above by its Hamiltonian."""


@pytest.mark.parametrize("scheme", [dx.DiscreteDirac(constraints="resolve"), dx.DiscreteGradient()], ids=["method 2", "gradient"])
@pytest.mark.soak_of("method 2")
def test_small_masses_beside_constraints_of_a_hamiltonian(scheme):
    """Initial velocities by a pseudo-inverse had an error of 1e-16 in forces too, which moved momenta of 1e-25 anywhere."""

    def run(units):
        length, mass, time = (units.of(d) for d in (LENGTH, MASS, TIME))
        size = np.array([length, length, *2 * [mass * length / time]])
        params = {"m": mass, "l": length, "g": 9.8 * length / time**2}
        settings = {"step": 0.02 * time, "steps": 20, "engine": "native"}
        sol = dx.simulate(PLANE_OF_PHASES, scheme, x=np.array([0.6, -0.8, 0.8, 0.6]) * size, params=params, **settings)
        assert sol.ok
        return sol.x / size

    plain = run(Units())
    for units in (Units(mass=-80), Units(mass=-120), Units(length=-33, mass=101, time=25)):
        np.testing.assert_allclose(run(units), plain, atol=1e-12)


@pytest.mark.parametrize(
    "units", [Units(length=-33, mass=-87, time=-40), Units(length=40, mass=-80, time=-20), Units(-33, 101, 25)]
)
@pytest.mark.soak_of(but=["units1"])
def test_the_constraint_algorithm_beside_small_forces(units):
    """A skate on the plane: velocities and forces in rows of their own, and an angle that stands in the one-form alone."""
    hamiltonian = lambda x, P: (x[3] ** 2 + x[4] ** 2) / P["m"] / 2 + x[5] ** 2 / 2 / P["J"]
    skate = dx.DiracSystem(dx.induced_dirac(SKATE, 3), hamiltonian)
    length, mass, time = (units.of(d) for d in (LENGTH, MASS, TIME))
    size = np.array([length, length, 1.0, *2 * [mass * length / time], mass * length**2 / time])
    chain = dx.constraint_algorithm(skate, np.array([0, 0, 0, 0.5, 0, 0.4]) * size, {"m": mass, "J": 0.4 * mass * length**2})
    assert (chain.verdict, chain.dimension) == ("determined", 5)
    field = np.asarray(chain.field(chain.point)) / size * time
    np.testing.assert_allclose(field, [0.5, 0.0, 1.0, 0.0, 0.5, 0.0], atol=1e-12)
