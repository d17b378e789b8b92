"""Machines of `dx.bodies` in pinocchio: its algorithm for articulated bodies, and its dynamics with the loops as constraints.

pinocchio computes accelerations and has no integrator: Runge and Kutta's of order four is written here in Python around it.
"""

import time
from collections.abc import Callable
from typing import Any

import numpy as np

from dirax.diagnostics.bench.hinges import branch_by_branch, closing_points, entry, is_hinged, joint_frames

is_stated = is_hinged

ACCURACY, REGULAR, MOST = 1e-12, 1e-8, 50
"""Of its proximal iteration, which redundant constraints need: weaker ones, and Baumgarte's corrections, make Bricard's mechanism
worse or break it."""


def built(machine: Any) -> tuple[Any, Any, dict[str, int]]:
    """The machine as pinocchio's model, the constraints of its loops, and its joints by body."""
    import pinocchio as pin

    model, starts, made, loops = pin.Model(), joint_frames(machine), {"ground": 0}, pin.StdVec_RigidConstraintModel()
    model.gravity.linear = np.asarray(machine.gravity, float)
    bodies = {body.name: body for body in machine.bodies}
    at = lambda x: pin.SE3(np.eye(3), x)
    for joint in branch_by_branch(machine):
        kind = pin.JointModelRevoluteUnaligned if joint.kind == "revolute" else pin.JointModelPrismaticUnaligned
        axis = np.asarray(joint.axis, float)
        place = at(np.asarray(joint.at, float) + starts[joint.parent])
        k = model.addJoint(made[joint.parent], kind(axis / np.linalg.norm(axis)), place, joint.body)
        body = bodies[joint.body]
        weight = pin.Inertia(float(body.mass), np.asarray(body.centre) + starts[body.name], np.array(body.inertia_matrix(None)))
        model.appendBodyToJoint(k, weight, pin.SE3.Identity())
        made[joint.body] = k
    for (one, first), (other, second) in closing_points(machine):
        kind = pin.ContactType.CONTACT_3D
        loops.append(pin.RigidConstraintModel(kind, model, made[one], at(first), made[other], at(second), pin.LOCAL))
    return model, loops, made


def acceleration(model: Any, loops: Any) -> tuple[Callable, Any]:
    """The function (q, v) of the accelerations, and the data that it fills."""
    import pinocchio as pin

    data, still = model.createData(), np.zeros(model.nv)
    if len(loops) == 0:
        return lambda q, v: pin.aba(model, data, q, v, still), data
    held, settings = pin.StdVec_RigidConstraintData(), pin.ProximalSettings(ACCURACY, REGULAR, MOST)
    for loop in loops:
        held.append(loop.createData())
    pin.initConstraintDynamics(model, data, loops, held)
    return lambda q, v: pin.constraintDynamics(model, data, q, v, still, loops, held, settings), data


def measured(example: Any, steps: int, end: np.ndarray, repeats: int) -> str:
    """µs a step, the distance of q at the end from `end`, the range of the energy relative to the largest, and the largest gap of
    a loop, by steps of order four of the example's size."""
    import pinocchio as pin

    model, loops, made = built(example.model)
    rate, data = acceleration(model, loops)
    order = np.array([model.joints[made[joint.body]].idx_q for joint in example.model.joints if not joint.closes])
    start = np.empty(model.nq), np.empty(model.nv)
    start[0][order], start[1][order] = example.initial["q"], example.initial["v"]
    h = example.step

    def following(q: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        a1 = rate(q, v).copy()
        v2 = v + h / 2 * a1
        a2 = rate(q + h / 2 * v, v2).copy()
        v3 = v + h / 2 * a2
        a3 = rate(q + h / 2 * v2, v3).copy()
        v4 = v + h * a3
        a4 = rate(q + h * v3, v4)
        return q + h / 6 * (v + 2 * v2 + 2 * v3 + v4), v + h / 6 * (a1 + 2 * a2 + 2 * a3 + a4)

    seconds, (q, v) = [], start
    for _ in range(repeats):
        (q, v), before = start, time.process_time()
        for _ in range(steps):
            q, v = following(q, v)
        seconds.append(time.process_time() - before)
    error, (q, v), energies, gap = np.abs(q[order] - end).max(), start, [], 0.0
    points = closing_points(example.model)
    for _ in range(steps):
        q, v = following(q, v)
        energies.append(pin.computeMechanicalEnergy(model, data, q, v))
        for (one, first), (other, second) in points:
            apart = data.oMi[made[one]].act(first) - data.oMi[made[other]].act(second)
            gap = max(gap, np.abs(apart).max())
    return entry(min(seconds) / steps, error, energies, gap if len(loops) else None)
