"""Premise: what has to hold of numbers at the initial data, or all along, whatever the scheme."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import numpy as np

from dirax.numerics.arrays import Data
from dirax.program.user_functions import evaluated, is_traced


class Premise(NamedTuple):
    """`numbers(data, params)` are the arrays, traceable, of one trajectory; `refuse`, called with their values, raises
    `ValueError` where what a system presupposes does not hold of them."""

    numbers: Callable[[Data, Any], Any]
    refuse: Callable[[Any], Any]

    def check(self, data: Data, params: Any) -> None:
        """Raise `ValueError` where it does not hold at these data and params, which must be concrete."""
        found = evaluated(self.numbers, dict(data), params)
        if not is_traced(found):  # functions may close over traced values
            self.refuse(jax.tree.map(np.asarray, found))
