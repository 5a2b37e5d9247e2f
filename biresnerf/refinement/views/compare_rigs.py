"""Two sets of poses of the same photos compared on unseen views, each in fields trained on it alone."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from biresnerf.arrays import Array
from biresnerf.data.photos.images import ImageSet
from biresnerf.data.workload import LOOKS, picture_share
from biresnerf.geometry.camera.camera import Intrinsics, directions_in_cam, project
from biresnerf.geometry.camera.camera_models import Camera
from biresnerf.geometry.focus import focus_point
from biresnerf.judging.compare import UNSEEN_PSNR, UNSEEN_SSIM, compare, paired
from biresnerf.refinement.numbers.choosing import VerdictNumbers
from biresnerf.refinement.optimise.methods import Recipe
from biresnerf.refinement.views.held_out_views import unseen_rounds
from biresnerf.refinement.views.image_metrics import shift_px
from biresnerf.refinement.views.pose_trials import PoseTrials, Trial, TrialScores, joined
from biresnerf.report import Finding, HeldOutEvidence

BeforeAfter = dict[int, tuple[NDArray[np.float32], NDArray[np.float32]]]

SHOWN = 4  # held-out views that are rendered with either rig, to be looked at
MOTION_GRID = 5  # points across and down


@dataclass(frozen=True, eq=False)
class Rig:
    """Poses [n, 4, 4], in one frame where they are compared, and the lens of each image at full size."""

    world_from_cam: Array
    cameras: tuple[Camera, ...]

    def of(self, images: NDArray[np.int64]) -> Rig:
        """The rig of images [m] alone."""
        return Rig(self.world_from_cam[images], tuple(self.cameras[i] for i in images))

    def lenses(self, images: ImageSet) -> tuple[Camera, ...]:
        """The lenses at the photos' working size."""
        return tuple(
            camera.resized(small.width, small.height)
            for camera, small in zip(self.cameras, images.cameras, strict=True)
        )


def moved_px(before: Rig, after: Rig, images: ImageSet) -> float:
    """How far the scene moves in the image (px, working size) between two rigs in one frame: median over cameras.

    Measured at points of a grid over each image, at the distance of the point that the rig `before` looks at. Each
    camera counts with their mean, and each point with at most the image's long side.
    """
    n = len(images)
    old, new = (Intrinsics.from_cameras(rig.lenses(images)) for rig in (before, after))
    focus = focus_point(before.world_from_cam)
    towards = (focus.point - before.world_from_cam[:, :3, 3]) * before.world_from_cam[:, :3, 2]
    depth = np.where(towards.sum(1) > 0, towards.sum(1), focus.mean_distance)
    steps = (torch.arange(MOTION_GRID, dtype=torch.float64) + 0.5) / MOTION_GRID
    share = torch.cartesian_prod(steps, steps).repeat(n, 1)
    index = torch.arange(n).repeat_interleave(MOTION_GRID**2)
    xy = share * torch.stack([old.width, old.height], 1)[index]
    rays = directions_in_cam(old, index, xy).numpy()
    i = index.numpy()
    in_cam = rays * depth[i][:, None]
    world = (
        np.einsum("mij,mj->mi", before.world_from_cam[i, :3, :3], in_cam) + before.world_from_cam[i, :3, 3]
    )
    seen = np.einsum("mji,mj->mi", after.world_from_cam[i, :3, :3], world - after.world_from_cam[i, :3, 3])
    moved = (project(new, index, torch.from_numpy(seen)) - xy).norm(dim=1).numpy().reshape(n, -1)
    most = np.maximum(images.widths, images.heights)[:, None].astype(np.float64)
    return float(np.median(np.fmin(moved, most).mean(1)))


@dataclass(frozen=True)
class Effort:
    """How much is trained to compare two rigs.

    Attributes:
        times: how many times the options' steps are taken.
        rounds_most: most rounds of small sets, each with other views left out; fewer if the first ones decide.
        looks: shares of a training after which fields are compared; the last is 1.
        pictured: whether some held-out views are rendered with either rig, to be looked at.
        favoured: what other evidence says of the second rig.
        moved_px: how far the scene moves in the image between the rigs, where that matters.
    """

    times: int = 1
    rounds_most: int | None = None
    looks: tuple[float, ...] = LOOKS
    pictured: bool = False
    favoured: Finding = "open"
    moved_px: float = np.inf


@dataclass(frozen=True, eq=False)
class HeldOutComparison:
    """Scores of the unseen `views` after two trainings.

    Attributes:
        work: of all trainings, see `Trial.work`.
        renders: of some held-out views [h, w, 3] with either rig, by their index, if requested.
    """

    views: list[int]
    before: TrialScores
    after: TrialScores
    evidence: HeldOutEvidence
    work: float
    renders: BeforeAfter


def compare_on_unseen_views(
    pair: tuple[Rig, Rig],
    images: ImageSet,
    held_out: Sequence[int],
    placed: NDArray[np.bool_],
    recipe: Recipe,
    should_stop: Callable[[], bool],
    report: Callable[[float], None] = lambda _share: None,
    effort: Effort = Effort(),
) -> HeldOutComparison | None:
    """Train a field on either rig, held still, and score both on the same unseen views; None for too few images.

    Trainings end at the first of the looks that decides.

    Args:
        held_out: views that the refinement never trained on; others join them where these are few.
        placed: images [n] that take part: others would spoil the fields of both rigs.
        report: called with the share of work done, if the present round decides.

    Raises:
        Interrupted: ``should_stop`` returned true.
    """
    numbers, steps, rows = (
        recipe.method.verdict,
        effort.times * recipe.options.trial_steps,
        np.flatnonzero(placed),
    )
    if not placed.all():
        images, pair = images.of(rows), (pair[0].of(rows), pair[1].of(rows))
        held_out = np.flatnonzero(np.isin(rows, held_out)).tolist()
    rounds = unseen_rounds(len(images), held_out, recipe.method.views)[: effort.rounds_most]
    if steps == 0 or not rounds[0]:
        return None
    rigs = [rig.world_from_cam for rig in pair]
    earlier: list[tuple[TrialScores, ...]] = []
    seen: list[int] = []
    work = 0.0
    renders: BeforeAfter = {}
    for done, views in enumerate(rounds):
        trials = PoseTrials(images, views, rigs, recipe, steps, should_stop)
        running = [trials.begin(rig.world_from_cam, rig.lenses(images)) for rig in pair]
        seen = seen + views
        pictured = effort.pictured and not done
        enough = picture_share(steps, kind=trials.kind) if pictured else 0.0
        for look in effort.looks:
            for side, trial in enumerate(running):
                trial.train(look)
                report((done + look * (side + 1) / len(running)) / (done + max(look, enough)))
            scores = tuple(trial.scores() for trial in running)
            old, new = (joined(side) for side in zip(*earlier, scores, strict=True))
            strictly = len(set(seen) & set(held_out))
            nearer = new if new.psnr.mean() >= old.psnr.mean() else old
            missed_px = _missed_px(nearer, images, seen)
            evidence = HeldOutEvidence(
                steps=running[0].optimiser.step_index, strictly=strictly, missed_px=missed_px,
                psnr=paired(old.psnr, new.psnr, UNSEEN_PSNR), ssim=paired(old.ssim, new.ssim, UNSEEN_SSIM),
            )  # fmt: skip
            decided = _decided(old, new, missed_px, numbers.early if look < 1 else 1, effort, numbers)
            if pictured and (decided or look == 1):
                renders = _pictures(
                    running, [view for view in views if view in held_out][:SHOWN], enough, rows
                )
            did = work + sum(trial.work for trial in running)
            found = HeldOutComparison(rows[seen].tolist(), old, new, evidence, did, renders)
            if decided:
                return found
        earlier.append(scores)
        work = did
    return found


def _pictures(
    pair: Sequence[Trial], views: Sequence[int], share: float, rows: NDArray[np.int64]
) -> BeforeAfter:
    """These views, by their rows, as both fields see them after so much of their training, or more."""
    for trial in pair:
        trial.train(share)
    return {int(rows[view]): (pair[0].render(view), pair[1].render(view)) for view in views}


def _missed_px(scores: TrialScores, images: ImageSet, views: Sequence[int]) -> float:
    """The `shift_px` of the median view."""
    missed = []
    for view, error_db in zip(views, scores.psnr.tolist(), strict=True):
        photo: NDArray[np.float32] = images.image(view).astype(np.float32) / np.float32(255)
        missed.append(shift_px(error_db, photo, images.counts_image(view)))
    return float(np.median(missed))


def photos_tell(missed_px: float, moved_px: float, numbers: VerdictNumbers) -> bool:
    """Whether renders with the better poses are near enough to the photos to distinguish poses a motion apart."""
    return missed_px <= max(numbers.blur_px, numbers.nearer * moved_px)


def may_be_blur(evidence: HeldOutEvidence, effort: Effort, numbers: VerdictNumbers) -> bool:
    """Whether a gain may only be of poses that suit a short training's blur, without any other support."""
    if effort.favoured == "better" or evidence.psnr.finding != "better" or evidence.missed_px is None:
        return False
    return numbers.nearer * effort.moved_px < evidence.missed_px <= numbers.blur_px


def _decided(
    before: TrialScores,
    after: TrialScores,
    missed_px: float,
    times: float,
    effort: Effort,
    numbers: VerdictNumbers,
) -> bool:
    """Whether both intervals lie beyond so many times what matters, on the same side; or beyond 0, on the favoured one.

    Other views, or more steps, would hardly change that. They may where a gain is not enough to tell yet.
    """
    both = ((after.psnr - before.psnr, UNSEEN_PSNR), (after.ssim - before.ssim, UNSEEN_SSIM))

    def says(side: Finding, times: float) -> bool:
        beyond = ((gains, replace(rule, least=0.0, beyond=times * rule.least)) for gains, rule in both)
        return all(compare(*each).finding == side for each in beyond)

    if effort.favoured in ("better", "worse") and says(effort.favoured, 0):
        return True
    return photos_tell(missed_px, effort.moved_px, numbers) and (
        says("better", times) or says("worse", times)
    )
