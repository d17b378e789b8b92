"""What the primitives of JAX, and dirax's own, are on the scalar graph: importing this room registers the rules."""

from dirax.program.rules import (
    by_numpy,
    control,
    derivative_primitives,
    elementwise,
    linear_algebra,
    movement,
    reductions,
)

__all__ = ["by_numpy", "control", "derivative_primitives", "elementwise", "linear_algebra", "movement", "reductions"]
