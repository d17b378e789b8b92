"""Method 2 with holonomic constraints: a spherical pendulum in curved coordinates of R³ against its angles, a pivot that
moves, both kinds of constraints, redundant ones, and what `NonholonomicMechanics` makes of them.

The oracles are scipy's DOP853 at tight tolerance in angles and closed forms.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dirax as dx
from curved_pendulum import along, exact, metric, place, slopes, sphere
from dirax.schemes import blm_method_2_step

METHOD_2 = dx.DiscreteDirac(constraints="resolve")


height = lambda y: place(y)[2]
SPHERICAL = dx.NonholonomicMechanics(metric, height, holonomic=sphere)


def exact_pendulum(times, middle):
    """(y, p, λ) with λ at the times `middle`."""
    return (*exact(times)[:2], exact(middle)[2])


Y0, P0, _ = (a[0] for a in exact_pendulum(np.array([0.0, 1.0]), np.array([0.5])))


def pendulum_errors(system, scheme, steps, time=2.0, **more):
    sol = dx.simulate(system, scheme, q=Y0, p=P0, step=time / steps, steps=steps, **more)
    exact = exact_pendulum(sol.t, (sol.t[1:] + sol.t[:-1]) / 2)
    found = (sol.q, sol.p, sol.multipliers)
    return [np.max(np.abs(one - other)) for one, other in zip(found, exact, strict=True)], sol


@pytest.mark.soak
def test_orders_of_q_p_and_the_tension_and_the_size_of_the_constraints():
    errors = []
    for steps in (50, 100, 200):
        found, sol = pendulum_errors(SPHERICAL, METHOD_2, steps)
        errors.append(found)
        assert sol.ok and np.max(np.abs(sol.constraint_residual())) < 5e-15
    assert slopes(errors) == pytest.approx(2.0, abs=0.1)


more = lambda scheme: pytest.param(scheme, marks=pytest.mark.soak)


@pytest.mark.parametrize(
    "scheme",
    [METHOD_2, *map(more, (dx.PlusLagrangeDirac(), dx.DiscreteDirac(), dx.LagrangeDAlembert(), dx.MinusLagrangeDirac()))],
)
def test_the_lagrangian_and_its_mechanics_are_one_system(scheme):
    lagrangian = dx.LagrangeDirac(lambda y, v: v @ metric(y) @ v / 2 - height(y), holonomic=sphere)
    run = {"q": Y0, "p": P0, "step": 0.05, "steps": 40}
    one, other = (dx.simulate(system, scheme, **run) for system in (lagrangian, SPHERICAL))
    np.testing.assert_allclose(one.q, other.q, atol=1e-13)
    np.testing.assert_allclose(one.p, other.p, atol=1e-13)
    np.testing.assert_allclose(one.multipliers, other.multipliers, atol=1e-11)


def test_multipliers_projector_and_residual_at_a_point():
    y, p = jnp.asarray(Y0), jnp.asarray(P0)
    _, _, tension = exact(np.array([0.0, 1.0]))
    assert SPHERICAL.multipliers(y, p) == pytest.approx(tension[0], abs=1e-12)
    x, jacobian = place(y), jax.jacfwd(place)(y)
    off = p + jnp.array([0.1, -0.3, 0.2])
    velocity = jnp.linalg.solve(jacobian.T, off)  # ẋ, as p = (Dx)ᵀẋ
    assert SPHERICAL.projector(y, off) == pytest.approx(np.asarray(jacobian.T @ (velocity - (velocity @ x) * x)), abs=1e-14)
    assert SPHERICAL.constraint_at({"q": y, "p": off}, None) == pytest.approx([0.0, 2 * float(velocity @ x)], abs=1e-14)
    assert not SPHERICAL.closed_form
    with pytest.raises(ValueError, match="off the constraint"):
        dx.simulate(SPHERICAL, METHOD_2, q=y, p=off, step=0.1, steps=1)
    sol = dx.simulate(SPHERICAL, METHOD_2, q=y * 1.05, p=off, step=0.1, steps=1, project=True)
    assert np.max(np.abs(sol.constraint_residual())) < 5e-15


def test_constraints_over_many_steps():
    sol = dx.simulate(SPHERICAL, METHOD_2, q=Y0, p=P0, step=0.02, steps=50_000, save_every=50, engine="native")
    assert sol.ok and np.max(np.abs(sol.constraint_residual())) < 5e-15
    assert np.max(np.abs(sol.energy() - sol.energy()[0])) < 1e-4


@pytest.mark.soak
def test_composition_raises_the_order_and_keeps_the_constraints():
    errors = []
    for steps in (10, 20, 40):
        found, sol = pendulum_errors(SPHERICAL, dx.Composition(METHOD_2, "suzuki4"), steps)
        errors.append(found[:2])
        assert np.max(np.abs(sol.constraint_residual())) < 5e-15
    assert slopes(errors) == pytest.approx(4.0, abs=0.25)


def test_the_step_is_self_adjoint():
    forth = dx.simulate(SPHERICAL, METHOD_2, q=Y0, p=P0, step=0.1, steps=10)
    back = dx.simulate(SPHERICAL, METHOD_2, q=forth.q[-1], p=-forth.p[-1], step=0.1, steps=10)  # reversible
    np.testing.assert_allclose(back.q[-1], Y0, atol=1e-14)
    np.testing.assert_allclose(-back.p[-1], P0, atol=1e-14)


FLAT = dx.NonholonomicMechanics(  # on an ellipse, so that g keeps no sum of squares by itself
    lambda q: jnp.eye(2), lambda q: q[1], holonomic=lambda q: jnp.stack([q[0] ** 2 + 2 * q[1] ** 2 + q[0] ** 4 - 2.0])
)
FLAT_START = {"q": np.array([1.0, 0.0]), "v": np.array([0.0, 0.7])}


@pytest.mark.soak
def test_engines_and_batches_agree():
    run = {"step": 0.1, "steps": 10}
    batch = {"q": np.stack([FLAT_START["q"]] * 2), "v": np.stack([FLAT_START["v"], -0.5 * FLAT_START["v"]])}
    native, xla = (dx.simulate(FLAT, METHOD_2, engine=e, **batch, **run) for e in ("native", "xla"))
    for name, tolerance in (("q", 1e-13), ("p", 1e-13), ("multipliers", 1e-12)):
        np.testing.assert_allclose(native.fields[name], xla.fields[name], atol=tolerance)
    alone = dx.simulate(FLAT, METHOD_2, **FLAT_START, **run)
    np.testing.assert_array_equal(alone.p, native.p[0])


@pytest.mark.soak
def test_a_gradient_against_finite_differences():
    def end(scale):
        sol = dx.simulate(FLAT, METHOD_2, q=FLAT_START["q"], v=scale * FLAT_START["v"], step=0.1, steps=10)
        return sol.q[-1, 1] + sol.p[-1, 0]

    slope = jax.jit(jax.grad(end))(1.0)
    assert slope == pytest.approx((float(end(1 + 1e-5)) - float(end(1 - 1e-5))) / 2e-5, rel=1e-7)


@pytest.mark.parametrize("theta", [0.0, 1.0])
@pytest.mark.soak_of("1.0")
def test_one_sided_maps_keep_the_constraints_too(theta):
    errors = []
    for steps in (50, 100, 200):
        scheme = dx.DiscreteDirac(dx.Theta(theta), constraints="resolve")
        found, sol = pendulum_errors(SPHERICAL, scheme, steps, time=1.0)
        errors.append(found[:2])
        assert np.max(np.abs(sol.constraint_residual())) < 5e-15
    assert slopes(errors) == pytest.approx(1.0, abs=0.1)


# --------------------------------------------------------------------- moving, mixed, redundant and driven constraints


@pytest.mark.soak
def test_a_moving_pivot_of_a_mass_that_changes():
    """The pivot at x = .3 cos 2t; mass and weight grow as e^{.2t}, a drag that leaves the direction alone: θ̈ + .2 θ̇ + …"""
    grown = lambda t: jnp.exp(0.2 * t)
    system = dx.NonholonomicMechanics(
        lambda t, q: grown(t) * jnp.eye(2),
        lambda t, q: grown(t) * q[1],
        holonomic=lambda t, q: jnp.stack([(q[0] - 0.3 * jnp.cos(2 * t)) ** 2 + q[1] ** 2 - 1.0]),
    )

    def field(t, y):
        """The pivot's acceleration −1.2 cos 2t and, on the whole velocity, −.2 ẋ: both along (cos θ, sin θ)."""
        push = 1.2 * np.cos(2 * t) + 0.2 * 0.6 * np.sin(2 * t)
        return [y[1], -np.sin(y[0]) - 0.2 * y[1] + push * np.cos(y[0])]

    errors = []
    for steps in (50, 100, 200):
        times = np.linspace(0.0, 2.0, steps + 1)
        angle, rate = along(field, [1.0, 0.5], times)
        s, c = np.sin(angle), np.cos(angle)
        q = np.stack([s + 0.3 * np.cos(2 * times), -c], -1)
        v = np.stack([c * rate - 0.6 * np.sin(2 * times), s * rate], -1)
        sol = dx.simulate(system, METHOD_2, q=q[0], v=v[0], step=2.0 / steps, steps=steps)
        errors.append([np.max(np.abs(sol.q - q)), np.max(np.abs(sol.p - np.exp(0.2 * times)[:, None] * v))])
    assert slopes(errors) == pytest.approx(2.0, abs=0.1)
    assert np.max(np.abs(np.asarray(sol.map_rows(system.constraint_at)))) < 5e-15


def both_kinds(gamma, build):
    """x² + y² = 1 and dz = y ds; dragged by −γv, all speeds go as e^{−γt}, and the path is that of τ = (1 − e^{−γt})/γ."""
    return build(
        one_forms=lambda q: jnp.stack([0.0 * q[0], 0.0 * q[0], 1.0 + 0.0 * q[0], -q[1]])[None],
        holonomic=lambda q: jnp.stack([q[0] ** 2 + q[1] ** 2 - 1.0]),
        forces=lambda t, q, v: -gamma * v,
    )


@pytest.mark.parametrize(
    "build",
    [
        lambda **c: dx.LagrangeDirac(lambda q, v: v @ v / 2, **c),
        lambda **c: dx.NonholonomicMechanics(lambda q: jnp.eye(4), lambda q: 0.0 * q[0], **c),
    ],
)
@pytest.mark.soak_of("<lambda>1")
def test_both_kinds_of_constraints_and_a_drag(build):
    errors, gamma = [], 0.3
    for steps in (50, 100, 200):
        start = {"q": [1.0, 0.0, 0.0, 0.0], "v": [0.0, 1.0, 0.0, 0.8]}
        sol = dx.simulate(both_kinds(gamma, build), METHOD_2, **start, step=2.0 / steps, steps=steps)
        decay = lambda t: np.exp(-gamma * t)
        angle = (1 - decay(sol.t)) / gamma
        sine, middle = np.sin(angle), (sol.t[1:] + sol.t[:-1]) / 2
        rate = 0.8 / np.sqrt(1 + sine**2) * decay(sol.t)
        circle = np.stack([np.cos(angle), sine], 1)
        turning = np.stack([-sine, np.cos(angle)], 1) * decay(sol.t)[:, None]
        exact = np.concatenate([turning, np.stack([sine * rate, rate], 1)], axis=1)
        work = (decay(sol.t) ** 2 - 1) * (1 + 0.8**2) / 2
        pairs = ((sol.q[:, :2], circle), (sol.p, exact), (sol.work, work), (sol.multipliers[:, 1], -decay(2 * middle) / 2))
        errors.append([np.max(np.abs(found - known)) for found, known in pairs])
        assert np.max(np.abs(sol.constraint_residual())) < 5e-15
    assert slopes(errors) == pytest.approx(2.0, abs=0.1)


@pytest.mark.soak
def test_a_redundant_constraint_is_left_out_and_reported():
    """The sphere said twice, by |x|² = 1 and by a multiple of |x|⁴ = 1: the second carries nothing."""
    twice = lambda y: jnp.stack([place(y) @ place(y) - 1.0, 3.0 * (place(y) @ place(y)) ** 2 - 3.0])
    run = {"q": Y0, "p": P0, "step": 0.02, "steps": 100}
    sol = dx.simulate(dx.NonholonomicMechanics(metric, height, holonomic=twice), METHOD_2, **run)
    once = dx.simulate(SPHERICAL, METHOD_2, **run)
    assert sol.stats["redundant_constraints"] == [1] and np.all(sol.multipliers[:, 1] == 0.0)
    np.testing.assert_allclose(sol.q, once.q, atol=1e-13)
    np.testing.assert_allclose(sol.multipliers[:, 0], once.multipliers[:, 0], atol=1e-12)
    assert np.max(np.abs(sol.constraint_residual())) < 5e-14


@pytest.mark.soak
def test_verify_finds_the_discrete_dirac_structure_of_mechanics_and_its_hidden_constraint():
    for scheme in (dx.LagrangeDAlembert(), METHOD_2):
        report = dx.verify(dx.simulate(FLAT, scheme, **FLAT_START, step=0.02, steps=100))
        assert report.ok and report["constraint"].verdict == "ok", report
        if scheme is not METHOD_2:
            assert report["hidden constraint"].verdict == report["discrete Dirac structure"].verdict == "ok", report


def test_wrong_statements():
    with pytest.raises(ValueError, match="affine is the b"):
        dx.NonholonomicMechanics(metric, height, affine=lambda q: q[:1])
    with pytest.raises(ValueError, match="starts from q=, v="):
        dx.simulate(SPHERICAL, METHOD_2, x=Y0, step=0.1, steps=1)
    with pytest.raises(ValueError, match=r"not from two points"):
        dx.simulate(SPHERICAL, METHOD_2, q0=Y0, q1=Y0, step=0.1, steps=1, check_initial=False)


@pytest.mark.soak
def test_accelerations_in_place_and_as_unknowns(monkeypatch):
    """Where there are few, λ and the direction of the first half are solved for in place: the same step."""

    def run(few):
        monkeypatch.setattr(blm_method_2_step, "FEW", few)
        dx.clear_caches()  # the same functions are the same system
        system = dx.LagrangeDirac(
            lambda q, v: (1 + q[0] ** 2) * v @ v / 2 - 3 * q[2],
            lambda q: jnp.stack([jnp.stack([-q[1], q[0], jnp.zeros(()), jnp.ones(())])]),
            holonomic=lambda q: jnp.stack([q[:3] @ q[:3] - 1.0]),
            forces=lambda t, q, v: -0.1 * v * jnp.cos(t),
        )
        start = {"q": [0.6, 0.0, 0.8, 0.0], "v": [0.4, 0.5, -0.3, -0.3], "step": 0.05, "steps": 40}
        return dx.simulate(system, dx.DiscreteDirac(constraints="resolve"), **start)

    here, there = run(4), run(0)
    assert here.ok and there.ok and here.stats["unknowns"] < there.stats["unknowns"]
    for name in ("q", "p", "multipliers", "work"):
        np.testing.assert_allclose(here.fields[name], there.fields[name], rtol=1e-11, atol=1e-12)
