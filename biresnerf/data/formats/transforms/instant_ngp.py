"""``transforms_ngp.json``: the poses by the rules of instant-ngp's loader (src/nerf_loader.cu).

The world is kept; ``scale`` and ``offset`` say where the scene lies in the loader's unit cube, so nothing is moved in
the matrices. Images are named by their path relative to the caller's folder: put the file there.
"""

from __future__ import annotations

from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from biresnerf.data.formats.codec import Codec, LensLimits, cannot_hold
from biresnerf.data.formats.transforms.read_transforms import (
    bind_transforms,
    parse_transforms,
    refuse_frames_without_files,
)
from biresnerf.data.formats.transforms.write_intrinsics import lens_values, listed_frames, ngp_coefficients
from biresnerf.data.model.atomic_file import write_json
from biresnerf.data.model.refined_set import RefinedSet
from biresnerf.geometry.camera.camera_models import COEFFICIENTS, Camera
from biresnerf.geometry.focus import focus_point
from biresnerf.options.formats import Format

INSTANT_NGP = Format(
    name="instant-ngp",
    title="transforms_ngp.json (instant-ngp)",
    rank=30,
    found_as=("transforms_ngp.json",),
    suffixes=(".json",),
    gives="as a transforms.json",
    checked_against="its writer",
    axes="opengl",
    in_set="transforms_ngp.json",
    loses=("rigs", "points", "mask paths"),
    instead="pinhole",
    lacks="FULL_OPENCV; THIN_PRISM_FISHEYE; WebP and TIFF images",
    heading="For instant-ngp",
    hint="Put it into the folder of the photos and open it in instant-ngp",
)

LARGEST_AABB = 128  # the loader's bound; powers of two only
INNER_SHARE = 0.9  # of the unit cube, for what the cameras look at
POINTS_INSIDE = 0.98  # of the points that the box must hold
_LENSES = LensLimits("instant-ngp", ("k1", "k2", "p1", "p2"))
# What its image reader decodes, of what we read.
_SUFFIXES = frozenset({".png", ".jpg", ".jpeg", ".bmp"})


def write_transforms_ngp(refined: RefinedSet, path: Path) -> None:
    """Writes the file, whole or not at all.

    Raises:
        InputError: ``export_not_possible``: a lens that instant-ngp does not have, or images it cannot decode.
    """
    for image in refined.images:
        if PurePosixPath(image.file_name).suffix.lower() not in _SUFFIXES:
            what = f"instant-ngp cannot decode {image.file_name}."
            raise cannot_hold(INSTANT_NGP.in_result, what)
    _LENSES.refuse(refined.cameras, INSTANT_NGP.in_result)
    shared, frames = listed_frames(refined, [_lens(camera) for camera in refined.cameras])
    scale, offset, aabb_scale = _placement(refined)
    placed = {"scale": scale, "offset": offset, "aabb_scale": aabb_scale}
    write_json(path, {**shared, **placed, "frames": frames})


def _lens(camera: Camera) -> dict[str, Any]:
    full = camera.full()
    lacking = {*COEFFICIENTS} - {*ngp_coefficients(full)}
    values = {key: value for key, value in lens_values(camera).items() if key not in lacking}
    return {**values, "is_fisheye": True} if full.fisheye else values


def _placement(refined: RefinedSet) -> tuple[float, list[float], int]:
    """``scale``, ``offset`` and ``aabb_scale``: what the cameras look at fills the unit cube, and all of it the box."""
    poses = refined.world_from_cam
    focus = focus_point(poses)
    cameras = [refined.camera_of(index) for index in range(len(refined))]
    tangents = [max(c.width / c.full().fx, c.height / c.full().fy) / 2 for c in cameras]
    half = max(focus.mean_distance * float(np.median(tangents)), 1e-9)
    scale = 0.5 * INNER_SHARE / half
    reach = [np.abs(poses[:, :3, 3] - focus.point).max()]
    if len(refined.model.points):
        away = np.abs(refined.model.points.xyz - focus.point).max(1)
        reach.append(np.quantile(away, POINTS_INSIDE))
    aabb_scale = 1
    while aabb_scale < LARGEST_AABB and 0.5 * aabb_scale < scale * max(reach):
        aabb_scale *= 2
    return scale, (0.5 - scale * focus.point).tolist(), aabb_scale


CODECS = (
    Codec(
        INSTANT_NGP,
        parse=parse_transforms,
        refuse_early=refuse_frames_without_files,
        bind=bind_transforms,
        write=lambda refined, path, _: write_transforms_ngp(refined, path),
    ),
)
