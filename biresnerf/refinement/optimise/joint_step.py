"""What a step of the joint optimisation is told, and what it computes from that."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from biresnerf.field.backends import Directions
from biresnerf.field.radiance_field import FieldRates, Marching, PositionGradient, RadianceField, Rays
from biresnerf.refinement.optimise.camera_errors import CameraErrors
from biresnerf.refinement.optimise.cast_rays import cast_rays, viewing_directions
from biresnerf.refinement.optimise.methods import Method
from biresnerf.refinement.optimise.photo_sampler import PhotoSampler, PixelBatch
from biresnerf.refinement.parameters.exposure import Exposure
from biresnerf.refinement.parameters.intrinsics_parameters import IntrinsicsParameters
from biresnerf.refinement.parameters.pose_parameters import PoseParameters


@dataclass(frozen=True)
class StepNumbers:
    """All that changes from step to step, besides tensors and random numbers.

    Attributes:
        blur: standard deviation (px) of the photos' blur before its random factor.
        moves_focal: whether focal lengths move, where lenses do.
    """

    rays: int
    marching: Marching
    gradient: PositionGradient
    rates: FieldRates
    blur: float
    pose_rate: float
    lens_rate: float
    moves_focal: bool


@dataclass(frozen=True)
class StepOutcome:
    """Loss [] against the (blurred) targets, error [] of training rays against the sharp photos, and samples."""

    loss: Tensor
    error: Tensor
    samples: int


class Trained(Protocol):
    """What a step reads and moves; see `JointOptimiser`."""

    field: RadianceField
    poses: PoseParameters
    lenses: IntrinsicsParameters
    exposure: Exposure
    camera_errors: CameraErrors
    sampler: PhotoSampler
    directions: Directions
    draws: torch.Generator
    mobility: Tensor
    method: Method
    switch: int | None

    def over_background(self, origin: Tensor, direction: Tensor, trained: int, *, jitter: bool) -> Rays: ...


def joint_step(optimiser: Trained, told: StepNumbers) -> StepOutcome:
    """Draw pixels, render them, and move field, poses, lenses and exposures by the gradients of the loss."""
    field, poses, exposure = optimiser.field, optimiser.poses, optimiser.exposure
    moves_poses, moves_lenses = told.pose_rate > 0, told.lens_rate > 0
    batch = optimiser.sampler.draw(told.rays, told.blur, optimiser.draws)
    matrices = poses.matrices()
    if not moves_poses:
        matrices = matrices.detach()
    if moves_lenses:
        matrices, lenses = optimiser.lenses.with_gradient(matrices)
    else:
        lenses = optimiser.lenses.intrinsics
    in_cam = viewing_directions(optimiser.directions, lenses, batch.image, batch.xy)
    origin, direction = cast_rays(matrices, batch.image, in_cam)
    rays = optimiser.over_background(origin, direction, batch.trained, jitter=True)
    rendering = field.render(rays, told.marching, told.gradient)
    colour = exposure.shown(rendering, batch.image)
    loss = _loss(optimiser, exposure.forgiven(colour, batch.target), batch)
    loss.backward()
    field.step(told.rates)
    exposure.step(told.rates.networks)
    if moves_poses:
        mobility = optimiser.mobility[0 if optimiser.switch is None else 1]
        poses.step(told.pose_rate, mobility, field_rate=told.rates.networks)
        if moves_lenses:
            poses.dolly(optimiser.lenses.step(told.lens_rate, focal=told.moves_focal))
    shown = colour.detach().clamp(max=1)
    optimiser.camera_errors.add(batch.image, shown, batch.target, rendering.opacity.detach(), batch.weight)
    error = ((shown - batch.sharp) ** 2 * batch.weight[:, None])[: batch.trained].mean()
    # A pose that is not finite sees nothing, so the loss stays finite.
    return StepOutcome(loss.detach() + poses.zero_if_finite(), error, rendering.samples)


def _loss(optimiser: Trained, colour: Tensor, batch: PixelBatch) -> Tensor:
    weight, of_camera = batch.weight, optimiser.camera_errors.weights
    if of_camera is not None and optimiser.method.weights:
        weight = weight * of_camera[batch.image]
    return (optimiser.method.loss(colour, batch.target) * weight[:, None]).mean()
