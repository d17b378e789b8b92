"""Time of a step of the unreduced, the reduced and the Routh equations of the double spherical pendulum of [RL] §7.2.

    python -m benchmarks reduction

The midpoint discrete Lagrangian, h = .01, constants in the program, one trajectory and a batch, on both engines and in JAX as
one would write it (scan, jacfwd, jnp.linalg.solve). Every round runs each program once, in turn. The paper reports that its
reduced code was about 75 % faster than its unreduced one.

What to expect. With exact Newton steps the reduced equations are the unreduced ones in other variables: their Jacobians
differ by a change of basis, and γ is a column of the elimination. The Routh equations have the Schur complement of that
column for their Jacobian, M − b c⁻¹ bᵀ: all of M, b and c have to be computed, the first pivot of the elimination moves into
the residual, and with it its division, which now is on the way of every evaluation and not of every Jacobian. On the native
engine, whose single trajectory is a chain of dependent operations (sines, residual, pivots, one after the other), a division
more an evaluation costs what an unknown less saves.
"""

import time
from typing import Any

import jax
import jax.numpy as jnp

import dirax as dx
from benchmarks.harness import interleaved, store, summary, table
from dirax.diagnostics.bench.engines import plain_run
from dirax.engines import native, xla
from dirax.engines.native.program import program
from dirax.engines.result import Problem
from dirax.gallery.double_spherical_pendulum import EXAMPLE, PARAMS, lagrangian
from dirax.gallery.rodriguez_leok import FASTER
from dirax.schemes.step import Shape, make_step_equation

SYSTEM = dx.LagrangeDirac(lambda q, v: lagrangian(q, v, PARAMS))
REDUCED = dx.reduce(SYSTEM, dx.LinearConnection(fibre=[0]))
MIDPOINT = dx.PlusLagrangeDirac("midpoint")
EQUATIONS: dict[str, tuple[Any, Any]] = {
    "unreduced": (SYSTEM, MIDPOINT),
    "reduced": (REDUCED, MIDPOINT),
    "Routh": (REDUCED, dx.DiscreteRouth("midpoint")),
}


def problem(name: str, steps: int, batch: int | None) -> Problem:
    """A run from the paper's initial data, or from a batch of points near them; only the last row is saved."""
    system, scheme = EQUATIONS[name]
    equation: Any = make_step_equation(scheme, system, Shape(4))

    def start(shift):
        q, p = jnp.asarray(EXAMPLE.initial["q"]).at[1].add(shift), jnp.asarray(EXAMPLE.initial["p"])
        return equation.start(SYSTEM.complete({"q": q, "p": p}, None, False), EXAMPLE.step, None)

    shifts = jnp.zeros(()) if batch is None else 1e-3 * jnp.arange(batch) / batch
    state, guess = (start if batch is None else jax.vmap(start))(shifts)
    return Problem(equation, state, (guess,), EXAMPLE.step, 0.0, steps, steps, batch=batch)


def operations(name: str) -> dict[str, int]:
    """Scalar operations of the compiled step: residual, Jacobian, elimination and all together."""
    made, _ = program(problem(name, 1, None).equation, None, False)
    plan = made._planned()
    g, equation, correction = plan.graph, plan.equations[0], plan.corrections[0]
    count = lambda nodes: sum(1 for node in g.reachable(nodes) if g.args[node])
    jacobian = [node for row in correction.jacobian for node in row]
    residual, with_jacobian = count(equation.residual), count([*equation.residual, *jacobian])
    everything = count([*equation.residual, *jacobian, *correction.change, correction.stable])
    return {
        "unknowns": len(equation.unknowns),
        "residual": residual,
        "Jacobian": with_jacobian - residual,
        "elimination": everything - with_jacobian,
        "step": made.operations,
    }


def timed(run) -> float:
    started = time.perf_counter()
    run()
    return time.perf_counter() - started


def measure(repeats: int, steps: int, batch: int) -> dict[str, dict[str, dict[str, float]]]:
    """Microseconds a step and trajectory, by setting and equations."""
    few = max(1, steps // 100)
    settings = {
        "native, one trajectory": (native.run, steps, None),
        f"native, {batch} trajectories": (native.run, few, batch),
        "xla, one trajectory": (xla.run, steps // 4, None),
        f"xla, {batch} trajectories": (xla.run, few, batch),
        "JAX as one writes it": (None, steps // 4, None),
    }
    found = {}
    for label, (engine, count, size) in settings.items():
        programs = {}
        for name in EQUATIONS:
            p = problem(name, count, size)
            run = plain_run(p) if engine is None else lambda p=p, engine=engine: engine(p)
            programs[name] = lambda run=run: timed(run)
        seconds = interleaved(programs, repeats)
        unit = 1e6 / (count * (size or 1))
        found[label] = {name: summary([unit * s for s in values]) for name, values in seconds.items()}
    return found


def main(short: bool = False) -> None:
    repeats, steps, batch = (9, 8_000, 256) if short else (31, 40_000, 2048)
    found = measure(repeats, steps, batch)
    counts = {name: operations(name) for name in EQUATIONS}
    rows = []
    for label, times in found.items():
        base = times["unreduced"]["median"]
        cells = [f"{times[name]['median']:.3f} ({base / times[name]['median']:.2f}×)" for name in EQUATIONS]
        rows.append((label, *cells))
    title = f"double spherical pendulum: µs a step, medians of {repeats} (speed over unreduced)"
    print(table(("", *EQUATIONS), rows, title))
    kinds = list(next(iter(counts.values())))
    print(table(("", *kinds), [(name, *(str(c[k]) for k in kinds)) for name, c in counts.items()], "scalar operations, native"))
    print(f"the paper's reduced code was about {FASTER:.0%} faster than its unreduced one")
    store("reduction", {"microseconds_per_step": found, "operations": counts, "paper": {"faster": FASTER}})


if __name__ == "__main__":
    main()
