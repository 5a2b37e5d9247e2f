"""Files that list views, poses and lenses apart, each by its number: Meshroom and OpenMVG."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from biresnerf.data.formats.bad_frames import attempt
from biresnerf.data.formats.parsed_poses import ParsedPoses
from biresnerf.data.formats.pose_rows import Placed, parsed_rows
from biresnerf.data.model.pose_validation import rigid_matrix
from biresnerf.data.model.untrusted_file import invalid_file
from biresnerf.errors import InputError
from biresnerf.geometry.camera.camera_models import Camera
from biresnerf.options.formats import Format


class View(NamedTuple):
    """An image, the place that describes it, and the numbers of its pose and its lens.

    ``problem`` says why its pose cannot be used.
    """

    name: str
    where: str
    pose: str
    lens: str
    problem: InputError | None = None


def parsed_views(
    form: Format,
    file: Path,
    views: Iterable[View],
    poses: Mapping[str, Callable[[], NDArray[np.float64]]],
    lenses: Mapping[str, Callable[[], Camera]],
) -> ParsedPoses:
    """The poses of ``views``; those whose pose is not listed have none."""

    @cache
    def lens_of(number: str) -> Camera | InputError:
        hint = "Export the file again, with its intrinsics."
        missing = invalid_file(f"{file.name} intrinsics", f"lacks number {number}.", hint)
        return attempt(lenses[number]) if number in lenses else missing

    def read(view: View, _where: str) -> Placed:
        found = lens_of(view.lens)
        for problem in (view.problem, found):
            if isinstance(problem, InputError):
                raise problem
        assert isinstance(found, Camera)
        return poses[view.pose]() if view.pose in poses else None, found

    return parsed_rows(form, [file], [(view.name, view.where, view) for view in views], read)


def pose_of_centre(
    world_from_cam_rotation: NDArray[np.float64], centre: Iterable[float], where: str
) -> NDArray[np.float64]:
    """``world_from_cam`` [4, 4] of a rotation [3, 3] and the camera's centre. Raises the codes of `rigid_matrix`."""
    return rigid_matrix(np.column_stack([world_from_cam_rotation, list(centre)]).tolist(), where)[0]


def listed(document: Any, key: str, file: Path, hint: str) -> list[dict[str, Any]]:
    """The objects in the list ``key`` of a document. Raises InputError ``pose_file_invalid`` where it is none."""
    rows = document.get(key) if isinstance(document, dict) else None
    if not isinstance(rows, list) or not all(isinstance(row, dict) for row in rows):
        raise invalid_file(f"{file.name} {key}", "is no list of objects.", hint)
    return rows
