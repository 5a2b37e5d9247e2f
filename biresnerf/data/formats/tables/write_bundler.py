"""Bundler's ``bundle.out`` (v0.3) with its ``list.txt``, which Metashape and others import.

Its cameras look along -z with y up, have one focal length, two radial coefficients and their principal point in the
image's centre; keypoints are measured from there, y up. Format: Bundler v0.4 user's manual, section 6.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np

from biresnerf.data.model.atomic_file import whole_file
from biresnerf.data.model.colmap_scene import ColmapModel
from biresnerf.data.model.dataset import Camera
from biresnerf.data.model.refined_set import RefinedSet
from biresnerf.errors import InputError

_FLIP = np.diag([1.0, -1.0, -1.0])
_CENTRED_PX = 1e-6


def bundler_problem(camera: Camera) -> str | None:
    """Why Bundler cannot hold this lens, or None where it can."""
    if camera.model not in ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV"):
        return f"{camera.model} is another kind of lens"
    full = camera.full()
    if full.fx != full.fy:
        return "it has two focal lengths"
    if abs(full.cx - camera.width / 2) > _CENTRED_PX or abs(full.cy - camera.height / 2) > _CENTRED_PX:
        return "its principal point is not in the image's centre"
    named = {**full._asdict(), "k1": 0.0, "k2": 0.0, "fx": 0.0, "fy": 0.0, "cx": 0.0, "cy": 0.0}
    if any(named.values()):
        return "it has more distortion than two radial coefficients"
    return None


def refuse_lenses(
    cameras: Iterable[Camera], problem_of: Callable[[Camera], str | None], form: str, where: str, hint: str
) -> None:
    """Raises InputError ``pack_not_possible`` for the first lens with a problem; ``form`` is whose (Bundler's)."""
    for camera in cameras:
        problem = problem_of(camera)
        if problem is not None:
            raise InputError(
                "pack_not_possible",
                f"{form} cannot hold a lens of this set: {problem}.",
                where=where,
                hint=hint,
            )


def write_bundler(refined: RefinedSet, folder: Path) -> None:
    """Writes ``bundle.out`` and ``list.txt`` (image names in the cameras' order) into ``folder``.

    Raises:
        InputError: ``pack_not_possible``: a lens that the format cannot hold.
    """
    hint = "Ask for the pinhole pack: it holds undistorted images, and a bundle.out for them."
    refuse_lenses(refined.cameras, bundler_problem, "Bundler's format", "bundler", hint)
    lines = ["# Bundle file v0.3", f"{len(refined)} {len(refined.model.points)}"]
    for index, cam_from_world in enumerate(refined.cam_from_world):
        full = refined.camera_of(index).full()
        lines.append(f"{full.fx!r} {full.k1!r} {full.k2!r}")
        rotation, translation = _FLIP @ cam_from_world[:3, :3], _FLIP @ cam_from_world[:3, 3]
        lines += [
            " ".join(repr(value) for value in row) for row in [*rotation.tolist(), translation.tolist()]
        ]
    lines += _point_lines(refined)
    with whole_file(folder / "list.txt") as temporary:
        names = [" ".join(image.file_name.splitlines()) for image in refined.images]
        temporary.write_text("\n".join(names) + "\n", "utf-8")
    with whole_file(folder / "bundle.out") as temporary:
        temporary.write_text("\n".join(lines) + "\n", "utf-8")


def _point_lines(refined: RefinedSet) -> list[str]:
    model: ColmapModel = refined.model
    points = model.points
    row_of_id = {number: row for row, number in enumerate(refined.image_ids)}
    lines = []
    for k in range(len(points)):
        track = slice(int(points.track_starts[k]), int(points.track_starts[k + 1]))
        views = []
        for image_id, keypoint in zip(
            points.track_image_ids[track].tolist(), points.track_point2d_indices[track].tolist(), strict=True
        ):
            row = row_of_id[image_id]
            camera = refined.camera_of(row)
            x, y = model.images[image_id].points2d_px[keypoint].tolist()
            views.append(f"{row} {keypoint} {x - camera.width / 2!r} {camera.height / 2 - y!r}")
        lines.append(" ".join(repr(value) for value in points.xyz[k].tolist()))
        lines.append(" ".join(str(value) for value in points.rgb[k].tolist()))
        lines.append(" ".join([str(len(views)), *views]))
    return lines
