"""To be looked at: a solution as one page for a browser, with motion in three dimensions and plots that move with it."""

from pathlib import Path
from typing import Any

from dirax.program.user_functions import is_traced
from dirax.solution.solution import Solution
from dirax.solution.trajectory import Trajectory


def _report(self: Solution, path: Any, **settings: Any) -> Path:
    """Write a page about this solution that opens in any browser: `dirax.show.report.report`."""
    from dirax.show.report import report

    return report(self, path, **settings)


def _animate(self: Solution, path: Any, **settings: Any) -> Path:
    """Write the motion of this solution as a moving picture: `dirax.show.animation.animate`."""
    from dirax.show.animation import animate

    return animate(self, path, **settings)


def _repr_html_(self: Solution) -> str:
    """The motion and two plots for a notebook, and the table of what was run; the table alone where there is nothing to draw."""
    table = Trajectory._repr_html_(self)
    if is_traced(self.t, self.fields) or not {"q", "x"} & self.fields.keys() or self.rows < 2:
        return table
    from dirax.show.report import notebook_view

    return notebook_view(self) + table


Solution.report = _report
Solution._repr_html_ = _repr_html_
Solution.animate = _animate
