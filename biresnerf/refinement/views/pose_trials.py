"""Equal short trainings on sets of poses: which set lets a field predict photos it was not shown?

Everything but the poses (and the lenses, where they were refined too) is the same in each: photos, unseen views, scene
box, steps, samples and random seed. Unseen views are rendered from the poses as they stand, fitted to no field: a fit
would hide the errors under comparison. Each set is scored within its own field, so frames need not agree to the last
digit. Where poses move, those of the unseen views follow the field without training it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from biresnerf.data.photos.images import ImageSet
from biresnerf.errors import Interrupted
from biresnerf.geometry.camera.camera_models import Camera
from biresnerf.refinement.numbers.choosing import ViewNumbers
from biresnerf.refinement.optimise.joint_optimiser import JointOptimiser
from biresnerf.refinement.optimise.methods import Recipe
from biresnerf.refinement.optimise.photo_sampler import PhotoSampler
from biresnerf.refinement.optimise.renderer import Renderer
from biresnerf.refinement.scene.scene_frame import scene_frame
from biresnerf.refinement.views.evaluation import render_view, score_views


def trial_views(count: int, numbers: ViewNumbers) -> list[int]:
    """Indices of the views of `count` that a trial does not train on, evenly spread."""
    one_in = numbers.one_in
    return list(range(one_in // 2, count, max(one_in, -(-count // numbers.views_most))))


@dataclass(frozen=True, eq=False)
class TrialScores:
    """PSNR (dB) and SSIM of each unseen view, float64 [views]."""

    psnr: NDArray[np.float64]
    ssim: NDArray[np.float64]


def joined(parts: Sequence[TrialScores]) -> TrialScores:
    """The scores of several trials, one after the other."""
    return TrialScores(np.concatenate([p.psnr for p in parts]), np.concatenate([p.ssim for p in parts]))


class PoseTrials:
    """Begins trainings of sets of poses, one after the other, under the same conditions.

    Args:
        images: photos at working size.
        unseen: indices of the views that no field is trained on.
        rigs: sets of poses [n, 4, 4] that together define the scene box; in one frame.
        recipe: the field's sizes and rates, and how it is trained.
        steps: of each training; an open scene takes more.
        should_stop: called after every step.
    """

    def __init__(
        self,
        images: ImageSet,
        unseen: Sequence[int],
        rigs: Sequence[NDArray[np.float64]],
        recipe: Recipe,
        steps: int,
        should_stop: Callable[[], bool],
    ) -> None:
        self.images, self.unseen = images, list(unseen)
        self.frame = scene_frame(np.concatenate(list(rigs)), images, recipe.method.scene)
        self.kind = recipe.method.kinds.of(self.frame.unbounded)
        self.steps = steps * self.kind.trial_steps
        # All of it stage 1, and the rates fall to their end: with the rates of a longer run's first half, trainings on
        # the same poses differ by 0.25 dB from seed to seed (lego at 100 px, 200 steps), so by 0.04.
        self._recipe = recipe.apart(self.steps, (self.steps, self.steps), recipe.method.views.trial_samples)
        self._should_stop = should_stop
        self._sampler = PhotoSampler(images, self.unseen, recipe.device, recipe.method.by_detail)

    def begin(
        self,
        world_from_cam: NDArray[np.float64],
        cameras: tuple[Camera, ...] | None = None,
        *,
        moving: bool = False,
    ) -> Trial:
        """A field before its first step.

        Args:
            world_from_cam: [n, 4, 4], in the frame of the rigs.
            cameras: of each image at working size; the photos' own where left out.
            moving: whether poses are optimised with the field.
        """
        images = self.images if cameras is None else replace(self.images, cameras=cameras)
        poses = self.frame.unit_from_world.apply_to_poses(world_from_cam)
        optimiser = JointOptimiser(
            images, self.frame, poses, self._recipe, self.unseen, sampler=self._sampler
        )
        if not moving:
            optimiser.hold_poses()
        return Trial(optimiser, images, self.unseen, self.steps, self._should_stop)


@dataclass(frozen=True, eq=False)
class Trial:
    """One set of poses in training: a field that takes so many `steps` in all."""

    optimiser: JointOptimiser
    images: ImageSet
    unseen: Sequence[int]
    steps: int
    should_stop: Callable[[], bool]

    def train(self, share: float) -> None:
        """Step until this share of the training is done. Beyond its end, above 1, the rates stay as they are there.

        Raises:
            Interrupted: ``should_stop`` returned true.
        """
        while self.optimiser.step_index < round(share * self.steps):
            if self.should_stop():
                raise Interrupted("stopped while sets of poses were tried")
            self.optimiser.step()

    @property
    def work(self) -> float:
        """The work of the steps so far, in steps of a scene with a background."""
        return self.optimiser.step_index * self.optimiser.schedule.kind.step_work

    def scores(self) -> TrialScores:
        """How well the field predicts the unseen views by now. The more steps, the more pixels are rendered."""
        numbers = self.optimiser.method.views
        pixels = int(sum(self.images.widths[v] * self.images.heights[v] for v in self.unseen))
        stride = max(1, math.ceil(math.sqrt(pixels / (numbers.rays_per_step * self.optimiser.step_index))))
        return score_unseen(self.optimiser.renderer, self.images, self.unseen, stride, numbers.coarser)

    def render(self, view: int) -> NDArray[np.float32]:
        """A view whole [h, w, 3], to be looked at."""
        pose, coarser = self.optimiser.poses.matrices()[view].detach(), self.optimiser.method.views.coarser
        return render_view(self.optimiser.renderer, pose, view, as_photo=True, coarser=coarser).colour


def score_unseen(
    renderer: Renderer, images: ImageSet, unseen: Sequence[int], stride: int, coarser: float = 1.0
) -> TrialScores:
    """How well the field predicts unseen views from where they stand, on every `stride`-th pixel across and down.

    Rays are marched at `coarser` times the fine interval.
    """
    scores = [(each.psnr, each.ssim) for each in score_views(renderer, images, unseen, stride, coarser)]
    table = np.array(scores, dtype=np.float64).reshape(-1, 2)
    return TrialScores(table[:, 0], table[:, 1])
