"""From the optimisation's poses and lenses at a moment back to the input's frame."""

from __future__ import annotations

from dataclasses import dataclass

from biresnerf.arrays import Array
from biresnerf.data.model.dataset import Dataset
from biresnerf.data.points.located_points import metres_from_world
from biresnerf.geometry.similarity import Similarity, align_by_spread, align_robust
from biresnerf.refinement.parameters.intrinsics_parameters import IntrinsicsParameters
from biresnerf.refinement.parameters.joint_parameters import JointParameters
from biresnerf.refinement.scene.scene_frame import SceneFrame

IN_METRES = 0.01  # a scale so near one is that of measured places: others have no unit


@dataclass(frozen=True, eq=False)
class RefinedPoses:
    """Poses and lenses of an optimisation at one moment.

    Attributes:
        world_from_cam: float64 [n, 4, 4], in the input's frame.
        input_from_optimised: the similarity that carried them there.
        lenses: as they were.
        dataset: the input, seen through these lenses, at its own poses.
    """

    world_from_cam: Array
    input_from_optimised: Similarity
    lenses: IntrinsicsParameters
    dataset: Dataset

    @classmethod
    def now(cls, dataset: Dataset, joint: JointParameters) -> RefinedPoses:
        """The present poses and lenses."""
        return cls.at(dataset, joint, joint.unit_from_cam, joint.lenses)

    def input_from_unit(self, frame: SceneFrame) -> Similarity:
        """The similarity from the unit frame that the optimisation is in."""
        return self.input_from_optimised @ frame.unit_from_world.inverse()

    @classmethod
    def at(
        cls, dataset: Dataset, joint: JointParameters, unit_from_cam: Array, lenses: IntrinsicsParameters
    ) -> RefinedPoses:
        """The poses of any moment, [n, 4, 4] in the unit frame. The optimisation leaves frame and scale free.

        The similarity that fits the optimised poses to the given ones best fixes them; it is robust to lost cameras
        unless the method says otherwise. Fixed cameras and rigs leave less free. Where no poses were given, measured
        places fix the frame, as they did for those found.
        """
        optimised = joint.frame.unit_from_world.inverse().apply_to_poses(unit_from_cam)
        given, tied = dataset.world_from_cam, dataset.anchors
        input_from_optimised = joint.bodies.input_from_optimised(optimised, given)
        refined = lenses.refined(dataset)
        input_from_optimised = input_from_optimised or _as_measured(dataset, optimised, refined)
        if input_from_optimised is None and joint.robust_frame:
            input_from_optimised = align_robust(optimised[tied], given[tied], with_rotations=True)
        elif input_from_optimised is None:
            input_from_optimised = align_by_spread(optimised[tied], given[tied])
        carried = joint.bodies.restored(input_from_optimised.apply_to_poses(optimised), given)
        return cls(carried, input_from_optimised, lenses, refined)


def _as_measured(dataset: Dataset, optimised: Array, refined: Dataset) -> Similarity | None:
    """What carries optimised poses [n, 4, 4] to measured places, if the set's own were found and carried there.

    Args:
        refined: the set seen through the refined lenses.
    """
    if any(frame.pose_source == "given" for frame in dataset.frames):
        return None
    there = metres_from_world(dataset, dataset.world_from_cam)
    found = metres_from_world(refined, optimised)
    return found if there is not None and abs(there.scale - 1) < IN_METRES else None
