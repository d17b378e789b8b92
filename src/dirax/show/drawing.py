"""A scene at one time as a matplotlib picture: faces, shaded by a sun, drawn from the farthest to the nearest."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from dirax.show import bodies
from dirax.show.camera import Camera
from dirax.show.frames import Motion
from dirax.show.scene import Part, Scene
from dirax.show.turns import rotated
from dirax.solution.style import COLOURS, INK, new_figure

SKY, GREY, ARROW = "#f4f5f6", "#8d949c", "#c2185b"
"""As in assets/report.css."""

SUN = np.array([-0.5, -0.9, 1.6]) / np.linalg.norm([-0.5, -0.9, 1.6])
SPOTS = 400
STILL = ("plane", "axes", "sphere", "path")
TAIL = 8
"""The bright end of a trail is this part of the whole time."""


class Drawing:
    """One picture of several motions of a scene: `at(frame)` draws them at a frame. `figure` is matplotlib's."""

    def __init__(self, scene: Scene, motions: Sequence[Motion], ghosts: Sequence[bool], size: tuple[float, float]):
        from matplotlib.collections import LineCollection, PolyCollection
        from matplotlib.colors import to_rgb

        self.scene, self.motions, self.rgb = scene, motions, to_rgb
        self.figure, self.ax = new_figure(size=size)
        self.figure.set_layout_engine("none")
        self.figure.set_facecolor(SKY)
        aspect = size[0] / size[1]
        self.ax.set_position((0, 0, 1, 1))
        self.ax.set(xlim=(-aspect, aspect), ylim=(-1, 1))
        self.ax.set_axis_off()
        spots, reach = self._measured()
        self.middle = (spots.min(axis=0) + spots.max(axis=0)) / 2
        box = (spots - reach[:, None]).min(axis=0), (spots + reach[:, None]).max(axis=0)
        self.extent = max(1e-6, float(np.max(box[1] - box[0])))
        self.camera = Camera.seeing(spots, reach, np.array(scene.direction), aspect, 0.04 * self.extent)
        self.several = len(motions) > 1
        self.opacity = [0.4 if ghost else 1.0 for ghost in ghosts]
        self.rigid = [bodies.pieces(part, self.extent) for part in scene.parts]
        self.still = LineCollection([], capstyle="round")
        self.trails = LineCollection([], capstyle="round")
        self.faces = PolyCollection([], closed=True)
        for artist, order in ((self.still, 1), (self.trails, 2), (self.faces, 3)):
            self.ax.add_collection(artist, autolim=False)
            artist.set_zorder(order)
        self._draw_still()

    def _measured(self) -> tuple[np.ndarray, np.ndarray]:
        """The places that must be seen (k, 3), and the room about each (k,)."""
        spots, reach = [], []
        for motion in self.motions:
            for part, places in zip(self.scene.parts, motion.places, strict=True):
                if part.kind in ("plane", "axes") or places is None:
                    continue
                radius = part.settings.get("radius") if part.kind in ("disk", "ball", "sphere") else None
                room = np.linalg.norm(part.settings["size"]) / 2 if part.kind == "box" else radius or 0.0
                for name in ("at", "end"):
                    if name in places:
                        points = places[name][:: max(1, len(places[name]) // SPOTS)]
                        spots.append(points)
                        reach.append(np.full(len(points), float(room)))
                if part.kind == "arrow":
                    at, vector = np.broadcast_arrays(places["at"], places["vector"])
                    tips = (at + part.settings["scale"] * vector)[:: max(1, len(vector) // SPOTS)]
                    spots.append(tips)
                    reach.append(np.zeros(len(tips)))
        if not spots:
            return np.array([[-1.0, -1, -1], [1, 1, 1]]), np.zeros(2)
        return np.concatenate(spots), np.concatenate(reach)

    def _colour(self, part: Part, k: int) -> str:
        chosen = part.settings.get("colour")
        if chosen in ("ink", "accent"):
            return GREY if chosen == "ink" else ARROW
        if isinstance(chosen, int) and not self.several:
            return COLOURS[chosen % len(COLOURS)]
        return chosen if isinstance(chosen, str) else COLOURS[k % len(COLOURS)]

    def _draw_still(self) -> None:
        """Planes, axes, surfaces and whole paths: what does not move, behind everything."""
        lines, colours, widths = [], [], []

        def add(points: np.ndarray, colour: str, opacity: float, width: float = 0.8) -> None:
            seen = self.camera(points)[0]
            lines.extend(seen)
            colours.extend([(*self.rgb(colour), opacity)] * len(seen))
            widths.extend([width] * len(seen))

        for k, motion in enumerate(self.motions):
            for part, places in zip(self.scene.parts, motion.places, strict=True):
                if places is None or part.kind not in STILL or (k and part.kind != "path"):
                    continue
                at = places["at"]
                turned = lambda points, places=places: rotated(places["turn"][0], points) if "turn" in places else points
                if part.kind == "plane":
                    wide = part.settings["size"] or 1.35 * self.extent
                    centre = at[0].copy()
                    if part.settings["size"] is None and abs(places["turn"][0][0] - 1) < 1e-12:
                        centre[:2] = self.middle[:2]
                    add(turned(bodies.grid_lines(wide)) + centre, GREY, 0.32, 0.7)
                elif part.kind == "axes":
                    size = part.settings["length"] or 0.5 * self.extent
                    ends = np.stack([np.zeros((3, 3)), size * np.eye(3)], axis=1)
                    add(turned(ends) + at[0], GREY, 0.9, 1.0)
                elif part.kind == "sphere":
                    add(bodies.globe_lines(part.settings["radius"]) + at[0], GREY, 0.35, 0.7)
                else:
                    add(at[None], self._colour(part, k), 0.55 * self.opacity[k], 1.2)
        self.still.set(segments=lines, color=colours, linewidths=widths)

    def at(self, frame: int) -> None:
        """Put everything where it is at a frame of the first motion, the others at theirs. A disk whose centre rests is a
        table: it lies beneath what moves."""
        faces: list[tuple[float, np.ndarray, tuple[float, ...]]] = []
        trails, colours, widths = [], [], []
        for k, motion in enumerate(self.motions):
            now = min(frame, len(motion.t) - 1)
            for part, places, rigid in zip(self.scene.parts, motion.places, self.rigid, strict=True):
                if places is None or part.kind in STILL:
                    continue
                at = {name: values[min(now, len(values) - 1)] for name, values in places.items()}
                colour = self._colour(part, k)
                if part.settings.get("trail") and now:
                    seen = self.camera(places["at"][: now + 1])[0]
                    first = max(0, now - max(2, len(motion.t) // TAIL))
                    for points, opacity, width in ((seen, 0.35, 1.0), (seen[first:], 0.9, 2.0)):
                        trails.append(points)
                        colours.append((*self.rgb(colour), opacity * self.opacity[k]))
                        widths.append(width)
                table = part.kind == "disk" and len(places["at"]) == 1
                found = self._rigid(rigid, at, colour, self.opacity[k])
                faces += [(math.inf, *rest) for _, *rest in found] if table else found
                faces += self._bent(part, at, colour, self.opacity[k])
        faces.sort(key=lambda face: -face[0])
        self.trails.set(segments=trails, color=colours, linewidths=widths)
        self.faces.set(verts=[face for _, face, _ in faces])
        shades = [shade for _, _, shade in faces]
        self.faces.set(facecolor=shades, edgecolor=shades, linewidth=0.35)

    def _rigid(self, rigid: list[bodies.Piece], at: dict[str, np.ndarray], colour: str, opacity: float) -> list:
        found = []
        for piece in rigid:
            turned = lambda points: rotated(at["turn"], points) if "turn" in at else points
            depth = float(self.camera(turned(np.array(piece.centre)) + at["at"])[1])
            for layer, (polygons, name) in enumerate(piece.mesh):
                corners = turned(polygons) + at["at"]
                normals = np.cross(corners, np.roll(corners, -1, axis=1)).sum(axis=1)  # Newell's, for corners that coincide too
                normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
                facing = np.einsum("ki,ki->k", normals, self.camera.eye - corners[:, 0]) > 0
                seen, _ = self.camera(corners[facing])
                base = self._named(colour, name)
                light = 0.72 + 0.3 * (normals[facing] @ SUN)
                shades = np.clip(light[:, None] * base, 0, 1)
                key = depth - 1e-6 * self.extent * layer
                found += [(key, face, (*shade, opacity)) for face, shade in zip(seen, shades, strict=True)]
        return found

    def _named(self, colour: str, name: str) -> np.ndarray:
        own = np.array(self.rgb(colour))
        return {"own": own, "pale": 0.38 * own + 0.62 * np.array(self.rgb(SKY)), "ink": np.array(self.rgb(INK))}[name]

    def _bent(self, part: Part, at: dict[str, np.ndarray], colour: str, opacity: float) -> list:
        """Rods, springs and arrows: bands of their own width across the line of sight, in short pieces."""
        shade = (*self.rgb(colour), opacity)
        if part.kind == "rod":
            width = part.settings["radius"] or 0.0075 * self.extent
            return self._band(np.linspace(at["at"], at["end"], 9), width, shade)
        if part.kind == "spring":
            wire = bodies.coil(at["at"], at["end"], part.settings["turns"], part.settings["radius"] or 0.025 * self.extent)
            return self._band(wire, 0.0045 * self.extent, shade)
        if part.kind != "arrow":
            return []
        reach = part.settings["scale"] * at["vector"]
        length = float(np.linalg.norm(reach))
        if length == 0:
            return []
        width = 0.009 * self.extent
        neck = at["at"] + reach * (1 - min(5 * width, length) / length)
        tip = self._band(np.stack([neck, at["at"] + reach]), np.array([2.4 * width, 0.0]), shade)
        return self._band(np.linspace(at["at"], neck, 5), width, shade) + tip

    def _band(self, points: np.ndarray, width: Any, shade: tuple[float, ...]) -> list:
        seen, depth = self.camera(points)
        along = np.gradient(seen, axis=0)
        along /= np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-12)
        half = (np.broadcast_to(width, len(points)) / (depth * np.tan(np.radians(13.0))))[:, None]
        aside = half * np.stack([-along[:, 1], along[:, 0]], axis=-1)
        low, high = seen - aside, seen + aside
        quads = np.stack([low[:-1], low[1:], high[1:], high[:-1]], axis=1)
        return [(float(z), quad, shade) for z, quad in zip((depth[:-1] + depth[1:]) / 2, quads, strict=True)]
