"""What is wrong with the numbers of a model: vectors that are none, axes without a direction, parameters that there are not."""

import inspect
from collections.abc import Iterator
from typing import Any

import numpy as np

from dirax.bodies.contacts import Contact, Ellipsoid, Round
from dirax.bodies.forces import Damper, Motor, Spring
from dirax.bodies.joints import Joint
from dirax.bodies.motion import Glide, Shift, Slide, Turn
from dirax.bodies.parts import Body
from dirax.program.signatures import refuse_other_places
from dirax.program.user_functions import is_traced

KINDS = {"bodies": (Body,), "joints": (Joint,), "contacts": (Contact,), "forces": (Spring, Damper, Motor)}
MOTIONS = ("rolls", "skates", "slides")


def check_kinds(model: Any) -> None:
    """Raise `TypeError` for parts that are no bodies, joints, contacts and forces."""
    for name, kinds in KINDS.items():
        parts = getattr(model, name)
        wrong = [part for part in parts if not isinstance(part, kinds)] if isinstance(parts, list | tuple) else [parts]
        if wrong:
            called = ", ".join(kind.__name__ for kind in kinds)
            raise TypeError(f"{name} must be a list of {called}, but {wrong[0]!r} came.")


def check_untraced(model: Any) -> None:
    """Raise `TypeError` for values that JAX traces: a model is checked and assembled by its numbers."""
    for part in (*model.bodies, *model.joints, *model.contacts, *model.forces, model):
        for name, value in vars(part).items():
            if is_traced(value):
                kind = type(part).__name__.lower()
                own = "" if part is model else f" of {kind} {getattr(part, 'name', '')!r}"
                raise TypeError(
                    f"{name}{own} is a value that JAX traces, but a model is made of numbers: write the name of one of its "
                    f"parameters, {name}={name!r} and parameters={{{name!r}: 1.0}}, and hand the value over to the run, "
                    f"params={{{name!r}: …}}."
                )


def check_numbers(model: Any) -> None:
    """Raise `ValueError` for numbers that mean nothing, and for names of parameters that the model has not."""
    for what, values in _vectors(model):
        if np.shape(values) != (3,):
            raise ValueError(f"{what} must be three numbers, but it is {values!r}.")
        _check_all(model, what, values)
    for what, value in _scalars(model):
        if np.ndim(value) != 0 or callable(value):
            raise ValueError(f"{what} must be a number or the name of a parameter, but it is {value!r}.")
        _check_all(model, what, [value])
    for what, axis in _axes(model):
        if np.shape(axis) != (3,) or any(isinstance(x, str) for x in axis) or not np.linalg.norm(np.asarray(axis, float)) > 0:
            raise ValueError(f"{what} must be a direction, three numbers that are not all zero, but it is {axis!r}.")
    for contact in model.contacts:
        if contact.motion not in MOTIONS:
            raise ValueError(
                f"motion of contact {contact.name!r} must be one of {', '.join(MOTIONS)}, but it is {contact.motion!r}."
            )
        sizes = contact.shape.semi_axes if isinstance(contact.shape, Ellipsoid) else (contact.shape.radius, contact.shape.tube)
        if any(not isinstance(x, str) and x < 0 for x in sizes):
            raise ValueError(f"contact {contact.name!r} has a negative radius among {sizes}.")
        _check_its_joint(model, contact)
    for force in model.forces:
        if not isinstance(force, Motor) or not callable(force.push):
            continue
        if len(inspect.signature(force.push).parameters) not in (3, 4):
            raise ValueError(f"the push of {force.name!r} must be a function of (t, q, v) or of (t, q, v, params).")
        refuse_other_places(force.push, f"the push of {force.name!r}", "push(t, q, v[, params])", ("t", "q", "v"))


def _check_all(model: Any, what: str, values: Any) -> None:
    for value in values:
        if isinstance(value, str):
            if value not in model.parameters:
                known = ", ".join(model.parameters) or "none"
                raise ValueError(f"{what} is {value!r}, which is no parameter of the model: there are {known}.")
        elif not np.isfinite(float(value)):
            raise ValueError(f"{what} must be finite, but it is {value!r}.")


def _vectors(model: Any) -> Iterator[tuple[str, Any]]:
    yield "gravity", model.gravity
    for body in model.bodies:
        yield f"the mass centre of body {body.name!r}", body.centre
        if np.shape(body.inertia) == (3,):
            yield f"the inertia of body {body.name!r}", body.inertia
    for joint in model.joints:
        yield f"at= of joint {joint.name!r}", joint.at
        yield f"on= of joint {joint.name!r}", joint.on
    for contact in model.contacts:
        yield f"the centre of contact {contact.name!r}", contact.centre
        yield f"the ground of contact {contact.name!r}", contact.ground
    for force in model.forces:
        for name, at in getattr(force, "between", None) or ():
            yield f"the end of {force.name!r} at {name!r}", at


def _axes(model: Any) -> Iterator[tuple[str, Any]]:
    for joint in model.joints:
        for motion in joint.motions:
            if isinstance(motion, Slide | Turn):
                yield f"an axis of joint {joint.name!r}", motion.axis
    for contact in model.contacts:
        yield f"normal= of contact {contact.name!r}", contact.normal
        yield f"along= of contact {contact.name!r}", contact.along
        if isinstance(contact.shape, Round):
            yield f"the axis of contact {contact.name!r}", contact.shape.axis


def _scalars(model: Any) -> Iterator[tuple[str, Any]]:
    for body in model.bodies:
        yield f"the mass of body {body.name!r}", body.mass
    for contact in model.contacts:
        yield f"the drag of contact {contact.name!r}", contact.drag
        yield f"the friction of contact {contact.name!r}", contact.friction
        yield f"the creep of contact {contact.name!r}", contact.creep
    for force in model.forces:
        names = {Spring: ("stiffness", "length"), Damper: ("rate",), Motor: ("push",)}[type(force)]
        for name in names:
            if not callable(getattr(force, name)):
                yield f"the {name} of {force.name!r}", getattr(force, name)


def _check_its_joint(model: Any, contact: Contact) -> None:
    """A contact on a body that its joint keeps on the ground touches where the joint says."""
    joint = next(joint for joint in model.tree if joint.body == contact.body)
    value, shape = (lambda x: model.parameters[x] if isinstance(x, str) else x), contact.shape
    at_origin = not any(value(x) != 0 for x in contact.centre)
    if joint.kind == "gliding":
        (distance,) = (motion.distance for motion in joint.motions if isinstance(motion, Glide))
        same = isinstance(shape, Round) and (value(shape.radius), value(shape.tube)) == (0, distance)
        expected = f"ball of radius {distance} around"
    elif joint.kind == "rolling wheel":
        tube, radius = (motion.by[2] for motion in joint.motions if isinstance(motion, Shift))
        same = (
            isinstance(shape, Round)
            and shape.axis[0] == shape.axis[2] == 0
            and (value(shape.radius), value(shape.tube)) == (radius, tube)
        )
        expected = f"wheel of radius {radius} and tube {tube} about the axis y in"
    else:
        return
    if not (same and at_origin):
        raise ValueError(
            f"contact {contact.name!r} is not the {expected} the origin of its body, which joint {joint.name!r} keeps on the "
            "ground: give both the same numbers, or let the body hang on the ground by free()."
        )
