"""Right runs whose numbers are off by more than the sizes of their terms show are not accused, and damage in them is seen."""

import jax.numpy as jnp
import numpy as np
import pytest

import dirax as dx
from dirax import gallery
from dirax.diagnostics.replay_lines import replayed
from dirax.diagnostics.rounding import DISTURBANCE
from dirax.diagnostics.structure_lines import of_terms, symplecticity
from dirax.program.evaluation.functions import in_numpy
from dirax.program.evaluation.noise import Noise

DAMAGE = 1e-10

RUNS = [  # each has lines that the sizes of terms alone would call violated
    ("car-axis", None, 2000),
    ("euler-disk", None, 600),
    ("euler-disk", dx.PlusLagrangeDirac(), 600),
    ("double-spherical-pendulum", None, 1000),
    ("dc-motor", None, None),
    ("bricard", None, None),
    pytest.param("n-four-bar", None, None, marks=pytest.mark.soak),  # closed chains as in bricard
]


@pytest.mark.parametrize(("name", "scheme", "steps"), RUNS)
@pytest.mark.soak_of(but=["euler-disk-scheme2-600", "double-spherical-pendulum-None-1000"])
def test_right_runs_are_right_and_damage_is_seen(name, scheme, steps):
    example = gallery.get(name)
    sol = example.simulate(scheme, **({"steps": steps} if steps else {}))
    violated = [line for line in dx.verify(sol, example.symmetries or None).lines if line.verdict == "VIOLATED"]
    assert not violated, violated
    for field in ("q", "p", "x"):
        if field in sol.fields:
            values = np.array(sol.fields[field])
            sizes = np.max(np.abs(values), axis=0)
            values[values.shape[0] // 2, np.argmax(sizes)] += DAMAGE * np.max(sizes)
            assert replayed(sol.replace(fields=sol.fields | {field: values}), None).verdict == "VIOLATED", field


def test_noise_finds_what_cancels_inside():
    """(1 + x) − 1 is off by half a place of 1, however small x is; a derivative by x times |x| does not say so."""
    x = np.full((4000, 1), 1e-8)
    found = in_numpy(lambda x: jnp.sum((1.0 + x) - 1.0)[None], [x], "cancels", noise=Noise(DISTURBANCE, 0))
    off = np.abs(np.asarray(found)[:, 0] - 1e-8) / DISTURBANCE
    assert 0.95 < np.max(off) <= 1.01
    assert abs(np.mean(off) - 0.5) < 0.03


@pytest.mark.soak
def test_a_decomposition_in_the_potential_is_no_violation():
    """The midpoint rule of a smooth Lagrangian; its operations cannot be disturbed one by one."""

    def run(potential):
        system = dx.LagrangeDirac(lambda q, v: v @ v / 2 + 0.1 * v[0] * v[1] - potential(q))
        return dx.simulate(system, dx.LagrangeDAlembert(), q=[0.3, 0.4], v=[0.2, -0.1], step=0.05, steps=20)

    sol = run(lambda q: jnp.sum(jnp.abs(jnp.fft.fft(jnp.stack([q[0], q[1], 1.0, 2.0]))) ** 2) / 10)
    line = symplecticity(sol, None)
    assert line.quantity == "symplecticity of one step" and line.verdict == "ok"


def test_derivatives_that_underflow_are_no_violation():
    """Ends of a long chain hardly move each other in a step: terms that have few digits, or that XLA takes for zero, miss."""
    missed, sizes = [1e-17, 4e-308, 0.0], [1.0, 8e-306, 0.0]
    assert of_terms(np.array([[[[missed, sizes]]]])) == 1e-17
