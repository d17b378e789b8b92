"""Constraints that follow from others are left out of runs under JAX's transformations too, as far as numbers decide it."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dirax as dx


def length_twice(q, params):
    return jnp.array([q @ q - params["r"], 2.0 * (q @ q - params["r"])])


PENDULUM = dx.LagrangeDirac(
    lambda q, v, params: params["m"] * v @ v / 2 - q[1] - params["m"] ** 2 * q[0] ** 2, holonomic=length_twice
)
SCHEMES = [dx.LagrangeDAlembert(), dx.PlusLagrangeDirac(), dx.DiscreteDirac(), dx.DiscreteDirac(constraints="resolve")]


def end(m, r=1.0, scheme=SCHEMES[0]):
    """x at the end of a swing that begins level with the pivot."""
    q = jnp.array([jnp.sqrt(r), 0.0]) if isinstance(r, jax.Array) else [np.sqrt(r), 0.0]
    arguments = {"q": q, "v": [0.0, 0.0], "params": {"m": m, "r": r}}
    return dx.simulate(PENDULUM, scheme, **arguments, step=0.1, steps=5).q[-1, 0]


@pytest.mark.parametrize("scheme", SCHEMES, ids=repr)
@pytest.mark.soak
def test_derivatives_of_a_run_that_leaves_one_out(scheme):
    found = jax.grad(end, (0, 1))(2.0, 1.0, scheme)
    by_hand = [(end(2.0 + a, 1.0 + b, scheme) - end(2.0 - a, 1.0 - b, scheme)) / 2e-5 for a, b in ((1e-5, 0), (0, 1e-5))]
    np.testing.assert_allclose(found, by_hand, atol=1e-8)


@pytest.mark.soak
def test_compiled_where_the_constraints_are_not_traced():
    by_mass = lambda m: end(m)
    np.testing.assert_allclose(jax.jit(jax.grad(by_mass))(2.0), jax.grad(by_mass)(2.0), rtol=1e-12)
    np.testing.assert_allclose(jax.vmap(by_mass)(jnp.array([1.0, 2.0]))[1], by_mass(2.0), rtol=1e-12)


def test_what_is_not_found_fails_and_says_so():
    sol = lambda r: dx.simulate(
        *(PENDULUM, SCHEMES[0]), q=jnp.array([jnp.sqrt(r), 0.0]), v=[0.0, 0.0], params={"m": 2.0, "r": r}, step=0.1, steps=5
    )
    ok, last = jax.jit(lambda r: (sol(r).ok, sol(r).q[-1]))(1.0)
    assert not ok and np.all(np.isnan(last))


def test_contradicting_ones_are_refused():
    apart = lambda q: jnp.array([q @ q - 1.0, 2.0 * q @ q - 2.1])
    system = dx.LagrangeDirac(lambda q, v, params: params * v @ v / 2 - q[1], holonomic=apart)
    last = lambda m: dx.simulate(system, SCHEMES[0], q=[1.0, 0.0], v=[0.0, 0.0], params=m, step=0.1, steps=5).q[-1, 0]
    for transformed in (jax.grad(last), jax.jit(last)):
        with pytest.raises(ValueError, match="contradict each other"):
            transformed(2.0)
