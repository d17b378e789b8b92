"""Moving pictures in files, and the camera and the bodies that they are drawn with."""

import itertools
import re
import shutil
import subprocess
import sys

import numpy as np
import pytest
from PIL import Image

import dirax as dx
from dirax import gallery
from dirax.show import animation, bodies, frames
from dirax.show.animation import calm_end
from dirax.show.camera import Camera
from dirax.show.drawing import Drawing

PENDULUM = gallery.get("pendulum").simulate(steps=60)


def pictures(path):
    with Image.open(path) as image:
        for k in range(image.n_frames):
            image.seek(k)
            yield np.asarray(image.convert("RGB")).copy()


@pytest.mark.parametrize("ending", ["gif", "webp"])
@pytest.mark.soak_of("gif")
def test_every_frame_is_another_picture_of_the_size_asked_for(tmp_path, ending):
    path = PENDULUM.animate(tmp_path / f"swing.{ending}", seconds=1, frames_per_second=5, size=(1.2, 1.0))
    found = list(pictures(path))
    assert path.name == f"swing.{ending}" and [p.shape for p in found] == [(100, 120, 3)] * 5
    assert all(np.abs(a.astype(int) - b).max() > 40 for a, b in itertools.pairwise(found))
    assert list(tmp_path.iterdir()) == [path]


def test_html_is_a_report_and_other_endings_are_refused(tmp_path, monkeypatch):
    page = PENDULUM.animate(tmp_path / "swing.html")
    assert "<title>Mathematical pendulum</title>" in page.read_text("utf-8")
    with pytest.raises(ValueError, match=r"path must end in \.gif or \.webp or \.mp4 or \.html"):
        PENDULUM.animate(tmp_path / "swing.avi")
    with pytest.raises(ValueError, match="has 305 bytes: choose one of at most 255"):
        PENDULUM.animate(tmp_path / ("x" * 300 + ".webp"))
    with pytest.raises(ValueError, match="must be positive"):
        PENDULUM.animate(tmp_path / "swing.gif", seconds=0)


def test_a_film_for_lectures(tmp_path):
    pytest.importorskip("imageio_ffmpeg") if shutil.which("ffmpeg") is None else None
    path = PENDULUM.animate(tmp_path / "swing.mp4", seconds=1, frames_per_second=5, size=(1.21, 1.0))
    said = subprocess.run([animation._ffmpeg(), "-i", path, "-f", "null", "-"], capture_output=True, text=True).stderr
    assert "Video: h264" in said and "120x100" in said and re.search(r"frame= *5\b", said)


def test_without_ffmpeg_or_where_it_fails_there_is_one_error(tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    with pytest.raises(RuntimeError, match=r"needs the program ffmpeg.*write a \.webp"):
        PENDULUM.animate(tmp_path / "swing.mp4")
    broken = tmp_path / "ffmpeg"
    broken.write_text("#!/bin/sh\nexit 3\n")
    broken.chmod(0o755)
    with pytest.raises(RuntimeError, match=r"ffmpeg \(.*\) failed.*\.gif instead"):
        PENDULUM.animate(tmp_path / "swing.mp4", seconds=1, frames_per_second=5, size=(1.2, 1.0))
    assert list(tmp_path.iterdir()) == [broken]


def test_a_fast_run_is_shown_in_part():
    assert calm_end(PENDULUM, 10_000) == PENDULUM.t[-1]
    assert PENDULUM.t[0] < calm_end(PENDULUM, 10) < PENDULUM.t[-1] / 2


def test_the_camera_sees_every_spot_with_its_room():
    spots = np.random.default_rng(0).normal(size=(40, 3)) * [3.0, 1.0, 0.5]
    reach = np.full(40, 0.3)
    for direction in ([0.5, -0.7, 0.4], [0.0, -1.0, 0.0], [0.0, 0.0, 1.0]):
        camera = Camera.seeing(spots, reach, np.array(direction), 1.5, 0.1)
        around = spots[:, None] + 0.3 * np.concatenate([np.eye(3), -np.eye(3)])
        seen, depth = camera(around)
        assert np.all(np.abs(seen) <= [1.5, 1.0]) and np.all(depth > 0)
        assert np.abs(seen[..., 0]).max() > 1.2 or np.abs(seen[..., 1]).max() > 0.8


@pytest.mark.parametrize("part", [dx.scene.point([0, 0, 0]), dx.scene.ball([0, 0, 0]), dx.scene.box([0, 0, 0])])
def test_faces_of_closed_bodies_look_outwards(part):
    for piece in bodies.pieces(part, 1.0):
        for polygons, _ in piece.mesh:
            normals = np.cross(polygons, np.roll(polygons, -1, axis=1)).sum(axis=1)
            assert np.all(np.einsum("ki,ki->k", normals, polygons.mean(axis=1)) > 0)


def test_what_is_nearer_is_drawn_later():
    near, far = dx.scene.point(lambda q: np.array([0.0, -1.0, 0.0]) + 0 * q), dx.scene.point([0.0, 1.0, 0.0], colour="ink")
    for parts in ((near, far), (far, near)):
        scene = dx.scene.Scene(parts, "front")
        rows = {"q": np.zeros((3, 3)), "t": np.arange(3.0)}
        drawing = Drawing(scene, frames.motions(scene, [(rows, None)]), [False], (2.0, 2.0))
        drawing.at(2)
        first, last = drawing.faces.get_facecolor()[[0, -1], :3]
        assert np.ptp(first) < 0.1 < np.ptp(last)  # the grey one, then the blue one
