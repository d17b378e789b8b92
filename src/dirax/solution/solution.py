"""Solution: what `simulate` returns, a trajectory with everything that can be done with it as methods."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from dirax.numerics.arrays import is_whole
from dirax.solution import export, moments, plotting, saving, selection
from dirax.solution.trajectory import Trajectory


class Solution(Trajectory):
    """A trajectory, or a batch of them, with what is needed to judge it.

    - `t` (rows,); `q`, `p`, `x`: (…, rows, n) where the method has them; `multipliers` (…, rows − 1, m): those of the step
      leaving each row. `fields` holds all saved arrays by name, `field_info` their shapes and meaning. Where a constraint
      force jumps at a row, p is the momentum that the scheme's `momentum` names: the one before the force, which (53) of [PY]
      has for p_k, by default for (+) and (−); the one after it, p_k of (54), with `momentum="outgoing"`; or their mean.
    - `ok` (bool, or (B,) in a batch) and `message` (str, or a list): whether every step was solved, and otherwise which
      step failed and why. What was computed is kept: one trajectory ends at its last good row, in a batch the rows after
      it are NaN.
    - `stats`: newton_iterations and max_residual (of a batch the sum and the largest, of `sol[i]` that trajectory's, which files
      do not hold), engine, steps, and where the time of the call went: `validate_seconds` (the
      arguments), `start_seconds` (initial data completed, premises checked, the equation made), `trace_seconds` (the step as a
      scalar program, and what it is compiled from), `compile_seconds` (machine code, from the disk where it is there),
      `run_seconds` (the steps), `result_seconds` (rows put together, failures explained).
    - `system`, `scheme`, `equation`, `step`, `save_every`, `params`, `initial`: what was run; None for a loaded file where
      it is code. `metadata`: names and units ("coordinates", "units") for plots and files. `derived`: computed quantities.
    - `sol[i]` is a trajectory of a batch, `sol[t0:t1]` with floats a stretch of time, `sol[i:j]` with whole numbers several
      trajectories of a batch or rows of one trajectory (`dirax.solution.selection.select`). `len(sol)` is the number of
      trajectories of a batch, of rows of one trajectory; `for one in sol` goes through a batch.
    """

    report: Callable[..., Path]
    """`sol.report(path)`: a page for a browser; `dirax.show`, which stands above this room, puts the method here."""

    animate: Callable[..., Path]
    """`sol.animate(path)`: the motion as .gif, .webp, .mp4 or .html, from `dirax.show` too."""

    def extend(self, steps: int, progress: Any = False) -> "Solution":
        """The solution of the run with `steps` more steps, with the bits of one run: the steps that are done are not repeated,
        except where Ctrl-C has interrupted them. Rows are saved as before; the last row of this solution is one of the longer
        run's if its number is a multiple of `save_every`. A trajectory that has failed stays as it is.

        Raises `ValueError` for a part of a solution, one from a file and one that JAX traces, which do not know how they were
        run.
        """
        if not is_whole(steps) or steps < 1:
            raise ValueError(f"steps must be a whole number ≥ 1, but {steps!r} was given.")
        if self.continuation is None:
            raise ValueError(
                "only what dx.simulate or a prepared run has returned, outside of jax.grad, jit and vmap, knows how to go on: "
                "extend that, before a part of it is taken or it is saved."
            )
        return self.continuation(self, int(steps), progress)

    __getitem__ = selection.select
    __len__ = selection.count
    __iter__ = selection.each

    at = moments.at

    save = saving.save
    to_xarray = export.to_xarray
    to_dataframe = export.to_dataframe
    to_csv = export.to_csv

    plot = plot_trajectory = plotting.plot_trajectory
    plot_coordinate = plotting.plot_coordinate
    plot_energy = plotting.plot_energy
    plot_phase = plotting.plot_phase
    plot_constraint = plotting.plot_constraint
    plot_momenta = plotting.plot_momenta
    plot_section = plotting.plot_section
