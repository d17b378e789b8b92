"""What is wrong with a model: one error for each mistake, which names the body or the joint and the way out."""

from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np

from dirax.bodies.joints import Joint
from dirax.bodies.parts import Body

GROUND = "ground"


def sorted_tree(bodies: Sequence[Body], joints: Sequence[Joint]) -> tuple[Joint, ...]:
    """The joints of the tree, parents first. Raises `ValueError` for a body that has no way to the ground, or two of them."""
    parents: dict[str, Joint] = {}
    for joint in joints:
        if joint.closes:
            continue
        if (other := parents.get(joint.body)) is not None:
            raise ValueError(
                f"body {joint.body!r} has two parents: {other.parent!r} by joint {other.name!r} and {joint.parent!r} by joint "
                f"{joint.name!r}. Give one of the joints closes=True, which makes it the constraint that closes the loop."
            )
        parents[joint.body] = joint
    for body in bodies:
        if body.name not in parents:
            raise ValueError(
                f"body {body.name!r} has no joint that it hangs on: add one, such as free('ground', {body.name!r}) if nothing "
                "holds it."
            )
    placed, found = {GROUND}, []
    while len(found) < len(parents):
        ready = [joint for joint in parents.values() if joint.parent in placed and joint.body not in placed]
        if not ready:
            circle = ", ".join(repr(joint.name) for joint in parents.values() if joint.body not in placed)
            raise ValueError(
                f"the joints {circle} go round in a circle and never reach the ground: hang one of the bodies on the ground, "
                "and give the joint that closes the loop closes=True."
            )
        found += ready
        placed |= {joint.body for joint in ready}
    return tuple(found)


def check_names(model: Any) -> None:
    """Raise `ValueError` for names twice, and for names of bodies, coordinates and parameters that there are not."""
    for kind, names in (
        ("bodies", [body.name for body in model.bodies]),
        ("joints", [joint.name for joint in model.joints]),
        ("contacts", [contact.name for contact in model.contacts]),
    ):
        twice = [name for name, count in Counter(names).items() if count > 1]
        if twice:
            raise ValueError(f"two {kind} are called {twice[0]!r}: give each a name= of its own.")
    known = {GROUND} | {body.name for body in model.bodies}
    if len(known) <= len(model.bodies):
        raise ValueError('a body is called "ground", which is the name of what does not move: give it another.')
    used = [(f"joint {joint.name!r}", name) for joint in model.joints for name in (joint.parent, joint.body)]
    used += [(f"contact {contact.name!r}", contact.body) for contact in model.contacts]
    used += [(f"{force.name!r}", end[0]) for force in model.forces for end in (getattr(force, "between", None) or ())]
    for what, name in used:
        if name not in known:
            raise ValueError(f"{what} is at body {name!r}, but the bodies are {', '.join(sorted(known))}.")
    for joint in model.joints:
        if joint.body == GROUND and not joint.closes:
            raise ValueError(f"joint {joint.name!r} moves the ground: its parent and its body are the wrong way round.")
        if joint.closes and not joint.conditions:
            raise ValueError(f"joint {joint.name!r} is {joint.kind}, which demands nothing of a loop: leave closes= out.")


def check_coordinates(model: Any) -> None:
    """Raise `ValueError` for two coordinates of one name, and for forces at one that there is not."""
    names = model.coordinates
    twice = [name for name, count in Counter(names).items() if count > 1]
    if twice:
        raise ValueError(f"two coordinates are called {twice[0]!r}: give one of the joints a name= of its own.")
    if not names:
        raise ValueError("the model has no coordinates: nothing can move. Give a body a joint that is not fixed.")
    for force in model.forces:
        if getattr(force, "between", None) is None and force.coordinate not in names:
            raise ValueError(f"{force.name!r} is at coordinate {force.coordinate!r}, but the coordinates are {', '.join(names)}.")


def check_masses(model: Any) -> None:
    """Raise `ValueError` for masses and moments of inertia that no body has."""
    for body in model.bodies:
        if isinstance(body.mass, str) or any(isinstance(x, str) for x in np.ravel(np.asarray(body.inertia, dtype=object))):
            continue
        mass, inertia = float(body.mass), np.asarray(body.inertia_matrix(None), float)
        if inertia.shape != (3, 3) or np.shape(body.inertia) not in ((3,), (3, 3)):
            raise ValueError(
                f"the inertia of body {body.name!r} must be three principal moments or a matrix (3, 3), but its shape is "
                f"{np.shape(body.inertia)}."
            )
        if np.any(inertia != inertia.T):
            raise ValueError(f"the inertia of body {body.name!r} must be a symmetric matrix, but it is not.")
        moments = np.linalg.eigvalsh(inertia)
        size = max(abs(moments).max(), 1e-300)
        if mass < 0 or moments[0] < -1e-9 * size:
            raise ValueError(f"body {body.name!r} has a negative mass or moment of inertia: {mass:g}, {moments}.")
        if mass == 0 and np.any(inertia != 0):
            raise ValueError(
                f"body {body.name!r} has no mass, but moments of inertia {moments}: a body without mass has none. Give it a "
                "mass, or leave out its inertia."
            )
