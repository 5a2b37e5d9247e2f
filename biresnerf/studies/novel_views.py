"""Unseen views, rendered from their true poses after BARF's test-time refinement; and LPIPS to score them."""

from __future__ import annotations

import importlib
import importlib.util
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from biresnerf.data.model.dataset import Dataset
from biresnerf.data.photos.images import load_images
from biresnerf.geometry.camera.camera import Intrinsics
from biresnerf.geometry.similarity import align_robust
from biresnerf.refinement.optimise.joint_optimiser import JointOptimiser
from biresnerf.refinement.parameters.pose_parameters import PoseParameters
from biresnerf.refinement.views.evaluation import fit_rays, render_view
from biresnerf.refinement.views.floaters import unshared_opacity

# torchvision's name of the file. The package would download it, which a measurement must not do.
VGG_WEIGHTS = "vgg16-397923af.pth"


@dataclass(frozen=True, eq=False)
class PhotoAndRender:
    """Both [h, w, 3] in 0..1, at working size; `counts` [h, w] marks the pixels to compare, None means all.

    And the render's `unshared_opacity`.
    """

    photo: Tensor
    render: Tensor
    unshared: float
    counts: Tensor | None = None


def render_test_views(
    optimiser: JointOptimiser, views: Dataset, truth: NDArray[np.float64]
) -> Iterator[PhotoAndRender]:
    """Each test view at its true pose, transformed to the optimised frame and fitted to the frozen field.

    A similarity from the true training poses `truth` [n, 4, 4] to the optimised ones (robust, as one lost
    camera must not spoil all views) transforms the poses; then 100 steps on 1024 rays each, as in BARF.
    """
    options = optimiser.options
    images = load_images(views, options.max_image_size, options.background)
    unit_from_true = align_robust(truth, optimiser.poses.poses().numpy())
    unit_from_cam = unit_from_true.apply_to_poses(views.world_from_cam)
    intrinsics = Intrinsics.from_cameras(images.cameras).to(optimiser.device)
    for index in range(len(images)):
        photo = torch.from_numpy(images.image(index).astype(np.float32) / 255)
        mask = images.counts_image(index)
        counts = None if mask is None else torch.from_numpy(mask)
        matrix = _fitted(optimiser, unit_from_cam[index], photo, counts, index, intrinsics)
        renderer, held_out = optimiser.renderer, optimiser.camera_errors.held_out
        colour = render_view(renderer, matrix, index, intrinsics).colour
        unshared = unshared_opacity(renderer, held_out, matrix, index, intrinsics)
        yield PhotoAndRender(photo, torch.from_numpy(colour), unshared, counts)


def _fitted(
    optimiser: JointOptimiser,
    unit_from_cam: NDArray[np.float64],
    photo: Tensor,
    counts: Tensor | None,
    index: int,
    intrinsics: Intrinsics,
) -> Tensor:
    """unit_from_cam [3, 4] of one view after fitting its photo to the field."""
    device = optimiser.device
    pose = PoseParameters(torch.from_numpy(unit_from_cam[None]), optimiser.poses.length, device)
    pixels = torch.nonzero(torch.ones(photo.shape[:2]) if counts is None else counts)
    rays, renderer = fit_rays(optimiser.method, optimiser.rays), optimiser.renderer
    which = torch.full((rays,), index, device=device)
    steps, rate = optimiser.method.views.fit_steps, optimiser.method.views.fit_rate
    for step in range(steps):
        y, x = pixels[torch.randint(len(pixels), (rays,), generator=optimiser.generator)].T
        xy = torch.stack([x, y], 1).to(device) + 0.5
        cast = renderer.cast(pose.matrices().expand(rays, 3, 4), which, xy, intrinsics)
        rendering = renderer.render(*cast, jitter=True)
        optimiser.method.loss(rendering.colour, photo[y, x].to(device)).mean().backward()
        pose.step(rate * 0.1 ** (step / steps))
    return pose.matrices().detach()[0]


def lpips_absent() -> str | None:
    """The reason why LPIPS cannot be measured here; None if it can."""
    if importlib.util.find_spec("lpips") is None or importlib.util.find_spec("torchvision") is None:
        return "the packages lpips and torchvision are not installed"
    weights = Path(torch.hub.get_dir()) / "checkpoints" / VGG_WEIGHTS
    return None if weights.is_file() else f"the weights {weights} are missing"


def lpips_vgg() -> Callable[[Tensor, Tensor], float]:
    """A function of two images [h, w, 3] in 0..1; call only if `lpips_absent` returns None."""
    model = importlib.import_module("lpips").LPIPS(net="vgg", verbose=False).eval()

    @torch.no_grad()
    def distance(image: Tensor, reference: Tensor) -> float:
        a, b = (2 * x.permute(2, 0, 1)[None].float() - 1 for x in (image, reference))
        return float(model(a, b))

    return distance
