"""A symmetric multistep method for q̈ = F(q), stated from outside: one force a step at order 12, for batches.

G. D. Quinlan, S. Tremaine, "Symmetric multistep methods for the numerical integration of planetary orbits", Astron. J. 100, 1990:

    Σ_j α_j q_{n+j} = h² Σ_j β_j F(q_{n+j}),   α_j = α_{k−j},   β_j = β_{k−j},   β_0 = β_k = 0,

explicit and reversible; the zeros of α other than the double one at 1 are simple and of length 1. It is computed for the changes
w_n = q_n − q_{n−1}, which rounds less. Steps are taken several at once, so that the past is moved seldom; the first k − 1 are
those of a one-step method and come in by the parameters. Steps must be short: ωh below about .13 for the largest frequency ω.

    python -m benchmarks.multistep       1024 trajectories of Hénon–Heiles beside heyoka's batch mode; needs heyoka
"""

from itertools import accumulate
from typing import Any

import jax
import jax.numpy as jnp
import mpmath
import numpy as np

import dirax as dx

ALPHA = (1, -2, 2, -1, 0, 0, 0, 0, 0, -1, 2, -2, 1)
AT_ONCE = 11


def exact_on_powers(nodes: list, conditions: list) -> list:
    """The numbers c_j with Σ_j c_j nodes_j^r = conditions_r, r = 0, 1, …"""
    with mpmath.workdps(50):
        matrix = mpmath.matrix([[mpmath.mpf(x) ** r for x in nodes] for r in range(len(nodes))])
        return [float(c) for c in mpmath.lu_solve(matrix, mpmath.matrix(conditions))]


def betas() -> list[float]:
    """β_1, …, β_{k−1}, by which the method is exact on polynomials."""
    k = len(ALPHA) - 1
    powers = [sum(mpmath.mpf(a) * (mpmath.mpf(j) - k // 2) ** (r + 2) for j, a in enumerate(ALPHA)) for r in range(k - 1)]
    return exact_on_powers([j - k // 2 for j in range(1, k)], [s / ((r + 1) * (r + 2)) for r, s in enumerate(powers)])


def slopes() -> list[float]:
    """The γ_j with h q̇_n = w_n + h² Σ_j γ_j F(q_{n−j}), j = 0, …, k − 2."""
    count = len(ALPHA) - 1
    of_change = [mpmath.mpf(-((-1) ** (r + 2))) for r in range(count - 1)]
    return exact_on_powers([-j for j in range(count - 1)], [-c / ((r + 1) * (r + 2)) for r, c in enumerate(of_change)])


class Multistep(dx.AbstractScheme):
    """`AT_ONCE` steps of the method a step; `params` are the positions (k, n) before the first one, the last that of the data."""

    def step_equation(self, system: Any, shape: Any) -> dx.StepEquation:
        n, past = shape.n, len(ALPHA) - 2
        state = dx.Layout(q=n, changes=(past, n), forces=(past, n))
        recurrence, beta, gamma = [-float(a) for a in accumulate(ALPHA)][1:-1], betas(), slopes()

        def force(q):
            return jax.grad(lambda q: system.lagrangian.at(0.0, q, jnp.zeros(n), jnp.zeros((past + 1, n))))(q)

        def start(data, h, params):
            points = jnp.asarray(params)[::-1]
            changes, part = points[:-1] - points[1:], h / AT_ONCE
            return state.join(q=points[0], changes=changes, forces=part**2 * jax.vmap(force)(points[:-1])), jnp.zeros(0)

        def advance(u, x, t, h, params):
            q, changes, forces = state.split(x)
            changes, forces = list(changes), list(forces)
            for _ in range(AT_ONCE):
                # the newest come last, since the others are there before them and need not wait
                older = [*zip(recurrence[1:], changes[1:], strict=True), *zip(beta[1:], forces[1:], strict=True)]
                new = sum(factor * past for factor, past in reversed(older) if factor)
                new = (new + recurrence[0] * changes[0]) + beta[0] * forces[0]
                q, changes = q + new, [new, *changes[:-1]]
                forces = [(h / AT_ONCE) ** 2 * force(q), *forces[:-1]]
            return state.join(q=q, changes=jnp.stack(changes), forces=jnp.stack(forces))

        def unpack(x, u, t, h, params):
            q, changes, forces = state.split(x)
            leap = changes[0] + sum(c * f for c, f in zip(gamma, forces, strict=True))
            return {"q": q, "p": leap * AT_ONCE / h}

        return dx.StepEquation(
            start=start, residual=lambda u, x, t, h, params: jnp.zeros(0), advance=advance, unpack=unpack,
            state_layout=state, unknowns=0, fields={"q": dx.Field((n,)), "p": dx.Field((n,))},
        )  # fmt: skip


def main() -> None:
    """Print a line for every number of steps: the table of docs/speed.md counts what `benchmarks.operations` counts."""
    import time

    from benchmarks.collocation_batch import BATCH, END, SIDE_BY_SIDE, beside_heyoka, taylor
    from benchmarks.operations import REPEATS, counted
    from benchmarks.splitting import FOURTEEN
    from benchmarks.work_precision import henon_heiles

    q, v, solvers, exact = beside_heyoka((1e-7, 1e-9, 1e-12))
    plain, begun = dx.LagrangeDirac(henon_heiles), np.concatenate([q, v], axis=1)
    system = lambda: dx.LagrangeDirac(lambda q, v, params: henon_heiles(q, v))
    first, runs, rows = {}, {}, {}
    for n in (770, 1100, 1210, 1870):
        h, steps = END / n, n // AT_ONCE - 1
        given = {"q": q, "v": v, "step": h}
        first[n] = [dx.prepare(plain, FOURTEEN, steps=k * AT_ONCE, save_every=k, **given) for k in (1, 2)]
        sol = first[n][0]()
        given = {"q": sol.q[:, -1], "p": sol.p[:, -1], "params": np.asarray(sol.q), "batch_params": True, "step": AT_ONCE * h}
        made = lambda k, of, given=given, steps=steps: dx.prepare(of, Multistep(), steps=k * steps, save_every=k * steps, **given)
        one = system()
        runs[n] = [made(k, one) for k in (1, 2)]
        both = counted(lambda made=made: made(1, system())) + counted(lambda h=h: dx.prepare(
            dx.LagrangeDirac(lambda q, v: henon_heiles(q, v)), FOURTEEN, q=q, v=v, step=h, steps=AT_ONCE))  # fmt: skip
        rows[n] = [both / (BATCH // SIDE_BY_SIDE)]

    def seconds(run):
        since = time.process_time()
        run()
        return time.process_time() - since

    least = lambda values: min(values) / BATCH * 1e6
    for _ in range(REPEATS):
        for n in runs:
            once, twice, begin, again = map(seconds, (*runs[n], *first[n]))
            rows[n].append((twice - once + again - begin, once + begin))
        for tolerance, solver in solvers.items():
            rows.setdefault(tolerance, []).append(seconds(lambda solver=solver: taylor(solver, begun)))
    for n, run in runs.items():
        off, (count, *times) = np.max(np.abs(np.asarray(run[0]().q)[:, -1] - exact)), rows[n]
        steps, call = float(np.median([t for t, _ in times])) / BATCH * 1e6, least([c for _, c in times])
        print(f"{n} steps: error {off:.1e}, {count:.3g} vector instructions, {steps:.2f} µs, a call as a whole {call:.2f} µs")
    for tolerance, solver in solvers.items():
        off = np.max(np.abs(taylor(solver, begun)[1][:, :2] - exact))
        print(f"heyoka, tolerance {tolerance:.0e}: error {off:.1e}, {least(rows[tolerance]):.1f} µs")


if __name__ == "__main__":
    main()
