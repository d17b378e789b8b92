"""Machines of `dx.bodies` in MuJoCo: the same bodies, hinges and slides, the hinge of a loop by equalities of two points."""

import time
from typing import Any
from xml.etree.ElementTree import Element, SubElement, tostring

import numpy as np

from dirax.diagnostics.bench.hinges import MOTIONS, closing_points, is_hinged, joint_frames
from dirax.text.tables import number

is_stated = is_hinged

THIN = 1e-9
"""Of the largest moment of inertia: the smallest that a body there may have."""

STIFF = "2e-3 1"
"""Time constant (s) and damping of loops (`solref`); MuJoCo takes two steps where that is longer."""


def mjcf(model: Any, step: float) -> str:
    """The machine as MuJoCo's XML."""
    root = Element("mujoco")
    gravity = " ".join(map(str, model.gravity))
    SubElement(root, "option", timestep=str(step), integrator="RK4", gravity=gravity, tolerance="1e-15", iterations="200")
    elements = {"ground": SubElement(root, "worldbody")}
    bodies = {body.name: body for body in model.bodies}
    starts = joint_frames(model)
    for joint in model.tree:
        place = np.asarray(joint.at, float) + starts[joint.parent]
        elements[joint.body] = e = SubElement(elements[joint.parent], "body", name=joint.body, pos=_text(place))
        SubElement(e, "joint", name=joint.name, type=MOTIONS[joint.kind], axis=_text(joint.axis))
        body = bodies[joint.body]
        inertia = np.asarray(body.inertia_matrix(None), float)
        inertia = inertia + max(THIN * np.abs(inertia).max(), 1e-12) * np.eye(3)
        full = _text(inertia[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]])
        SubElement(e, "inertial", pos=_text(np.asarray(body.centre) + starts[body.name]), mass=str(body.mass), fullinertia=full)
    loops = SubElement(root, "equality")
    for k, ends in enumerate(closing_points(model)):
        names = [f"end {k}.{end}" for end in (1, 2)]
        for name, (body, at) in zip(names, ends, strict=True):
            SubElement(elements[body], "site", name=name, pos=_text(at))
        SubElement(loops, "connect", site1=names[0], site2=names[1], solref=STIFF)
    return tostring(root, encoding="unicode")


def _text(values: Any) -> str:
    return " ".join(map(repr, np.asarray(values, float).tolist()))


def measured(example: Any, steps: int, end: np.ndarray, repeats: int) -> str:
    """µs a step, the distance of q at the end from `end`, and the largest gap of a loop, by RK4 with the example's step."""
    import mujoco

    model, names = mujoco.MjModel.from_xml_string(mjcf(example.model, example.step)), example.model.coordinates
    places = [mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_JOINT, name) for name in names]

    def started() -> Any:
        data = mujoco.MjData(model)
        data.qpos[places], data.qvel[places] = example.initial["q"], example.initial["v"]
        return data

    seconds, data = [], started()
    for _ in range(repeats):
        data, before = started(), time.process_time()
        mujoco.mj_step(model, data, nstep=steps)
        seconds.append(time.process_time() - before)
    q, data, gap = np.array(data.qpos[places]), started(), 0.0
    for _ in range(steps):
        mujoco.mj_step(model, data)
        gap = max(gap, np.abs(data.efc_pos).max(initial=0.0))
    return f"{number(1e6 * min(seconds) / steps)} µs, error {number(np.abs(q - end).max(), 2)}, loops {number(gap, 2)}"
