"""Forces that see multipliers of constraints that follow from others: refused, unless they see only what is determined."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dirax as dx

FRICTION = 0.3


def bead(share, scale=1.0):
    """A bead on a hoop that is stated twice, the second time with other units, slowed by the load that `share` makes of both."""
    load = lambda multipliers: jnp.abs(jnp.asarray(share) @ multipliers)
    return dx.LagrangeDirac(
        lambda q, v: v @ v / 2,
        holonomic=lambda q: jnp.stack([q @ q - 1, scale * (q @ q - 1)]) / 2,
        forces=lambda t, q, v, multipliers, params: -params * load(multipliers) * v / jnp.sqrt(v @ v),
    )


SCHEMES = [dx.LagrangeDAlembert(), dx.DiscreteDirac(constraints="resolve")]
RUN = {"q": [1.0, 0.0], "v": [0.0, 1.0], "step": 0.01, "steps": 200}


@pytest.mark.parametrize("scheme", SCHEMES)
@pytest.mark.parametrize("scale", [1.0, 2.0**-40, 2.0])
@pytest.mark.soak
def test_a_load_that_is_not_determined_is_refused_and_one_that_is_slows_the_bead(scheme, scale):
    for share in ([1.0, 0.0], [0.0, 1.0], [1.0, scale * 1.001]):
        with pytest.raises(ValueError, match=r"nothing determines: the constraints \(holonomic\) have rank 1 of 2"):
            dx.simulate(bead(share, scale), scheme, **RUN, params=FRICTION)
    sol = dx.simulate(bead([1.0, scale], scale), scheme, **RUN, params=FRICTION)
    assert np.linalg.norm(sol.p[-1]) == pytest.approx(1 / (1 + 2 * FRICTION), abs=1e-4)  # v̇ = −μ v² on the unit circle


@pytest.mark.soak
def test_the_same_under_transformations_of_jax():
    speed = lambda share: lambda friction: jnp.linalg.norm(dx.simulate(bead(share), SCHEMES[0], **RUN, params=friction).p[-1])
    for transformed in (jax.grad, jax.jit):
        with pytest.raises(ValueError, match="nothing determines"):
            transformed(speed([0.0, 1.0]))(FRICTION)
    assert jax.grad(speed([1.0, 1.0]))(FRICTION) == pytest.approx(-2 / (1 + 2 * FRICTION) ** 2, rel=1e-3)


def test_a_block_on_four_feet_is_refused_and_on_three_it_runs():
    """Pushed straight ahead, the block on four feet turned one way or the other, by the order in which they were stated."""
    b, feet = dx.bodies, [(0.2, 0.2, 0.0), (-0.2, 0.2, 0.0), (-0.2, -0.2, 0.0), (0.2, -0.2, 0.0)]

    def block(feet):
        tips = [b.tip("block", at=at, name=f"t{k}", motion="slides", friction=0.3, creep=1e-2) for k, at in enumerate(feet)]
        body = b.Body("block", 1.5, inertia=(0.02, 0.03, 0.04), centre=(0, 0, 0.1))
        model = b.Model([body], [b.free("ground", "block", rotation="zyx")], contacts=tips)
        return dx.simulate(model.system, SCHEMES[0], **model.state({}, {"block.x": 1.0}), step=1e-3, steps=20)

    with pytest.raises(ValueError, match=r"rank 3 of 4.*support a body at three points"):
        block(feet)
    assert block(feet[:3]).ok


@pytest.mark.soak
def test_they_are_reported_beside_walls_too():
    twice = lambda q: jnp.stack([q[1], 2.0 * q[1]])
    system = dx.LagrangeDirac(lambda q, v: v @ v / 2, holonomic=twice)
    start = {"q": [1.0, 0.0], "v": [-1.0, 0.0], "step": 0.1, "steps": 20}
    sol = dx.simulate(system, dx.LagrangeDAlembert(), events=[dx.Impact(lambda q: q[0])], **start)
    assert sol.stats["redundant_constraints"] == [1] and len(sol.events) == 1
