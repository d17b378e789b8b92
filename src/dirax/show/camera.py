"""A camera that sees the whole of a motion: the projection of points of space onto a picture."""

from dataclasses import dataclass

import numpy as np

OPENING = np.tan(np.radians(26.0) / 2)
"""Half the height of the picture at distance 1, as in the reports (assets/src/view.js)."""

STEEPEST = np.radians(89.0)


@dataclass(frozen=True)
class Camera:
    """Looks from `eye` along −`towards`; `right` and `above` span the picture, from −1 to 1 in height."""

    eye: np.ndarray
    towards: np.ndarray
    right: np.ndarray
    above: np.ndarray

    @classmethod
    def seeing(cls, spots: np.ndarray, reach: np.ndarray, direction: np.ndarray, aspect: float, margin: float) -> "Camera":
        """From `direction` (3,), as near as all `spots` (k, 3) with the room `reach` (k,) about each can be seen."""
        direction = direction / np.linalg.norm(direction)
        azimuth = np.arctan2(direction[1], direction[0])
        elevation = np.clip(np.arcsin(direction[2]), -STEEPEST, STEEPEST)
        level = np.cos(elevation)
        towards = np.array([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)])
        right = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
        above = np.cross(towards, right)
        target = (spots.min(axis=0) + spots.max(axis=0)) / 2
        near = (spots - target) @ towards
        room = {"right": OPENING * aspect, "above": OPENING}
        for axis, wide in ((right, room["right"]), (above, room["above"])):
            across = (spots - target) @ axis
            ends = np.min(across - reach - margin - wide * near), np.max(across + reach + margin + wide * near)
            target = target + axis * sum(ends) / 2
        near = (spots - target) @ towards
        distances = [
            (np.abs((spots - target) @ axis) + reach + margin) / wide + near
            for axis, wide in ((right, room["right"]), (above, room["above"]))
        ]
        return cls(target + max(margin, float(np.max(distances))) * towards, towards, right, above)

    def __call__(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Places in the picture (…, 2), and the depths (…,) of points (…, 3); what is behind the eye is put just before it."""
        to = points - self.eye
        depth = np.maximum(-(to @ self.towards), 1e-9)
        return np.stack([to @ self.right, to @ self.above], axis=-1) / (OPENING * depth[..., None]), depth
