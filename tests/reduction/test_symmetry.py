"""Group actions, momentum maps, the search for symmetries: closed forms, laws, and systems that have none."""

import jax.numpy as jnp
import numpy as np
import pytest

import dirax as dx
from dirax import GroupAction, Translations, check_invariance, cyclic_coordinates, translation_symmetries


def turned(g, q):
    c, s = jnp.cos(g[0]), jnp.sin(g[0])
    return jnp.array([[c, -s], [s, c]]) @ q


TURN = GroupAction(turned, 1)
CENTRAL = dx.LagrangeDirac(lambda q, v, params: v @ v / 2 + params / jnp.sqrt(q @ q))


def test_lifts_and_momentum_map_of_turns_of_the_plane():
    rng = np.random.default_rng(1)
    q, v, p, g = *rng.normal(size=(3, 2)), np.array([0.7])
    assert TURN.generator(np.ones(1), q) == pytest.approx([-q[1], q[0]], abs=1e-14)
    assert float(TURN.momentum_map(q, p)[0]) == pytest.approx(q[0] * p[1] - q[1] * p[0], abs=1e-14)
    moved, rate = TURN.tangent_lift(g, q, v)
    there, momentum = TURN.cotangent_lift(g, q, p)
    assert there == pytest.approx(moved) and float(momentum @ rate) == pytest.approx(p @ v, abs=1e-13)
    assert TURN.momentum_map(there, momentum) == pytest.approx(np.asarray(TURN.momentum_map(q, p)), abs=1e-13)


def test_translations():
    action, q = Translations([0, 2]), np.array([1.0, 2.0, 3.0])
    assert action(jnp.array([0.5, -1.0]), q) == pytest.approx([1.5, 2, 2])
    assert action.generator(np.array([1.0, 4.0]), q) == pytest.approx([1, 0, 4])
    assert action.momentum_map(q, np.array([7.0, 8.0, 9.0])) == pytest.approx([7, 9])


def test_invariance_is_found_and_its_lack_is_placed():
    assert check_invariance(CENTRAL, TURN, q=[1.0, 0.5], params=2.0)
    missing = check_invariance(CENTRAL, Translations([0]), q=[1.0, 0.5], params=2.0, samples=0)
    slope = 2.0 / np.hypot(1, 0.5) ** 3
    assert not missing and missing.defect == pytest.approx(slope, rel=1e-12) and "generator 0 at the rate" in str(missing)
    # a defect that only shows away from the first point
    bump = dx.LagrangeDirac(lambda q, v: v @ v / 2 + jnp.maximum(q[0] - 1.2, 0.0) ** 3)
    assert check_invariance(bump, Translations([0]), q=[0.0, 0.0], radius=1.0)
    far = check_invariance(bump, Translations([0]), q=[0.0, 0.0], radius=3.0)
    assert not far.ok and far.q[0] > 1.2 and far.defect == pytest.approx(3 * (far.q[0] - 1.2) ** 2)


def test_invariance_of_discrete_lagrangians_and_of_one_forms():
    midpoint = lambda q0, q1, h: (q1 - q0) @ (q1 - q0) / (2 * h) - h * jnp.sum((q0 + q1) ** 2) ** 2
    options = {"q": [1.0, 0.5], "discrete_lagrangian": midpoint, "step": 0.1}
    assert check_invariance(CENTRAL, TURN, **options)
    assert check_invariance(CENTRAL, Translations([1]), **options).of == "discrete_lagrangian"
    knife = dx.LagrangeDirac(lambda q, v: v @ v / 2, lambda q: jnp.array([[jnp.sin(q[2]), -jnp.cos(q[2]), 0.0]]))
    assert check_invariance(knife, Translations([0, 1]), q=np.zeros(3))
    heading = check_invariance(knife, Translations([0, 2]), q=np.zeros(3))
    assert heading.of == "one_forms" and heading.generator == 1


def test_cyclic_coordinates_and_oblique_translations_are_found():
    chain = dx.LagrangeDirac(lambda q, v: v @ v / 2 - jnp.cos(q[0] - q[2]) + jnp.sin(q[1]) * v[3])
    assert cyclic_coordinates(chain, np.zeros(4)) == (3,)
    found = translation_symmetries(chain, np.zeros(4))
    expected = np.array([[1.0, 0, 1, 0], [0, 0, 0, np.sqrt(2)]]) / np.sqrt(2)
    assert found.T @ found == pytest.approx(expected.T @ expected, abs=1e-9)
    assert cyclic_coordinates(dx.LagrangeDirac(lambda q, v: v @ v / 2 - q @ q), np.zeros(3)) == ()


def test_what_is_no_symmetry_from_some_time_on_is_one_before():
    switched = dx.LagrangeDirac(lambda t, q, v: v @ v / 2 - (1.0 + jnp.tanh(20.0 * (t - 3.0))) * jnp.cos(q[1]))
    at = {"q": [1.0, 0.2], "v": [1.0, 0.8]}
    for fibre, first, last in ((0, True, True), (1, True, False)):
        assert bool(check_invariance(switched, Translations([fibre]), **at)) is first
        assert bool(check_invariance(switched, Translations([fibre]), t=5.0, **at)) is last
    assert cyclic_coordinates(switched, **at) == (0, 1)
    assert cyclic_coordinates(switched, **at, t=5.0) == (0,)


def test_mistakes():
    with pytest.raises(ValueError, match=r"action\(0, q\) = q fails by 1"):
        check_invariance(CENTRAL, GroupAction(lambda g, q: q + 1.0 + 0 * g[0], 1), q=[1.0, 0.0], params=1.0)
    with pytest.raises(ValueError, match=r"action\(g \+ h, q\)"):
        check_invariance(CENTRAL, GroupAction(lambda g, q: q + jnp.sin(g[0]), 1), q=[1.0, 0.0], params=1.0)
    turned = lambda g, q: jnp.stack([q[0] * jnp.cos(g[0] ** 3) - q[1] * jnp.sin(g[0] ** 3), q[0] * jnp.sin(g[0] ** 3) + q[1]])
    with pytest.raises(ValueError, match=r"action\(g \+ h, q\)"):  # at a fixed point it satisfies every law
        check_invariance(CENTRAL, GroupAction(turned, 1), q=[0.0, 0.0], params=1.0)
    with pytest.raises(ValueError, match="does not fit a system of 2"):
        check_invariance(CENTRAL, Translations([2]), q=[1.0, 0.0], params=1.0)
    with pytest.raises(TypeError, match=r"action must be one such as dx\.Translations"):
        check_invariance(CENTRAL, [0], q=[1.0, 0.0], params=1.0)
    with pytest.raises(TypeError, match=r"a Lagrangian L\(q, v\), such as a dx\.LagrangeDirac, but one of type DiracSystem was"):
        cyclic_coordinates(dx.DiracSystem(dx.induced_dirac(None, 1), lambda x: x @ x), [1.0, 0.0])
    with pytest.raises(TypeError, match="takes params, which were not given"):
        check_invariance(CENTRAL, TURN, q=[1.0, 0.0])
    with pytest.raises(ValueError, match=r"shape \(n,\), but their shapes are \(\) and \(\)"):
        cyclic_coordinates(CENTRAL, 1.0, params=1.0)
    with pytest.raises(ValueError, match="L is finite at none of the points"):
        cyclic_coordinates(dx.LagrangeDirac(lambda q, v: v @ v / 2 + jnp.log(q[0])), [-5.0, 0.0])
    with pytest.raises(ValueError, match="needs step="):
        check_invariance(CENTRAL, TURN, q=[1.0, 0.0], discrete_lagrangian=lambda a, b, h: jnp.sum(a))


def test_finite_translations_agree_with_the_derivative():
    """The infinitesimal criterion against invariance under the group itself."""
    pulled = lambda q, v: v @ v * (1 + jnp.cos(q[1])) / 2 - jnp.sin(q[0] - q[1])
    system = dx.LagrangeDirac(pulled)
    whole = GroupAction(lambda g, q: q + g[0], 1)
    found = check_invariance(system, whole, q=[0.2, 0.4])
    q, v = jnp.array(found.q), jnp.array(found.v)
    finite = float((pulled(q + 1e-5, v) - pulled(q - 1e-5, v)) / 2e-5)
    assert not found and found.defect == pytest.approx(abs(finite), rel=1e-6)


@pytest.mark.parametrize("unit", [1e-15, 1e12])
@pytest.mark.soak_of(but=["1e-15"])
def test_one_forms_of_any_units(unit):
    """Of a knife edge that turns with y; moved along y it is another one, in whatever units, and along x the same."""
    rows = lambda q: unit * jnp.stack([jnp.stack([jnp.sin(q[1]), -jnp.cos(q[1]), 0.3 + 0 * q[2]])])
    system = dx.LagrangeDirac(lambda q, v: v @ v / 2, rows)
    assert check_invariance(system, Translations([0, 2]), q=[0.1, 0.2, 0.3])
    assert not check_invariance(system, Translations([1]), q=[0.1, 0.2, 0.3])


@pytest.mark.soak
def test_small_units_hide_no_asymmetry():
    """Masses of 1e-27, as in SI units of atoms."""
    falling = dx.LagrangeDirac(lambda q, v: 1e-27 * (v @ v / 2 - q[1]))
    assert cyclic_coordinates(falling, [0.1, 0.2]) == (0,)
    assert check_invariance(falling, Translations([0]), q=[0.1, 0.2])
    assert not check_invariance(falling, Translations([1]), q=[0.1, 0.2])
    free = lambda q, v: 1e-27 * (v[0] ** 2 + (1 + q[0] ** 2) * v[1] ** 2) / 2
    for along, message in ((0.1, "f has the part .*e-29 along"), (0.0, "")):
        pushed = dx.LagrangeDirac(free, forces=lambda t, q, v, along=along: -1e-27 * jnp.stack([v[0], along * v[1]]))
        reduced, start = dx.reduce(pushed, dx.LinearConnection([1])), {"q": [0.1, 0.2], "v": [0.3, 0.4], "step": 0.1, "steps": 3}
        if message:
            with pytest.raises(ValueError, match=message):
                dx.simulate(reduced, dx.DiscreteRouth(), **start)
        else:
            assert dx.simulate(reduced, dx.DiscreteRouth(), **start).ok


@pytest.mark.parametrize("unit", [(1.0, 1.0, 1.0), (2.0**-33, 2.0**-80, 2.0**-40), (2.0**33, 2.0**80, 2.0**10)])
@pytest.mark.soak_of(but=["unit1"])
def test_symmetries_in_other_units(unit):
    """Of lengths and an angle: with lengths of 1e-10, a potential of the angle alone was too small beside ∂L/∂x to be seen."""
    length, mass, time = unit
    energy = mass * length**2 / time**2

    def lagrangian(q, v):
        kinetic = mass * (1.3 * v[0] ** 2 + 0.7 * v[2] ** 2 + 0.6 * length**2 * v[1] ** 2) / 2
        return kinetic - energy * (0.3 * jnp.cos(q[0] / length) + 0.2 * jnp.sin(q[1]))

    system, sizes = dx.LagrangeDirac(lagrangian), np.array([length, 1.0, length])
    q, v = np.array([0.3, 0.4, 0.5]) * sizes, np.array([0.1, 0.2, 0.3]) * sizes / time
    assert cyclic_coordinates(system, q, v) == (2,) == cyclic_coordinates(system, 0 * q)
    assert [bool(check_invariance(system, Translations([i]), q=q, v=v)) for i in range(3)] == [False, False, True]
    sliding = GroupAction(lambda g, q: q + g[0] * np.array([0.0, 0.0, length]), 1)
    assert check_invariance(system, sliding, q=q)
