"""What is known of a run between its rows, whether its values are numbers or traced."""

from typing import Any

from dirax.solution.trajectory import Trajectory


class BetweenRows:
    """The inside of the steps of a run.

    By the polynomial of the method, where it has one; by the cubic through saved rows, for methods of second order whose every
    row was saved; else by a step of a part of the length, of which a row is made as the run makes it.
    """

    def __init__(self, sol: Trajectory):
        if sol.equation is None or sol.system is None:
            raise ValueError(
                "this solution does not know by which equations it was made: load it with dx.load(path, system=…, scheme=…)."
            )
        if sol.impacts is not None and sol.save_every != 1:
            raise ValueError("between the rows of a run with impacts sol.at needs every row: leave save_every= out.")
        if sol.has_own_times and sol.save_every != 1:
            raise ValueError("between the rows of a run of variable steps sol.at needs every row: leave save_every= out.")
        if sol.rows < 2:
            raise ValueError("there is no step between the rows of this solution, which has only one.")
        self.sol, self.equation = sol, sol.equation
        first = self.equation.stages[0][0]
        single = len(self.equation.stages) == 1
        self.interpolate = first.interpolate if single else None
        self.between = first.between if single and sol.save_every == 1 else None
        if sol.has_own_times and not single:
            raise ValueError("between the rows of a composition of variable steps nothing is known: compose another scheme.")

    @property
    def nodes(self) -> dict[str, Any]:
        """The saved fields of nodes."""
        return {name: a for name, a in self.sol.fields.items() if self.sol.field_info[name].place == "node"}


def velocity_of(system: Any, row: dict, t: Any, params: Any) -> Any:
    """The velocity that belongs to q and p, near what is known `about` it."""
    near = {name: row[name] for name in ("q", "p", "about") if name in row}
    return system.complete({**near, "t": t}, params, False)["v"]
