"""Solution: the trajectory that `simulate` returns, with its derived quantities."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dirax.schemes.step import Field


class Solution:
    """A trajectory, or a batch of them, with what is needed to judge it.

    - `t` (rows,); `q`, `p`, `x`: (…, rows, n) where the method has them; `multipliers` (…, rows − 1, m): those of the step
      leaving each row. `fields` holds all saved arrays by name, `field_info` their shapes and meaning.
    - `ok` (bool, or (B,) in a batch) and `message` (str, or a list): whether every step was solved, and otherwise which
      step failed and why. What was computed is kept: one trajectory ends at its last good row, in a batch the rows after
      it are NaN.
    - `stats`: newton_iterations, max_residual, engine, compile_seconds, run_seconds, steps.
    - `system`, `scheme`, `equation`, `step`, `params`, `initial`: what was run; None for a loaded file where it is code.
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
        self.params, self.batch_params = params, batch_params
        self.initial = initial or {}
        self.metadata = metadata or {}
        self._derived = dict(derived or {})

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
        return self._per_row("energy", lambda row, params: self.system.energy_at(row, params))

    def constraint_residual(self):
        """The constraint along the trajectory: the discrete one of each step, (…, rows − 1, m), where the method imposes
        it between two points; else the system's own at each row, (…, rows, m)."""
        if "constraint" in self.fields:
            return self.fields["constraint"]
        return self._per_row("constraint_residual", lambda row, params: self.system.constraint_at(row, params))

    def momentum_map(self, generator):
        """⟨p, ξ_Q(q)⟩ along the trajectory, (…, rows), for the infinitesimal generator `generator(q) -> (n,)`."""
        return self.map_rows(lambda row, params: jnp.vdot(row["p"], generator(row["q"])))

    def map_rows(self, function):
        """`function(row, params)` for every saved row, stacked; `row` is the dict of node fields."""
        nodes = {k: jnp.asarray(a) for k, a in self.fields.items() if self.field_info[k].place == "node"}
        along = jax.vmap(function, in_axes=(0, None))
        if self.batch is not None:
            axis = 0 if self.batch_params and self.params is not None else None
            along = jax.vmap(along, in_axes=(0, axis))
        return jax.jit(along)(nodes, self.params)

    def _per_row(self, name, function):
        if name not in self._derived:
            if self.system is None:
                raise ValueError(
                    f"this solution was loaded without its system, and its file holds no {name}: "
                    "use dx.load(path, system=system)."
                )
            values = self.map_rows(function)
            self._derived[name] = values if isinstance(values, jax.core.Tracer) else np.asarray(values)
        return self._derived[name]
