"""Compiled functions whose static arguments, systems among them, are let go with everything else that dirax keeps."""

import functools
from collections.abc import Callable
from typing import Any

import equinox as eqx

from dirax.program.memo import Memo

_jitted: Memo[Callable] = Memo(256)


def compiled(function: Callable, **options: Any) -> Callable:
    """`eqx.filter_jit(function, **options)`, the same for equal functions, whose cache `dx.clear_caches` empties."""
    key = function, tuple(sorted(options.items(), key=str))

    @functools.wraps(function)
    def call(*values: Any, **named: Any) -> Any:
        return _jitted.get(key, lambda: eqx.filter_jit(function, **options))(*values, **named)

    return call
