"""Comparisons, logic, and the choice between two numbers."""

from collections.abc import Callable

from dirax.engines.native.ir.emitter import Emitter


def _comparison(predicate: str) -> Callable[..., str]:
    return lambda e, a, b: e.compare(predicate, a, b)


MACHINE_CODE = {
    "select": Emitter.select,
    **{"lt": _comparison("olt"), "le": _comparison("ole"), "eq": _comparison("oeq"), "ne": _comparison("une")},
    "finite": lambda e, x: e.compare("olt", e.abs(x), e.const(float("inf"))),
    **{"and": Emitter.both, "or": Emitter.either, "not": Emitter.invert},
}
