"""``transforms_nerfstudio.json``: any set by the rules of nerfstudio's parser, with its points.

Rules: nerfstudio/data/dataparsers/nerfstudio_dataparser.py (1.1.5). The world is kept. Images and points.ply are named
by their path relative to the caller's folder: put both files there.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from biresnerf.data.formats.codec import Codec, LensLimits, WriteContext, cannot_hold
from biresnerf.data.formats.simple.points_ply import POINTS_PLY, write_points_ply
from biresnerf.data.formats.transforms.read_transforms import (
    bind_transforms,
    parse_transforms,
    refuse_frames_without_files,
)
from biresnerf.data.formats.transforms.write_intrinsics import lens_values, listed_frames
from biresnerf.data.model.atomic_file import write_json
from biresnerf.data.model.dataset import Dataset
from biresnerf.data.model.refined_set import RefinedSet
from biresnerf.geometry.camera.camera_models import COEFFICIENTS, Camera
from biresnerf.options.formats import Format

NERFSTUDIO = Format(
    name="nerfstudio",
    title="transforms_nerfstudio.json (nerfstudio)",
    rank=25,
    found_as=("transforms_nerfstudio.json",),
    suffixes=(".json",),
    gives="as a transforms.json",
    checked_against="its writer",
    axes="opengl",
    in_set="transforms_nerfstudio.json",
    always=True,
    loses=("rigs", "mask paths"),
    splats=True,
    instead="pinhole",
    lacks="FULL_OPENCV beyond k3; THIN_PRISM_FISHEYE; fisheyes beside other lenses",
    heading="For nerfstudio",
    hint="With points.ply beside it in the folder of the photos: ns-train splatfacto --data FILE",
)

# What the parser reads; all of them, or none, at the top.
_RADIAL = ("k1", "k2", "k3", "k4")
_BROWN = (*_RADIAL, "p1", "p2")
# The k4 of another lens than a fisheye is the rational model's, which it does not know.
_LENSES = LensLimits("nerfstudio")


def write_nerfstudio(refined: RefinedSet, path: Path, dataset: Dataset | None = None) -> None:
    """Writes the file, whole or not at all, and points.ply beside it where there are points.

    Args:
        dataset: the input, for its masks; nerfstudio takes masks for all images or for none.

    Raises:
        InputError: ``export_not_possible``: a lens that nerfstudio does not have.
    """
    _LENSES.refuse(refined.cameras, NERFSTUDIO.in_result)
    kinds = {camera.full().fisheye for camera in refined.cameras}
    if len(kinds) > 1:
        what = "nerfstudio takes all lenses of a set for fisheyes, or none."
        raise cannot_hold(NERFSTUDIO.in_result, what)
    masks = [{"mask_path": name} for name in _masks(dataset)]
    shared, frames = listed_frames(refined, [_lens(camera) for camera in refined.cameras], masks)
    document: dict[str, Any] = {"camera_model": "OPENCV_FISHEYE" if kinds == {True} else "OPENCV", **shared}
    if len(refined.model.points):
        write_points_ply(refined, path.with_name(POINTS_PLY.in_set))
        document["ply_file_path"] = POINTS_PLY.in_set
    write_json(path, {**document, "frames": frames})


def _lens(camera: Camera) -> dict[str, Any]:
    full = camera.full()
    values = {key: value for key, value in lens_values(camera).items() if key not in COEFFICIENTS}
    coefficients = _RADIAL if full.fisheye else _BROWN if full.distorted else ()
    return values | {name: getattr(full, name) for name in coefficients}


def _masks(dataset: Dataset | None) -> list[str]:
    """The masks of all images, by their path in the set's folder; none where it cannot use them."""
    names: list[str] = []
    if dataset is None:
        return names
    for frame in dataset.frames:
        if frame.mask is None or frame.mask_inverted or not frame.mask.is_relative_to(dataset.root):
            return []
        names.append(frame.mask.relative_to(dataset.root).as_posix())
    return names


def _write(refined: RefinedSet, path: Path, context: WriteContext) -> None:
    write_nerfstudio(refined, path, context.dataset)


CODECS = (
    Codec(
        NERFSTUDIO,
        parse=parse_transforms,
        bind=bind_transforms,
        refuse_early=refuse_frames_without_files,
        write=_write,
    ),
)
