"""From a trajectory on the quotient back to the configuration space."""

import jax
import numpy as np

from dirax.functions import is_traced
from dirax.reduction.reduced import ReducedLagrangeDirac
from dirax.schemes.step import Field
from dirax.solution import Solution


def reconstruct(solution: Solution) -> Solution:
    """The motion (q, p) on T*Q over a reduced solution, as a Solution of the unreduced system ([RL] §4).

    q = (x, g) with g_{k+1} = g_k + ω_d + A(x_{k+1} − x_k), p = (w − h*_{d,Σ}(μ), μ). Raises `TypeError` for a solution
    that is not of a reduced system.
    """
    system = solution.system
    if not isinstance(system, ReducedLagrangeDirac):
        raise TypeError(f"dx.reconstruct takes a solution of a system made by dx.reduce, but this one is of {system!r}.")
    rows = system.unreduced_row
    for _ in range(np.ndim(solution.fields["x"]) - 1):
        rows = jax.vmap(rows)
    lifted = rows({name: solution.fields[name] for name in ("x", "w", "mu", "g")})
    n = lifted["q"].shape[-1]
    return Solution(
        t=solution.t,
        fields={name: np.asarray(a) if not is_traced(a) else a for name, a in lifted.items()},
        field_info={"q": Field((n,)), "p": Field((n,))},
        step=solution.step,
        save_every=solution.save_every,
        stats=solution.stats,
        ok=solution.ok,
        message=solution.message,
        system=system.system,
        scheme=solution.scheme,
        params=solution.params,
        batch_params=solution.batch_params,
        initial=solution.initial,
    )
