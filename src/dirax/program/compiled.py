"""Compiled functions whose static arguments, systems among them, are let go with everything else that dirax keeps."""

import functools
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax

from dirax.program.alarms import without_alarms
from dirax.program.memo import Memo

KEPT = 96
"""Functions kept in memory: a run on the xla engine has one, whose executable takes 130 memory maps and four megabytes or more,
of the 65 530 maps that a process may have."""

_jitted: Memo[Callable] = Memo(KEPT)


def compiled(function: Callable, **options: Any) -> Callable:
    """`function`, compiled for its arrays; every other leaf of its arguments is static, as in `eqx.filter_jit`.

    The static ones are not handed to `jax.jit(…, **options)`, which would never let go of them, but are closed over.
    """
    own = function, repr(sorted(options.items()))

    @functools.wraps(function)
    def call(*values: Any, **named: Any) -> Any:
        leaves, structure = jax.tree.flatten((values, named))
        moves = tuple(map(eqx.is_array, leaves))
        static = tuple(None if m else leaf for leaf, m in zip(leaves, moves, strict=True))

        def jitted() -> Callable:
            @functools.wraps(function)  # whose name XLA gives the module
            def of_arrays(arrays: list[Any]) -> Any:
                rest = iter(arrays)
                values, named = jax.tree.unflatten(
                    structure, [next(rest) if m else s for s, m in zip(static, moves, strict=True)]
                )
                return function(*values, **named)

            return jax.jit(of_arrays, **options)

        kinds = tuple(map(type, static))  # 1, 1.0 and True are equal
        run = _jitted.get((own, structure, moves, static, kinds), jitted)
        with without_alarms():
            return run([leaf for leaf, m in zip(leaves, moves, strict=True) if m])

    return call
