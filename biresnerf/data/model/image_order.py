"""The order in which photos were taken, as their names tell it."""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from biresnerf.geometry.focus import focus_point

# Photos are taken one after the other along a path if neighbours by name stand this much nearer than any two do.
STEP_SHARE = 0.5
LEAST_POSED = 4


def natural_order(names: Sequence[str]) -> list[int]:
    """Indices sorted by name with numbers compared as numbers: ``2.png`` before ``10.png``."""

    def key(index: int) -> list[tuple[int, int, str]]:
        parts = re.split(r"(\d+)", names[index])
        return [(0, int(part), "") if part.isdecimal() else (1, 0, part) for part in parts if part]

    return sorted(range(len(names)), key=key)


def taken_along_a_path(world_from_cam: NDArray[np.float64]) -> bool:
    """Whether poses [n, 4, 4], in the order of names, follow each other far closer than any two of them do."""
    if len(world_from_cam) < LEAST_POSED:
        return False
    apart = pose_distances(world_from_cam)
    steps = np.diagonal(apart, offset=1)
    return float(np.median(steps)) < STEP_SHARE * float(np.median(apart[np.triu_indices(len(apart), 1)]))


def pose_distances(world_from_cam: NDArray[np.float64]) -> NDArray[np.float64]:
    """How far any two poses [n, n] are apart: their centres, in distances of the scene, and their viewing axes."""
    centres = world_from_cam[:, :3, 3] / max(focus_point(world_from_cam).mean_distance, 1e-12)
    apart: NDArray[np.float64] = np.linalg.norm(centres[:, None] - centres[None], axis=2)
    return apart + np.linalg.norm(world_from_cam[:, None, :3, 2] - world_from_cam[None, :, :3, 2], axis=2)
