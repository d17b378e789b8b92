"""Solutions of a step followed from short ones on: where they turn back, by closed forms, and what is said of a failed run."""

import numpy as np
import pytest

import dirax as dx
from dirax import gallery
from dirax.run.turning_step import follow


@pytest.mark.parametrize("size", [1e-3, 1.0, 1e3])
def test_a_parabola_turns_at_its_vertex_in_any_units(size):
    """u = size + h u²/size has the roots size (1 ± √(1 − 4h))/(2h)."""

    def linearized(u, h):
        return u - size - h * u**2 / size, np.array([[1.0 - 2.0 * h * u[0] / size]])

    assert follow(linearized, np.array([size]), np.zeros(1), 1.0).step == pytest.approx(0.25, rel=2e-2)
    assert not follow(linearized, np.array([size]), np.zeros(1), 1.0).whole
    assert follow(linearized, np.array([size]), np.zeros(1), 0.2).whole


def test_a_failed_step_says_whether_there_is_a_solution():
    """The turning point of two stages at t = .7 is .0835 by a continuation with other steps and scales."""
    example = gallery.get("cartesian-double-pendulum")
    run = lambda stages: dx.simulate(
        example.system, dx.Collocation(stages, "lobatto"), step=0.1, steps=40, params=example.params, **example.initial
    )
    assert "turn back there: longer ones have none near" in run(2).message and "lead to h = 0.083" in run(2).message
    assert "there is a solution, to which those of shorter steps lead" in run(3).message
