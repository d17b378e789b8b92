"""Solution: the trajectory that `simulate` returns, with its derived quantities."""

import os
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np

from dirax.program.compiled import compiled
from dirax.program.user_functions import is_traced
from dirax.schemes.step import Field
from dirax.text.representation import counted, html_table

if TYPE_CHECKING:
    from pathlib import Path

    from xarray import Dataset

BLOCK = 2**16
"""Rows that a quantity is computed for at a time, which bounds the memory that it takes."""


class Solution:
    """A trajectory, or a batch of them, with what is needed to judge it.

    - `t` (rows,); `q`, `p`, `x`: (…, rows, n) where the method has them; `multipliers` (…, rows − 1, m): those of the step
      leaving each row. `fields` holds all saved arrays by name, `field_info` their shapes and meaning.
    - `ok` (bool, or (B,) in a batch) and `message` (str, or a list): whether every step was solved, and otherwise which
      step failed and why. What was computed is kept: one trajectory ends at its last good row, in a batch the rows after
      it are NaN.
    - `stats`: newton_iterations, max_residual, engine, compile_seconds, run_seconds, steps.
    - `system`, `scheme`, `equation`, `step`, `save_every`, `params`, `initial`: what was run; None for a loaded file where
      it is code. `metadata`: names and units ("coordinates", "units") for plots and files. `derived`: computed quantities.
    """

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
        self.t, self.fields, self.field_info = t, fields, field_info
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

    @property
    def batch(self) -> int | None:
        """Number of trajectories, None for a single one without a batch axis."""
        name, values = next(iter(self.fields.items()))
        return values.shape[0] if np.ndim(values) == len(self.field_info[name].shape) + 2 else None

    @cached_property
    def params(self) -> Any:
        """The params of a run, as JAX's arrays."""
        return jax.tree.map(lambda leaf: jnp.asarray(leaf) if isinstance(leaf, np.ndarray) else leaf, self._params)

    @property
    def params_of_one(self) -> Any:
        """The params of a run, of the first trajectory where they have a batch axis."""
        return jax.tree.map(lambda leaf: leaf[0], self.params) if self.batch_params else self.params

    @property
    def rows(self) -> int:
        """Number of saved rows."""
        return len(self.t)

    @property
    def nbytes(self) -> int:
        """Bytes of the saved arrays, `t` included."""
        return int(self.t.nbytes + sum(np.asarray(a).nbytes for a in self.fields.values()))

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
        """⟨p, ξ_Q(q)⟩ along the trajectory, (…, rows), for the infinitesimal generator `generator(q) -> (n,)`."""
        return self.map_rows(lambda row, params: jnp.vdot(row["p"], generator(row["q"])))

    def map_rows(self, function: Callable):
        """`function(row, params)` for every saved row, stacked; `row` is the dict of node fields of one trajectory and of
        the time `t`."""
        nodes = {k: jnp.asarray(a) for k, a in self.fields.items() if self.field_info[k].place == "node"}
        batched = self.batch is not None
        nodes["t"] = jnp.broadcast_to(jnp.asarray(self.t), (self.batch, self.rows) if batched else (self.rows,))
        axes = (0, 0 if self.batch_params and self.params is not None else None) if batched else None
        if is_traced(nodes, self.params) or self.rows * (self.batch or 1) <= BLOCK:
            return _along(function, nodes, self.params, axes)
        size = max(1, BLOCK // (self.batch or 1))
        blocks = []
        for first in range(0, self.rows, size):
            at = np.minimum(np.arange(first, first + size), self.rows - 1)  # full blocks only: one compilation
            block = {k: jnp.take(a, at, axis=int(batched)) for k, a in nodes.items()}
            blocks.append(jax.tree.map(np.asarray, _along(function, block, self.params, axes)))
        rows = (slice(None),) * batched + (slice(self.rows),)
        return jax.tree.map(lambda *parts: np.concatenate(parts, axis=int(batched))[rows], *blocks)

    def _per_row(self, name: str, method: str):
        if name not in self.derived:
            if self.system is None:
                raise ValueError(
                    f"this solution was loaded without its system, and its file holds no {name}: "
                    "use dx.load(path, system=system)."
                )
            values = self.map_rows(getattr(self.system, method))
            self.derived[name] = values if is_traced(values) else np.asarray(values)
        return self.derived[name]

    # ------------------------------------------------------------------ files and pictures

    def to_xarray(self, units: Mapping[str, Any] | None = None, coordinates: Sequence[str] | None = None) -> "Dataset":
        """The trajectory as an `xarray.Dataset` with named dimensions, units, derived quantities and what was run.

        `units`: {"t": "s", "q": ["m", "rad"], …}, `coordinates`: names; both default to `metadata`. Raises `ValueError`
        for unknown names, wrong lengths, and inside `jax.grad`, `jit` or `vmap`.
        """
        from dirax.solution.dataset import to_dataset

        return to_dataset(self, units, coordinates)

    def save(
        self,
        path: str | os.PathLike,
        overwrite: bool = False,
        units: Mapping[str, Any] | None = None,
        coordinates: Sequence[str] | None = None,
    ) -> "Path":
        """Write the solution to `path`, a zarr store (`.zarr`) or a netCDF file (`.nc`); read it with `dx.load`.

        The file appears complete or not at all. Raises `FileExistsError` unless `overwrite`, `FileNotFoundError` where
        the folder does not exist, `ValueError` for another ending and inside `jax.grad`, `jit` or `vmap`.
        """
        from dirax.solution.storage import save

        return save(self, path, overwrite, units, coordinates)

    def plot(self, *args, **kwargs):
        """The path in the plane of two coordinates: `dirax.solution.plotting.plot_trajectory`."""
        return self.plot_trajectory(*args, **kwargs)

    def plot_trajectory(self, *args, **kwargs):
        """The path in the plane of two coordinates: `dirax.solution.plotting.plot_trajectory`."""
        from dirax.solution.plotting import plot_trajectory

        return plot_trajectory(self, *args, **kwargs)

    def plot_energy(self, *args, **kwargs):
        """Energy and energy error against time: `dirax.solution.plotting.plot_energy`."""
        from dirax.solution.plotting import plot_energy

        return plot_energy(self, *args, **kwargs)

    def plot_phase(self, *args, **kwargs):
        """The path in a phase plane (q_i, p_i): `dirax.solution.plotting.plot_phase`."""
        from dirax.solution.plotting import plot_phase

        return plot_phase(self, *args, **kwargs)

    def plot_constraint(self, *args, **kwargs):
        """The constraint residual against time: `dirax.solution.plotting.plot_constraint`."""
        from dirax.solution.plotting import plot_constraint

        return plot_constraint(self, *args, **kwargs)

    # ------------------------------------------------------------------ how it shows itself

    def _summary(self) -> dict[str, str]:
        text = lambda value, name: repr(value) if value is not None else str(self.metadata.get(name, "unknown"))
        shapes = ", ".join(f"{name}{list(np.shape(values))}" for name, values in self.fields.items())
        about = {"system": text(self.system, "system"), "scheme": text(self.scheme, "scheme")}
        if is_traced(self.t, self.fields, self.step):
            return {**about, "holds": f"{shapes}, traced"}
        every = "every step" if self.save_every == 1 else f"every {counted(self.save_every, 'step')}"
        about["time"] = f"{self.t[0]:.6g} to {self.t[-1]:.6g}, step {float(self.step):.6g}, {every} saved"
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
            return "ok" if self.ok else str(self.message)
        failed = np.flatnonzero(~np.asarray(self.ok))
        if not len(failed):
            return f"all {counted(self.batch, 'trajectory', 'trajectories')} ok"
        return f"{len(failed)} of {self.batch} trajectories failed, the first: {self.message[failed[0]]}"

    def __repr__(self) -> str:
        lines = (f"  {name}: {text}".replace("\n", "\n    ") for name, text in self._summary().items())
        return "\n".join(("Solution", *lines))

    def _repr_html_(self) -> str:
        return html_table("Solution", self._summary())


@compiled
def _along(function, nodes, params, axes):
    """`function` of every row, compiled once per function and shape: a system's bound method is compared by its system."""
    along = jax.vmap(function, in_axes=(0, None))
    return (along if axes is None else jax.vmap(along, in_axes=axes))(nodes, params)
