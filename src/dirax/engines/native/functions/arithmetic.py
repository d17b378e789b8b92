"""Sums, products, reciprocals and roots; the larger and the smaller; whole numbers near by."""

from collections.abc import Callable

from dirax.engines.native.ir.emitter import Emitter


def _intrinsic(name: str) -> Callable[..., str]:
    return lambda e, x: e.intrinsic(name, x)


def _extreme(predicate: str) -> Callable[..., str]:
    """The first of two numbers where it compares so with the second or is NaN, else the second."""

    def chosen(e: Emitter, a: str, b: str) -> str:
        first = e.compare(predicate, a, b)
        return e.select(e.either(first, e.compare("uno", a, a)), a, b)

    return chosen


def sign(e: Emitter, x: str) -> str:
    """±1, and x itself where it is zero or NaN."""
    zero = e.const(0.0)
    below = e.select(e.compare("olt", x, zero), e.const(-1.0), x)
    return e.select(e.compare("ogt", x, zero), e.const(1.0), below)


MACHINE_CODE = {
    **{"add": Emitter.add, "sub": Emitter.sub, "mul": Emitter.mul, "neg": Emitter.neg, "rem": Emitter.rem},
    **{"abs": Emitter.abs, "sqrt": Emitter.sqrt, "max": _extreme("ogt"), "min": _extreme("olt"), "sign": sign},
    "recip": lambda e, x: e.div(e.const(1.0), x),
    **{"floor": _intrinsic("floor"), "ceil": _intrinsic("ceil"), "round": _intrinsic("roundeven"), "trunc": _intrinsic("trunc")},
}
