"""Discrete Routh equations, connections that are not linear, constraints and bad input in reduction."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dirax as dx
from dirax.gallery import charged_particle, double_spherical_pendulum, rolling_disk
from dirax.reduction.connection import DiscreteConnection
from dirax.reduction.symmetry import cyclic_coordinates
from dirax.schemes.routh import DiscreteRouth

TWISTED = [[0.3, -0.2, 0.1]]
CURVED = DiscreteConnection(
    lambda q0, q1: q1[3:] - q0[3:] + (q0[:1] + 2 * q1[:1]) * (q1[1:2] - q0[1:2]) + (q1[2:3] - q0[2:3]) ** 2, fibre=[3]
)
PARTICLE, PENDULUM, DISK = charged_particle.EXAMPLE, double_spherical_pendulum.EXAMPLE, rolling_disk.EXAMPLE


def run(example, system, scheme, steps=500, **changes):
    settings = {"engine": "native", **example.initial, "params": dict(example.params), "step": example.step, "steps": steps}
    return dx.simulate(system, scheme, **{**settings, **changes})


@pytest.fixture(scope="module")
def particle():
    return run(PARTICLE, PARTICLE.system, dx.PlusLagrangeDirac("midpoint"))


@pytest.mark.parametrize(
    ("scheme", "connection"),
    [
        (dx.PlusLagrangeDirac, dx.LinearConnection([3], TWISTED)),
        (dx.PlusLagrangeDirac, CURVED),
        (dx.MinusLagrangeDirac, CURVED),
        (DiscreteRouth, dx.LinearConnection([3])),
        (DiscreteRouth, CURVED),
    ],
)
@pytest.mark.soak_of("PlusLagrangeDirac-connection1", "DiscreteRouth-connection3")
def test_particle_on_the_quotient_is_the_particle(particle, scheme, connection):
    quotient = run(PARTICLE, dx.reduce(PARTICLE.system, connection), scheme("midpoint"))
    lifted = dx.reconstruct(quotient)
    assert np.abs(lifted.q - particle.q).max() < 1e-10 and np.abs(lifted.p - particle.p).max() < 1e-10
    assert np.all(quotient.mu == quotient.mu[0])
    vertical = connection.one_form(particle.q[7], particle.q[8])
    assert quotient.vertical[7] == pytest.approx(np.asarray(vertical), abs=1e-11)


@pytest.mark.soak
def test_routh_where_l_is_not_quadratic_in_the_group_velocity():
    relativistic = dx.LagrangeDirac(lambda q, v: -jnp.sqrt(1 - v[0] ** 2 - q[0] ** 2 * v[1] ** 2) + 0.2 / q[0])
    start = {"q": [1.0, 0.0], "v": [0.1, 0.5], "step": 0.02, "steps": 300}
    unreduced = dx.simulate(relativistic, dx.PlusLagrangeDirac("midpoint"), **start)
    reduced = dx.reduce(relativistic, dx.LinearConnection(cyclic_coordinates(relativistic, [1.0, 0.0], radius=0.3)))
    quotient = dx.simulate(reduced, DiscreteRouth("midpoint"), **start)
    assert quotient.ok and np.abs(dx.reconstruct(quotient).q - unreduced.q).max() < 1e-11


KEPLER = dx.LagrangeDirac(lambda q, v, params: (v[0] ** 2 + (q[0] * v[1]) ** 2) / 2 + params / q[0])
"""In polar coordinates."""


def test_gradients_are_those_of_the_unreduced_run_and_of_differences():
    reduced = dx.reduce(KEPLER, dx.LinearConnection([1], [[0.4]]))

    def end(system, scheme, v, mu):
        sol = dx.simulate(system, scheme, q=jnp.array([1.0, 0.3]), v=v, params=mu, step=0.05, steps=20)
        sol = dx.reconstruct(sol) if system is reduced else sol
        return sol.q[-1] @ jnp.array([1.0, 2.0]) + sol.p[-1] @ jnp.array([0.5, -1.0])

    v, mu = jnp.array([0.2, 0.9]), 1.1
    by_routh = lambda v, mu: end(reduced, DiscreteRouth("midpoint"), v, mu)
    slopes = jax.jit(jax.grad(by_routh, argnums=(0, 1)))(v, mu)
    unreduced = jax.grad(lambda v, mu: end(KEPLER, dx.PlusLagrangeDirac("midpoint"), v, mu), argnums=(0, 1))
    for found, wanted in zip(slopes, jax.jit(unreduced)(v, mu), strict=True):
        assert np.asarray(found) == pytest.approx(np.asarray(wanted), rel=1e-10)
    e, run = 1e-4, jax.jit(by_routh)
    assert float(slopes[1]) == pytest.approx(float(run(v, mu + e) - run(v, mu - e)) / (2 * e), rel=1e-6)
    assert float(slopes[0][1]) == pytest.approx(float(run(v.at[1].add(e), mu) - run(v.at[1].add(-e), mu)) / (2 * e), rel=1e-6)


@pytest.mark.parametrize("engine", ["native", "xla"])
@pytest.mark.soak_of("xla")
def test_a_batch_is_its_trajectories(engine):
    reduced, scheme = dx.reduce(KEPLER, dx.LinearConnection([1])), DiscreteRouth("midpoint")
    q, v, mu = (
        np.array([[1.0, 0.0], [1.2, 0.5], [0.8, -1.0]]),
        np.array([[0.0, 1.0], [0.3, 0.8], [0.1, 1.1]]),
        np.array([1, 1.2, 0.9]),
    )
    settings = {"step": 0.05, "steps": 100, "engine": engine}
    batch = dx.simulate(reduced, scheme, q=q, v=v, params=mu, batch_params=True, **settings)
    for i in range(3):
        one = dx.simulate(reduced, scheme, q=q[i], v=v[i], params=mu[i], **{**settings, "engine": "native"})
        assert np.abs(dx.reconstruct(batch).q[i] - dx.reconstruct(one).q).max() < 1e-12


@pytest.mark.soak
@pytest.mark.parametrize(("example", "fibre", "start", "step"), [
    (PARTICLE, 3, PARTICLE.initial, 0.01),
    (PENDULUM, 0, {"q": [0.0, 2.2, 0.0, 2.3], "v": [0.25, 0.0, 0.0, 0.0]}, 0.1),  # stays away from the poles
])  # fmt: skip
def test_momentum_over_a_million_steps(example, fibre, start, step):
    settings = {**start, "params": example.params, "step": step, "steps": 10**6, "save_every": 100, "engine": "native"}
    unreduced = dx.simulate(example.system, dx.PlusLagrangeDirac("midpoint"), **settings)
    momentum = unreduced.p[:, fibre]
    assert unreduced.ok and np.abs(momentum / momentum[0] - 1).max() < 1e-12
    reduced = dx.reduce(example.system, dx.LinearConnection([fibre], TWISTED))
    for scheme in (dx.PlusLagrangeDirac("midpoint"), DiscreteRouth("midpoint")):
        quotient = dx.simulate(reduced, scheme, **settings)
        assert quotient.ok and np.all(quotient.mu == quotient.mu[0])
        assert np.abs(dx.reconstruct(quotient).q - unreduced.q).max() < 1e-6


def test_mistakes():
    start = {"params": dict(PENDULUM.params), "v": np.full(4, 0.1), "step": 0.01, "steps": 3}
    with pytest.raises(ValueError, match="orbits of the group are not free at the initial point"):
        dx.simulate(dx.reduce(PENDULUM.system, dx.LinearConnection([0])), DiscreteRouth(), q=np.array([0.0, 0, 1, 0]), **start)
    with pytest.raises(TypeError, match=r"made by dx\.reduce"):
        dx.simulate(PENDULUM.system, DiscreteRouth(), **{**start, "q": np.ones(4)})
    with pytest.raises(
        ValueError, match=r"fixes μ, which the forces of the constraints move: one-form 0 has the part 1 along q\[0\]"
    ):
        run(DISK, dx.reduce(DISK.system, dx.LinearConnection([0, 1])), DiscreteRouth(), 3)
    dragged = dx.LagrangeDirac(lambda q, v: v @ v / 2, forces=lambda t, q, v: -v * q[0])
    with pytest.raises(ValueError, match=r"forces f\(t, q, v\) move: f has the part -?0\.\d+ along q\[1\] at"):
        dx.simulate(dx.reduce(dragged, dx.LinearConnection([1])), DiscreteRouth(), q=[0.0, 0.0], v=[0.1, 0.2], step=0.1, steps=3)
    drifting = dx.LagrangeDirac(lambda q, v: v[0] ** 2 / 2 + v[0] * v[1])
    with pytest.raises(ValueError, match=r"singular value at the initial data: the group inertia .* rank 0 of 1"):
        dx.simulate(dx.reduce(drifting, dx.LinearConnection([1])), DiscreteRouth(), q=[0.0, 0.0], v=[0.1, 0.2], step=0.1, steps=3)
    quartic = dx.LagrangeDirac(lambda q, v: v[0] ** 2 / 2 + v[1] ** 4 / 4)
    with pytest.raises(ValueError, match="singular value at the initial data"):
        dx.simulate(dx.reduce(quartic, dx.LinearConnection([1])), DiscreteRouth(), q=[0.0, 0.0], v=[0.1, 0.0], step=0.1, steps=3)
    patchy = DiscreteConnection(lambda q0, q1: q1[3:] - q0[3:] + jnp.log(q1[:1] / q0[:1]), fibre=[3])
    with pytest.raises(ValueError, match="no discrete connection on all of Q: it is not finite at q0 ="):
        run(PARTICLE, dx.reduce(PARTICLE.system, patchy), DiscreteRouth(), 3)
    broken = DiscreteConnection(lambda q0, q1: q1[3:] - q0[3:] + q0[:1], fibre=[3])
    with pytest.raises(ValueError, match=r"ω_d\(q, q\) = 0 fails by"):
        run(PARTICLE, dx.reduce(PARTICLE.system, broken), DiscreteRouth(), 3)
    twice = DiscreteConnection(lambda q0, q1: 2 * (q1[3:] - q0[3:]), fibre=[3])
    with pytest.raises(ValueError, match=r"ω_d\(q0 \+ g0, q1 \+ g1\)"):
        run(PARTICLE, dx.reduce(PARTICLE.system, twice), DiscreteRouth(), 3)


@pytest.mark.parametrize("scheme", [dx.DiscreteRouth("left"), dx.PlusLagrangeDirac("left")])
@pytest.mark.soak_of("scheme0")
def test_symmetric_compositions_on_the_quotient(scheme):
    """Φ_{h/2} ∘ Φ*_{h/2} of the scheme of order 1 has order 2, and is that of the unreduced system."""
    reduced, ends = dx.reduce(KEPLER, dx.LinearConnection([1])), []
    symmetric = dx.SymmetricComposition(scheme)
    data = {"q": [1.0, 0.0], "v": [0.1, 1.1], "params": 1.0}
    for steps in (20, 40, 80):
        sol = dx.reconstruct(dx.simulate(reduced, symmetric, step=1.0 / steps, steps=steps, **data))
        ends.append(np.concatenate([sol.q[-1], sol.p[-1]]))
    unreduced = dx.SymmetricComposition(dx.LagrangeDAlembert("left", "left"))
    plain = dx.simulate(KEPLER, unreduced, step=1.0 / 80, steps=80, **data)
    np.testing.assert_allclose(ends[-1], np.concatenate([plain.q[-1], plain.p[-1]]), rtol=0, atol=1e-12)
    order = np.log2(np.linalg.norm(ends[0] - ends[1]) / np.linalg.norm(ends[1] - ends[2]))
    assert abs(order - 2) < 0.1
