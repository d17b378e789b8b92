"""Machines stated as bodies: what they weigh, how they are joined, where they touch the ground, what pulls at them.

    b = dirax.bodies
    pendulum = b.Model(
        bodies=[b.Body("rod", mass=1.0, inertia=(0.1, 0.1, 0.0), centre=(0.0, 0.0, -0.5))],
        joints=[b.revolute("ground", "rod", axis=(0, 1, 0), name="angle")],
    )
    sol = dirax.simulate(pendulum.system, dirax.LagrangeDAlembert(), **pendulum.state({"angle": 1.0}), step=0.01, steps=1000)

A model is plain data and states a `dx.LagrangeDirac`, or a `dx.ManifoldLagrangian` with its rotations on SO(3); schemes,
engines and diagnostics know nothing of it.

model.py              Model: names, energy, observables; model_constraints.py its constraints, statement.py the systems,
                      assembly.py its initial data, machine_units.py how large it is, checks.py and number_checks.py its mistakes
parts.py              Body, rod; joints.py, contacts.py, forces.py what is between bodies
motion.py, frames.py  how a joint moves a frame, with its velocity
drawing.py            the scene of a report

Numbers of a model may be names of its `parameters`, which are then the params of its functions.
"""

from dirax.bodies.contacts import Contact, ball_contact, blade, ellipsoid, tip, wheel
from dirax.bodies.forces import Damper, Motor, Spring
from dirax.bodies.joints import Joint, ball, fixed, free, gliding, planar, prismatic, revolute, rolling_wheel, universal
from dirax.bodies.model import Model
from dirax.bodies.parts import Body, rod

__all__ = [
    "Body",
    "Contact",
    "Damper",
    "Joint",
    "Model",
    "Motor",
    "Spring",
    "ball",
    "ball_contact",
    "blade",
    "ellipsoid",
    "fixed",
    "free",
    "gliding",
    "planar",
    "prismatic",
    "revolute",
    "rod",
    "rolling_wheel",
    "tip",
    "universal",
    "wheel",
]
