"""Batches of composed schemes on the native engine: every field of every trajectory has the bits that it has alone, whatever
number of lanes fills up the last block."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dirax as dx

pendulum = dx.LagrangeDirac(
    lambda q, v, mass: mass * (v @ v / 2 - q[1]),
    holonomic=lambda q, mass: jnp.array([(q @ q - 1) / 2]),
    forces=lambda t, q, v, mass: -0.1 * v,
)
port = dx.PortHamiltonian(
    lambda x, mass: x @ x / 2 + mass * x[0] ** 4,
    J=lambda x, mass: jnp.array([[0.0, 1.0], [-1.0, 0.0]]),
    R=lambda x, mass: jnp.diag(jnp.array([0.0, 0.1])),
)
ANGLES = np.linspace(0.3, 1.5, 9)
Q = np.stack([np.sin(ANGLES), -np.cos(ANGLES)], axis=1)
V = 0.5 * np.stack([np.cos(ANGLES), np.sin(ANGLES)], axis=1)
CASES = {
    "suzuki4": (pendulum, dx.Composition(dx.LagrangeDAlembert(), "suzuki4"), "multipliers"),
    "yoshida4 of Method 2": (pendulum, dx.Composition(dx.DiscreteDirac(constraints="resolve"), "yoshida4"), "multipliers"),
    "symmetric": (pendulum, dx.SymmetricComposition(dx.PlusLagrangeDirac()), "multipliers"),
    "port, discrete gradient": (port, dx.Composition(dx.DiscreteGradient(), "suzuki4"), "power"),
    "port, Dirac": (port, dx.Composition(dx.DiscreteDirac(), "suzuki4"), "power"),
}
by_case = pytest.mark.parametrize("case", CASES)


def run(case, which, **more):
    system, scheme, _ = CASES[case]
    data = {"x": Q[which]} if system is port else {"q": Q[which], "v": V[which]}
    return dx.simulate(system, scheme, **data, **{"params": 1.0, "step": 0.1, "steps": 7, "engine": "native"} | more)


alone = functools.cache(run)


@by_case
@pytest.mark.parametrize("every", [1, 3])
@pytest.mark.soak_of("1-suzuki4", "1-yoshida4 of Method 2", "1-symmetric", "1-port, discrete gradient")
def test_batches_of_any_size_have_the_bits_of_single_runs(case, every):
    for size in (1, 2, 3, 5, 7, 9):
        sol = run(case, slice(size), save_every=every)
        assert CASES[case][2] in sol.fields
        for number in range(size):
            one = alone(case, number, save_every=every)
            for name, rows in sol.fields.items():
                np.testing.assert_array_equal(rows[number], one.fields[name], f"{name} of trajectory {number} of {size}")


@by_case
def test_and_their_continuations(case):
    sol = run(case, slice(3), steps=4).extend(3)
    for name, rows in sol.fields.items():
        np.testing.assert_array_equal(rows, np.stack([alone(case, i, save_every=1).fields[name] for i in range(3)]), name)


def test_and_their_derivatives():
    def total(mass, which):
        return jnp.sum(run("suzuki4", which, params=mass, steps=4).multipliers ** 2)

    @jax.jit
    def ways(mass):
        batch, *single = [jax.value_and_grad(total)(mass, which) for which in (slice(3), 0, 1, 2)]
        return batch, single, jax.jvp(lambda mass: total(mass, slice(3)), (mass,), (1.0,))

    batch, single, tangent = ways(1.0)
    np.testing.assert_allclose(batch, np.sum(single, axis=0), rtol=1e-13)
    np.testing.assert_allclose(tangent, batch, rtol=1e-12)
