"""What can be shown of a set before any pose has moved: its photos, its poses, and what matches say so far."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image
from pydantic import Field

from biresnerf.data.formats.simple.poses_json import POSES, write_poses_json
from biresnerf.data.model.atomic_file import whole_file, write_text
from biresnerf.data.model.dataset import Dataset, Frame
from biresnerf.data.model.refined_set import RefinedSet
from biresnerf.data.photos.decode import as_stored
from biresnerf.data.photos.image_files import UNREADABLE, header_of, is_sixteen_bit, open_image, quiet_pillow
from biresnerf.data.photos.kinds.sixteen_bit import as_eight_bit
from biresnerf.data.photos.orientation import turned
from biresnerf.data.seeding.seeding_progress import SeedingProgress
from biresnerf.frozen_model import FrozenModel

SEEDING_JSON, PHOTOS = "seeding.json", "photos.jpg"
SHEET_COLUMNS, SHEET_MOST = 6, 36
TILE, _GAP = 128, 4  # px
_GROUND = (238, 238, 238)


class SeedingImage(FrozenModel):
    """What is known of one photo."""

    name: str
    posed: bool
    features: int | None = Field(description="How many were found; None before it was searched.")
    partners: int = Field(description="Photos that it has matches with.")


class SeedingPreview(FrozenModel):
    """``seeding.json``: how far the search for matching features is."""

    matched_pairs: int
    images: tuple[SeedingImage, ...]


def write_seeding_preview(
    dataset: Dataset, found: SeedingProgress, folder: Path, poses: RefinedSet | None
) -> list[Path]:
    """The files photos.jpg, seeding.json and, where there are poses of all images, poses.json.

    Args:
        dataset: as it was given.
        found: what COLMAP has found so far.
        poses: those given, or to start from.
    """
    sheet, progress = folder / PHOTOS, folder / SEEDING_JSON
    if not sheet.is_file():
        write_contact_sheet(dataset.frames, sheet)
    write_text(progress, _described(dataset, found).model_dump_json(indent=1))
    if poses is None:
        return [sheet, progress]
    write_poses_json(poses, folder / POSES)
    return [sheet, progress, folder / POSES]


def _described(dataset: Dataset, found: SeedingProgress) -> SeedingPreview:
    partners = Counter(index for pair in found.matches for index in pair)
    posed = dataset.posed.tolist()
    images = tuple(
        SeedingImage(name=f.name, posed=posed[i], features=found.features.get(i), partners=partners[i])
        for i, f in enumerate(dataset.frames)
    )
    return SeedingPreview(matched_pairs=len(found.matches), images=images)


def write_contact_sheet(frames: Sequence[Frame], path: Path) -> None:
    """Photos, evenly spread over the set, 36 at most, side by side in one JPEG."""
    shown = [frames[i] for i in np.linspace(0, len(frames) - 1, min(SHEET_MOST, len(frames))).astype(int)]
    rows = -(-len(shown) // SHEET_COLUMNS)
    sheet = Image.new("RGB", (TILE * min(SHEET_COLUMNS, len(shown)), TILE * rows), _GROUND)
    with quiet_pillow():
        for place, frame in enumerate(shown):
            try:
                tile = _tile(frame)
            except UNREADABLE:  # its place stays empty; reading the set says what is wrong with it
                continue
            row, column = divmod(place, SHEET_COLUMNS)
            left, top = (TILE - tile.width) // 2, (TILE - tile.height) // 2
            sheet.paste(tile, (TILE * column + left, TILE * row + top))
    with whole_file(path) as temporary:
        sheet.save(temporary, "JPEG", quality=80)


def _tile(frame: Frame) -> Image.Image:
    with open_image(frame.path, frame.name) as image:
        image.draft("RGB", (2 * TILE, 2 * TILE))  # a JPEG is decoded no larger than needed
        picture: Image.Image = image
        if is_sixteen_bit(image):
            picture = Image.fromarray(as_eight_bit(np.asarray(image), frame.levels))
        elif image.mode.startswith(("I", "F")):  # Pillow would clip them
            grey = np.asarray(image, dtype=np.float32)
            picture = Image.fromarray((grey * (255 / max(1.0, float(grey.max())))).astype(np.uint8))
        picture = picture.convert("RGBA")
        picture.thumbnail((TILE - _GAP, TILE - _GAP))
        on_ground = Image.alpha_composite(Image.new("RGBA", picture.size, (*_GROUND, 255)), picture)
        stored = as_stored(np.asarray(on_ground.convert("RGB")), image, header_of(image).orientation)
    return Image.fromarray(turned(stored, frame.orientation))
