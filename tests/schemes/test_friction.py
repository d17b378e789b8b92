"""Forces that see the multipliers: Coulomb friction, against exact motions."""

import jax.numpy as jnp
import numpy as np
import pytest

import dirax as dx

MU = 0.3
SLIDES = (
    dx.LagrangeDAlembert(),
    dx.LagrangeDAlembert("trapezoidal"),
    dx.DiscreteDirac(constraints="resolve"),
)


def friction(multipliers, direction, size=1.0):
    """μ|N| against a motion that does not come to rest."""
    return -MU * size * jnp.sum(jnp.abs(multipliers)) * direction / jnp.sqrt(direction @ direction)


HOOP = dx.LagrangeDirac(
    lambda q, v: v @ v / 2,
    holonomic=lambda q: jnp.array([(q @ q - 1.0) / 2]),
    forces=lambda t, q, v, multipliers: friction(multipliers, v),
)
SLOPE = dx.LagrangeDirac(
    lambda q, v, params: params["m"] * (v @ v / 2 - params["g"] * q[1]),
    one_forms=lambda q: jnp.array([[-jnp.sin(0.5), jnp.cos(0.5)]]),
    forces=lambda t, q, v, multipliers, params: params["grip"] * friction(multipliers, v),
)


def on_the_hoop(scheme, h):
    """A bead on a hoop without gravity: N = mv², v̇ = −μv², angle ln(1 + μ v₀ t)/μ."""
    sol = dx.simulate(HOOP, scheme, q=[1.0, 0.0], v=[0.0, 1.0], step=h, steps=round(2.0 / h))
    angle = np.unwrap(np.arctan2(sol.q[:, 1], sol.q[:, 0]))
    speed = np.linalg.norm(sol.p, axis=1)
    force = sol.multipliers[:, 0] / (-1.0 if isinstance(scheme, dx.DiscreteDirac) else h)
    middle = sol.t[:-1] + h / 2
    return sol, [
        np.max(np.abs(angle - np.log1p(MU * sol.t) / MU)),
        np.max(np.abs(speed - 1 / (1 + MU * sol.t))),
        np.max(np.abs(force - (1 / (1 + MU * middle)) ** 2)),
        abs(sol.work[-1] - sol.energy()[-1] + sol.energy()[0]),
    ]


@pytest.mark.parametrize("scheme", SLIDES, ids=["midpoint", "trapezoidal", "resolve"])
def test_a_bead_on_a_hoop_is_slowed_at_second_order(scheme):
    sol, coarse = on_the_hoop(scheme, 0.1)
    _, fine = on_the_hoop(scheme, 0.05)
    _, finer = on_the_hoop(scheme, 0.025)
    assert sol.stats["engine"] == "native"
    for errors in zip(coarse, fine, finer, strict=True):
        if max(errors) > 1e-13:  # the work of Method 2 is exact
            np.testing.assert_allclose(np.log2(np.array(errors[:-1]) / errors[1:]), 2.0, atol=0.15)
    assert max(coarse[:2]) < 2e-3


@pytest.mark.parametrize("scheme", (dx.PlusLagrangeDirac(), dx.MinusLagrangeDirac()), ids=["plus", "minus"])
def test_one_sided_schemes_keep_their_first_order(scheme):
    errors = [on_the_hoop(scheme, h)[1][0] for h in (0.02, 0.01)]
    assert 0.8 < np.log2(errors[0] / errors[1]) < 2.2 and errors[1] < 0.02


@pytest.mark.parametrize(
    ("scheme", "engine"), [*((scheme, "native") for scheme in SLIDES), (SLIDES[0], "xla"), (SLIDES[2], "xla")]
)
@pytest.mark.soak_of("scheme3-xla", "scheme4-xla")
def test_a_block_slides_down_a_slope(scheme, engine):
    """v̇ = g(sin α − μ cos α), exactly, with N = m g cos α."""
    params = {"m": 2.0, "g": 9.81, "grip": 1.0}
    along = np.array([np.cos(0.5), np.sin(0.5)])
    sol = dx.simulate(SLOPE, scheme, q=[0.0, 0.0], v=-along, params=params, step=0.1, steps=10, engine=engine)
    rate = 9.81 * (np.sin(0.5) - MU * np.cos(0.5))
    np.testing.assert_allclose(sol.q, -np.outer(sol.t + rate * sol.t**2 / 2, along), atol=1e-11)
    np.testing.assert_allclose(sol.work[-1], -MU * 2.0 * 9.81 * np.cos(0.5) * np.linalg.norm(sol.q[-1]), rtol=1e-11)
    np.testing.assert_allclose(sol.energy()[-1] - sol.energy()[0], sol.work[-1], rtol=1e-10)


def test_a_composition_keeps_its_order():
    errors = [on_the_hoop(dx.Composition(dx.LagrangeDAlembert(), "suzuki4"), h)[1][:2] for h in (0.2, 0.1)]
    assert np.all(np.log2(np.array(errors[0]) / errors[1]) > 3.7)


def test_what_does_not_see_the_multipliers_says_so():
    with pytest.raises(ValueError, match="there are none: give one_forms= or holonomic="):
        dx.LagrangeDirac(lambda q, v: v @ v / 2, forces=lambda t, q, v, multipliers: v)
    with pytest.raises(TypeError, match=r"forces\(t, q, v, multipliers\[, params\]\).* but a function of \(q, v, multipliers\)"):
        dx.LagrangeDirac(lambda q, v: v @ v / 2, holonomic=lambda q: q[:1], forces=lambda q, v, multipliers: v)
    with pytest.raises(TypeError, match=r"with an argument of that name .* but a function of \(t, q, v, mu, P\) was given"):
        dx.LagrangeDirac(lambda q, v: v @ v / 2, holonomic=lambda q: q[:1], forces=lambda t, q, v, mu, P: -mu[0] * P * v)
    unnamed = dx.LagrangeDirac(lambda q, v: v @ v / 2, holonomic=lambda q: q[:1], forces=lambda t, q, v, lam: lam[0] * v)
    with pytest.raises(TypeError, match="its argument lam stands for params, which were not given"):
        dx.simulate(unnamed, dx.LagrangeDAlembert(), q=[0.0, 1.0], v=[0.0, 1.0], step=0.1, steps=2)
    with pytest.raises(TypeError, match="forces cannot see the multipliers here"):
        dx.ManifoldLagrangian(lambda q, v: v @ v / 2, dx.Sphere(3), forces=lambda t, q, v, multipliers: v)
    with pytest.raises(TypeError, match=r"forces that see the multipliers are for dx\.LagrangeDAlembert"):
        dx.simulate(HOOP, dx.DiscreteDirac(), q=[1.0, 0.0], v=[0.0, 1.0], step=0.1, steps=2)


def test_verify_says_what_it_cannot_check():
    sol = dx.simulate(HOOP, SLIDES[0], q=[1.0, 0.0], v=[0.0, 1.0], step=0.1, steps=20)
    assert "the forces see the multipliers" in str(dx.verify(sol))


def test_a_norm_of_multipliers_that_begin_at_zero_is_named():
    bead = dx.LagrangeDirac(
        lambda q, v: v @ v / 2 - q[2],
        holonomic=lambda q: jnp.array([q[0] - jnp.cos(q[2]), q[1] - jnp.sin(q[2])]),
        forces=lambda t, q, v, multipliers: -0.3 * jnp.linalg.norm(multipliers) * v / jnp.sqrt(v @ v),
    )
    with pytest.raises(ValueError, match="have no derivative at multipliers of zero, with which a run begins"):
        dx.simulate(bead, dx.LagrangeDAlembert(), q=[1.0, 0.0, 0.0], v=[0.0, 1.0, 1.0], step=0.01, steps=2)
