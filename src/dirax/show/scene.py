"""What a report draws: a few bodies, whose places are functions of the row of a trajectory.

    parts = [dx.scene.rod([0, 0, 0], bob), dx.scene.point(bob, trail=True)]      # bob(q) -> (3,)
    sol.report("pendulum.html", scene=parts)

A place is an array or a function that JAX traces. The names of its arguments say what it is given: q, p, x or another saved
field, t, params; a single argument of another name is q (x, where there is no q). Two numbers are a point of the plane z = 0.
A rotation is a quaternion (w, x, y, z), as `turn` and `after` make them, or a matrix (3, 3).
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, TypeAlias

import numpy as np

from dirax.show.turns import after, attitudes, turn

__all__ = [
    "Part",
    "Scene",
    "after",
    "arrow",
    "attitudes",
    "axes",
    "ball",
    "blade",
    "box",
    "disk",
    "path",
    "plane",
    "point",
    "rod",
    "sphere",
    "spring",
    "turn",
]

Place: TypeAlias = "Callable | Sequence | np.ndarray"

ORIGIN = (0.0, 0.0, 0.0)
UNTURNED = (1.0, 0.0, 0.0, 0.0)

VIEWS = {"oblique": (0.55, -0.75, 0.45), "front": (0.0, -1.0, 0.0), "above": (0.0, -0.02, 1.0), "tilted": (0.0, -0.62, 0.78)}


@dataclass(frozen=True)
class Reading:
    """A place that is read from what many have in common, such as the frames of all bodies, which is computed once for all of
    them: read(whole(q, params), params)."""

    whole: Callable
    read: Callable

    def __call__(self, q: Any, params: Any) -> Any:
        return self.read(self.whole(q, params), params)


@dataclass(frozen=True)
class Part:
    """One body: its kind, its places by name, and plain settings (lengths, None for one that suits the picture)."""

    kind: str
    places: Mapping[str, Any]
    settings: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Scene:
    """Parts, and where they are looked at from.

    - `view`: "oblique", "front" (x to the right, z up), "above" (x to the right, y up), "tilted", or the direction (3,) from
      the middle of the motion to the eye.
    - `fields(rows, params) -> {name: (rows, k)}`: more quantities that places may name, from NumPy arrays (rows, n) of the
      saved ones, `t` (rows,) included; for what needs the whole trajectory, such as an attitude from angular velocities.
    """

    parts: Sequence[Part]
    view: str | Sequence[float] = "oblique"
    fields: Callable[[dict[str, np.ndarray], Any], Mapping[str, np.ndarray]] | None = None

    def __post_init__(self):
        if isinstance(self.view, str) and self.view not in VIEWS:
            raise ValueError(f"view must be one of {', '.join(VIEWS)} or a direction of three numbers, but it is {self.view!r}.")
        others = [part for part in self.parts if not isinstance(part, Part)]
        if others:
            raise TypeError(f"a scene is made of parts such as dirax.scene.point(…), but one is a {type(others[0]).__name__}.")

    @property
    def direction(self) -> tuple[float, ...]:
        """From the middle of the motion to the eye, (3,)."""
        return VIEWS[self.view] if isinstance(self.view, str) else tuple(float(x) for x in self.view)


def point(at: Place, radius: float | None = None, trail: bool = False, colour: Any = None) -> Part:
    """A small ball."""
    return Part("point", {"at": at}, {"radius": radius, "trail": trail, "colour": colour})


def ball(centre: Place, turn: Place = UNTURNED, radius: float = 1.0, trail: bool = False, colour: Any = None) -> Part:
    """A ball with two halves, so that its rotation is seen."""
    return Part("ball", {"at": centre, "turn": turn}, {"radius": radius, "trail": trail, "colour": colour})


def rod(start: Place, end: Place, radius: float | None = None, colour: Any = "ink") -> Part:
    """A straight rod between two points."""
    return Part("rod", {"at": start, "end": end}, {"radius": radius, "colour": colour})


def spring(start: Place, end: Place, turns: int = 9, radius: float | None = None, colour: Any = "ink") -> Part:
    """A coil between two points."""
    return Part("spring", {"at": start, "end": end}, {"turns": turns, "radius": radius, "colour": colour})


def disk(
    centre: Place,
    turn: Place = UNTURNED,
    radius: float = 1.0,
    thickness: float | None = None,
    trail: bool = False,
    colour: Any = None,
) -> Part:
    """A wheel with spokes, whose axis is z before it is turned."""
    settings = {"radius": radius, "thickness": thickness, "trail": trail, "colour": colour}
    return Part("disk", {"at": centre, "turn": turn}, settings)


def box(
    centre: Place, turn: Place = UNTURNED, size: Sequence[float] = (1.0, 1.0, 1.0), trail: bool = False, colour: Any = None
) -> Part:
    """A box with edges along the axes before it is turned."""
    return Part("box", {"at": centre, "turn": turn}, {"size": list(map(float, size)), "trail": trail, "colour": colour})


def blade(at: Place, turn: Place = UNTURNED, length: float | None = None, trail: bool = False, colour: Any = None) -> Part:
    """A skate that touches the plane z = 0 at a point and moves along x before it is turned."""
    return Part("blade", {"at": at, "turn": turn}, {"length": length, "trail": trail, "colour": colour})


def sphere(centre: Place = ORIGIN, radius: float = 1.0) -> Part:
    """A transparent surface to move on."""
    return Part("sphere", {"at": centre}, {"radius": radius})


def plane(at: Place = ORIGIN, turn: Place = UNTURNED, size: float | None = None) -> Part:
    """A plane with a grid, z = 0 before it is turned, as large as the motion unless `size` is given."""
    return Part("plane", {"at": at, "turn": turn}, {"size": size})


def axes(centre: Place = ORIGIN, turn: Place = UNTURNED, length: float | None = None) -> Part:
    """Three thin axes."""
    return Part("axes", {"at": centre, "turn": turn}, {"length": length})


def arrow(tail: Place, vector: Place, scale: float = 1.0, colour: Any = "accent") -> Part:
    """An arrow of a vector (3,), such as a momentum, `scale` units of length for one of the vector."""
    return Part("arrow", {"at": tail, "vector": vector}, {"scale": float(scale), "colour": colour})


def path(at: Place, colour: Any = None) -> Part:
    """The whole curve that a point describes."""
    return Part("path", {"at": at}, {"colour": colour})
