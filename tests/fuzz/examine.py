"""What is asked of a scheme on a random system; `examine` returns what is wrong, in words."""

import itertools
import zlib
from collections.abc import Iterator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import dirax as dx
from dirax.diagnostics.replay_lines import replayed
from fuzz.reference import motion, rows_of
from fuzz.systems import Kind, RandomSystem


class Promise(NamedTuple):
    """A scheme with its order, and that of its multipliers as forces at a place in the step, 0 where it begins, from a row on."""

    scheme: Any
    order: int
    of_multipliers: int = 2
    place: float = 0.0
    first_row: int = 0


LAGRANGE = dx.LagrangeDAlembert()
SCHEMES = {
    "midpoint": Promise(LAGRANGE, 2),
    "trapezoidal": Promise(dx.LagrangeDAlembert("trapezoidal"), 2),
    "plus": Promise(dx.PlusLagrangeDirac(), 1, of_multipliers=1, first_row=1),
    "minus": Promise(dx.MinusLagrangeDirac(), 1, of_multipliers=1, first_row=1),
    "mean minus": Promise(dx.MinusLagrangeDirac(momentum="mean"), 1, of_multipliers=1),
    "Method 1": Promise(dx.DiscreteDirac(), 2, of_multipliers=1, place=0.5),
    "Method 2": Promise(dx.DiscreteDirac(constraints="resolve"), 2, place=0.5),
    "suzuki4": Promise(dx.Composition(LAGRANGE, "suzuki4"), 4, place=0.5),
    "symmetric": Promise(dx.SymmetricComposition(dx.PlusLagrangeDirac()), 2, place=0.5),
    "collocation": Promise(dx.Collocation(2), 4, place=0.5),
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
    promise = SCHEMES[name]
    run = lambda h, steps, **more: dx.simulate(
        system.system, promise.scheme, **({"params": params, "step": h, "steps": steps} | start | more)
    )
    try:
        sols = [run(STEP / 2**i, STEPS * 2**i) for i in range(3)]
    except (TypeError, ValueError) as refused:
        return [f"refused: {refused}"]
    if not all(sol.ok for sol in sols):
        return [f"failed: {next(sol.message for sol in sols if not sol.ok)}"]
    wrong = [f"order: {text}" for text in _orders(system, sols, promise, params, start)]
    if wrong:  # errors of two signs may cancel in long steps
        finer = [sols[2], *(run(STEP / 2**i, STEPS * 2**i) for i in (3, 4))]
        wrong = [f"order: {text}" for text in _orders(system, finer, promise, params, start)]
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


def examine_together(system: RandomSystem, name: str, cases: dict[int, tuple[dict, dict]]) -> dict[int, list[str]]:
    """The same of several systems of a kind, by number, as trajectories of one batch, in which one number is damaged. Where
    something is wrong, or a run does not begin, each is examined alone."""
    alone = lambda numbers: {number: examine(system, name, *cases[number]) for number in numbers}
    promise, (params, start) = SCHEMES[name], jax.tree.map(lambda *leaves: np.stack(leaves), *cases.values())
    run = lambda h, steps, **more: dx.simulate(
        system.system, promise.scheme, **({"params": params, "batch_params": True, "step": h, "steps": steps} | start | more)
    )
    try:
        sols = [run(STEP / 2**i, STEPS * 2**i) for i in range(3)]
    except (TypeError, ValueError):
        return alone(cases)
    if not all(np.all(sol.ok) for sol in sols):
        return alone(cases)
    orders = [any(_orders(system, [sol[i] for sol in sols], promise, *case)) for i, case in enumerate(cases.values())]
    found = {number: [] for number in cases} | alone(number for number, wrong in zip(cases, orders, strict=True) if wrong)
    report, several = dx.verify(sols[1]), list(damaged(sols[1]))
    what, other = several[zlib.crc32(np.asarray(sols[1].q).tobytes()) % len(several)]
    wrong = _restart(sols[1], run)
    wrong += [f"false alarm: {line.quantity}: {line.explanation}" for line in report.lines if line.verdict == "VIOLATED"]
    line, looked_at = report["steps replayed"], "each row" in report["steps replayed"].explanation
    if line.verdict != "ok" or (looked_at and replayed(other, None).verdict != "VIOLATED"):
        wrong.append(f"missed: {what}; {line.explanation}")
    if wrong:
        found = alone(cases)
        first = min(cases)
        found[first] = [*found[first], *(f"{text} (in a batch of {len(cases)})" for text in wrong)]
    return found


def damaged(sol: dx.Solution) -> Iterator[tuple[str, dx.Solution]]:
    """The solution with one number off by a millionth of the largest of its field, for each field."""
    draw = np.random.default_rng(0)
    for field, values in sol.fields.items():
        changed = np.array(values)
        place = tuple(draw.integers(size) for size in changed.shape)
        largest = np.max(np.abs(changed), initial=0.0)
        changed[place] += DAMAGE * (largest if largest > 1e-9 else 1.0)
        yield f"{field}{list(map(int, place))}", sol.replace(fields=sol.fields | {field: changed})


def _orders(system: RandomSystem, sols: list, promise: Promise, params: dict, start: dict) -> Iterator[str]:
    """Quantities whose errors do not fall as they should."""
    t = np.asarray(sols[0].t)
    forces_at = [t[promise.first_row : -1] + promise.place * sol.step for sol in sols]
    times, back = np.unique(np.concatenate([t, *forces_at]), return_inverse=True)
    exact = {name: a[back] for name, a in motion(system, params, start, times).items()}
    at_rows, *at_places = ({name: a[part] for name, a in exact.items()} for part in _parts([t, *forces_at]))
    for field in ("q", "p", "work", "multipliers"):
        if field not in sols[0].fields or not np.size(exact[field]):
            continue
        if field == "multipliers":
            wanted = promise.of_multipliers
            errors = [
                _error_of_forces(system, sol, at, s, 2**i, promise.first_row)
                for i, (sol, at, s) in enumerate(zip(sols, at_places, forces_at, strict=True))
            ]
        else:
            wanted = promise.order
            errors = [
                float(np.max(np.abs(np.asarray(sol.fields[field])[:: 2**i] - at_rows[field]))) for i, sol in enumerate(sols)
            ]
        if (
            errors[2] > FLOOR
            and np.log2(errors[1] / errors[2]) < wanted - SLACK
            and errors[2] > errors[0] * 2.0 ** (-2 * wanted + 1)
        ):
            yield f"{field} has errors {', '.join(f'{e:.2g}' for e in errors)}, order {wanted} expected"


def _parts(arrays: list) -> list[slice]:
    """Where these arrays are in their concatenation."""
    ends = np.cumsum([0, *map(len, arrays)]).tolist()
    return [slice(*pair) for pair in itertools.pairwise(ends)]


def _error_of_forces(system: RandomSystem, sol, exact: dict, t: np.ndarray, every: int, first_row: int) -> float:
    """How far the forces of the constraints in every so many steps are from those of the motion at these times."""
    values = np.asarray(sol.multipliers)[first_row * every :: every]
    impulse = sol.step if sol.field_info["multipliers"].rule == "sum" else 1.0
    independent, all_rows = map(np.asarray, rows_of(system)(t, exact["q"], sol.params))
    force = np.einsum("tmn,tm->tn", all_rows, values / impulse)  # whichever of them follow from others
    wanted = np.einsum("tmn,tm->tn", independent, exact["multipliers"])
    return float(np.max(np.abs(np.abs(force) - np.abs(wanted))))


def _restart(sol, run) -> list[str]:
    """A run that goes on from a saved row is the run."""
    middle = sol.rows // 2
    given = {
        "q": np.asarray(sol.q)[..., middle, :],
        "v": None,
        "p": np.asarray(sol.p)[..., middle, :],
        "t0": float(sol.t[middle]),
    }
    other = run(sol.step, sol.rows - 1 - middle, **given, check_initial=False)
    apart = np.max(np.abs(np.asarray(other.q)[..., -1, :] - np.asarray(sol.q)[..., -1, :]))
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
