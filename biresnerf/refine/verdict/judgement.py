"""The verdict on a finished optimisation: evidence gathered, decision taken, photos looked over."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from biresnerf.data.model.dataset import GUESSES, Dataset
from biresnerf.data.photos.images import ImageSet
from biresnerf.geometry.focus import focus_point, rms_spread
from biresnerf.geometry.pose_error import rotation_between_deg
from biresnerf.refine.lost.pose_certainty import unsure_deg
from biresnerf.refine.optimise.joint_optimiser import JointOptimiser
from biresnerf.refine.start.input_frame import poses_in_input_frame
from biresnerf.refine.verdict import image_flags
from biresnerf.refine.verdict.pose_evidence import (
    EpipolarComparison,
    HeldOutComparison,
    Rig,
    compare_on_matches,
    compare_on_unseen_views,
    moved_px,
)
from biresnerf.refine.verdict.run_input import RunInput
from biresnerf.refine.verdict.verdict import MEASURABLE_PX, Findings, decide, failed_checks
from biresnerf.report import Verdict

Array = NDArray[np.float64]

GUESSED = GUESSES | {"forward-facing"}


@dataclass(frozen=True, eq=False)
class Judgement:
    """The verdict, and what it has to say of each image [n].

    Attributes:
        trial_psnr: of the unseen views, before and after [2, n]; NaN for the others.
        epipolar_px: before and after [2, n]; NaN where there are too few matches.
        sharpness, gain: see `image_flags`.
        unsure_deg: how far each camera can be carried about the scene without fitting its photo less; 0 if not far.
        moved_far, blurred, exposure_off: bool.
    """

    verdict: Verdict
    trial_psnr: Array
    epipolar_px: Array
    sharpness: Array
    gain: Array
    unsure_deg: Array
    moved_far: NDArray[np.bool_]
    blurred: NDArray[np.bool_]
    exposure_off: NDArray[np.bool_]


def judge(
    given: RunInput,
    optimiser: JointOptimiser,
    threads: int,
    should_stop: Callable[[], bool],
    tell: Callable[[float], None] = lambda _share: None,
) -> Judgement:
    """Compare the optimised poses with the dataset's own.

    Args:
        tell: called with the share of the work that is done.

    Raises:
        Interrupted: ``should_stop`` said so.
    """
    dataset, images = given.dataset, given.images
    refined = optimiser.lenses.refined(dataset)
    everyone = range(len(dataset))
    before = Rig(dataset.world_from_cam, tuple(dataset.camera_of(i) for i in everyone))
    after = Rig(poses_in_input_frame(dataset, optimiser)[0], tuple(refined.camera_of(i) for i in everyone))
    turned, shifted = motion(before.world_from_cam, after.world_from_cam)
    spread = rms_spread(before.world_from_cam[:, :3, 3])
    grounded = sum(frame.pose_source not in GUESSED for frame in dataset.frames) > len(dataset) / 2
    lost = int(optimiser.camera_errors.lost.sum())
    failed = failed_checks(after.world_from_cam, lost, turned, shifted, spread, grounded)
    heldout: HeldOutComparison | None = None
    epipolar: EpipolarComparison | None = None
    moved = 0.0
    if np.isfinite(after.world_from_cam).all():
        moved = moved_px(before, after, images)
        if given.matches is not None:
            epipolar = compare_on_matches(
                before, after, given.matches, independent=not given.start.placed.any()
            )
        if moved >= MEASURABLE_PX:
            heldout = compare_on_unseen_views(
                before, after, images, given.held_out, optimiser.options, optimiser.device, threads, should_stop,
                lambda share: tell(0.9 * share),
            )  # fmt: skip
    verdict = decide(
        Findings(
            failed=failed,
            moved_px=moved,
            heldout=heldout.evidence if heldout else None,
            epipolar=epipolar.evidence if epipolar else None,
            compared_with=_whose(dataset),
            grounded=grounded,
        )
    )
    return _with_images(verdict, images, optimiser, before, heldout, epipolar, turned, shifted)


def motion(before: Array, after: Array) -> tuple[Array, Array]:
    """Rotation (deg) and distance of the centres [n] between poses [n, 4, 4] of the same cameras."""
    turned = rotation_between_deg(before, after)
    return turned, np.linalg.norm(after[:, :3, 3] - before[:, :3, 3], axis=1)


def _whose(dataset: Dataset) -> Literal["given", "seeded", "mixed"]:
    given = sum(frame.pose_source == "given" for frame in dataset.frames)
    if given == len(dataset):
        return "given"
    return "mixed" if given else "seeded"


def _with_images(
    verdict: Verdict,
    images: ImageSet,
    optimiser: JointOptimiser,
    before: Rig,
    heldout: HeldOutComparison | None,
    epipolar: EpipolarComparison | None,
    turned: Array,
    shifted: Array,
) -> Judgement:
    trial_psnr, epipolar_px = np.full((2, len(images)), np.nan), np.full((2, len(images)), np.nan)
    if heldout is not None:
        trial_psnr[:, heldout.views] = heldout.before.psnr, heldout.after.psnr
    if epipolar is not None:
        epipolar_px[:] = epipolar.before, epipolar.after
    sharpness = image_flags.sharpness(images, before.world_from_cam)
    gain = image_flags.gains(optimiser)
    distance = focus_point(before.world_from_cam).mean_distance
    return Judgement(
        verdict=verdict,
        trial_psnr=trial_psnr,
        epipolar_px=epipolar_px,
        sharpness=sharpness,
        gain=gain,
        unsure_deg=unsure_deg(optimiser),
        moved_far=image_flags.moved_far(turned, shifted, distance),
        blurred=image_flags.blurred(sharpness),
        exposure_off=image_flags.exposure_off(gain),
    )
