"""An event of a traced run as a function of the step that it is in: its time, and the fields there, with their derivatives."""

from dataclasses import dataclass
from typing import Any

from dirax.program.given_tangents import implicit
from dirax.run.event import Event, evaluated
from dirax.schemes.step import CLOCK
from dirax.solution.dense_traced import TracedDense


@dataclass(frozen=True)
class EventPlace:
    """An event, the place of which in a step is known as a number.

    A step is its rows, its fields, t, h and params; `roots` are the unknowns of what is solved inside of it, where they are known
    as numbers.
    """

    dense: TracedDense
    event: Event
    number: int

    def located(self, root: Any, step: tuple, solved: tuple, roots: Any = None) -> tuple[Any, dict]:
        """The time and the fields of nodes at a part `root` of a step, where the function of the event is zero."""
        residual = lambda x, whole: self.along(*whole, roots=roots)(x[0])[None]
        theta = implicit(residual, root[None], (step, solved), lambda m, r: r / m[0])[0]
        (begins, length), known = _clock(step), self.dense.inside(solved, *step, roots=roots)(theta)
        return begins + theta * length, {name: known[name] for name in step[0] if name in known}

    def along(self, step: tuple, solved: tuple, roots: Any = None) -> Any:
        """θ ↦ the function of the event in a step, of which everything is known that has to be solved."""
        event, inside, params, (begins, length) = (
            self.event,
            self.dense.inside(solved, *step, roots=roots),
            step[-1],
            _clock(step),
        )

        def value(theta):
            time, fields = begins + theta * length, inside(theta)
            if "v" in event.arguments:
                data = {"q": fields["q"], "p": fields["p"], "t": time}
                fields = fields | {"v": self.dense.sol.system.complete(data, params, False)["v"]}
            known = {name: fields[name] for name in event.arguments if name in fields} | {"t": time}
            return evaluated(event, self.number, known, params)

        return value


def _clock(step: tuple) -> tuple[Any, Any]:
    """When a step begins, and how long it lasts."""
    row, after, _, t, h, _ = step
    begins = row.get(CLOCK, t)
    return begins, after[CLOCK] - begins if CLOCK in row else h
