"""One machine with its rotations as Euler angles, as quaternions of length 1, and on SO(3) by a discretization map."""

import jax.numpy as jnp
import numpy as np
import pytest

import dirax as dx
from dirax.gallery import spherical_pendulums

b = dx.bodies
TOP = b.Body("top", 1.0, (0.1, 0.1, 0.05), centre=(0, 0, 0.4))
CASES = {  # rotation of the joint, initial place and velocities of one motion
    "zxz": ({"top.nutation": 0.5}, {"top.spin": 9.0, "top.precession": 0.0}),
    "quaternion": (
        {"top.qx": np.sin(0.25)},
        {"top.qz": 4.5 * np.cos(0.25), "top.qy": -4.5 * np.sin(0.25), "top.qx": 0.0},
    ),
}


def turned(model, q):
    return np.asarray(model.frames(q, np.zeros(len(q)))["top"].turn)


@pytest.mark.soak
def test_one_model_has_one_motion_in_all_three():
    step = {"step": 2e-3, "steps": 250, "save_every": 250}
    ends = []
    for rotation, (place, velocity) in CASES.items():
        model = b.Model([TOP], [b.ball("ground", "top", rotation)])
        data = model.state(place, velocity)
        sol = dx.simulate(model.system, dx.LagrangeDAlembert(), **data, **step)
        ends.append(turned(model, sol.q[-1]))
        if rotation == "quaternion":
            on_group = dx.simulate(model.manifold_system, dx.DiscreteDirac(model.discretization_map), **data, **step)
            ends.append(turned(model, on_group.q[-1]))
            assert on_group.q[-1] @ on_group.q[-1] == pytest.approx(1.0, abs=1e-15)
            about_vertical = model.observables(on_group)["angular_momentum"][:, 2]
            assert about_vertical[-1] == pytest.approx(about_vertical[0], rel=1e-12) and about_vertical[0] > 0.3
    for end in ends[1:]:
        assert end == pytest.approx(ends[0], abs=1e-3)


@pytest.mark.soak
def test_a_rolling_ball_on_the_group_keeps_its_contact_and_its_momentum():
    """Holonomic constraints and one-forms on R³ × SO(3), at the nodes to roundoff; Chaplygin's integral. The page of the machines
    has the same ball in both descriptions."""
    ball = b.Model(
        [b.Body("ball", 1.0, (0.2, 0.35, 0.5))],
        [b.free("ground", "ball")],
        contacts=[b.ball_contact("ball", 1.0)],
        gravity=(0, 0, 0),
    )
    data = ball.state({"ball.z": 1.0, "ball.qx": 0.3}, {"ball.x": 0.5, "ball.qz": 0.6})
    scheme = dx.DiscreteDirac(ball.discretization_map, "resolve")
    assert ball.manifold_system.manifold.dimension == 6
    about = lambda q, v: ball.angular_momentum(q, v, about=q[:3] - np.array([0.0, 0.0, 1.0]))
    sol = dx.simulate(ball.manifold_system, scheme, **data, step=0.02, steps=100, save_every=100)
    assert sol.ok and np.abs(sol.constraint_residual()).max() < 1e-13 and np.abs(sol.q[:, 2] - 1.0).max() < 1e-14
    seen = ball.observables(sol, about=about)
    assert np.ptp(seen["about"], axis=0).max() < 1e-4 and np.ptp(seen["energy"]) < 1e-6
    both = dx.simulate(ball.system, dx.LagrangeDAlembert(), **data, step=0.02, steps=100, save_every=100)
    assert sol.q[-1] == pytest.approx(both.q[-1], abs=1e-3) and np.abs(sol.q[-1] - sol.q[0]).max() > 0.5


def test_a_rod_by_its_axis_is_a_conical_pendulum_in_coordinates_and_on_the_sphere():
    """Ω² = m g c/((I + m c²) cos θ)."""
    mass, across, centre, tilt = 1.3, 0.1, 0.4, 0.7
    model = b.Model([b.Body("rod", mass, (across, across, 0.02), centre=(0, 0, centre))], [b.ball("ground", "rod", "axis")])
    assert model.coordinates == ("rod.ux", "rod.uy", "rod.uz") and model.constraints == ("rod: |u| = 1",)
    rate = np.sqrt(mass * 9.81 * centre / ((across + mass * centre**2) * np.cos(tilt)))
    at = lambda angle: np.array([np.sin(tilt) * np.cos(angle), np.sin(tilt) * np.sin(angle), -np.cos(tilt)])
    data = model.state(at(0.0), rate * np.cross([0, 0, 1], at(0.0)))
    sphere = dx.DiscreteDirac(model.discretization_map)
    for system, scheme in ((model.system, dx.LagrangeDAlembert()), (model.manifold_system, sphere)):
        sol = dx.simulate(system, scheme, **data, step=2e-3, steps=500)
        assert sol.q[-1] == pytest.approx(at(rate * sol.t[-1]), abs=1e-4)
        assert np.abs(np.linalg.norm(sol.q, axis=1) - 1).max() < 1e-15
        seen = model.observables(sol)
        assert seen["angular_momentum"][:, 2] == pytest.approx(rate * (across + mass * centre**2) * np.sin(tilt) ** 2, abs=1e-12)


def test_rods_that_hang_on_each_other_are_the_double_spherical_pendulum():
    given = spherical_pendulums.PARAMS
    model = b.Model(
        [b.Body("a", given["m1"], centre=(0, 0, given["l1"])), b.Body("c", given["m2"], centre=(0, 0, given["l2"]))],
        [b.ball("ground", "a", "axis"), b.ball("a", "c", "axis", at=(0, 0, given["l1"]))],
        gravity=(0, 0, -given["g"]),
    )
    q, v = jnp.array(np.random.default_rng(4).normal(size=(2, 6)))
    found, expected = model.system.lagrangian(q, v, None), spherical_pendulums.lagrangian(q, v, given)
    assert float(found) == pytest.approx(float(expected), abs=1e-13)


def test_an_attitude_is_the_quaternion_from_the_ground():
    """Of a body that hangs on another one: Q = Q₁ Q₂, and the same Lagrangian."""
    rng, bodies = np.random.default_rng(6), [b.Body(name, 1.0, (0.1, 0.2, 0.25), centre=(0.1, 0.2, 0.3)) for name in "ac"]
    relative, absolute = (
        b.Model(bodies, [b.ball("ground", "a"), b.ball("a", "c", rotation, at=(0.3, 0.4, 1.0))])
        for rotation in ("quaternion", "attitude")
    )
    first, second, rate, other = rng.normal(size=(4, 4))

    def product(p, q):
        return np.concatenate([[p[0] * q[0] - p[1:] @ q[1:]], p[0] * q[1:] + q[0] * p[1:] + np.cross(p[1:], q[1:])])

    first, second = first / np.linalg.norm(first), second / np.linalg.norm(second)
    rate, other = rate - (rate @ first) * first, other - (other @ second) * second
    q, v = np.concatenate([first, second]), np.concatenate([rate, other])
    there = np.concatenate([first, product(first, second)])
    moving = np.concatenate([rate, product(rate, second) + product(first, other)])
    expected = float(relative.system.lagrangian(jnp.array(q), jnp.array(v), None))
    assert float(absolute.system.lagrangian(jnp.array(there), jnp.array(moving), None)) == pytest.approx(expected, abs=1e-12)


@pytest.mark.parametrize(
    "body, joints, message",
    [
        ({"inertia": (0.1, 0.2, 0.15)}, [], "moments of inertia across it differ"),
        ({"centre": (0.1, 0, 0.4)}, [], "mass centre is beside it"),
        ({}, [b.revolute("rod", "arm")], "'arm' is revolute, which holds more of it"),
        ({}, [b.ball("rod", "arm", at=(0.1, 0, 0))], "'arm' is beside it"),
        ({}, [b.free("ground", "arm"), b.fixed("arm", "rod", name="weld", closes=True)], "'weld' is fixed"),
    ],
)
def test_what_needs_more_than_the_axis_is_refused(body, joints, message):
    bodies = [b.Body("rod", **{"mass": 1.0, "inertia": (0.1, 0.1, 0.0), **body}), *([b.Body("arm", 1.0)] if joints else [])]
    with pytest.raises(ValueError, match=rf"body 'rod' is stated by its axis z alone.*{message}.*quaternion"):
        b.Model(bodies, [b.ball("ground", "rod", "axis"), *joints])


def test_friction_of_the_normal_force_is_not_stated_on_the_group():
    ball = b.Model(
        [b.Body("ball", 1.0, (0.2, 0.2, 0.2))],
        [b.free("ground", "ball")],
        contacts=[b.ball_contact("ball", 1.0, motion="slides", friction=0.1)],
    )
    with pytest.raises(ValueError, match=r"Coulomb friction.*take model\.system"):
        _ = ball.manifold_system
