"""The machine code of every operation: `MACHINE_CODE[name](emitter, *values)` writes the instructions and gives the result.

A file a family, as in `dirax.program.operations`, where the meaning and the derivative of the operations are, and where those
without machine code of their own have a formula of others. The code is without branches and the same for scalars and for
vectors of any width, so that a lane's bits are the same in all of them.
"""

from collections.abc import Callable

from dirax.engines.native.functions import (
    arithmetic,
    error_function,
    exponential,
    hyperbolic,
    inverse_trigonometric,
    logarithms_and_powers,
    logic,
    trigonometric,
)

FAMILIES = (
    *(arithmetic, logic, trigonometric, inverse_trigonometric),
    *(exponential, logarithms_and_powers, hyperbolic, error_function),
)
MACHINE_CODE: dict[str, Callable[..., str]] = {name: code for family in FAMILIES for name, code in family.MACHINE_CODE.items()}
