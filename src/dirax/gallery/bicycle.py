"""The benchmark bicycle of Meijaard, Papadopoulos, Ruina and Schwab, with its rider, on a plane: fully nonlinear.

Four bodies: the rear wheel, the frame with the rider, the handlebar with the fork, and the front wheel. Both wheels are thin
discs that roll without slipping. Axes: x forwards, y to the left, z upwards; the frame's origin is the middle of the rear wheel.
Data: Table 1 of the paper (its z points down, so that products of inertia I_xz have the other sign). SI units.
"""

import math
from dataclasses import replace

import jax.numpy as jnp
import numpy as np

from dirax.bodies import Body, Model, free, revolute, wheel
from dirax.gallery.example import Example
from dirax.gallery.machine import machine

WHEELBASE, TRAIL, TILT, REAR, FRONT = 1.02, 0.08, math.pi / 10, 0.3, 0.35
STEER = np.array([WHEELBASE + TRAIL, 0.0, -REAR])
"""Where the steering axis meets the ground, from the middle of the rear wheel."""


def seen(x: float, height: float) -> np.ndarray:
    """A point by its distance ahead of the rear contact and its height."""
    return np.array([x, 0.0, height - REAR])


def symmetric(xx: float, yy: float, zz: float, xz: float) -> tuple:
    """An inertia matrix of a body that is its own mirror image."""
    return ((xx, 0.0, xz), (0.0, yy, 0.0), (xz, 0.0, zz))


MODEL = Model(
    bodies=[
        Body("frame", 85.0, symmetric(9.2, 11.0, 2.8, -2.4), centre=seen(0.3, 0.9)),
        Body("rear wheel", 2.0, (0.0603, 0.12, 0.0603)),
        Body("handlebar", 4.0, symmetric(0.05892, 0.06, 0.00708, 0.00756), centre=seen(0.9, 0.7) - STEER),
        Body("front wheel", 3.0, (0.1405, 0.28, 0.1405)),
    ],
    joints=[
        free("ground", "frame", "zxy"),
        revolute("frame", "rear wheel", (0, 1, 0)),
        revolute("frame", "handlebar", (-math.sin(TILT), 0, math.cos(TILT)), "steer", at=STEER),
        revolute("handlebar", "front wheel", (0, 1, 0), at=seen(WHEELBASE, FRONT) - STEER),
    ],
    contacts=[wheel("rear wheel", REAR), wheel("front wheel", FRONT)],
)


def straight(speed: float) -> dict[str, np.ndarray]:
    """Upright and straight ahead at a speed (m/s)."""
    turning = {"rear wheel": speed / REAR, "front wheel": speed / FRONT}
    return MODEL.state({"frame.z": REAR}, {"frame.x": speed, **turning})


def circling(steer: float, roll: float, rate: float) -> dict[str, np.ndarray]:
    """With these angles of handlebar and frame (rad), turning at a rate (rad/s): a circular motion where nothing accelerates."""
    return MODEL.state({"steer": steer, "frame.roll": roll}, {"frame.yaw": rate, "frame.roll": 0.0, "steer": 0.0})


def moved(k: int):
    """The generator of translations in one coordinate."""
    return lambda q: jnp.zeros(9).at[k].set(1.0)


def turned(q):
    """The generator of turns about the vertical."""
    return jnp.zeros(9).at[0].set(-q[1]).at[1].set(q[0]).at[3].set(1.0)


SYMMETRIES = {"x": moved(0), "y": moved(1), "yaw": turned, "rear wheel": moved(6), "front wheel": moved(8)}
"""Infinitesimal generators; rolling does not conserve their momenta."""

EXAMPLE = machine(
    "bicycle",
    "Benchmark bicycle with a rigid rider",
    "Meijaard, Papadopoulos, Ruina, Schwab, Proc. R. Soc. A 463 (2007) 1955–1982",
    MODEL,
    MODEL.state({"frame.z": REAR}, {"frame.x": 4.6, "frame.roll": 0.5, "frame.yaw": 0.0}),
    step=0.005,
    steps=1000,
    view=(-0.5, -1.0, 0.4),
    trail="frame",
)


def _manoeuvre(name: str, speed: float, push: float, step: float) -> Example:
    start = MODEL.state({"frame.z": REAR}, {"frame.x": speed, "frame.roll": push, "frame.yaw": 0.0, "steer": 0.0})
    title = f"{EXAMPLE.title}, {name}: {speed} m/s, pushed over at {push} rad/s"
    return replace(EXAMPLE, name=f"bicycle {name}", title=title, initial=start, step=step, steps=round(20 / step))


MANOEUVRES = tuple(_manoeuvre(*data) for data in (("M1", 4.0, 0.05, 0.01), ("M2", 4.6, 0.5, 0.02), ("M3", 8.0, 0.05, 0.02)))
"""Of the IFToMM library of benchmark problems, twenty seconds each: its score is 100 times the range of the energy, relative."""
