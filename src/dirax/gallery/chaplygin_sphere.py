"""Chaplygin's sphere: a ball with three different moments of inertia, balanced, that rolls on a plane without slipping.

Its angular momentum about the point of contact, I ω + m r² γ × (ω × γ) with the vertical γ, is constant in space, and so is its
energy (Chaplygin 1903; Borisov and Mamaev 2001). No potential, no friction. Units of the ball.
"""

import numpy as np

from dirax.bodies import Body, Model, ball_contact, free
from dirax.gallery.machine import machine

MODEL = Model(
    bodies=[Body("ball", 1.0, (0.2, 0.35, 0.5))],
    joints=[free("ground", "ball")],
    contacts=[ball_contact("ball", 1.0)],
    gravity=(0.0, 0.0, 0.0),
)


def about_contact(q, v):
    """The angular momentum about the point of contact (3,), constant."""
    return MODEL.angular_momentum(q, v, about=q[:3] - np.array([0.0, 0.0, 1.0]))


EXAMPLE = machine(
    "chaplygin-sphere",
    "Chaplygin's sphere",
    "Chaplygin 1903; Borisov & Mamaev, Nelin. Dinam. 2001: its integrals",
    MODEL,
    MODEL.state({"ball.z": 1.0, "ball.qx": 0.3, "ball.qy": 0.1}, {"ball.x": 0.5, "ball.y": 0.2, "ball.qz": 0.6}),
    step=0.01,
    steps=2000,
    units=False,
    trail="ball",
)
