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


def both(name, scheme, steps=40):
    """The runs in plain units and in others, q, p and the updates of either in plain ones."""
    example, random = gallery.get(name), np.random.default_rng(len(name))
    exponents = {c.unit: int(random.integers(-30, 30)) for c in example.coordinates}
    a = np.array([2.0 ** exponents[c.unit] for c in example.coordinates])
    tau, c = 2.0 ** random.integers(-20, 20), 2.0 ** random.integers(-40, 40)
    system = in_units(example.system)
    for units in ({"a": np.ones(len(a)), "tau": 1.0, "c": 1.0}, {"a": a, "tau": tau, "c": c}):
        start = {"q": np.asarray(example.initial["q"]) * units["a"]}
        start["v"] = np.asarray(example.initial["v"]) * units["a"] / units["tau"]
        run = {"step": example.step * units["tau"], "steps": steps, "params": units | {"own": example.params}}
        sol = dx.simulate(system, scheme, **start, **run)
        assert sol.ok, sol.message
        yield sol.q / units["a"], sol.p * units["a"] / units["c"] / units["tau"], sol.stats["newton_iterations"]


def stated(name):
    example = gallery.get(name)
    plain = isinstance(example.system, dx.LagrangeDirac) and set(example.initial) == {"q", "v"}
    return plain and not example.system.forces_see_multipliers


def compared(name, scheme):
    """A root before the first step is found to a rounding; without one the runs are the same to the last bit."""
    (q, p, updates), (scaled_q, scaled_p, scaled_updates) = both(name, scheme)
    sizes = np.maximum(np.abs(p).max(), np.abs(p).max(axis=0))
    assert np.abs(scaled_q - q).max() <= 1e-12 * np.abs(q).max()
    assert np.all(np.abs(scaled_p - p).max(axis=0) <= 1e-11 * sizes)
    assert abs(scaled_updates - updates) <= 0.2 * updates
    return np.array_equal(scaled_q, q) and np.array_equal(scaled_p, p) and scaled_updates == updates


@pytest.mark.parametrize("scheme", ["lagrange-dalembert", "lobatto"])
def test_a_ball_on_a_turntable_in_other_units(scheme):
    """Its first momentum was wrong by 1.5e-5, without a word: masses of 2⁻⁶² beside rolling."""
    compared("turntable", SCHEMES[scheme])


@pytest.mark.parametrize("name", ["heisenberg", "contact-particle"])
def test_systems_that_begin_without_a_root_have_every_bit(name):
    assert compared(name, dx.DiscreteDirac())


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
