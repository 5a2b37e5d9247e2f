"""What a step of the joint optimisation is told, and what it computes from that."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from biresnerf.field.radiance_field import FieldRates, Marching, PositionGradient
from biresnerf.refinement.optimise.camera_errors import CameraErrors
from biresnerf.refinement.optimise.methods import Method
from biresnerf.refinement.optimise.photo_sampler import PhotoSampler
from biresnerf.refinement.optimise.renderer import Renderer, cast_rays, viewing_directions


@dataclass(frozen=True)
class StepNumbers:
    """All that changes from step to step, besides what moves and random numbers.

    Attributes:
        mobility: each camera's factor of the pose rate [n].
        blur: standard deviation (px) of the photos' blur before its random factor.
        moves_focal: whether focal lengths move, where lenses do.
    """

    rays: int
    marching: Marching
    gradient: PositionGradient
    rates: FieldRates
    blur: float
    pose_rate: float
    mobility: Tensor
    lens_rate: float
    moves_focal: bool


@dataclass(frozen=True)
class StepOutcome:
    """Loss [] against the (blurred) targets, error [] of training rays against the sharp photos, and samples."""

    loss: Tensor
    error: Tensor
    samples: int


def joint_step(
    renderer: Renderer, sampler: PhotoSampler, camera_errors: CameraErrors, method: Method, told: StepNumbers
) -> StepOutcome:
    """Draw pixels, render them, and move field, poses, lenses and exposures by the gradients of the loss."""
    field, joint = renderer.field, renderer.joint
    poses, exposure = joint.poses, joint.exposure
    moves_poses, moves_lenses = told.pose_rate > 0, told.lens_rate > 0
    batch = sampler.draw(told.rays, told.blur, renderer.draws)
    matrices = poses.matrices()
    if not moves_poses:
        matrices = matrices.detach()
    if moves_lenses:
        matrices, lenses = joint.lenses.with_gradient(matrices)
    else:
        lenses = joint.lenses.intrinsics
    in_cam = viewing_directions(renderer.directions, lenses, batch.image, batch.xy)
    origin, direction = cast_rays(matrices, batch.image, in_cam)
    rays = renderer.over_background(origin, direction, batch.trained, jitter=True)
    rendering = field.render(rays, told.marching, told.gradient)
    colour = exposure.shown(rendering, batch.image)
    weight, of_camera = batch.weight, camera_errors.weights
    if of_camera is not None and method.weights:
        weight = weight * of_camera[batch.image]
    loss = (method.loss(exposure.forgiven(colour, batch.target), batch.target) * weight[:, None]).mean()
    loss.backward()
    field.step(told.rates)
    exposure.step(told.rates.networks)
    if moves_poses:
        poses.step(told.pose_rate, told.mobility, field_rate=told.rates.networks)
        if moves_lenses:
            poses.dolly(joint.lenses.step(told.lens_rate, focal=told.moves_focal))
    shown = colour.detach().clamp(max=1)
    camera_errors.add(batch.image, shown, batch.target, rendering.opacity.detach(), batch.weight)
    error = ((shown - batch.sharp) ** 2 * batch.weight[:, None])[: batch.trained].mean()
    # A pose that is not finite sees nothing, so the loss stays finite.
    return StepOutcome(loss.detach() + poses.zero_if_finite(), error, rendering.samples)
