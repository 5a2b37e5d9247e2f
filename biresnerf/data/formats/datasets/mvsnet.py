"""MVSNet's cameras: ``cams/NAME_cam.txt`` for images/NAME.

An extrinsic matrix, cam_from_world with OpenCV axes, then an intrinsic one; depths at the end are not used: load_cam in
mvsnet/preprocess.py of YoYo000/MVSNet. The first pixel's middle is (0.5, 0.5): get_pixel_grids in
mvsnet/homography_warping.py.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

from biresnerf.data.formats.codec import Codec, head_holds
from biresnerf.data.formats.parsed_poses import ParsedPoses
from biresnerf.data.formats.pose_rows import Placed, Row, at_size_of, parsed_rows, pinhole_of
from biresnerf.data.model.pose_validation import rigid_matrix
from biresnerf.data.model.untrusted_file import finite_numbers, invalid_file, read_text
from biresnerf.geometry.rigid import rigid_inverse
from biresnerf.options.formats import Format

MVSNET = Format(
    name="mvsnet",
    title="MVSNet cameras",
    rank=86,
    found_as=("cams",),
    gives="poses, one lens an image",
    checked_against="its source; LiangliangNan/RealCameraViewer",
    cam_from_world=True,
)
_HINT = "Give an extrinsic matrix of 4 rows and an intrinsic one of 3, each below its name."
_SUFFIX = "_cam.txt"


def parse_mvsnet(_root: Path, place: Path) -> ParsedPoses:
    """The cameras in the folder ``place``, each for the photo of its name.

    Raises:
        InputError: codes as in docs/input.md.
    """
    files = sorted(place.glob(f"*{_SUFFIX}"))
    rows: list[Row] = [
        (f"{file.name.removesuffix(_SUFFIX)}.jpg", file.name, partial(_read, file)) for file in files
    ]
    return parsed_rows(
        "mvsnet", files, rows, take_file_names=True, photo_folders=("images", "blended_images")
    )


def _read(file: Path) -> Placed:
    words = read_text(file).split()
    if len(words) < 27 or (words[0], words[17]) != ("extrinsic", "intrinsic"):
        raise invalid_file(file.name, "does not hold an extrinsic and an intrinsic matrix.", _HINT)
    extrinsic = finite_numbers(words[1:17], f"{file.name} extrinsic", _HINT).reshape(4, 4)
    intrinsic = finite_numbers(words[18:27], f"{file.name} intrinsic", _HINT).reshape(3, 3)
    pose = rigid_inverse(rigid_matrix(extrinsic.tolist(), f"{file.name} extrinsic")[0])
    return pose, at_size_of(pinhole_of(intrinsic, f"{file.name} intrinsic", 0.5))


def _recognises(place: Path) -> bool:
    first = next(iter(sorted(place.glob(f"*{_SUFFIX}"))), None) if place.is_dir() else None
    return first is not None and head_holds(b"extrinsic")(first)


CODECS = (
    Codec(
        MVSNET,
        parse=parse_mvsnet,
        recognises=_recognises,
        pose_place=lambda file: file.parent if file.name.endswith(_SUFFIX) else None,
        image_root=lambda place: place.parent,
    ),
)
