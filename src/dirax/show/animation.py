"""animate(): the motion of a solution as a moving picture in a file."""

import os
import shutil
from collections.abc import Iterator, Sequence
from pathlib import Path
from subprocess import CalledProcessError
from typing import Any

import numpy as np

from dirax.show import frames, series
from dirax.show.drawing import Drawing
from dirax.show.report import PAGES, checked_path, checked_solutions, report
from dirax.solution.atomic_files import placed
from dirax.solution.saving import path_of
from dirax.solution.solution import Solution
from dirax.solution.style import INK, style

DOTS = 100
"""Dots of an inch of the picture's size."""

COLOURS_OF_GIF = 64

RAPID = 4000
"""Rows of a run that are looked at for how fast it is."""

LARGEST_MOVE, LARGEST_TURN = 0.05, 0.25
"""Of a body between two frames: in sizes of the picture, and in radians."""

ENDINGS = (".gif", ".webp", ".mp4", *PAGES)


def animate(
    solutions: Solution | Sequence[Solution],
    path: str | os.PathLike,
    *,
    scene: Any = None,
    seconds: float = 6.0,
    frames_per_second: int = 20,
    size: tuple[float, float] = (4.8, 3.2),
    overwrite: bool = True,
) -> Path:
    """Write the motion of a solution, or of several side by side, as a moving picture, and return its path.

    The ending of `path` says how: .gif and .webp go round for ever, .mp4 is for lectures and needs the program ffmpeg, installed
    or in the package imageio-ffmpeg, .html is the report without verdicts, to be turned about and stopped. `scene` is a
    `dx.scene.Scene` or a list of its parts, by default that of the gallery's system. The whole run takes `seconds`; for a part
    of it, animate `sol[t0:t1]`. `size` is in inches of 100 dots. The first trajectories of a batch move together.

    Raises `ValueError` for another ending, `RuntimeError` where ffmpeg is missing or fails, and what `sol.report` raises.
    """
    path = path_of(path, such="run.gif")
    checked_path(path, ENDINGS, overwrite)
    if path.suffix in PAGES:
        return report(solutions, path, scene=scene, verdicts=False)
    encoder = _ffmpeg() if path.suffix == ".mp4" else ""
    if not seconds > 0 or not frames_per_second > 0:
        raise ValueError(f"seconds and frames_per_second must be positive, but {seconds!r} and {frames_per_second!r} were given.")
    several = checked_solutions(solutions)
    from matplotlib import rc_context

    count = max(2, round(seconds * frames_per_second))
    with placed(path, overwrite) as beside, style(), rc_context({"animation.ffmpeg_path": encoder} if encoder else {}):
        drawing, times = drawn(several, scene, count, size)
        _write(beside, drawing, times, str(several[0].metadata.get("units", {}).get("t", "")), frames_per_second)
    return path


def drawn(several: Sequence[Solution], scene: Any, count: int, size: tuple[float, float]) -> tuple[Drawing, np.ndarray]:
    """The drawing of solutions at `count` rows of their runs, and the times of these."""
    runs = [run for k, sol in enumerate(several) for run in series.runs_of(sol, "", k, None, measured=False)]
    main = several[0].fields.get("q", several[0].fields.get("x"))
    given = scene if scene is not None else getattr(getattr(several[0], "example", None), "scene", None)
    chosen = frames.scene_of(given, np.asarray(main).shape[-1])
    motions = frames.motions(chosen, [(run.rows, run.params) for run in runs], count)
    ghosts = [run.ghost and len(runs) > 6 for run in runs]
    return Drawing(chosen, motions, ghosts, size), max((m.t for m in motions), key=len)


def _ffmpeg() -> str:
    """The program that encodes an .mp4. Raises `RuntimeError` where there is none."""
    if found := shutil.which("ffmpeg"):
        return found
    try:
        from imageio_ffmpeg import get_ffmpeg_exe

        return get_ffmpeg_exe()
    except (ImportError, RuntimeError):
        raise RuntimeError(
            "an .mp4 needs the program ffmpeg, which is not installed: install it, or `pip install imageio-ffmpeg`, or write a "
            ".webp or .gif."
        ) from None


def _write(path: Path, drawing: Drawing, times: np.ndarray, unit: str, rate: int) -> None:
    from matplotlib.animation import FFMpegWriter
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from PIL import Image

    canvas = FigureCanvasAgg(drawing.figure)
    drawing.figure.set_dpi(DOTS)
    digits = max(0, min(6, 2 - int(np.floor(np.log10(times[-1] - times[0] or 1.0)))))
    clock = drawing.ax.text(0.02, 0.03, "", transform=drawing.ax.transAxes, color=INK, fontsize=9, alpha=0.75)

    def each() -> Iterator[int]:
        for frame, t in enumerate(times):
            clock.set_text(f"t = {t:.{digits}f}{f' {unit}' if unit else ''}")
            drawing.at(frame)
            yield frame

    if path.suffix == ".mp4":
        writer = FFMpegWriter(fps=rate)
        try:
            with writer.saving(drawing.figure, str(path), DOTS):
                for _ in each():
                    writer.grab_frame(facecolor=drawing.figure.get_facecolor())
        except (OSError, CalledProcessError) as error:
            raise RuntimeError(f"ffmpeg ({writer.bin_path()}) failed: {error}; write a .webp or .gif instead.") from error
        return
    if path.suffix == ".gif":  # the last frame has all colours, those of the trails too
        drawing.at(len(times) - 1)
        canvas.draw()
        colours = Image.fromarray(np.array(canvas.buffer_rgba())[..., :3]).quantize(COLOURS_OF_GIF, Image.Quantize.MEDIANCUT)
        reduced = lambda image: image.quantize(palette=colours, dither=Image.Dither.NONE)
        how: dict[str, Any] = {"optimize": False, "disposal": 1}
    else:
        reduced, how = (lambda image: image), {"quality": 70, "method": 2}
    pictures = []
    for _ in each():
        canvas.draw()
        pictures.append(reduced(Image.fromarray(np.array(canvas.buffer_rgba())[..., :3])))
    whole = {"save_all": True, "append_images": pictures[1:], "duration": round(1000 / rate), "loop": 0}
    pictures[0].save(path, **whole, **how)


def calm_end(sol: Solution, count: int, scene: Any = None) -> float:
    """Until when `count` frames from the start on show a motion that the eye can follow: a body moves by at most a twentieth
    of the picture and turns by at most a quarter of a radian between frames, on the average."""
    several = checked_solutions(sol)
    drawing, times = drawn(several, scene, RAPID, (4.8, 3.2))
    amount = np.zeros(len(times))
    for places in drawing.motions[0].places:
        for name, values in (places or {}).items():
            if len(values) == len(times):
                if name == "turn":
                    cosine = np.abs(np.sum(values[1:] * values[:-1], axis=1))
                    changes = 2 * np.arccos(np.minimum(1.0, cosine)) / LARGEST_TURN
                else:
                    changes = np.linalg.norm(np.diff(values, axis=0), axis=1) / (LARGEST_MOVE * drawing.extent)
                amount[1:] = np.maximum(amount[1:], np.cumsum(changes))
    return float(times[max(2, int(np.searchsorted(amount, count, side="right")) - 1)])
