"""verify(): is the structure that a scheme promises really there, in the trajectory that came out?"""

import numpy as np

from dirax.diagnostics.action import stationary_action
from dirax.diagnostics.casimir_lines import casimir_lines
from dirax.diagnostics.constraint_lines import constraint, hidden_constraint
from dirax.diagnostics.energy_lines import energy_line, port_lines
from dirax.diagnostics.final_manifold_lines import final_manifold
from dirax.diagnostics.flights import longest_flight, run_again
from dirax.diagnostics.manifold_lines import points
from dirax.diagnostics.momentum_lines import Symmetries, generators_of, momentum, quotient_momentum
from dirax.diagnostics.premise_line import premise_line
from dirax.diagnostics.reconstruction_line import reconstruction
from dirax.diagnostics.regularity_line import regularity
from dirax.diagnostics.replay_lines import replayed
from dirax.diagnostics.report import OK, VIOLATED, Line, Report
from dirax.diagnostics.residuals import residual_size
from dirax.diagnostics.reversal_line import taken_back
from dirax.diagnostics.structure_lines import membership, structure_of, symplecticity
from dirax.diagnostics.verdicts import of_lane, steps_of
from dirax.engines.stopping import STALLED
from dirax.numerics.one_thread import one_thread
from dirax.program.memo import patience
from dirax.program.user_functions import refuse_traced
from dirax.solution.events import WALLS_WORK
from dirax.solution.reconstruction import reconstruct
from dirax.solution.solution import Solution
from dirax.solution.trajectory import last_rows


@patience()
@one_thread()
@np.errstate(all="ignore")
def verify(sol: Solution, symmetries: Symmetries = None, tolerance: float | None = None) -> Report:
    """Measure the structure of a solution: a `Report` with one line a quantity, each with a tolerance and a verdict.

    `symmetries`: {name: generator(q) -> (n,)}, whose momentum maps ⟨p, ξ_Q(q)⟩ should be conserved, or a list of the
    numbers of cyclic coordinates. `tolerance`: one relative tolerance in place of those below, the energy's apart.

    Measured values are relative to the natural scale of the quantity, so that one rounding is 2⁻⁵³ = ε/2: the sum of the
    absolute values of the terms that should cancel, and of their change when every saved number is changed by itself
    (absolute Jacobian times |q|). The tolerances are roundoff's:

    - steps replayed: every saved number of every row, of any scheme and of compositions, against the step from the row before,
      taken again in NumPy: 32 ε of what it would be off if every operation were; of long runs 10 000 rows, or as many as a few
      tenths of a second are enough for, evenly spread, and the line says so; of rows very many steps apart a few, by the engine
      of the run: 32 ε · steps of what it moves with the state before;
    - points of manifolds and elements of groups, in every row: 32 ε off them, or what the initial data were;
    - discrete Dirac structure of every step ([PY] Proposition 5.17, Theorem 6.8; [BLM] Definition 5.1), saved momenta and
      multipliers against those of the points, constraint: 32 ε, because these hold step by step;
    - steps solved: the largest residual of a run, relative to the terms of its equations, however they cancel, which Newton's
      method brings to their roundoff;
    - final manifold of a singular Lagrangian: 32 ε where a scheme keeps it, and violated where the run starts off it, or jumps
      across it from one solution of the discrete equations to the other; of relations of x with constraints of index 3 or more:
      violated where rows are off what these hide;
    - momentum maps, and of Euler–Poincaré and Lie–Poisson systems the Casimirs and the spatial momentum (where quantities
      are advected, its part that leaves them alone): 32 ε · steps, the most that 32 roundings a step add up to (a random
      walk gives √steps of that);
    - symplecticity of one step (of Euler–Poincaré and Lie–Poisson systems: whether it is a Poisson map), and φ*Ω = Ω + dβ
      where there are constraints ([PY] §3.2): 32 ε · 2n · the condition number of the step's equations, at a few steps, of
      each entry of the form;
    - variable steps: a step and the step back, 32 ε of what it would be off if every operation were;
    - runs with impacts: all rows and impacts by the run once more, with its walls (of one that took longer than 2 s, its first
      part); steps replayed but those that a wall divides, momentum maps over the run, and the energy where no wall
      changes it; all else in the longest flight between two of them;
    - motions that were reconstructed on a group: what is made of the reduced rows, 32 ε of the largest number of a field;
    - systems with ports ([BLM] §7.1): the power balance of every step and, with a discrete gradient, the books over the run,
      H − H(0) less what was supplied plus what was dissipated: 32 ε, however many steps;
    - premise: there, and violated, where J, R, a metric or a Dirac structure is none at one of 64 rows, as is asked where a run
      begins;
    - regular Lagrangian: there, and violated, where a run steps over a place where ∂²L/∂v² is singular, as 512 rows say;
    - energy: "bounded" or "drifts", told apart by windowed means (`dirax.diagnostics.drift`); a drift below
      32 ε · steps · (|E| + |∂E| |row|) is roundoff. The tolerance shown is the drift that could have been told. Violated where
      the energy has a jump between two rows (L or H has one there), which kinks and stiff springs are told from.

    A run on the quotient by an abelian symmetry has the structure of the motion that `dx.reconstruct` gives, and μ besides.
    A batch is judged by its worst trajectory, a failed run by the part that was computed, and what cannot be checked says
    so, and why: membership needs every step saved, a loaded solution its system (`dx.load(path, system=…)`).

    Raises `TypeError` or `ValueError` for something that is not a Solution, for one inside `jax.grad`, `jit` or `vmap`, for
    symmetries that are neither functions of q nor coordinate numbers, and for a `tolerance` that is negative or no number.

        print(dx.verify(sol, symmetries={"rotation": lambda q: jnp.array([-q[1], q[0]])}))
    """
    if not isinstance(sol, Solution):
        raise TypeError(f"sol must be a dirax Solution (from dx.simulate or dx.load), but a {type(sol).__name__} was given.")
    refuse_traced("dx.verify", sol.t, sol.fields, sol.params)
    if tolerance is not None and not 0.0 <= float(tolerance) < np.inf:
        raise ValueError(f"tolerance must be a number that is not negative, but {tolerance!r:.80} was given.")
    generators = generators_of(sol, symmetries)
    flight, impacts = longest_flight(sol)
    whole = (
        flight
        if flight is not sol
        else reconstruct(sol)
        if sol.system is not None and sol.system.quotient_form() is not None
        else sol
    )
    structure = structure_of(whole)
    lines = [
        _completion(sol),
        replayed(sol, tolerance),
        points(sol, tolerance),
        impacts,
        run_again(sol),
        reconstruction(sol, tolerance),
        *membership(whole, structure, tolerance),
        stationary_action(whole, structure, tolerance),
        constraint(whole, structure, tolerance),
        hidden_constraint(whole, tolerance),
        final_manifold(whole, tolerance),
        energy_line(flight if sol.stats.get(WALLS_WORK) else sol),
        *port_lines(sol, tolerance),
        premise_line(sol),
        regularity(sol),
        *(momentum(sol, name, generator, tolerance) for name, generator in generators.items()),
        *quotient_momentum(sol, tolerance),
        *casimir_lines(sol, tolerance),
        symplecticity(whole, tolerance),
        taken_back(sol, tolerance),
    ]
    return Report(_title(sol), tuple(line for line in lines if line is not None))


def _completion(sol: Solution) -> Line:
    ok, messages = np.atleast_1d(sol.ok), np.atleast_1d(sol.message)
    residual = float(np.max(sol.stats["max_residual"])) if "max_residual" in sol.stats else None
    if np.all(ok):
        if broken := _not_numbers(sol):
            return Line("steps solved", residual, None, VIOLATED, broken)
        text = f"every step was solved, up to t = {sol.time_of(-1):.6g}"
        if residual is None or (size := residual_size(sol)) is None:
            return Line("steps solved", residual, None, OK, text)
        text = f"{text}; the largest residual, {residual:.2g}, relative to its terms"
        return Line("steps solved", residual / size, STALLED, OK if residual <= STALLED * size else VIOLATED, text)
    failed = np.flatnonzero(~ok)
    which = f"trajectory {failed[0]}: " if sol.batch is not None else ""
    more = f" (and {len(failed) - 1} more)" if len(failed) > 1 else ""
    return Line("steps solved", residual, None, VIOLATED, f"{which}{messages[failed[0]]}{more}")


def _not_numbers(sol: Solution) -> str:
    """In words, that a saved array of a run without failed steps is not finite somewhere; "" where all are."""
    broken = [name for name, a in sol.fields.items() if isinstance(a, np.ndarray) and not np.all(np.isfinite(a))]
    ended = _ended_by_events(sol) if broken else np.zeros((0, 0), bool)
    for name in broken:
        values = sol.fields[name]
        rows = values.reshape(sol.batch or 1, values.shape[int(sol.batch is not None)], -1)
        missing = ~np.all(np.isfinite(rows), axis=2) & ~ended[:, : rows.shape[1]]
        if np.any(missing):
            lane, row = np.argwhere(missing)[0].tolist()
            where = f"t = {sol.time_of(row, lane):.6g}{of_lane(sol, lane)}"
            return f"every step was solved, but {name} is not finite in a row or more, first at {where}"
    return ""


def _ended_by_events(sol: Solution) -> np.ndarray:
    """The rows (B, rows) of a batch from the end of those on which an event has ended the trajectory: they are NaN from the one
    after it on."""
    ended = np.zeros((sol.batch or 1, sol.rows), bool)
    if sol.batch is None or sol.events is None or not len(sol.events):
        return ended
    lasts = np.maximum(last_rows([np.asarray(sol.fields["q" if "q" in sol.fields else "x"])]), 0)
    for lane in np.unique(sol.events.lane).tolist():
        last, at = int(lasts[lane]), sol.events.t[sol.events.lane == lane]
        if last + 1 < sol.rows and np.any((at >= sol.time_of(last, lane)) & (at <= sol.time_of(last + 1, lane))):
            ended[lane, last:] = True  # of the last good row no step is saved
    return ended


def _title(sol: Solution) -> str:
    scheme, system = (type(part).__name__ if part is not None else "unknown" for part in (sol.scheme, sol.system))
    batch = f", {sol.batch} trajectories" if sol.batch is not None else ""
    return f"{scheme} on {system}: {steps_of(sol)} steps of {float(sol.step):.6g}{batch}"
