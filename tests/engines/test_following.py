"""Solutions of a step followed from short ones on: where they turn back, by closed forms, and what is said of a failed run."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import brentq

import dirax as dx
from dirax import gallery
from dirax.engines.following import followed


@pytest.mark.parametrize("size", [1e-3, 1.0, 1e3])
def test_a_parabola_turns_at_its_vertex_in_any_units(size):
    """u = size + h u²/size has the roots size (1 ± √(1 − 4h))/(2h)."""

    def slopes(some, u, part):
        h = part[:, None] * step[some]
        residual = u - size - h * u**2 / size
        return residual, np.stack([1.0 - 2.0 * h * u / size, -step[some] * u**2 / size], axis=2)

    step = np.array([[1.0], [0.2]])
    unknowns, parts = followed(slopes, np.full((2, 1), size), np.zeros((2, 1)))
    assert parts[0] == pytest.approx(0.25, rel=2e-2)
    assert parts[1] == 1.0
    assert np.isnan(unknowns[0, 0])
    assert unknowns[1, 0] == pytest.approx(size * (1.0 - np.sqrt(0.2)) / 0.4, rel=1e-12)


def test_unknowns_that_become_far_larger_on_the_way():
    """A block at rest under friction μ tanh(v/ε), which slides 200 times as fast in a short step: v − p = s f(v)."""
    p, drive, mu, slip = -0.0125, 2e-4, 0.039, 1e-4
    force = lambda v: drive - mu * np.tanh(v / slip)

    def slopes(some, u, part):
        by_u = 1.0 + part[:, None] * mu / slip / np.cosh(u / slip) ** 2
        return u - p - part[:, None] * force(u), np.stack([by_u, -force(u)], axis=2)

    unknowns, parts = followed(slopes, np.full((1, 1), 3e-5), np.zeros((1, 1)))
    assert parts[0] == 1.0
    assert unknowns[0, 0] == pytest.approx(brentq(lambda v: v - p - force(v), -1.0, 1.0, xtol=1e-18), rel=1e-9)


@pytest.mark.soak
def test_a_failed_step_says_where_solutions_turn_back():
    """The turning point of two stages at t = .7 is .0835 by a continuation with other steps and scales; three have none."""
    example = gallery.get("cartesian-double-pendulum")
    run = lambda stages: dx.simulate(
        example.system, dx.Collocation(stages, "lobatto"), step=0.1, steps=40, params=example.params, **example.initial
    )
    two, three = run(2), run(3)
    assert "turn back there: longer ones have none near" in two.message and "lead to h = 0.083" in two.message
    assert three.ok
    assert dx.verify(three).ok


MU, SLIP, H = 0.3 * 9.81, 1e-3, 0.01


def block(steps, q=(3.0,), mu=MU, slip=SLIP, **options):
    """A block on a spring that friction stops: Newton's method fails where it comes to rest within a step."""
    friction = lambda t, q, v, p: -p * jnp.tanh(v / slip)
    system = dx.LagrangeDirac(lambda q, v: v @ v / 2 - 2.0 * q @ q, forces=friction)
    v = np.zeros_like(np.asarray(q))
    return dx.simulate(system, dx.LagrangeDAlembert(), q=q, v=v, step=H, steps=steps, params=mu, **options)


@pytest.mark.parametrize("engine", ["native", "xla"])
@pytest.mark.parametrize("slip", [SLIP, 1e-5])
@pytest.mark.soak_of(but=["0.001-native"])
def test_where_friction_stops_a_block(slip, engine):
    """Against the roots of the same equations in one number, which brackets find: at rest its velocity alternates, and what steps
    before say of it leads the wrong way."""
    sol, q, p = block(220, q=(2.0,), slip=slip, engine=engine), 2.0, 0.0
    for k in range(220):
        half = lambda v: H / 2 * (-4.0 * (q + H / 2 * v) - MU * np.tanh(v / slip))  # noqa: B023
        v = brentq(lambda v: v - half(v) - p, -20.0, 20.0, xtol=1e-16)  # noqa: B023
        q, p = q + H * v, v + half(v)
        np.testing.assert_allclose((sol.q[k + 1, 0], sol.p[k + 1, 0]), (q, p), atol=1e-12)
    assert "followed" in sol.stats["iteration"]


@pytest.mark.parametrize("engine", ["native", "xla"])
@pytest.mark.soak_of("native")
def test_bits_of_a_block_that_friction_stops(engine):
    """Ever so many trajectories that stop in different steps: natively each has the bits that it has alone."""
    sol = block(220, q=[2.0], engine=engine)
    assert dx.verify(sol).ok
    assert np.array_equal(block(173, q=[2.0], engine=engine).extend(47).q, sol.q)
    many = block(223, q=[[1.8], [2.0], [2.2]], engine=engine, save_every=10)
    assert np.all(many.ok) and "followed" in many.stats["iteration"]
    np.testing.assert_allclose(many.q[1, :-1], sol.q[::10], rtol=0.0, atol=1e-14 if engine == "xla" else 0.0)


@pytest.mark.soak
def test_many_that_stop_have_the_bits_of_each_alone():
    """A bead on a hoop under friction of its normal force, of several unknowns: those of the others set no scale."""
    friction = lambda t, q, v, multipliers: -0.4 * jnp.abs(multipliers[0]) * v / jnp.sqrt(v @ v + 1e-8)
    round_hoop = lambda q: jnp.array([(q @ q - 1) / 2])
    hoop = dx.LagrangeDirac(lambda q, v: v @ v / 2 - 9.81 * q[1], holonomic=round_hoop, forces=friction)
    angle = np.array([-0.24, 0.24])
    q, v = np.stack([np.sin(angle), -np.cos(angle)], axis=1), 2.0 * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    run = lambda some: dx.simulate(hoop, dx.LagrangeDAlembert(), q=q[some], v=v[some], step=0.02, steps=60)
    both = run([0, 1])
    assert "22 steps followed" in both.stats["iteration"]
    assert np.array_equal(run([0, 0]).q[0], both.q[0])


@pytest.mark.soak
def test_its_derivative():
    end = lambda mu: block(400, mu=mu).q[-1, 0]
    assert jax.grad(end)(MU) == pytest.approx((end(MU + 1e-6) - end(MU - 1e-6)) / 2e-6, rel=1e-6)


def test_from_where_newton_left_to_far_places():
    """An exponential that is cut off at e³⁰, where Newton's method comes to velocities of 1e14."""
    force = lambda v, xp: -1e3 * (xp.exp(xp.clip(v / 0.05, -60.0, 30.0)) - 1.0)
    diode = dx.LagrangeDirac(lambda q, v: v @ v / 2, forces=lambda t, q, v: force(v, jnp))
    sol = dx.simulate(diode, dx.LagrangeDAlembert(), q=[0.0], v=[-1.0], step=0.05, steps=1)
    assert sol.ok, sol.message
    v = brentq(lambda v: v - 0.025 * force(v, np) + 1.0, -1.0, 1.0, xtol=1e-18)
    assert sol.q[1, 0] / 0.05 == pytest.approx(v, rel=1e-12)


def test_few_updates_are_a_bound():
    sol = block(400, max_iterations=7)
    assert not sol.ok
    assert "there is a solution, to which those of easier equations lead" in sol.message


def test_of_many_that_fail_the_first_are_explained():
    kepler = dx.LagrangeDirac(lambda q, v: v @ v / 2 + 1.0 / jnp.sqrt(q @ q))
    q, v = np.tile([1.0, 0.0], (60, 1)), np.tile([0.0, 0.3], (60, 1))
    sol = dx.simulate(kepler, dx.LagrangeDAlembert(), q=q, v=v, step=0.7, steps=50)
    assert not np.any(sol.ok)
    assert "largest residual in" in sol.message[0]
    assert len(sol.message[-1]) < len(sol.message[0])
    assert "Newton's method" in sol.message[-1]
