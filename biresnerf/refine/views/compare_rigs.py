"""Two sets of poses of the same photos compared on unseen views, each in fields trained on it alone."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from biresnerf.data.photos.images import ImageSet
from biresnerf.geometry.camera.camera_models import Camera
from biresnerf.options.refine_options import ResolvedOptions
from biresnerf.refine.adjustment.paired import paired
from biresnerf.refine.optimise.joint_optimiser import JointOptimiser
from biresnerf.refine.scene.scene import Scene
from biresnerf.refine.views.held_out_views import ROUNDS_MOST, unseen_rounds
from biresnerf.refine.views.pose_trials import PoseTrials, TrialScores, joined
from biresnerf.report import HeldOutEvidence

Array = NDArray[np.float64]
BeforeAfter = dict[int, tuple[NDArray[np.float32], NDArray[np.float32]]]

SHOWN = 4  # held-out views that are rendered with either rig, to be looked at
# Differences that matter and are larger than chance: trainings on the same poses differ by less (docs/verdict.md).
PSNR_MATTERS, SSIM_MATTERS = 0.5, 0.01  # dB, and 1


@dataclass(frozen=True, eq=False)
class Rig:
    """Poses [n, 4, 4], in one frame where they are compared, and the lens of each image at full size."""

    world_from_cam: Array
    cameras: tuple[Camera, ...]

    def of(self, images: NDArray[np.int64]) -> Rig:
        """Those images [m] alone."""
        return Rig(self.world_from_cam[images], tuple(self.cameras[i] for i in images))

    def lenses(self, images: ImageSet) -> tuple[Camera, ...]:
        """The lenses at the photos' working size."""
        return tuple(
            camera.resized(small.width, small.height)
            for camera, small in zip(self.cameras, images.cameras, strict=True)
        )


@dataclass(frozen=True, eq=False)
class HeldOutComparison:
    """Scores of the unseen `views` after two trainings.

    Attributes:
        renders: of some held-out views [h, w, 3] with either rig, by their index.
    """

    views: list[int]
    before: TrialScores
    after: TrialScores
    evidence: HeldOutEvidence
    renders: BeforeAfter


def compare_on_unseen_views(
    pair: tuple[Rig, Rig],
    images: ImageSet,
    held_out: Sequence[int],
    options: ResolvedOptions,
    device: torch.device,
    threads: int,
    should_stop: Callable[[], bool],
    report: Callable[[float], None] = lambda _share: None,
    rounds_most: int = ROUNDS_MOST,
) -> HeldOutComparison | None:
    """Train a field on either rig, held still, and score both on the same unseen views; None of too few images.

    Args:
        held_out: views that the refinement never trained on; others join them where these are few.
        report: called with the share of work done, if the present round decides.
        rounds_most: small sets are trained so often, with other views left out, unless the first ones decide.

    Raises:
        Interrupted: ``should_stop`` returned true.
    """
    steps = options.trial_steps
    rounds = unseen_rounds(len(images), held_out)[:rounds_most]
    if steps == 0 or not rounds[0]:
        return None
    rigs = [rig.world_from_cam for rig in pair]
    scores: tuple[list[TrialScores], list[TrialScores]] = ([], [])
    seen: list[int] = []
    for done, views in enumerate(rounds):
        trials = PoseTrials(images, views, rigs, options, steps, device, threads, should_stop)
        shown = [] if done else [view for view in views if view in held_out][:SHOWN]
        for side, rig in zip(scores, pair, strict=True):
            side.append(trials.score(rig.world_from_cam, rig.lenses(images), shown=shown))
            report(sum(map(len, scores)) / (2 * (done + 1)))
        seen += views
        old, new = (joined(side) for side in scores)
        evidence = HeldOutEvidence(
            steps=trials.steps,
            strictly=len(set(seen) & set(held_out)),
            psnr=paired(old.psnr, new.psnr, PSNR_MATTERS),
            ssim=paired(old.ssim, new.ssim, SSIM_MATTERS),
        )
        if _decided(evidence):
            break
    renders = {view: (old.renders[view], new.renders[view]) for view in old.renders}
    return HeldOutComparison(seen, old, new, evidence, renders)


def _decided(evidence: HeldOutEvidence) -> bool:
    """Whether both intervals lie beyond what matters, on the same side: other views would hardly change that."""
    psnr, ssim = evidence.psnr, evidence.ssim
    if psnr.low is None or psnr.high is None or ssim.low is None or ssim.high is None:
        return False
    better = psnr.low > PSNR_MATTERS and ssim.low > SSIM_MATTERS
    worse = psnr.high < -PSNR_MATTERS and ssim.high < -SSIM_MATTERS
    return better or worse


def compare_placed(
    before: Rig,
    after: Rig,
    scene: Scene,
    optimiser: JointOptimiser,
    placed: NDArray[np.bool_],
    should_stop: Callable[[], bool],
    report: Callable[[float], None] = lambda _share: None,
    times: int = 1,
    rounds_most: int = ROUNDS_MOST,
) -> HeldOutComparison | None:
    """`compare_on_unseen_views` of the images placed [n] alone: others would spoil the fields of both rigs.

    Fields are trained ``times`` as long as the options say, in ``rounds_most`` rounds at most.
    """
    options = optimiser.options
    options = options.model_copy(update={"trial_steps": times * options.trial_steps})
    rows = np.flatnonzero(placed)
    images = scene.images if placed.all() else scene.images.of(rows)
    held_out = np.flatnonzero(np.isin(rows, scene.held_out)).tolist()
    found = compare_on_unseen_views(
        (before.of(rows), after.of(rows)), images, held_out, options, optimiser.device, optimiser.threads,
        should_stop, report, rounds_most,
    )  # fmt: skip
    if found is None:
        return None
    renders = {int(rows[view]): pair for view, pair in found.renders.items()}
    return replace(found, views=rows[found.views].tolist(), renders=renders)
