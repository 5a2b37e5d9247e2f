"""transforms.json as a format: written in the input's own dialect, frame, names and order."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from biresnerf.data.formats.codec import Codec, WriteContext
from biresnerf.data.formats.transforms.read_transforms import (
    bind_transforms,
    parse_transforms,
    refuse_frames_without_files,
)
from biresnerf.data.formats.transforms.write_intrinsics import (
    family,
    has_own_intrinsics,
    lens_values,
    put_lens,
)
from biresnerf.data.model.atomic_file import write_json
from biresnerf.data.model.conventions import file_from_world_from_cam
from biresnerf.data.model.dataset import Dataset
from biresnerf.data.model.refined_set import RefinedSet
from biresnerf.options.formats import Format

TRANSFORMS = Format(
    name="transforms",
    title="transforms.json (nerfstudio, instant-ngp, Blender)",
    rank=10,
    panoramas=True,
    found_as=("transforms.json", "transforms_train.json", "transform.json", "transform_train.json"),
    suffixes=(".json",),
    gives="poses (also for some images only), shared or per-frame intrinsics, masks",
    checked_against="files of each dialect; published sets",
    axes="opengl",
    in_set="transforms.json",
    always=True,
    needs=("input",),
    loses=("rigs", "points"),
    heading="For the program of the input",
    hint="Replaces the transforms.json of the photos",
)


def write_transforms(dataset: Dataset, world_from_cam: NDArray[np.float64], path: Path) -> None:
    """Writes the transforms file ``path`` like the input's: all other keys and values and the order kept.

    For a folder of images the nerfstudio dialect is written, with ``file_path`` relative to that folder.

    Args:
        dataset: the input.
        world_from_cam: float64 [n, 4, 4] in the order of ``dataset.frames``, in the input's world.
        path: the file; it appears whole or not at all.
    """
    if world_from_cam.shape != (len(dataset), 4, 4) or not np.isfinite(world_from_cam).all():
        raise ValueError(
            f"poses must be finite and of shape ({len(dataset)}, 4, 4), not {world_from_cam.shape}"
        )
    source = dataset.source
    matrices = file_from_world_from_cam(world_from_cam, source.applied_transform, source.applied_scale)
    document: dict[str, Any] = (
        dict(source.document) if source.document else {"camera_model": "OPENCV", "frames": None}
    )
    document["frames"] = [
        _frame_object(
            dataset, index, matrix.tolist(), unmoved=_unmoved(dataset, index, world_from_cam[index])
        )
        for index, matrix in enumerate(matrices)
    ]
    if not source.document:
        document = _with_intrinsics(document, dataset)
    else:
        _write_found_intrinsics(document, dataset)
    write_json(path, document)


def transforms_notes(dataset: Dataset, world_from_cam: NDArray[np.float64]) -> tuple[str, ...]:
    """What a user of the transforms file at these poses [n, 4, 4] should know."""
    notes = []
    document = dataset.source.document
    if document.get("ply_file_path") and not all(
        _unmoved(dataset, i, pose) for i, pose in enumerate(world_from_cam)
    ):
        notes.append("transforms.json still names ply_file_path: these points belong to the poses before.")
    if not document and len({family(camera) for camera in dataset.cameras}) > 1:
        notes.append(
            "transforms.json holds lenses of several kinds, which nerfstudio takes for one: "
            "give it the COLMAP model or the export pinhole."
        )
    return tuple(notes)


def _unmoved(dataset: Dataset, index: int, world_from_cam: NDArray[np.float64]) -> bool:
    given = dataset.frames[index].world_from_cam
    return given is not None and dataset.body_offset is None and np.array_equal(given, world_from_cam)


def _frame_object(
    dataset: Dataset, index: int, matrix: list[list[float]], *, unmoved: bool
) -> dict[str, Any]:
    frame = dataset.frames[index]
    row = dict(frame.raw) or {"file_path": dataset.file_names[index]}
    rows_given = row.get("transform_matrix")
    if isinstance(rows_given, list) and unmoved:
        return row  # its own digits, not those of the way to our convention and back
    row["transform_matrix"] = matrix[:3] if isinstance(rows_given, list) and len(rows_given) == 3 else matrix
    return row


def _with_intrinsics(document: dict[str, Any], dataset: Dataset) -> dict[str, Any]:
    """Intrinsics shared by all frames, or in each frame where there are several cameras."""
    frames = document.pop("frames")
    models = {family(camera) for camera in dataset.cameras}
    if len(models) == 1:
        document["camera_model"] = models.pop()
    if len(dataset.cameras) == 1:
        return {**document, **lens_values(dataset.cameras[0]), "frames": frames}
    described = [
        {"file_path": row.pop("file_path"), **lens_values(dataset.camera_of(index)), **row}
        for index, row in enumerate(frames)
    ]
    if models:
        document.pop("camera_model", None)
        for index, row in enumerate(described):
            row["camera_model"] = family(dataset.camera_of(index))
    return {**document, "frames": described}


def _write_found_intrinsics(document: dict[str, Any], dataset: Dataset) -> None:
    """Write intrinsics that the input lacks or that changed: in frames that have their own, else at the top."""
    shared = {
        frame.camera
        for frame, row in zip(dataset.frames, document["frames"], strict=True)
        if not has_own_intrinsics(row)
    }
    for frame, row in zip(dataset.frames, document["frames"], strict=True):
        if dataset.source_of_intrinsics(frame.camera) == "given":
            continue
        own = has_own_intrinsics(row) or len(shared) > 1
        put_lens(row if own else document, dataset.cameras[frame.camera])


def _write(refined: RefinedSet, path: Path, context: WriteContext) -> None:
    if context.dataset is not None:
        write_transforms(context.dataset, refined.world_from_cam, path)


CODECS = (
    Codec(
        TRANSFORMS,
        parse=parse_transforms,
        bind=bind_transforms,
        refuse_early=refuse_frames_without_files,
        write=_write,
    ),
)
