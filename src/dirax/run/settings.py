"""What is said of a run: Settings besides its numbers, and the Case that are its numbers."""

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
from jax.core import Tracer

from dirax.engines.engine import AbstractEngine
from dirax.program.captured import Captured, functions_in
from dirax.program.hoisted import Hoisted
from dirax.program.memo import Memo, Same
from dirax.program.primitives import is_tracing
from dirax.program.user_functions import UserFunction
from dirax.run.event import Event, checked_events
from dirax.run.impact import Impact
from dirax.run.scalars import count, flag
from dirax.run.validate import (
    MOST_ITERATIONS,
    Case,
    check_kinds,
    checked_store,
    engine_from,
    first_time,
    validated_case,
)
from dirax.schemes.step import AbstractScheme
from dirax.systems.system import AbstractSystem

X64 = "jax_enable_x64"
"""JAX's option for 64-bit floats, which dirax turns on."""


_reads: Memo[list[tuple[str, Captured]]] = Memo(256)


@dataclass(frozen=True)
class Settings:
    """What is run and how; `system` is with its inputs, and `engine` is one."""

    system: AbstractSystem
    scheme: AbstractScheme
    engine: AbstractEngine
    project: bool
    check_initial: bool
    max_iterations: int
    compensated: bool
    events: tuple = ()
    to: Path | None = None
    """The store that the rows go to."""

    @cached_property
    def reads(self) -> list[tuple[str, Captured]]:
        """What the functions of this system and scheme, and of these events, read from outside, which may have changed where
        that of others that are equal has not."""
        walls = (event.restitution for event in self.events if isinstance(event, Impact))
        stated = self.system, self.scheme, *self.events, *walls
        return _reads.get(tuple(map(Same, stated)), lambda: list(functions_in(stated)))

    @cached_property
    def key(self) -> tuple:
        """Equal for equal settings: systems and schemes are compared by value, with what is static in them."""
        of_value = (jax.tree.flatten(module) for module in (self.system, self.scheme, self.engine))
        modules = ((structure, *leaves) for leaves, structure in of_value)
        return *modules, self.project, self.check_initial, self.compensated, self.max_iterations


def stated(
    system: Any, scheme: Any, step: Any, steps: Any, data: dict[str, Any], inputs: Any, params: Any, batch_params: bool,
    save_every: Any, engine: Any, project: bool, check_initial: bool, t0: Any, max_iterations: Any, compensated: bool,
    events: Any = (), to: Any = None,
) -> tuple[Settings, Case, int, int]:  # fmt: skip
    """The settings and the case that the arguments of `simulate` state, steps and save_every; raises as it does."""
    check_kinds(system, scheme)
    if not getattr(jax.config, X64):
        raise ValueError(
            "JAX has been set to 32-bit floats since dirax was imported, and structure is kept to the roundoff of 64-bit ones: "
            'say jax.config.update("jax_enable_x64", True).'
        )
    on, steps, save_every = engine_from(engine), count(steps, "steps"), count(save_every, "save_every")
    max_iterations = count(max_iterations, "max_iterations", MOST_ITERATIONS)
    events = checked_events(events, (Event, Impact))
    case = validated_case(data, params, flag(batch_params, "batch_params"), step, t0)
    if (first := first_time(system, case.data, case.t0)) is not case.t0:
        case = replace(case, t0=first)
    system = system if inputs is None else system.with_inputs(inputs)
    path = checked_store(to, events, case.traced)
    given = {"project": project, "check_initial": check_initial, "compensated": compensated}
    flags = {name: flag(value, name) for name, value in given.items()}
    if is_tracing():
        (system, scheme, *events), case = _hoisted((system, scheme, *events), case)
    settings = Settings(system, scheme, on, max_iterations=max_iterations, events=tuple(events), to=path, **flags)
    if params is not None and not events:  # which may take them too
        _warn_of_unused_params(system, scheme)
    return settings, case, steps, save_every


def _hoisted(stated: tuple, case: Case) -> tuple[tuple, Case]:
    """What is stated, and the case, with all that its functions close over and JAX traces in the params; nothing is done where
    something is not of dirax, which may look into the params itself."""
    if not all(is_of_dirax(value) for value in stated):
        return stated, case
    values: list[Tracer] = []
    takes = lambda value: hasattr(value, "hoisted")
    stated = jax.tree.map(lambda value: value.hoisted(values) if takes(value) else value, stated, is_leaf=takes)
    repeated = lambda value: jnp.broadcast_to(value, (case.batch or 1, *jnp.shape(value))) if case.batch_params else value
    return stated, replace(case, params=Hoisted(case.params, tuple(map(repeated, values)))) if values else case


_unused: Memo[str] = Memo(256)
"""The names of the functions where none takes params."""


def is_of_dirax(value: Any) -> bool:
    """Whether what is stated is an object of dirax's own classes."""
    return type(value).__module__.startswith("dirax.")


def _warn_of_unused_params(*stated: Any) -> None:
    """Warn where no function of what is stated takes params, unless something in it is not of dirax and may read them."""
    if names := _unused.get(tuple(map(Same, stated)), lambda: _without_params(stated)):
        warnings.warn(
            f"params were given, but none of the functions ({names}) takes them, so that they change nothing: a function takes "
            "params as its last argument.",
            UserWarning,
            stacklevel=4,
        )


def _without_params(stated: Sequence[Any]) -> str:
    """The names of the functions; none where one takes params or is not known."""
    if not all(map(is_of_dirax, stated)):
        return ""
    is_known = lambda value: isinstance(value, UserFunction)
    functions = [value for value in jax.tree.leaves(stated, is_leaf=is_known) if callable(value)]
    known = [f for f in functions if isinstance(f, UserFunction) and not f.takes_params]
    return ", ".join(dict.fromkeys(f.name for f in known)) if len(known) == len(functions) else ""


def kind_of(case: Case) -> tuple:
    """What a plan for a case depends on: which data are given and their shapes, and the kinds of the params; and the values of
    those params that are no floats, where they are part of the step's program."""
    leaves, structure = jax.tree.flatten(case.params)
    part = lambda leaf: b"" if case.batch_params else leaf.tobytes()
    kinds = tuple([(a.shape,) if a.dtype.char == "d" else (a.shape, a.dtype.char, part(a)) for a in leaves])
    return tuple([(name, a.shape) for name, a in case.data.items()]), structure, kinds, case.batch_params
