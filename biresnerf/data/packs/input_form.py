"""The caller's own form back, where it is none of those that every result has."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from biresnerf.config import PackName
from biresnerf.data.atomic_file import whole_file
from biresnerf.data.dataset import Dataset
from biresnerf.data.refined_set import RefinedSet

POSES_BOUNDS = "poses_bounds.npy"


def forms_of_input(dataset: Dataset) -> tuple[PackName, ...]:
    """The packs that a result has because its input was one of them."""
    source = dataset.source
    if source.dialect == "kitti":
        return ("kitti",)
    if source.dialect == "bundler":
        return ("bundler",)
    return ("colmap-text",) if source.colmap is not None and source.colmap.form == "text" else ()


def write_poses_bounds(refined: RefinedSet, given: Path, path: Path) -> None:
    """LLFF's file at the refined poses: rows, their order and their bounds of depth as in the file ``given``.

    The fifth column is height, width and focal length (px) of the images as they are.

    Raises:
        ValueError: the file has not a row for each image.
    """
    rows = np.array(np.load(given, allow_pickle=False), dtype=np.float64)
    if rows.shape != (len(refined), 17):
        raise ValueError(f"{given.name} has {rows.shape}, not a row for each of {len(refined)} images")
    for index, image in enumerate(refined.images):
        pose, camera = image.world_from_cam, refined.camera_of(index)
        right, down, ahead, centre = pose[:3].T
        lens = np.array([camera.height, camera.width, (camera.full().fx * camera.full().fy) ** 0.5])
        rows[index, :15] = np.stack([down, right, -ahead, centre, lens], axis=1).ravel()
    with whole_file(path) as temporary, temporary.open("wb") as file:
        np.save(file, rows)


def write_input_form(dataset: Dataset, refined: RefinedSet, folder: Path) -> None:
    """Writes the file of the input's own form into ``folder``, where no pack is that form."""
    if dataset.source.dialect == "llff":
        write_poses_bounds(refined, dataset.source.files[0], folder / POSES_BOUNDS)
