"""To be looked at: a solution as one page for a browser, with motion in three dimensions and plots that move with it."""

from pathlib import Path
from typing import Any

from dirax.solution.solution import Solution


def _report(self: Solution, path: Any, **settings: Any) -> Path:
    """Write a page about this solution that opens in any browser: `dirax.show.report.report`."""
    from dirax.show.report import report

    return report(self, path, **settings)


Solution.report = _report
