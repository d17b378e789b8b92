"""Rotations of space as unit quaternions (w, x, y, z), for functions that say where bodies are drawn."""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float


def turn(axis: Any, angle: Any) -> Float[Array, "4"]:
    """The rotation by `angle` (rad) about `axis` (3,), by the right hand."""
    axis = jnp.asarray(axis, float)
    half = jnp.asarray(angle, float) / 2
    return jnp.concatenate([jnp.cos(half)[None], jnp.sin(half) * axis / jnp.linalg.norm(axis)])


def after(*turns: Any) -> Float[Array, "4"]:
    """The rotations one after the other as a product of matrices is: the last one first."""
    first, *others = turns
    for other in others:
        first = _product(jnp, first, other)
    return first


def _product(xp: Any, a: Any, b: Any) -> Any:
    (aw, ax, ay, az), (bw, bx, by, bz) = xp.moveaxis(a, -1, 0), xp.moveaxis(b, -1, 0)
    parts = (
        aw * bw - ax * bx - ay * by - az * bz,
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
    )
    return xp.stack(parts, axis=-1)


def rotated(turns: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    """Vectors (…, 3) turned by quaternions (…, 4)."""
    w, u = turns[..., :1], turns[..., 1:]
    across = 2 * np.cross(u, vectors)
    return vectors + w * across + np.cross(u, across)


def attitudes(t: np.ndarray, omega: np.ndarray, upright: np.ndarray | None = None) -> np.ndarray:
    """The attitudes (rows, 4) of a body with angular velocity `omega` (rows, 3) in its own frame, for drawing.

    By the midpoint rule from the identity, to second order in the distance of rows. Where `upright` (rows, 3), the vertical
    as the body sees it, is given, every attitude is tilted so that it agrees with it: only the heading is integrated.
    """
    start = np.array([1.0, 0.0, 0.0, 0.0])
    steps = _exponentials(np.diff(t)[:, None] * (omega[1:] + omega[:-1]) / 2)
    found = [start if upright is None else _upright(start, upright[0])]
    for row, step in enumerate(steps, start=1):
        moved = _product(np, found[-1], step)
        found.append(moved if upright is None else _upright(moved, upright[row]))
    return np.stack(found)


def _exponentials(vectors: np.ndarray) -> np.ndarray:
    angle = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.concatenate([np.cos(angle / 2), vectors * np.sinc(angle / (2 * np.pi)) / 2], axis=-1)


def _upright(attitude: np.ndarray, upright: np.ndarray) -> np.ndarray:
    """The attitude, tilted on the shortest way so that the body's vector `upright` points to (0, 0, 1)."""
    x, y, z = rotated(attitude, upright / np.linalg.norm(upright))
    tilt = np.array([1 + z, y, -x, 0.0])
    size = np.linalg.norm(tilt)
    tilt = tilt / size if size > 1e-9 else np.array([0.0, 1.0, 0.0, 0.0])
    return _product(np, tilt, attitude)


def quaternions(matrices: np.ndarray) -> np.ndarray:
    """The quaternions (rows, 4) of rotation matrices (rows, 3, 3), of either sign."""
    m = matrices
    squares = np.stack(
        [
            1 + m[:, 0, 0] + m[:, 1, 1] + m[:, 2, 2],
            1 + m[:, 0, 0] - m[:, 1, 1] - m[:, 2, 2],
            1 - m[:, 0, 0] + m[:, 1, 1] - m[:, 2, 2],
            1 - m[:, 0, 0] - m[:, 1, 1] + m[:, 2, 2],
        ],
        axis=1,
    )
    whole = np.empty((len(m), 4, 4))  # row k: 4 q_k q, the row with the largest q_k is used
    whole[:, range(4), range(4)] = squares
    for (a, b), value in {
        (0, 1): m[:, 2, 1] - m[:, 1, 2],
        (0, 2): m[:, 0, 2] - m[:, 2, 0],
        (0, 3): m[:, 1, 0] - m[:, 0, 1],
        (1, 2): m[:, 0, 1] + m[:, 1, 0],
        (1, 3): m[:, 0, 2] + m[:, 2, 0],
        (2, 3): m[:, 1, 2] + m[:, 2, 1],
    }.items():
        whole[:, a, b] = whole[:, b, a] = value
    best = whole[np.arange(len(m)), np.argmax(squares, axis=1)]
    return best / np.linalg.norm(best, axis=1, keepdims=True)
