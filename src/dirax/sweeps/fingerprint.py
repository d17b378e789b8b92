"""What the store of a sweep belongs to, besides systems and schemes: digests of `case=` and `keep=`."""

from collections.abc import Mapping

import jax
import numpy as np

from dirax.solution.fingerprint import of_code, of_functions
from dirax.sweeps.case import Case
from dirax.sweeps.keep import Keep


def of_case(case: Case, arguments: Mapping[str, np.ndarray]) -> str:
    """A digest of `case`: of its traced program where it is evaluated by that, else of its code."""
    if case.mode == "scalars":
        given = tuple(jax.ShapeDtypeStruct((), arguments[name].dtype) for name in case.names)
        return f"{case.mode} {of_functions([(case.in_jax, given)])}"
    return f"{case.mode} {of_code(case.function)}"


def of_keep(keep: Keep) -> str:
    """A digest of the code of `keep`."""
    return "rows" if keep.function is None else of_code(keep.function)
