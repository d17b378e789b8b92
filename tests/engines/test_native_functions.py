"""The elementary functions of the native engine against mpmath, in units of the last place; the same bits at every width."""

import mpmath
import numpy as np
import pytest

from dirax.engines.native.functions import MACHINE_CODE
from dirax.engines.native.ir.compiled_function import compiled
from dirax.program.evaluation.by_jax import by_jax
from dirax.program.graph import Graph
from dirax.program.graph_derivatives import partials
from dirax.program.operations import NUMPY, OPERATIONS, derivatives

COUNT = 250
rng = np.random.default_rng(20260331)
between = lambda low, high: rng.uniform(low, high, COUNT)
signs = lambda: rng.choice([-1.0, 1.0], COUNT)
powers = lambda low, high: signs() * 10.0 ** rng.uniform(low, high, COUNT)
CIRCLE = np.concatenate([between(-10, 10), powers(-8, 6), np.arange(1, 200) * np.pi / 2, powers(6, 300)])
NEAR_ONE = np.concatenate([between(-1, 1), powers(-10, -0.01), 1 - abs(powers(-14, -1)), -1 + abs(powers(-14, -1))])
GROWTH = np.concatenate([between(-2, 2), powers(-10, 2.5), between(-700, 700)])
POINTS = {  # function: arguments, largest error in units of the last place
    "sin": (CIRCLE, 1.0),
    "cos": (CIRCLE, 1.0),
    "tan": (CIRCLE, 1.0),
    "asin": (NEAR_ONE, 1.0),
    "acos": (NEAR_ONE, 1.0),
    "atan": (np.concatenate([between(-3, 3), powers(-10, 100)]), 1.0),
    "exp": (np.concatenate([between(-2, 2), between(-700, 709), between(-744, -708)]), 1.0),
    "exp2": (np.concatenate([between(-2, 2), between(-1000, 1000)]), 1.0),
    "expm1": (GROWTH, 1.2),
    "sinh": (GROWTH, 1.0),
    "cosh": (GROWTH, 1.0),
    "tanh": (np.concatenate([between(-2, 2), powers(-10, 1.2)]), 1.2),
    "log": (np.concatenate([between(0.5, 2), abs(powers(-300, 300)), 1 + powers(-10, -2), abs(powers(-320, -308))]), 1.0),
    "log1p": (np.concatenate([between(-0.9, 2), powers(-10, -0.1), abs(powers(-2, 300))]), 1.3),
    "asinh": (np.concatenate([between(-3, 3), powers(-10, 200)]), 2.0),
    "acosh": (1 + np.concatenate([between(0, 3), abs(powers(-10, 200))]), 2.0),
    "atanh": (NEAR_ONE[: 2 * COUNT], 2.0),
    "cbrt": (np.concatenate([between(-9, 9), powers(-300, 300)]), 1.0),
    "erf": (np.concatenate([between(-3, 3), powers(-10, 1)]), 2.0),
    "erfc": (np.concatenate([between(-3, 3), between(1, 26)]), 4.0),
    "sqrt": (abs(powers(-300, 300)), 0.5),
}
EXACT = {
    "exp2": lambda x: mpmath.mpf(2) ** x,
    "log1p": lambda x: mpmath.log(1 + x),
    "expm1": lambda x: mpmath.exp(x) - 1,
    "cbrt": lambda x: mpmath.sign(x) * mpmath.cbrt(abs(x)),
    "pow": mpmath.power,
}


def last_places(got: float, exact) -> float:
    nearest = float(exact)
    if nearest == 0 or not np.isfinite(nearest):
        return 0.0 if got == nearest else np.inf
    return float(abs(mpmath.mpf(float(got)) - exact) / mpmath.mpf(float(np.spacing(abs(nearest)))))


def at_every_width(name: str, *columns: np.ndarray) -> np.ndarray:
    g = Graph()
    inputs = [g.input(f"x{i}") for i in range(len(columns))]
    outputs = [g.make(name, *inputs)]
    values = np.stack(columns)
    results = [compiled(g, inputs, outputs, width)(values)[0] for width in (1, 2, 4, 8)]
    for found in results:
        found[np.isnan(found)] = np.nan  # its sign is the processor's choice
    for other in results[1:]:
        assert other.tobytes() == results[0].tobytes()
    return results[0]


@pytest.mark.parametrize("name", POINTS)
def test_errors_in_last_places(name, record_property):
    x, bound = POINTS[name]
    got = at_every_width(name, x)
    with mpmath.workprec(1300 if name in ("sin", "cos", "tan") else 300):
        exact = EXACT.get(name) or getattr(mpmath, name)
        errors = [last_places(g, exact(mpmath.mpf(float(a)))) for a, g in zip(x, got, strict=True)]
    worst = int(np.argmax(errors))
    record_property("largest error in last places", errors[worst])
    assert errors[worst] <= bound, f"{name}({x[worst]!r}) = {got[worst]!r}, {errors[worst]:.2f} last places off"


@pytest.mark.parametrize("name", ["pow", "atan2"])
def test_errors_of_two_arguments(name):
    if name == "pow":
        x = np.concatenate([between(0.1, 10), abs(powers(-30, 30)), 1 + powers(-6, -1)])
        y = np.concatenate([between(-20, 20), between(-9, 9), between(-700, 700)])
    else:
        x = np.concatenate([powers(-3, 3), powers(-100, 100), between(-1, 1)])
        y = np.concatenate([powers(-3, 3), powers(-100, 100), between(-1, 1)])
    got = at_every_width(name, x, y)
    with mpmath.workprec(300):
        exact = EXACT.get(name) or getattr(mpmath, name)
        pairs = zip(x, y, got, strict=True)
        errors = [last_places(g, exact(mpmath.mpf(float(a)), mpmath.mpf(float(b)))) for a, b, g in pairs]
    assert max(errors) <= 1.0


SPECIAL = np.array([0, -0.0, 1, -1, 2, -2, 3, -3, 0.5, -0.5, np.inf, -np.inf, np.nan, 1e300, -1e300, 1e-300, 5e-324, 800, -800])


@pytest.mark.parametrize("name", [*POINTS, "floor", "ceil", "round", "trunc", "sign", "recip"])
def test_special_values_are_numpys(name):
    with np.errstate(all="ignore"):
        expected = NUMPY[name](SPECIAL)
    tolerance = 2e-15 if name == "erfc" else 4e-16
    np.testing.assert_allclose(at_every_width(name, SPECIAL), expected, rtol=tolerance, atol=5e-324)


@pytest.mark.parametrize("name", ["pow", "atan2", "max", "min", "rem"])
def test_special_pairs_are_numpys(name):
    x, y = (grid.ravel() for grid in np.meshgrid(SPECIAL, SPECIAL))
    with np.errstate(all="ignore"):
        expected = NUMPY[name](x, y)
    np.testing.assert_allclose(at_every_width(name, x, y), expected, rtol=4e-16, atol=5e-324)


# ---------------------------------------------------------------------- every operation is whole

RULED = {operation.name for operation in derivatives.OPERATIONS}
PLAIN = [name for name in OPERATIONS if name not in ("select", "and", "or", "not", *RULED)]
OPERANDS = {"acosh": (1.7,), "pow": (1.7, -0.6), "recip": (0.4,)}
PAIRS = ("add", "sub", "mul", "max", "min", "rem", "atan2", "pow", "lt", "le", "eq", "ne")


def of_numbers(name: str) -> tuple[Graph, list[int], int, np.ndarray]:
    """A graph, its inputs, an operation of them, and numbers at which it is smooth."""
    point = np.array(OPERANDS.get(name, (0.7, 0.3) if name in PAIRS else (0.35,)))
    g = Graph()
    inputs = [g.input(f"x{i}") for i in range(len(point))]
    return g, inputs, g.make(name, *inputs), point


def test_every_operation_has_machine_code_or_a_formula():
    assert OPERATIONS.keys() == MACHINE_CODE.keys() | {name for name, o in OPERATIONS.items() if o.formula}
    assert not [name for name in MACHINE_CODE if OPERATIONS[name].formula]
    assert all(name == operation.name for name, operation in OPERATIONS.items())


@pytest.mark.parametrize("name", PLAIN)
def test_jax_and_machine_code_mean_what_numpy_does(name):
    g, inputs, node, point = of_numbers(name)
    expected = float(NUMPY[name](*point))
    assert compiled(g, inputs, [node])(point[:, None]).item() == pytest.approx(expected, rel=4e-16)
    assert by_jax(g, [node], dict(zip(inputs, point, strict=True))).item() == pytest.approx(expected, rel=2e-15)


@pytest.mark.parametrize("name", [name for name in PLAIN if OPERATIONS[name].derivative])
def test_derivatives_are_those_of_numpys_values(name):
    g, inputs, node, point = of_numbers(name)
    values = {f"x{i}": x for i, x in enumerate(point)}
    slopes = g.evaluate([slope for slope in partials(g, node) if slope is not None], values)
    assert len(slopes) == len(inputs)
    for i, slope in enumerate(slopes):
        step = np.eye(len(point))[i] * 1e-5
        difference = (NUMPY[name](*(point + step)) - NUMPY[name](*(point - step))) / 2e-5
        assert slope == pytest.approx(float(difference), rel=1e-8, abs=1e-9)


def test_operations_without_a_derivative_are_steps_or_truth_values():
    none = {name for name, operation in OPERATIONS.items() if operation.derivative is None}
    assert none - RULED == {name for name, operation in OPERATIONS.items() if operation.stepwise or operation.boolean}


def test_the_choice_and_logic_are_whole():
    g = Graph()
    x, y = g.input("x0"), g.input("x1")
    a, b = g.make("lt", x, y), g.make("lt", g.zero, x)
    nodes = [g.select(a, x, y), g.make("and", a, b), g.make("or", a, b), g.make("not", a)]
    for point in ([0.5, 0.7], [0.7, 0.5], [-0.5, 0.7], [-0.5, -0.7]):
        expected = [float(v) for v in g.evaluate(nodes, {"x0": point[0], "x1": point[1]})]
        assert compiled(g, [x, y], nodes)(np.array(point)[:, None])[:, 0].tolist() == expected
        assert by_jax(g, nodes, {x: point[0], y: point[1]}).tolist() == expected
