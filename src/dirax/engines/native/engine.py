"""The engine "native": what it supports, its run, and the run as a function that JAX differentiates."""

from collections.abc import Callable

from dirax.engines import policy
from dirax.engines.contract import Outcome, Problem, Progress
from dirax.engines.engine import AbstractEngine
from dirax.engines.native.collocation_kernels import collocation_kernels
from dirax.engines.native.kernels import kernels
from dirax.engines.native.run import Ready
from dirax.engines.native.walk import KernelWalk
from dirax.engines.walk import AbstractWalk
from dirax.program.interpreter import UnsupportedPrimitive


class Native(AbstractEngine):
    """Small systems on a CPU: the step traced to scalars, compiled by LLVM, run on vectors of trajectories and several threads.

    `most_operations` bounds the scalar operations of a step, unless XLA would compile it even longer; None: as many as can be
    traced.
    """

    most_operations: int | None = None
    name = "native"

    def supports(self, problem: Problem) -> str | None:
        """None if the step is a scalar program, of so many operations; else the primitive and the line of the user's source, or
        how many operations there are."""
        try:
            if collocation_kernels(problem.equation, problem.params, problem.batch_params) is not None:
                return None
            made = kernels(problem.equation, problem.params, problem.batch_params, problem.compensated)
            if self.most_operations is not None:
                most = max(self.most_operations, int(policy.SCALARS_FOR_ARRAYS * made.step.array_operations))
                written = made.without_corrections + made.step.least_operations
                written = written if written > most else made.written
                if written > most:
                    return f"at least {written} scalar operations to be written out, more than {most}"
        except UnsupportedPrimitive as error:
            return str(error)
        return None

    def run(self, problem: Problem, progress: Progress | None = None) -> Outcome:
        """Run `problem`, saving into NumPy arrays; Ctrl-C and failing steps keep what was computed.

        Raises `UnsupportedPrimitive` for a step that cannot be compiled.
        """
        return self.prepared(problem)(problem, progress)

    def prepared(self, problem: Problem) -> Callable[[Problem, Progress | None], Outcome]:
        """`run` with the kernel at hand."""
        return Ready(problem)

    def walks(self, problem: Problem) -> Callable[[Problem], AbstractWalk]:
        """Walks by a kernel."""
        return KernelWalk

    def run_traced(self, problem: Problem) -> Outcome:
        """The same as one primitive of JAX, with derivatives by loops over the steps; those of the second order and higher are
        those of the run with a tangent, of large steps by the xla engine. Raises `UnsupportedPrimitive` as well."""
        from dirax.engines.native.gradients.differentiate import run_traced  # imported when it is used

        return run_traced(problem)
