"""Events of a run whose values JAX traces, their times differentiated."""

from typing import Any

import jax
import jax.numpy as jnp

from dirax.program.memo import Same, by_value
from dirax.run.event import Event, refuse_unknown
from dirax.run.event_on_host import EventsOnHost
from dirax.run.event_places import EventPlace
from dirax.run.impact_traced import bracketed_fall
from dirax.solution.dense_traced import TracedDense
from dirax.solution.events import Events
from dirax.solution.solution import Solution
from dirax.solution.steps_again import Keyed, compiled_call


def with_traced_events(sol: Solution, events: tuple[Event, ...], points: int, closed: bool) -> Solution:
    """The solution of a traced run, of which every row is saved, with its events: as many as there are such points in all of its
    steps may be there, NaN where there is none. After a terminal event rows and events are NaN. `closed`: whether their functions
    close over values that JAX traces."""
    dense, lanes, h = TracedDense(sol), sol.batch or 1, jnp.asarray(sol.step, float)
    for number, event in enumerate(events):
        refuse_unknown(event, number, dense.nodes)
    lead = lambda a: jnp.asarray(a) if sol.batch is not None else jnp.asarray(a)[None]
    nodes = {name: lead(a) for name, a in dense.nodes.items()}
    steps = {name: lead(a) for name, a in sol.fields.items() if name not in nodes}
    own = sol.batch_params and sol.batch is not None
    params = jax.tree.map(
        lambda a: jnp.asarray(a) if own else jnp.broadcast_to(jnp.asarray(a), (lanes, *jnp.shape(a))), sol.params
    )
    given = nodes, steps, params, jnp.asarray(sol.axis[0], float), h
    same = Same(dense.equation), by_value(sol.system), *events, points, jax.tree.structure(given)
    on_host = None if closed else EventsOnHost(dense, events, points)
    found = None if on_host is None else compiled_call(Keyed(on_host, "on host", *same), *given)
    if found is None:
        found = compiled_call(Keyed(TracedSearch(dense, events, points), "by JAX", *same), *given)
    (t, index, direction, fields), endings = found
    whole = lambda a: a.reshape(-1, *a.shape[2:])
    known = {name: whole(a) for name, a in fields.items()}
    events_of = Events(whole(t), whole(index), whole(direction), jnp.repeat(jnp.arange(lanes), t.shape[1]), known)
    sol = _ended(sol, endings[:, None]) if any(event.terminal for event in events) else sol
    sol.events = events_of
    return sol


def _ended(sol: Solution, endings: Any) -> Solution:
    """The solution with NaN in the rows after these times (B, 1)."""
    t, fields = jnp.broadcast_to(jnp.asarray(sol.t), (sol.batch or 1, sol.rows)), {}
    for name, values in sol.fields.items():
        after = (t if sol.field_info[name].place == "node" else t[:, 1:]) > endings
        after = after if sol.batch is not None else after[0]
        fields[name] = jnp.where(after.reshape(*after.shape, *(1,) * (values.ndim - after.ndim)), jnp.nan, values)
    return sol.replace(fields=fields)


class TracedSearch:
    """The same by JAX alone: one event may be in each of so many parts of every step, and is seen by the sign of its function."""

    def __init__(self, dense: TracedDense, events: tuple[Event, ...], points: int):
        self.dense, self.events, self.points = dense, events, points

    def __call__(self, nodes: dict, steps: dict, params: Any, t0: Any, h: Any) -> tuple:
        """What `EventsOnHost` returns."""
        lanes = len(next(iter(nodes.values())))
        times = t0 + jnp.arange(len(next(iter(nodes.values()))[0]) - 1.0) * h

        def lane(own):
            nodes, steps, params = own
            rows, after = ({name: a[i : len(a) - 1 + i] for name, a in nodes.items()} for i in (0, 1))
            return jax.lax.map(lambda step: self.of_step((*step, h, params)), (rows, after, steps, times))

        found = jax.lax.map(lane, (nodes, steps, params))
        t, index, direction, fields = jax.tree.map(lambda a: a.reshape(lanes, -1, *a.shape[4:]), found)
        order = jnp.argsort(jax.lax.stop_gradient(t), axis=1)  # NaN is last
        pick = lambda a: jnp.take_along_axis(a, order.reshape(*order.shape, *(1,) * (a.ndim - 2)), axis=1)
        t, index, direction, fields = jax.tree.map(pick, (t, index, direction, fields))
        ends = jnp.isin(index, jnp.array([i for i, event in enumerate(self.events) if event.terminal], float))
        endings = jnp.min(jnp.where(ends, jax.lax.stop_gradient(t), jnp.inf), axis=1)
        kept = lambda a: jnp.where((t <= endings[:, None]).reshape(*t.shape, *(1,) * (a.ndim - 2)), a, jnp.nan)
        return jax.tree.map(kept, (t, index, direction, fields)), endings

    def of_step(self, step: tuple) -> tuple:
        """(times, index, direction, fields) of what is found in a step (its rows, the fields of steps, t, h, params): (events,
        points, …), NaN where there is nothing."""
        whole = step, self.dense.solved(*step)
        found = [self._of_event(EventPlace(self.dense, event, number), whole) for number, event in enumerate(self.events)]
        return jax.tree.map(lambda *parts: jnp.stack(parts), *found)

    def _of_event(self, place: EventPlace, whole: tuple) -> tuple:
        places, direction = jnp.arange(self.points + 1) / self.points, place.event.direction
        values = place.along(*jax.lax.stop_gradient(whole))
        g = jax.lax.map(values, places)
        a, b = g[:-1], g[1:]
        rises, falls = (a < 0.0) & (b >= 0.0), (a > 0.0) & (b <= 0.0)
        asked = (rises & (direction >= 0)) | (falls & (direction <= 0))

        def one(part):
            low, high, a, b, is_found = part
            sign = jnp.where(a < 0.0, -1.0, 1.0)

            def located():
                root = bracketed_fall(lambda x: sign * values(x), low, sign * a, high, sign * b)
                t, known = place.located(root, *whole)
                return t, jnp.asarray(float(place.number)), -sign, known

            nothing = jax.tree.map(lambda s: jnp.full(s.shape, jnp.nan), jax.eval_shape(located))
            return jax.lax.cond(is_found, located, lambda: nothing)

        return jax.lax.map(one, (places[:-1], places[1:], a, b, asked))
