"""Pixels to viewing directions and back, for perspective and fisheye cameras with distortion.

Camera axes are OpenCV's (x right, y down, z forward). Pixel coordinates are (x, y); the first pixel's centre
lies at (0.5, 0.5).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import torch
from torch import Tensor

from biresnerf.geometry.camera.camera_models import Camera
from biresnerf.geometry.camera.distortion import (
    Coefficients,
    coefficients_of,
    distort,
    distort_jacobian,
    solve,
    undistort,
)
from biresnerf.geometry.camera.lens import lens_reach

# Columns of `Intrinsics.distortion`: numerator, denominator, tangential.
ABOVE, BELOW, TANGENTIAL = slice(0, 4), slice(4, 7), slice(7, 11)
# Radians from the axis: closer to it, series replace quotients with a gradient of 0 / 0.
_NEAR_AXIS = 1e-8


@dataclass(frozen=True, eq=False)
class Intrinsics:
    """Intrinsics of every image.

    Attributes:
        fx, fy, cx, cy: float64 [images], px.
        distortion: float64 [images, 11]: coefficients of the radial factor's numerator (4) and denominator (3), and
            p1, p2, sx1, sy1, as in `biresnerf.geometry.camera.distortion`.
        fisheye: bool [images].
        reach: float64 [images]: radius, on the plane of directions, about all that the image shows.
        width, height: int64 [images], px.
        terms: how many coefficients of each of the three groups any image has; no more are computed with.
        some_fisheye: whether any image is a fisheye's.
    """

    fx: Tensor
    fy: Tensor
    cx: Tensor
    cy: Tensor
    distortion: Tensor
    fisheye: Tensor
    reach: Tensor
    width: Tensor
    height: Tensor
    terms: tuple[int, int, int]
    some_fisheye: bool

    @staticmethod
    def from_cameras(cameras: Sequence[Camera]) -> Intrinsics:
        """The intrinsics of images whose cameras are given one by one, at the size they are used at.

        Raises:
            ValueError: a model is not supported or has the wrong number of parameters.
        """
        full = [camera.full() for camera in cameras]
        coefficients = [coefficients_of(f) for f in full]
        count = len(full)
        table = torch.tensor([f[:4] for f in full], dtype=torch.float64).reshape(count, 4)
        rows = [(*c.above, *c.below, *c.tangential) for c in coefficients]
        distortion = torch.tensor(rows, dtype=torch.float64).reshape(count, 11)
        reach = [lens_reach(f, c.width, c.height) for f, c in zip(full, cameras, strict=True)]
        sizes = torch.tensor([(c.width, c.height) for c in cameras], dtype=torch.int64).reshape(count, 2)
        fx, fy, cx, cy = (column.contiguous() for column in table.unbind(1))
        width, height = (column.contiguous() for column in sizes.unbind(1))
        fisheye = torch.tensor([f.fisheye for f in full], dtype=torch.bool)
        reaches = torch.tensor(reach, dtype=torch.float64)
        terms = _terms(distortion)
        return Intrinsics(
            fx, fy, cx, cy, distortion, fisheye, reaches, width, height, terms, bool(fisheye.any())
        )

    def __len__(self) -> int:
        return len(self.fx)

    @property
    def distorted(self) -> bool:
        """Whether any coefficient differs from zero; if not, undistortion is skipped."""
        return any(self.terms)

    def to(self, device: torch.device | str) -> Intrinsics:
        """The same on another device; stays in float64."""
        values = {f.name: getattr(self, f.name) for f in fields(self)}
        moved: dict[str, Any] = {k: v.to(device) for k, v in values.items() if isinstance(v, Tensor)}
        return replace(self, **moved)

    def coefficients(self, image_index: Tensor) -> Coefficients:
        """The coefficients of each of the images [rays], without columns that are zero for the whole set."""
        rows = self.distortion[image_index]
        groups = (rows[:, part].unbind(1) for part in (ABOVE, BELOW, TANGENTIAL))
        return Coefficients(*(group[:count] for group, count in zip(groups, self.terms, strict=True)))


def directions_in_cam(intrinsics: Intrinsics, image_index: Tensor, pixel_xy: Tensor) -> Tensor:
    """Unit viewing directions [rays, 3] of pixel positions, in the type of ``pixel_xy``.

    Distortion is undone by Newton's method in float64, to rounding. A fisheye's rays may point backward.

    Args:
        intrinsics: of all images.
        image_index: int64 [rays].
        pixel_xy: [rays, 2], px.

    Raises:
        ValueError: the shapes do not fit.
    """
    _require(image_index, pixel_xy, 2)
    x, y = _in_focal_lengths(intrinsics, image_index, pixel_xy)
    if intrinsics.distorted:
        x, y = undistort(x, y, intrinsics.coefficients(image_index))
    return _from_plane(intrinsics, image_index, x, y).to(pixel_xy.dtype)


def directions_with_gradient(
    intrinsics: Intrinsics, image_index: Tensor, pixel_xy: Tensor, directions: Tensor
) -> Tensor:
    """`directions_in_cam` as a function of the intrinsics' tensors, which may require gradients.

    By the implicit function theorem, one Newton step from the solution has its derivatives: no earlier step is kept.

    Args:
        directions: what `directions_in_cam` gave, of any precision.
    """
    _require(image_index, pixel_xy, 2)
    c = intrinsics.coefficients(image_index)
    with torch.no_grad():
        x, y = plane_position(intrinsics, image_index, directions.to(torch.float64))
        jacobian = distort_jacobian(x, y, c)
    now_x, now_y = distort(x, y, c)
    to_x, to_y = _in_focal_lengths(intrinsics, image_index, pixel_xy)
    step_x, step_y = solve(jacobian, now_x - to_x, now_y - to_y)
    return _from_plane(intrinsics, image_index, x - step_x, y - step_y).to(pixel_xy.dtype)


def project(intrinsics: Intrinsics, image_index: Tensor, points_in_cam: Tensor) -> Tensor:
    """Pixel positions [points, 2] of points in camera coordinates, in their type.

    NaN where there is none: behind a perspective camera (unless z > 0), straight behind a fisheye.

    Args:
        intrinsics: of all images.
        image_index: int64 [points].
        points_in_cam: [points, 3].

    Raises:
        ValueError: the shapes do not fit.
    """
    _require(image_index, points_in_cam, 3)
    x, y = plane_position(intrinsics, image_index, points_in_cam.to(torch.float64))
    return _on_image(intrinsics, image_index, x, y).to(points_in_cam.dtype)


def in_view(intrinsics: Intrinsics, image_index: Tensor, points_in_cam: Tensor) -> Tensor:
    """Which points [points, 3] of camera coordinates the images show, bool [points].

    Points farther out than anything the image shows are not in view, wherever the lens formula may fold them.
    """
    _require(image_index, points_in_cam, 3)
    x, y = plane_position(intrinsics, image_index, points_in_cam.to(torch.float64))
    pixel_xy = _on_image(intrinsics, image_index, x, y)
    size = torch.stack([intrinsics.width[image_index], intrinsics.height[image_index]], 1)
    inside = ((pixel_xy > 0) & (pixel_xy < size)).all(1)
    return inside & (x * x + y * y <= intrinsics.reach[image_index] ** 2)


def _in_focal_lengths(i: Intrinsics, image_index: Tensor, pixel_xy: Tensor) -> tuple[Tensor, Tensor]:
    xy = pixel_xy.to(torch.float64)
    return (
        (xy[:, 0] - i.cx[image_index]) / i.fx[image_index],
        (xy[:, 1] - i.cy[image_index]) / i.fy[image_index],
    )


def _on_image(i: Intrinsics, image_index: Tensor, x: Tensor, y: Tensor) -> Tensor:
    """Pixel positions [points, 2] of positions on the plane of directions."""
    if i.distorted:
        x, y = distort(x, y, i.coefficients(image_index))
    x, y = x * i.fx[image_index] + i.cx[image_index], y * i.fy[image_index] + i.cy[image_index]
    return torch.stack([x, y], dim=-1)


def _from_plane(i: Intrinsics, image_index: Tensor, x: Tensor, y: Tensor) -> Tensor:
    """Unit directions [rays, 3] of positions on the plane of directions."""
    slopes = torch.stack([x, y, torch.ones_like(x)], dim=-1)
    perspective: Tensor = slopes / slopes.norm(dim=-1, keepdim=True)
    if not i.some_fisheye:
        return perspective
    s = x * x + y * y
    off_axis = s > _NEAR_AXIS**2
    angle = torch.where(off_axis, s, torch.ones_like(s)).sqrt()
    across = torch.where(off_axis, angle.sin() / angle, 1 - s / 6)
    along = torch.where(off_axis, angle.cos(), 1 - s / 2)
    fisheye = torch.stack([x * across, y * across, along], dim=-1)
    return torch.where(i.fisheye[image_index][:, None], fisheye, perspective)


def plane_position(i: Intrinsics, image_index: Tensor, points: Tensor) -> tuple[Tensor, Tensor]:
    """Positions [m], [m] on the plane of directions of points [m, 3] in the camera; NaN where there is none."""
    x, y, z = points.unbind(1)
    one, nowhere = torch.ones_like(z), torch.full_like(z, float("nan"))
    scale = torch.where(z > 0, 1 / torch.where(z > 0, z, one), nowhere)
    if i.some_fisheye:
        s = x * x + y * y
        off_axis = s > (_NEAR_AXIS * z) ** 2
        r = torch.where(off_axis, s, one).sqrt()
        angle = torch.where(off_axis, torch.atan2(r, z) / r, scale)
        scale = torch.where(i.fisheye[image_index], angle, scale)
    return x * scale, y * scale


def _terms(distortion: Tensor) -> tuple[int, int, int]:
    """How many leading columns of each group hold anything but zeros; of the last, pairs go together."""
    used = (distortion != 0).any(0)
    above, below = (
        int((used[part].nonzero().max() + 1) if used[part].any() else 0) for part in (ABOVE, BELOW)
    )
    prism, tangential = bool(used[9:].any()), bool(used[TANGENTIAL].any())
    return above, below, 4 if prism else 2 if tangential else 0


def _require(image_index: Tensor, values: Tensor, columns: int) -> None:
    if values.ndim != 2 or values.shape[1] != columns or image_index.shape != values.shape[:1]:
        raise ValueError(
            f"need one image index for each of [n, {columns}] values, "
            f"got {tuple(image_index.shape)} and {tuple(values.shape)}"
        )
