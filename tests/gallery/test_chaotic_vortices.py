"""Four equal vortices: their invariants, their chaos, and the energy of Methods 1 and 2 and of RK2 in it."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dirax as dx
from dirax.diagnostics.drift import judge
from dirax.gallery import vortices
from dirax.gallery.chaotic_vortices import CIRCULATIONS, EXAMPLE, START

METHODS = {1: dx.DiscreteDirac(), 2: dx.DiscreteDirac(constraints="resolve")}


def energy(q):
    """H by complex numbers, apart from the gallery's function."""
    z = q[..., :4] + 1j * q[..., 4:]
    return sum(np.log(np.abs(z[..., j] - z[..., k])) for j in range(4) for k in range(j)) / (2 * np.pi)


def test_method_2_keeps_the_impulses_and_neighbours_part_exponentially():
    near = np.stack([START, START + 1e-9 * np.eye(8)[0]])
    sol = EXAMPLE.simulate(METHODS[2], q=near, v=np.zeros((2, 8)), steps=4000, save_every=20)
    q = np.asarray(sol.q)
    for impulse in (q[..., :4].sum(-1), q[..., 4:].sum(-1), np.square(q).sum(-1)):  # linear and quadratic: midpoint keeps them
        assert np.ptp(impulse, axis=1).max() < 1e-11
    apart = np.linalg.norm(q[1] - q[0], axis=1)
    when = sol.t[np.argmax(apart > 1e-2)]
    assert 50 < when < 200 and apart[-1] > 0.1
    np.testing.assert_allclose(sol.energy(), energy(q), rtol=1e-12)


@pytest.mark.soak
def test_energy_over_a_million_steps():
    """h = .05: Methods 1 and 2 stay in their bands, RK2 drifts."""
    bands = {}
    for number, scheme in METHODS.items():
        sol = EXAMPLE.simulate(scheme, steps=1_000_000, save_every=50)
        series = energy(np.asarray(sol.q))
        bands[number] = np.ptp(series)
        found = judge(np.asarray(sol.t), series, np.asarray(sol.q), 1e-12)
        assert sol.ok and found.verdict == "bounded", (number, found)
    step = lambda q, _: (vortices.runge_kutta_step(q, 0.05, CIRCULATIONS), None)
    rows = lambda q, _: (jax.lax.scan(step, q, None, length=50)[0], q)
    q = np.asarray(jax.jit(lambda q: jax.lax.scan(rows, q, None, length=20_000)[1])(jnp.asarray(START)))
    found = judge(2.5 * np.arange(len(q)), energy(q), q, 1e-12)
    assert found.verdict == "drifts", found
    print({**bands, "RK2": np.ptp(energy(q))})
