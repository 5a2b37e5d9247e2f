"""``cameras_sphere.npz`` of NeuS and IDR: a projection of each image, and the sphere that holds the object.

Conventions: models/dataset.py of Totoro97/NeuS. ``world_mat_i`` is K [R | t] of cam_from_world, OpenCV axes;
``scale_mat_i`` takes the unit sphere to the world. A pixel's coordinates are its indices (gen_rays_at), so the
principal point lies half a pixel nearer to the corner than here. Rows belong to the photos of image/ by name.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from biresnerf.data.formats.codec import Codec
from biresnerf.data.formats.simple.bundler import refuse_lenses
from biresnerf.data.formats.simple.llff import rows_by_name
from biresnerf.data.model.atomic_file import whole_file
from biresnerf.data.model.refined_set import RefinedSet
from biresnerf.geometry.camera.camera_models import Camera
from biresnerf.geometry.focus import focus_point
from biresnerf.options.formats import Format

NEUS = Format(
    name="neus",
    title="cameras_sphere.npz (NeuS, IDR)",
    rank=55,
    in_set="cameras_sphere.npz",
    loses=("names", "distortion", "rigs", "points", "mask paths"),
    instead="pinhole",
    heading="For NeuS, IDR",
    hint="Beside image/ and mask/, whose files are in the order of their names",
)
_HELD = 0.98  # of the points that the sphere must hold
_HALF_PX = 0.5


def write_neus(refined: RefinedSet, path: Path) -> None:
    """Writes the file, whole or not at all.

    The sphere's centre is what the cameras look at. It holds nearly all points, or where there are none, what the
    cameras see at that distance.

    Raises:
        InputError: ``export_not_possible``: a distorted lens.
    """
    hint = "Convert to pinhole, which undistorts the photos, then that folder to neus."
    refuse_lenses(refined.cameras, _problem, "NeuS", path.name, hint)
    scale = _sphere(refined)
    matrices = {}
    for row, index in enumerate(rows_by_name(refined)):
        full = refined.camera_of(index).full()
        lens = np.eye(4)
        lens[0, [0, 2]], lens[1, [1, 2]] = (full.fx, full.cx - _HALF_PX), (full.fy, full.cy - _HALF_PX)
        matrices[f"world_mat_{row}"] = lens @ refined.cam_from_world[index]
        matrices[f"scale_mat_{row}"] = scale
    with whole_file(path) as temporary, temporary.open("wb") as file:
        np.savez(file, **matrices)


def _problem(camera: Camera) -> str | None:
    full = camera.full()
    if full.fisheye:
        return f"{camera.model} is a fisheye"
    return "it is distorted" if full.distorted else None


def _sphere(refined: RefinedSet) -> NDArray[np.float64]:
    """``world_from_sphere`` [4, 4]."""
    focus, points = focus_point(refined.world_from_cam), refined.model.points.xyz
    if len(points):
        radius = float(np.quantile(np.linalg.norm(points - focus.point, axis=1), _HELD))
    else:
        tangents = [max(c.width / c.full().fx, c.height / c.full().fy) / 2 for c in refined.cameras]
        radius = focus.mean_distance * float(np.median(tangents))
    matrix = np.diag([*[max(radius, 1e-9)] * 3, 1.0])
    matrix[:3, 3] = focus.point
    return matrix


CODECS = (Codec(NEUS, write=lambda refined, path, _: write_neus(refined, path)),)
