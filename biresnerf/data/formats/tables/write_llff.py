"""LLFF's ``poses_bounds.npy``: poses, one focal length and two bounds of depth an image; no names, no distortion."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from biresnerf.data.formats.tables.write_bundler import bundler_problem, refuse_lenses
from biresnerf.data.model.atomic_file import whole_file
from biresnerf.data.model.dataset import Camera
from biresnerf.data.model.refined_set import RefinedSet
from biresnerf.errors import InputError

POSES_BOUNDS = "poses_bounds.npy"
# LLFF's own shares of the points in front of a camera that may lie before and behind its bounds, percent.
_NEAREST, _FARTHEST = 0.1, 99.9


def llff_problem(camera: Camera) -> str | None:
    """Why LLFF's form cannot hold this lens, or None where it can."""
    problem = bundler_problem(camera)
    if problem is None and any(camera.full()[4:]):
        return "it is distorted"
    return problem


def rows_by_name(refined: RefinedSet) -> list[int]:
    """The images as readers of a form without names take them: by the order of their files' names."""
    return sorted(range(len(refined)), key=lambda index: refined.images[index].file_name)


def given_bounds(file: Path, count: int) -> NDArray[np.float64]:
    """The bounds of depth [count, 2] of a ``poses_bounds.npy`` that has been read as an input of so many images.

    Raises:
        ValueError: the file has not a row for each image.
    """
    rows = np.load(file, allow_pickle=False)
    if rows.shape != (count, 17):
        raise ValueError(f"{file.name} has {rows.shape}, not a row for each of {count} images")
    return np.asarray(rows[:, 15:], dtype=np.float64)


def write_llff(refined: RefinedSet, path: Path, bounds: NDArray[np.float64] | None = None) -> None:
    """Writes the set in the order of its files' names.

    Args:
        bounds: nearest and farthest depth [n, 2] of the images; where left out, of the points that each sees.

    Raises:
        InputError: ``pack_not_possible``: a lens that the form cannot hold; ``bounds_missing``: no points are seen.
    """
    hint = "Convert to pinhole, which undistorts the photos, then that folder to llff."
    refuse_lenses(refined.cameras, llff_problem, "LLFF's form", "llff", hint)
    order = rows_by_name(refined)
    if bounds is None:
        bounds = np.array([_bounds_of_points(refined, index) for index in range(len(refined))])
    write_poses_bounds(refined, order, bounds, path)


def _bounds_of_points(refined: RefinedSet, index: int) -> tuple[float, float]:
    """Between these depths lie the points that the image sees, but for a thousandth at either end."""
    model = refined.model
    seen = model.points.track_image_ids == refined.image_ids[index]
    of_point = np.repeat(np.arange(len(model.points)), np.diff(model.points.track_starts))
    pose = refined.world_from_cam[index]
    depths = (model.points.xyz[of_point[seen]] - pose[:3, 3]) @ pose[:3, 2]
    depths = depths[depths > 0]
    if not len(depths):
        raise InputError(
            "bounds_missing",
            "sees no points that would tell its bounds of depth.",
            where=refined.images[index].name,
            hint="Give the depth of what is nearest and farthest: --bounds NEAR FAR.",
        )
    near, far = np.percentile(depths, (_NEAREST, _FARTHEST)).tolist()
    return near, far


def write_poses_bounds(
    refined: RefinedSet, order: list[int], bounds: NDArray[np.float64], path: Path
) -> None:
    """A row for each image, in this ``order``; ``bounds`` [n, 2] are in the set's.

    The fifth column is height, width and focal length (px) of the images as they are.
    """
    rows = np.empty((len(order), 17))
    rows[:, 15:] = bounds[order]
    for row, index in zip(rows, order, strict=True):
        camera = refined.camera_of(index)
        right, down, ahead, centre = refined.images[index].world_from_cam[:3].T
        lens = np.array([camera.height, camera.width, (camera.full().fx * camera.full().fy) ** 0.5])
        row[:15] = np.stack([down, right, -ahead, centre, lens], axis=1).ravel()
    with whole_file(path) as temporary, temporary.open("wb") as file:
        np.save(file, rows)
