"""Add photos to a finished result: its photos keep their poses and lenses, and the new ones join their frame."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from biresnerf.data.formats.match_names import match_files
from biresnerf.data.formats.read_dataset import read_poses
from biresnerf.data.formats.transforms.write_transforms import TRANSFORMS
from biresnerf.data.model.dataset import Dataset
from biresnerf.data.model.part_of_set import with_frames
from biresnerf.data.photos.panoramas.cut_panoramas import PANORAMA_VIEWS
from biresnerf.errors import InputError
from biresnerf.geometry.camera.camera_models import Camera
from biresnerf.options.refine_options import RefineOptions
from biresnerf.result import load


def joined_to(dataset: Dataset, options: RefineOptions, result: Path) -> tuple[Dataset, RefineOptions]:
    """The set with the result's poses and lenses for the photos that the result has; and options that keep these.

    Photos that share a camera with one of them see through its lens, if all of them see through one.

    Raises:
        InputError: ``result_missing``, ``no_common_images``, or a code of the readers.
    """
    earlier = load(result)
    pose_of = dict(zip(earlier.names, earlier.poses, strict=True))
    lens_of = dict(zip(earlier.names, earlier.intrinsics, strict=True))
    if any(name.startswith(f"{PANORAMA_VIEWS}/") for name in earlier.names):
        # It has one pose for each panorama; the others are of its views.
        pose_of = read_poses(result / TRANSFORMS.in_result)
    found = {name: known for known, name in match_files(list(pose_of), dataset.names)[0].items()}
    if not found:
        raise InputError(
            "no_common_images",
            "has no photo of the earlier result.",
            where=dataset.root.name,
            hint="Give the old photos under their old names, and the new ones beside them.",
        )
    cameras = list(dataset.cameras)
    sources = [dataset.source_of_intrinsics(camera) for camera in range(len(cameras))]
    numbers: dict[Camera, int] = {}
    frames = []
    for index, frame in enumerate(dataset.frames):
        if frame.name in found:
            known = found[frame.name]
            frame = replace(frame, world_from_cam=pose_of[known], pose_source="given")
            if known not in lens_of:  # a panorama, which has none
                frames.append(frame)
                continue
            number = numbers.setdefault(lens_of[known], len(cameras))
            if number == len(cameras):
                cameras.append(lens_of[known])
                sources.append("given")
            # A file's poses may be of pixels as they are stored, where a photo alone is turned upright.
            shown = (dataset.camera_of(index).width, dataset.camera_of(index).height)
            turned = frame.orientation if shown == (lens_of[known].width, lens_of[known].height) else 1
            frame = replace(frame, camera=number, orientation=turned)
        frames.append(frame)
    shared = _shared(dataset, [frame.camera for frame in frames])
    joined = [replace(frame, camera=shared.get(frame.camera, frame.camera)) for frame in frames]
    seen_by_all = replace(dataset, cameras=tuple(cameras), intrinsics_sources=tuple(sources))
    fixed = dict.fromkeys((*options.fixed, *found))
    return with_frames(seen_by_all, joined), options.model_copy(update={"fixed": tuple(fixed)})


def _shared(dataset: Dataset, now: list[int]) -> dict[int, int]:
    """For each camera of the set, the result's camera that all its known photos share, if there is one."""
    known: dict[int, set[int]] = {}
    for frame, camera in zip(dataset.frames, now, strict=True):
        if camera != frame.camera:
            known.setdefault(frame.camera, set()).add(camera)
    return {camera: min(found) for camera, found in known.items() if len(found) == 1}
