"""An engine as somebody else would write it: one trajectory after the other, plain Newton, nothing of dirax but its contract."""

import jax
import jax.numpy as jnp
import numpy as np

import dirax as dx
from dirax.engines.contract import NOT_CONVERGED, NOT_FINITE, OK, Outcome, Problem, finished

TINY = 1e-13
"""Relative size of the last update, from where the quadratic convergence of Newton's method has nothing left to do."""


def one_stage(stage, state, guess, t, h, params, most, follow):
    """(unknowns, next state, largest residual, updates, outcome) of a stage, by Newton's method with a new Jacobian each time."""
    stop = jax.lax.stop_gradient
    args = jax.tree.map(stop, (state, t, h, params))
    residual = lambda u: stage.residual(u, *args)

    def update(carry):
        u, _, count = carry
        change = jnp.linalg.solve(jax.jacfwd(residual)(u), residual(u))
        return u - change, jnp.max(jnp.abs(change) / (jnp.abs(u - change) + 1.0)), count + 1

    start = stop(stage.guess(args[0], guess, *args[2:])), jnp.array(jnp.inf), jnp.array(0)
    u, size, updates = jax.lax.while_loop(lambda c: (c[1] > TINY) & (c[2] < most), update, start) if stage.unknowns else start
    new, left = stage.advance(u, *args), residual(u)
    converged = (size <= TINY) | (stage.unknowns == 0)
    outcome = jnp.where(jnp.all(jnp.isfinite(jnp.append(new, left))), jnp.where(converged, OK, NOT_CONVERGED), NOT_FINITE)
    if follow:  # derivatives by the implicit function theorem, of steps that are good
        good = outcome == OK
        args = jax.tree.map(lambda a: jnp.where(good, a, stop(a)), (state, t, h, params))
        inverse = lambda linear, b: jnp.linalg.solve(jax.jacfwd(linear)(b), b)
        u = jax.lax.custom_root(lambda u: stage.residual(u, *args), u, lambda _, u: u, inverse) if stage.unknowns else u
        new = stage.advance(u, *args)
    return u, new, jnp.max(jnp.abs(left), initial=0.0), updates, outcome


made = {}


def compiled(stage, most, follow):
    """`one_stage` of a stage, and its rows, compiled once for all trajectories and runs."""
    key = id(stage), most, follow
    if key not in made:  # with the stage itself, so that no other one has its number
        made[key] = stage, jax.jit(lambda *a: one_stage(stage, *a, most, follow)), jax.jit(stage.unpack)
    return made[key][1:]


class Reference(dx.AbstractEngine):
    """For problems without compensated summation."""

    name = "reference"

    def supports(self, problem: Problem) -> str | None:
        return "it does not compensate sums" if problem.compensated else None

    def run(self, problem, progress=None) -> Outcome:
        return finished(problem, self._lanes(problem, np, progress))

    def run_traced(self, problem) -> Outcome:
        return finished(problem, self._lanes(problem, jnp, None))

    def _lanes(self, p: Problem, xp, progress) -> Outcome:
        one = lambda state, guess, params: self._one(p, state, guess, params, xp is jnp, progress)
        if p.batch is None:
            runs = jax.tree.map(lambda a: a[None], one(p.state, list(p.guess), p.params))
        elif xp is jnp:
            runs = jax.vmap(one, (0, 0, 0 if p.batch_params else None))(p.state, list(p.guess), p.params)
        else:
            pick = lambda tree, lane: jax.tree.map(lambda a: a[lane], tree)
            params = lambda lane: pick(p.params, lane) if p.batch_params else p.params
            lanes = [one(p.state[lane], pick(list(p.guess), lane), params(lane)) for lane in range(p.batch)]
            runs = jax.tree.map(lambda *a: np.stack(a), *lanes)
        fields, closing, numbers, states, unknowns = runs
        completed, status, iterations = (numbers[:, i].astype(int) for i in range(3))
        interrupted = xp is np and bool(np.any((completed < p.steps) & (status == OK)))
        return Outcome(
            fields, closing, completed, status, iterations, numbers[:, 3], states, unknowns, self.name, interrupted=interrupted
        )

    def _one(self, p: Problem, state, guesses, params, follow: bool, progress):
        """The fields, the closing row, (completed, status, updates, worst), the last state and unknowns of one trajectory."""
        first, fraction = p.equation.stages[0]
        stages = [compiled(s, p.max_iterations, follow)[0] for s, _ in p.equation.stages]
        unpack, rows, good = compiled(first, p.max_iterations, follow)[1], {}, jnp.array(True)
        state, guesses, numbers = jnp.asarray(state), [jnp.asarray(g) for g in guesses], jnp.zeros(4)
        for k in range(p.steps + 1):  # the last one for the unknowns of the closing row
            at, t, results = state, p.t0 + (p.first_step + numbers[0]) * p.h, []
            for solve, (_, part), guess in zip(stages, p.equation.stages, guesses, strict=True):
                results.append(solve(at, guess, t, part * p.h, params))
                at, t = results[-1][1], t + part * p.h
            t = p.t0 + (p.first_step + numbers[0]) * p.h
            leaving = jnp.where(jnp.isfinite(results[0][0]), results[0][0], guesses[0])
            closing = unpack(state, leaving, t, fraction * p.h, params)
            if k % p.save_every == 0 or k == p.steps:
                rows[k] = closing
            if k == p.steps or (not follow and not good):
                break
            outcome = next((r[4] for r in results if not follow and r[4] != OK), jnp.max(jnp.stack([r[4] for r in results])))
            before, good = good, good & (outcome == OK)
            state = jnp.where(good, at, state)
            guesses = [jnp.where(good, r[0], g) for r, g in zip(results, guesses, strict=True)]
            worst = jnp.maximum(numbers[3], jnp.max(jnp.stack([r[2] for r in results])))
            updates = jnp.where(before, sum(r[3] for r in results).astype(float), 0.0)
            status = jnp.where(before, outcome.astype(float), numbers[1])
            numbers = jnp.stack(
                [numbers[0] + good.astype(float), status, numbers[2] + updates, jnp.where(good, worst, numbers[3])]
            )
            try:
                if progress:
                    progress(k + 1, p.steps)
            except KeyboardInterrupt:
                at, t = state, p.t0 + (p.first_step + numbers[0]) * p.h
                closing = unpack(state, guesses[0], t, fraction * p.h, params)
                break
        wanted = [min(i * p.save_every, p.steps) for i in range(p.rows)]
        row = lambda name, i: rows.get(wanted[i], closing)[name]
        stacked = {name: jnp.stack([row(name, i) for i in range(p.rows - (not p.is_node(name)))]) for name in p.fields}
        found = stacked, closing, numbers, state, guesses[0]
        return found if follow else jax.tree.map(np.array, found)
