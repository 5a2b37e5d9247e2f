"""What an optimisation moves besides its field, in one object: code that needs poses takes this."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from biresnerf.geometry.rigid_bodies import RigidBodies
from biresnerf.refinement.parameters.exposure import Exposure
from biresnerf.refinement.parameters.intrinsics_parameters import IntrinsicsParameters
from biresnerf.refinement.parameters.pose_parameters import PoseParameters
from biresnerf.refinement.scene.scene_frame import SceneFrame


@dataclass(frozen=True, eq=False)
class JointParameters:
    """Poses, lenses and exposures of the same photos.

    Attributes:
        frame: the unit frame, which the poses are in.
        bodies: which cameras move together, and which not at all.
        robust_frame: whether lost cameras do not count in finding the input's frame.
    """

    frame: SceneFrame
    bodies: RigidBodies
    poses: PoseParameters
    lenses: IntrinsicsParameters
    exposure: Exposure
    robust_frame: bool

    @property
    def unit_from_cam(self) -> NDArray[np.float64]:
        """The poses of this moment, float64 [n, 4, 4]."""
        return np.asarray(self.poses.poses().numpy(), np.float64)
