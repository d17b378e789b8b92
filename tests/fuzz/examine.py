"""What is asked of a scheme on a random system; `examine` returns what is wrong, in words."""

import zlib
from collections.abc import Iterator

import jax
import jax.numpy as jnp
import numpy as np

import dirax as dx
from dirax.diagnostics.replay_lines import replayed
from fuzz.reference import motion, rows_of
from fuzz.systems import Kind, RandomSystem

LAGRANGE = dx.LagrangeDAlembert()
SCHEMES = {
    "midpoint": (LAGRANGE, 2),
    "trapezoidal": (dx.LagrangeDAlembert("trapezoidal"), 2),
    "plus": (dx.PlusLagrangeDirac(), 1),
    "minus": (dx.MinusLagrangeDirac(), 1),
    "Method 1": (dx.DiscreteDirac(), 2),
    "Method 2": (dx.DiscreteDirac(constraints="resolve"), 2),
    "suzuki4": (dx.Composition(LAGRANGE, "suzuki4"), 4),
    "symmetric": (dx.SymmetricComposition(dx.PlusLagrangeDirac()), 2),
    "collocation": (dx.Collocation(2), 4),
}
STEP, STEPS = 0.05, 12
FLOOR = 3e-11
"""Errors below this say nothing of an order."""

SLACK = 0.6
"""An order measured over one halving of the step is off by so much at most."""

DAMAGE = 1e-6


def examine(system: RandomSystem, name: str, params: dict, start: dict, deep: bool = False) -> list[str]:
    """All that is wrong with a scheme on a system; `deep` damages each field, not one of them, and asks of derivatives and of
    the other engine too."""
    scheme, order = SCHEMES[name]
    run = lambda h, steps, **more: dx.simulate(
        system.system, scheme, **({"params": params, "step": h, "steps": steps} | start | more)
    )
    try:
        sols = [run(STEP / 2**i, STEPS * 2**i) for i in range(3)]
    except (TypeError, ValueError) as refused:
        return [f"refused: {refused}"]
    if not all(sol.ok for sol in sols):
        return [f"failed: {next(sol.message for sol in sols if not sol.ok)}"]
    wrong = [f"order: {text}" for text in _orders(system, sols, order, motion(system, params, start, np.asarray(sols[0].t)))]
    report = dx.verify(sols[1])
    wrong += [f"false alarm: {line.quantity}: {line.explanation}" for line in report.lines if line.verdict == "VIOLATED"]
    if (line := report["steps replayed"]).verdict != "ok":
        wrong.append(f"not replayed: {line.explanation}")
    else:
        several = list(damaged(sols[1]))
        looked_at = several if deep else [several[zlib.crc32(np.asarray(sols[1].q).tobytes()) % len(several)]]
        wrong += [f"missed: {what}" for what, other in looked_at if replayed(other, None).verdict != "VIOLATED"]
    wrong += _restart(sols[1], run)
    if deep:
        wrong += [*_batch(sols[0], run, start), *_engines(sols[0], run), *_gradient(run, params)]
    return wrong


def damaged(sol: dx.Solution) -> Iterator[tuple[str, dx.Solution]]:
    """The solution with one number off by a millionth of the largest of its field, for each field."""
    draw = np.random.default_rng(0)
    for field, values in sol.fields.items():
        changed = np.array(values)
        place = tuple(draw.integers(size) for size in changed.shape)
        largest = np.max(np.abs(changed), initial=0.0)
        changed[place] += DAMAGE * (largest if largest > 1e-9 else 1.0)
        yield f"{field}{list(map(int, place))}", sol.replace(fields=sol.fields | {field: changed})


def _orders(system: RandomSystem, sols: list, order: int, exact: dict) -> Iterator[str]:
    """Quantities whose errors do not fall as they should."""
    for field in ("q", "p", "work", "multipliers"):
        if field not in sols[0].fields or not np.size(exact[field]):
            continue
        errors = [_error(system, field, sol, exact[field], 2**i) for i, sol in enumerate(sols)]
        wanted = 1 if field == "multipliers" else order  # of impulses, compared with forces at nodes
        if (
            errors[2] > FLOOR
            and np.log2(errors[1] / errors[2]) < wanted - SLACK
            and errors[2] > errors[0] * 2.0 ** (-2 * wanted + 1)
        ):
            yield f"{field} has errors {', '.join(f'{e:.2g}' for e in errors)}, order {wanted} expected"


def _error(system: RandomSystem, field: str, sol, exact: np.ndarray, every: int) -> float:
    values = np.asarray(sol.fields[field])
    if field != "multipliers":
        return float(np.max(np.abs(values[::every] - exact)))
    rows = np.arange(every, len(values), every)
    impulse = sol.step if sol.field_info[field].rule == "sum" else 1.0
    independent, all_rows = map(np.asarray, rows_of(system)(np.asarray(sol.t)[rows], np.asarray(sol.q)[rows], sol.params))
    force = np.einsum("tmn,tm->tn", all_rows, values[rows] / impulse)  # whichever of them follow from others
    wanted = np.einsum("tmn,tm->tn", independent, exact[rows // every])
    return float(np.max(np.abs(np.abs(force) - np.abs(wanted))))


def _restart(sol, run) -> list[str]:
    """A run that goes on from a saved row is the run."""
    middle = sol.rows // 2
    given = {"q": np.asarray(sol.q)[middle], "v": None, "p": np.asarray(sol.p)[middle], "t0": float(sol.t[middle])}
    other = run(sol.step, sol.rows - 1 - middle, **given, check_initial=False)
    apart = np.max(np.abs(np.asarray(other.q)[-1] - np.asarray(sol.q)[-1]))
    return [] if apart < 1e-10 else [f"restart: q is off by {apart:.2g} at the end"]


def _batch(sol, run, start: dict) -> list[str]:
    """A trajectory of a batch is that trajectory alone."""
    several = {name: np.stack([a, a, a * 1.0]) for name, a in start.items()}
    batch = run(sol.step, sol.rows - 1, **several)
    wrong = [n for n, a in sol.fields.items() if not np.allclose(np.asarray(batch.fields[n])[1], a, rtol=1e-11, atol=1e-12)]
    return [f"batch: {', '.join(wrong)} differ"] if wrong else []


def _engines(sol, run) -> list[str]:
    other = run(sol.step, sol.rows - 1, engine="xla")
    wrong = [n for n, a in sol.fields.items() if not np.allclose(np.asarray(other.fields[n]), a, rtol=1e-9, atol=1e-10)]
    return [f"engines: {', '.join(wrong)} differ"] if wrong else []


def _gradient(run, params: dict) -> list[str]:
    """The derivative of the end by the masses, by differences too."""
    end = lambda mass: jnp.sum(run(STEP, STEPS, params=params | {"mass": mass}).q[-1])
    mass, h = jnp.asarray(params["mass"]), 1e-5
    found = np.asarray(jax.grad(end)(mass))
    steps = np.eye(len(mass)) * h
    by_hand = np.array([float(end(np.asarray(mass) + d) - end(np.asarray(mass) - d)) / (2 * h) for d in steps])
    off = np.max(np.abs(found - by_hand))
    return [] if off < 1e-7 else [f"gradient: off by {off:.2g} from differences"]


KINDS: dict[Kind, RandomSystem] = {}


def random_case(seed: int, kinds: int = 12) -> tuple[RandomSystem, dict, dict]:
    """A system by number: one of so many kinds, whose compiled code serves all systems of it."""
    kind = Kind.drawn(np.random.default_rng(seed % kinds))
    system = KINDS.setdefault(kind, RandomSystem(kind))
    return system, *system.parameters(np.random.default_rng([1, seed]))
