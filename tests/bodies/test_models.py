"""Machines from bodies and joints against equations written by hand, and their mistakes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dirax as dx
from dirax.bodies.drawing import _from_z

b = dx.bodies
ROD = {"mass": 2.0, "inertia": (0.3, 0.2, 0.1)}


def value(found):
    return float(np.asarray(found))


def test_a_double_pendulum_is_the_one_written_by_hand():
    m1, m2, l1, g = 1.3, 0.7, 0.9, 9.81
    model = b.Model(
        [b.Body("upper", m1, centre=(0, 0, -l1)), b.Body("lower", m2, centre=(0, 0, -0.6))],
        [b.revolute("ground", "upper", (0, -1, 0)), b.revolute("upper", "lower", (0, -1, 0), at=(0, 0, -l1))],
    )
    q, v = np.array([0.4, 0.9]), np.array([-1.1, 0.6])
    first = l1 * v[0] * np.array([np.cos(q[0]), np.sin(q[0])])
    second = first + 0.6 * (v[0] + v[1]) * np.array([np.cos(q[0] + q[1]), np.sin(q[0] + q[1])])
    height = -m1 * l1 * np.cos(q[0]) - m2 * (l1 * np.cos(q[0]) + 0.6 * np.cos(q[0] + q[1]))
    lagrangian = m1 * first @ first / 2 + m2 * second @ second / 2 - g * height
    assert value(model.system.lagrangian(jnp.array(q), jnp.array(v), None)) == pytest.approx(lagrangian, abs=1e-13)
    assert value(model.energy(q, v)) == pytest.approx(lagrangian + 2 * g * height, abs=1e-12)


@pytest.mark.parametrize("rotation", ["zxy", "quaternion"])
@pytest.mark.soak_of(but=["zxy"])
def test_a_free_body_keeps_momentum_and_angular_momentum_in_every_description(rotation):
    model = b.Model([b.Body("stone", **ROD, centre=(0.1, 0.2, 0.0))], [b.free("ground", "stone", rotation)], gravity=(0, 0, 0))
    n = len(model.coordinates)
    start = np.linspace(0.4, 0.9, n)
    data = model.state(start if rotation != "quaternion" else start / np.linalg.norm(start), np.linspace(-0.5, 0.8, n))
    sol = dx.simulate(model.system, dx.LagrangeDAlembert(), **data, step=0.002, steps=200, save_every=100)
    seen = model.observables(sol)
    assert np.ptp(seen["momentum"], axis=0).max() < 1e-5 and np.ptp(seen["angular_momentum"], axis=0).max() < 1e-5
    assert np.ptp(seen["energy"]) < 1e-5 and seen["energy"] == pytest.approx(sol.energy(), abs=1e-12)


def test_parameters_springs_dampers_and_motors():
    model = b.Model(
        [b.Body("cart", "m")],
        [b.prismatic("ground", "cart")],
        forces=[
            b.Spring("k", (("ground", (0.0, 0.0, 0.0)), ("cart", (0.0, 0.0, 0.0)))),
            b.Damper("c", coordinate="cart"),
            b.Motor("cart", lambda t, q, v, params: params["push"] * jnp.cos(t)),
        ],
        parameters={"m": 2.0, "k": 8.0, "c": 0.4, "push": 0.5},
    )
    found = model.accelerations([0.3], [0.7])["cart"]
    assert found == pytest.approx((0.5 - 8.0 * 0.3 - 0.4 * 0.7) / 2.0)
    assert model.accelerations([0.3], [0.7], {**model.params, "k": 0.0})["cart"] == pytest.approx((0.5 - 0.28) / 2)
    sol = dx.simulate(
        model.system, dx.LagrangeDAlembert(), **model.state({"cart": 0.3}), params=model.params, step=0.01, steps=10
    )
    assert sol.ok and sol.params["k"] == 8.0


@pytest.mark.soak
def test_a_ball_rolls_in_a_bowl():
    """On z = (x² + y²)/2 · k the contact stays on the surface, and the energy of a ball that starts at rest stays."""
    model = b.Model(
        [b.Body("ball", 1.0, (0.004, 0.004, 0.004))],
        [b.gliding("ground", "ball", lambda x, y: 0.5 * (x * x + y * y), 0.1)],
        contacts=[b.ball_contact("ball", 0.1)],
    )
    sol = dx.simulate(model.system, dx.LagrangeDAlembert(), **model.state({"ball.x": 0.3}), step=0.005, steps=400)
    assert sol.ok and np.ptp(sol.energy()) < 2e-3 * 0.5 and np.abs(sol.q[:, 1]).max() < 1e-12
    assert sol.q[:, 0].min() == pytest.approx(-0.3, abs=1e-3)


def test_a_loop_is_assembled_and_one_that_cannot_close_says_which_joint():
    def crank(rod):
        return b.Model(
            [b.Body("crank", **ROD), b.Body("rod", **ROD), b.Body("piston", 1.0)],
            [
                b.revolute("ground", "crank"),
                b.revolute("crank", "rod", at=(1.0, 0, 0)),
                b.prismatic("ground", "piston"),
                b.revolute("rod", "piston", name="pin", at=(rod, 0, 0), closes=True),
            ],
        )

    model = crank(2.5)
    data = model.state({"crank": 0.7}, {"crank": 1.0})
    q, v = dict(zip(model.coordinates, data["q"], strict=True)), dict(zip(model.coordinates, data["v"], strict=True))
    apart = q["piston"] - np.cos(0.7)
    assert apart**2 + np.sin(0.7) ** 2 == pytest.approx(2.5**2, abs=1e-12) and q["crank"] == 0.7
    assert apart * (v["piston"] + np.sin(0.7)) + np.sin(0.7) * np.cos(0.7) == pytest.approx(0.0, abs=1e-12)
    assert v["crank"] == 1.0
    with pytest.raises(ValueError, match=r"cannot be assembled.*pin: y by .*crank.*open"):
        crank(0.5).state({"crank": 1.2})


def slider_crank(unit, rod=2.5):
    """A crank of length 1, its rod and a piston, all lengths in this unit; the piston is held to its rail twice."""
    return b.Model(
        [b.rod("crank", (unit, 0, 0)), b.rod("rod", (rod * unit, 0, 0)), b.Body("piston", 1.0)],
        [
            b.revolute("ground", "crank"),
            b.revolute("crank", "rod", at=(unit, 0, 0)),
            b.prismatic("ground", "piston"),
            b.revolute("rod", "piston", name="pin", at=(rod * unit, 0, 0), closes=True),
        ],
    )


@pytest.mark.parametrize("unit", [2.0**-43, 2.0**-30, 2.0**35])
@pytest.mark.soak
def test_a_machine_is_assembled_alike_in_any_unit_of_length(unit):
    """Of 1e-13 m it had no constraints, of 1e10 those too that its joints meet; and its velocities were others."""
    plain, scaled, one = slider_crank(1.0), slider_crank(unit), np.array([1.0, 1.0, unit])
    wanted, found = (model.state({"crank": 0.7}, {"crank": 1.0}) for model in (plain, scaled))
    assert scaled.constraints == plain.constraints == ("pin: x", "pin: y")
    np.testing.assert_array_equal(found["q"] / one, wanted["q"])
    np.testing.assert_array_equal(found["v"] / one, wanted["v"])
    assert scaled.redundant(found["q"]) == plain.redundant(wanted["q"])
    for given in ({"q": {"crank": 1.2}}, {"q": {"crank": 0.7}, "v": {"crank": 1.0, "piston": 3.0 * unit}}):
        with pytest.raises(ValueError, match=r"no velocity|cannot be assembled"):
            slider_crank(unit, 0.5 if "v" not in given else 2.5).state(**given)


@pytest.mark.parametrize("rotation", ["quaternion", "axis"])
@pytest.mark.soak_of("quaternion")
def test_a_chain_that_is_straight_at_zero_is_bent_to_where_its_end_is_held(rotation):
    """At zero both rods point at their end, and no joint knows which way to give."""
    inertia, end = (0.1, 0.1, 0.0), (0.0, 0.0, 1.0)
    bodies = [b.Body(name, 1.0, inertia, centre=(0, 0, 0.5)) for name in "ac"]
    joints = [b.ball("ground", "a", rotation), b.ball("a", "c", rotation, at=end)]
    hold = b.ball("ground", "c", name="hold", at=(0.0, 0.0, 1.2), on=end, closes=True)
    model = b.Model(bodies, [*joints, hold])
    data = model.state()
    frames = model.frames(data["q"], data["v"])
    assert np.asarray(frames["c"].point(np.array(end))) == pytest.approx([0.0, 0.0, 1.2], abs=1e-11)
    assert float(frames["a"].point(np.array(end))[2]) == pytest.approx(0.6, abs=1e-11)


def rods(*names):
    return [b.Body(name, **ROD) for name in names]


@pytest.mark.parametrize(
    "bodies, joints, message",
    [
        ([b.Body("a", 0.0, (1, 1, 1))], [b.revolute("ground", "a")], "'a' has no mass, but moments of inertia"),
        (rods("a"), [b.revolute("ground", "a"), b.ball("ground", "a", name="b")], "'a' has two parents.*closes=True"),
        (rods("a", "c"), [b.revolute("ground", "a", name="j"), b.ball("a", "c", name="j")], "two joints are called 'j'"),
        (rods("a", "a"), [b.revolute("ground", "a")], "two bodies are called 'a'"),
        (rods("a", "c"), [b.revolute("ground", "a")], "'c' has no joint"),
        (rods("a", "c"), [b.revolute("a", "c"), b.revolute("c", "a", name="k")], "go round in a circle"),
        (rods("a"), [b.revolute("ground", "arm")], "joint 'arm' is at body 'arm', but the bodies are a, ground"),
        (rods("a"), [b.fixed("ground", "a")], "nothing can move"),
        ([b.Body("a", -1.0)], [b.revolute("ground", "a")], "negative mass"),
        (
            [b.Body("a", 1.0, (1.0, 0.1, 0.1))],
            [b.free("ground", "a")],
            r"no body has the moments of inertia \[0.1 0.1 1. \] of 'a'",
        ),
        ([b.Body("a", 1.0, np.diag([0.0, 0.1, 1.0]))], [b.free("ground", "a")], "larger than the other two together"),
    ],
)
def test_mistakes_get_one_error_each(bodies, joints, message):
    with pytest.raises(ValueError, match=message):
        b.Model(bodies, joints)


def of_one(body=None, joint=None, **more):
    return b.Model([body or rods("a")[0]], [joint or b.revolute("ground", "a")], **more)


WHEEL = b.rolling_wheel("ground", "a", 0.5)
BALL = b.gliding("ground", "a", lambda x, y: 0.1 * x * x, 0.5)


@pytest.mark.parametrize(
    "model, message",
    [
        (lambda: of_one(joint=b.revolute("ground", "a", (0, 0, 0))), "an axis of joint 'a' must be a direction"),
        (lambda: of_one(joint=b.revolute("ground", "a", at=(0, 1))), "at= of joint 'a' must be three numbers, but it is"),
        (lambda: of_one(gravity=(0, -9.81)), "gravity must be three numbers"),
        (lambda: of_one(b.Body("a", "m")), "mass of body 'a' is 'm', which is no parameter of the model: there are none"),
        (lambda: of_one(b.Body("a", np.nan)), "mass of body 'a' must be finite"),
        (lambda: of_one(b.Body("a", 1.0, 0.1)), "three principal moments or a matrix"),
        (lambda: of_one(b.Body("a")), "joint 'a' moves nothing that has a mass"),
        (lambda: of_one(forces=[b.Spring(1.0)]), "'spring' acts nowhere"),
        (lambda: of_one(forces=[b.Motor("a", lambda t: t)]), r"push of 'motor' must be a function of \(t, q, v\)"),
        (lambda: of_one(forces=[b.Motor("a", lambda q, v, t: t)]), r"takes \(q, v, t\), where q stands in the place of t"),
        (lambda: of_one(contacts=[b.tip("a", motion="roll")]), "must be one of rolls, skates, slides, but it is 'roll'"),
        (lambda: of_one(contacts=[b.ball_contact("a", -1.0)]), "negative radius"),
        (lambda: of_one(joint=WHEEL, contacts=[b.wheel("a", 0.4)]), "not the wheel of radius 0.5 and tube 0"),
        (lambda: of_one(joint=BALL, contacts=[b.ball_contact("a", 0.4)]), "not the ball of radius 0.5"),
        (lambda: b.Model({"a": 1}, []), "bodies must be a list of Body"),
        (lambda: of_one(b.Body("a", lambda p: p["m"])), "mass of body 'a' must be a number or the name of a parameter"),
        (lambda: jax.grad(lambda m: of_one(b.Body("a", m)))(1.0), r"mass of body 'a' is a value that JAX traces.* mass='mass'"),
    ],
)
def test_numbers_that_mean_nothing_get_one_error_each(model, message):
    with pytest.raises((ValueError, TypeError), match=message):
        model()


def test_mistakes_in_data_name_the_coordinates():
    model = b.Model(rods("a"), [b.ball("ground", "a")])
    with pytest.raises(ValueError, match=r"q has 'angle', but the coordinates are a\.qw"):
        model.state({"angle": 1.0})
    with pytest.raises(ValueError, match=r"shape \(4,\)"):
        model.state(np.zeros(3))
    with pytest.raises(ValueError, match=r"q of 'a\.qw' must be a finite number, but it is nan"):
        model.state({"a.qw": np.nan})
    with pytest.raises(ValueError, match="no velocity has the given ones"):
        model.state({"a.qw": 1.0}, {"a.qw": 1.0})
    with pytest.raises(ValueError, match="rotation must be"):
        b.ball("ground", "a", "zzq")
    with pytest.raises(ValueError, match="'a' has turned=, which a rotation from the ground does not feel"):
        b.ball("ground", "a", "attitude", turned=((0, 0, 1), 0.3))


def test_friction_without_a_normal_force_is_refused():
    model = b.Model(
        rods("a"),
        [b.gliding("ground", "a", lambda x, y: 0.1 * x * x, 0.5)],
        contacts=[b.ball_contact("a", 0.5, motion="slides", friction=0.2)],
    )
    with pytest.raises(ValueError, match=r"contact 'a' has friction, but its joint keeps it on the ground.*free\(\)"):
        _ = model.system


def test_loops_of_constraints_that_contradict_each_other_are_not_closed():
    """Two pins of one rod at a distance that it has not."""
    model = b.Model(
        rods("a"),
        [
            b.free("ground", "a", "zxz"),
            b.ball("ground", "a", name="first", closes=True),
            b.ball("ground", "a", name="second", at=(2.0, 0, 0), on=(1.0, 0, 0), closes=True),
        ],
    )
    with pytest.raises(ValueError, match=r"cannot be assembled.*(first|second): x by .*Change the lengths"):
        model.state()


WHERE = {"at": (0.3, -0.2, 0.5), "on": (0.1, 0.4, -0.3), "turned": ((1.0, 2.0, -1.0), 0.7)}


@pytest.mark.parametrize(
    "joint",
    [
        lambda **more: b.fixed("a", "c", name="j", **more),
        lambda **more: b.revolute("a", "c", (1, 2, 3), name="j", **more),
        lambda **more: b.prismatic("a", "c", (1, 2, 3), name="j", **more),
        lambda **more: b.universal("a", "c", (1, 2, 0), (-2, 1, 0), name="j", **more),
        lambda **more: b.ball("a", "c", name="j", **more),
        lambda **more: b.planar("a", "c", (1, 2, 3), name="j", **more),
    ],
)
def test_what_a_joint_of_the_tree_does_its_conditions_allow_and_nothing_else(joint):
    """Moved by its coordinates, a body meets the conditions of the joint that closes a loop, as many as take the rest of six."""
    model = b.Model(rods("a", "c"), [b.free("ground", "a", "zxz"), joint(**WHERE)])
    closing = joint(**WHERE, closes=True)
    q = np.random.default_rng(1).uniform(-1.0, 1.0, len(model.coordinates))
    frames = model.frames(q, np.zeros(q.size))
    defect = [float(x) for x in closing.defect(frames["a"], frames["c"], None)]
    assert defect == pytest.approx(np.zeros(len(closing.conditions)), abs=1e-14)
    coordinates = len(joint().coordinates) - (joint().kind == "ball")  # of a quaternion three are free
    assert len(defect) == 6 - coordinates


def test_velocities_are_the_derivatives_of_places():
    model = b.Model(
        rods("a", "c", "d", "e"),
        [
            b.free("ground", "a"),
            b.universal("a", "c", **WHERE),
            b.gliding("ground", "d", lambda x, y: 0.3 * jnp.sin(x) + 0.2 * x * y, 0.4, "zxz"),
            b.rolling_wheel("ground", "e", 0.5, 0.1),
        ],
    )
    rng = np.random.default_rng(2)
    q, v = rng.uniform(0.2, 0.9, (2, len(model.coordinates)))
    frames = model.frames(q, v)
    ahead, behind = (model.frames(q + s * 1e-6 * v, v) for s in (1, -1))
    for name in "acde":
        x = rng.uniform(-1.0, 1.0, 3)
        rate = (ahead[name].point(x) - behind[name].point(x)) / 2e-6
        assert frames[name].velocity_of(x) == pytest.approx(np.asarray(rate), abs=1e-8)


def test_chaplygins_sleigh():
    """u̇ = a ω², ω̇ = −m a u ω/(J + m a²) for the blade at the origin and the mass centre a ahead of it."""
    m, j, a, angle, u, omega = 1.5, 0.4, 0.3, 0.8, 1.2, 0.7
    model = b.Model(
        [b.Body("sleigh", m, (0, 0, j), centre=(a, 0, 0))], [b.planar("ground", "sleigh")], contacts=[b.blade("sleigh")]
    )
    assert model.constraints == ("sleigh: skates",)
    data = model.state({"sleigh.angle": angle}, {"sleigh.angle": omega, "sleigh.x": u * np.cos(angle)})
    assert data["v"][1] == pytest.approx(u * np.sin(angle))
    found = model.accelerations(**data)
    assert found["sleigh.angle"] == pytest.approx(-m * a * u * omega / (j + m * a**2))
    along = np.array([np.cos(angle), np.sin(angle)])
    assert along @ [found["sleigh.x"], found["sleigh.y"]] == pytest.approx(a * omega**2)


def test_friction_is_of_the_normal_force_and_dampers_take_energy():
    model = b.Model(
        [b.Body("ball", 2.0, (0.1, 0.1, 0.1))],
        [b.free("ground", "ball")],
        contacts=[b.ball_contact("ball", 0.5, motion="slides", friction=0.2)],
    )
    data = model.state({"ball.z": 0.5}, {"ball.x": 3.0, "ball.qx": 0.0, "ball.qy": 0.0})
    found = model.accelerations(**data)
    assert found["ball.x"] == pytest.approx(-0.2 * 9.81, rel=1e-6) and found["ball.z"] == pytest.approx(0.0, abs=1e-12)
    ends = (("ground", (1.0, 0.0, 1.0)), ("ball", (0.1, 0.2, 0.0)))
    damped = b.Model(model.bodies, model.joints, forces=[b.Damper(0.7, ends)])
    q, v = np.array([0.3, 0.2, 0.1, 0.8, 0.2, -0.4, 0.4]), np.array([0.5, -0.2, 0.3, 0.0, 0.4, 0.0, -0.2])
    frame = model.frames(q, v)["ball"]
    apart = np.asarray(frame.point(np.array([0.1, 0.2, 0.0]))) - [1.0, 0.0, 1.0]
    speed = apart @ np.asarray(frame.velocity_of(np.array([0.1, 0.2, 0.0]))) / np.linalg.norm(apart)
    force = damped.system.forces(0.0, q, v, None)
    assert v @ np.asarray(force) == pytest.approx(-0.7 * speed**2)


def test_friction_at_small_speeds_in_other_units():
    """Slipping at 2⁻¹⁴ of a length in a unit of time: 1e-3 in the user's own units was small in one and large in another."""

    def rate(length, time):
        model = b.Model(
            [b.Body("ball", 2.0, (0.1 * length**2,) * 3)],
            [b.free("ground", "ball")],
            contacts=[b.ball_contact("ball", "r", motion="slides", friction=0.2)],
            gravity=(0.0, 0.0, -8.0 * length / time**2),
            parameters={"r": 0.5 * length},
        )
        data = model.state({"ball.z": 0.5 * length}, {"ball.x": 2.0**-14 * length / time, "ball.qx": 0.0, "ball.qy": 0.0})
        return model.accelerations(**data)["ball.x"] / length * time**2

    plain = rate(1.0, 1.0)
    assert -1.6 < plain < -0.01 and plain == pytest.approx(-1.6 / np.hypot(1.0, 1e-3 * 2.0 / 2.0**-14), rel=1e-9)
    assert rate(2.0**-30, 2.0**-7) == pytest.approx(plain, rel=1e-12)


def test_friction_needs_to_know_which_speeds_are_small():
    ball = lambda **given: b.Model(
        [b.Body("ball", 2.0, (0.1, 0.1, 0.1))],
        [b.free("ground", "ball")],
        contacts=[b.ball_contact("ball", 0.5, motion="slides", friction=0.2, **given)],
        gravity=(0.0, 0.0, 0.0),
    )
    with pytest.raises(ValueError, match=r"contact 'ball' has friction, but the machine has no gravity.*give the contact creep="):
        _ = ball().system
    assert ball(creep=0.01).system.forces is not None


def test_a_machine_with_parameters_is_drawn():
    import jax

    model = b.Model(
        [b.Body("wheel", "m", (0.1, 0.2, 0.1))],
        [b.rolling_wheel("ground", "wheel", 0.5)],
        contacts=[b.wheel("wheel", "r")],
        forces=[b.Spring(1.0, (("ground", (0.0, 0.0, 1.0)), ("wheel", (0.0, 0.0, 0.0))))],
        parameters={"m": 1.0, "r": 0.5},
    )
    parts = {part.kind: part for part in model.scene().parts}
    assert set(parts) == {"plane", "disk", "spring"} and parts["disk"].settings["radius"] == 0.5
    for params in (None, model.params):
        turn = jax.eval_shape(lambda q, params=params: parts["disk"].places["turn"](q, params), np.zeros(5))
        assert turn.shape == (3, 3)
    assert np.asarray(parts["spring"].places["end"](np.zeros(5), None)) == pytest.approx([0.0, 0.0, 0.5])


@pytest.mark.parametrize("axis", [(0, 0, 1), (0, 0, -1), (0, 1, 0), (1, 2, -3), (-1e-5, 0, -1), (1e-200, 0, 1)])
def test_wheels_are_drawn_across_their_axes(axis):
    axis = np.array(axis) / np.linalg.norm(axis)
    turn = _from_z(axis)
    np.testing.assert_allclose(turn @ [0.0, 0.0, 1.0], axis, atol=1e-9)
    np.testing.assert_allclose(turn.T @ turn, np.eye(3), atol=1e-9)
    assert np.linalg.det(turn) == pytest.approx(1.0)


def test_a_carriage_without_mass_has_no_accelerations_of_its_own():
    """Between two springs: accelerations of least squares were returned, −.375 for −.1875 and −.5625, and ω = 1 for √¾."""
    springs = [b.Spring(3.0, coordinate="light"), b.Spring(1.0, coordinate="m")]
    joints = [b.prismatic("ground", "light"), b.prismatic("light", "m")]
    model = b.Model([b.Body("light", 0.0), b.Body("m", 1.0)], joints, forces=springs, gravity=(0, 0, 0))
    with pytest.raises(ValueError, match=r"do not determine the accelerations: .* no mass"):
        model.accelerations(**model.state({"light": 0.25, "m": 0.75}))
    found = dx.linearize(model.system, {"q": [0.0, 0.0], "v": [0.0, 0.0]}, params=model.params)
    np.testing.assert_allclose(np.sort(found.eigenvalues.imag), [-np.sqrt(0.75), np.sqrt(0.75)], rtol=1e-12)
