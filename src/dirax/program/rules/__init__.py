"""What the primitives of JAX, and dirax's own, are on the scalar graph: importing this room registers the rules."""

from dirax.program.rules import (
    control,
    derivatives,
    elementwise,
    linear_algebra,
    movement,
    reductions,
)

__all__ = ["control", "derivatives", "elementwise", "linear_algebra", "movement", "reductions"]
