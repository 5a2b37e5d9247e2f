"""Files of older nerfstudio, which turned COLMAP's world and did not write down that it had."""

from __future__ import annotations

import posixpath
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from biresnerf.data.formats.bind_images import PoseEntry
from biresnerf.data.formats.colmap.read_model import model_forms, read_colmap_model
from biresnerf.errors import InputError

MODEL = "colmap/sparse/0"
OLDER_TRANSFORM = np.array([[0.0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 0], [0, 0, 0, 1]])
# Poses are taken for equal up to this, relative to the largest coordinate: files have 6 digits or more.
_EQUAL = 1e-4


def applied_transform_left_out(file: Path, entries: Sequence[PoseEntry]) -> NDArray[np.float64] | None:
    """The transform that ``file``, which names none, was made with, where the model beside it shows that it was.

    nerfstudio itself takes this transform as soon as there is a model; here the model's poses must agree with the
    frames' after it, as folders of other programs hold both files, too. None where they do not.
    """
    folder = file.parent / MODEL
    if not model_forms(folder):
        return None
    try:
        images = read_colmap_model(folder).images.values()
    except InputError:
        return None  # not what is read; nothing is taken from it
    by_name = {posixpath.basename(image.name): image.world_from_cam for image in images}
    off, size, found = 0.0, 1.0, 0
    for entry in entries:
        pose = by_name.get(posixpath.basename(entry.name))
        if pose is not None and entry.world_from_cam is not None:
            expected = OLDER_TRANSFORM @ pose
            found, off = found + 1, max(off, float(np.abs(entry.world_from_cam - expected).max()))
            size = max(size, float(np.abs(expected).max()))
    return OLDER_TRANSFORM if found and off <= _EQUAL * size else None
