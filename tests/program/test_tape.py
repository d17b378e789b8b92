"""Tapes: the compiled loops have the bits of NumPy, at any number of entries."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dirax.program.evaluation import tape as tapes
from dirax.program.evaluation.functions import program_of
from dirax.program.evaluation.in_numpy import Slopes, Values
from dirax.program.evaluation.row_tape import RowTape
from dirax.program.evaluation.tape import Tape, by_tape
from dirax.program.roots import nearest_root


def some_of_everything(x, y):
    """Every operation of the loop, calls of NumPy one inside the other, a decomposition and a root."""
    far = jnp.where((x > 0.2) & ~(y <= x) | (x == 0.3), jnp.sin(y * jnp.cos(x)), -jnp.abs(x) / y)
    size = jnp.sqrt(jnp.exp(far) + x * x) - jnp.where(jnp.isfinite(1 / (x - 0.5)) & (x != y), 1.0, jnp.floor(x))
    matrix = jnp.outer(x, y) + 3 * jnp.eye(3) + jnp.diag(size)
    root = nearest_root(lambda u: matrix @ u + u**3 - far, jnp.zeros(3))
    return jnp.linalg.svd(matrix, compute_uv=False), root * size, far


def arguments(entries):
    rng = np.random.default_rng(entries)
    x, y = rng.uniform(-1, 1, (2, entries, 3))
    x[0], y[0, 0] = [0.3, 0.5, 0.0], np.nan
    return [x, y]


@pytest.fixture(scope="module")
def program():
    found = program_of(some_of_everything, [jax.ShapeDtypeStruct((3,), jnp.float64)] * 2, "everything")
    assert found is not None and found[0].opaque
    return found[0]


@pytest.mark.parametrize("entries, most", [(1, 2**20), (8, 2**20), (43, 2**20), (43, 1)])
def test_values_have_the_bits_of_numpy(program, entries, most, monkeypatch):
    monkeypatch.setattr(tapes, "MOST_VALUES", most)
    leaves = arguments(entries)
    for again in range(2):  # the second time in memory that has been used
        for expected, found in zip(program._part(leaves, None), program._by_tape(leaves), strict=True):
            np.testing.assert_array_equal(found, expected, strict=True, err_msg=str(again))


def test_one_entry_in_floats(program):
    leaves = arguments(1)
    flat = lambda arrays: [int(node) for nodes in arrays for node in nodes.ravel()]
    function = by_tape(program.graph, flat(program.inputs), flat(program.results), program.opaque)
    expected = np.concatenate([a.ravel() for a in program._part(leaves, None)])
    np.testing.assert_array_equal(function([*leaves[0][0].tolist(), *leaves[1][0].tolist()]), expected)


def test_no_entries(program):
    assert program.tape(np.zeros((0, 6))).shape == (0, 9)


@pytest.mark.parametrize("outputs", [[0, 1, 2, 3], [1], [0, 0, 5]])
@pytest.mark.parametrize("branches", [True, False])
@pytest.mark.parametrize("entries", [1, 19])
def test_derivatives_have_the_bits_of_the_sweeps_of_numpy(outputs, branches, entries):
    def function(x, y):
        z = jnp.where(x > y, jnp.sin(x) * y, y / x) if branches else jnp.sin(x) * y
        w = jnp.sqrt(1 + z * z) * jnp.roll(x, 1) + jnp.exp(-y) * z
        return jnp.concatenate([z * w, w - x, x[:1], jnp.ones(1)])

    made = program_of(function, [jax.ShapeDtypeStruct((3,), jnp.float64)] * 2, ("sweeps", branches))
    assert made is not None
    graph = made[0].graph.copy()
    nodes = made[0].results[0][outputs].tolist()
    x, y = made[0].inputs
    inputs = [*x.tolist(), int(y[0])]
    leaves = arguments(entries)
    plan = Slopes(graph, nodes, inputs)
    assert plan.tape is None  # there are too few nodes for it
    known = Values(graph, entries)
    for own, leaf in zip((x, y), leaves, strict=True):
        known.bind(own, leaf)
    more = [int(x[0])]
    tape = RowTape(graph, nodes, inputs, more, plan.terms, plan.needed, plan.backward)
    values, slopes = tape(known.given(tape.numbers))
    np.testing.assert_array_equal(slopes, known.slopes(nodes, inputs, plan))
    np.testing.assert_array_equal(values, known.read(np.array(nodes + more)))


def test_constants_and_inputs_alone(program):
    graph = program.graph
    first = int(program.inputs[0][0])
    found = Tape(graph, [first], [graph.one, first, graph.zero, graph.true])(np.array([[2.5], [3.5]]))
    np.testing.assert_array_equal(found, [[1.0, 2.5, 0.0, 1.0], [1.0, 3.5, 0.0, 1.0]])


def test_nothing_in_and_nothing_out(program):
    graph, first = program.graph, int(program.inputs[0][0])
    assert Tape(graph, [first], [])(np.ones((9, 1))).shape == (9, 0)
    np.testing.assert_array_equal(Tape(graph, [], [graph.one])(np.ones((9, 0))), np.ones((9, 1)))
