"""What the papers prove, measured: one row a theorem, by formulas in NumPy that use nothing of dirax but what it computed."""

import math
from dataclasses import dataclass
from typing import Any

from dirax.text.tables import plain

HOLDS, FAILS = "holds", "DOES NOT HOLD"


@dataclass(frozen=True)
class Theorem:
    """One theorem: where it stands, what it says, and to how much it holds, relative to the terms that cancel.

    `limit` is what roundoff explains; `control` is the same number where the theorem must fail, NaN where nothing was tried:
    it holds where the first is at most `limit` and the second is far above it.
    """

    name: str
    says: str
    holds_to: float
    control: float = math.nan
    limit: float = 1e-12

    @property
    def verdict(self) -> str:
        """HOLDS, or FAILS."""
        told_apart = math.isnan(self.control) or self.control > 1e3 * self.limit
        return HOLDS if self.holds_to <= self.limit and told_apart else FAILS

    def to_dict(self) -> dict[str, Any]:
        """The row as plain Python values, fit for JSON."""
        names = ("name", "says", "holds_to", "control", "limit", "verdict")
        return plain({name: getattr(self, name) for name in names})

    @property
    def cells(self) -> tuple[str, str, str, str, str]:
        """The row of a printed table, under `HEADER`."""
        control = "" if math.isnan(self.control) else f"{self.control:.1e}"
        return self.name, self.says, f"{self.holds_to:.1e}", control, self.verdict


HEADER = ("theorem", "says", "holds to", "control", "verdict")
