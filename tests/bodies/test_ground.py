"""Wheels on ground that is not level, against closed equations and tilted gravity."""

import jax.numpy as jnp
import numpy as np
import pytest

import dirax as dx

b = dx.bodies
RADIUS, MASS, AXLE = 0.4, 2.0, 0.2
DISC = b.Body("disc", MASS, (0.1, AXLE, 0.1))


def disc(height=None, gravity=(0.0, 0.0, -9.81)):
    return b.Model(
        [DISC],
        [b.rolling_wheel("ground", "disc", RADIUS, height=height)],
        contacts=[b.wheel("disc", RADIUS)],
        gravity=gravity,
    )


def test_a_plane_that_leans_is_a_level_one_under_other_gravity():
    slope, data = 0.3, ([0.2, 0.1, 0.7, 0.3, 0.4], [1.0, 0.5, -0.4, 0.8])
    level = disc(gravity=(-9.81 * np.sin(np.arctan(slope)), 0.0, -9.81 * np.cos(np.arctan(slope))))
    leaning = disc(lambda x, y: slope * x)
    length = np.sqrt(1 + slope**2)
    q, rest = data
    start = level.state(q, dict(zip(("disc.yaw", "disc.roll", "disc.spin"), rest[1:], strict=True)))
    other = leaning.state([q[0] / length, *q[1:]], dict(zip(("disc.yaw", "disc.roll", "disc.spin"), rest[1:], strict=True)))
    assert other["v"] == pytest.approx(start["v"] / [length, 1, 1, 1, 1], abs=1e-12)
    found, expected = leaning.accelerations(**other), level.accelerations(**start)
    assert found["disc.x"] * length == pytest.approx(expected["disc.x"], abs=1e-10)
    assert [found[name] for name in leaning.coordinates[1:]] == pytest.approx(
        [expected[name] for name in level.coordinates[1:]], abs=1e-10
    )


@pytest.mark.soak
def test_a_wheel_in_a_round_valley_is_a_pendulum():
    """(m + J/r²)(R − r) θ̈ = −m g sin θ for an upright wheel, the contact at x = R sin θ."""
    round_, angle = 3.0, 0.6
    model = disc(lambda x, y: round_ - jnp.sqrt(round_**2 - x * x))
    data = model.state({"disc.x": round_ * np.sin(angle)})
    rate = -MASS * 9.81 * np.sin(angle) / ((MASS + AXLE / RADIUS**2) * (round_ - RADIUS))
    found = model.accelerations(**data)
    assert found["disc.x"] == pytest.approx(round_ * np.cos(angle) * rate, abs=1e-10)
    assert [found[f"disc.{name}"] for name in ("y", "yaw", "roll")] == pytest.approx([0.0] * 3, abs=1e-10)
    sol = dx.simulate(model.system, dx.LagrangeDAlembert(), **data, step=0.01, steps=300)
    assert sol.ok and np.ptp(sol.energy()) < 1e-3 * MASS * 9.81 and sol.q[:, 0].min() < -0.99 * data["q"][0]


@pytest.mark.soak
def test_velocities_on_a_surface_are_derivatives_of_places():
    model = disc(lambda x, y: 0.3 * jnp.sin(x) + 0.2 * x * y)
    q, v = np.random.default_rng(3).uniform(0.2, 0.9, (2, 5))
    x = np.array([0.3, -0.2, 0.1])
    ahead, behind = (np.asarray(model.frames(q + s * 1e-6 * v, v)["disc"].point(x)) for s in (1, -1))
    assert model.frames(q, v)["disc"].velocity_of(x) == pytest.approx((ahead - behind) / 2e-6, abs=1e-8)
    turn = np.asarray(model.frames(q, v)["disc"].turn)
    assert turn @ turn.T == pytest.approx(np.eye(3), abs=1e-14) and np.linalg.det(turn) > 0


@pytest.mark.soak
def test_symmetries_of_a_ball_that_slides_with_friction():
    """Its forces see the normal force, which is the same wherever it is."""
    ball = b.Model(
        [b.Body("ball", 1.0, (0.2, 0.2, 0.2))],
        [b.free("ground", "ball", "zxz")],
        contacts=[b.ball_contact("ball", 1.0, motion="slides", friction=0.1)],
    )
    found = dx.translation_symmetries(ball.system, [0.0, 0.0, 1.0, 0.1, 0.6, 0.2], radius=0.3)
    span = found.T @ found
    assert np.diag(span)[:3] == pytest.approx([1.0, 1.0, 0.0], abs=1e-9) and np.diag(span)[4] < 0.5
    uneven = dx.LagrangeDirac(
        lambda q, v: v @ v / 2 - q[1],
        holonomic=lambda q: q[1:],
        forces=lambda t, q, v, multipliers: jnp.stack([-jnp.maximum(-multipliers[0], 0.0) * jnp.sin(q[0]), 0.0 * q[0]]),
    )
    assert len(dx.translation_symmetries(uneven, [0.3, 0.0])) == 0
