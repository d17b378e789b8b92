"""Named layouts of flat vectors."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dirax as dx

LAYOUT = dx.Layout(q=2, nothing=0, work=(), matrix=(2, 2))


def test_parts_in_order_and_by_name():
    vector = jnp.arange(7.0)
    q, nothing, work, matrix = parts = LAYOUT.split(vector)
    assert LAYOUT.size == 7 and nothing.shape == (0,) and work.shape == () and work == 2.0
    np.testing.assert_array_equal(q, [0.0, 1.0])
    np.testing.assert_array_equal(matrix, [[3.0, 4.0], [5.0, 6.0]])
    np.testing.assert_array_equal(LAYOUT.join(**parts._asdict()), vector)
    np.testing.assert_array_equal(LAYOUT.join(work=jnp.array(2.0)), [0, 0, 2, 0, 0, 0, 0])
    np.testing.assert_array_equal(LAYOUT.replace(vector, q=jnp.array([8.0, 9.0])), [8, 9, 2, 3, 4, 5, 6])
    assert LAYOUT.rest(vector, "q", "matrix").keys() == {"nothing", "work"}
    assert vector[LAYOUT.place("matrix")].shape == (4,)
    assert LAYOUT.entries == ("q[0]", "q[1]", "work", "matrix[0, 0]", "matrix[0, 1]", "matrix[1, 0]", "matrix[1, 1]")


def test_layouts_are_values():
    assert repr(LAYOUT) == "Layout(q=2, nothing=0, work=(), matrix=(2, 2))"
    assert dx.Layout(p=1, **LAYOUT.without("matrix")) == dx.Layout(p=1, q=2, nothing=0, work=())
    assert dx.Layout(q=1, p=1) != dx.Layout(p=1, q=1)
    assert len({LAYOUT, dx.Layout(**LAYOUT)}) == 1
    assert dx.Layout().join().shape == (0,)


def test_splitting_traces_to_slices():
    jaxpr = jax.make_jaxpr(dx.Layout(q=2, p=2).split)(jnp.zeros(4))
    assert {e.primitive.name for e in jaxpr.eqns} == {"slice"} and len(jaxpr.eqns) == 2


def test_what_does_not_fit_is_named():
    with pytest.raises(TypeError, match="part 'q' of a layout must be a length or a shape, but"):
        dx.Layout(q=1.5)
    with pytest.raises(ValueError, match=r"takes a vector of length 7, but one of shape \(6,\)"):
        LAYOUT.split(jnp.zeros(6))
    with pytest.raises(ValueError, match=r"part 'q' of .* has the shape \(2,\), but \(3,\) was given"):
        LAYOUT.join(q=jnp.zeros(3))
    with pytest.raises(ValueError, match="has no part p"):
        LAYOUT.join(p=jnp.zeros(2))


def of_layout(**more):
    function = lambda *args: jnp.zeros(0)
    return dx.StepEquation(start=function, residual=function, advance=function, unpack=function, fields={}, **more)


def test_a_step_equation_takes_layouts_or_sizes():
    named = of_layout(state_layout=dx.Layout(q=1, p=1), unknown_layout=dx.Layout(v=1))
    assert (named.state_size, named.unknowns, named.labels) == (2, 1, ("equation 0",))
    plain = of_layout(state_size=2, unknowns=0)
    assert (plain.state_layout, plain.unknown_layout) == (dx.Layout(state=2), dx.Layout(u=0))
    with pytest.raises(ValueError, match=r"state_size = 3 does not fit Layout\(q=1, p=1\), which has 2 numbers"):
        of_layout(state_size=3, state_layout=dx.Layout(q=1, p=1), unknowns=0)
    with pytest.raises(ValueError, match="a StepEquation needs unknowns=, or a layout instead"):
        of_layout(state_size=2)
    with pytest.raises(ValueError, match=r"labels need one entry per unknown \(1\), but 2 were given"):
        of_layout(state_size=2, unknowns=1, labels=("a", "b"))
