"""Example: a system of the gallery with the data that make it run, and what is known about it from elsewhere."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from dirax.run.simulate import simulate
from dirax.schemes.lagrange_dirac import LagrangeDAlembert
from dirax.schemes.step import AbstractScheme
from dirax.show.scene import Scene
from dirax.solution.solution import Solution
from dirax.systems.system import AbstractSystem


@dataclass(frozen=True)
class Coordinate:
    """The name of a coordinate and its unit; "" where the source gives none."""

    name: str
    unit: str = ""


@dataclass(frozen=True, eq=False)
class Example:
    """A ready-made system: `dirax.gallery.get(name)`.

    - `name`, `title`, `source`: what it is and where its equations are.
    - `system`, `params`: a dirax system and the parameters of its functions, by name or another pytree (None without any).
    - `initial`: initial data for `simulate` by keyword, `q` and `v` of shape (n,) or another of its pairs.
    - `scheme`, `step`, `steps`: the run that the source shows, or a sensible one; `step` is in `time_unit`.
    - `coordinates`: one `Coordinate` per entry of q or x; `plane`: the two that make a good picture.
    - `exact(t, params=…, **initial) -> (rows, n)`: the solution at times `t` (rows,) from a closed form or a quadrature.
    - `symmetries`: infinitesimal generators `ξ(q) -> (n,)` by name, whose momentum ⟨p, ξ(q)⟩ is conserved.
    - `options`: other arguments of `dx.simulate`, such as events.
    - `scene`: what a report draws of it, a `dx.scene.Scene`.
    - `model`: the `dx.bodies.Model` that states it, if one does.

        sol = dirax.gallery.get("kepler").simulate(step=0.05)
    """

    name: str
    title: str
    source: str
    system: AbstractSystem
    initial: Mapping[str, Any]
    step: float
    steps: int
    coordinates: tuple[Coordinate, ...]
    scheme: AbstractScheme = field(default_factory=LagrangeDAlembert)
    params: Any = None
    time_unit: str = ""
    energy_unit: str = ""
    plane: tuple[int, int] = (0, 1)
    exact: Callable[..., np.ndarray] | None = None
    symmetries: Mapping[str, Callable] = field(default_factory=dict)
    options: Mapping[str, Any] = field(default_factory=dict)
    scene: Scene | None = None
    model: Any = None

    @property
    def labels(self) -> dict[str, Any]:
        """Names and units, as a Solution carries them in its `metadata` for plots and files."""
        return {
            "title": self.title,
            "example": self.name,
            "coordinates": [c.name for c in self.coordinates],
            "units": {"q": [c.unit for c in self.coordinates], "t": self.time_unit, "energy": self.energy_unit},
        }

    def simulate(self, scheme: AbstractScheme | None = None, **changes: Any) -> Solution:
        """Run the example and return the Solution; `changes` are keywords of `dx.simulate` that replace the example's data.

        `params` may be a part of the parameters; the others keep their values. Giving any initial data replaces all of it.
        Raises what `dx.simulate` raises.
        """
        settings: dict[str, Any] = {"step": self.step, "steps": self.steps, **self.options}
        if not {"q", "v", "p", "q0", "q1", "x"} & changes.keys():
            settings.update(self.initial)
        params = changes.pop("params", None)
        partly = isinstance(self.params, Mapping) and isinstance(params, Mapping)
        settings["params"] = {**self.params, **params} if partly else self.params if params is None else params
        solution = simulate(self.system, scheme or self.scheme, **{**settings, **changes})
        solution.metadata.update(self.labels)
        solution.example = self
        return solution
