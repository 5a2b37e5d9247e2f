"""Repair of lost cameras: other poses are tried against the frozen field.

A camera that starts too far off ends in a local minimum, or sees nothing and gets no gradient at all. The error
over its pose has many minima, but the field that the other cameras have formed distinguishes them: many poses are
scored, the best optimised for some steps, and the winner kept if it is clearly better.
"""

from __future__ import annotations

import dataclasses
import logging

import numpy as np
import torch
from torch import Tensor

from biresnerf.field.radiance_field import Marching, PositionGradient, Rendering
from biresnerf.frozen_model import FrozenModel
from biresnerf.geometry.pose_error import rotation_between_deg
from biresnerf.judging.compare import ANY_GAIN, FAR_REPAIRED, REPAIRED, is_better, octaves
from biresnerf.refinement.lost.own_matches import OwnMatches, better, contradicted
from biresnerf.refinement.optimise.joint_optimiser import JointOptimiser
from biresnerf.refinement.optimise.pose_hypotheses import pose_hypotheses
from biresnerf.refinement.parameters.pose_parameters import PoseParameters
from biresnerf.refinement.scene.shared_views import shared_shares

logger = logging.getLogger(__name__)

CHUNK = 4096  # rays rendered at once
SCORED_AT_ONCE = 10  # poses
ALONE_SIDE = 8  # a view shares what 8 x 8 pixels of it show
NO_ERROR = 1e-12


class RepairState(FrozenModel):
    """What a checkpoint keeps: images repaired, fixed points passed, samples spent."""

    repaired: tuple[int, ...] = ()
    times: int = 0
    spent: float = 0.0


class LostCameraRepair:
    """Looks for lost cameras at fixed points of the run and gives them other poses.

    Args:
        own: the photos' feature matches, where there are any.

    Attributes:
        repaired: images whose pose was replaced.
    """

    def __init__(self, optimiser: JointOptimiser, own: OwnMatches | None = None) -> None:
        self.optimiser, self._own, self.camera_errors = optimiser, own, optimiser.camera_errors
        self._numbers = optimiser.method.lost
        self.repaired: list[int] = []
        self._marching = optimiser.marching(optimiser.schedule.fine_interval)
        self._given = optimiser.poses.poses().numpy()
        self._times = 0  # how many of the fixed points have passed
        self._spent = 0.0  # samples

    def due(self) -> bool:
        """Whether one of the fixed points has been reached. The switch runs a repair regardless."""
        optimiser, options = self.optimiser, self.optimiser.options
        if not optimiser.method.repair:
            return False
        if optimiser.switch is None:
            least = float(options.coarse_steps_min)
            points = [share * least for share in optimiser.schedule.kind.repairs]
            return self._times < len(points) and optimiser.step_index >= points[self._times]
        steps, switch, numbers = optimiser.schedule.steps, optimiser.switch, self._numbers
        late = max(numbers.last_share * steps, switch + numbers.settled_share * (steps - switch))
        return self._times < 4 and optimiser.step_index >= late

    def run(self, *, switching: bool = False) -> None:
        """Try to repair all lost cameras, the worst first, as far as the budget goes."""
        optimiser = self.optimiser
        if not optimiser.method.repair:
            return
        self._times = 3 if switching else self._times + 1 if optimiser.switch is None else 4
        total = float(optimiser.schedule.samples(optimiser.schedule.steps, 0)) * optimiser.schedule.steps
        total *= self._numbers.guessed_times if bool(self.camera_errors.doubted.any()) else 1
        allowance = min(self._spent + self._numbers.event_share * total, self._numbers.run_share * total)
        self._marching = self._coarse_marching()
        self.place_by_matches()
        alone = self._alone()
        # Matches are better evidence than the error of a young field: cameras they placed stay (on dtu these were 2 deg
        # off, and 7 to 9 deg after a repair).
        suspects = (self.camera_errors.suspects | alone) & (optimiser.mobility[0] > 0)
        relative = torch.where(suspects, self.camera_errors.relative, -torch.inf)
        worst_first = relative.argsort(descending=True, stable=True)[: int(suspects.sum())].tolist()
        median = self._reference_error(suspects) if worst_first else 0.0
        for camera in worst_first:
            if self._spent >= allowance:
                logger.info("no budget left to repair camera %d", camera)
                break
            self._repair(camera, median, ~suspects, alone=bool(alone[camera]))

    def place_by_matches(self) -> None:
        """Give cameras that their own matches contradict poses that those support, the worst first."""
        if self._own is None:
            return
        optimiser, numbers = self.optimiser, self._numbers
        errors = self._own.errors_px(optimiser.poses.poses().numpy())
        wrong = contradicted(errors, numbers) & optimiser.bodies.alone
        trusted = ~(wrong | self.camera_errors.suspects.cpu().numpy())
        for camera in np.argsort(-np.nan_to_num(errors) * wrong)[: int(wrong.sum())].tolist():
            found = self._own.placed(camera, optimiser.poses.poses().numpy(), trusted, numbers)
            logger.info(
                "the matches of camera %d are off by %.3g px and %s",
                camera, errors[camera], "place it elsewhere" if found is not None else "do not place it",
            )  # fmt: skip
            if found is not None:
                self._replace(camera, torch.from_numpy(found[:3]).float().to(optimiser.device))

    def matches_object_to(self, camera: int, unit_from_cam: Tensor) -> bool:
        """Whether a camera's own matches fit another pose [3, 4] less well than its present one."""
        if self._own is None:
            return False
        now = self.optimiser.poses.poses().numpy()
        moved = now.copy()
        moved[camera, :3] = unit_from_cam.double().cpu().numpy()
        return better(camera, self._own.errors_px(moved), self._own.errors_px(now))

    def _replace(self, camera: int, unit_from_cam: Tensor) -> None:
        self.optimiser.replace_pose(camera, unit_from_cam)
        self.repaired = sorted({*self.repaired, camera})

    @torch.no_grad()
    def _alone(self) -> Tensor:
        """Mask [n] of training cameras that look where almost no other does: their error cannot show a wrong pose."""
        optimiser = self.optimiser
        alone = torch.zeros(len(optimiser.poses), dtype=torch.bool, device=optimiser.device)
        least = optimiser.schedule.kind.alone
        if not least:
            return alone
        cameras = torch.arange(len(alone), device=optimiser.device)
        unshared = self._shared(optimiser.poses.matrices(), cameras) < least
        unshared &= ~self.camera_errors.held_out
        return unshared if float(unshared.float().mean()) <= self._numbers.alone_most else alone

    @torch.no_grad()
    def _shared(self, matrices: Tensor, image: Tensor) -> Tensor:
        """Share [k] of the view of photos `image` [k] from poses [k, 3, 4] that other cameras see, too."""
        optimiser, points = self.optimiser, []
        for part in torch.arange(len(image), device=optimiser.device).split(CHUNK // ALONE_SIDE**2):
            owner = part.repeat_interleave(ALONE_SIDE**2)
            xy = self._grid(image[owner], ALONE_SIDE)
            origin, direction = optimiser.renderer.cast(matrices[owner], image[owner], xy)
            rendering = self._render(matrices[owner], image[owner], xy, PositionGradient())
            self._spent += self._numbers.forward_cost * rendering.samples
            points.append((origin + rendering.depth[:, None] * direction).reshape(len(part), -1, 3))
        return shared_shares(
            torch.cat(points), image, optimiser.poses.matrices(), optimiser.lenses.intrinsics
        )

    def _grid(self, image: Tensor, side: int) -> Tensor:
        """Centres [rays, 2] of `side` x `side` pixels spread over each photo; `image` [rays] names it that often."""
        along = (torch.arange(side, device=image.device) + 0.5) / side
        grid = torch.stack(torch.meshgrid(along, along, indexing="xy"), -1).reshape(-1, 2)
        size = self.optimiser.sampler.sizes[0][image]
        return (grid.repeat(len(image) // len(grid), 1) * size).floor() + 0.5

    @torch.no_grad()
    def _reference_error(self, suspects: Tensor) -> float:
        """Median score of cameras that are not lost."""
        trusted = torch.nonzero(~suspects & ~self.camera_errors.held_out)[:, 0]
        if len(trusted) == 0:
            return 0.0
        count = min(self._numbers.references, len(trusted))
        chosen = trusted[torch.linspace(0, len(trusted) - 1, count).long()]
        return float(self._scores(self.optimiser.poses.matrices()[chosen], chosen).median())

    def _repair(self, camera: int, median: float, trusted: Tensor, *, alone: bool) -> None:
        optimiser = self.optimiser
        now = optimiser.poses.poses().numpy()
        hypotheses = pose_hypotheses(
            self._given, now, camera, trusted.cpu().numpy(), optimiser.photo_distances[camera], self._numbers
        )
        tried = torch.from_numpy(np.concatenate([now[camera : camera + 1], hypotheses])[:, :3])
        tried = tried.float().to(optimiser.device)
        image = torch.full((len(tried),), camera, device=optimiser.device)
        scores = self._scores(tried, image)
        old = float(scores[0])
        # A guess need not be clearly beaten.
        rule = ANY_GAIN if bool(self.camera_errors.doubted[camera]) else REPAIRED
        if alone:  # its own error says nothing, and neither does that of another pose that shares no view
            shared = self._shared(tried, image) >= optimiser.schedule.kind.alone
            if not bool(shared.any()):
                return
            tried, scores = tried[shared], scores[shared]
        for keep, rays, steps in self._numbers.rounds:
            chosen = _distinct(tried, scores, keep, self._numbers.distinct_deg)
            tried = self._optimised(tried[chosen], camera, rays, steps)
            scores = self._scores(tried, image[: len(tried)])
            best = int(scores.argmin())
            error = float(scores[best])
            gain = octaves(old, error, NO_ERROR)
            accepted = near = error < self._numbers.near_median * median
            if not alone:
                accepted = is_better(gain, rule) and (near or is_better(gain, FAR_REPAIRED))
            accepted = accepted and not self.matches_object_to(camera, tried[best])
            if accepted and (optimiser.switch is None or error < median):
                break  # the run itself optimises the rest
        logger.info(
            "camera %d stands out (error %.3g, others %.3g): best pose found has %.3g, %s",
            camera, old, median, error, "accepted" if accepted else "rejected",
        )  # fmt: skip
        if accepted:
            self._replace(camera, tried[best])
        elif old < self._numbers.near_median * median and not alone:
            self.camera_errors.believe(camera)  # nothing better was found than where it stands

    @torch.no_grad()
    def _scores(self, matrices: Tensor, image: Tensor) -> Tensor:
        """Mean squared error [k] of photos `image` [k] seen from poses [k, 3, 4], on a fixed grid of pixels."""
        optimiser = self.optimiser
        side = self._numbers.score_side
        owner = torch.arange(len(image), device=optimiser.device).repeat_interleave(side**2)
        rays = image[owner]
        xy = self._grid(rays, side)
        target = optimiser.sampler.colours(rays, xy, self._blur())
        counting = optimiser.sampler.counting(rays, xy)
        errors = []
        for part in torch.arange(len(rays), device=optimiser.device).split(SCORED_AT_ONCE * side**2):
            rendering = self._render(matrices[owner[part]], rays[part], xy[part], PositionGradient())
            self._spent += self._numbers.forward_cost * rendering.samples
            colour = optimiser.exposure.refitted(
                rendering,
                target[part],
                None if counting is None else counting[part],
                len(part) // side**2,
            )
            errors.append(((colour - target[part]) ** 2).mean(1))
        squared = torch.cat(errors).reshape(len(image), -1)
        if counting is None:
            mean = squared.mean(1)
        else:
            counting = counting.reshape(squared.shape)
            mean = (squared * counting).sum(1) / counting.sum(1).clamp(min=1)
        return mean / self.camera_errors.shares[image]

    def _optimised(self, matrices: Tensor, camera: int, rays: int, steps: int) -> Tensor:
        """Poses [k, 3, 4] after some steps of Adam on the photometric error alone, all in one batch."""
        optimiser = self.optimiser
        bottom = matrices.new_tensor([0.0, 0, 0, 1]).expand(len(matrices), 1, 4)
        poses = PoseParameters(torch.cat([matrices, bottom], 1), optimiser.poses.length, optimiser.device)
        count = len(matrices) * rays
        owner = torch.arange(len(matrices), device=optimiser.device).repeat_interleave(rays)
        image = torch.full((count,), camera, device=optimiser.device)
        first, last = self._numbers.rates
        for step in range(steps):
            xy = optimiser.sampler.random_pixels(image, optimiser.generator)
            target = optimiser.sampler.colours(image, xy, self._blur())
            rendering = self._render(
                poses.matrices()[owner], image, xy, PositionGradient(1.0, 1.0, 1.0), jitter=True
            )
            self._spent += rendering.samples
            colour = optimiser.exposure.refitted(rendering, target, None, len(matrices))
            optimiser.method.loss(colour, target).sum().backward()
            poses.step(first * (last / first) ** (step / steps))
        return poses.matrices().detach()

    def _blur(self) -> float:
        """Blur of recent targets (px): half of the schedule's width, of which batches draw a random share."""
        optimiser = self.optimiser
        sampler = optimiser.sampler
        return optimiser.schedule.blur(optimiser.step_index, optimiser.switch, sampler.long_side) / 2

    def _render(
        self, matrix: Tensor, image: Tensor, xy: Tensor, gradient: PositionGradient, *, jitter: bool = False
    ) -> Rendering:
        renderer = self.optimiser.renderer
        rays = renderer.over_background(*renderer.cast(matrix, image, xy), 0, jitter=jitter)
        return renderer.field.render(rays, self._marching, gradient)

    def _coarse_marching(self) -> Marching:
        """Coarser samples than the run's, and one more cell around occupied ones: gradients begin there."""
        optimiser = self.optimiser
        interval = optimiser.schedule.interval(optimiser.step_index, optimiser.switch)
        marching = optimiser.marching(max(interval, self._numbers.least_interval))
        occupied = torch.nn.functional.max_pool3d(
            marching.occupied[None, None].float(), 3, stride=1, padding=1
        )
        return dataclasses.replace(marching, occupied=occupied[0, 0].to(torch.uint8).contiguous())

    def state(self) -> RepairState:
        return RepairState(repaired=tuple(self.repaired), times=self._times, spent=self._spent)

    def load_state(self, state: RepairState) -> None:
        self.repaired, self._times, self._spent = list(state.repaired), state.times, state.spent
        for camera in self.repaired:
            self.optimiser.free(camera)


def _distinct(matrices: Tensor, scores: Tensor, keep: int, apart_deg: float) -> Tensor:
    """Indices of the `keep` best poses [k, 3, 4] of which no two are turned by less than `apart_deg`."""
    rotations = matrices[:, :, :3].double().cpu().numpy()
    chosen: list[int] = []
    for i in scores.argsort(stable=True).tolist():
        if bool((rotation_between_deg(rotations[chosen], rotations[i]) >= apart_deg).all()):
            chosen.append(i)
        if len(chosen) == keep:
            break
    return torch.tensor(chosen, device=matrices.device)
