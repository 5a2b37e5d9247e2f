"""Photos and tracks as ideal cameras would have them: straightened once, before anything is adjusted."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray

from biresnerf.data.photos.bilinear import bilinear
from biresnerf.data.points.tracks import Tracks
from biresnerf.geometry.camera.camera import Intrinsics, directions_in_cam, project


def ideal_cameras(intrinsics: Intrinsics) -> Intrinsics:
    """The same cameras without distortion; fisheyes, which no pinhole can stand for, as they are."""
    if not intrinsics.some_fisheye:
        return replace(intrinsics, distortion=torch.zeros_like(intrinsics.distortion), terms=(0, 0, 0))
    return replace(intrinsics, distortion=intrinsics.distortion * intrinsics.fisheye[:, None])


def resized(intrinsics: Intrinsics, widths: NDArray[np.int64], heights: NDArray[np.int64]) -> Intrinsics:
    """Of the same pictures resampled to other sizes (px) [n]."""
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
    y, x = np.meshgrid(np.arange(height) + 0.5, np.arange(width) + 0.5, indexing="ij")
    xy = torch.from_numpy(np.stack([x, y], -1).reshape(-1, 2))
    index = torch.full((len(xy),), image)
    source = project(intrinsics, index, directions_in_cam(ideal, index, xy)).numpy() - 0.5
    limit = np.array([width - 1, height - 1])
    seen = np.isfinite(source).all(1) & (source >= 0).all(1) & (source <= limit).all(1)
    straight = bilinear(photo, np.nan_to_num(source))
    return straight.reshape(photo.shape), seen.reshape(height, width)
