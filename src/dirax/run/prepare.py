"""prepare(): a run that is said once, and carried out again with other numbers in microseconds."""

import time
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import jax

from dirax.engines.engine import AbstractEngine
from dirax.program.hoisted import beside
from dirax.run.carry_out import Kind, carried_out, prepared
from dirax.run.params import params_of_case, plain_floats
from dirax.run.scalars import count, finite, positive
from dirax.run.settings import Settings, stated
from dirax.run.validate import KINDS, Case, batch_size, first_time, initial_data
from dirax.schemes.step import AbstractScheme
from dirax.solution.solution import Solution
from dirax.systems.system import AbstractSystem

NUMBERS = frozenset().union(*KINDS)
"""The names of initial data."""


class PreparedRun:
    """What `dx.prepare` returns: called with other initial data, `params`, `step`, `steps`, `save_every`, `t0` or `progress`,
    each as it was prepared where it is not given, it returns the Solution that `dx.simulate` returns, bit by bit.

    All premises are checked as they are there. Initial data of another kind or shape, and params of another structure, may be
    given too; the first such call takes as long as a first `dx.simulate`. It is pickled where the functions of its system are
    those of a module; cloudpickle takes lambdas too.
    """

    def __init__(self, settings: Settings, case: Case, steps: int, save_every: int, kind: Kind | None):
        self._settings, self._case, self._steps, self._save_every, self._kind = settings, case, steps, save_every, kind
        self._leaves, self._structure = jax.tree.flatten(case.params)
        self._has_clock = settings.system.has_clock

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
        base, kind = self._case, self._kind
        data, params = base.data, base.params
        if given:
            data, params = self._alike(given) if kind is not None else (None, None)
        if data is None:
            data, params, kind = *self._other(given), None
        case = Case(
            data,
            params,
            base.h if step is None else positive(step, "step"),
            self._first_time(data, t0),
            base.batch if data is base.data and params is base.params else batch_size(_batch_of(data), params, base.batch_params),
            base.batch_params,
        )
        if type(case.h) is not float or type(case.t0) is not float:  # traced by JAX
            kind = None
        return carried_out(
            self._settings,
            case,
            self._steps if steps is None else count(steps, "steps"),
            self._save_every if save_every is None else count(save_every, "save_every"),
            progress,
            kind,
            entered,
        )

    def _first_time(self, data: Mapping[str, Any], t0: Any) -> Any:
        """That of the prepared run where none is given, but that of the data where they have a clock."""
        if t0 is None and (data is self._case.data or not self._has_clock):
            return self._case.t0
        return first_time(self._settings.system, data, 0.0 if t0 is None else finite(t0, "t0"))

    def _alike(self, given: dict[str, Any]) -> tuple[Any, Any]:
        """Data and params where all that is given is finite floats of the shapes that were prepared; else (None, None)."""
        base = self._case
        data, params = dict(base.data), base.params
        for name, value in given.items():
            if name == "params":
                leaves, structure = jax.tree.flatten(value)
                before = self._leaves
                if structure != self._structure:
                    return None, None
                leaves = [plain_floats(leaf) for leaf in leaves]
                if any([a is None or a.shape != b.shape or b.dtype.char != "d" for a, b in zip(leaves, before, strict=True)]):
                    return None, None
                params = jax.tree.unflatten(structure, leaves)
                continue
            array = plain_floats(value)
            if array is None or name not in data or array.shape != data[name].shape:
                return None, None
            data[name] = array
        return data, params

    def _other(self, given: dict[str, Any]) -> tuple[dict[str, Any], Any]:
        """The same for anything that is given. Raises `TypeError` and `ValueError`."""
        base = self._case
        params = beside(params_of_case(given["params"]), base.params) if "params" in given else base.params
        given = {name: value for name, value in given.items() if name != "params" and value is not None}
        if unknown := next((name for name in given if name not in NUMBERS), None):
            raise TypeError(
                f"a prepared run takes initial data, params, step, steps, save_every, t0 and progress, but {unknown}= was "
                "given: prepare another one."
            )
        if not given:
            return dict(base.data), params
        kept = base.data if base.data.keys() >= given.keys() else {}
        return initial_data({**kept, **given})[0], params

    def __reduce__(self) -> tuple:
        """What is pickled and copied in depth: what the run was made from, without what was found and compiled."""
        return _prepared_again, (replace(self._settings), self._case, self._steps, self._save_every)

    def __repr__(self) -> str:
        return f"PreparedRun({self._settings.scheme!r} on {self._settings.system!r}, {self._steps} steps of {self._case.h})"


def _prepared_again(settings: Settings, case: Case, steps: int, save_every: int) -> PreparedRun:
    return PreparedRun(settings, case, steps, save_every, prepared(settings, case, steps, save_every))


def _batch_of(data: Mapping[str, Any]) -> int | None:
    array = next(iter(data.values()))
    return array.shape[0] if array.ndim == 2 else None


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
    events: Any = (),
) -> PreparedRun:
    """A run with everything found and compiled that its numbers do not change: the arguments are those of `dx.simulate`.

        run = dx.prepare(system, scheme, q=[0.3, 0.1], v=[0.2, 0.3], step=0.1, steps=100)
        solutions = [run(q=[0.3, 0.1 * k]) for k in range(1000)]  # some 50 µs each, and the steps

    Raises as `dx.simulate`, for data that a premise excludes too.
    """
    settings, case, steps, save_every = stated(
        system, scheme, step, steps, {"q": q, "v": v, "p": p, "q0": q0, "q1": q1, "x": x}, inputs, params, batch_params,
        save_every, engine, project, check_initial, t0, max_iterations, compensated, events,
    )  # fmt: skip
    return PreparedRun(settings, case, steps, save_every, prepared(settings, case, steps, save_every))
