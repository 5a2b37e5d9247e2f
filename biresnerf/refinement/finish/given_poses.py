"""The input's poses as evidence: how accurate they are, measured against poses that other evidence gave."""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from biresnerf.arrays import Array
from biresnerf.data.model.dataset import Dataset
from biresnerf.geometry.body_offset import EXACT, SHARED_ERRORS, BodyOffset, tie
from biresnerf.geometry.focus import rms_spread
from biresnerf.options.refine_options import ResolvedOptions
from biresnerf.refinement.adjustment.adjustment import Adjustment
from biresnerf.refinement.adjustment.cameras import Cameras
from biresnerf.refinement.adjustment.evidence import Evidence, PosePrior
from biresnerf.uncertainty import InputAccuracy

logger = logging.getLogger(__name__)


LEAST_CAMERAS = 6
UNDERSTATED = 3.0  # errors so many times as large as stated are worth a warning


@dataclass(frozen=True, eq=False)
class GivenPoses:
    """Poses of the input, and how far they are from the truth.

    Attributes:
        world_from_cam: [n, 4, 4], carried into the frame of the others, and from the tracked body to the camera.
        offset: the offset that all poses of the input share; None where the errors show none.
        rotation, position: standard deviation of each component of the errors: rad, and the unit of `world_from_cam`.
        unit: that unit, in the input's.
        weight: of each camera [n], 0 to 1; 0 where it had no pose, or one far off.
        stated: rotation and position as the user knows them, in place of the measured ones; 0 where not stated.
    """

    world_from_cam: Array
    offset: BodyOffset | None
    rotation: float
    position: float
    unit: float
    weight: Array
    stated: tuple[float, float] = (0.0, 0.0)

    @property
    def deviations(self) -> tuple[float, float]:
        """Deviations of rotation and position for a prior: as stated, or else as measured and shared."""
        rotation, position = self.stated
        return rotation or SHARED_ERRORS * self.rotation, position or SHARED_ERRORS * self.position

    def as_stated(self, rotation: float, position: float) -> GivenPoses:
        """These poses with the errors that the user states: rad, and the input's unit; 0 where nothing is stated."""
        exact = EXACT * rms_spread(self.world_from_cam[:, :3, 3])
        return replace(
            self,
            stated=(
                max(rotation, EXACT) if rotation else 0.0,
                max(position / self.unit, exact) if position else 0.0,
            ),
        )

    @property
    def contradicted(self) -> bool:
        """Whether errors are far larger than stated."""
        measured = (self.rotation, self.position)
        return any(
            0 < known * UNDERSTATED < found for known, found in zip(self.stated, measured, strict=True)
        )

    def tells(self, prior: PosePrior) -> bool:
        """Whether these poses are more accurate than the prior of some camera."""
        rotation, position = self.stated[0] or self.rotation, self.stated[1] or self.position
        better = rotation < prior.rotation.max() or position < prior.position.max()
        return bool(better and self.weight.any())

    def prior(self, other: PosePrior) -> PosePrior:
        """The combination of these poses with another prior."""
        mine = self.weight[:, None] / np.array(self.deviations) ** 2
        theirs = 1 / np.stack([other.rotation, other.position], 1) ** 2
        share = (mine / (mine + theirs)).repeat(3, axis=1)
        between = Cameras.of(other.world_from_cam)
        step = Cameras.of(self.world_from_cam).apart(between).reshape(-1, 6)
        rotation, position = (1 / np.sqrt(mine + theirs)).T
        mean = between.moved((share * step).reshape(-1)).world_from_cam()
        return PosePrior(mean, rotation, position, other.bodies)


def given_poses(given: Array, fitted: Array, known: NDArray[np.bool_]) -> GivenPoses | None:
    """How accurate the input's poses are, from poses of the same cameras that other evidence gave.

    The errors found include those of both, so that the input never looks better than it is. Its frame, its scale and
    an offset between tracked body and camera are estimated with it: see `tie`.

    Args:
        given: the input's [n, 4, 4], in any frame.
        fitted: [n, 4, 4].
        known: cameras [n] that have a pose in the input, and one that other evidence gave.

    Returns:
        None where too few cameras are known.
    """
    if known.sum() < LEAST_CAMERAS:
        return None
    found = tie(fitted[known], given[known])
    back, weight = found.given_from_fitted.inverse(), np.zeros(len(given))
    weight[known] = found.weight
    return GivenPoses(
        back.apply_to_poses(given if found.offset is None else given @ found.offset.body_from_cam),
        found.offset,
        found.rotation,
        found.position * back.scale,
        found.given_from_fitted.scale,
        weight,
    )


def input_accuracy(
    dataset: Dataset, adjusted: Adjustment | None, evidence: Evidence, options: ResolvedOptions
) -> GivenPoses | None:
    """The accuracy of poses that the user gave: those of matches share the evidence, and guesses have none.

    What `options` state replaces what is measured.

    None where no evidence exists, or too few cameras are known.
    """
    if adjusted is None:
        return None
    known = np.array([frame.pose_source == "given" for frame in dataset.frames])
    found = given_poses(dataset.world_from_cam, adjusted.world_from_cam, known & _seen(evidence, len(known)))
    if found is None:
        return None
    if dataset.body_offset is not None:
        found = replace(found, offset=dataset.body_offset.then(found.offset))
    found = found.as_stated(math.radians(options.input_rotation_deg), options.input_position)
    logger.info("the input's poses: %s", accuracy_report(found))
    return found


def loosened(prior: PosePrior, adjusted: Adjustment, evidence: Evidence) -> PosePrior | None:
    """The prior with deviations as large as the errors of its poses; None where the usual camera's are no larger.

    The errors are measured against poses that were adjusted with it: a field that binds cameras loosely bends rigs and
    loses single cameras, by more than is believed of it.
    """
    known = _seen(evidence, len(prior.rotation)) & ~prior.fixed
    found = given_poses(prior.world_from_cam, adjusted.world_from_cam, known)
    if found is None:
        return None
    rotation, position = found.deviations
    if rotation <= np.median(prior.rotation[known]) and position <= np.median(prior.position[known]):
        return None
    logger.info("the field's poses are off by more than was believed: %.2g deg", math.degrees(found.rotation))
    vague = np.where(known, 1 / np.sqrt(np.maximum(found.weight, EXACT**2)), 0.0)
    return replace(
        prior,
        rotation=np.maximum(prior.rotation, rotation * vague),
        position=np.maximum(prior.position, position * vague),
    )


def _seen(evidence: Evidence, images: int) -> NDArray[np.bool_]:
    """Which images [n] tracks or patches tell of."""
    seen = np.zeros(images, np.bool_)
    if evidence.tracks is not None:
        seen[evidence.tracks.image] = True
    if evidence.patches is not None:
        seen[evidence.patches.host] = seen[evidence.patches.target] = True
    return seen


def accuracy_report(given: GivenPoses) -> InputAccuracy:
    """The numbers for a report."""
    return InputAccuracy.model_validate(
        {
            "rotation_deg": math.degrees(given.rotation),
            "position": given.position * given.unit,
            "body_from_camera": given.offset and given.offset.body_from_cam.tolist(),
            "body_from_camera_deviation": given.offset and given.offset.shift_deviation,
            "body_from_camera_known_along": []
            if given.offset is None
            else given.offset.known_along.T.tolist(),
            "stated_rotation_deg": math.degrees(given.stated[0]) or None,
            "stated_position": given.stated[1] * given.unit or None,
        }
    )


def accuracy_warnings(given: GivenPoses | None, options: ResolvedOptions) -> tuple[str, ...]:
    """A warning where what is stated of the input's poses is not used, or they are far less exact."""
    if given is None:
        if not (options.input_rotation_deg or options.input_position):
            return ()
        return (
            "What input_rotation_deg and input_position state was not used: it takes six given poses that feature "
            "matches or photos tell of as well.",
        )
    if not given.contradicted:
        return ()
    found = accuracy_report(given)
    return (
        f"The given poses are off by {found.rotation_deg:.2g} degrees and {found.position:.2g} in the input's unit "
        "(standard deviation about each axis), far more than stated (input_rotation_deg, input_position).",
    )
