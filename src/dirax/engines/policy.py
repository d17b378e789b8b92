"""Which engine runs a problem: native for small systems on a CPU, xla for everything."""

from functools import cache
from importlib.util import find_spec
from typing import Any

import jax

from dirax.engines import xla
from dirax.engines.result import Outcome, Problem, Progress
from dirax.program.user_functions import evaluate_on

ENGINES = ("auto", "xla", "native")

LARGEST_NATIVE = 96
"""Unknowns of a stage, or entries of the state, up to which "auto" takes the native engine for steps that are sparse enough."""

LARGEST_FULL = 32
"""The same up to which it takes it for any step."""

MOST_OPERATIONS = 10_000
"""Scalar operations of a step that is sparse enough: a second of compiling, which 20 000 steps get back."""

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
    most = None if problem.size <= LARGEST_FULL else MOST_OPERATIONS
    reason = _too_large(problem, LARGEST_NATIVE) or _other_device() or native.supported(problem, most)
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
    reason = _too_large(problem, LARGEST_FULL) or _other_device()
    if reason is None:
        try:
            return native.run_traced(problem)
        except native.UnsupportedPrimitive as error:
            reason = str(error)
    outcome = xla.run_traced(problem)
    outcome.notes["not_native"] = reason
    return outcome


def _too_large(problem: Problem, largest: int) -> str | None:
    return None if problem.size <= largest else f"{problem.size} numbers a step, more than {largest}"


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
    from dirax.program.evaluation import concrete  # imported when it is used

    return concrete


evaluate_on(_native_host)
