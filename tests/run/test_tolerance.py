"""tolerance= in place of step=, against the errors that closed solutions tell."""

import jax
import numpy as np
import pytest

import dirax as dx
from dirax.gallery.kepler import EXAMPLE, exact

OSCILLATOR = dx.LagrangeDirac(lambda q, v: (v @ v - q @ q) / 2)
RUN = {"q": [1.0], "v": [0.0]}


def largest_error(sol, unit=1.0):
    """Of q = cos and p = −sin, each relative to its largest value."""
    exact_q, exact_p = np.cos(sol.t / unit), -unit * np.sin(sol.t / unit)
    pairs = ((sol.q[:, 0], exact_q), (sol.p[:, 0], exact_p))
    return max(np.max(np.abs(a - b)) / np.max(np.abs(b)) for a, b in pairs)


@pytest.mark.parametrize("scheme", [dx.LagrangeDAlembert(), dx.Collocation(3)])
@pytest.mark.parametrize("tolerance", [1e-3, 1e-6, 1e-9])
def test_error_is_the_one_that_was_asked_for(scheme, tolerance):
    sol = dx.simulate(OSCILLATOR, scheme, tolerance=tolerance, steps=8, **RUN)
    error = largest_error(sol)
    assert tolerance / 4 <= sol.stats["tolerance_error"] <= tolerance
    assert tolerance / 8 < error < 2 * tolerance  # of first order the estimate would be half of it
    assert sol.stats["tolerance_trials"] < 30
    again = dx.simulate(OSCILLATOR, scheme, step=sol.step, steps=8, **RUN)
    assert np.array_equal(again.q, sol.q)


@pytest.mark.parametrize("unit", [1e-9, 1e6])
def test_units_of_time_do_not_matter(unit):
    slow = dx.LagrangeDirac(lambda q, v: (v @ v * unit**2 - q @ q) / 2)
    sol = dx.simulate(slow, dx.LagrangeDAlembert(), tolerance=1e-6, steps=8, **RUN)
    error = largest_error(sol, unit)
    assert 1e-7 < error < 2e-6


def test_batches_and_events():
    q, v = np.array([[0.4, 0.0], [1.0, 0.0]]), np.array([[0.0, 2.0], [0.0, 1.0]])
    apsis = dx.Event(lambda q, v: q @ v, direction=+1)
    sol = dx.simulate(EXAMPLE.system, dx.Collocation(2), q=q, v=v, params=EXAMPLE.params, tolerance=1e-7, steps=8, events=[apsis])
    errors = [np.max(np.abs(sol.q[i] - exact(sol.t, q[i], v[i]))) for i in range(2)]
    assert errors[1] < errors[0] < 2e-7
    assert sol.events is not None


def test_bad_input():
    run = lambda **other: dx.simulate(OSCILLATOR, dx.LagrangeDAlembert(), steps=4, **{**RUN, **other})
    for other in ({}, {"step": 0.1, "tolerance": 1e-3}):
        with pytest.raises(ValueError, match="one of step= and tolerance="):
            run(**other)
    for tolerance in (0.0, -1.0, 1.0, np.nan, "small", True):
        with pytest.raises(ValueError, match="tolerance must be a number"):
            run(tolerance=tolerance)
    with pytest.raises(ValueError, match="at rest"):
        run(tolerance=1e-6, q=[0.0])
    falling = dx.LagrangeDirac(lambda q, v: v @ v / 2 - q[0])
    with pytest.raises(ValueError, match=r"steps tried were .* or the scheme has no error on it"):
        dx.simulate(falling, dx.LagrangeDAlembert(), q=[1.0], v=[0.0], tolerance=1e-6, steps=4)
    with pytest.raises(ValueError, match="belong to one step"):
        run(tolerance=1e-6, q=None, v=None, q0=[0.0], q1=[0.1])
    with pytest.raises(ValueError, match="JAX traces"):
        jax.grad(lambda a: run(tolerance=1e-6, q=[a]).q[-1, 0])(1.0)
    with pytest.raises(ValueError, match="lengths of their own"):
        dx.simulate(OSCILLATOR, dx.VariableSteps(dx.Collocation(1), lambda q: 1.0), tolerance=1e-6, steps=4, **RUN)
