"""machine(): an example of the gallery from a model of bodies, which knows its coordinates and what it looks like."""

from collections.abc import Mapping
from typing import Any

from dirax.bodies.model import Model
from dirax.gallery.example import Coordinate, Example

SI = {"length": "m", "angle": "rad", "": ""}


def machine(
    name: str,
    title: str,
    source: str,
    model: Model,
    initial: Mapping[str, Any],
    *,
    step: float,
    steps: int,
    units: bool = True,
    view: Any = "oblique",
    trail: str = "",
    **more: Any,
) -> Example:
    """The `Example` of a model, by the scheme that `Example` takes unless `more` names another.

    `units`: whether its numbers are SI units; `view` and `trail` are those of `Model.scene`. Coordinates of the first body are
    called without its name.
    """
    first = f"{model.joints[0].name}."
    si = SI if units else dict.fromkeys(SI, "") | {"angle": "rad"}
    kinds = zip(model.coordinates, model.quantities, strict=True)
    return Example(
        name=name,
        title=title,
        source=source,
        system=model.system,
        params=model.params,
        initial=initial,
        step=step,
        steps=steps,
        coordinates=tuple(Coordinate(coordinate.removeprefix(first), si[kind]) for coordinate, kind in kinds),
        time_unit="s" if units else "",
        energy_unit="J" if units else "",
        scene=model.scene(view=view, trail=trail),
        model=model,
        **more,
    )
