"""Photos and tracks as ideal cameras would have them: straightened once, before anything is adjusted."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from biresnerf.data.points.tracks import Tracks
from biresnerf.geometry.camera.camera import Intrinsics, directions_in_cam, project

NODES = (
    2  # px; in between a lens bends so little that positions are right to 0.002 px, in photos of 300 px too
)


def ideal_cameras(intrinsics: Intrinsics) -> Intrinsics:
    """The same cameras without distortion; fisheyes, which no pinhole can stand for, as they are."""
    if not intrinsics.some_fisheye:
        return replace(intrinsics, distortion=torch.zeros_like(intrinsics.distortion), terms=(0, 0, 0))
    return replace(intrinsics, distortion=intrinsics.distortion * intrinsics.fisheye[:, None])


def resized(intrinsics: Intrinsics, widths: NDArray[np.int64], heights: NDArray[np.int64]) -> Intrinsics:
    """The intrinsics of the same pictures resampled to other sizes (px) [n]."""
    width, height = torch.from_numpy(widths.astype(np.int64)), torch.from_numpy(heights.astype(np.int64))
    x, y = width / intrinsics.width, height / intrinsics.height
    i = intrinsics
    return replace(i, fx=i.fx * x, cx=i.cx * x, fy=i.fy * y, cy=i.cy * y, width=width, height=height)


def straight_tracks(tracks: Tracks, intrinsics: Intrinsics, ideal: Intrinsics) -> Tracks:
    """The tracks where the ideal cameras would have observed them."""
    image = torch.from_numpy(tracks.image)
    rays = directions_in_cam(intrinsics, image, torch.from_numpy(np.ascontiguousarray(tracks.xy)))
    return replace(tracks, xy=project(ideal, image, rays).numpy())


def straight_photo(
    photo: NDArray[np.float32], image: int, intrinsics: Intrinsics, ideal: Intrinsics
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """A photo [h, w, c] as the ideal camera would have taken it, and which of its pixels [h, w] it shows at all.

    Bilinear. Both intrinsics are for the photo's size.
    """
    height, width = photo.shape[:2]
    last = torch.tensor([width - 1, height - 1], dtype=torch.float64)
    source = _seen_at(height, width, image, intrinsics, ideal)
    seen = ((source >= 0) & (source <= last)).all(2)  # no NaN is
    at = torch.where(seen[..., None], source / last.clamp(min=1) * 2 - 1, -1.0).float()
    picture = torch.from_numpy(photo).permute(2, 0, 1)
    straight = functional.grid_sample(picture[None], at[None], padding_mode="border", align_corners=True)[0]
    return straight.permute(1, 2, 0).numpy(), seen.numpy()


def _seen_at(height: int, width: int, image: int, intrinsics: Intrinsics, ideal: Intrinsics) -> Tensor:
    """Pixel indices [h, w, 2] in the photo of what the ideal camera has at each pixel: exact at every `NODES`th."""
    rows, columns = (torch.arange(-(-(size - 1) // NODES) + 1) * NODES for size in (height, width))
    y, x = torch.meshgrid(rows + 0.5, columns + 0.5, indexing="ij")
    index = torch.full((x.numel(),), image)
    xy = torch.stack([x, y], -1).reshape(-1, 2).double()
    nodes = (project(intrinsics, index, directions_in_cam(ideal, index, xy)) - 0.5).reshape(*x.shape, 2)
    size = (int(rows[-1]) + 1, int(columns[-1]) + 1)
    between = functional.interpolate(nodes.permute(2, 0, 1)[None], size, mode="bilinear", align_corners=True)
    return between[0].permute(1, 2, 0)[:height, :width]
