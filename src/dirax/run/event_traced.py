"""Events of a run whose values JAX traces: as many in each step as may be seen there, their times differentiated."""

from typing import Any

import jax
import jax.numpy as jnp

from dirax.program.given_tangents import implicit
from dirax.program.memo import Same, by_value
from dirax.run.event import Event, evaluated, refuse_unknown
from dirax.run.impact_traced import bracketed_fall
from dirax.schemes.step import CLOCK
from dirax.solution.dense_traced import TracedDense
from dirax.solution.events import Events
from dirax.solution.solution import Solution
from dirax.solution.steps_again import Keyed, compiled_call


def with_traced_events(sol: Solution, events: tuple[Event, ...], points: int) -> Solution:
    """The solution of a traced run, of which every row is saved, with its events: one may be in each of so many parts of every
    step, and stands for NaN where there is none. After a terminal event rows and events are NaN."""
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
    times = jnp.asarray(sol.axis, float)[:-1]
    search = TracedSearch(dense, events, points)

    def all_of(nodes, steps, params, times, h):
        def lane(own):
            nodes, steps, params = own
            rows, after = ({name: a[i : len(a) - 1 + i] for name, a in nodes.items()} for i in (0, 1))
            return jax.lax.map(lambda step: search.of_step((*step, h, params)), (rows, after, steps, times))

        return jax.lax.map(lane, (nodes, steps, params))

    structure = jax.tree.structure((nodes, steps, params))
    same = Same(dense.equation), by_value(sol.system), *events
    t, index, direction, fields = compiled_call(Keyed(all_of, *same, points, structure), nodes, steps, params, times, h)
    flat = lambda a: a.reshape(lanes, -1, *a.shape[4:])
    t, index, direction, fields = flat(t), flat(index), flat(direction), {name: flat(a) for name, a in fields.items()}
    order = jnp.argsort(jax.lax.stop_gradient(t), axis=1)  # NaN is last
    pick = lambda a: jnp.take_along_axis(a, order.reshape(*order.shape, *(1,) * (a.ndim - 2)), axis=1)
    t, index, direction, fields = pick(t), pick(index), pick(direction), {name: pick(a) for name, a in fields.items()}
    ends = jnp.isin(index, jnp.array([i for i, event in enumerate(events) if event.terminal], float))
    endings = jnp.min(jnp.where(ends, jax.lax.stop_gradient(t), jnp.inf), axis=1, keepdims=True)
    kept = lambda a: jnp.where((t <= endings).reshape(*t.shape, *(1,) * (a.ndim - 2)), a, jnp.nan)
    whole = lambda a: jnp.concatenate(kept(a))
    found = Events(
        whole(t),
        whole(index),
        whole(direction),
        jnp.repeat(jnp.arange(lanes), t.shape[1]),
        {n: whole(a) for n, a in fields.items()},
    )
    sol = _ended(sol, endings) if any(event.terminal for event in events) else sol
    sol.events = found
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
    """Looks for events in one step at a time."""

    def __init__(self, dense: TracedDense, events: tuple[Event, ...], points: int):
        self.dense, self.events, self.points = dense, events, points

    def of_step(self, step: tuple) -> tuple:
        """(times, index, direction, fields) of what is found in a step (its rows, the fields of steps, t, h, params): (events,
        points, …), NaN where there is nothing."""
        whole = step, self.dense.solved(*step)
        fixed = jax.lax.stop_gradient(whole)
        found = [self._of_event(number, event, whole, fixed) for number, event in enumerate(self.events)]
        return jax.tree.map(lambda *parts: jnp.stack(parts), *found)

    def _of_event(self, number: int, event: Event, whole: tuple, fixed: tuple) -> tuple:
        places = jnp.arange(self.points + 1) / self.points
        values = self._along(number, event, fixed)
        g = jax.lax.map(values, places)
        a, b = g[:-1], g[1:]
        rises, falls = (a < 0.0) & (b >= 0.0), (a > 0.0) & (b <= 0.0)
        asked = (rises & (event.direction >= 0)) | (falls & (event.direction <= 0))

        def one(part):
            low, high, a, b, is_found = part
            sign = jnp.where(a < 0.0, -1.0, 1.0)

            def located():
                root = bracketed_fall(lambda x: sign * values(x), low, sign * a, high, sign * b)
                residual = lambda x, whole: self._along(number, event, whole)(x[0])[None]
                theta = implicit(residual, root[None], whole, lambda m, r: r / m[0])[0]
                t, known = self._fields(theta, *whole)
                return t, jnp.asarray(float(number)), -sign, {name: known[name] for name in whole[0][0]}

            nothing = jax.tree.map(lambda s: jnp.full(s.shape, jnp.nan), jax.eval_shape(located))
            return jax.lax.cond(is_found, located, lambda: nothing)

        return jax.lax.map(one, (places[:-1], places[1:], a, b, asked))

    def _fields(self, theta: Any, step: tuple, solved: tuple) -> tuple[Any, dict]:
        begins, length = _clock(step)
        return begins + theta * length, self.dense.inside(solved, *step)(theta)

    def _along(self, number: int, event: Event, whole: tuple) -> Any:
        """θ ↦ the function of an event in a step, of which everything is known that has to be solved."""
        step, solved = whole
        inside, params, (begins, length) = self.dense.inside(solved, *step), step[-1], _clock(step)

        def value(theta):
            time, fields = begins + theta * length, inside(theta)
            if "v" in event.arguments:
                fields = fields | {
                    "v": self.dense.sol.system.complete({"q": fields["q"], "p": fields["p"], "t": time}, params, False)["v"]
                }
            known = {name: fields[name] for name in event.arguments if name in fields} | {"t": time}
            return evaluated(event, number, known, params)

        return value


def _clock(step: tuple) -> tuple[Any, Any]:
    """When a step begins, and how long it lasts."""
    row, after, _, t, h, _ = step
    begins = row.get(CLOCK, t)
    return begins, after[CLOCK] - begins if CLOCK in row else h
