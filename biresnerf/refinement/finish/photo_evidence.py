"""Patches of a run's photos: decoded larger than the run needed them, on the surface that its field shows."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from biresnerf.data.photos.images import ImageSet, load_images
from biresnerf.geometry.camera.camera import Intrinsics
from biresnerf.options.refine_options import ResolvedOptions
from biresnerf.refinement.adjustment.evidence import Evidence, Patches, PatchPhotos
from biresnerf.refinement.adjustment.ideal import resized, straight_photo
from biresnerf.refinement.adjustment.patch_points import Surfaces, find_patches
from biresnerf.refinement.optimise.renderer import Renderer
from biresnerf.refinement.scene.scene import Scene
from biresnerf.refinement.views.evaluation import render_view

MOST_PIXELS = 6_000_000  # of all photos together: 70 MB for each blur that they are compared at
MOST_RAYS = 200_000  # of all depth maps together; they get every second, third, ... row and column beyond


def photo_patches(
    scene: Scene,
    renderer: Renderer,
    options: ResolvedOptions,
    intrinsics: Intrinsics,
    evidence: Evidence,
    placed: NDArray[np.bool_],
) -> Patches | None:
    """Patches of the photos that are `placed` [n], at the present poses.

    None for fisheyes, and where the field shows no surface to put them on.
    """
    if intrinsics.some_fisheye:
        return None
    images, joint, ideal, numbers = (
        _larger(scene, options),
        renderer.joint,
        evidence.intrinsics,
        evidence.numbers,
    )
    widths, heights = images.widths.astype(np.int64), images.heights.astype(np.int64)
    lenses, straight = resized(intrinsics, widths, heights), resized(ideal, widths, heights)
    gains = joint.exposure.gains()
    photos: list[NDArray[np.float32]] = []
    seen: list[NDArray[np.bool_]] = []
    for i in range(len(images)):
        photo: NDArray[np.float32] = images.image(i).astype(np.float32) / np.float32(255)
        if gains is not None:
            photo = photo / gains[i].astype(np.float32)
        counts = images.counts_image(i)
        shown = (np.ones(photo.shape[:2], np.bool_) if counts is None else counts) & placed[i]
        if lenses.distorted:
            masked = np.concatenate([photo, shown[..., None].astype(np.float32)], 2)
            masked, inside = straight_photo(masked, i, lenses, straight)
            photo, shown = masked[..., :-1], inside & (masked[..., -1] > 0.99)
        photos.append(np.ascontiguousarray(photo))
        seen.append(shown)
    surfaces = _surfaces(renderer, ideal, seen)
    per_photo = int(np.clip(numbers.most_patches // len(photos), *numbers.patches_of_photo))
    stacked = PatchPhotos.stacked(photos)
    return find_patches(joint.unit_from_cam, ideal, stacked, surfaces, per_photo, numbers, options.seed)


def _larger(scene: Scene, options: ResolvedOptions) -> ImageSet:
    """The photos at full size, or as large as all of them together may be."""
    full = [scene.dataset.camera_of(i) for i in range(len(scene.dataset))]
    pixels = sum(camera.width * camera.height for camera in full)
    share = min(1.0, (MOST_PIXELS / pixels) ** 0.5)
    size = int(share * max(max(camera.width, camera.height) for camera in full))
    if size <= int(max(scene.images.widths.max(), scene.images.heights.max())):
        return scene.images
    return load_images(scene.dataset, size, options.background)


def _surfaces(renderer: Renderer, ideal: Intrinsics, seen: list[NDArray[np.bool_]]) -> Surfaces:
    """Depth maps through the ideal cameras; `seen` [h, w] are the pixels that count."""
    working = renderer.joint.lenses.intrinsics
    widths, heights = working.width.cpu().numpy(), working.height.cpu().numpy()
    apart = max(1, int(np.ceil((float((widths * heights).sum()) / MOST_RAYS) ** 0.5)))
    lenses = resized(ideal, np.maximum(widths // apart, 1), np.maximum(heights // apart, 1))
    lenses = lenses.to(renderer.device)
    matrices = renderer.joint.poses.matrices().detach()
    surfaces = Surfaces([], [], [])
    for i, pixels in enumerate(seen):
        view = render_view(renderer, matrices[i], i, lenses)
        surfaces.depth.append(view.depth.astype(np.float64))
        surfaces.opacity.append(view.opacity.astype(np.float64))
        surfaces.counts.append(_cells_seen(pixels, *view.depth.shape))
    return surfaces


def _cells_seen(pixels: NDArray[np.bool_], height: int, width: int) -> NDArray[np.bool_]:
    """Cells [height, width] of a grid over the pixels [h, w] of which all count."""
    rows, columns = (
        (np.arange(n) * cells // n) for n, cells in zip(pixels.shape, (height, width), strict=True)
    )
    hidden = np.zeros((height, width), np.bool_)
    y, x = np.nonzero(~pixels)
    hidden[rows[y], columns[x]] = True
    return ~hidden
