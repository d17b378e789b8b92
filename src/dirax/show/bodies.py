"""The bodies of a scene as flat faces, for pictures without a graphics card: each kind is a function of its part.

A body is convex or made of convex pieces, so its faces need no order among themselves once those that look away are left out.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np

from dirax.show.scene import Part

Mesh = list[tuple[np.ndarray, str]]
"""Polygons (k, m, 3), counter-clockwise seen from outside, with the name of their colour: own, pale, ink."""


@dataclass(frozen=True)
class Piece:
    """What is drawn at one depth: `mesh` is moved by `at` and `turn` of its part."""

    mesh: Mesh
    centre: tuple[float, float, float] = (0.0, 0.0, 0.0)


def pieces(part: Part, extent: float) -> list[Piece]:
    """The rigid pieces of a part, in its own frame; `extent`: the size of the motion, for bodies without one of their own."""
    made = RIGID.get(part.kind)
    return made(dict(part.settings), extent) if made is not None else []


def _ring(count: int) -> np.ndarray:
    angle = 2 * np.pi * np.arange(count) / count
    return np.stack([np.cos(angle), np.sin(angle)], axis=-1)


@cache
def _globe(across: int, up: int) -> np.ndarray:
    """The faces (up, across, 4, 3) of the unit sphere."""
    latitude = np.pi * (np.arange(up + 1) / up - 0.5)
    ring = _ring(across)
    points = np.concatenate(
        [np.cos(latitude)[:, None, None] * ring, np.broadcast_to(np.sin(latitude)[:, None, None], (up + 1, across, 1))], axis=-1
    )
    around = np.roll(points, -1, axis=1)
    return np.stack([points[:-1], around[:-1], around[1:], points[1:]], axis=2)


def _block(size: Iterable[float], centre: Iterable[float] = (0.0, 0.0, 0.0)) -> np.ndarray:
    """The six faces (6, 4, 3) of a box."""
    half = np.asarray(tuple(size)) / 2
    faces = []
    for axis in range(3):
        i, j = (axis + 1) % 3, (axis + 2) % 3
        for sign in (1.0, -1.0):
            face = np.zeros((4, 3))
            face[:, axis] = sign
            face[:, i] = [-1, 1, 1, -1]
            face[:, j] = [-1, -1, 1, 1]
            faces.append(face[:: int(sign)])
    return np.stack(faces) * half + np.asarray(tuple(centre))


def _point(settings: dict[str, Any], extent: float) -> list[Piece]:
    radius = settings["radius"] or 0.022 * extent
    return [Piece([(radius * _globe(14, 8).reshape(-1, 4, 3), "own")])]


def _ball(settings: dict[str, Any], extent: float) -> list[Piece]:
    faces = settings["radius"] * _globe(36, 20)
    return [Piece([(faces[:, :18].reshape(-1, 4, 3), "own"), (faces[:, 18:].reshape(-1, 4, 3), "pale")])]


def _disk(settings: dict[str, Any], extent: float) -> list[Piece]:
    """A plate, and on both sides of it rim, spokes, hub and a mark, as thin as they can be."""
    radius = settings["radius"]
    high = (settings["thickness"] or 0.12 * radius) / 2
    ring, inner = radius * _ring(40), 0.86 * radius * _ring(40)
    nxt, inxt = np.roll(ring, -1, axis=0), np.roll(inner, -1, axis=0)
    raised = lambda flat, z: np.concatenate([flat, np.full((*flat.shape[:-1], 1), z)], axis=-1)
    band = np.stack([raised(ring, -high), raised(nxt, -high), raised(nxt, high), raised(ring, high)], axis=1)
    mesh: Mesh = [(band, "own")]
    spoke = radius * np.array([[-0.95, -0.03], [0.95, -0.03], [0.95, 0.03], [-0.95, 0.03]])
    turns = [np.array([[np.cos(a), -np.sin(a)], [np.sin(a), np.cos(a)]]) for a in np.pi / 3 * np.arange(3)]
    layers = [
        (ring[None], "pale"),
        *((np.stack([spoke @ turn.T for turn in turns]), "own"),),
        (np.stack([ring, nxt, inxt, inner], axis=1), "own"),
        (0.12 * radius * _ring(16)[None], "own"),
        ((0.1 * radius * _ring(16) + [0.62 * radius, 0.0])[None], "ink"),
    ]
    for flat, colour in layers:
        mesh += [(raised(flat, high), colour), (raised(flat[:, ::-1], -high), colour)]
    return [Piece(mesh)]


def _box(settings: dict[str, Any], extent: float) -> list[Piece]:
    return [Piece([(_block(settings["size"]), "own")])]


def _blade(settings: dict[str, Any], extent: float) -> list[Piece]:
    size = settings["length"] or 0.12 * extent
    steel = _block((size, 0.04 * size, 0.22 * size), (0, 0, 0.11 * size))
    shoe = _block((0.85 * size, 0.22 * size, 0.1 * size), (0, 0, 0.27 * size))
    base = size * np.array([[0.425, -0.11, 0.27], [0.75, 0, 0.27], [0.425, 0.11, 0.27]])
    return [Piece([(steel, "own"), (shoe, "ink"), (base[None], "own")], (0.0, 0.0, 0.2 * size))]


RIGID: dict[str, Callable[[dict[str, Any], float], list[Piece]]] = {
    "point": _point,
    "ball": _ball,
    "disk": _disk,
    "box": _box,
    "blade": _blade,
}


def coil(start: np.ndarray, end: np.ndarray, turns: int, radius: float) -> np.ndarray:
    """The wire (k, 3) of a spring."""
    along = end - start
    length = np.linalg.norm(along) or 1.0
    axis = along / length
    aside = np.cross(axis, [0.0, 0.0, 1.0] if abs(axis[2]) < 0.9 else [1.0, 0.0, 0.0])
    aside /= np.linalg.norm(aside)
    third = np.cross(axis, aside)
    s = np.linspace(0, 1, 16 * turns + 1)[:, None]
    wide = radius * np.clip(np.minimum(12 * s, 12 * (1 - s)), 0, 1)
    angle = 2 * np.pi * turns * s
    return start + along * s + wide * (np.cos(angle) * aside + np.sin(angle) * third)


def globe_lines(radius: float) -> np.ndarray:
    """Circles of latitude and of longitude (11, 97, 3) on a sphere."""
    u = np.linspace(0, 2 * np.pi, 97)
    circles = [
        radius * np.stack([np.cos(u) * np.cos(v), np.sin(u) * np.cos(v), np.full_like(u, np.sin(v))], axis=-1)
        for v in np.pi / 6 * np.arange(-2, 3)
    ]
    circles += [
        radius * np.stack([np.cos(a) * np.cos(u), np.sin(a) * np.cos(u), np.sin(u)], axis=-1) for a in np.pi / 6 * np.arange(6)
    ]
    return np.stack(circles)


def grid_lines(wide: float) -> np.ndarray:
    """The lines (k, 2, 3) of a grid on the plane z = 0, a round number apart."""
    power = 10 ** np.floor(np.log10(wide / 8))
    step = next(m * power for m in (1, 2, 5, 10) if wide / (m * power) <= 16)
    count = int(np.ceil(wide / 2 / step))
    end = count * step
    lines = []
    for at in step * np.arange(-count, count + 1):
        lines += [[[-end, at, 0], [end, at, 0]], [[at, -end, 0], [at, end, 0]]]
    return np.array(lines, float)
