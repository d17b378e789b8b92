"""The engine "auto": native for small systems on a CPU, sparse for large ones that are sparse, xla for everything else."""

from collections.abc import Callable

from dirax.engines import policy
from dirax.engines.contract import Outcome, Problem, Progress
from dirax.engines.engine import AbstractEngine
from dirax.engines.step_program import FULL, step_program
from dirax.engines.walk import AbstractWalk, WalkByRuns
from dirax.engines.xla import Xla
from dirax.program.interpreter import UnsupportedPrimitive


class Auto(AbstractEngine):
    """Takes the native engine where that is quicker, by the numbers in `policy.py`; `stats["not_native"]` says why where not, and
    `stats["not_sparse"]` why a large system is not taken as a sparse one."""

    name = "auto"

    def supports(self, problem: Problem) -> str | None:
        """The xla engine takes what the native one does not."""
        return None

    def run(self, problem: Problem, progress: Progress | None = None) -> Outcome:
        """By the native engine or by the xla engine."""
        return self.prepared(problem)(problem, progress)

    def prepared(self, problem: Problem) -> Callable[[Problem, Progress | None], Outcome]:
        """`run` of the engine that takes the problem."""
        native, reason = self._native(problem)
        if native is not None:
            try:
                return native.prepared(problem)
            except UnsupportedPrimitive as error:  # its Jacobian or its elimination has too many operations
                reason = str(error)
        engine, notes = self._by_arrays(problem)

        def by_arrays(problem: Problem, progress: Progress | None = None) -> Outcome:
            outcome = engine.run(problem, progress)
            outcome.notes |= {"not_native": reason, **notes}
            return outcome

        return by_arrays

    def walks(self, problem: Problem) -> Callable[[Problem], AbstractWalk]:
        """By the native engine, or that which `prepared` takes."""
        native, _ = self._native(problem)
        if native is not None:
            try:
                native.prepared(problem)
                return native.walks(problem)
            except UnsupportedPrimitive:
                pass
        run = self.prepared(problem)
        return lambda problem: WalkByRuns(problem, run)

    def _native(self, problem: Problem, traced: bool = False) -> tuple[AbstractEngine | None, str | None]:
        """The native engine, or why it does not take the problem."""
        reason = policy.kept_from_native(problem, traced)
        if reason is None:
            try:
                native = policy.engine_of("native", most_operations=policy.most_operations(problem))
                reason = native.supports(problem)
            except ImportError as error:
                reason = str(error)
            else:
                if reason is None:
                    return native, None
        return None, reason

    def run_traced(self, problem: Problem) -> Outcome:
        """The same."""
        native, reason = self._native(problem, traced=True)
        if native is not None:
            try:
                return native.run_traced(problem)
            except UnsupportedPrimitive as error:
                reason = str(error)
        engine, notes = self._by_arrays(problem)
        outcome = engine.run_traced(problem)
        outcome.notes |= {"not_native": reason, **notes}
        return outcome

    def _by_arrays(self, problem: Problem) -> tuple[AbstractEngine, dict[str, str | None]]:
        """The sparse engine or the xla engine, and why not the former. Raises `ValueError` for dense steps that are too large."""
        if problem.size < policy.FEWEST_SPARSE:
            return Xla(), {}
        unknowns = max(stage.unknowns for stage, _ in problem.equation.stages)
        sparse, reason = _sparse(problem, unknowns)
        if sparse is not None:
            return sparse, {}
        if unknowns > policy.LARGEST_DENSE:
            raise ValueError(
                f"a step of {unknowns} unknowns that is not sparse takes a matrix of {8e-9 * unknowns**2:.3g} GB: {reason}. Take "
                "a scheme whose equations have few unknowns each (mean-value gradients have all; "
                "dx.DiscreteDirac is the midpoint rule), write the system's functions as sums over neighbours, or ask for "
                'engine="xla".'
            )
        return Xla(), {"not_sparse": reason}


def _sparse(problem: Problem, unknowns: int) -> tuple[AbstractEngine | None, str | None]:
    """The sparse engine, or why it does not take the problem."""
    if full := _full(problem, unknowns):
        return None, full
    try:
        sparse = policy.engine_of("sparse", only_quicker=True)
        reason = sparse.supports(problem)
    except ImportError as error:
        return None, str(error)
    return (sparse, None) if reason is None else (None, reason)


def _full(p: Problem, unknowns: int) -> str | None:
    """Why a step of moderate size is not sparse, which its scalar program says at once; None where it does not."""
    if p.size > policy.LARGEST_NATIVE:
        return None
    try:
        full = step_program(p.equation, p.params, p.batch_params).full
    except UnsupportedPrimitive:
        return None
    if 2 * full <= unknowns:
        return None
    return f"{full} equations of {unknowns} need each other's unknowns, in more than one entry of {FULL} of their matrix"
