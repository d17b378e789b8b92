"""Machines of `dx.bodies` in Drake's `MultibodyPlant`: trees by its Runge-Kutta integrator of order three, loops by its solver in
discrete time, which alone has constraints between points."""

import time
from typing import Any

import numpy as np

from dirax.diagnostics.bench.hinges import closing_points, entry, is_hinged, joint_frames


def is_stated(model: Any) -> bool:
    """Whether the machine is one of hinges and slides in which one hinge at most, of two moving bodies, closes a loop: with
    others the solver of Drake 1.51 ends the process."""
    closing = [joint for joint in model.joints if joint.closes] if model is not None else []
    return is_hinged(model) and len(closing) <= 1 and all(joint.parent != "ground" for joint in closing)


def built(machine: Any, step: float) -> tuple[Any, dict[str, Any], dict[str, Any]]:
    """The machine as a plant, its joints by name, and its bodies by name."""
    from pydrake.math import RigidTransform
    from pydrake.multibody.plant import DiscreteContactApproximation, MultibodyPlant
    from pydrake.multibody.tree import (
        PrismaticJoint,
        RevoluteJoint,
        RotationalInertia,
        SpatialInertia,
    )

    loops = closing_points(machine)
    plant = MultibodyPlant(step if loops else 0.0)
    if loops:
        plant.set_discrete_contact_approximation(DiscreteContactApproximation.kSap)
    plant.mutable_gravity_field().set_gravity_vector(np.asarray(machine.gravity, float))
    starts, bodies, joints = joint_frames(machine), {"ground": plant.world_body()}, {}
    for body in machine.bodies:
        inertia, centre = np.asarray(body.inertia_matrix(None), float), np.asarray(body.centre, float) + starts[body.name]
        six = (inertia[k] for k in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)))
        weight = SpatialInertia.MakeFromCentralInertia(float(body.mass), centre, RotationalInertia(*map(float, six)))
        bodies[body.name] = plant.AddRigidBody(body.name, weight)
    for joint in machine.tree:
        place = RigidTransform(np.asarray(joint.at, float) + starts[joint.parent])
        frame = plant.AddFrame(_fixed(joint.name, bodies[joint.parent], place))
        kind = RevoluteJoint if joint.kind == "revolute" else PrismaticJoint
        axis, own = np.asarray(joint.axis, float), bodies[joint.body].body_frame()
        joints[joint.name] = plant.AddJoint(kind(joint.name, frame, own, axis / np.linalg.norm(axis)))
    for (one, first), (other, second) in loops:
        plant.AddBallConstraint(bodies[one], first, bodies[other], second)
    plant.Finalize()
    return plant, joints, bodies


def _fixed(name: str, body: Any, place: Any) -> Any:
    from pydrake.multibody.tree import FixedOffsetFrame

    return FixedOffsetFrame(f"{name} holds", body.body_frame(), place)


def measured(example: Any, steps: int, end: np.ndarray, repeats: int) -> str:
    """µs a step, the distance of q at the end from `end`, the range of the energy relative to the largest, and the largest gap of
    a loop, by steps of the example's size."""
    from pydrake.systems.analysis import ResetIntegratorFromFlags, Simulator

    machine, h = example.model, example.step
    plant, joints, bodies = built(machine, h)
    loops = closing_points(machine)
    of = np.array([joints[name].position_start() for name in machine.coordinates])

    def started() -> Any:
        simulator = Simulator(plant)
        if not loops:
            ResetIntegratorFromFlags(simulator, "runge_kutta3", h)
            simulator.get_mutable_integrator().set_fixed_step_mode(True)
        q, v = np.empty(of.size), np.empty(of.size)
        q[of], v[of] = example.initial["q"], example.initial["v"]
        plant.SetPositions(simulator.get_mutable_context(), q)
        plant.SetVelocities(simulator.get_mutable_context(), v)
        simulator.Initialize()
        return simulator

    seconds, simulator = [], started()
    for _ in range(repeats):
        simulator, before = started(), time.process_time()
        simulator.AdvanceTo(steps * h)
        seconds.append(time.process_time() - before)
    error = np.abs(plant.GetPositions(simulator.get_context())[of] - end).max()
    simulator, energies, gap = started(), [], 0.0
    for k in range(steps):
        simulator.AdvanceTo((k + 1) * h)
        context = simulator.get_context()
        energies.append(plant.EvalKineticEnergy(context) + plant.EvalPotentialEnergy(context))
        for (one, first), (other, second) in loops:
            at = lambda name, x, context=context: plant.EvalBodyPoseInWorld(context, bodies[name]) @ x
            gap = max(gap, np.abs(at(one, first) - at(other, second)).max())
    return entry(min(seconds) / steps, error, energies, gap if loops else None)
