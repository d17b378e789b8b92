"""Compiled functions whose static arguments, systems among them, are let go with everything else that dirax keeps."""

import functools
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax

from dirax.program.alarms import without_alarms
from dirax.program.memo import Memo
from dirax.program.primitives import is_tracing

KEPT = 96
"""Functions kept in memory: a run on the xla engine has one, whose executable takes 130 memory maps and four megabytes or more,
of the 65 530 maps that a process may have."""

SELDOM = {
    "xla_cpu_use_fusion_emitters": False, "xla_backend_optimization_level": 0, "xla_disable_hlo_passes": "constant_folding",
}  # fmt: skip
"""With these, code for a CPU takes a fourth of the time to compile, and half as long again to run; and what is made of a large
matrix that functions close over is not found by XLA's interpreter, which takes 15 s for the inverse of one of 800 rows."""

_jitted: Memo[Callable] = Memo(KEPT)


def compiled(function: Callable, seldom: bool = False, **options: Any) -> Callable:
    """`function`, compiled for its arrays; every other leaf of its arguments is static, as in `eqx.filter_jit`. One that is
    called once in a run, and `seldom` alike, is compiled for that.

    The static ones are not handed to `jax.jit(…, **options)`, which would never let go of them, but are closed over.
    """
    own = function, repr(sorted(options.items()))

    @functools.wraps(function)
    def call(*values: Any, **named: Any) -> Any:
        leaves, structure = jax.tree.flatten((values, named))
        moves = tuple(map(eqx.is_array, leaves))
        static = tuple(None if m else leaf for leaf, m in zip(leaves, moves, strict=True))

        quickly = seldom and not is_tracing() and jax.default_backend() == "cpu"

        def jitted() -> Callable:
            @functools.wraps(function)  # whose name XLA gives the module
            def of_arrays(arrays: list[Any]) -> Any:
                rest = iter(arrays)
                values, named = jax.tree.unflatten(
                    structure, [next(rest) if m else s for s, m in zip(static, moves, strict=True)]
                )
                return function(*values, **named)

            how: dict[str, Any] = {"compiler_options": known_options(SELDOM)} if quickly else {}
            return jax.jit(of_arrays, **(options | how))

        kinds = tuple(map(type, static))  # 1, 1.0 and True are equal
        run = _jitted.get((own, structure, moves, static, kinds, quickly), jitted)
        with without_alarms():
            return run([leaf for leaf, m in zip(leaves, moves, strict=True) if m])

    return call


def known_options(options: dict[str, Any]) -> dict[str, Any]:
    """Those of XLA's options that this version of it knows."""
    return {name: value for name, value in options.items() if _is_known(name, value)}


@functools.cache
def _is_known(name: str, value: Any) -> bool:
    try:
        jax.jit(lambda: 0.0, compiler_options={name: value}).lower().compile()
    except jax.errors.JaxRuntimeError:
        return False
    return True
