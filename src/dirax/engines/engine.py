"""AbstractEngine: what runs a problem. One package each beside this module, and one line in `policy.py`."""

from abc import abstractmethod
from collections.abc import Callable
from typing import ClassVar

import equinox as eqx

from dirax.engines.contract import Outcome, Problem, Progress
from dirax.engines.walk import AbstractWalk, WalkByRuns


class AbstractEngine(eqx.Module):
    """Runs problems: solves step after step and saves rows. Its options are its fields.

    `dx.simulate(…, engine=…)` takes an engine, of dirax or of your own, or the name of one. What an engine owes to
    trajectories that fail is said in `dirax/engines/contract.py`, and asked by `tests/engines/test_contract.py`.
    """

    name: ClassVar[str]
    """What `stats["engine"]` says."""

    @abstractmethod
    def supports(self, problem: Problem) -> str | None:
        """None if the engine takes the problem, else why it does not, in words that go on after "because"."""

    @abstractmethod
    def run(self, problem: Problem, progress: Progress | None = None) -> Outcome:
        """Run `problem`, saving into NumPy arrays; Ctrl-C and failing steps keep what was computed.

        `progress` is called now and then. Raises `UnsupportedPrimitive` for a problem that the engine does not support.
        """

    def compiles_start(self, traced: bool) -> bool:
        """Whether the start of a run is compiled by JAX, too, and not found from scalar programs; `traced`: under `jax.grad`,
        `jit` or `vmap`."""
        return False

    def prepared(self, problem: Problem) -> Callable[[Problem, Progress | None], Outcome]:
        """`run` for this problem and for others that differ from it in numbers alone: state, guess, h, t0, floating params, and
        how many steps there are and how many of them are saved. Raises as `run`, at once or when it is called.

        An engine that finds something once for all of them overrides it.
        """
        return self.run

    def walks(self, problem: Problem) -> Callable[[Problem], AbstractWalk]:
        """What makes walks of this problem of one trajectory and one part, and of others that differ from it in numbers alone.
        Raises as `run`, at once or when one of them goes."""
        run = self.prepared(problem)
        return lambda problem: WalkByRuns(problem, run)

    @abstractmethod
    def run_traced(self, problem: Problem) -> Outcome:
        """The same under `jax.grad`, `jit` or `vmap`, with derivatives: arrays of JAX, nothing is known of their values."""
