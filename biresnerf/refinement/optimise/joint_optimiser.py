"""The joint optimisation of poses and radiance field: one object holding all state, one method taking a step."""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from biresnerf.data.photos.images import ImageSet
from biresnerf.field.backends import directions_for, make_occupancy
from biresnerf.field.radiance_field import Marching
from biresnerf.geometry.perturb import RIG_DISTANCE
from biresnerf.geometry.rigid_bodies import RigidBodies
from biresnerf.refinement.optimise.async_metrics import AsyncMetrics, StepResult
from biresnerf.refinement.optimise.camera_errors import CameraErrors
from biresnerf.refinement.optimise.methods import Recipe
from biresnerf.refinement.optimise.optimiser_state import Part, StepState
from biresnerf.refinement.optimise.photo_sampler import PhotoSampler
from biresnerf.refinement.optimise.pose_hypotheses import photo_distances
from biresnerf.refinement.optimise.renderer import Renderer, cast_rays, viewing_directions
from biresnerf.refinement.parameters.exposure import Exposure
from biresnerf.refinement.parameters.intrinsics_parameters import IntrinsicsParameters
from biresnerf.refinement.parameters.joint_parameters import JointParameters
from biresnerf.refinement.parameters.pose_parameters import PoseParameters
from biresnerf.refinement.scene.scene_frame import SceneFrame

MOST_SAMPLES = 768  # per ray
RAYS_MOST = 1 << 15
FIRST_SAMPLES = 64  # per ray, as guessed for the first step


class JointOptimiser:
    """Poses, field, occupancy and their schedules.

    Args:
        images: photos at working size.
        frame: the unit frame.
        unit_from_cam: start poses [n, 4, 4].
        held_out: images that move their own pose but never the field.
        mobility: each camera's factor of the pose rate [2, n] in stage 1 and stage 2; default 1.
        bodies: which cameras move together, and which not at all; by default each moves independently.
        lenses: the intrinsics, where they may move; by default those of the images.
        sampler: of the same images and held-out views, if another optimiser has one already.
        poses: in place of poses that move freely from the start poses.
    """

    def __init__(
        self,
        images: ImageSet,
        frame: SceneFrame,
        unit_from_cam: np.ndarray,
        recipe: Recipe,
        held_out: list[int],
        mobility: np.ndarray | None = None,
        bodies: RigidBodies | None = None,
        lenses: IntrinsicsParameters | None = None,
        sampler: PhotoSampler | None = None,
        poses: PoseParameters | None = None,
    ) -> None:
        options, device, threads = recipe.options, recipe.device, recipe.threads
        self.frame, self.options, self.device, self.threads = frame, options, device, threads
        self.bodies = bodies or RigidBodies.free(len(images))
        self.method = recipe.method
        self.field = self.method.build_field(options, frame, device, threads)
        self.lenses = lenses or IntrinsicsParameters.held(images.cameras, device)
        self.poses = (
            poses
            if poses is not None
            else PoseParameters(
                torch.from_numpy(unit_from_cam),
                frame.distance / RIG_DISTANCE,
                device,
                betas=self.method.pose_betas,
                double_step=options.double_pose_step,
                body=torch.from_numpy(self.bodies.of),
            )
        )
        self.schedule = self.method.scheduled(options, frame)
        self._images = images
        self.sampler = sampler or PhotoSampler(images, held_out, device, self.method.by_detail)
        self.camera_errors = CameraErrors(images, held_out, device, self.method.errors)
        self.directions, self.metrics = directions_for(device), AsyncMetrics(device)
        self.occupancy = make_occupancy(self.method.occupancy_side(options), device)
        self.generator = torch.Generator().manual_seed(options.seed)
        # Steps draw random numbers on the device, as draws of the host would have to be waited for.
        on_device = None if device.type == "cpu" else torch.Generator(device).manual_seed(options.seed)
        self.draws = on_device or self.generator
        seen = images.pixels if images.counts is None else images.pixels[images.counts]
        behind = frame.background if frame.background is not None else seen.mean(0) / 255
        self.background = torch.as_tensor(behind, dtype=torch.float32, device=device)
        around = self.background if frame.background is not None else None
        self.exposure = Exposure(images, options.exposure, held_out, around, device, self.method.parameters)
        self.step_index = 0
        # The step at which stage 2 began. A method of one stage is in its last from the first step.
        self.switch: int | None = None if self.method.two_stages else 0
        self.poses_held = False  # whether poses and lenses stay fixed
        self.batch_share = 1.0  # of the requested samples; less where they do not fit in memory
        self.mobility = (
            torch.ones(2, len(self.poses), device=device)
            if mobility is None or not self.method.mobility
            else torch.tensor(mobility, dtype=torch.float32, device=device)
        )
        self.mobility[:, torch.from_numpy(self.bodies.fixed).to(device)] = 0.0
        guess = self.schedule.samples(0, None) // (self.field.stratified or FIRST_SAMPLES)
        self.rays = max(self.method.rays_least, guess)

    @property
    def recipe(self) -> Recipe:
        """The recipe for the rest of the run, whose options may have changed on the way."""
        return Recipe(self.options, self.method, self.device, self.threads)

    @property
    def joint(self) -> JointParameters:
        """All that moves but the field."""
        robust = self.method.robust_frame
        return JointParameters(self.frame, self.bodies, self.poses, self.lenses, self.exposure, robust)

    @property
    def renderer(self) -> Renderer:
        """The field as it is now."""
        marching = self.marching(self.schedule.fine_interval)
        return Renderer(self.field, self.joint, marching, self.background, self.directions, self.draws)

    @cached_property
    def photo_distances(self) -> NDArray[np.float32]:
        """How unlike the photos are, see `photo_distances`; computed when a lost camera first needs it."""
        return photo_distances(self._images)

    def replace_pose(self, camera: int, unit_from_cam: Tensor) -> None:
        """Restart one camera at another pose [3, 4], as free as any and with no history."""
        self.poses.replace(camera, unit_from_cam)
        self.camera_errors.forget(camera)
        self.exposure.forget(camera)
        self.free(camera)

    def free(self, camera: int) -> None:
        """Let a camera, and those that move with it, move in both stages."""
        self.mobility[:, self.poses.members(camera)] = 1.0

    def hold_poses(self) -> None:
        """Keep poses and lenses fixed from now on."""
        self.poses_held = True

    def halve_batch(self) -> None:
        """Halve the samples of steps from now on."""
        self.batch_share /= 2
        self.rays = max(self.method.rays_least, self.rays // 2)
        self.field.release_memory()

    def marching(self, interval: float) -> Marching:
        near, far = self.schedule.near(self.step_index, self.switch), self.schedule.far(self.frame.far)
        near = self.frame.distance * (max(near, self.frame.near) if self.method.near_plane else near)
        merging = self.method.merging if self.switch is not None else None  # stage 1 needs every sample
        return Marching(interval, near, far, MOST_SAMPLES, self.occupancy.occupied, merging)

    def step(self) -> StepResult:
        """One step of the joint optimisation."""
        t, schedule = self.step_index, self.schedule
        self.field.reach(t / schedule.steps)
        if t % schedule.numbers.occupancy_period == 0 and self.method.pruned:
            self._update_occupancy(t)
        loss, error, samples = self._learn()
        rays = self.rays
        self.step_index += 1
        self._adapt_rays(samples, int(self.batch_share * schedule.samples(t, self.switch)))
        of_loss, of_error = self.metrics.read(loss, error)
        return StepResult(of_loss, of_error, rays, samples)

    def _learn(self) -> tuple[Tensor, Tensor, int]:
        """Draw pixels, render them, and move field, poses, lenses and exposures by the gradients of the loss.

        Returns:
            loss [] against the (blurred) targets, error [] of training rays against the sharp photos, and samples.
        """
        t, switch, schedule, renderer = self.step_index, self.switch, self.schedule, self.renderer
        poses, exposure, rates = self.poses, self.exposure, schedule.field_rates(t, switch)
        pose_rate, held = self.pose_rate(), self.poses_held or not self.lenses.moving
        lens_rate = 0.0 if held else schedule.lens_rate(t, switch)
        moves_poses, moves_lenses = pose_rate > 0, lens_rate > 0
        batch = self.sampler.draw(self.rays, schedule.blur(t, switch, self.sampler.long_side), self.draws)
        matrices, lenses = poses.matrices(), self.lenses.intrinsics
        if not moves_poses:
            matrices = matrices.detach()
        if moves_lenses:
            matrices, lenses = self.lenses.with_gradient(matrices)
        in_cam = viewing_directions(self.directions, lenses, batch.image, batch.xy)
        origin, direction = cast_rays(matrices, batch.image, in_cam)
        rays = renderer.over_background(origin, direction, batch.trained, jitter=True)
        marching = self.marching(schedule.interval(t, switch))
        rendering = self.field.render(rays, marching, schedule.position_gradient(t, switch))
        colour = exposure.shown(rendering, batch.image)
        weight, of_camera = batch.weight, self.camera_errors.weights
        if of_camera is not None and self.method.weights:
            weight = weight * of_camera[batch.image]
        forgiven = exposure.forgiven(colour, batch.target)
        loss = (self.method.loss(forgiven, batch.target) * weight[:, None]).mean()
        loss.backward()
        self.field.step(rates)
        exposure.step(rates.networks)
        if moves_poses:
            mobility = self.mobility[0 if switch is None else 1]
            poses.step(pose_rate, mobility, field_rate=rates.networks)
            if moves_lenses:
                poses.dolly(self.lenses.step(lens_rate, focal=schedule.focal_moves(switch)))
        shown = colour.detach().clamp(max=1)
        self.camera_errors.add(batch.image, shown, batch.target, rendering.opacity.detach(), batch.weight)
        error = ((shown - batch.sharp) ** 2 * batch.weight[:, None])[: batch.trained].mean()
        # A pose that is not finite sees nothing, so the loss stays finite.
        return loss.detach() + poses.zero_if_finite(), error, rendering.samples

    def pose_rate(self) -> float:
        """Learning rate of the poses at this step."""
        return 0.0 if self.poses_held else self.schedule.pose_rate(self.step_index, self.switch)

    def end_after(self, share: float) -> None:
        """End the run after this share of the requested steps, if not sooner."""
        self._end_at(min(self.step_index + round(share * self.options.steps), self.schedule.steps))

    def set_steps(self, steps: int) -> None:
        """Set how many steps the run takes in all: the rest of its schedule is compressed or stretched."""
        if self.switch is None:
            self._plan(steps)
        else:
            self._end_at(steps)

    def _plan(self, steps: int) -> None:
        self.options = self.options.with_steps(steps)
        self.schedule = replace(self.schedule, options=self.options)

    def _end_at(self, steps: int) -> None:
        options = self.schedule.options.model_copy(update={"steps": steps})
        self.schedule = replace(self.schedule, options=options)

    def start_reconstruction(self) -> None:
        """Switch to stage 2 at this step."""
        self.switch = self.step_index
        self.field.start_reconstruction()

    def _update_occupancy(self, step: int) -> None:
        self.occupancy.update(
            self.field,
            self.schedule.fine_interval,
            self.draws,
            looked_at=self.schedule.empty_cells_looked_at(step),
            prune=self.schedule.pruned(step),
            dilate=self.schedule.dilated(self.switch),
        )

    def _adapt_rays(self, samples: int, budget: int) -> None:
        wanted = self.rays * budget / max(1, samples)
        wanted = min(max(wanted, self.rays / 1.5), self.rays * 1.5)
        self.rays = int(min(max(wanted, self.method.rays_least), RAYS_MOST))

    def coarse_state(self) -> dict[str, Tensor]:
        """The tensors of stage 1: all but the reconstruction module, which has not moved."""
        return {name: tensor for name, tensor in self.state().items() if "reconstruction" not in name}

    def state(self) -> dict[str, Tensor]:
        """All tensors of the run (shared, not copied)."""
        parts = {name: part.state() for name, part in self._parts().items()}
        named = {f"{name}.{key}": tensor for name, part in parts.items() for key, tensor in part.items()}
        return {"generator": self.generator.get_state(), **named}

    def _parts(self) -> dict[str, Part]:
        return {
            "field": self.field,
            "poses": self.poses,
            "lenses": self.lenses,
            "occupancy": self.occupancy,
            "camera_errors": self.camera_errors,
            "exposure": self.exposure,
        }

    def step_state(self) -> StepState:
        """The state that is not in tensors."""
        return StepState(
            step_index=self.step_index,
            switch=self.switch,
            rays=self.rays,
            poses_held=self.poses_held,
            batch_share=self.batch_share,
            planned_steps=self.options.steps,
            steps=self.schedule.steps,
        )

    def load_state(self, tensors: dict[str, Tensor], numbers: StepState) -> None:
        """Restore what `state` and `step_state` returned; the next step is then the one that would have come."""
        self.generator.set_state(tensors["generator"])
        for name, part in self._parts().items():
            head = f"{name}."
            part.load_state({k.removeprefix(head): v for k, v in tensors.items() if k.startswith(head)})
        self.step_index, self.switch, self.rays = numbers.step_index, numbers.switch, numbers.rays
        self.poses_held, self.batch_share = numbers.poses_held, numbers.batch_share
        if numbers.planned_steps != self.options.steps:
            self._plan(numbers.planned_steps)
        self._end_at(numbers.steps)
        if self.draws is not self.generator:
            self.draws.manual_seed(self.options.seed + self.step_index)  # its state is not kept
        self.field.reach(self.step_index / self.schedule.steps)
