"""Nodes that are equal as functions."""

import numpy as np
import pytest

from dirax.program.equal_nodes import PRIME, values_modulo_prime, without_equals
from dirax.program.graph import Graph
from dirax.program.graph_derivatives import jacobian


def values(g, *nodes):
    found = values_modulo_prime(g, g.reachable(nodes))
    return [found[node] for node in nodes]


def test_values_are_those_of_exact_arithmetic():
    """A float is the fraction that it is: .1 + .2 is not .3."""
    g = Graph()
    x, y, c = g.input("x"), g.input("y"), g.constant
    exact, sums, tenths = values(
        g,
        g.sub(g.mul(g.add(c(0.25), x), c(3.0)), g.mul(c(3.0), x)),
        g.sub(g.add(g.add(x, c(0.1)), g.add(y, c(0.2))), g.add(x, y)),
        c(0.3),
    )
    assert exact == 3 * pow(4, -1, PRIME) % PRIME
    a, b = (0.1).as_integer_ratio(), (0.2).as_integer_ratio()
    assert sums == (a[0] * pow(a[1], -1, PRIME) + b[0] * pow(b[1], -1, PRIME)) % PRIME != tenths


def test_roundoff_of_one_number_is_no_other_number():
    """The powers of 2 modulo p are all numbers but zero: 2 has no smaller order, whatever prime divides p − 1."""
    assert all(pow(2, (PRIME - 1) // factor, PRIME) != 1 for factor in (2, 165349, 4580250903341))
    assert PRIME - 1 == 2 * 165349 * 4580250903341 and pow(2, PRIME - 1, PRIME) == 1
    g, c = Graph(), lambda a: g.constant(float(a))
    x = g.input("x")
    found = values(
        g, *(g.add(g.mul(x, c(k * 2.0**-61)), g.mul(x, c(-i / 16))) for i in range(16) for k in (0, *2.0 ** np.arange(-9, 3)))
    )
    assert len(set(found)) == 16 * 13


def test_what_is_known_of_sines_and_what_is_not():
    g = Graph()
    x, y = g.input("x"), g.input("y")
    of = lambda op, node: g.make(op, node)
    circle, one = values(g, g.add(g.mul(of("sin", x), of("sin", x)), g.mul(of("cos", x), of("cos", x))), g.one)
    assert circle == one
    apart = g.sub(x, y), g.sub(y, x)
    sines, cosines = (values(g, *(of(op, node) for node in apart)) for op in ("sin", "cos"))
    assert sum(sines) == PRIME and cosines[0] == cosines[1]
    again = g.sub(g.add(x, y), y)
    assert len(set(values(g, of("exp", x), of("exp", again)))) == 1
    names = "exp", "log", "sqrt", "abs", "tanh", "floor"
    assert len(set(values(g, x, y, *(of(name, x) for name in names), g.make("max", x, y), g.constant(np.inf)))) == 10


@pytest.mark.parametrize("op", ["sin", "exp", "sqrt"])
def test_second_derivatives_are_taken_over_once(op):
    """Of f(x y, x) the Hessian has three entries and not four, with the values that it had, and no node twice."""
    g = Graph()
    x, y = g.input("x"), g.input("y")
    function = g.mul(g.make(op, g.mul(x, y)), g.add(x, g.make("exp", y)))
    (gradient,) = jacobian(g, [function], [x, y])
    first = [gradient[0], gradient[1]]
    every = g.copy()
    rows = jacobian(every, first, [x, y])
    found = without_equals(g, every, [rows[i][j] for i in range(2) for j in range(2)])
    assert rows[0][1] != rows[1][0] and found[1] == found[2]
    point = {"x": 0.7, "y": 1.3}
    expected = every.evaluate([rows[i][j] for i in range(2) for j in range(2)], point)
    np.testing.assert_allclose(g.evaluate(found, point), expected, rtol=1e-14)
    needed = g.reachable(found)
    new = [value for node, value in values_modulo_prime(g, needed).items() if g.args[node]]
    assert len(set(new)) == len(new)


def test_opposite_nodes_and_zeros():
    g = Graph()
    x, y = g.input("x"), g.input("y")
    every = g.copy()
    a = every.mul(x, every.sub(x, y))
    opposite = every.sub(every.mul(x, y), every.mul(x, x))
    nothing = every.add(a, opposite)
    one, other, zero = without_equals(g, every, [a, opposite, nothing])
    assert other == g.neg(one) and zero == g.zero


def test_nothing_finite_is_replaced_by_what_is_not():
    """(y + y x²)/y, which was there before, is no stand-in for 1 + x², but that is for others like it, and 2 for (y + y)/y."""
    g = Graph()
    x, y = g.input("x"), g.input("y")
    square, over = g.mul(x, x), g.recip(y)
    quotient, two = g.mul(g.add(y, g.mul(y, square)), over), g.mul(g.add(y, y), over)
    every = g.copy()
    plain = every.add(every.one, square)
    other = every.sub(every.mul(every.add(x, every.one), every.add(x, every.one)), every.add(x, x))
    split = every.add(every.mul(every.mul(y, square), over), every.mul(y, over))
    outputs = [quotient, plain, other, split, two, every.constant(2.0), every.mul(every.mul(y, every.constant(2.0)), over)]
    found = without_equals(g, every, outputs)
    assert found[0] == quotient and g.number(found[4]) == 2.0
    assert found[1] == found[2] == found[3] != quotient and found[4] == found[5] == found[6]
    numbers = {"x": np.array(0.7), "y": np.array(0.0)}
    with np.errstate(all="ignore"):
        assert np.isfinite(g.evaluate(found, numbers)).tolist() == [False, *[True] * 6]


def test_a_node_is_not_replaced_by_one_with_more_inputs():
    """x + y − y is x, but Newton's method may know x alone."""
    g = Graph()
    x, y = g.input("x"), g.input("y")
    more = g.sub(g.make("mul", g.add(x, y), g.constant(3.0)), g.make("mul", y, g.constant(3.0)))
    every = g.copy()
    less = every.mul(every.constant(3.0), x)
    both = every.add(more, y), every.add(less, y)
    first, second = without_equals(g, every, list(both))
    assert first == second
    (alone,) = without_equals(g, every, [less])
    _, again = without_equals(g, every, [more, less])
    assert y not in g.reachable([alone]) and y not in g.reachable([again])
