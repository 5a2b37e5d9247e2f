"""What an earlier run left in the output folder, and whether this run may continue from it."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

from biresnerf.data.model.atomic_file import whole_file
from biresnerf.data.model.dataset import Dataset
from biresnerf.data.photos.images import ImageSet
from biresnerf.errors import InputError
from biresnerf.options.refine_options import RESULT_OPTIONS, STAGE_1_OPTIONS
from biresnerf.refinement.optimise.method_changes import differences
from biresnerf.refinement.optimise.methods import Recipe
from biresnerf.refinement.stages.checkpoint import (
    COARSE,
    SEEDING,
    TRACKS,
    Checkpoint,
    RunOrigin,
    load_checkpoint,
)
from biresnerf.stages import OTHER_FOLDER, ReusableStage


def earlier_work(folder: Path) -> Checkpoint | None:
    """The checkpoint of an unfinished run, or the end of stage 1 of a run that shares it; None if there is neither.

    COLMAP's answer is restored from it: the checkpoint may have been copied without the rest of its folder.

    Raises:
        InputError: ``checkpoint_invalid``.
    """
    earlier = load_checkpoint(folder) or load_checkpoint(folder, COARSE)
    if earlier is not None and earlier.origin.seeding is not None:
        with whole_file(folder / SEEDING) as temporary:
            temporary.write_text(earlier.origin.seeding, "utf-8")
    return earlier


def run_origin(folder: Path, dataset: Dataset, images: ImageSet, recipe: Recipe) -> RunOrigin:
    """What identifies a run: its photos at working size, given poses, options and method.

    Args:
        dataset: as it was given, before poses were found.
    """
    photos = hashlib.sha256(images.pixels.data)
    if images.counts is not None:
        photos.update(images.counts.data)
    given = [None if f.world_from_cam is None else f.world_from_cam.tolist() for f in dataset.frames]

    def fingerprint(names: frozenset[str]) -> str:
        digest = photos.copy()
        options = recipe.options.model_dump(include=set(names))
        content: list[Any] = [options, differences(recipe), dataset.names, given]
        digest.update(json.dumps(content, sort_keys=True).encode())
        return digest.hexdigest()

    seeding = folder / SEEDING
    return RunOrigin(
        fingerprint=fingerprint(RESULT_OPTIONS),
        stage_1_fingerprint=fingerprint(STAGE_1_OPTIONS),
        seeding=seeding.read_text("utf-8") if seeding.is_file() else None,
    )


def refuse_other_run(folder: Path, earlier: Checkpoint, origin: RunOrigin) -> None:
    """Raise `InputError` if a run of this origin cannot continue from earlier work."""
    if earlier.ends_stage_1:
        if earlier.origin.stage_1_fingerprint != origin.stage_1_fingerprint:
            raise InputError(
                "stage_1_not_usable",
                "is of other images, poses or options, or of another kind of device.",
                where=COARSE.as_posix(),
                hint="Start from its seeding, or from the beginning.",
            )
    elif earlier.origin.fingerprint != origin.fingerprint:
        raise InputError(
            "output_not_resumable",
            "holds an unfinished run of other images, poses or options.",
            where=str(folder),
            hint=OTHER_FOLDER,
        )


def reusable_seeding(folder: Path) -> dict[ReusableStage, tuple[str, ...]]:
    """Files that another run can take COLMAP's answer from; empty if COLMAP did not run."""
    kept = tuple(path.as_posix() for path in (SEEDING, TRACKS) if (folder / path).is_file())
    return {"seeding": kept} if SEEDING.as_posix() in kept else {}
