"""Joints: how a body moves against another one, as coordinates of a tree or as the constraints that close a loop."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import jax.numpy as jnp
import numpy as np

from dirax.bodies.frames import AnyFrame, Vector, across, unit, vector
from dirax.bodies.motion import Direct, Glide, Motion, Quaternion, Shift, Slide, Turn, TurnBy

X, Y, Z = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)
ORIGIN = (0.0, 0.0, 0.0)
AXES = {"x": X, "y": Y, "z": Z}

CONDITIONS = {
    "fixed": ("x", "y", "z", "turn about x", "turn about y", "turn about z"),
    "revolute": ("x", "y", "z", "first tilt", "second tilt"),
    "prismatic": ("first offset", "second offset", "turn about x", "turn about y", "turn about z"),
    "universal": ("x", "y", "z", "angle of the axes"),
    "ball": ("x", "y", "z"),
    "planar": ("offset", "first tilt", "second tilt"),
}
"""What a joint of each kind demands where it closes a loop."""

WITHOUT_TURN, WITH_AXIS = ("fixed", "prismatic"), ("revolute", "planar")
"""The kinds whose conditions have the sines of a rotation, and of an axis."""


@dataclass(frozen=True)
class Joint:
    """Between `parent` and `body`, made by `revolute`, `free` and the other functions here.

    The body's frame is moved by `motions`, in their order, from the point `at` of the parent's frame; the point `on` of the
    body's frame is then at that point. A joint that `closes` a loop has no coordinates: it demands of the two bodies what is
    named in `conditions`. Its `axis` is seen from the parent, and `axis_on` is the same axis seen from the body, by default the
    same numbers.
    """

    name: str
    kind: str
    parent: str
    body: str
    motions: tuple[Motion, ...]
    at: Vector = ORIGIN
    on: Vector = ORIGIN
    axis: Vector = Z
    second: Vector = X
    axis_on: Vector | None = None
    turned: tuple[Vector, float] | None = None
    closes: bool = False
    order: tuple[Motion, ...] = field(init=False)
    """All motions, those without coordinates among them."""

    def __post_init__(self):
        if self.turned and any(isinstance(m, Direct) or (isinstance(m, Quaternion) and m.from_ground) for m in self.motions):
            raise ValueError(f"joint {self.name!r} has turned=, which a rotation from the ground does not feel: leave it out.")
        before = [Shift(self.at)] if np.any(np.asarray(self.at) != 0) else []
        before += [TurnBy(*self.turned)] if self.turned else []
        after = [Shift(_opposite(self.on))] if np.any(np.asarray(self.on) != 0) else []
        object.__setattr__(self, "order", (*before, *self.motions, *after))

    @property
    def is_axis(self) -> bool:
        """Whether it gives its body a direction of the axis z and nothing else of a rotation."""
        return not self.closes and any(isinstance(motion, Direct) for motion in self.motions)

    @property
    def coordinates(self) -> tuple[str, ...]:
        """The names of its coordinates."""
        return () if self.closes else tuple(name for motion in self.motions for name in motion.names)

    @property
    def conditions(self) -> tuple[str, ...]:
        """The names of the constraints of a joint that closes a loop."""
        return CONDITIONS[self.kind] if self.closes else ()

    def move(self, frame: Any, q: Any, v: Any, params: Any) -> AnyFrame:
        """The body's frame from its parent's, for the joint's coordinates and their rates."""
        start = 0
        order: Sequence[Any] = self.order  # of a ray nothing but a shift is asked
        for motion in order:
            end = start + len(motion.names)
            frame, start = motion.move(frame, q[start:end], v[start:end], params), end
        return frame

    def defect(self, parent: AnyFrame, body: AnyFrame, params: Any) -> list[Any]:
        """By how much the conditions are violated, in their order, seen from the parent: lengths and sines of angles."""
        turned, (between, axis, own) = turn_of(self.turned), self._between(parent, body)
        apart = parent.turn.T @ (body.point(vector(self.on, params)) - parent.point(vector(self.at, params)))
        first, second = (turned @ e for e in across(axis))
        tilts = lambda: [e @ (between @ own) for e in across(axis)]
        turns = lambda: [(between[k, j] - between[j, k]) / 2 for j, k in ((1, 2), (2, 0), (0, 1))]
        places = [apart[0], apart[1], apart[2]]
        return {
            "fixed": lambda: [*places, *turns()],
            "revolute": lambda: [*places, *tilts()],
            "prismatic": lambda: [first @ apart, second @ apart, *turns()],
            "universal": lambda: [*places, axis @ (between @ unit(self.second))],
            "ball": lambda: places,
            "planar": lambda: [(turned @ axis) @ apart, *tilts()],
        }[self.kind]()

    @property
    def may_turn_over(self) -> bool:
        """Whether its conditions do not tell a body that is in place from one that is turned over, by half a turn."""
        return self.closes and self.kind in (*WITHOUT_TURN, *WITH_AXIS)

    def turned_over(self, parent: AnyFrame, body: AnyFrame) -> Any:
        """1 − cos of the angle, of the rotation or of the axis, by which a body that may turn over is out of place."""
        between, axis, own = self._between(parent, body)
        return (3.0 - jnp.trace(between)) / 2 if self.kind in WITHOUT_TURN else 1.0 - axis @ (between @ own)

    def _between(self, parent: AnyFrame, body: AnyFrame) -> tuple[Any, Any, Any]:
        """The rotation of the body as seen from the parent, beyond the joint's own; its axis, and the same seen from the body."""
        between = turn_of(self.turned).T @ parent.turn.T @ body.turn
        return between, unit(self.axis), unit(self.axis if self.axis_on is None else self.axis_on)


def turn_of(turned: tuple[Vector, float] | None) -> np.ndarray:
    """The rotation matrix of an axis and an angle, or the identity."""
    if turned is None:
        return np.eye(3)
    (x, y, z), angle = unit(turned[0]), turned[1]
    skew = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + np.sin(angle) * skew + (1 - np.cos(angle)) * skew @ skew


def _opposite(values: Vector) -> Any:
    if any(isinstance(value, str) for value in values):
        raise TypeError(f"`on` of a joint must be numbers, but it is {values!r}: name a parameter in `at` instead.")
    return tuple(-np.asarray(values, float))


def fixed(parent: str, body: str, name: str = "", **where: Any) -> Joint:
    """No motion at all. `where`: at=, on=, turned=(axis, angle), closes=, as of every joint here."""
    return Joint(name or body, "fixed", parent, body, (), **where)


def revolute(parent: str, body: str, axis: Vector = Z, name: str = "", **where: Any) -> Joint:
    """A hinge about `axis`; its coordinate, an angle in rad, has the joint's name, by default that of the body."""
    name = name or body
    return Joint(name, "revolute", parent, body, (Turn(axis, (name,)),), axis=axis, **where)


def prismatic(parent: str, body: str, axis: Vector = X, name: str = "", **where: Any) -> Joint:
    """A slide along `axis`; its coordinate, a length, has the joint's name, by default that of the body."""
    name = name or body
    return Joint(name, "prismatic", parent, body, (Slide(axis, (name,)),), axis=axis, **where)


def universal(parent: str, body: str, axis: Vector = X, second: Vector = Y, name: str = "", **where: Any) -> Joint:
    """A Hooke's joint: a turn about `axis`, which the parent holds, then about `second`, which the body holds."""
    name = name or body
    motions = (Turn(axis, (f"{name}.1",)), Turn(second, (f"{name}.2",)))
    return Joint(name, "universal", parent, body, motions, axis=axis, second=second, **where)


def ball(parent: str, body: str, rotation: str = "quaternion", name: str = "", **where: Any) -> Joint:
    """A ball joint. `rotation`: "quaternion", from the parent; "attitude", a quaternion from the ground; axes of Euler angles
    such as "zxz", each turned by the ones before it; or "axis", the direction, as seen from the ground, of the axis z of a rod
    or of another symmetric body that does not turn about it. To what hangs on such a body, it is a frame that does not turn."""
    name = name or body
    return Joint(name, "ball", parent, body, rotations(rotation, name), **where)


def free(parent: str, body: str, rotation: str = "quaternion", name: str = "", **where: Any) -> Joint:
    """No constraint: x, y, z of the body's frame and its rotation, as of `ball`."""
    name = name or body
    slides = tuple(Slide(AXES[x], (f"{name}.{x}",)) for x in "xyz")
    return Joint(name, "free", parent, body, (*slides, *rotations(rotation, name)), **where)


def planar(parent: str, body: str, axis: Vector = Z, name: str = "", **where: Any) -> Joint:
    """In the plane across `axis`: two lengths and an angle. For the axis z they are x, y and the angle from x."""
    name = name or body
    first, second = across(axis)
    motions = (Slide(first, (f"{name}.x",)), Slide(second, (f"{name}.y",)), Turn(axis, (f"{name}.angle",)))
    return Joint(name, "planar", parent, body, motions, axis=axis, **where)


def gliding(
    parent: str, body: str, height: Callable, distance: float, rotation: str = "quaternion", name: str = "", **where: Any
) -> Joint:
    """A body whose origin stays at a `distance` from the surface z = height(x, y): coordinates x, y of the point below it, and
    its rotation, as of `ball`. A ball of that radius touches the surface there."""
    name = name or body
    motions = (Glide(height, distance, (f"{name}.x", f"{name}.y")), *rotations(rotation, name))
    return Joint(name, "gliding", parent, body, motions, **where)


def rolling_wheel(
    parent: str,
    body: str,
    radius: float,
    tube: float = 0.0,
    name: str = "",
    height: Callable | None = None,
    **where: Any,
) -> Joint:
    """A wheel that touches the plane z = 0, or the surface z = height(x, y): x and y of the point of contact, the yaw of its
    heading about the normal, the roll about the heading, and the spin about its axle, the axis y of the body. `radius` is that
    of the circle that its rim is around, `tube` that of the rim."""
    name = name or body
    x, y = f"{name}.x", f"{name}.y"
    on_plane: tuple[Motion, ...] = (Slide(X, (x,)), Slide(Y, (y,)))
    motions = (
        *(on_plane if height is None else (Glide(height, 0.0, (x, y), leans=True),)),
        Turn(Z, (f"{name}.yaw",)),
        Shift((0.0, 0.0, tube)),
        Turn(X, (f"{name}.roll",)),
        Shift((0.0, 0.0, radius)),
        Turn(Y, (f"{name}.spin",)),
    )
    return Joint(name, "rolling wheel", parent, body, motions, **where)


def rotations(rotation: str, name: str) -> tuple[Motion, ...]:
    """The motions of a rotation; raises `ValueError` for one that is not known."""
    if rotation == "axis":
        return (Direct(tuple(f"{name}.{part}" for part in ("ux", "uy", "uz"))),)
    if rotation in ("quaternion", "attitude"):
        return (Quaternion(tuple(f"{name}.{part}" for part in ("qw", "qx", "qy", "qz")), rotation == "attitude"),)
    if not isinstance(rotation, str) or len(rotation) != 3 or set(rotation) - set("xyz"):
        raise ValueError(
            'rotation must be "quaternion", "attitude", "axis", or three axes of Euler angles such as "zxz" or "zxy", '
            f"but {rotation!r} was given."
        )
    if rotation[0] == rotation[1] or rotation[1] == rotation[2]:
        raise ValueError(f"rotation {rotation!r} turns about the same axis twice running: no three angles of a rotation.")
    again = rotation[0] == rotation[2]
    angles = ("precession", "nutation", "spin") if again else tuple(ANGLES[axis] for axis in rotation)
    return tuple(Turn(AXES[axis], (f"{name}.{angle}",)) for axis, angle in zip(rotation, angles, strict=True))


ANGLES = {"x": "roll", "y": "pitch", "z": "yaw"}
"""Names of angles about three different axes."""


def norm_defect(q: Any) -> Any:
    """(|Q|² − 1)/2."""
    return (q @ q - 1.0) / 2


def stacked(values: Sequence[Any]) -> Any:
    """Scalars as one array."""
    return jnp.stack([jnp.asarray(value, float) for value in values])
