"""``poses.csv``: one row an image, for spreadsheets and scripts: where it was taken, and how exactly that is known."""

from __future__ import annotations

import csv
import io
from pathlib import Path

from biresnerf.data.formats.codec import Codec
from biresnerf.data.model.atomic_file import write_text
from biresnerf.data.model.conventions import quat_wxyz_from_rotation
from biresnerf.data.model.refined_set import RefinedSet
from biresnerf.options.formats import Format

POSES_CSV = Format(
    name="csv",
    title="poses.csv",
    rank=91,
    in_set="poses.csv",
    always=True,
    loses=("lenses", "rigs", "points", "mask paths"),
    heading="For spreadsheets",
    hint="Each pose, and how exactly it is known",
)

# Centre and quaternion of world_from_cam, OpenCV axes, in the input's world; 90 % bounds of their errors, empty where
# not known.
COLUMNS = (
    "image", "x", "y", "z", "qw", "qx", "qy", "qz", "rotation_deg_90", "position_90", "known_from", "why_unknown",
    "pose_source", "flags",
)  # fmt: skip


def write_poses_csv(refined: RefinedSet, path: Path) -> None:
    """Writes the file, whole or not at all; numbers with all their digits."""
    file = io.StringIO()
    table = csv.writer(file, lineterminator="\n")
    table.writerow(COLUMNS)
    for image in refined.images:
        known = image.uncertainty
        said = (
            ("", "", "", "")
            if known is None
            else (known.rotation_deg, known.position, known.known_from, known.why_unknown)
        )
        centre = image.world_from_cam[:3, 3].tolist()
        rotation = quat_wxyz_from_rotation(image.world_from_cam[:3, :3]).tolist()
        table.writerow([image.name, *centre, *rotation, *said, image.pose_source, " ".join(image.flags)])
    write_text(path, file.getvalue())


CODECS = (Codec(POSES_CSV, write=lambda refined, path, _: write_poses_csv(refined, path)),)
