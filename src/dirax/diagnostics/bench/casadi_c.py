"""The step in C: CasADi differentiates it and writes the code, a C compiler compiles it, Newton's loop in C runs it.

CasADi is given the scalar expressions of the step (residual, predictor, next state), and makes the Jacobian and the code
its own way. The loop stops as `dirax.engines.xla.newton` does and begins from the same quadratic extrapolation, but renews the
Jacobian in every update.
"""

import ctypes
import subprocess
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from dirax.diagnostics.bench.subject import Program, Skipped, Subject, library
from dirax.diagnostics.bench.timing import compiler
from dirax.engines.contract import Problem
from dirax.engines.parameters import parameters
from dirax.engines.step_program import inputs, trace
from dirax.program.graph import Graph
from dirax.program.interpreter import UnsupportedPrimitive
from dirax.program.operations import EXACT, OPERATIONS

FLAGS = ("-O3", "-march=native")
MOST_SECONDS = 60
"""Longest time for the C compiler."""

DRIVER = r"""
#include <math.h>
#include <string.h>
#include "step.c"
static int at_floor(double update, double before, int updates) {
  if (update <= 8 * 2.220446049250313e-16) return 1;
  if (updates < 2) return 0;
  double ratio = update / before;
  return (ratio >= 0.5 && update < 1e-9) || update * ratio * ratio <= 1e-5 * 2.220446049250313e-16;
}
static int solve(double a[K][K], double b[K]) {
  for (int c = 0; c < K; c++) {
    int best = c;
    for (int i = c + 1; i < K; i++) if (fabs(a[i][c]) > fabs(a[best][c])) best = i;
    if (best != c) {
      for (int j = c; j < K; j++) { double s = a[c][j]; a[c][j] = a[best][j]; a[best][j] = s; }
      double s = b[c]; b[c] = b[best]; b[best] = s;
    }
    if (a[c][c] == 0) return 1;
    double inverse = 1.0 / a[c][c];
    for (int i = c + 1; i < K; i++) {
      double factor = a[i][c] * inverse;
      for (int j = c + 1; j < K; j++) a[i][j] -= factor * a[c][j];
      b[i] -= factor * b[c];
    }
  }
  for (int i = K - 1; i >= 0; i--) {
    for (int j = i + 1; j < K; j++) b[i] -= a[i][j] * b[j];
    b[i] /= a[i][i];
  }
  return 0;
}
/* state and unknowns are replaced by those at the end; the number of updates, or -1 for a step that is not solved */
long run(double *state, double *unknowns, double t0, double h, long first, long steps) {
  double u[K], slope[K] = {0}, bend[K] = {0}, extrapolated[K], r[K], flat[K * K], a[K][K], next[S];
  long updates = 0;
  for (long k = 0; k < steps; k++) {
    double t = t0 + h * (k + first), before = 0;
    for (int i = 0; i < K; i++) extrapolated[i] = unknowns[i] + slope[i] + bend[i];
    const double *begin[4] = {state, extrapolated, &t, &h};
    double *begun[1] = {u};
    step_guess(begin, begun, 0, 0, 0);
    const double *arg[4] = {u, state, &t, &h};
    for (int i = 1;; i++) {
      if (i > 50) return -1;
      double *res[2] = {r, flat};
      step_residual(arg, res, 0, 0, 0);
      for (int j = 0; j < K; j++) for (int c = 0; c < K; c++) a[c][j] = flat[j * K + c];
      if (solve(a, r)) return -1;
      double update = 0;
      for (int j = 0; j < K; j++) {
        u[j] -= r[j];
        double share = fabs(r[j]) / (fabs(u[j]) + 1);
        if (!(share <= update)) update = share;
      }
      updates++;
      if (isnan(update)) return -1;
      if (at_floor(update, before, i)) break;
      before = update;
    }
    double *res[1] = {next};
    step_advance(arg, res, 0, 0, 0);
    memcpy(state, next, sizeof next);
    for (int i = 0; i < K; i++) {
      double change = k > 0 ? u[i] - unknowns[i] : 0;
      bend[i] = k > 1 ? change - slope[i] : 0;
      slope[i] = change;
      unknowns[i] = u[i];
    }
  }
  return updates;
}
"""


def casadi_c(subject: Subject) -> Program:
    """One trajectory in C. Raises `Skipped` without CasADi or a compiler, or for a step that they do not take."""
    run, last = c_run(subject.one), {}

    def timed() -> float:
        seconds, *last["end"] = run()
        return seconds

    timed()
    return Program(timed, lambda: subject.position(*last["end"]), {"flags": " ".join(FLAGS)})


def c_run(p: Problem) -> Callable[[], tuple[float, np.ndarray, np.ndarray]]:
    """A function to (seconds, state, unknowns at the end) of the problem's run in compiled C."""
    casadi = library("casadi")
    found = compiler()
    if found is None:
        raise Skipped("there is no C compiler")
    if p.equation.unknowns == 0:
        raise Skipped("the scheme is explicit")
    with tempfile.TemporaryDirectory() as folder:
        _write(casadi, p, Path(folder))
        command = [found, *FLAGS, "-shared", "-fPIC", "-o", "step.so", "driver.c", "-lm"]
        try:
            subprocess.run(command, cwd=folder, check=True, capture_output=True, timeout=MOST_SECONDS)
        except subprocess.TimeoutExpired:
            raise Skipped(f"the C compiler needs more than {MOST_SECONDS} s") from None
        except subprocess.CalledProcessError as error:
            raise Skipped(f"the C compiler refuses the code: {error.stderr.decode().splitlines()[0]}") from None
        program = ctypes.CDLL(str(Path(folder) / "step.so"))
    program.run.restype = ctypes.c_long
    program.run.argtypes = [ctypes.c_void_p] * 2 + [ctypes.c_double] * 2 + [ctypes.c_long] * 2

    def run():
        state, unknowns = np.array(p.state, dtype=float), np.array(p.guess[0], dtype=float)
        tick = time.perf_counter()
        updates = program.run(state.ctypes.data, unknowns.ctypes.data, p.t0, p.h, p.first_step, p.steps)
        seconds = time.perf_counter() - tick
        if updates < 0:
            raise Skipped("a step of the C program is not solved")
        return seconds, state, unknowns

    return run


def _write(casadi: Any, p: Problem, folder: Path) -> None:
    """step.c by CasADi and the loop around it."""
    e = p.equation
    leaves = parameters(p.params, False)
    graph = Graph()
    shared = inputs(graph, leaves.size)
    try:
        traced = trace(graph, shared, e, leaves)
    except UnsupportedPrimitive as error:
        raise Skipped(str(error)) from None
    vector = lambda name, n: casadi.SX.sym(name, n)
    u, state, previous = vector("u", e.unknowns), vector("state", e.state_size), vector("previous", e.unknowns)
    t, h = casadi.SX.sym("t"), casadi.SX.sym("h")
    known = {"t": t, "h": h} | {f"param{i}": value for i, value in enumerate(leaves.flatten(p.params, None).tolist())}
    for name, symbols in (("u", u), ("state", state), ("previous", previous)):
        known |= {f"{name}{i}": symbols[i] for i in range(symbols.shape[0])}
    table = operations(casadi)
    nodes = graph.reachable([*traced.guess, *traced.residual, *traced.advance])
    if missing := {graph.op[n] for n in nodes if graph.args[n]} - table.keys():
        raise Skipped(f"the operation {min(missing)} is not translated for CasADi")
    column = lambda outputs: casadi.vertcat(*graph.evaluate(outputs, known, table))
    residual = column(traced.residual)
    jacobian = casadi.densify(casadi.jacobian(residual, u))
    functions = (
        ("step_guess", [state, previous, t, h], [column(traced.guess)]),
        ("step_residual", [u, state, t, h], [casadi.densify(residual), jacobian]),
        ("step_advance", [u, state, t, h], [column(traced.advance)]),
    )
    generator = casadi.CodeGenerator("step.c", {"with_header": False})
    for name, arguments, results in functions:
        generator.add(casadi.Function(name, arguments, casadi.cse([casadi.densify(r) for r in results])))
    generator.generate(f"{folder}/")
    sizes = f"#define K {e.unknowns}\n#define S {e.state_size}\n"
    (folder / "driver.c").write_text(sizes + DRIVER)


def operations(casadi: Any) -> dict[str, Callable]:
    """The operations of the scalar graph in CasADi: Python's operators, the names of C, and what it says its own way."""
    named = {name: getattr(casadi, o.c) for name, o in OPERATIONS.items() if o.c is not None and hasattr(casadi, o.c)}
    return {
        **EXACT,
        **named,
        "recip": lambda a: 1 / a,
        "pow": lambda a, b: a**b,
        "exp2": lambda a: 2.0**a,
        "sign": casadi.sign,
        "select": casadi.if_else,
        "and": casadi.logic_and,
        "or": casadi.logic_or,
        "not": casadi.logic_not,
        "finite": lambda a: casadi.lt(casadi.fabs(a), casadi.inf),
    }
