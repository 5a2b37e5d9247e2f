"""Printed markers in photos: AprilTags and ArUco's, found by OpenCV."""

from __future__ import annotations

import importlib.util
import re
from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from biresnerf.data.model.dataset import Dataset
from biresnerf.data.photos.decode import decode
from biresnerf.errors import InputError

# OpenCV's name of the family, by how people write it.
_FAMILIES = {
    "tag16h5": "APRILTAG_16H5", "tag25h9": "APRILTAG_25H9", "tag36h10": "APRILTAG_36H10", "tag36h11": "APRILTAG_36H11",
    "aruco4x4": "4X4_1000", "aruco5x5": "5X5_1000", "aruco6x6": "6X6_1000", "aruco7x7": "7X7_1000",
    "aruco": "ARUCO_ORIGINAL",
}  # fmt: skip
_NAME = re.compile(r"(\w+):(\d{1,4})")


def is_marker(name: str) -> bool:
    """Whether a point's name is that of a marker: ``tag36h11:7``."""
    found = _NAME.fullmatch(name.strip().lower())
    return found is not None and found[1] in _FAMILIES


def refuse_without_opencv(where: str) -> None:
    """Raises InputError ``markers_unsupported`` where nothing can find markers."""
    if importlib.util.find_spec("cv2") is None:
        raise InputError(
            "markers_unsupported",
            "names printed markers, which OpenCV finds, and that is not installed.",
            where=where,
            hint="Run `pip install 'biresnerf[markers]'`, or add where photos show the points (image, px, py).",
        )


def marked(dataset: Dataset, names: Iterable[str]) -> dict[tuple[str, int], tuple[float, float]]:
    """Where photos show the centres of these markers (px), by name and frame; not those that a photo shows twice.

    Raises:
        InputError: a code of `decode`.
    """
    wanted = {name.strip().lower(): name for name in names}
    found: dict[tuple[str, int], tuple[float, float]] = {}
    for index, frame in enumerate(dataset.frames):
        photo = decode(frame, dataset.camera_of(index))[..., :3].mean(-1).astype(np.uint8)
        for family in sorted({name.partition(":")[0] for name in wanted}):
            numbers, corners = _detected(photo, family)
            for number, corner in zip(numbers, corners, strict=True):
                name = wanted.get(f"{family}:{number}")
                if name is not None and numbers.count(number) == 1:
                    found[name, index] = _crossing(corner)
    return found


def _detected(photo: NDArray[np.uint8], family: str) -> tuple[list[int], list[NDArray[np.float64]]]:
    """Numbers of the markers in a grey photo, and their corners [4, 2] in order, px."""
    import cv2

    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{_FAMILIES[family]}"))
    parameters = cv2.aruco.DetectorParameters()
    # Of 32 rendered markers centres are within 0.17 px so; 0.62 by SUBPIX, and 0.4 px off as a whole by APRILTAG.
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_CONTOUR
    corners, numbers, _ = cv2.aruco.ArucoDetector(dictionary, parameters).detectMarkers(photo)
    if numbers is None:
        return [], []
    # OpenCV has the first pixel's centre at (0, 0).
    return [int(number) for number in np.ravel(numbers)], [
        np.asarray(c, np.float64).reshape(4, 2) + 0.5 for c in corners
    ]


def _crossing(corners: NDArray[np.float64]) -> tuple[float, float]:
    """Where the diagonals of corners [4, 2] cross: the centre of a square, however it is seen."""
    homogeneous = np.column_stack([corners, np.ones(4)])
    lines = np.cross(homogeneous[[0, 1]], homogeneous[[2, 3]])
    x, y, w = np.cross(*lines)
    return float(x / w), float(y / w)
