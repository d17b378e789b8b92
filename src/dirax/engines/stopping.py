"""When Newton's method stops, in every engine: at the roundoff floor, and not at a tolerance.

An update is measured by its largest |change_i| / (|u_i| + size_i), with the sizes of `sizes.py`, whose ε-th part is the
roundoff of the unknowns, so that units do not matter; and its ratio to the one before says how the iteration contracts, to 1
where that was larger, since coming from far away says nothing.
With a Jacobian from a distance e of the root the error shrinks by 2Ce in an update, C the curvature, and Ce is the ratio of the
first two updates: what an update leaves is at most 2·ratio·update. The iteration has reached its floor where

    update ≤ FLOOR   or   2·ratio·update ≤ NEGLIGIBLE   or   ratio ≥ ½ and update < STALLED.

A size is a bound, which can be far too large: the first of these counts only where what is left, 2·ratio·|change_i|, is below
FLOOR·(|u_i| + OWN·size_i) for every unknown, or where there is no ratio yet.

Roots around a run, of initial data say, stop as `dirax/numerics/newton.py` says. The test is
written out in array operations in `xla/newton.py` and in machine code in `native/loops/newton_loop.py`.
"""

from dirax.numerics.tolerances import EPSILON

FLOOR = 8 * EPSILON
"""A relative update of this size is roundoff: the unknowns cannot be known better."""

OWN = 2.0**-20
"""What is surely roundoff of a size that is a bound: an iteration that contracts goes on to it."""

NEGLIGIBLE = 1e-5 * EPSILON
"""Error left by the last update that even 10¹⁰ steps do not add up to more than their roundoff."""

STALLED = 1e-9
"""Updates below this that no longer shrink have reached the floor of an ill-conditioned equation."""

NEAR, CONTRACTING = 1e-3, 1e-2
"""The Jacobian is used again after a first update below NEAR, as long as updates shrink by the factor CONTRACTING, and for those
below STALLED, of which roundoff is a part: another Jacobian would not make it any smaller."""
