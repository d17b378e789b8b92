"""Discrete action sums and energies: written out by hand, stationary at trajectories and not beside them."""

import itertools

import jax.numpy as jnp
import numpy as np
import pytest

import dirax as dx
from dirax import gallery

SCHEMES = [dx.PlusLagrangeDirac(), dx.MinusLagrangeDirac(), dx.LagrangeDAlembert(), dx.LagrangeDAlembert("trapezoidal")]


@pytest.mark.parametrize("scheme", SCHEMES)
@pytest.mark.soak_of("scheme2", "scheme3")
def test_trajectories_are_stationary_and_their_neighbours_are_not(scheme):
    sol = gallery.get("rolling-disk").simulate(scheme, steps=50)
    rng = np.random.default_rng(1)
    for _ in range(3):
        found = dx.action_variation(sol, rng.normal(size=sol.q.shape))
        assert abs(found.value) < 1e-13 * found.size
    q = sol.q.copy()
    q[20] += [0.0, 0.0, 1e-3, 0.0]
    sol.fields["q"] = q
    beside = dx.action_variation(sol, rng.normal(size=sol.q.shape))
    assert abs(beside.value) > 1e-7 * beside.size


def test_the_sum_and_its_derivative_by_hand():
    """A pendulum by the midpoint rule: the sum in NumPy, and its derivative by differences where there is no constraint."""
    potential = lambda q: q[0] ** 4 / 4 - np.cos(q[1])
    system = dx.LagrangeDirac(lambda q, v: v @ v / 2 - q[0] ** 4 / 4 + jnp.cos(q[1]))
    h, n = 0.1, 6
    sol = dx.simulate(system, dx.LagrangeDAlembert(), q=[1.0, 0.3], v=[0.2, -0.5], step=h, steps=n)

    def total(q):
        return sum(h * (((b - a) / h) @ ((b - a) / h) / 2 - potential((a + b) / 2)) for a, b in itertools.pairwise(q))

    np.testing.assert_allclose(dx.action_sum(sol), total(sol.q), rtol=1e-14)
    path = np.asarray(sol.q) + np.random.default_rng(0).normal(size=sol.q.shape)
    sol.fields["q"] = path
    along = np.random.default_rng(2).normal(size=path.shape)
    inner = along * (np.arange(n + 1) % n > 0)[:, None]
    by_differences = (total(path + 1e-5 * inner) - total(path - 1e-5 * inner)) / 2e-5
    np.testing.assert_allclose(dx.action_variation(sol, along).value, by_differences, rtol=1e-8)


def test_discrete_energies():
    """Of L_d = h L(q0, Δq/h): E⁺ is h times the energy at (q0, Δq/h), and E⁻ that with the momentum at q0."""
    oscillator = dx.LagrangeDirac(lambda q, v: v @ v / 2 - q @ q / 2)
    start = {"q": np.array([[1.0], [0.5]]), "v": np.zeros((2, 1))}
    sol = dx.simulate(oscillator, dx.PlusLagrangeDirac(), **start, step=0.1, steps=5)
    v, q0 = np.diff(sol.q, axis=1)[..., 0] / 0.1, sol.q[:, :-1, 0]
    np.testing.assert_allclose(dx.discrete_energy(sol), 0.1 * (v**2 / 2 + q0**2 / 2), rtol=1e-13)
    minus = 0.1 * ((v + 0.1 * q0) * v - v**2 / 2 + q0**2 / 2)
    np.testing.assert_allclose(dx.discrete_energy(sol, "-"), minus, rtol=1e-12)
    assert dx.action_sum(sol).shape == (2,)


def test_mistakes():
    sol = gallery.get("rolling-disk").simulate(steps=10)
    with pytest.raises(ValueError, match="must have the shape of q"):
        dx.action_variation(sol, np.zeros(3))
    with pytest.raises(ValueError, match='sign must be "\\+" or "-"'):
        dx.discrete_energy(sol, "0")
    with pytest.raises(ValueError, match="save_every=1"):
        dx.action_sum(gallery.get("rolling-disk").simulate(steps=10, save_every=5))
    with pytest.raises(TypeError, match="a discrete Lagrangian on Q × Q"):
        dx.action_sum(gallery.get("rigid-body").simulate(steps=10))


def test_the_line_of_verify_sees_a_path_that_is_no_solution():
    """Stationary to roundoff at a trajectory; the same run with points moved by 1e-6 is not. What is no solution is refused."""
    system = dx.LagrangeDirac(lambda q, v: v @ v / 2 - jnp.cos(q[0]))
    sol = dx.simulate(system, dx.LagrangeDAlembert(), q=[0.3, 0.1], v=[0.2, 0.5], step=0.1, steps=40)
    line = dx.verify(sol)["action sum stationary"]
    assert line.verdict == "ok" and line.value < 2e-15
    sol.fields["q"] = sol.q + 1e-6 * np.sin(9 * np.arange(41))[:, None]
    moved = dx.verify(sol)["action sum stationary"]
    assert moved.verdict == "VIOLATED" and moved.value > 1e-8
    with pytest.raises(TypeError, match="must be a dirax Solution"):
        dx.action_sum(3)


@pytest.mark.parametrize("unit", [1.0, 2.0**-20, 2.0**-34])
def test_variations_are_admissible_in_any_unit_of_a_coordinate(unit):
    """With a holonomic constraint beside a one-form, whose rows are nearly parallel where one coordinate has a small unit."""
    sizes = np.array([1.0, 1.0 / unit, 1.0])
    lagrangian = lambda q, v: v @ v / 2 + 0.2 * v[0] * v[1] - q @ q / 2 - 0.1 * jnp.sum(q**4)
    system = dx.LagrangeDirac(
        lambda q, v: lagrangian(q * sizes, v * sizes),
        lambda q: jnp.array([[1.0, q[2], 0.3]]) * sizes[None],
        holonomic=lambda q: jnp.array([(q * sizes) @ (q * sizes) - 1.0]),
    )
    q = np.array([0.3, 0.2, 0.1]) / np.linalg.norm([0.3, 0.2, 0.1])
    start = {"q": q / sizes, "v": np.array([0.1, 0.4, 0.2]) / sizes, "project": True}
    sol = dx.simulate(system, dx.LagrangeDAlembert(), **start, step=0.05, steps=60)
    line = dx.verify(sol)["action sum stationary"]
    assert line.verdict == "ok" and line.value < 1e-15
