"""Between two rows of a method of second order: the cubic with their positions and velocities."""

from collections.abc import Callable
from typing import Any

from dirax.systems.lagrange_dirac import LagrangeDirac


def cubic(theta: Any, q: Any, after: Any, v: Any, v_after: Any, h: Any) -> Any:
    """q(θ) of degree 3 with these places and velocities at θ = 0 and 1."""
    rest, change = 1.0 - theta, after - q
    return q + theta * (change + rest * ((rest * (h * v - change)) + theta * (change - h * v_after)))


def hermite(system: LagrangeDirac, one_sided: bool = False) -> Callable:
    """`between` of a StepEquation: q(θ) of degree 3 with q and v of both rows, v = q̇ and p = ∂L/∂v(q, q̇).

    The rows have their own p, from which ∂L/∂v may differ at them, where L is degenerate for instance: that is blended in.
    The interpolation alone is off by O(h⁴) in q and O(h³) in v and p, less than a method of second order is. Velocities of
    `one_sided` methods of first order belong to a place half a step off, at both rows: q(θ) has them moved by what they miss
    of the way between the rows, and v goes from one to the other without a bend that would be none of the motion.
    """

    def between(theta: Any, row: dict, after: dict, h: Any, params: Any) -> dict:
        rest, change = 1.0 - theta, after["q"] - row["q"]
        missed_way = change / h - (row["v"] + after["v"]) / 2.0 if one_sided else 0.0
        begins, ends = row["v"] + missed_way, after["v"] + missed_way
        bend = (rest * (h * begins - change)) + theta * (change - h * ends)
        q = cubic(theta, row["q"], after["q"], begins, ends, h)
        slope = (change - h * ends) - (h * begins - change)
        v = (change + (rest - theta) * bend + theta * rest * slope) / h - missed_way
        missed = [end["p"] - system.legendre(end["q"], end["v"], params, end["t"]) for end in (row, after)]
        p = system.legendre(q, v, params, row["t"] + theta * h) + rest * missed[0] + theta * missed[1]
        found = {"q": q, "v": v, "p": p}
        if "work" in row:
            found["work"] = row["work"] + theta * (after["work"] - row["work"])
        return found

    return between
