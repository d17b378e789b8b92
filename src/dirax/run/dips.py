"""Where three values of a function say that it may reach zero between them without a change of sign."""

import numpy as np


def dips(before: np.ndarray, middle: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Where a function of one sign is nearest to zero in the middle, and bends so much that it may reach zero beside it, four
    times as much as a parabola has to."""
    sign = np.sign(middle)
    before, middle, after = sign * before, sign * middle, sign * after
    bend = before - 2.0 * middle + after
    return (middle > 0.0) & (middle <= before) & (middle <= after) & (middle <= bend / 2.0)
