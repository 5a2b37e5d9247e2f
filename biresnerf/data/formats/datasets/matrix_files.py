"""A 4 x 4 matrix per image in a file of its own: ScanNet, NSVF, NeRF++, 7-Scenes, 3DMatch, MobileBrick.

Camera to world, OpenCV axes. Lenses stand in files beside: ``intrinsic/NAME.txt`` (MobileBrick, an ARKit capture),
``intrinsics/NAME.txt`` (NeRF++; pixels from the corner: nerf_sample_ray_split.py of Kai-46/nerfplusplus),
``intrinsic/intrinsic_color.txt`` (ScanNet), ``intrinsics.txt`` (NSVF: a matrix, or f, cx, cy and 0 in the first line),
``camera-intrinsics.txt`` (3DMatch). In the others a pixel's coordinates are its indices: load_intrinsics and
get_uv in fairnr/data/data_utils.py of facebookresearch/NSVF, depth2xyz in utils/geometry.py of
ActiveVisionLab/MobileBrick, the kernel of fusion.py in andyzeng/tsdf-fusion-python, which also shows 7-Scenes' axes.
ScanNet's axes: nerfstudio's scannet_dataparser.py. A pose that was lost is infinite there.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from biresnerf.data.formats.codec import Codec, head_matches
from biresnerf.data.formats.parsed_poses import LensOf, ParsedPoses
from biresnerf.data.formats.pose_rows import Placed, at_size_of, parsed_rows, pinhole_of, pose_by
from biresnerf.data.model.untrusted_file import finite_numbers, invalid_file, read_text
from biresnerf.options.formats import Format

MATRIX_FILES = Format(
    name="matrix-files",
    title="a 4 × 4 per image (ScanNet, 7-Scenes, NSVF, NeRF++, 3DMatch, MobileBrick)",
    rank=83,
    found_as=("pose", "poses", "."),
    gives="poses; intrinsics beside them",
    checked_against="the programs' sources; andyzeng/tsdf-fusion-python, andyzeng/3dmatch-toolbox, borglab/gtsfm",
)
_HINT = "Give a file of 4 rows of 4 numbers for each image, camera to world."
_FOLDERS = ("pose", "poses")
_FRAME = re.compile(r"(.*frame-\d+)\.pose\.txt$")  # 7-Scenes and 3DMatch, beside NAME.color.png
_SHARED = ("intrinsic/intrinsic_color.txt", "intrinsics.txt", "camera-intrinsics.txt")
_OWN = {"intrinsic": 0.0, "intrinsics": 0.5}  # folders, and where the first pixel's middle lies
_NUMBER = rb"[-+]?(?:[\d.]+(?:e[-+]?\d+)?|inf|nan)"
_MATRIX = rb"(?i)\s*(?:%b\s+){11}(?:(?:%b\s+){4})?%b\s*\Z" % (_NUMBER, _NUMBER, _NUMBER)


def parse_matrix_files(_root: Path, place: Path) -> ParsedPoses:
    """The poses of the files in ``place``, each for the image of its name."""
    files = _pose_files(place)
    root = _image_root(place)
    shared = next((root / name for name in _SHARED if (root / name).is_file()), None)
    shared_lens = None if shared is None else _lens(shared)

    def read(file: Path, where: str) -> Placed:
        own = next((path for name in _OWN if (path := root / name / file.name).is_file()), None)
        lens = shared_lens if own is None else _lens(own)
        values = finite_numbers(read_text(file).split(), where, _HINT, 12, 16)
        return pose_by(MATRIX_FILES, values.reshape(-1, 4), where), lens

    rows = [(name, file.name, file) for name, file in files.items()]
    used = [*files.values(), *([shared] if shared else [])]
    folders = ("color", "image")
    return parsed_rows(MATRIX_FILES, used, rows, read, take_file_names=True, photo_folders=folders)


def _pose_files(place: Path) -> dict[str, Path]:
    """The files with a matrix each, by the name of the image that each is for."""
    if place.name in _FOLDERS:
        return {f"{path.stem}.png": path for path in sorted(place.glob("*.txt")) if path.is_file()}
    found = {}
    for path in sorted([*place.glob("frame-*.pose.txt"), *place.glob("*/frame-*.pose.txt")]):
        match = _FRAME.match(path.relative_to(place).as_posix())
        if match and path.is_file():
            found[f"{match[1]}.color.png"] = path
    return found


def _recognises(place: Path) -> bool:
    """Whether the first file holds the numbers of a matrix, and nothing else."""
    first = next(iter(_pose_files(place).values()), None) if place.is_dir() else None
    return first is not None and head_matches(_MATRIX)(first)


def _lens(file: Path) -> LensOf:
    lines = [line.split() for line in read_text(file).splitlines() if line.strip()]
    numbers = [len(line) for line in lines]
    matrix: NDArray[np.float64]
    if numbers in ([4] * 4, [4] * 3, [3] * 3, [16], [12], [9]):
        words = [word for line in lines for word in line]
        matrix = finite_numbers(words, file.name, _HINT).reshape(-1, 3 if len(words) == 9 else 4)
    elif numbers and numbers[0] == 4:
        focal, cx, cy, _ = finite_numbers(lines[0], f"{file.name} first line", _HINT).tolist()
        matrix = np.array([[focal, 0.0, cx], [0.0, focal, cy], [0.0, 0.0, 1.0]])
    else:
        raise invalid_file(
            file.name, "is no intrinsic matrix of 3 or 4 rows.", "Give fx 0 cx, 0 fy cy, 0 0 1."
        )
    return at_size_of(pinhole_of(matrix, file.name, _OWN.get(file.parent.name, 0.0)))


def _image_root(place: Path) -> Path:
    return place.parent if place.name in _FOLDERS else place


def _place(file: Path) -> Path | None:
    own = file.suffix.lower() == ".txt" and (file.parent.name in _FOLDERS or _FRAME.match(file.name))
    return file.parent if own else None


CODECS = (
    Codec(
        MATRIX_FILES,
        parse=parse_matrix_files,
        recognises=_recognises,
        pose_place=_place,
        image_root=_image_root,
    ),
)
