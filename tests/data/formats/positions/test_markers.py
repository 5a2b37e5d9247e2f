"""Printed markers are found in photos to a fifth of a pixel, and give metres."""

from __future__ import annotations

import importlib.util
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from biresnerf.data.formats.positions.control_points import control_notes, control_points
from biresnerf.data.model.dataset import Dataset, Frame, SourceFormat
from biresnerf.data.points.located_points import metres_from_world
from biresnerf.errors import InputError
from biresnerf.geometry.camera.camera_models import Camera
from tests.refinement.adjustment.rig import look_at_origin

SIDE, SIZE = 640, 0.12  # px of a photo, and the edge of a marker in units of 2 m
LENS = Camera("SIMPLE_PINHOLE", SIDE, SIDE, (700.0, SIDE / 2, SIDE / 2))
CENTRES = {3: (-0.4, -0.3), 11: (0.35, -0.35), 42: (0.3, 0.4), 7: (-0.35, 0.3)}
POSES = look_at_origin(np.array([[0.9, -1.1, 1.6], [-1.2, -0.4, 1.5], [0.2, 1.3, 1.4], [0.5, 0.2, 2.0]]))


def photo_of(cv2, pose, family) -> np.ndarray:
    """A board of four markers, as a camera at this pose sees it."""
    dictionary = cv2.aruco.getPredefinedDictionary(family)
    picture = np.full((3 * SIDE, 3 * SIDE), 255, np.uint8)
    for number, (x, y) in CENTRES.items():
        marker = cv2.aruco.generateImageMarker(dictionary, number, 240)
        # Corners of the printed square, the first upper left as one looks at it from above, in world units.
        half = SIZE / 2
        square = np.array(
            [[x - half, y + half], [x + half, y + half], [x + half, y - half], [x - half, y - half]]
        )
        in_cam = (np.column_stack([square, np.zeros(4)]) - pose[:3, 3]) @ pose[:3, :3]
        xy = 3 * (700 * in_cam[:, :2] / in_cam[:, 2:] + SIDE / 2) - 0.5
        corners = np.array([[-0.5, -0.5], [239.5, -0.5], [239.5, 239.5], [-0.5, 239.5]])
        warp = cv2.getPerspectiveTransform(corners.astype(np.float32), xy.astype(np.float32))
        shown = cv2.warpPerspective(marker, warp, picture.shape, borderValue=255)
        picture = np.minimum(picture, shown)
    return picture.reshape(SIDE, 3, SIDE, 3).mean((1, 3)).astype(np.uint8)


@pytest.fixture(name="board", params=["tag36h11", "aruco4x4"])
def photographed(request, tmp_path: Path) -> Dataset:
    cv2 = pytest.importorskip("cv2")
    family = {"tag36h11": cv2.aruco.DICT_APRILTAG_36H11, "aruco4x4": cv2.aruco.DICT_4X4_1000}[request.param]
    frames = []
    for i, pose in enumerate(POSES):
        path = tmp_path / f"{i}.png"
        Image.fromarray(photo_of(cv2, pose, family)).save(path)
        frames.append(Frame(path.name, path, 0, pose, "given"))
    rows = [f"{request.param}:{number},{2 * x},{2 * y},0" for number, (x, y) in CENTRES.items()]
    (tmp_path / "gcp.csv").write_text("\n".join(["name,x,y,z", *rows, f"{request.param}:500,0,0,1"]))
    return Dataset(tmp_path, (LENS,), tuple(frames), SourceFormat("images"))


def test_markers_are_found_and_give_metres(board):
    points = control_points(board)
    assert len(points.names) == 4  # nobody printed the one numbered 500
    assert len(points.image) >= 14
    for name, image, xy in zip(np.array(points.names)[points.point], points.image, points.xy, strict=True):
        centre = np.array([*CENTRES[int(name.split(":")[1])], 0.0])
        in_cam = (centre - POSES[image, :3, 3]) @ POSES[image, :3, :3]
        assert np.abs(700 * in_cam[:2] / in_cam[2] + SIDE / 2 - xy).max() < 0.2
    frame = metres_from_world(replace(board, control=points), POSES)
    assert frame.scale == pytest.approx(2.0, rel=1e-3)
    assert control_notes(board) == ("gcp.csv: 5 printed markers are looked for in the photos",)


def test_without_opencv_the_way_to_get_it_is_told(tmp_path, monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda _name: None)
    (tmp_path / "gcp.csv").write_text("name,x,y,z\ntag36h11:1,0,0,0\n")
    frame = Frame("a.jpg", tmp_path / "a.jpg", 0, None, None)
    with pytest.raises(InputError, match="OpenCV") as caught:
        control_notes(Dataset(tmp_path, (LENS,), (frame,), SourceFormat("images")))
    assert caught.value.code == "markers_unsupported"
    assert "biresnerf[markers]" in caught.value.hint
