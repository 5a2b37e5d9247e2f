"""Measuring a finished field: held-out poses fitted to it, views rendered, PSNR and SSIM; and the orbit."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from biresnerf.data.photos.images import ImageSet
from biresnerf.field.radiance_field import Rendering
from biresnerf.geometry.camera.camera import Intrinsics
from biresnerf.refinement.optimise.joint_optimiser import JointOptimiser
from biresnerf.refinement.optimise.methods import Method
from biresnerf.refinement.optimise.photo_sampler import PixelBatch
from biresnerf.refinement.optimise.renderer import Renderer
from biresnerf.refinement.views.image_metrics import psnr, ssim

CHUNK = 8192  # rays rendered at once
SWING_BELOW_DEG = 200.0  # cameras spread less than this about the scene: the orbit swings to and fro


@dataclass(frozen=True, eq=False)
class RenderedView:
    """A view at working size: colour [h, w, 3] in 0..1 and depth [h, w] (unit lengths along the ray)."""

    colour: np.ndarray
    depth: np.ndarray
    opacity: np.ndarray


@dataclass(frozen=True, eq=False)
class ViewScore:
    """A view scored against its photo."""

    image: int
    view: RenderedView
    psnr: float
    ssim: float


def fit_rays(method: Method, rays: int) -> int:
    """Rays of one step of fitting poses to the frozen field: as BARF, but no more than a large network can afford."""
    most = method.views.fit_rays
    return min(most, rays) if method.large_network else most


def fit_held_out_poses(optimiser: JointOptimiser, held_out: list[int]) -> None:
    """Fit the poses of held-out views to the frozen field by their photometric error (method 2.4, item 4).

    And their exposures, where those are compensated. Poses that are held stay: the field's own error would move them.
    """
    held, exposure, poses = optimiser.poses_held, optimiser.exposure, optimiser.poses
    if not held_out or (held and exposure.gains() is None):
        return
    mobility = torch.zeros(len(poses), device=optimiser.device)
    mobility[held_out] = 1.0
    mobility[torch.from_numpy(optimiser.bodies.fixed).to(optimiser.device)] = 0.0
    poses.restart_adam()
    exposure.restart_adam()
    renderer = optimiser.renderer

    def seen(rays: int) -> tuple[PixelBatch, Rendering]:
        """Pixels drawn from the held-out photos, and what the field shows there from the present poses."""
        batch = optimiser.sampler.draw(rays, 0.0, renderer.draws, held_out_only=True)
        cast = renderer.cast(poses.matrices()[batch.image], batch.image, batch.xy)
        return batch, renderer.render(*cast, jitter=True)

    if held:  # what is seen of the field stays the same
        with torch.no_grad():
            batch, rendering = seen(CHUNK)
    # Not longer than the field was trained, or a short run would take longer to measure than to do.
    numbers = optimiser.method.views
    steps = numbers.fit_steps if held else min(numbers.fit_steps, optimiser.options.steps)
    for step in range(steps):
        if not held:
            batch, rendering = seen(fit_rays(optimiser.method, optimiser.rays))
        colour = exposure.forgiven(exposure.shown(rendering, batch.image), batch.sharp)
        (optimiser.method.loss(colour, batch.sharp) * batch.weight[:, None]).mean().backward()
        if not held:
            poses.step(numbers.fit_rate * 0.1 ** (step / steps), mobility)
        exposure.step(numbers.fit_exposure_rate * 0.1 ** (step / steps))


@torch.no_grad()
def render_view(
    renderer: Renderer,
    unit_from_cam: Tensor,
    image: int,
    intrinsics: Intrinsics | None = None,
    stride: int = 1,
    *,
    as_photo: bool = False,
    coarser: float = 1.0,
) -> RenderedView:
    """Render what a camera at `unit_from_cam` [3, 4] with the intrinsics of `image` sees, whole.

    `intrinsics` are the run's images' where not given; of rows and columns every `stride`-th is rendered. `as_photo`
    gives it the exposure of photo `image`, to be compared with it; else it has the mean exposure of all. Rays are
    marched at `coarser` times the fine interval.
    """
    lenses = intrinsics or renderer.joint.lenses.intrinsics
    width, height = int(lenses.width[image]), int(lenses.height[image])
    rows, columns = torch.arange(0, height, stride) + 0.5, torch.arange(0, width, stride) + 0.5
    y, x = torch.meshgrid(rows, columns, indexing="ij")
    pixels = torch.stack([x, y], -1).reshape(-1, 2).to(renderer.device)
    parts = []
    for xy in pixels.split(CHUNK):
        index = torch.full((len(xy),), image, device=renderer.device)
        origin, direction = renderer.cast(
            unit_from_cam.float().to(renderer.device).expand(len(xy), 3, 4), index, xy, lenses
        )
        part = renderer.render(origin, direction, coarser=coarser)
        colour = renderer.joint.exposure.shown(part, index) if as_photo else part.colour
        parts.append(torch.cat([colour, part.depth[:, None], part.opacity[:, None]], 1).cpu())
    whole = torch.cat(parts).reshape(len(rows), len(columns), 5).numpy()
    return RenderedView(whole[..., :3].clip(0, 1), whole[..., 3], whole[..., 4])


def score_views(
    renderer: Renderer, images: ImageSet, views: Iterable[int], stride: int = 1, coarser: float = 1.0
) -> Iterator[ViewScore]:
    """Render each view at its present pose, see `render_view`, and score it where its photo's pixels count."""
    matrices = renderer.joint.poses.matrices().detach()
    for image in views:
        view = render_view(renderer, matrices[image], image, stride=stride, as_photo=True, coarser=coarser)
        photo = torch.from_numpy(images.image(image)[::stride, ::stride].astype(np.float32) / 255)
        colour, mask = torch.from_numpy(view.colour), images.counts_image(image)
        counts = None if mask is None else torch.from_numpy(mask[::stride, ::stride].copy())
        yield ViewScore(image, view, psnr(colour, photo, counts), ssim(colour, photo, counts))


def orbit_poses(unit_from_cam: np.ndarray, frames: int) -> np.ndarray:
    """Cameras [frames, 3, 4] circling the unit frame's centre at the rig's mean height and distance.

    A rig that sees the scene from one side only gets a path that swings over the directions it covers.
    """
    centres = unit_from_cam[:, :3, 3]
    up = -unit_from_cam[:, :3, 1].mean(0)
    up = up / max(float(np.linalg.norm(up)), 1e-9)
    towards = centres.mean(0) - up * (centres.mean(0) @ up)
    if np.linalg.norm(towards) < 0.1 * np.linalg.norm(centres, axis=1).mean():
        towards = centres[0] - up * (centres[0] @ up)  # a full circle has no side of its own
    first = towards / max(float(np.linalg.norm(towards)), 1e-9)
    second = np.cross(up, first)
    azimuth = np.arctan2(centres @ second, centres @ first)
    height = float(np.median(centres @ up))
    radius = float(np.median(np.hypot(centres @ first, centres @ second)))
    reach = float(np.degrees(np.quantile(azimuth, 0.95) - np.quantile(azimuth, 0.05)))
    turn = np.linspace(0, 2 * np.pi, frames, endpoint=False)
    if reach < SWING_BELOW_DEG:
        middle = float(np.median(azimuth))
        turn = middle + np.radians(reach) / 2 * np.sin(turn)
    poses = []
    for angle in turn:
        eye = radius * (np.cos(angle) * first + np.sin(angle) * second) + height * up
        forward = -eye / max(float(np.linalg.norm(eye)), 1e-9)
        right = np.cross(forward, up)
        right = right / max(float(np.linalg.norm(right)), 1e-9)
        poses.append(np.stack([right, np.cross(forward, right), forward, eye], 1))
    return np.stack(poses)


def render_orbit(renderer: Renderer, frames: int, after_frame: Callable[[int], None]) -> Iterator[np.ndarray]:
    """Frames uint8 [h, w, 3] of a video around the scene, with the first image's intrinsics."""
    path = orbit_poses(renderer.joint.unit_from_cam, frames)
    for i, pose in enumerate(path):
        view = render_view(renderer, torch.from_numpy(pose), 0)
        after_frame(i)
        yield np.rint(view.colour * 255).astype(np.uint8)
