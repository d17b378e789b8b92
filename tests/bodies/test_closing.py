"""Joints that close loops, assembled: a body in place is not one that is turned over, which the sines of angles do not tell."""

import jax.numpy as jnp
import numpy as np
import pytest

import dirax as dx

b = dx.bodies
PAIR = [b.Body("arm", 1.0, (0.1, 0.1, 0.1), (0.1, 0.2, 0)), b.Body("tool", 1.0, (0.1, 0.12, 0.15), (0.3, 0, 0))]


def machine(closing, axis=(0, 1, 0), rotation="quaternion"):
    joints = [b.revolute("ground", "arm", axis=axis), b.free("ground", "tool", rotation=rotation), closing]
    return b.Model(PAIR, joints)


@pytest.mark.parametrize("rotation", ["quaternion", "attitude", "zxy"])
@pytest.mark.soak_of(but=["zxy"])
def test_a_welded_body_is_where_a_fixed_one_is(rotation):
    model = machine(b.fixed("arm", "tool", name="weld", at=(0.5, 0, 0), closes=True), rotation=rotation)
    for angle in (0.3, 1.7, 3.0, -2.5, 5.0):
        state = model.state({"arm": angle}, {"arm": 1.0})
        frame = model.frames(state["q"], state["v"])["tool"]
        centre = frame.point(np.array([0.3, 0, 0]))
        np.testing.assert_allclose(centre, 0.8 * np.array([np.cos(angle), 0, -np.sin(angle)]), atol=1e-10)
        np.testing.assert_allclose(frame.turn[:, 1], [0, 1, 0], atol=1e-10)


@pytest.mark.soak
def test_a_hinge_that_closes_moves_as_one_of_the_tree():
    closed = machine(b.revolute("arm", "tool", axis=(0, 0, 1), name="hinge", at=(0.5, 0, 0), closes=True), axis=(1, 0, 0))
    tree = b.Model(PAIR, [b.revolute("ground", "arm", axis=(1, 0, 0)), b.revolute("arm", "tool", (0, 0, 1), at=(0.5, 0, 0))])
    for angle in (0.4, 1.7, 2.8):
        state = closed.state({"arm": angle})
        frames = closed.frames(state["q"], state["v"])
        between = np.asarray(frames["arm"].turn.T @ frames["tool"].turn)
        assert between[2, 2] > 1 - 1e-12
        theirs = tree.accelerations(np.array([angle, np.arctan2(between[1, 0], between[0, 0])]), np.zeros(2))["arm"]
        np.testing.assert_allclose(closed.accelerations(**state)["arm"], theirs, rtol=1e-9)


def test_a_body_that_is_given_turned_over_is_refused():
    model = machine(b.fixed("arm", "tool", name="weld", at=(0.5, 0, 0), closes=True))
    turned = np.array([0.0, 0.5, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0])  # by half a turn about x
    with pytest.raises(ValueError, match="weld met with the body turned over"):
        model.state({name: x for name, x in zip(model.coordinates, turned, strict=True)})


def test_an_inertia_that_was_turned_is_symmetric_to_rounding():
    turn = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    inertia = turn @ np.diag([0.1, 0.2, 0.25]) @ turn.T
    assert np.any(inertia != inertia.T)
    model = b.Model([b.Body("rod", 1.0, inertia, (0, 0, -0.5))], [b.revolute("ground", "rod", axis=(0, 1, 0))])
    expected = -9.81 * 0.5 * np.sin(1.0) / (inertia[1, 1] + 0.25)
    np.testing.assert_allclose(model.accelerations([1.0], [0.0])["rod"], expected, rtol=1e-12)
    inertia[0, 1] += 1e-3
    with pytest.raises(ValueError, match="symmetric"):
        b.Model([b.Body("rod", 1.0, inertia, (0, 0, -0.5))], [b.revolute("ground", "rod", axis=(0, 1, 0))])


@pytest.mark.parametrize(
    "push, said",
    [
        (lambda t, q, v: -v["foo"], "push of 'drive' at 'arm' could not be traced by JAX: KeyError: 'foo'"),
        (lambda t, q, v: None, "push of 'drive' at 'arm'"),
        (lambda t, q, v: jnp.stack([v["arm"]] * 2), "must be one number"),
    ],
)
def test_a_mistake_in_the_push_of_a_motor_is_said_with_its_name(push, said):
    model = b.Model(PAIR[:1], [b.revolute("ground", "arm")], forces=[b.Motor("arm", push, name="drive")])
    with pytest.raises((TypeError, ValueError), match=said):
        model.accelerations([1.0], [0.5])
    with pytest.raises((TypeError, ValueError), match="push of 'drive'"):
        dx.simulate(model.system, dx.LagrangeDAlembert(), **model.state(), step=0.1, steps=1)


def test_observables_are_those_of_one_trajectory():
    model = b.Model(PAIR[:1], [b.revolute("ground", "arm")])
    batch = dx.simulate(model.system, dx.LagrangeDAlembert(), q=[[0.1], [0.2]], v=[[0.0], [0.0]], step=0.1, steps=3)
    with pytest.raises(ValueError, match=r"solution\[i\]"):
        model.observables(batch)
    assert model.observables(batch[1])["energy"].shape == (4,)


def test_a_thin_rod_that_turns_in_all_ways_is_refused_by_name():
    with pytest.raises(ValueError, match=r"'stick' has no moment of inertia about an axis .* rotation=\"axis\""):
        b.Model([b.rod("stick", (0, 0, -1.0))], [b.ball("ground", "stick")])
    for joint in (b.free("ground", "stick"), b.free("ground", "stick", rotation="zxz")):
        with pytest.raises(ValueError, match="no moment of inertia"):
            b.Model([b.rod("stick", (0, 0, -1.0))], [joint])
    model = b.Model([b.rod("stick", (0, 0, -1.0))], [b.ball("ground", "stick", rotation="axis")])
    assert dx.simulate(model.system, dx.LagrangeDAlembert(), **model.state(), step=0.01, steps=5).ok
    b.Model([b.rod("stick", (0, 0, -1.0))], [b.ball("ground", "stick", at=(0, 0, 1), on=(0.2, 0, 0))])  # beside its axis
    with pytest.raises(ValueError, match="which have no direction"):
        b.Model(PAIR[:1], [b.ball("ground", "arm")]).state(np.zeros(4))
