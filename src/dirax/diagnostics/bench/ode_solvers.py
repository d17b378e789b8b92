"""Libraries for ordinary differential equations, at the end error of the dirax run: DOP853, heyoka's Taylor method, diffrax.

Each gets the equations in its own fast form: SciPy a function compiled by dirax, heyoka its own expressions, diffrax
JAX. The tolerance is the loosest of a geometric sequence whose end error is not above that of dirax, by which the order
and the step-size control of these methods come to bear. They give the end point alone.
"""

import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dirax.diagnostics.bench.engines import end_error
from dirax.diagnostics.bench.ode import ExplicitODE
from dirax.diagnostics.bench.subject import Program, Skipped, library
from dirax.engines.native.ir.compiled_function import loaded
from dirax.program.graph import Graph
from dirax.program.interpreter import Interpreter, Unavailable, UnsupportedPrimitive

TOLERANCES = tuple(10 ** (-k / 2) for k in range(2, 30))
REFERENCE, FINEST = 1e-13, 3e-14
"""The relative tolerance of the reference, and the smallest that SciPy takes."""

MOST_SECONDS = 15.0
"""Time after which no finer tolerance is tried."""

MOST_STEPS = 20_000
"""Steps after which a method is given up: at a loose tolerance a trajectory may run off to infinity."""


def reference_end(ode: ExplicitODE, span: float) -> np.ndarray:
    """q (or x) at the end, by DOP853 at a relative tolerance of 1e-13."""
    return _dop853(ode, span)(REFERENCE)[: ode.shown]


def dop853(ode: ExplicitODE, span: float, reference: np.ndarray, wanted: float) -> Program:
    """SciPy's DOP853."""
    return _timed(_dop853(ode, span), ode, reference, wanted)


def _dop853(ode: ExplicitODE, span: float) -> Callable[[float], np.ndarray]:
    method = library("scipy.integrate").DOP853
    field = compiled_field(ode)

    def solve(tolerance: float) -> np.ndarray:
        with np.errstate(all="ignore"):
            solver, steps = method(field, 0.0, ode.start, span, rtol=max(tolerance, FINEST), atol=tolerance), 0
            while solver.status == "running" and steps < MOST_STEPS:
                solver.step()
                steps += 1
        return solver.y if solver.status == "finished" else np.full(len(ode.start), np.nan)

    return solve


def diffrax_dopri8(ode: ExplicitODE, span: float, reference: np.ndarray, wanted: float) -> Program:
    """diffrax's Dopri8 with its proportional-integral controller, compiled once."""
    diffrax = library("diffrax")
    term = diffrax.ODETerm(lambda t, y, args: ode.derivative(t, y))

    @jax.jit
    def compiled(start, tolerance):
        controller = diffrax.PIDController(rtol=tolerance, atol=tolerance)
        saved = diffrax.SaveAt(t1=True)
        solution = diffrax.diffeqsolve(
            term,
            diffrax.Dopri8(),
            0.0,
            span,
            None,
            start,
            saveat=saved,
            stepsize_controller=controller,
            max_steps=MOST_STEPS,
            throw=False,
        )
        return jnp.where(solution.result == diffrax.RESULTS.successful, solution.ys[-1], jnp.nan)

    start = jnp.asarray(ode.start)
    return _timed(lambda tolerance: np.asarray(compiled(start, tolerance)), ode, reference, wanted)


def heyoka_taylor(ode: ExplicitODE, span: float, reference: np.ndarray, wanted: float) -> Program:
    """heyoka's Taylor integrator, compiled anew for every tolerance."""
    heyoka = library("heyoka")
    graph, _, outputs = field_graph(ode)
    symbols = heyoka.make_vars(*(f"y{i}" for i in range(len(ode.start))))
    symbols = symbols if isinstance(symbols, list) else [symbols]
    known: dict[str, Any] = {f"y{i}": symbol for i, symbol in enumerate(symbols)} | {"t": heyoka.time}
    table = heyoka_operations(heyoka)
    if missing := {graph.op[n] for n in graph.reachable(outputs) if graph.args[n]} - table.keys():
        raise Skipped(f"heyoka has no {min(missing)}")
    rates = [heyoka.expression(rate) for rate in graph.evaluate(outputs, known, table)]
    made: dict[float, Any] = {}

    def solve(tolerance: float) -> np.ndarray:
        if tolerance not in made:
            made.clear()
            made[tolerance] = heyoka.taylor_adaptive(list(zip(symbols, rates, strict=True)), ode.start, tol=tolerance)
        integrator = made[tolerance]
        integrator.time = 0.0
        integrator.state[:] = ode.start
        integrator.propagate_until(span, max_steps=MOST_STEPS)
        if integrator.time != span:
            return np.full(len(ode.start), np.nan)
        return np.array(integrator.state)

    return _timed(solve, ode, reference, wanted)


def heyoka_operations(heyoka: Any) -> dict[str, Callable]:
    """The smooth operations of the scalar graph in heyoka."""
    same = ("sqrt", "sin", "cos", "tan", "asin", "acos", "atan", "atan2", "sinh", "cosh", "tanh", "asinh", "acosh", "atanh")
    return {
        **{name: getattr(heyoka, name) for name in (*same, "exp", "log", "erf")},
        "pow": lambda a, b: a**b,
        "add": lambda a, b: a + b,
        "sub": lambda a, b: a - b,
        "mul": lambda a, b: a * b,
        "neg": lambda a: -a,
        "recip": lambda a: 1.0 / a,
    }


def field_graph(ode: ExplicitODE) -> tuple[Graph, list[int], list[int]]:
    """ẏ as scalar expressions of t and y: the graph, its inputs and its outputs. Raises `Skipped`."""
    d, graph = len(ode.start), Graph()
    vector, scalar = jax.ShapeDtypeStruct((d,), jnp.float64), jax.ShapeDtypeStruct((), jnp.float64)
    closed = jax.make_jaxpr(ode.derivative)(scalar, vector)
    inputs = [graph.input("t"), *(graph.input(f"y{i}") for i in range(d))]
    try:
        (rates,) = Interpreter(graph).run(closed, np.array(inputs[0], dtype=np.int64), np.array(inputs[1:], dtype=np.int64))
    except UnsupportedPrimitive as error:
        raise Skipped(str(error)) from None
    if isinstance(rates, Unavailable):
        raise Skipped(str(rates.error))
    return graph, inputs, rates.tolist()


def compiled_field(ode: ExplicitODE, most: int | None = None) -> Callable[[float, np.ndarray], np.ndarray]:
    """(t, y) ↦ ẏ on NumPy arrays, compiled; about as cheap as a call from Python can be. Raises `Skipped`, also for more than
    `most` operations, a thousand of which take LLVM half a second."""
    graph, inputs, outputs = field_graph(ode)
    if most is not None and len(graph.reachable(outputs)) > most:
        raise Skipped(f"its equations have more than {most} operations")
    call = loaded(graph, inputs, outputs)
    given, rates = np.empty(len(inputs)), np.empty(len(outputs))
    pointers = given.ctypes.data, rates.ctypes.data

    def field(t: float, y: np.ndarray) -> np.ndarray:
        given[0], given[1:] = t, y
        call(*pointers, 1)
        return rates.copy()

    return field


def _timed(solve: Callable[[float], np.ndarray], ode: ExplicitODE, reference: np.ndarray, wanted: float) -> Program:
    """`solve(tolerance)` at the loosest tolerance that reaches the wanted end error."""
    started, last = time.perf_counter(), {}
    for chosen in TOLERANCES:
        if end_error(solve(chosen)[: ode.shown], reference) <= wanted:
            break
        if time.perf_counter() - started > MOST_SECONDS:
            raise Skipped(f"does not reach the error {wanted:.1e} in {MOST_SECONDS:.0f} s of trials")
    else:
        raise Skipped(f"does not reach the error {wanted:.1e}")

    def run() -> float:
        tick = time.perf_counter()
        last["end"] = solve(chosen)
        return time.perf_counter() - tick

    run()
    return Program(run, lambda: last["end"][: ode.shown], {"tolerance": chosen})
