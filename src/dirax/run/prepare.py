"""prepare(): a run that is said once, and carried out again with other numbers in microseconds."""

import time
from typing import Any

from dirax.engines.engine import AbstractEngine
from dirax.run.carry_out import Kind, carried_out, prepared
from dirax.run.settings import Settings, kind_of, stated
from dirax.run.validate import KINDS, Case, batch_size, count, finite, initial_data, params_of_case, positive
from dirax.schemes.step import AbstractScheme
from dirax.solution.solution import Solution
from dirax.systems.system import AbstractSystem

NUMBERS = frozenset().union(*KINDS)
"""The names of initial data."""


class PreparedRun:
    """What `dx.prepare` returns: called with other initial data, `params`, `step`, `steps`, `save_every`, `t0` or `progress`,
    each as it was prepared where it is not given, it returns the Solution that `dx.simulate` returns, bit by bit.

    All premises are checked as they are there. Initial data of another kind or shape, and params of another structure, may be
    given too; the first such call takes as long as a first `dx.simulate`.
    """

    def __init__(self, settings: Settings, case: Case, steps: int, save_every: int, kind: Kind | None):
        self._settings, self._case, self._steps, self._save_every, self._kind = settings, case, steps, save_every, kind
        self._of_kind = kind and kind_of(case)

    def __call__(
        self,
        *,
        step: Any = None,
        steps: Any = None,
        save_every: Any = None,
        t0: Any = None,
        progress: Any = False,
        **given: Any,
    ) -> Solution:
        """The Solution of the run with these numbers. Raises as `dx.simulate`."""
        entered = time.perf_counter()
        base = self._case
        data, params, batch = base.data, base.params, base.batch
        new_params = "params" in given
        if new_params:
            params = params_of_case(given.pop("params"))
        if given:
            if unknown := next((name for name in given if name not in NUMBERS), None):
                raise TypeError(
                    f"a prepared run takes initial data, params, step, steps, save_every, t0 and progress, but {unknown}= was "
                    "given: prepare another one."
                )
            kept = {name: a for name, a in data.items() if name not in given} if data.keys() >= given.keys() else {}
            data, batch = initial_data({name: given.get(name, kept.get(name)) for name in (*given, *kept)})
            data = {name: data[name] for name in base.data} if data.keys() == base.data.keys() else data
        if given or new_params:
            batch = batch_size(batch, params, base.batch_params)
        case = Case(
            data,
            params,
            base.h if step is None else positive(step, "step"),
            base.t0 if t0 is None else finite(t0, "t0"),
            batch,
            base.batch_params,
        )
        return carried_out(
            self._settings,
            case,
            self._steps if steps is None else count(steps, "steps"),
            self._save_every if save_every is None else count(save_every, "save_every"),
            progress,
            self._kind if self._kind is not None and case.plain and kind_of(case) == self._of_kind else None,
            entered,
        )

    def __repr__(self) -> str:
        return f"PreparedRun({self._settings.scheme!r} on {self._settings.system!r}, {self._steps} steps of {self._case.h})"


def prepare(
    system: AbstractSystem,
    scheme: AbstractScheme,
    *,
    step: float,
    steps: int,
    q: Any = None,
    v: Any = None,
    p: Any = None,
    q0: Any = None,
    q1: Any = None,
    x: Any = None,
    inputs: Any = None,
    params: Any = None,
    batch_params: bool = False,
    save_every: int = 1,
    engine: str | AbstractEngine = "auto",
    project: bool = False,
    check_initial: bool = True,
    t0: float = 0.0,
    max_iterations: int = 50,
    compensated: bool = False,
) -> PreparedRun:
    """A run with everything found and compiled that its numbers do not change: the arguments are those of `dx.simulate`.

        run = dx.prepare(system, scheme, q=[0.3, 0.1], v=[0.2, 0.3], step=0.1, steps=100)
        solutions = [run(q=[0.3, 0.1 * k]) for k in range(1000)]  # some 50 µs each, and the steps

    Raises as `dx.simulate`, for data that a premise excludes too.
    """
    settings, case, steps, save_every = stated(
        system, scheme, step, steps, {"q": q, "v": v, "p": p, "q0": q0, "q1": q1, "x": x}, inputs, params, batch_params,
        save_every, engine, project, check_initial, t0, max_iterations, compensated,
    )  # fmt: skip
    return PreparedRun(settings, case, steps, save_every, prepared(settings, case, steps, save_every))
