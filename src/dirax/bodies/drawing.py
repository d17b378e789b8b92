"""The scene of a machine for reports: bodies, wheels, balls, springs and the ground, from the model alone."""

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import numpy as np

from dirax.bodies.contacts import Ellipsoid, Round
from dirax.bodies.forces import Spring
from dirax.bodies.frames import scalar, unit, vector
from dirax.show.scene import Part, Reading, Scene, ball, disk, plane, point, rod, spring

POINT, ROD = 0.05, 0.02
"""Radii of mass centres and of rods, in units of the machine's size: a report would take them from how far it goes."""


def scene_of(model: Any, view: str = "oblique", trail: str = "") -> Scene:
    """Rods from where a body hangs to its mass centre and to the bodies that hang on it; `trail` names a body whose mass centre
    leaves one."""
    frames = _frames(model)
    parts: list[Part] = [plane()] if model.contacts else []
    small, thin = (share * _size(model) or None for share in (POINT, ROD))
    drawn = {contact.body for contact in model.contacts if _is_round(contact.shape)}
    for contact in model.contacts:
        parts += _contact(model, frames, contact)
    for body in model.bodies:
        centre = _place(frames, body.name, body.centre)
        if body.name not in drawn or np.any(np.asarray(body.centre) != 0):
            parts.append(point(centre, small, trail=body.name == trail))
        if np.any(np.asarray(body.centre) != 0):
            parts.append(rod(_place(frames, body.name, (0.0, 0.0, 0.0)), centre, thin))
    for joint in model.joints:
        if joint.parent != "ground" and np.any(np.asarray(joint.at) != 0):
            parts.append(rod(_place(frames, joint.parent, (0.0, 0.0, 0.0)), _place(frames, joint.parent, joint.at), thin))
        if np.any(np.asarray(joint.on) != 0):
            parts.append(rod(_place(frames, joint.body, (0.0, 0.0, 0.0)), _place(frames, joint.body, joint.on), thin))
    for force in model.forces:
        if isinstance(force, Spring) and force.between is not None:
            first, second = force.between
            parts.append(spring(_place(frames, *first), _place(frames, *second)))
    return Scene(tuple(parts), view=view)


def _size(model: Any) -> float:
    """The longest way inside a body, from where it hangs to its mass centre, to what hangs on it, or to its rim."""
    moving = {body.name for body in model.bodies}
    inside = [body.centre for body in model.bodies] + [joint.on for joint in model.joints]
    inside += [joint.at for joint in model.joints if joint.parent in moving]
    lengths = [np.linalg.norm(np.asarray(vector(x, model.parameters), float)) for x in inside]
    return float(max(lengths, default=0.0))


def _is_round(shape: Any) -> bool:
    return isinstance(shape, Ellipsoid) or shape.radius != 0 or shape.tube != 0


def _contact(model: Any, frames: Callable, contact: Any) -> list[Part]:
    if not _is_round(contact.shape):
        return []
    centre, number = _place(frames, contact.body, contact.centre), lambda x: float(scalar(x, model.parameters))
    turn = _turn(frames, contact.body)
    if isinstance(contact.shape, Ellipsoid):
        return [ball(centre, turn, radius=float(np.mean(np.asarray(vector(contact.shape.semi_axes, model.parameters)))))]
    shape: Round = contact.shape
    if isinstance(shape.radius, float | int) and shape.radius == 0:
        return [ball(centre, turn, radius=number(shape.tube))]
    upright = _from_z(unit(shape.axis))
    thick = 2 * number(shape.tube) or None
    turned = Reading(frames, lambda found, params: turn.read(found, params) @ upright)
    return [disk(centre, turned, number(shape.radius) + number(shape.tube), thick)]


def _frames(model: Any) -> Callable:
    return lambda q, params: model.frames(q, jnp.zeros_like(q), params or None)


def _place(frames: Callable, body: str, x: Any) -> Reading:
    return Reading(frames, lambda found, params: found[body].point(vector(x, params)))


def _turn(frames: Callable, body: str) -> Reading:
    return Reading(frames, lambda found, params: found[body].turn)


def _from_z(axis: np.ndarray) -> np.ndarray:
    """A rotation that takes z to the axis."""
    x, y, z = axis
    across = x * x + y * y
    if across == 0.0:
        return np.diag([1.0, z, z])
    turning = np.array([[0.0, 0.0, x], [0.0, 0.0, y], [-x, -y, 0.0]])
    return np.eye(3) + turning + turning @ turning * ((1.0 - z) / across)
