"""Nodes that are read again and again, in an order and by a tape, against nodes that are read once."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dirax.program.evaluation.functions import program_of
from dirax.program.evaluation.in_numpy import Values
from dirax.program.evaluation.noise import Noise
from dirax.program.evaluation.read_again import FEWEST_NODES, TAPED, ReadAgain

RNG = np.random.default_rng(0)


def function(x):
    turned = jnp.where(x > 0.5, jnp.sin(x), x[::-1] ** 3 / x) * jnp.exp(-x) + jnp.sqrt(jnp.abs(x) + 1.0)
    return jnp.stack([jnp.cumsum(turned), turned / (x + 2.0)])


@pytest.fixture(params=[2, 12])
def program(request):
    """Of few nodes and of many."""
    found = program_of(function, [jax.ShapeDtypeStruct((request.param,), jnp.float64)], ("read again", request.param))
    assert found is not None and (len(found[0].graph) > FEWEST_NODES) == (request.param == 12)
    return found[0]


@pytest.mark.parametrize("entries", [1, 2, 9, 60])
def test_every_time_it_has_the_bits_of_the_first(program, entries):
    reads, given = ReadAgain(program.graph), program.inputs[0]
    for _ in range(TAPED + 2):
        known = Values(program.graph, entries)
        known.bind(given, RNG.normal(size=(entries, *given.shape)))
        once = known.without(set())
        found, expected = reads(known, program.results[0]), once.read(program.results[0])
        assert found.tobytes() == expected.tobytes() and found.shape == (entries, *program.results[0].shape)


def test_noise_is_in_every_operation_of_any_reading(program):
    reads, given = ReadAgain(program.graph), program.inputs[0]
    x, found = RNG.normal(size=(5, *given.shape)), []
    for noise in [None] * TAPED + [Noise(1e-9, 0), Noise(1e-9, 1)]:
        known = Values(program.graph, 5, noise.table if noise else None)
        known.bind(given, x)
        found.append(reads(known, program.results[0]))
    off = np.abs(np.stack(found[-2:]) / found[0] - 1.0)
    assert 1e-11 < np.max(off) < 1e-7
