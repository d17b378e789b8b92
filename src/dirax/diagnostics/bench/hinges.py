"""Machines of hinges and slides and nothing else, which every program for machines can state."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from dirax.text.tables import number

MOTIONS = {"revolute": "hinge", "prismatic": "slide"}


def is_hinged(model: Any) -> bool:
    """Whether the machine is a tree of hinges and slides, its loops closed by hinges, under its weight alone."""
    if model is None or model.contacts or model.forces or model.parameters or model.dropped:
        return False
    trees = all(joint.kind in MOTIONS and joint.turned is None for joint in model.tree)
    return trees and all(joint.kind == "revolute" and joint.turned is None for joint in model.joints if joint.closes)


def joint_frames(model: Any) -> dict[str, np.ndarray]:
    """The origin of each body's frame in a frame that starts at its joint instead, as other programs have it (3,)."""
    return {"ground": np.zeros(3)} | {joint.body: -np.asarray(joint.on, float) for joint in model.tree}


def branch_by_branch(model: Any) -> list[Any]:
    """The joints of the tree, each with all that hangs on it before the next one begins."""
    found, waiting = [], [joint for joint in reversed(model.tree) if joint.parent == "ground"]
    while waiting:
        found.append(waiting.pop())
        waiting += [joint for joint in reversed(model.tree) if joint.parent == found[-1].body]
    return found


def closing_points(model: Any) -> list[tuple[tuple[str, np.ndarray], tuple[str, np.ndarray]]]:
    """Pairs of points that coincide where loops are closed, each of a body in the frame at its joint: two on the axis of every
    hinge, of whose six demands one follows from the others."""
    starts, found = joint_frames(model), []
    for joint in model.joints:
        if joint.closes:
            own = joint.axis if joint.axis_on is None else joint.axis_on
            ends = ((joint.body, joint.on, own), (joint.parent, joint.at, joint.axis))
            for along in (0.0, 1.0):
                out = [along * np.asarray(axis, float) / np.linalg.norm(axis) for *_, axis in ends]
                first, second = (
                    (name, np.asarray(at, float) + starts[name] + x) for (name, at, _), x in zip(ends, out, strict=True)
                )
                found.append((first, second))
    return found


def entry(seconds: float, error: float, energies: Sequence[float], gap: float | None) -> str:
    """What the table says of a program: the time of a step, the error at the end, the range of the energy beside the largest,
    and the largest gap of a loop, None where there are no loops."""
    drift = np.ptp(energies) / np.abs(energies).max()
    said = f"{number(1e6 * seconds)} µs, error {number(error, 2)}, energy {number(drift, 2)}"
    return said if gap is None else said + f", loops {number(gap, 2)}"
