"""The input's poses as evidence: how accurate they are, measured against poses that other evidence gave."""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from biresnerf.data.model.dataset import Dataset
from biresnerf.geometry.focus import rms_spread
from biresnerf.geometry.lie import so3_exp
from biresnerf.geometry.similarity import Similarity, align_robust
from biresnerf.options.refine_options import ResolvedOptions
from biresnerf.refinement.adjustment.adjustment import Adjustment
from biresnerf.refinement.adjustment.cameras import Cameras
from biresnerf.refinement.adjustment.evidence import Evidence, PosePrior
from biresnerf.refinement.adjustment.track_term import ROBUST_SCALE
from biresnerf.uncertainty import InputAccuracy

logger = logging.getLogger(__name__)

Array = NDArray[np.float64]

FRAME, OFFSET = 7, 6  # unknowns
LEAST_CAMERAS = 6
CONTRADICTED = 3.0  # errors so many times as large as stated are worth a warning
# Of six deviates, as large for each as that of an observation of a feature.
SCALE = 3 * ROBUST_SCALE**2
# Neighbours' errors are alike where poses come from tracking or feature matches, and do not average out: by how much
# the deviations count for more in a prior. Chosen by the table of docs/estimator.md.
SHARED_ERRORS = 2.0
SAME = 1e-3  # of the largest singular value: what is smaller cannot be told
FURTHEST = 0.3  # rad, and spreads of the rig: the longest step
SETTLED = 1e-6  # of a standard deviation
MAXWELL_MEDIAN = 1.5382  # of the length of three normal deviates
ROUNDS = 30
EXACT = 1e-7  # rad, and shares of the cameras' spread: no pose is known better


@dataclass(frozen=True, eq=False)
class GivenPoses:
    """Poses of the input, and how far they are from the truth.

    Attributes:
        world_from_cam: [n, 4, 4], carried into the frame of the others, and from the tracked body to the camera.
        body_from_cam: [4, 4], what all poses of the input lack, in the input's unit: that of a tracked body to its
            camera. The identity where the residuals show none.
        rotation, position: standard deviation of each component of the errors: rad, and the unit of `world_from_cam`.
        unit: that unit, in the input's.
        weight: of each camera [n], 0 to 1; 0 where it had no pose, or one far off.
        stated: rotation and position as the user knows them, in place of the measured ones; 0 where not stated.
    """

    world_from_cam: Array
    body_from_cam: Array
    rotation: float
    position: float
    unit: float
    weight: Array
    stated: tuple[float, float] = (0.0, 0.0)

    @property
    def deviations(self) -> tuple[float, float]:
        """Of rotation and position in a prior: as stated, or else as measured and shared."""
        rotation, position = self.stated
        return rotation or SHARED_ERRORS * self.rotation, position or SHARED_ERRORS * self.position

    def as_stated(self, rotation: float, position: float) -> GivenPoses:
        """With what the user states: rad, and the input's unit; 0 where nothing is stated."""
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
            0 < known * CONTRADICTED < found for known, found in zip(self.stated, measured, strict=True)
        )

    @property
    def has_offset(self) -> bool:
        return not np.array_equal(self.body_from_cam, np.eye(4))

    def tells(self, prior: PosePrior) -> bool:
        """Whether these poses are known better than some camera is before."""
        rotation, position = self.stated[0] or self.rotation, self.stated[1] or self.position
        better = rotation < prior.rotation.max() or position < prior.position.max()
        return bool(better and self.weight.any())

    def prior(self, other: PosePrior) -> PosePrior:
        """What these poses and another prior say together."""
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

    The errors of both are in what is found, so that the input never looks better than it is. Its frame and scale are
    estimated with it, robustly: a camera far off has no say. So is an offset between tracked body and camera, which is
    believed if Schwarz's criterion is (Schwarz 1978): its six numbers must explain more than they could by chance.

    Args:
        given: the input's [n, 4, 4], in any frame.
        fitted: [n, 4, 4].
        known: cameras [n] that have a pose in the input, and one that other evidence gave.

    Returns:
        None where too few cameras are known.
    """
    residuals = 6 * int(known.sum())
    if residuals < 6 * LEAST_CAMERAS:
        return None
    plain, moved = (_fitted(given, fitted, known, with_offset=each) for each in (False, True))
    gain = residuals * math.log(plain.rotation * plain.position / (moved.rotation * moved.position))
    return moved if gain > OFFSET * math.log(residuals) else plain


def _fitted(given: Array, fitted: Array, known: NDArray[np.bool_], *, with_offset: bool) -> GivenPoses:
    """By Gauss-Newton steps of frame and offset, with weights from the residuals.

    The poses that are better known are carried to the input, not the other way: from noisy poses a smaller frame with
    an offset would follow (regression dilution).
    """
    residuals, cam_from_body, to = 6 * int(known.sum()), np.eye(4), Cameras.of(given)
    frame = align_robust(given[known], fitted[known], with_rotations=True).inverse()
    middle = to.centre[known].mean(0)
    spread = float(np.linalg.norm(to.centre[known] - middle, axis=1).mean())
    columns = FRAME + OFFSET if with_offset else FRAME
    lost = math.sqrt(residuals / (residuals - columns))
    for _ in range(ROUNDS):
        now = Cameras.of(frame.apply_to_poses(fitted @ cam_from_body))
        apart = to.apart(now).reshape(-1, 6)
        rotation, position = (
            max(float(np.median(np.linalg.norm(part[known], axis=1))) / MAXWELL_MEDIAN * lost, EXACT * unit)
            for part, unit in ((apart[:, :3], 1.0), (apart[:, 3:], spread))
        )
        deviations = np.repeat([rotation, position], 3)
        weight = known * (SCALE / (SCALE + ((apart / deviations) ** 2).sum(1))) ** 2
        weights = np.sqrt(weight)[:, None] / deviations
        system = (weights[..., None] * _jacobian(now, middle, spread)[..., :columns]).reshape(-1, columns)
        # The shortest solution: an offset that looks like another frame is left to the frame of the start.
        step = np.linalg.lstsq(system, (weights * apart).reshape(-1), rcond=SAME)[0]
        if np.abs(system @ step).max() < SETTLED:
            break
        step *= min(1.0, FURTHEST / float(np.abs(step).max()))
        if with_offset:
            motion = np.eye(4)
            motion[:3, :3], motion[:3, 3] = _turn(step[7:10]), spread * step[10:] / frame.scale
            cam_from_body = cam_from_body @ motion
        turned, grown = _turn(step[:3]), math.exp(step[6])
        frame = Similarity(grown, turned, middle - grown * turned @ middle + spread * step[3:6]) @ frame
    back = frame.inverse()
    body_from_cam: Array = np.linalg.inv(cam_from_body).astype(np.float64)
    # The offset's length is in the unit of the fitted poses; that of the input is asked for.
    body_from_cam[:3, 3] *= frame.scale
    return GivenPoses(
        back.apply_to_poses(given @ body_from_cam),
        body_from_cam,
        rotation,
        position * back.scale,
        frame.scale,
        weight,
    )


def _jacobian(now: Cameras, middle: Array, spread: float) -> Array:
    """Of poses [n, 6, 13]: by a turn, a shift and growth of their frame, and by an offset in each camera's axes.

    The frame turns and grows about its middle, and lengths count in spreads of the rig.
    """
    jacobian, away = np.zeros((len(now), 6, FRAME + OFFSET)), now.centre - middle
    jacobian[:, :3, :3] = np.eye(3)
    for axis in range(3):
        jacobian[:, 3:, axis] = np.cross(np.eye(3)[axis], away)
    jacobian[:, 3:, 3:6] = spread * np.eye(3)
    jacobian[:, 3:, 6] = away
    jacobian[:, :3, 7:10] = now.rotation
    jacobian[:, 3:, 10:] = spread * now.rotation
    return jacobian


def _turn(rotation_vector: Array) -> Array:
    return np.asarray(so3_exp(torch.from_numpy(rotation_vector)).numpy())


def input_accuracy(
    dataset: Dataset, adjusted: Adjustment | None, evidence: Evidence, options: ResolvedOptions
) -> GivenPoses | None:
    """Of poses that the user gave: those of feature matches are of the same evidence, and guesses of none.

    What `options` state of it holds in place of what is measured.

    None where nothing tells, or too few cameras are known.
    """
    if adjusted is None:
        return None
    known = np.array([frame.pose_source == "given" for frame in dataset.frames])
    seen = np.zeros_like(known)
    if evidence.tracks is not None:
        seen[evidence.tracks.image] = True
    if evidence.patches is not None:
        seen[evidence.patches.host] = seen[evidence.patches.target] = True
    found = given_poses(dataset.world_from_cam, adjusted.world_from_cam, known & seen)
    if found is None:
        return None
    found = found.as_stated(math.radians(options.input_rotation_deg), options.input_position)
    logger.info("the input's poses: %s", accuracy_report(found))
    return found


def accuracy_report(given: GivenPoses) -> InputAccuracy:
    """The numbers for a report."""
    return InputAccuracy.model_validate(
        {
            "rotation_deg": math.degrees(given.rotation),
            "position": given.position * given.unit,
            "body_from_camera": given.body_from_cam.tolist() if given.has_offset else None,
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
