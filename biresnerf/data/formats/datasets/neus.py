"""``cameras_sphere.npz`` of NeuS and IDR: a projection of each image, and the sphere that holds the object.

Conventions: models/dataset.py of Totoro97/NeuS. ``world_mat_i`` is K [R | t] of cam_from_world, OpenCV axes;
``scale_mat_i`` takes the unit sphere to the world. A pixel's coordinates are its indices (gen_rays_at), so the
principal point lies half a pixel nearer to the corner than here. Rows belong to the photos of image/ by name. IDR's
cameras.npz is the same.
"""

from __future__ import annotations

import re
import zipfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path, PurePosixPath

import numpy as np
from numpy.typing import NDArray

from biresnerf.data.formats.codec import Codec, LensLimits
from biresnerf.data.formats.parsed_poses import Assignment, ParsedPoses
from biresnerf.data.formats.pose_rows import Placed, at_size_of, parsed_rows, pinhole_of, pose_by
from biresnerf.data.formats.simple.llff import rows_by_name
from biresnerf.data.model.array_file import npz_numbers
from biresnerf.data.model.atomic_file import whole_file
from biresnerf.data.model.refined_set import RefinedSet
from biresnerf.data.model.untrusted_file import invalid_file, refuse_not_finite
from biresnerf.geometry.focus import focus_point
from biresnerf.options.formats import Format

NEUS = Format(
    name="neus",
    title="cameras_sphere.npz (NeuS, IDR)",
    rank=55,
    found_as=("cameras_sphere.npz", "cameras.npz"),
    suffixes=(".npz",),
    gives="poses, one lens an image",
    checked_against="its writer; jingz666/NeuF",
    cam_from_world=True,
    in_set="cameras_sphere.npz",
    loses=("names", "distortion", "rigs", "points", "mask paths"),
    instead="pinhole",
    heading="For NeuS, IDR",
    hint="Beside image/ and mask/, whose files are in the order of their names",
)
_HELD = 0.98  # of the points that the sphere must hold
_HALF_PX = 0.5
_WORLD = re.compile(r"world_mat_\d{1,6}")


_HINT = "Give the cameras_sphere.npz that was made for these images."
_MAX_MATRIX_BYTES = 1024  # a 4 x 4 of float64 takes 256


def parse_neus(_root: Path, file: Path) -> ParsedPoses:
    """The cameras of ``file`` in its world, before ``scale_mat``; for the images in the order of their names.

    Where there are fewer images than cameras, their names must be the cameras' numbers.
    """
    rows = [(str(n), f"{file.name} world_mat_{n}", one) for n, one in sorted(_world_matrices(file).items())]
    folders = ("image", "rgb")
    parsed = parsed_rows(NEUS, [file], rows, _decomposed, photo_folders=folders, in_order_of_names="as text")

    def assign(names: Sequence[str]) -> Assignment:
        numbers = [PurePosixPath(name).stem for name in names]
        by_number = {int(entry.name): entry for entry in parsed.entries}
        if len(names) < len(by_number) and all(
            stem.isdecimal() and int(stem) in by_number for stem in numbers
        ):
            found = [
                (name, replace(by_number[int(stem)], name=name))
                for name, stem in zip(names, numbers, strict=True)
            ]
            return found, [f"{file.name}: images were taken by their numbers"]
        assert parsed.assign is not None
        return parsed.assign(names)

    return replace(parsed, assign=assign)


def _world_matrices(file: Path) -> dict[int, NDArray[np.float64]]:
    """The ``world_mat_i`` by number. Raises InputError ``pose_file_invalid``."""
    found = npz_numbers(file, lambda name: bool(_WORLD.fullmatch(name)), _MAX_MATRIX_BYTES, _HINT)
    if not found:
        raise invalid_file(file.name, "holds no world_mat_0.", _HINT)
    return {int(name.removeprefix("world_mat_")): matrix for name, matrix in found.items()}


def _decomposed(matrix: NDArray[np.float64], where: str) -> Placed:
    """The pose and lens of a projection K [R | t], of any scale."""
    if matrix.shape not in ((3, 4), (4, 4)):
        raise invalid_file(where, f"is an array of shape {matrix.shape}, not 4 x 4.", _HINT)
    refuse_not_finite(matrix, where, _HINT)
    projection = matrix[:3] * (1.0 if np.linalg.det(matrix[:3, :3]) > 0.0 else -1.0)
    # K R by a QR of the transposed block in reverse order, with the signs that make K's diagonal positive.
    q, r = np.linalg.qr(projection[::-1, :3].T)
    lens, rotation = r.T[::-1, ::-1], q.T[::-1]
    signs = np.where(np.diag(lens) < 0.0, -1.0, 1.0)
    lens, rotation = lens * signs, signs[:, None] * rotation
    if np.diag(lens).min() <= 1e-12 * np.abs(lens).max():
        raise invalid_file(where, "is no projection of a camera.", _HINT)
    cam_from_world = np.column_stack([rotation, np.linalg.solve(lens, projection[:, 3])])
    return pose_by(NEUS, cam_from_world, where), at_size_of(pinhole_of(lens / lens[2, 2], where, 0.0))


def _recognises(file: Path) -> bool:
    if not zipfile.is_zipfile(file):
        return False
    with zipfile.ZipFile(file) as archive:
        return any(_WORLD.fullmatch(name.removesuffix(".npy")) for name in archive.namelist())


def write_neus(refined: RefinedSet, path: Path) -> None:
    """Writes the file, whole or not at all.

    The sphere's centre is what the cameras look at. It holds nearly all points, or where there are none, what the
    cameras see at that distance.

    Raises:
        InputError: ``export_not_possible``: a distorted lens.
    """
    hint = "Convert to pinhole, which undistorts the photos, then that folder to neus."
    LensLimits("NeuS", (), fisheye=None, hint=hint).refuse(refined.cameras, path.name)
    scale = _sphere(refined)
    matrices = {}
    for row, index in enumerate(rows_by_name(refined)):
        full = refined.camera_of(index).full()
        lens = np.eye(4)
        lens[0, [0, 2]], lens[1, [1, 2]] = (full.fx, full.cx - _HALF_PX), (full.fy, full.cy - _HALF_PX)
        matrices[f"world_mat_{row}"] = lens @ refined.cam_from_world[index]
        matrices[f"scale_mat_{row}"] = scale
    with whole_file(path) as temporary, temporary.open("wb") as file:
        np.savez(file, **matrices)


def _sphere(refined: RefinedSet) -> NDArray[np.float64]:
    """``world_from_sphere`` [4, 4]."""
    focus, points = focus_point(refined.world_from_cam), refined.model.points.xyz
    if len(points):
        radius = float(np.quantile(np.linalg.norm(points - focus.point, axis=1), _HELD))
    else:
        tangents = [max(c.width / c.full().fx, c.height / c.full().fy) / 2 for c in refined.cameras]
        radius = focus.mean_distance * float(np.median(tangents))
    matrix = np.diag([*[max(radius, 1e-9)] * 3, 1.0])
    matrix[:3, 3] = focus.point
    return matrix


CODECS = (
    Codec(
        NEUS,
        parse=parse_neus,
        recognises=_recognises,
        write=lambda refined, path, _: write_neus(refined, path),
        given_back=lambda dataset: dataset.source.dialect == "neus",
    ),
)
