"""The engine "sparse": steps on arrays by XLA, their linear equations by sparse elimination."""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax

from dirax.engines.contract import Problem
from dirax.engines.sizes import sizes_of_traced
from dirax.engines.sizes_of_many import sizes_of_many
from dirax.engines.sparse.plan import quicker_plan, sparse_plan
from dirax.engines.xla.engine import Xla
from dirax.engines.xla.lane import Numerics
from dirax.program.interpreter import UnsupportedPrimitive


class Sparse(Xla):
    """Steps of many unknowns each of which depends on few others: a step costs in proportion to their number.

    Which unknowns an equation depends on is found in its functions. `stats` say how the matrix is factored, its bandwidth and
    fill, and how long factors and solutions took and all else, evaluation most of it. With `only_quicker` steps are left to
    others that dense elimination is quicker for.
    """

    only_quicker: bool = False
    name = "sparse"

    def supports(self, problem: Problem) -> str | None:
        """A CPU, and sparse equations."""
        if (platform := jax.default_backend()) != "cpu":
            return f"JAX computes on {platform}"
        found = quicker_plan if self.only_quicker else sparse_plan
        plan = found(problem.equation, problem.params, problem.batch_params)
        return plan if isinstance(plan, str) else None

    def _planned(self, p: Problem) -> tuple[Problem, Numerics, dict[str, Any]]:
        plan = sparse_plan(p.equation, p.params, p.batch_params)
        if isinstance(plan, str):
            raise UnsupportedPrimitive("the step as a whole", f"is not sparse: {plan}", "engine='sparse'")
        notes = plan.stats
        if p.compensated:
            notes["not_compensated"] = "the engine 'sparse' does not know the increments of the step"
        return dataclasses.replace(p, equation=plan.equation), Numerics(sparse=plan.solvers), notes

    def _sizes(self, p: Problem, found: Callable) -> tuple:
        return sizes_of_many(p, traced=found is sizes_of_traced)
