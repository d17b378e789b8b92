"""A run with impacts: all its trajectories, and what is refused."""

import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dirax.engines.contract import Outcome, Problem, finished
from dirax.run.event import OutsideIndex, captures_traced, refuse_no_number
from dirax.run.flight import Flight
from dirax.run.flights import Flights, behind
from dirax.run.impact import Impact
from dirax.run.result import solution_of
from dirax.schemes.step import CLOCK, PART, STEP_DENSITY
from dirax.solution.events import WALLS_WORK, Events
from dirax.solution.solution import Solution
from dirax.text.representation import error_text


def fly_all(settings: Any, begun: Any, walls: tuple[Impact, ...], numbers: tuple[int, ...]) -> Solution:
    """The Solution of a problem with impacts, of which every row is saved. Raises `TypeError` and `ValueError`."""
    p, system, started = begun.problem, settings.system, time.perf_counter()
    lanes = p.batch or 1
    one = lambda a, lane: np.asarray(a)[lane] if p.batch is not None else np.asarray(a)
    params = lambda lane: jax.tree.map(lambda leaf: np.asarray(leaf)[lane], p.params) if p.batch_params else p.params
    own = [
        p.with_numbers(
            state=one(p.state, lane),
            guess=tuple(one(g, lane) for g in p.guess),
            params=params(lane),
            batch=None,
            batch_params=False,
        )
        for lane in range(lanes)
    ]
    run, interrupted = settings.engine.prepared(own[0]), False
    flights: list[Flight] = []
    flight_of = Flights(settings.engine, run, system, own[0], walls, numbers)
    made = time.perf_counter()
    for number, lane in enumerate(own):
        flight = flight_of(lane)
        if refused := behind(flight):
            raise ValueError(refused.format(f" of trajectory {number}" if p.batch is not None else ""))
        if interrupted:
            flight.finish()
        else:
            flight.fly()
            interrupted = flight.interrupted
        flights.append(flight)
    done = np.array([flight.done for flight in flights])
    fields = {name: np.stack([flight.rows[name] for flight in flights]) for name in p.fields}
    closing = {name: np.stack([flight.closing[name] for flight in flights]) for name in p.fields}
    for name in filter(p.is_node, closing):
        fields[name] = np.concatenate([fields[name], closing[name][:, None]], axis=1)
    seconds = time.perf_counter() - made
    sample = run(own[0].with_numbers(steps=1, save_every=1), None)
    outcome = Outcome(
        fields=fields,
        closing=closing,
        completed=done,
        status=np.array([flight.status for flight in flights]),
        iterations=np.array([flight.iterations for flight in flights]),
        max_residual=np.array([flight.max_residual for flight in flights]),
        last_state=np.stack([flight.state for flight in flights]),
        last_unknowns=np.stack([flight.unknowns for flight in flights]),
        engine=sample.engine,
        interrupted=interrupted,
        compile_seconds=made - started,
        run_seconds=seconds,
        notes={
            **sample.notes,
            **({"redundant_constraints": list(begun.redundant)} if begun.redundant else {}),
            "impacts": sum(len(flight.hits) for flight in flights),
            WALLS_WORK: any(wall.works for wall in walls),
        },
    )
    said = [flight.message for flight in flights]
    sol = solution_of(system, settings.scheme, begun.case, p, finished(p, outcome), begun.row0, False, said)
    sol.impacts = _events(flights, p)
    return sol


def check_walls(system: Any, p: Problem, walls: tuple[Impact, ...], numbers: tuple[int, ...]) -> bool:
    """Whether a wall closes over values that JAX traces. Raises `TypeError` and `ValueError` for walls that these steps cannot
    bounce off, and functions of them that are none."""
    stages = p.equation.stages
    layout = stages[0][0].state_layout
    if system.lagrangian_form() is None or len(stages) > 1 or not {"q", "p"} <= set(layout):
        held = "composition" if len(stages) > 1 else f"state of {', '.join('x' if name == 'state' else name for name in layout)}"
        raise TypeError(
            "dx.Impact bounces Lagrangian systems in coordinates by schemes of one part whose state holds (q, p), such as "
            "dx.LagrangeDAlembert(), dx.DiscreteDirac() and dx.Collocation(); this is "
            f"{type(system).__name__} with a {held}."
        )
    if p.first_step:
        raise ValueError("a run with dx.Impact starts from q= with v= or p=, not from two points.")
    t, q = jax.ShapeDtypeStruct((), jnp.float64), jax.ShapeDtypeStruct((layout["q"][0],), jnp.float64)
    own = jax.tree.map(lambda leaf: jnp.asarray(leaf)[0], p.params) if p.batch_params else p.params
    traced = False
    for wall, number in zip(walls, numbers, strict=True):
        for what, function in wall.functions.items():
            traced = _seen(f"the {what} of events[{number}]", function, t, q, own) or traced
    return traced


def _seen(what: str, function: Callable, *arguments: Any) -> bool:
    """Whether a function of a wall closes over values that JAX traces. Raises `TypeError` and `ValueError` for one that returns
    no number."""
    try:
        found, traced = captures_traced(what, function, *arguments)
    except OutsideIndex:
        raise
    except Exception as error:
        raise TypeError(f"{what} could not be traced by JAX: {error_text(error)}") from error
    refuse_no_number(what, found)
    return traced


def _events(flights: list[Flight], p: Problem) -> Events:
    hits, layout = [(lane, *hit) for lane, flight in enumerate(flights) for hit in flight.hits], flights[0].search.layout
    n = layout["q"][0]

    def array(i: int, shape: tuple[int, ...] = (), kind: type = float) -> np.ndarray:
        return np.array([hit[i] for hit in hits], kind).reshape(len(hits), *shape)

    fields = {"q": array(3, (n,)), "p": array(4, (n,))}
    if CLOCK in layout:
        fields |= {STEP_DENSITY: array(7), CLOCK: array(8), PART: array(5) % 1.0}
    names = flights[0].others
    sizes = [int(np.prod(p.fields[name].shape)) for name in names]
    parts = np.split(array(6, (sum(sizes),)), np.cumsum(sizes)[:-1], axis=1)
    for name, part in zip(names, parts, strict=False):
        fields[name] = part.reshape(len(hits), *p.fields[name].shape)
    return Events(array(1), array(2, (), int), np.full(len(hits), -1), array(0, (), int), fields)
