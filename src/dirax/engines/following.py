"""Solutions of steps followed from short ones on, by pseudo-arclength (Keller 1977): of a step for which Newton's method finds
none from its guess, and to see where they turn back."""

from collections.abc import Callable

import numpy as np

from dirax.numerics.inverses import solved

BEGIN = 2.0**-10
"""The part of the step at which following begins."""

MOST = 200
"""Points on the branch of solutions."""

FIRST, LONGEST, SHORTEST = 0.05, 0.3, 1e-5
"""Distances between them, in unknowns relative to their sizes and in parts of the step."""

NEAR, FOUND, UPDATES = 1e-6, 1e-9, 8
"""The relative update of Newton's method at which a point on the way is found, and the last one, and how many there may be."""

BESIDE = 2.0**-13
"""Part of sizes, which are bounds, that counts beside values: an unknown that becomes larger on the way counts as that."""

TURNED = 0.98
"""Part of the longest step found below which the solutions have turned back."""

FOLLOWED = 64
"""Unknowns of a step up to which its solutions are followed."""

Slopes = Callable[[np.ndarray, np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]


@np.errstate(all="ignore")
def followed(slopes: Slopes, unknowns: np.ndarray, sizes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The solutions u(s) of equations of steps, of their parts 0 < s ≤ 1, side by side: from `unknowns` (n, k) near those of a
    short part on, which have these `sizes`. Returns those of the whole steps (n, k), NaN where there are none, and how long a
    part has solutions, (n,): 1, or less where two of them meet and turn back; 0 where they cannot be followed.

    `slopes(some, u, s)` gives of the steps numbered `some` the residuals (m, k) at u (m, k) and parts s (m,), and their
    derivatives (m, k, k + 1) by the unknowns and by s.
    """
    (n, k), scale = unknowns.shape, np.abs(unknowns) + BESIDE * sizes
    scale = np.where((scale != 0.0) & np.isfinite(scale), scale, 1.0)
    scale = np.append(scale, np.ones((n, 1)), axis=1)
    last = np.append(np.zeros(k), 1.0)

    def bordered(some, y, normal):
        u = y * scale[some]
        residual, matrix = slopes(some, u[:, :k], u[:, k])
        matrix = matrix * scale[some][:, None]
        rows = np.max(np.abs(matrix), axis=2)
        rows = np.where(rows != 0.0, rows, 1.0)
        return residual / rows, np.concatenate([matrix / rows[..., None], normal[:, None]], axis=1)

    def corrected(some, start, normal, near):
        """The points of the branches on the planes through these, the last matrices there, and which points are found."""
        y, found, matrices = start.copy(), np.zeros(len(some), bool), np.empty((len(some), k + 1, k + 1))
        for _ in range(UPDATES):
            if not len(left := np.flatnonzero(~found)):
                break
            residual, matrices[left] = bordered(some[left], y[left], normal[left])
            off = np.einsum("nk,nk->n", normal[left], y[left] - start[left])
            change = solved(matrices[left], np.append(residual, off[:, None], axis=1))
            y[left] -= change
            found[left] = np.max(np.abs(change), axis=1) < near[left]
        return y, matrices, found

    y = np.append(unknowns / scale[:, :k], np.full((n, 1), BEGIN), axis=1)
    direction, distance, longest, reached = np.tile(last, (n, 1)), np.full(n, FIRST), np.zeros(n), np.zeros(n)
    y, matrices, going = corrected(np.arange(n), y, direction, np.full(n, NEAR))
    for _ in range(MOST):
        if not len(some := np.flatnonzero(going)):
            break
        matrices[some, k] = direction[some]
        along = solved(matrices[some], np.broadcast_to(last, (len(some), k + 1)))
        direction[some] = along = along / np.linalg.norm(along, axis=1, keepdims=True)
        to_end = (1.0 - y[some, k]) / along[:, k]
        ends = (along[:, k] > 0.0) & (to_end <= distance[some])  # the last point is at the whole step
        far = np.where(ends, to_end, distance[some])
        ahead = y[some] + far[:, None] * along
        ahead[ends, k] = 1.0
        near = np.where(ends, FOUND, NEAR)
        new, there, found = corrected(some, ahead, np.where(ends[:, None], last, along), near)
        found &= np.linalg.norm(new - y[some], axis=1) < 2.0 * far
        distance[some] = np.where(found, np.minimum(1.5 * distance[some], LONGEST), far / 2.0)
        here = some[found]
        y[here], matrices[here] = new[found], there[found]
        grown = np.maximum(np.abs(y), 1.0)
        grown[:, k] = 1.0
        y, direction, scale, matrices = y / grown, direction / grown, scale * grown, matrices * grown[:, None]
        turned = y[here, k] < TURNED * longest[here]
        reached[here] = np.where(turned, longest[here], np.where(ends[found], 1.0, 0.0))
        longest[here] = np.maximum(longest[here], y[here, k])
        going[here] = ~turned & ~ends[found]
        going[some[~found]] &= distance[some[~found]] >= SHORTEST
    return np.where(reached[:, None] == 1.0, y[:, :k] * scale[:, :k], np.nan), reached
