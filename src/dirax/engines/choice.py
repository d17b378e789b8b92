"""Which engine runs a problem: native for small systems on a CPU, xla for everything."""

from functools import cache
from importlib.util import find_spec
from typing import Any

import jax

from dirax.engines import xla
from dirax.engines.result import Outcome, Problem, Progress
from dirax.functions import evaluate_on

ENGINES = ("auto", "xla", "native")

LARGEST_NATIVE = 32
"""Unknowns of a stage, or entries of the state, up to which "auto" takes the native engine."""

PLUGINS = ("jax_plugins", "libtpu")
"""The packages without which JAX has no device but CPUs."""


def run_on(engine: str, problem: Problem, progress: Progress | None = None) -> Outcome:
    """Run `problem` on the named engine; "auto" takes native where it can, and notes why where it cannot.

    Raises `UnsupportedPrimitive` for `engine="native"` and a step that it cannot compile.
    """
    if engine == "xla":
        return xla.run(problem, progress)
    from dirax.engines import native  # the compiler is imported when it is used

    if engine == "native":
        return native.run(problem, progress)
    reason = _too_large(problem) or _other_device() or native.supported(problem)
    if reason is None:
        return native.run(problem, progress)
    outcome = xla.run(problem, progress)
    outcome.notes["not_native"] = reason
    return outcome


def run_traced_on(engine: str, problem: Problem) -> Outcome:
    """The same under `jax.grad`, `jit` or `vmap`: differentiable on every engine."""
    if engine == "xla":
        return xla.run_traced(problem)
    from dirax.engines import native

    if engine == "native":
        return native.run_traced(problem)
    reason = _too_large(problem) or _other_device()
    if reason is None:
        try:
            return native.run_traced(problem)
        except native.UnsupportedPrimitive as error:
            reason = str(error)
    outcome = xla.run_traced(problem)
    outcome.notes["not_native"] = reason
    return outcome


def _too_large(problem: Problem) -> str | None:
    size = max(max(stage.unknowns, stage.state_size) for stage, _ in problem.equation.stages)
    return None if size <= LARGEST_NATIVE else f"{size} numbers a step, more than {LARGEST_NATIVE}"


def _other_device() -> str | None:
    device: Any = getattr(jax.config, "jax_default_device", None)
    # asking JAX starts it, which takes 10 ms
    known = "cpu" if getattr(jax.config, "jax_platforms", None) == "cpu" or not _plugins() else None
    platform = getattr(device, "platform", device) or known or jax.default_backend()
    return None if platform == "cpu" else f"JAX computes on {platform}"


@cache
def _plugins() -> bool:
    return any(map(find_spec, PLUGINS))


def _native_host() -> Any:
    from dirax.engines.native import concrete  # imported when it is used

    return concrete


evaluate_on(_native_host)
