"""Where patches are taken: textured pixels of opaque, smooth surfaces, and the photos that see the same place."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from biresnerf.arrays import Array
from biresnerf.geometry.camera.camera import Intrinsics
from biresnerf.refinement.adjustment.evidence import Patches, PatchPhotos
from biresnerf.refinement.adjustment.splines import blurred
from biresnerf.refinement.numbers.finish import EvidenceNumbers

# A patch's pixels about its middle one, as in Direct Sparse Odometry (Engel et al. 2018), made symmetric.
PATTERN = np.array([[0, 0], [-2, 0], [2, 0], [0, -2], [0, 2], [-1, -1], [1, 1], [-1, 1]])
WINDOW = 2  # pixels of the depth map to either side that must lie on one plane
GRADIENT_BLUR_PX = 0.7
BORDER = 5  # pixels of a photo that no patch or comparison comes closer to


@dataclass(frozen=True, eq=False)
class Surfaces:
    """What the field shows from each camera, on a grid of pixels that covers the image evenly.

    Attributes:
        depth: of each image [h, w], along the ray of each grid cell's middle, in the poses' unit.
        opacity: likewise, 0 to 1.
        counts: likewise, whether patches may be there and be seen there.
    """

    depth: list[Array]
    opacity: list[Array]
    counts: list[NDArray[np.bool_]]


@dataclass(frozen=True, eq=False)
class _Planes:
    """Planes that best fit the inverse depth around grid cells: value and slopes [3, h, w], and whether each fits."""

    inverse: Array
    usable: NDArray[np.bool_]


def find_patches(
    world_from_cam: Array,
    intrinsics: Intrinsics,
    photos: PatchPhotos,
    surfaces: Surfaces,
    per_photo: int,
    numbers: EvidenceNumbers,
    seed: int = 0,
) -> Patches | None:
    """Patches of all photos, at most so many of each, with the photos to compare them with; None if there are none.

    Args:
        world_from_cam: [n, 4, 4], the poses that the surfaces are seen from.
        intrinsics: at full size, without distortion.
    """
    rng = np.random.default_rng(seed)
    lens = np.stack([intrinsics.fx, intrinsics.fy, intrinsics.cx, intrinsics.cy], 1)
    ratio = np.stack(
        [photos.widths / intrinsics.width.numpy(), photos.heights / intrinsics.height.numpy()], 1
    )
    lens = lens * np.tile(ratio, 2)
    found = []
    for i in range(len(world_from_cam)):
        planes = _planes(surfaces, i, lens[i], photos, numbers)
        at = _chosen_pixels(photos, i, planes, per_photo, numbers.least_gradient, rng)
        found.append((np.full(len(at), i), *_on_planes(at, planes, lens[i], photos, i)))
    host, rays, inverse = (np.concatenate(parts) for parts in zip(*found, strict=True))
    if len(host) == 0:
        return None
    sights = host, rays[:, 0], inverse[:, 0]
    point, target = _targets(world_from_cam, lens, photos, surfaces, *sights, numbers)
    if len(point) == 0:
        return None
    seen = np.bincount(point, minlength=len(host)) > 0
    return Patches(host, rays, inverse, point, target, photos).of(seen)


def _planes(
    surfaces: Surfaces, image: int, lens: Array, photos: PatchPhotos, numbers: EvidenceNumbers
) -> _Planes:
    depth, opacity = surfaces.depth[image], surfaces.opacity[image]
    height, width = depth.shape
    step = np.array([photos.widths[image] / width, photos.heights[image] / height])
    x = ((np.arange(width) + 0.5) * step[0] - lens[2]) / lens[0]
    y = ((np.arange(height) + 0.5) * step[1] - lens[3]) / lens[1]
    inverse = np.sqrt(x[None] ** 2 + y[:, None] ** 2 + 1) / np.maximum(depth, 1e-9)
    good = (opacity > numbers.opaque) & surfaces.counts[image] & np.isfinite(inverse) & (depth > 1e-6)
    span = 2 * WINDOW + 1
    if height < span or width < span:
        return _Planes(np.zeros((3, height, width)), np.zeros((height, width), np.bool_))
    windows = np.lib.stride_tricks.sliding_window_view(inverse, (span, span)).reshape(
        height - span + 1, -1, span**2
    )
    off = np.stack(np.meshgrid(np.arange(span), np.arange(span), indexing="xy"), -1).reshape(-1, 2) - WINDOW
    design = np.c_[np.ones(len(off)), off]
    plane = windows @ np.linalg.pinv(design).T
    off_plane = np.abs(windows - plane @ design.T).max(-1)
    solid = np.lib.stride_tricks.sliding_window_view(good, (span, span)).all((2, 3))
    inner = np.s_[WINDOW : height - WINDOW, WINDOW : width - WINDOW]
    planes, usable = np.zeros((3, height, width)), np.zeros((height, width), np.bool_)
    planes[(slice(None), *inner)] = plane.transpose(2, 0, 1)
    usable[inner] = solid & (off_plane < numbers.flatness * plane[..., 0]) & (plane[..., 0] > 0)
    return _Planes(planes, usable)


def _chosen_pixels(
    photos: PatchPhotos, image: int, planes: _Planes, count: int, least: float, rng: np.random.Generator
) -> NDArray[np.int64]:
    """Columns and rows [k, 2] of textured pixels on usable surface, no two of them neighbours."""
    width, height = int(photos.widths[image]), int(photos.heights[image])
    photo = photos.of(image).mean(-1)
    smooth = blurred(photo[..., None], GRADIENT_BLUR_PX)[..., 0]
    steep = np.hypot(*np.gradient(smooth))
    cell = _cells(
        np.stack(np.meshgrid(np.arange(width), np.arange(height), indexing="xy"), -1),
        photos,
        image,
        planes.usable.shape,
    )
    able = planes.usable[cell[..., 1], cell[..., 0]] & (steep > least)
    able[:BORDER], able[-BORDER:], able[:, :BORDER], able[:, -BORDER:] = False, False, False, False
    rows, columns = np.nonzero(able)
    order = np.argsort(-np.sqrt(steep[rows, columns]) * rng.random(len(rows)))
    taken, chosen = np.zeros((height, width), np.bool_), []
    for k in order.tolist():
        x, y = int(columns[k]), int(rows[k])
        if not taken[y, x]:
            taken[y - 1 : y + 2, x - 1 : x + 2] = True
            chosen.append((x, y))
            if len(chosen) == count:
                break
    return np.array(chosen, dtype=np.int64).reshape(-1, 2)


def _cells(
    pixel: NDArray[np.int64], photos: PatchPhotos, image: int, shape: tuple[int, ...]
) -> NDArray[np.int64]:
    """The cells [..., 2] (column, row) of a grid over the image that pixels [..., 2] lie in."""
    scale = np.array([shape[1] / photos.widths[image], shape[0] / photos.heights[image]])
    cells = ((pixel + 0.5) * scale).astype(np.int64)
    return np.clip(cells, 0, np.array([shape[1] - 1, shape[0] - 1]))


def _on_planes(
    at: NDArray[np.int64], planes: _Planes, lens: Array, photos: PatchPhotos, image: int
) -> tuple[Array, Array]:
    """Rays [k, pattern, 3] and inverse depths [k, pattern] of patches around pixels [k, 2]."""
    shape = planes.usable.shape
    cell = _cells(at, photos, image, shape)
    plane = planes.inverse[:, cell[:, 1], cell[:, 0]]
    pixels = at[:, None] + PATTERN + 0.5
    scale = np.array([shape[1] / photos.widths[image], shape[0] / photos.heights[image]])
    off = pixels * scale - (cell[:, None] + 0.5)
    inverse = plane[0][:, None] + plane[1][:, None] * off[..., 0] + plane[2][:, None] * off[..., 1]
    slopes = (pixels - lens[2:]) / lens[:2]
    return np.concatenate([slopes, np.ones((*slopes.shape[:2], 1))], -1), inverse


def _targets(
    world_from_cam: Array,
    lens: Array,
    photos: PatchPhotos,
    surfaces: Surfaces,
    host: NDArray[np.int64],
    rays: Array,
    inverse: Array,
    numbers: EvidenceNumbers,
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Patch and photo of each comparison [m]: photos that see the place from near enough, unhidden."""
    rotation, centre = world_from_cam[:, :3, :3], world_from_cam[:, :3, 3]
    xyz = np.einsum("pij,pj->pi", rotation[host], rays) / inverse[:, None] + centre[host]
    from_host = xyz - centre[host]
    from_host /= np.linalg.norm(from_host, axis=1, keepdims=True)
    points, targets, widest = [], [], np.cos(np.radians(numbers.widest_deg))
    for j in range(len(world_from_cam)):
        away = xyz - centre[j]
        distance = np.maximum(np.linalg.norm(away, axis=1), 1e-12)
        q = away @ rotation[j]
        front = (host != j) & (q[:, 2] > 1e-3 * distance) & ((from_host * away).sum(1) > widest * distance)
        with np.errstate(divide="ignore", invalid="ignore"):
            xy = q[:, :2] / q[:, 2:] * lens[j, :2] + lens[j, 2:]
        size = np.array([photos.widths[j], photos.heights[j]])
        inside = front & (xy > BORDER).all(1) & (xy < size - BORDER).all(1)
        at = np.flatnonzero(inside)
        cell = _cells(xy[at].astype(np.int64), photos, j, surfaces.depth[j].shape)
        own = np.s_[cell[:, 1], cell[:, 0]]
        agrees = np.abs(surfaces.depth[j][own] - distance[at]) < numbers.agree * distance[at]
        at = at[agrees & (surfaces.opacity[j][own] > numbers.opaque) & surfaces.counts[j][own]]
        points.append(at)
        targets.append(np.full(len(at), j))
    point, target = np.concatenate(points), np.concatenate(targets)
    order = np.argsort(point, kind="stable")
    return point[order], target[order]
