"""Systems of the gallery in other units of their coordinates, of time and of energy, by powers of two, through one program."""

import numpy as np
import pytest

import dirax as dx
from dirax import gallery

SCHEMES = {
    "lagrange-dalembert": dx.LagrangeDAlembert(),
    "trapezoidal": dx.LagrangeDAlembert("trapezoidal"),
    "plus": dx.PlusLagrangeDirac(),
    "minus": dx.MinusLagrangeDirac(),
    "method 1": dx.DiscreteDirac(),
    "suzuki4": dx.Composition(dx.LagrangeDAlembert(), "suzuki4"),
    "gauss": dx.Collocation(3),
    "lobatto": dx.Collocation(3, nodes="lobatto"),
}


def in_units(s):
    """The system whose coordinates are a·q, times τ·t and energies c·E, all of them params."""
    place = lambda q, params: q / params["a"]
    rate = lambda v, params: v * params["tau"] / params["a"]

    def lagrangian(t, q, v, params):
        at = t / params["tau"], place(q, params), rate(v, params)
        return params["c"] * s.lagrangian.at(*at, params["own"])

    def forces(t, q, v, params):
        at = t / params["tau"], place(q, params), rate(v, params)
        return params["c"] * s.forces(*at, params["own"]) / params["a"]

    def of_place(function, unit):
        if function is None:
            return None
        found = lambda t, q, params: function.at(t / params["tau"], place(q, params), params["own"]) / unit(params)
        return found if function.takes_time else lambda q, params: found(0.0, q, params)

    return dx.LagrangeDirac(
        lagrangian if s.lagrangian.takes_time else lambda q, v, params: lagrangian(0.0, q, v, params),
        of_place(s.one_forms, lambda params: params["a"][None]),
        affine=of_place(s.affine, lambda params: params["tau"]),
        holonomic=of_place(s.holonomic, lambda params: 1.0),
        forces=None if s.forces is None else forces,
    )


def in_both(name, away=0.0):
    """(system, initial data that are `away` from the example's, params, step, units) in plain units and in others."""
    example, random = gallery.get(name), np.random.default_rng(len(name))
    exponents = {c.unit: int(random.integers(-30, 30)) for c in example.coordinates}
    a = np.array([2.0 ** exponents[c.unit] for c in example.coordinates])
    tau, c = 2.0 ** random.integers(-20, 20), 2.0 ** random.integers(-40, 40)
    system = in_units(example.system)
    moved = {name: np.asarray(example.initial[name]) + away * random.normal(size=len(a)) for name in ("q", "v")}
    for units in ({"a": np.ones(len(a)), "tau": 1.0, "c": 1.0}, {"a": a, "tau": tau, "c": c}):
        start = {"q": moved["q"] * units["a"], "v": moved["v"] * units["a"] / units["tau"]}
        yield system, start, units | {"own": example.params}, example.step * units["tau"], units


def both(name, scheme, steps=40, away=0.0, **more):
    """The runs in plain units and in others, q, p and the updates of either in plain ones."""
    for system, start, params, step, units in in_both(name, away):
        sol = dx.simulate(system, scheme, **start, step=step, steps=steps, params=params, **more)
        assert sol.ok, sol.message
        yield sol.q / units["a"], sol.p * units["a"] / units["c"] / units["tau"], sol.stats["newton_iterations"]


def stated(name):
    example = gallery.get(name)
    plain = isinstance(example.system, dx.LagrangeDirac) and set(example.initial) == {"q", "v"}
    return plain and not example.system.forces_see_multipliers


def chain_in_both(name):
    """What the constraint algorithm says in plain units and in others, and its point, (q, p), in plain ones."""
    for system, start, params, _, units in in_both(name):
        chain, n = dx.constraint_algorithm(system, start, params), len(units["a"])
        yield str(chain), chain.point[:n] / units["a"], chain.point[-n:] * units["a"] / units["c"] / units["tau"]


def compared(name, scheme, **more):
    """A root before the first step is found to a rounding; without one the runs are the same to the last bit."""
    (q, p, updates), (scaled_q, scaled_p, scaled_updates) = both(name, scheme, **more)
    sizes = np.maximum(np.abs(p).max(), np.abs(p).max(axis=0))
    assert np.abs(scaled_q - q).max() <= 1e-12 * np.abs(q).max()
    assert np.all(np.abs(scaled_p - p).max(axis=0) <= 1e-11 * sizes)
    assert abs(scaled_updates - updates) <= 0.2 * updates
    return np.array_equal(scaled_q, q) and np.array_equal(scaled_p, p) and scaled_updates == updates


@pytest.mark.parametrize("scheme", ["lagrange-dalembert", "lobatto"])
@pytest.mark.soak_of("lobatto")
def test_a_ball_on_a_turntable_in_other_units(scheme):
    """Its first momentum was wrong by 1.5e-5, without a word: masses of 2⁻⁶² beside rolling."""
    compared("turntable", SCHEMES[scheme])


def test_the_governor_in_other_units_runs_natively():
    """Derivatives of equations without the later unknowns were taken to be nodes with them, which cancel: a raw KeyError."""
    system, start, params, step, _ = next(in_both("flyball-governor"))
    sol = dx.simulate(system, dx.LagrangeDAlembert(), **start, step=step, steps=3, params=params, engine="native")
    assert sol.ok


def test_gauss_nodes_in_other_units():
    """The elimination of the mass matrix was called unstable in some, and another iteration took its place."""
    assert compared("charged-particle", SCHEMES["gauss"])


def test_a_board_that_starts_from_rest_in_other_units():
    """All that its wheels hold is the roundoff of zero in the first step, which was called unsolved in some: no size was left."""
    assert compared("snakeboard-gait", SCHEMES["suzuki4"], steps=3)


@pytest.mark.parametrize("name", ["heisenberg", "contact-particle"])
def test_systems_that_begin_without_a_root_have_every_bit(name):
    assert compared(name, dx.DiscreteDirac())


def compared_chains(name):
    (said, q, p), (scaled_said, scaled_q, scaled_p) = chain_in_both(name)
    assert scaled_said == said
    np.testing.assert_allclose(scaled_q, q, rtol=1e-9, atol=1e-12 * np.abs(q).max())
    np.testing.assert_allclose(scaled_p, p, rtol=1e-9, atol=1e-12 * np.abs(p).max())


def test_data_are_projected_in_other_units():
    """The mass matrix of lengths and angles was called singular in some, and the data came out off the constraint."""
    compared("rolling-disk", SCHEMES["lagrange-dalembert"], steps=2, away=0.01, project=True)


@pytest.mark.soak
def test_the_constraint_algorithm_in_other_units():
    """Its ranks were not constant in some: samples around a point were as far away as 1 + |x|."""
    compared_chains("cartesian-double-pendulum")


@pytest.mark.soak
@pytest.mark.parametrize("name", gallery.names())
def test_chains_of_the_gallery_in_other_units(name):
    if not stated(name):
        pytest.skip("its functions are not those of q and v alone")
    compared_chains(name)


@pytest.mark.soak
@pytest.mark.parametrize("scheme", SCHEMES)
@pytest.mark.parametrize("name", gallery.names())
def test_the_gallery_in_other_units(name, scheme):
    if not stated(name):
        pytest.skip("its functions are not those of q and v alone")
    try:
        compared(name, SCHEMES[scheme])
    except (TypeError, ValueError) as error:  # both units have to be refused
        with pytest.raises(type(error)):
            gallery.get(name).simulate(SCHEMES[scheme], steps=1)
