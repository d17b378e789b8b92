"""The sizes of the terms of functions of many numbers."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

import dirax as dx
from dirax.program.rounding import rounding


@pytest.mark.soak
def test_xla_is_given_no_large_graph():
    """Of some ten thousand operations, which it would compile for minutes, the terms are found from derivatives."""
    x = jnp.linspace(0.1, 1.0, 48)
    products = lambda x: jnp.sum(jnp.sin(x[:, None] * x[None, :]), axis=0)
    terms = jax.jit(lambda x: rounding(products, x)).lower(x)
    assert terms.as_text().count("\n") < 1000
    expected = products(x) + jnp.abs(jax.jacfwd(products)(x)) @ jnp.abs(x)
    np.testing.assert_allclose(terms.compile()(x), expected, rtol=1e-13)


def rounds(count):
    """y + y³ = c by Newton's method."""
    return lambda c: lax.fori_loop(0, count, lambda _, y: y - (y + y**3 - c) / (1 + 3 * y**2), c)


@pytest.mark.soak
def test_an_iteration_that_contracts_is_no_sum_of_its_rounds():
    c = jnp.array([0.3, -2.0, 50.0])
    few, many = (jax.vmap(lambda c, count=count: rounding(rounds(count), c))(c) for count in (8, 80))
    assert np.all(many < 1e4 * jnp.abs(rounds(80)(c))) and np.all(many > jnp.abs(rounds(80)(c)) / 2)
    assert np.all(few > jnp.abs(rounds(8)(c)))


@pytest.mark.soak
def test_long_sums_keep_their_terms():
    x = jnp.linspace(1.0, 2.0, 80)
    summed = lambda x: lax.fori_loop(0, 80, lambda i, s: s + x[i], 0.0)
    assert rounding(lambda x: summed(x) - summed(x[::-1]), x) > jnp.sum(x)


@pytest.mark.parametrize("engine", ["native", "xla"])
@pytest.mark.soak_of("xla")
def test_roots_inside_of_a_lagrangian_leave_steps_their_digits(engine):
    system = dx.LagrangeDirac(lambda q, v: v @ v / 2 - rounds(40)(q[0]) ** 2)
    sol = dx.simulate(system, dx.LagrangeDAlembert(), q=[0.5], v=[0.3], step=0.1, steps=20, engine=engine)

    def force(q):
        y = q
        for _ in range(40):
            y -= (y + y**3 - q) / (1 + 3 * y**2)
        return -2 * y / (1 + 3 * y**2)

    q, p = 0.5, 0.3
    for _ in range(20):
        w = p
        for _ in range(60):
            w = p + 0.05 * force(q + 0.05 * w)
        q, p = q + 0.1 * w, p + 0.1 * force(q + 0.05 * w)
    assert abs(sol.q[-1, 0] - q) < 1e-14
