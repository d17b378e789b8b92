"""Trajectory: the numbers of a run or of a batch of runs, and the quantities that its system derives from them."""

import math
from collections.abc import Callable, Hashable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from dirax.engines.lifted import lifted
from dirax.program.compiled import compiled
from dirax.program.evaluation.functions import in_numpy
from dirax.program.hoisted import split
from dirax.program.memo import Same, by_value
from dirax.program.side_by_side import of_one, side_by_side, waits
from dirax.program.stated import as_stated
from dirax.program.user_functions import is_traced
from dirax.schemes.step import CLOCK, Field, Shape, make_step_equation
from dirax.text.representation import counted, fields_html

BESIDE_ROW = 1e-6
"""Part of a step by which a wall may be hit off a row and still at it."""

ROWS_BEFORE = "rows_before"
"""The entry of `stats` that says how many rows of the run a part of it leaves out in front."""

BLOCK = 2**16
"""Rows that a quantity is computed for at a time, which bounds the memory that it takes."""

BLOCK_NUMBERS = 2**22
"""Numbers that such rows hold, at most."""

BY_NUMPY, NUMBERS_BY_NUMPY = 2**18, 2**24
"""Rows, and numbers in them, up to which NumPy is quicker than to compile for them."""

MANY = 2**15
"""Rows of all trajectories from which on machine code is made for their energy."""

GIVEN = (
    *("t", "fields", "field_info", "step", "save_every", "stats", "ok", "message", "system", "scheme", "equation"),
    *("batch_params", "initial", "derived", "metadata"),
)
"""What a Trajectory is made of, besides the params."""

BESIDES = ("example", "events", "impacts", "supplied", "counts")
"""What else is known of one, and of a copy with other values."""

COUNTS = {"newton_iterations": np.sum, "max_residual": np.max}
"""The `stats` that are made of those of each trajectory of a batch, and how."""

Some = TypeVar("Some", bound="Trajectory")


class NotSaved(ValueError):
    """Something was asked of rows that do not hold what it takes."""


class SavedRow(dict):
    """The node fields of one row, its time "t" and `about`, which say so where something is asked of them that was not saved."""

    def __missing__(self, name: str):
        held = ", ".join(key for key in self if key not in ("t", "about"))
        raise NotSaved(f"needs {name}, but the rows hold {held} alone (a scheme saves what its `fields` name)")


@dataclass(frozen=True)
class Momentum:
    """⟨p, ξ_Q(q)⟩ of a row, for the infinitesimal generator ξ_Q; the same for the same generator."""

    generator: Same

    def __call__(self, row: Mapping[str, Any], params: Any) -> Any:
        return jnp.vdot(row["p"], self.generator.object(row["q"]))


class Trajectory:
    """The arrays of a run and what was run: `Solution` says what each is."""

    example: Any = None
    """The example of the gallery that was run, which knows a scene and an exact solution; None for other systems."""

    continuation: Any = None
    """(solution, more steps, progress) ↦ the solution of the longer run; None where it is not known how it was run."""

    events: Any = None
    """What `events=` found, the `Events` of the run; None for a run without."""

    impacts: Any = None
    """Those of the events that are impacts, which divide steps; None for a run without walls."""

    again: Any = None
    """steps ↦ the first so many steps of a run that walls divide, once more from its beginning, with every row; None for other
    runs, and where it is not known how it was run."""

    counts: dict[str, Any] | None = None
    """The `stats` that are sums or maxima over a batch, (B,) of its trajectories; None where these are not known."""

    supplied: bool = False
    """Whether its system was given to `dx.load`, so that it may be another one than that of the run."""

    lifted: Any = None
    """What this one was reconstructed from, a `Lifted`, where the steps of that make no rows of this one; None for others."""

    def __init__(
        self,
        *,
        t: Any,
        fields: dict[str, Any],
        field_info: dict[str, Field],
        step: float,
        save_every: int,
        stats: dict[str, Any],
        ok: Any = True,
        message: Any = "",
        system: Any = None,
        scheme: Any = None,
        equation: Any = None,
        params: Any = None,
        batch_params: bool = False,
        initial: dict[str, Any] | None = None,
        derived: dict[str, Any] | None = None,
        metadata: dict[str, Any] | None = None,
    ):
        self.axis, self.fields, self.field_info = t, fields, field_info
        self.step, self.save_every, self.stats = step, save_every, stats
        self.ok, self.message = ok, message
        self.system, self.scheme, self.equation = system, scheme, equation
        self._params, self.batch_params = params, batch_params
        self.initial = initial or {}
        self.metadata = metadata or {}
        self.derived = dict(derived or {})

    def __getattr__(self, name: str):
        fields = self.__dict__.get("fields", {})
        if name in fields:
            return fields[name]
        if name in ("q", "p", "x", "multipliers"):
            raise AttributeError(f"this solution has no {name!r}; it holds {', '.join(fields)}.")
        raise AttributeError(f"'Solution' object has no attribute {name!r}")

    def __getstate__(self) -> dict[str, Any]:
        """What is pickled and copied in depth: no compiled code, so that nothing is known of how the run goes on."""
        kept = {"axis", "_params", *GIVEN, *BESIDES} - {"t", "equation", "example"}
        return {name: value for name, value in self.__dict__.items() if name in kept}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        none: Any = None
        whole = self.initial and self.system is not None and self.scheme is not None
        self.equation = equation_of(self) if whole else none

    def replace(self: Some, **changes: Any) -> Some:
        """A copy with other values for some of the constructor's arguments."""
        given = {name: getattr(self, name) for name in GIVEN} | {"t": self.axis, "params": self._params}
        copy = type(self)(**(given | changes))
        copy.__dict__ |= {name: getattr(self, name) for name in BESIDES}
        return copy

    @property
    def lacks(self) -> str:
        """What of the run's code a loaded solution is without, as part of a sentence; "" where it has its equation."""
        if self.system is None:
            return "the solution was loaded without its system, which dx.load(path, system=…) takes"
        if self.scheme is None or self.equation is None:
            return "the solution was loaded without its scheme, which dx.load(path, system=…, scheme=…) takes"
        return ""

    @property
    def t(self) -> Any:
        """The times of the rows, (rows,); of a batch whose steps have lengths of their own (B, rows)."""
        return self.fields.get(CLOCK, self.axis)

    @property
    def has_own_times(self) -> bool:
        """Whether steps have lengths of their own, so that rows are not at t0 + k·step."""
        return CLOCK in self.fields

    @property
    def times(self) -> np.ndarray:
        """The times of the rows of every trajectory, (B, rows)."""
        return np.broadcast_to(np.asarray(self.t), (self.batch or 1, self.rows))

    def time_of(self, row: Any, lane: int = 0) -> float:
        """The time of a row of a trajectory."""
        return float(self.times[lane, row])

    @property
    def batch(self) -> int | None:
        """Number of trajectories, None for a single one without a batch axis."""
        name, values = next(iter(self.fields.items()))
        return values.shape[0] if np.ndim(values) == len(self.field_info[name].shape) + 2 else None

    @cached_property
    def params(self) -> Any:
        """The params of a run, as JAX's arrays."""
        with jax.ensure_compile_time_eval():  # asked for first in a trace, they are kept for what comes after it
            return jax.tree.map(lambda leaf: jax.device_put(leaf) if isinstance(leaf, np.ndarray) else leaf, self._params)

    @property
    def params_of_one(self) -> Any:
        """`given_params`, of the first trajectory where they have a batch axis."""
        return jax.tree.map(lambda leaf: leaf[0], self._params) if self.batch_params else self._params

    @property
    def given_params(self) -> Any:
        """The params of a run, NumPy's arrays where they were not traced: nothing is handed to a device."""
        return self._params

    @property
    def rows(self) -> int:
        """Number of saved rows."""
        return len(self.axis)

    @property
    def nbytes(self) -> int:
        """Bytes of the saved arrays, `t` included."""
        return int(self.axis.nbytes + sum(a.nbytes for a in self.fields.values()))

    def energy(self):
        """The energy at every saved row, (…, rows): E = ⟨p, v⟩ − L for Lagrangian systems, H for Hamiltonian ones.

        It is computed from the saved momentum where there is one, with the velocity that belongs to it. Raises
        `ValueError` for a loaded solution saved without it (`dx.load(path, system=…)` supplies the system).
        """
        return self._per_row("energy", "energy_at")

    def constraint_residual(self):
        """The constraint along the trajectory: the discrete one of each step, (…, rows − 1, m), where the method imposes
        it between two points; else the system's own at each row, (…, rows, m). Raises as `energy` does."""
        if "constraint" in self.fields:
            return self.fields["constraint"]
        return self._per_row("constraint_residual", "constraint_at")

    def momentum_map(self, generator: Callable):
        """⟨p, ξ_Q(q)⟩ along the trajectory, (…, rows), for the infinitesimal generator `generator(q) -> (n,)`. Raises `TypeError`
        for what is no function, `ValueError` for one that returns another shape."""
        if not callable(generator):
            raise TypeError(f"generator must be a function q ↦ ξ(q), an array (n,), but {generator!r:.80} was given.")
        q = jax.ShapeDtypeStruct(self.field_info["q"].shape, jnp.float64)
        if (came := jax.eval_shape(lambda q: jnp.asarray(generator(q)), q).shape) != q.shape:
            raise ValueError(f"generator must return an array of shape {q.shape}, as q has, but it returned shape {came}.")
        momentum = Momentum(Same(as_stated(generator).function))
        values = self._without_compiling(momentum, momentum)
        return self.map_rows(momentum) if values is None else values

    @property
    def divided(self) -> np.ndarray:
        """Between which rows and the next ones walls are hit, (B, rows − 1); at a row, on both sides of it."""
        found = np.zeros((self.batch or 1, max(self.rows - 1, 0)), bool)
        if self.impacts is None or is_traced(self.impacts.t):
            return found
        lanes, times, near = self.impacts.lane, self.impacts.t, BESIDE_ROW * self.step
        for lane in np.unique(lanes):
            for t in (times[lanes == lane] - near, times[lanes == lane] + near):
                found[lane, np.clip(np.searchsorted(self.times[lane], t, side="right") - 1, 0, self.rows - 2)] = True
        return found

    @property
    def row_fields(self) -> dict[str, Any]:
        """What a function of a row is given, (…, rows, …): the fields of nodes, the time "t", and `about`, near which the system
        searches for the velocity or the parameters of the row."""
        return self._row_fields(0, self.rows)

    def _row_fields(self, first: int, stop: int) -> dict[str, Any]:
        """The same of the rows from `first` to before `stop`."""
        lead = (slice(None),) * (self.batch is not None)
        low, high = max(0, first - 1), min(self.rows, stop + 1)  # with their neighbours
        taken = lambda a, first, stop: a if (first, stop) == (0, self.rows) else a[(*lead, slice(first, stop))]
        nodes = {k: taken(a, first, stop) for k, a in self.fields.items() if self.field_info[k].place == "node"}
        xp = jnp if is_traced(self.t) else np
        times = xp.broadcast_to(self.t, (self.rows,) if self.batch is None else (self.batch, self.rows))
        nodes["t"] = taken(times, first, stop)
        names = () if self.system is None else self.system.searches_near
        if not names or self.rows < 2 or not self.fields.keys() >= set(names):
            return nodes
        axis, lengths = len(lead), xp.diff(taken(times, low, high), axis=-1)[..., None]
        near = []
        for name in names:
            field = self.fields[name]
            of_steps = taken(field, low, high) if name in nodes else field[(*lead, slice(low, high - 1))]
            of_steps = of_steps.reshape(*np.shape(of_steps)[: axis + 1], -1)
            if name in nodes:
                of_steps = (jnp if is_traced(of_steps) else np).diff(of_steps, axis=axis) / lengths
                if self.impacts is not None:  # between such rows no velocity is a mean one
                    divided = self.divided[:, low : high - 1].reshape(*of_steps.shape[:-1], 1)
                    of_steps = (jnp if is_traced(of_steps) else np).where(divided, np.nan, of_steps)
            near.append(_at_nodes(of_steps, axis)[(*lead, slice(first - low, stop - low))])
        return nodes | {"about": (jnp if is_traced(near) else np).concatenate(near, axis=-1)}

    def map_rows(self, function: Callable):
        """`function(row, params)` for every saved row, stacked; `row` is the dict of node fields of one trajectory and of
        the time `t`."""
        batched = self.batch is not None
        axes = (0, 0 if self.batch_params and self.params is not None else None) if batched else None
        size = self.rows if is_traced(self.t, self.fields, self.step, self.params) else self.rows_at_a_time
        if size >= self.rows:
            return _along(function, {k: jnp.asarray(a) for k, a in self.row_fields.items()}, self.params, axes)
        blocks, lead = [], (slice(None),) * batched
        for begin in range(0, self.rows, size):
            first = min(begin, self.rows - size)  # full blocks only: one compilation
            block = {k: jnp.asarray(a) for k, a in self._row_fields(first, first + size).items()}
            found, new = _along(function, block, self.params, axes), (*lead, slice(begin - first, None))
            blocks.append(jax.tree.map(lambda a, new=new: np.asarray(a)[new], found))
        return jax.tree.map(lambda *parts: np.concatenate(parts, axis=int(batched)), *blocks)

    @property
    def rows_at_a_time(self) -> int:
        """Rows that a quantity is computed for at a time."""
        return max(1, min(BLOCK, BLOCK_NUMBERS // self._width) // (self.batch or 1))

    @property
    def _width(self) -> int:
        """Numbers of a row of one trajectory."""
        return 1 + sum(math.prod(info.shape) for info in self.field_info.values() if info.place == "node")

    def refuse_traced(self, what: str) -> None:
        """Raise `ValueError` inside of `jax.grad`, `jit` or `vmap`, where there are no numbers to do `what` with."""
        if is_traced(self.t, self.fields, self.step, self.params, self.stats):
            raise ValueError(
                f"this solution holds traced values, not numbers: {what} outside of jax.grad, jit and vmap, or return its arrays "
                "from the transformed function."
            )

    def _per_row(self, name: str, method: str):
        if name not in self.derived:
            if self.system is None:
                raise ValueError(
                    f"this solution was loaded without its system, and its file holds no {name}: "
                    "use dx.load(path, system=system)."
                )
            function = getattr(self.system, method)
            values = self._of_many() if name == "energy" else None
            values = self._without_compiling(function, (by_value(self.system), method)) if values is None else values
            values = self.map_rows(function) if values is None else values
            self.derived[name] = values if is_traced(values) else np.asarray(values)
        return self.derived[name]

    def _of_many(self) -> np.ndarray | None:
        """The energy at every row of a long run by machine code; None for others, and where there is none."""
        in_memory = all(isinstance(values, np.ndarray) for values in self.fields.values())
        if self.rows * (self.batch or 1) <= MANY or not in_memory or is_traced(self._params):
            return None
        from dirax.solution.energy_code import energies_of  # and its compiler, where it is used

        def at_rows(rows: list[int]) -> np.ndarray | None:
            lead = (slice(None),) * (self.batch is not None)
            some = {k: np.asarray(a)[(*lead, rows)] for k, a in self.fields.items() if self.field_info[k].place == "node"}
            few = self.replace(t=np.asarray(self.axis)[rows], fields=some)
            system: Any = self.system
            return few._without_compiling(system.energy_at, (by_value(system), "energy_at"))

        return energies_of(self, at_rows)

    def _without_compiling(self, function: Callable, key: Hashable) -> np.ndarray | None:
        """The array that `function(row, params)` is at every row by its scalar program, which is ready sooner than XLA's; None
        for long trajectories, where XLA is faster, and where there is no such program. Functions with equal keys are equal."""
        leaves, structure = jax.tree.flatten(self._params)
        count = self.batch or 1
        if self.rows * count > BY_NUMPY or self.rows * count * self._width > NUMBERS_BY_NUMPY:
            return None
        nodes = self.row_fields
        if is_traced(nodes, leaves) or not all(map(_is_numeric, leaves)):
            return None
        lead = (self.rows,) if self.batch is None else (self.batch, self.rows)
        rows = {k: np.asarray(a).reshape(self.rows * count, *np.shape(a)[len(lead) :]) for k, a in nodes.items()}
        repeated = lambda leaf: np.repeat(leaf, self.rows, axis=0)
        constant = lambda leaf: np.broadcast_to(leaf, (self.rows * count, *np.shape(leaf)))
        along = [(repeated if self.batch_params else constant)(np.asarray(leaf)) for leaf in leaves]
        program = lambda *values: function(
            SavedRow(zip(rows, values, strict=False)), jax.tree.unflatten(structure, values[len(rows) :])
        )
        values = in_numpy(program, [*rows.values(), *along], (key, tuple(rows), structure))
        return None if values is None else values.reshape(*lead, *values.shape[1:])

    # ------------------------------------------------------------------ how it shows itself

    def _summary(self) -> dict[str, str]:
        text = lambda value, name: repr(value) if value is not None else str(self.metadata.get(name, "unknown"))
        shapes = ", ".join(f"{name}{list(np.shape(values))}" for name, values in self.fields.items())
        about = {"system": text(self.system, "system"), "scheme": text(self.scheme, "scheme")}
        if is_traced(self.t, self.fields, self.step):
            return {**about, "holds": f"{shapes}, traced"}
        every = "every step" if self.save_every == 1 else f"every {counted(self.save_every, 'step')}"
        about["time"] = f"{self.time_of(0):.6g} to {self.time_of(-1):.6g}, step {float(self.step):.6g}, {every} saved"
        about["holds"] = shapes
        if redundant := self.stats.get("redundant_constraints"):
            about["redundant"] = f"constraints {', '.join(map(str, redundant))}, left out because they follow from the others"
        about["ended"] = self._ending()
        if "energy" in self.derived:
            energy = np.asarray(self.derived["energy"])
            change = np.nanmax(np.abs(energy - energy[..., :1]))
            about["energy"] = f"{energy.flat[0]:.9g} at the start, changes by at most {change:.3g}"
        return about

    def _ending(self) -> str:
        if self.batch is None:
            return str(self.message) or "ok" if self.ok else str(self.message)
        failed = np.flatnonzero(~np.asarray(self.ok))
        if not len(failed):
            return f"all {counted(self.batch, 'trajectory', 'trajectories')} ok"
        return f"{len(failed)} of {self.batch} trajectories failed, the first: {self.message[failed[0]]}"

    def __repr__(self) -> str:
        lines = (f"  {name}: {text}".replace("\n", "\n    ") for name, text in self._summary().items())
        return "\n".join(("Solution", *lines))

    def _repr_html_(self) -> str:
        return fields_html("Solution", self._summary())


def _is_numeric(leaf: Any) -> bool:
    return isinstance(leaf, bool | int | float | np.ndarray | np.generic | jax.Array) and np.asarray(leaf).dtype.kind in "fiub"


def _at_nodes(of_steps: Any, axis: int) -> Any:
    """The means of what two steps have at the node between them; what one has where the other has none, and else zero."""
    xp = jnp if is_traced(of_steps) else np
    first, last = (xp.take(of_steps, xp.asarray([i]), axis=axis) for i in (0, -1))
    before, after = xp.concatenate([first, of_steps], axis=axis), xp.concatenate([of_steps, last], axis=axis)
    one = xp.where(xp.isfinite(before), before, xp.where(xp.isfinite(after), after, 0.0))
    return xp.where(xp.isfinite(before) & xp.isfinite(after), 0.5 * (before + after), one)


@compiled
def _along(function, nodes, params, axes):
    """`function` of every row, compiled once per function and shape: a system's bound method is compared by its system."""
    one = lambda row, params: function(SavedRow(row), split(params, function, None)[0])
    waiting = waits(one, of_one(nodes, 1 if axes is None else 2), of_one(params, axes is not None and axes[1] is not None))
    along = side_by_side(one, (0, None), waiting)
    return (along if axes is None else side_by_side(along, axes, waiting))(nodes, params)


def last_rows(nodes: list[np.ndarray]) -> np.ndarray:
    """The last row (B,) that each trajectory reached, −1 where there is none, by the arrays (B, rows, …) of the nodes."""
    reached = [np.isfinite(a).reshape(*a.shape[:2], -1).all(axis=2) for a in nodes]
    return np.max(np.where(np.logical_and.reduce(reached), np.arange(nodes[0].shape[1]), -1), axis=1)


def equation_of(sol: Trajectory) -> Any:
    """The equation of the steps of a run, made anew from its system, scheme and initial data."""
    one = {name: a[0] if a.ndim == 2 else a for name, a in sol.initial.items()}
    redundant = tuple(sol.stats.get("redundant_constraints", ()))
    shape = Shape(*sol.system.sizes(one, sol.params_of_one), redundant=redundant)
    return lifted(make_step_equation(sol.scheme, sol.system, shape), sol.params, sol.batch_params)
