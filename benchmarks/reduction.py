"""Time of a step of the unreduced, the reduced and the Routh equations, in one run.

    python -m benchmarks reduction

The double spherical pendulum of [RL] §7.2 (dim G = 1 of 4) on both engines and in JAX as one would write it (scan, jacfwd,
jnp.linalg.solve), and the planar three-body problem without translations and rotations (dim G = 3 of 6) on the native engine:
midpoint discrete Lagrangian, constants in the program, one thread, processor time, every program once a round. The paper
reports that its reduced code for the pendulum was about 75 % faster than its unreduced one.

What to expect. With exact Newton steps the reduced equations are the unreduced ones in other variables: their Jacobians
differ by a change of basis, and γ is a column of the elimination. The Routh equations have the Schur complement of that
column for their Jacobian, M − b c⁻¹ bᵀ: all of M, b and c have to be computed, and the first pivot of the elimination moves
into the residual. For the pendulum that saves half of the elimination, a fifteenth of the scalar operations of a step, and
puts a division in the way of every evaluation of the residual; a single trajectory on the native engine is a chain of
dependent operations (sines, residual, pivots), where this costs what an unknown less saves. The reduction pays where the
group is large or L at group coordinate 0 is simpler than L, as for the three bodies.
"""

import os
import time
from typing import Any

import jax
import jax.numpy as jnp

import dirax as dx
from benchmarks.harness import interleaved, store, summary, table
from dirax.diagnostics.bench.engines import plain_run
from dirax.engines.contract import Problem
from dirax.engines.native import Native
from dirax.engines.native.kernels import kernels
from dirax.engines.xla import Xla
from dirax.gallery import double_spherical_pendulum, planar_n_body
from dirax.gallery.rodriguez_leok import FASTER
from dirax.schemes.step import Shape, make_step_equation

MIDPOINT, ROUTH = dx.PlusLagrangeDirac("midpoint"), dx.DiscreteRouth("midpoint")


def equations(system: dx.LagrangeDirac, fibre: list[int]) -> dict[str, tuple[Any, Any]]:
    """The three ways to step a system."""
    reduced = dx.reduce(system, dx.LinearConnection(fibre))
    return {"unreduced": (system, MIDPOINT), "reduced": (reduced, MIDPOINT), "Routh": (reduced, ROUTH)}


PENDULUM = dx.LagrangeDirac(lambda q, v: double_spherical_pendulum.lagrangian(q, v, double_spherical_pendulum.PARAMS))
BODIES = dx.in_coordinates(
    dx.LagrangeDirac(lambda q, v: planar_n_body.lagrangian(q, v, planar_n_body.PARAMS)),
    lambda y: planar_n_body.from_shape(y, planar_n_body.PARAMS),
)
WAYS = {"pendulum": equations(PENDULUM, [0]), "three bodies": equations(BODIES, [3, 4, 5])}


def initial(subject: str) -> tuple[Any, Any, float]:
    """q, p and the step: the paper's, and the figure eight in shape coordinates."""
    if subject == "pendulum":
        data = double_spherical_pendulum.EXAMPLE.initial
        return jnp.asarray(data["q"]), jnp.asarray(data["p"]), 0.01
    data = planar_n_body.EXAMPLE.initial
    q, v = jax.jvp(lambda q: planar_n_body.to_shape(q, planar_n_body.PARAMS), (data["q"],), (data["v"],))
    return q, BODIES.legendre(q, v), 0.003


def problem(subject: str, way: str, steps: int, batch: int | None) -> Problem:
    """A run from the initial data, or from a batch of points near them; only the last row is saved."""
    system, scheme = WAYS[subject][way]
    q, p, h = initial(subject)
    equation: Any = make_step_equation(scheme, system, Shape(len(q)))
    unreduced = WAYS[subject]["unreduced"][0]

    def start(shift):
        return equation.start(unreduced.complete({"q": q.at[1].add(shift), "p": p}, None, False), h, None)

    shifts = jnp.zeros(()) if batch is None else 1e-3 * jnp.arange(batch) / batch
    state, guess = (start if batch is None else jax.vmap(start))(shifts)
    return Problem(equation, state, (guess,), h, 0.0, steps, steps, batch=batch)


def operations(subject: str, way: str) -> dict[str, int]:
    """Scalar operations of the compiled step: residual, Jacobian, elimination and all together."""
    made = kernels(problem(subject, way, 1, None).equation, None, False)
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
    started = time.process_time()
    run()
    return time.process_time() - started


def measure(repeats: int, steps: int, batch: int) -> dict[str, dict[str, dict[str, float]]]:
    """Microseconds of processor time a step and trajectory, by setting and way."""
    os.environ["DIRAX_THREADS"] = "1"
    few = max(1, steps // 100)
    settings = {
        "pendulum, native": ("pendulum", Native().run, steps, None),
        f"pendulum, native, {batch} at once": ("pendulum", Native().run, few, batch),
        "pendulum, xla": ("pendulum", Xla().run, steps // 4, None),
        "pendulum, JAX as one writes it": ("pendulum", None, steps // 4, None),
        "three bodies, native": ("three bodies", Native().run, steps, None),
        f"three bodies, native, {batch} at once": ("three bodies", Native().run, few, batch),
    }
    found = {}
    for label, (subject, engine, count, size) in settings.items():
        programs = {}
        for way in WAYS[subject]:
            p = problem(subject, way, count, size)
            run = plain_run(p) if engine is None else lambda p=p, engine=engine: engine(p)
            programs[way] = lambda run=run: timed(run)
        seconds = interleaved(programs, repeats)
        unit = 1e6 / (count * (size or 1))
        found[label] = {way: summary([unit * s for s in values]) for way, values in seconds.items()}
    return found


def main(short: bool = False) -> None:
    repeats, steps, batch = (9, 8_000, 256) if short else (31, 40_000, 2048)
    found = measure(repeats, steps, batch)
    counts = {f"{subject}, {way}": operations(subject, way) for subject, ways in WAYS.items() for way in ways}
    rows = []
    for label, times in found.items():
        base = times["unreduced"]["median"]
        rows.append((label, *(f"{t['median']:.3f} ({base / t['median']:.2f}×)" for t in times.values())))
    print(table(("", *WAYS["pendulum"]), rows, f"µs a step, medians of {repeats} (speed over unreduced)"))
    kinds = list(next(iter(counts.values())))
    lines = [(name, *(str(c[k]) for k in kinds)) for name, c in counts.items()]
    print(table(("", *kinds), lines, "scalar operations of a step, native"))
    print(f"the paper's reduced code for the pendulum was about {FASTER:.0%} faster than its unreduced one")
    store("reduction", {"microseconds_per_step": found, "operations": counts, "paper": {"faster": FASTER}})


if __name__ == "__main__":
    main()
