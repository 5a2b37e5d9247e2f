"""What pages show of a checked set before it is refined: its photos, given cameras, and how long a job will take."""

from __future__ import annotations

import os
from collections.abc import Collection, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from biresnerf.data.given_poses.readings import read_as
from biresnerf.data.model.dataset import Dataset, Frame
from biresnerf.data.photos.images import ImageSet, load_images
from biresnerf.data.photos.masks import mask_place
from biresnerf.data.photos.panoramas.cut_panoramas import as_views
from biresnerf.data.scene_kind import SceneKinds
from biresnerf.data.show.view_pictures import CELL_PX, THUMBNAIL_PX, write_contact_sheet, write_thumbnail
from biresnerf.data.workload import can_be_adjusted, workload
from biresnerf.forecast.rates import latest_machine, machine_rates
from biresnerf.machine import usable_cores
from biresnerf.options.given_poses import PoseReading
from biresnerf.options.presets import PRESET_ON, PRESETS, ComputeDevice, PresetName
from biresnerf.options.refine_options import RefineOptions
from biresnerf.wire.datasets import CheckedCamera, CheckedPhoto, MaskPlace, PhotoList, PhotoSheet
from workers.records import FIRST_PHOTO, PHOTO_LIST

SMALLEST_PX = 16  # of sets with too many photos to show


def small_side(count: int) -> int:
    """The long side, px, at which ``count`` photos are shown."""
    return next((side for most, side in CELL_PX if count <= most), SMALLEST_PX)


def write_shown(
    dataset: Dataset,
    images: ImageSet,
    checked: Path,
    sent: Collection[str],
    folder: Path,
    asked: Sequence[PoseReading],
) -> None:
    """Write into ``folder``: the list of photos with their poses, a contact sheet, and the first photo.

    Args:
        sent: the paths of the user's files in ``checked``, which now also has frames of videos.
        asked: the reading of given poses that the user is asked about; empty for none.
    """
    folder.mkdir(parents=True, exist_ok=True)
    sheet = write_contact_sheet(images, folder)
    first = load_images(replace(dataset, frames=dataset.frames[:1]), THUMBNAIL_PX)
    write_thumbnail(first.image(0), folder / FIRST_PHOTO)
    photos = PhotoList(
        photos=tuple(
            _listed(frame, checked, sent, _rows(other) if asked else None)
            for frame, other in zip(dataset.frames, read_as(dataset, asked).frames, strict=True)
        ),
        cameras=tuple(
            CheckedCamera(model=one.model, width=one.width, height=one.height, params=tuple(one.params))
            for one in dataset.cameras
        ),
        sheet=sheet and PhotoSheet(**sheet.model_dump(exclude={"file"})),
    )
    (folder / PHOTO_LIST).write_text(photos.model_dump_json(), "utf-8")


def _rows(frame: Frame) -> Any:
    return None if frame.world_from_cam is None else frame.world_from_cam[:3].tolist()


def _listed(frame: Frame, checked: Path, sent: Collection[str], as_asked: Any) -> CheckedPhoto:
    path, (mask, inverted) = _inside(frame.path, checked), mask_place(frame)
    own = path in sent
    return CheckedPhoto(
        name=frame.name,
        camera=frame.camera,
        world_from_cam=_rows(frame),
        read_as_asked=as_asked,
        masked=frame.mask is not None,
        path=path if own else None,
        orientation=frame.orientation,
        mask=MaskPlace(path=_inside(mask, checked), inverted=inverted) if own else None,
    )


def _inside(path: Path, folder: Path) -> str:
    return Path(os.path.relpath(path, folder)).as_posix()


def expected_seconds(dataset: Dataset, *, unbounded: bool) -> dict[PresetName, tuple[float, float]]:
    """Least and most seconds of a job with each preset, on a machine like that of the latest job here."""
    device, threads = _latest_machine()
    rates, adjusts = machine_rates(device, threads), can_be_adjusted(len(as_views(dataset)))
    found: dict[PresetName, tuple[float, float]] = {}
    for preset in PRESETS:
        asked = RefineOptions(preset=preset)
        kind = SceneKinds().of(unbounded)
        work = workload(dataset, asked, asked.resolved(device), kind=kind, adjusts=adjusts)
        found[preset] = rates.between(work.amounts)
    return found


def preset_here() -> PresetName:
    """The default preset on a machine like that of the latest job here."""
    return PRESET_ON[_latest_machine()[0]]


def _latest_machine() -> tuple[ComputeDevice, int]:
    kind, threads = latest_machine(usable_cores())
    return ("cuda" if kind == "cuda" else "cpu"), threads
