"""Machines of `dx.bodies` in Exudyn: every body with its own position and Euler parameters, joints and rolling as constraints."""

import time
from typing import Any

import numpy as np

from dirax.text.tables import number

KINDS = ("revolute", "prismatic", "ball", "free")
UP = [0.0, 0.0, 1.0]


def is_stated(model: Any) -> bool:
    """Whether the machine is one of hinges, slides, balls and thin wheels on level ground, which is what is written here."""
    if model is None or model.forces or model.parameters or model.dropped or any(body.mass == 0 for body in model.bodies):
        return False
    joints = all(joint.kind in KINDS and joint.turned is None and not joint.is_axis for joint in model.joints)
    return joints and all(contact.is_thin_wheel for contact in model.contacts)


def built(example: Any) -> tuple[Any, dict[str, Any]]:
    """The machine at the example's initial data as Exudyn's `MainSystem`, and its bodies by name."""
    import exudyn
    from exudyn.rigidBodyUtilities import RigidBodyInertia

    model = example.model
    frames = model.frames(np.asarray(example.initial["q"], float), np.asarray(example.initial["v"], float))
    mbs = exudyn.SystemContainer().AddSystem()
    made = {"ground": mbs.CreateGround()}
    for body in model.bodies:
        frame, centre = frames[body.name], np.asarray(body.centre, float)
        turn, spin = np.array(frame.turn), np.array(frame.spin)
        made[body.name] = mbs.CreateRigidBody(
            inertia=RigidBodyInertia(body.mass, np.array(body.inertia_matrix(None)), np.zeros(3)),
            referencePosition=np.array(frame.point(centre)),
            referenceRotationMatrix=turn,
            initialVelocity=np.array(frame.velocity) + np.cross(spin, turn @ centre),
            initialAngularVelocity=spin,
            gravity=list(map(float, model.gravity)),
        )
    for joint in model.joints:
        pair, parent = [made[joint.parent], made[joint.body]], frames[joint.parent]
        place = {"position": np.array(parent.point(np.asarray(joint.at, float))), "useGlobalFrame": True, "show": False}
        if joint.kind == "ball":
            mbs.CreateSphericalJoint(itemNumbers=pair, **place)
        elif joint.kind != "free":
            create = mbs.CreateRevoluteJoint if joint.kind == "revolute" else mbs.CreatePrismaticJoint
            create(itemNumbers=pair, axis=np.array(parent.turn) @ np.asarray(joint.axis, float), **place)
    centres = {body.name: np.asarray(body.centre, float) for body in model.bodies}
    for contact in model.contacts:
        axle = np.asarray(contact.centre, float) - centres[contact.body]
        mbs.CreateRollingDisc(
            bodyNumbers=[made["ground"], made[contact.body]],
            axisPosition=axle,
            axisVector=np.asarray(contact.shape.axis, float),
            discRadius=float(contact.shape.radius),
            planePosition=[0.0, 0.0, 0.0],
            planeNormal=UP,
            show=False,
        )
    mbs.Assemble()
    return mbs, made


def measured(example: Any, steps: int, end: np.ndarray, repeats: int) -> str:
    """µs a step, how far mass centres are at the end from those at the coordinates `end`, and the relative change of the energy:
    by its trapezoidal rule of index 2 with the example's step."""
    import exudyn

    settings, seconds = exudyn.SimulationSettings(), []
    settings.timeIntegration.numberOfSteps, settings.timeIntegration.endTime = steps, steps * example.step
    settings.timeIntegration.verboseMode = 0
    settings.solution.file.write = False
    settings.linearSolver.solverType = exudyn.LinearSolverType.EigenDense
    settings.linearSolver.ignoreSingularJacobian = True
    mbs, made = built(example)
    before = _energy(example.model, mbs, made)
    for _ in range(repeats):
        mbs, made = built(example)
        began = time.process_time()
        try:
            mbs.SolveDynamic(settings, solverType=exudyn.DynamicSolverType.TrapezoidalIndex2)
        except exudyn.SolverError:
            return "fails: its solver ends before the time"
        seconds.append(time.process_time() - began)
    frames = example.model.frames(end, np.zeros_like(end))
    place = lambda body: mbs.GetObjectOutputBody(made[body.name], exudyn.OutputVariableType.Position, [0.0, 0.0, 0.0])
    apart = [np.array(frames[b.name].point(np.asarray(b.centre, float))) - place(b) for b in example.model.bodies]
    drift = abs(_energy(example.model, mbs, made) - before) / abs(before)
    return f"{number(1e6 * min(seconds) / steps)} µs, apart {number(np.abs(apart).max(), 2)}, energy {number(drift, 2)}"


def _energy(model: Any, mbs: Any, made: dict[str, Any]) -> float:
    import exudyn

    total, kinds = 0.0, exudyn.OutputVariableType
    for body in model.bodies:
        read = lambda kind, body=body: np.array(mbs.GetObjectOutputBody(made[body.name], kind, [0.0, 0.0, 0.0]))
        speed, spin = read(kinds.Velocity), read(kinds.AngularVelocityLocal)
        turning = spin @ np.asarray(body.inertia_matrix(None)) @ spin
        total += (body.mass * speed @ speed + turning) / 2 - body.mass * np.asarray(model.gravity, float) @ read(kinds.Position)
    return float(total)
