"""What is known of the poses that a run returns, in the input's frame and unit."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from biresnerf.data.model.dataset import Dataset
from biresnerf.geometry.focus import focus_point, rms_spread
from biresnerf.refinement.finish.expected_errors import ExpectedErrors
from biresnerf.refinement.finish.outcome import Finish
from biresnerf.refinement.parameters.joint_parameters import JointParameters
from biresnerf.refinement.start.refined_poses import RefinedPoses
from biresnerf.refinement.verdict.judgement import Judgement
from biresnerf.uncertainty import KnownFrom, PoseUncertainty

FIXED = "they were kept as given, on request"
MATCHES_CONTRADICT = "their feature matches contradict them"
NO_EVIDENCE = "no feature matches or patches support them"
LOST = "no pose was found that agrees with the photo"
OPEN = "their matches do not determine them"


def pose_uncertainty(
    dataset: Dataset,
    joint: JointParameters,
    finish: Finish,
    judgement: Judgement | None,
    lost: NDArray[np.bool_],
) -> tuple[PoseUncertainty, ...]:
    """The uncertainty of each image's returned pose.

    Args:
        lost: cameras [n] that have no fitting pose.
        finish: with the poses that fit all evidence that is to be trusted.
        judgement: None where there is no verdict, and the refined poses are returned.
    """
    refined = RefinedPoses.now(dataset, joint)
    poses, found = refined.world_from_cam, None if judgement is None else judgement.errors
    wrong = np.zeros(len(dataset), np.bool_) if judgement is None else judgement.contradicted
    if judgement is not None and judgement.verdict.returned == "input":
        poses, found, wrong = dataset.world_from_cam, None, judgement.contradicted_before
    if found is None:
        found = finish.errors_of(poses, refined.input_from_unit(joint.frame), joint.bodies)
    reasons = [
        FIXED if joint.bodies.fixed[i]
        else MATCHES_CONTRADICT if wrong[i]
        else None if found is not None and found.known[i]
        else LOST if lost[i]
        else NO_EVIDENCE if found is None or not (found.by_tracks[i] or found.by_patches[i])
        else OPEN
        for i in range(len(dataset))
    ]  # fmt: skip
    focus = focus_point(poses)
    distance = focus.mean_distance if focus.well_posed else rms_spread(poses[:, :3, 3])
    known = None if found is None else _known(found, distance)
    return tuple(
        PoseUncertainty(known_from="nothing", why_unknown=why)
        if why is not None or known is None
        else known(i)
        for i, why in enumerate(reasons)
    )


def _known(found: ExpectedErrors, distance: float) -> Callable[[int], PoseUncertainty]:
    """What is known of the pose of an image, by its number."""
    rotation, position = found.bounds_90()
    moments = found.moments

    def of(image: int) -> PoseUncertainty:
        source: KnownFrom = "photos"
        if found.by_tracks[image]:
            source = "matches and photos" if found.by_patches[image] else "matches"
        return PoseUncertainty(
            known_from=source,
            rotation_deg=float(np.degrees(rotation[image])),
            position=float(position[image]),
            position_percent=100 * float(position[image]) / distance,
            covariance=moments[image].tolist(),
        )

    return of
