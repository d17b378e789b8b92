"""What is wrong with a model: one error for each mistake, which names the body or the joint and the way out."""

from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np

from dirax.bodies.joints import Joint
from dirax.bodies.parts import Body

GROUND = "ground"

SYMMETRIC = 1e-9
"""Relative to the largest entry of an inertia: what its entries beside the diagonal may differ."""

MASSLESS = 1e-13
"""Relative to the largest moment of inertia: what is none."""

MEASURED = 1e-6
"""Relative to the largest moment of inertia: what measured ones may be off."""


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
        if getattr(force, "between", None) is None and not force.coordinate:
            raise ValueError(f"{force.name!r} acts nowhere: give it between=((body, point), (body, point)) or coordinate=.")
        if getattr(force, "between", None) is None and force.coordinate not in names:
            raise ValueError(f"{force.name!r} is at coordinate {force.coordinate!r}, but the coordinates are {', '.join(names)}.")


def check_turns(model: Any) -> None:
    """Raise `ValueError` for a body that turns in all ways, with no moment of inertia about an axis, where nothing else keeps it
    from turning about that: no equation says how it does."""
    for body in model.bodies:
        joint = next(joint for joint in model.tree if joint.body == body.name)
        others = {name for other in model.joints if other is not joint for name in (other.parent, other.body)}
        others |= {contact.body for contact in model.contacts}
        numbers = (body.mass, *body.centre, *joint.on, *np.ravel(np.asarray(body.inertia, dtype=object)))
        if joint.kind not in ("ball", "free", "gliding") or joint.is_axis or body.name in others:
            continue
        if any(isinstance(x, str) for x in numbers) or body.mass == 0:
            continue
        arm = np.asarray(body.centre, float) - np.asarray(joint.on, float) if joint.kind == "ball" else np.zeros(3)
        about = np.asarray(body.inertia_matrix(None), float) + float(body.mass) * (arm @ arm * np.eye(3) - np.outer(arm, arm))
        moments = np.linalg.eigvalsh(about)
        if moments[0] <= MASSLESS * moments[2]:
            raise ValueError(
                f"body {body.name!r} has no moment of inertia about an axis through joint {joint.name!r}, and can turn about it, "
                f"so that nothing says how it does: its moments there are {moments}. Give it one, or the joint "
                'rotation="axis", the direction of its axis z alone.'
            )


def check_masses(model: Any) -> None:
    """Raise `ValueError` for masses and moments of inertia that no body has, and for joints of a tree that move no mass."""
    for body in model.bodies:
        if isinstance(body.mass, str) or any(isinstance(x, str) for x in np.ravel(np.asarray(body.inertia, dtype=object))):
            continue
        if np.shape(body.inertia) not in ((3,), (3, 3)):
            raise ValueError(
                f"the inertia of body {body.name!r} must be three principal moments or a matrix (3, 3), but its shape is "
                f"{np.shape(body.inertia)}."
            )
        mass, inertia = float(body.mass), np.asarray(body.inertia_matrix(None), float)
        stated = np.asarray(body.inertia, float)
        if stated.ndim == 2 and not np.all(np.abs(stated - stated.T) <= SYMMETRIC * np.abs(stated).max()):
            raise ValueError(f"the inertia of body {body.name!r} must be a symmetric matrix, but it is not.")
        moments = np.linalg.eigvalsh(inertia)
        size = max(abs(moments).max(), 1e-300)
        if mass < 0 or moments[0] < -1e-9 * size:
            raise ValueError(f"body {body.name!r} has a negative mass or moment of inertia: {mass:g}, {moments}.")
        if moments[1] > 1e-9 * size and moments[2] - moments[0] - moments[1] > MEASURED * size:
            raise ValueError(
                f"no body has the moments of inertia {moments} of {body.name!r}: none is larger than the other two together. Of "
                "one that turns in a plane state the moment across it alone, (0, 0, J)."
            )
        if mass == 0 and np.any(inertia != 0):
            raise ValueError(
                f"body {body.name!r} has no mass, but moments of inertia {moments}: a body without mass has none. Give it a "
                "mass, or leave out its inertia."
            )
    weighs = {body.name for body in model.bodies if body.mass != 0}
    for joint in reversed(model.tree):
        weighs |= {joint.parent} if joint.body in weighs else set()
        if joint.coordinates and joint.body not in weighs and not any(other.closes for other in model.joints):
            raise ValueError(
                f"joint {joint.name!r} moves nothing that has a mass: give one to body {joint.body!r} or to what hangs "
                "on it, or make the joint fixed()."
            )


def check_axes(model: Any) -> None:
    """Raise `ValueError` for bodies by their axis that need more than it: other points, moments of inertia, joints, contacts."""
    for joint in model.tree:
        if joint.is_axis:
            body = next(body for body in model.bodies if body.name == joint.body)
            for what, wrong in _beside(model, body, joint):
                if wrong:
                    raise ValueError(
                        f'body {body.name!r} is stated by its axis z alone (rotation="axis"), but {what}. Put it on that axis, '
                        'or take rotation="quaternion".'
                    )


def _beside(model: Any, body: Body, own: Joint) -> list[tuple[str, bool]]:
    """What of a model would need more of a body than its axis, and whether it does."""
    off = lambda x: x[0] != 0 or x[1] != 0
    inertia = np.asarray(body.inertia, dtype=object)
    moments = inertia if inertia.ndim == 1 else inertia.diagonal()
    found = [
        ("its mass centre is beside it", off(body.centre)),
        ("its moments of inertia across it differ", moments[0] != moments[1]),
        ("it has products of inertia", inertia.ndim == 2 and any(inertia[k, j] != 0 for k, j in ((0, 1), (0, 2), (1, 2)))),
    ]
    for joint in model.joints:
        if body.name in (joint.parent, joint.body):
            at = joint.at if joint.parent == body.name else joint.on
            found.append((f"joint {joint.name!r} is beside it", off(at)))
            held = joint.kind == "ball" if joint.closes else joint is own or joint.kind in ("ball", "free")
            found.append((f"joint {joint.name!r} is {joint.kind}, which holds more of it", not held))
    for contact in model.contacts:
        if contact.body == body.name:
            point = getattr(contact.shape, "radius", 1) == 0 and contact.shape.tube == 0 and contact.motion != "skates"
            found.append((f"contact {contact.name!r} is beside it", off(contact.centre)))
            found.append((f"contact {contact.name!r} is no tip() of it that may spin", not (point and contact.spins)))
    for force in model.forces:
        ends = [at for name, at in getattr(force, "between", None) or () if name == body.name]
        found.append((f"{force.name!r} is beside it", any(off(at) for at in ends)))
    return found
