"""Feature matches as witnesses of the repair: they place cameras that they contradict, and object to worse poses."""

from __future__ import annotations

import logging

import numpy as np
import torch
from torch import Tensor

from biresnerf.refinement.lost.own_matches import OwnMatches, better, contradicted
from biresnerf.refinement.optimise.joint_optimiser import JointOptimiser

logger = logging.getLogger(__name__)


class MatchedRepair:
    """What the matches of single cameras say to their repair; nothing where there are none.

    Args:
        own: the photos' feature matches.
    """

    def __init__(self, optimiser: JointOptimiser, own: OwnMatches | None) -> None:
        self.optimiser, self._own = optimiser, own

    def place(self) -> list[int]:
        """Give cameras that their own matches contradict a pose that those support, the worst first; returns which."""
        if self._own is None:
            return []
        optimiser, placed = self.optimiser, []
        errors = self._own.errors_px(optimiser.poses.poses().numpy())
        wrong = contradicted(errors) & optimiser.bodies.alone
        trusted = ~(wrong | optimiser.camera_errors.suspects.cpu().numpy())
        for camera in np.argsort(-np.nan_to_num(errors) * wrong)[: int(wrong.sum())].tolist():
            found = self._own.placed(camera, optimiser.poses.poses().numpy(), trusted)
            logger.info(
                "the matches of camera %d are off by %.3g px and %s",
                camera, errors[camera], "place it elsewhere" if found is not None else "do not place it",
            )  # fmt: skip
            if found is not None:
                optimiser.replace_pose(camera, torch.from_numpy(found[:3]).float().to(optimiser.device))
                placed.append(camera)
        return placed

    def object_to(self, camera: int, unit_from_cam: Tensor) -> bool:
        """Whether a camera's own matches fit another pose [3, 4] less well than its present one."""
        if self._own is None:
            return False
        now = self.optimiser.poses.poses().numpy()
        moved = now.copy()
        moved[camera, :3] = unit_from_cam.double().cpu().numpy()
        return better(camera, self._own.errors_px(moved), self._own.errors_px(now))
