"""Problems of single photos: blur, a different exposure, a pose that moved far."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from biresnerf.arrays import Array
from biresnerf.data.model.image_distances import nearest_images, pose_distances
from biresnerf.data.photos.images import ImageSet
from biresnerf.refinement.numbers.choosing import VerdictNumbers
from biresnerf.refinement.optimise.photo_sampler import PhotoSampler
from biresnerf.refinement.optimise.renderer import Renderer

NEIGHBOURS = 6  # photos from the nearest places, which show about the same
GAIN_RAYS = 256  # of each photo
MAD_TO_DEVIATION = 1.4826
DARKEST = 0.02  # mean colour below which a photo has no gain


def sharpness(images: ImageSet, world_from_cam: Array) -> Array:
    """Variance of each photo's Laplacian [n] over the median of its neighbours', at working size."""
    variances = np.array([_laplacian_variance(images, i) for i in range(len(images))])
    nearest = nearest_images(pose_distances(world_from_cam), len(images), NEIGHBOURS)
    return variances / np.maximum(np.median(variances[nearest], axis=1), 1e-12)


def _laplacian_variance(images: ImageSet, index: int) -> float:
    """Variance of the Laplacian of the brightness (0 to 1), over pixels whose neighbours count as well."""
    grey = images.image(index).astype(np.float64).mean(2) / 255
    if min(grey.shape) < 3:
        return 0.0
    laplacian = _four_neighbours(grey) - 4 * grey[1:-1, 1:-1]
    counts = images.counts_image(index)
    if counts is not None:
        laplacian = laplacian[(_four_neighbours(counts.astype(np.float64)) == 4) & counts[1:-1, 1:-1]]
    return float(laplacian.var()) if laplacian.size else 0.0


def _four_neighbours(values: Array) -> Array:
    """The sum of the four neighbours of each inner pixel of [h, w]."""
    return values[1:-1, :-2] + values[1:-1, 2:] + values[:-2, 1:-1] + values[2:, 1:-1]


@torch.no_grad()
def gains(renderer: Renderer, sampler: PhotoSampler) -> Array:
    """Brightness of each photo over that of its render [n], from random pixels that show the scene; NaN if none do."""
    count = len(renderer.joint.poses)
    batch = sampler.draw(GAIN_RAYS * count, 0.0, renderer.draws)
    shown, rendered = np.zeros(count), np.zeros(count)
    matrices = renderer.joint.poses.matrices().detach()
    for part in torch.arange(len(batch.image), device=renderer.device).split(GAIN_RAYS * 32):
        image = batch.image[part]
        rendering = renderer.render(*renderer.cast(matrices[image], image, batch.xy[part]))
        seen = (rendering.opacity > 0.5).float() * batch.weight[
            part
        ]  # the background may have any brightness
        for total, colour in ((shown, batch.sharp[part]), (rendered, rendering.colour)):
            values = (colour.mean(1) * seen).double().cpu().numpy()
            np.add.at(total, image.cpu().numpy(), values)
    dark = np.minimum(shown, rendered) < DARKEST * GAIN_RAYS
    return np.where(dark, np.nan, shown / np.maximum(rendered, 1e-12))


def blurred(relative: Array, numbers: VerdictNumbers) -> NDArray[np.bool_]:
    """Which photos [n] are blurred, by their `sharpness`."""
    return relative < numbers.blurred_below


def exposure_off(gain: Array, numbers: VerdictNumbers) -> NDArray[np.bool_]:
    """Which photos [n] are exposed otherwise than the rest, by their `gains`."""
    logs = np.log(gain)
    known = np.isfinite(logs)
    if not known.any():
        return np.zeros(len(gain), dtype=np.bool_)
    apart = np.abs(logs - np.median(logs[known]))
    deviation = MAD_TO_DEVIATION * float(np.median(apart[known]))
    return known & (apart > max(numbers.exposure_off, numbers.exposure_deviations * deviation))


def moved_far(
    turned_deg: Array, shifted: Array, distance: float, numbers: VerdictNumbers
) -> NDArray[np.bool_]:
    """Which cameras [n] moved by far more than most; `distance` is that of the cameras from the scene."""
    turn = turned_deg > max(numbers.moved_deg, numbers.moved_times * float(np.median(turned_deg)))
    shift = shifted > max(numbers.moved_share * distance, numbers.moved_times * float(np.median(shifted)))
    return turn | shift
