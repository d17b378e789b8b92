"""Events of a traced run by a call of the host: found as in any other run, and differentiated by scalar programs.

XLA would take seconds to compile the search, and the derivatives of what it finds in every step.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dirax.engines.steps_in_numbers import StepsInNumbers
from dirax.program.memo import Same, by_value
from dirax.program.on_host import called_on_host, on_host
from dirax.run.event import Event
from dirax.run.event_places import EventPlace
from dirax.run.event_search import EventSearch
from dirax.solution.dense import Dense
from dirax.solution.dense_traced import TracedDense
from dirax.solution.divided_steps import AT_ROW
from dirax.solution.solution import Solution


class EventsOnHost:
    """The events of runs of one kind, of each trajectory so many `points` a step and event at most."""

    def __init__(self, dense: TracedDense, events: tuple[Event, ...], points: int):
        self.dense, self.events, self.points = dense, events, points
        self.stages = [stage.unknowns for stage, _ in dense.equation.stages]
        self.solves = 1 if dense.interpolate is not None else 0 if dense.between is not None else 2
        self.width = self.solves * sum(self.stages)

    def __call__(self, nodes: dict, steps: dict, params: Any, t0: Any, h: Any) -> tuple | None:
        """(times, index, direction, fields) of what is found (lanes, most, …), in the order of time and NaN after the last one;
        and when a terminal event ends each trajectory (lanes,), ∞ where none does. Of arrays (lanes, …).

        None where the steps, or what is differentiated, have no scalar program."""
        if StepsInNumbers.found(self.dense.equation, jax.tree.map(lambda a: a[0], params), False) is None:
            return None
        leaves, structure = jax.tree.flatten((nodes, steps, params))
        lanes, rows = next(iter(nodes.values())).shape[:2]
        most = self._most(rows)
        size = lanes * most
        widths = [size, size, size, size, size * self.width, lanes]
        kinds = [(leaf.shape, leaf.dtype) for leaf in leaves]
        find = lambda *flat: self._find(kinds, structure, flat, widths)
        flat = called_on_host(find, widths, *(a.reshape(-1).astype(float) for a in leaves), jnp.stack([t0, h]))
        theta, number, which, direction = flat[:4]
        roots, endings = flat[4].reshape(size, self.width), flat[5]
        number = jnp.where(jnp.isnan(theta), 0.0, number).astype(int)
        lane = jnp.repeat(jnp.arange(lanes), most)
        row, after = ({name: a[lane, number + i] for name, a in nodes.items()} for i in (0, 1))
        step = (
            row, after, {name: a[lane, number] for name, a in steps.items()},
            t0 + number.astype(float) * h, jnp.broadcast_to(h, size), jax.tree.map(lambda a: a[lane], params),
        )  # fmt: skip
        operands, of_step = jax.tree.flatten(step)
        t, fields = jnp.full(size, jnp.nan), {}
        for i, event in enumerate(self.events):
            one = EventPlace(self.dense, event, i)

            def located(theta, roots, *operands, one=one):
                step = jax.tree.unflatten(of_step, operands)
                parts = [self._split(part) for part in jnp.split(roots, self.solves)] if self.solves else None
                return one.located(theta, step, self.dense.solved(*step, roots=parts), parts)

            own = which == i
            key = "event", event, i, Same(self.dense.equation), by_value(self.dense.sol.system), of_step
            found = on_host(located, [jnp.where(own, theta, jnp.nan), roots, *operands], key, fixed=2)
            if found is None:
                return None
            there = lambda a, own=own: own.reshape(-1, *(1,) * (a.ndim - 1))
            t = jnp.where(own, found[0], t)
            fields = {name: jnp.where(there(a), a, fields.get(name, jnp.nan)) for name, a in found[1].items()}
        found = t, which, direction, fields
        return jax.tree.map(lambda a: a.reshape(lanes, most, *a.shape[1:]), found), endings

    def _most(self, rows: int) -> int:
        """Places for events in a trajectory of so many rows."""
        return (rows - 1) * len(self.events) * self.points

    def _split(self, flat: Any) -> tuple:
        """The unknowns of each stage."""
        return tuple(jnp.split(flat, np.cumsum(self.stages)[:-1].tolist()))

    def _find(self, kinds: list[tuple], structure: Any, flat: tuple, widths: list[int]) -> list[np.ndarray]:
        """What the host finds in several such runs, arrays (runs, …) with the numbers of each in one row."""
        many, times = len(flat[-1]), np.asarray(flat[-1])
        results = [np.full((many, width), np.nan) for width in widths]
        results[-1][:] = np.inf
        for t0, h in np.unique(times, axis=0):  # those of equal times are one batch
            own = np.flatnonzero((times == (t0, h)).all(axis=1))
            arrays = [
                np.asarray(a)[own].reshape(-1, *shape[1:]).astype(dtype) for a, (shape, dtype) in zip(flat, kinds, strict=False)
            ]
            if len(own):
                found = self._found(jax.tree.unflatten(structure, arrays), float(t0), float(h))
                for result, a in zip(results, found, strict=True):
                    result[own] = a.reshape(len(own), -1)
        return results

    def _found(self, arrays: tuple, t0: float, h: float) -> list[np.ndarray]:
        """The same of the trajectories of a batch, arrays (B, …)."""
        nodes, steps, params = arrays
        like, (batch, rows) = self.dense.sol, next(iter(nodes.values())).shape[:2]
        most, width = self._most(rows), self.width
        sol = Solution(
            t=t0 + np.arange(rows) * h, fields={**nodes, **steps}, field_info=like.field_info, step=h, save_every=1,
            stats={"engine": like.stats.get("engine")}, system=like.system, scheme=like.scheme, equation=self.dense.equation,
            params=params, batch_params=True,
        )  # fmt: skip
        dense, endings = Dense(sol), np.full(batch, np.inf)
        places, roots = [np.full((batch, most), np.nan) for _ in range(4)], np.full((batch, most, width), np.nan)
        searches = [EventSearch(dense, event, i) for i, event in enumerate(self.events)]
        parts = [search.places(0, int(dense.ends.max())) for search in searches]
        for search in searches:
            if search.event.terminal:
                np.minimum(endings, search.last_known, out=endings)
        lanes, numbers, theta, direction = map(np.concatenate, zip(*parts, strict=True))
        which = np.repeat(np.arange(len(parts)), [len(part.lanes) for part in parts])
        t = dense.time_at(lanes, numbers, theta)
        terminal = np.array([event.terminal for event in self.events])[which]
        np.minimum.at(endings, lanes[terminal], t[terminal])
        order = np.lexsort((t, lanes))
        order = order[t[order] <= endings[lanes[order]]]
        lanes, numbers, theta, direction, which = (a[order] for a in (lanes, numbers, theta, direction, which))
        rank = np.arange(len(lanes)) - np.searchsorted(lanes, lanes)
        own = rank < most
        at = lanes[own], rank[own]
        for place, a in zip(places, (theta, numbers, which, direction), strict=True):
            place[at] = a[own]
        if width and np.any(own):
            roots[at] = self._roots(dense, lanes[own], numbers[own], theta[own])
        return [*places, roots, endings]

    def _roots(self, dense: Dense, lanes: np.ndarray, numbers: np.ndarray, theta: np.ndarray) -> np.ndarray:
        """The unknowns of the steps that are taken for these places."""
        states, u = dense.again.at(lanes, numbers)
        if self.solves == 1:
            return u
        t, part = dense.time_at(lanes, numbers, 0.0), dense.step_to(lanes, numbers, np.maximum(theta, AT_ROW))
        there, first = dense.again.step(lanes, states, u, t, part)
        return np.concatenate([first, dense.again.step(lanes, there, first, t + part, part)[1]], axis=1)
