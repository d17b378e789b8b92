"""Coefficients of symmetric compositions, by the names of their authors and their order."""

from collections.abc import Sequence


def _symmetric(half: Sequence[float], middle: float | None = None) -> tuple[float, ...]:
    """(γ1, …, γs, γ_middle, γs, …, γ1), with the middle that makes the sum 1 unless it is given."""
    centre = 1.0 - 2.0 * sum(half) if middle is None else middle
    return (*half, centre, *reversed(half))


def _triple_jump(order: int) -> tuple[float, ...]:
    """From order − 2 to `order` by three steps (Yoshida 1990; Creutz–Gocksch)."""
    outer = 1.0 / (2.0 - 2.0 ** (1.0 / (order - 1)))
    return (outer, 1.0 - 2.0 * outer, outer)


def _quintuple_jump(order: int) -> tuple[float, ...]:
    """From order − 2 to `order` by five steps (Suzuki 1990)."""
    outer = 1.0 / (4.0 - 4.0 ** (1.0 / (order - 1)))
    return (outer, outer, 1.0 - 4.0 * outer, outer, outer)


def _nested(jump, order: int) -> tuple[float, ...]:
    coefficients = (1.0,)
    for current in range(4, order + 1, 2):
        coefficients = tuple(a * b for a in jump(current) for b in coefficients)
    return coefficients


COEFFICIENTS: dict[str, tuple[float, ...]] = {
    "yoshida4": _nested(_triple_jump, 4),
    "suzuki4": _nested(_quintuple_jump, 4),
    "suzuki6": _nested(_quintuple_jump, 6),
    "suzuki8": _nested(_quintuple_jump, 8),
    # Yoshida 1990, solution A of order 6
    "yoshida6": _symmetric((0.784513610477560, 0.235573213359357, -1.17767998417887)),
    # Kahan, Li 1997: order 6 with nine, order 8 with seventeen steps
    "kahan-li6": _symmetric((0.39216144400731413928, 0.33259913678935943860, -0.70624617255763935981, 0.08221359629355080023)),
    "kahan-li8": _symmetric(
        (
            0.13020248308889008088,
            0.56116298177510838456,
            -0.38947496264484728641,
            0.15884190655515560090,
            -0.39590389413323757734,
            0.18453964097831570709,
            0.25837438768632204729,
            0.29501172360931029887,
        )
    ),
    # Suzuki, Umeno 1993; McLachlan 1995: order 8 with fifteen steps
    "mclachlan8": _symmetric(
        (
            0.74167036435061295345,
            -0.40910082580003159400,
            0.19075471029623837995,
            -0.57386247111608226666,
            0.29906418130365592384,
            0.33462491824529818378,
            0.31529309239676659663,
        )
    ),
}
"""Symmetric compositions of a self-adjoint scheme of order 2, by the name of their authors and their order."""
