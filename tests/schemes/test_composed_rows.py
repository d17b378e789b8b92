"""Rows of composed steps: what is saved is the whole step's, of the order of q in every field, on both engines."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dirax as dx

G = 9.81
pendulum = dx.LagrangeDirac(
    lambda q, v: v @ v / 2 - G * q[1], holonomic=lambda q: jnp.array([(q @ q - 1) / 2])
)  # the force of the constraint is −λ q with λ = v² − g·q, and multipliers are impulses of the opposite sign
START = {"q": jnp.array([np.sin(0.5), -np.cos(0.5)]), "v": jnp.zeros(2)}
END = 1.0


def mean_tension(sol):
    """The mean of the tension over every step: by Simpson's rule on a run of a fine plain scheme in the angle."""
    angle = dx.LagrangeDirac(lambda q, v: v[0] ** 2 / 2 + G * jnp.cos(q[0]))
    fine, every = 64, sol.step / 64
    steps = fine * (sol.rows - 1)
    ref = dx.simulate(
        angle, dx.Composition(dx.LagrangeDAlembert(), "kahan-li8"), q=jnp.array([0.5]), v=jnp.zeros(1), step=every, steps=steps
    )
    tension = np.asarray(ref.p)[:, 0] ** 2 + G * np.cos(np.asarray(ref.q)[:, 0])
    weights = np.array([1, *([4, 2] * (fine // 2 - 1)), 4, 1]) / (3 * fine)
    return np.array([weights @ tension[i * fine : (i + 1) * fine + 1] for i in range(sol.rows - 1)])


@pytest.mark.parametrize("engine", ["native", "xla"])
@pytest.mark.parametrize(("name", "order"), [("suzuki4", 4), ("yoshida4", 4), ("kahan-li6", 6)])
def test_the_impulse_of_a_composed_step_is_the_whole_steps(engine, name, order):
    """The first part of a step of suzuki4 has .4145 of the tension, of yoshida4 1.3512."""
    errors = []
    for steps in (10, 20):
        sol = dx.simulate(
            pendulum, dx.Composition(dx.LagrangeDAlembert(), name), **START, step=END / steps, steps=steps, engine=engine
        )
        found = np.asarray(sol.multipliers)[:, 0] / sol.step
        errors.append(np.max(np.abs(np.abs(found) / mean_tension(sol) - 1)))
    assert errors[0] < 0.02
    assert np.log2(errors[0] / errors[1]) > order - 0.5
