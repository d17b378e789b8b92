"""The premise of a discrete Lagrangian of one's own: that it is one of the system, asked at initial data."""

from collections.abc import Callable
from typing import Any

import numpy as np

from dirax.program.evaluation.functions import at_values

NEAR = 1e-2
"""Part of the step at whose end the discrete Lagrangian is asked."""

CLOSER, CONVERGED = 4.0, 0.6
"""By how much this is divided, and what may be left of a difference that goes to zero then."""

OFF, BELOW = 1e-2, 1e-6
"""A difference that counts, relative to its own entry, and to the largest one."""


class ConsistentWith:
    """Whether −D1 L_d and D2 L_d come to ∂L/∂v, and (D1 L_d + D2 L_d)/h to ∂L/∂q, for short steps from (q, v).

    Then steps by L_d are consistent with the Euler–Lagrange equations of L from the momentum ∂L/∂v (Marsden, West 2001, §2.3).
    """

    def __init__(self, derivatives: Callable, slopes: Callable):
        self.derivatives, self.slopes, self.asked = derivatives, slopes, False

    def check(self, data: Any, h: Any, params: Any) -> None:
        """Raise `ValueError` where it is not so at the first data that it is asked of; where they hold no v, the momentum is the
        user's, which may belong to L_d alone."""
        if self.asked or "v" not in data:
            return
        q, v = (np.asarray(data[name], float) for name in ("q", "v"))
        v = np.where(v == 0.0, np.max(np.abs(v)) or NEAR * np.max(np.abs(q)) / abs(h) or 1.0, v)
        q = np.where(q == 0.0, np.max(np.abs(q)) or abs(h) * np.max(np.abs(v)), q)
        t = np.asarray(data.get("t", 0.0), float)
        expected = self._numbers(self.slopes, (t, q, v, params))
        near, closer = (self._near(t, q, v, step, params) for step in (NEAR * h, NEAR * h / CLOSER))
        if expected is None or near is None or closer is None:
            self.asked = True
            return
        p, force = expected
        for name, target, first, second in (
            ("−D1 L_d", p, near[0], closer[0]),
            ("D2 L_d", p, near[1], closer[1]),
            ("(D1 L_d + D2 L_d)/h", force, near[2], closer[2]),
        ):
            size = np.maximum(np.abs(target), np.abs(second))
            far = np.abs(second - target) > np.maximum(OFF * size, BELOW * np.max(size))
            if np.any(far & (np.abs(second - target) > CONVERGED * np.abs(first - target))):
                what = "∂L/∂q" if target is force else "∂L/∂v"
                raise ValueError(
                    f"discrete_lagrangian is none of this Lagrangian: for short steps from the initial point {name} comes to "
                    f"{np.array2string(second, precision=4)}, and {what} is {np.array2string(target, precision=4)}. "
                    "L_d(q0, q1, h) is h L at points between q0 and q1, with (q1 - q0)/h for v."
                )
        self.asked = True

    def _near(self, t: np.ndarray, q: np.ndarray, v: np.ndarray, h: float, params: Any) -> tuple | None:
        found = self._numbers(self.derivatives, (t, q, v, np.asarray(h), params))
        return None if found is None else (-found[0], found[1], (found[0] + found[1]) / h)

    @staticmethod
    def _numbers(function: Callable, values: tuple) -> tuple | None:
        """What a function returns, where that is found without compiling, and finite."""
        found = at_values(function, values)
        return found[0] if found is not None and all(np.all(np.isfinite(a)) for a in found[0]) else None
