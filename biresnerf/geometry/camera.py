"""Pixels to viewing directions and back, for pinhole cameras with radial and tangential distortion.

Camera axes are OpenCV's (x right, y down, z forward). Pixel coordinates are (x, y); the first pixel's centre
lies at (0.5, 0.5).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from biresnerf.geometry.camera_models import full_parameters

# Newton doubles the digits at each step; lenses that do not fold inside the image need five or six.
NEWTON_STEPS = 20
# In units of the focal length: under 1e-9 px for any real camera.
_NEWTON_DONE = 1e-13


class CameraDescription(Protocol):
    """What `Intrinsics.from_cameras` asks of a camera: COLMAP's model and parameters, size in px."""

    @property
    def model(self) -> str: ...
    @property
    def width(self) -> int: ...
    @property
    def height(self) -> int: ...
    @property
    def params(self) -> tuple[float, ...]: ...


@dataclass(frozen=True, eq=False)
class Intrinsics:
    """Intrinsics of every image.

    Attributes:
        fx, fy, cx, cy: float64 [images], px.
        distortion: float64 [images, 4]: k1, k2, p1, p2 of COLMAP's OPENCV model.
        width, height: int64 [images], px.
        distorted: whether any coefficient differs from zero; if not, undistortion is skipped.
    """

    fx: Tensor
    fy: Tensor
    cx: Tensor
    cy: Tensor
    distortion: Tensor
    width: Tensor
    height: Tensor
    distorted: bool

    @staticmethod
    def from_cameras(cameras: Sequence[CameraDescription]) -> Intrinsics:
        """The intrinsics of images whose cameras are given one by one, at the size they are used at.

        Raises:
            ValueError: a model is not supported or has the wrong number of parameters.
        """
        rows = [full_parameters(camera.model, camera.params) for camera in cameras]
        table = torch.tensor(rows, dtype=torch.float64).reshape(len(rows), 8)
        sizes = torch.tensor([(c.width, c.height) for c in cameras], dtype=torch.int64).reshape(len(rows), 2)
        fx, fy, cx, cy = (column.contiguous() for column in table[:, :4].unbind(1))
        distortion = table[:, 4:].contiguous()
        width, height = (column.contiguous() for column in sizes.unbind(1))
        return Intrinsics(fx, fy, cx, cy, distortion, width, height, bool((distortion != 0).any()))

    def __len__(self) -> int:
        return len(self.fx)

    def to(self, device: torch.device | str) -> Intrinsics:
        """The same on another device; stays in float64."""
        return Intrinsics(
            fx=self.fx.to(device),
            fy=self.fy.to(device),
            cx=self.cx.to(device),
            cy=self.cy.to(device),
            distortion=self.distortion.to(device),
            width=self.width.to(device),
            height=self.height.to(device),
            distorted=self.distorted,
        )


def directions_in_cam(intrinsics: Intrinsics, image_index: Tensor, pixel_xy: Tensor) -> Tensor:
    """Unit viewing directions [rays, 3] of pixel positions, in the type of ``pixel_xy``.

    Distortion is undone by Newton's method in float64, to rounding.

    Args:
        intrinsics: of all images.
        image_index: int64 [rays].
        pixel_xy: [rays, 2], px.

    Raises:
        ValueError: the shapes do not fit.
    """
    _require(image_index, pixel_xy, 2)
    xy = pixel_xy.to(torch.float64)
    x = (xy[:, 0] - intrinsics.cx[image_index]) / intrinsics.fx[image_index]
    y = (xy[:, 1] - intrinsics.cy[image_index]) / intrinsics.fy[image_index]
    if intrinsics.distorted:
        x, y = _undistort(x, y, intrinsics.distortion[image_index])
    directions = torch.stack([x, y, torch.ones_like(x)], dim=-1)
    return (directions / directions.norm(dim=-1, keepdim=True)).to(pixel_xy.dtype)


def project(intrinsics: Intrinsics, image_index: Tensor, points_in_cam: Tensor) -> Tensor:
    """Pixel positions [points, 2] of points in camera coordinates, in their type; NaN unless z > 0.

    Args:
        intrinsics: of all images.
        image_index: int64 [points].
        points_in_cam: [points, 3].

    Raises:
        ValueError: the shapes do not fit.
    """
    _require(image_index, points_in_cam, 3)
    points = points_in_cam.to(torch.float64)
    in_front = points[:, 2] > 0
    depth = torch.where(in_front, points[:, 2], torch.ones_like(points[:, 2]))
    x, y = points[:, 0] / depth, points[:, 1] / depth
    if intrinsics.distorted:
        x, y = _distort(x, y, intrinsics.distortion[image_index])
    pixel_xy = torch.stack(
        [
            x * intrinsics.fx[image_index] + intrinsics.cx[image_index],
            y * intrinsics.fy[image_index] + intrinsics.cy[image_index],
        ],
        dim=-1,
    )
    nowhere = torch.full_like(pixel_xy, float("nan"))
    return torch.where(in_front[:, None], pixel_xy, nowhere).to(points_in_cam.dtype)


def _distort(x: Tensor, y: Tensor, distortion: Tensor) -> tuple[Tensor, Tensor]:
    """COLMAP's OPENCV model on coordinates in units of the focal length."""
    k1, k2, p1, p2 = distortion.unbind(-1)
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * k2)
    return (
        x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
        y * radial + 2 * p2 * x * y + p1 * (r2 + 2 * y * y),
    )


def _undistort(x_distorted: Tensor, y_distorted: Tensor, distortion: Tensor) -> tuple[Tensor, Tensor]:
    """The inverse of `_distort`: Newton's method in two unknowns, started at the distorted position."""
    k1, k2, p1, p2 = distortion.unbind(-1)
    x, y = x_distorted, y_distorted
    for _ in range(NEWTON_STEPS):
        x_now, y_now = _distort(x, y, distortion)
        error_x, error_y = x_now - x_distorted, y_now - y_distorted
        r2 = x * x + y * y
        radial, slope = 1 + r2 * (k1 + r2 * k2), 2 * k1 + 4 * k2 * r2
        xx = radial + slope * x * x + 2 * p1 * y + 6 * p2 * x
        yy = radial + slope * y * y + 2 * p2 * x + 6 * p1 * y
        xy = slope * x * y + 2 * p1 * x + 2 * p2 * y
        determinant = xx * yy - xy * xy
        step_x = (yy * error_x - xy * error_y) / determinant
        step_y = (xx * error_y - xy * error_x) / determinant
        x, y = x - step_x, y - step_y
        if x.numel() == 0 or float(torch.maximum(step_x.abs(), step_y.abs()).max()) < _NEWTON_DONE:
            break
    return x, y


def _require(image_index: Tensor, values: Tensor, columns: int) -> None:
    if values.ndim != 2 or values.shape[1] != columns or image_index.shape != values.shape[:1]:
        raise ValueError(
            f"need one image index for each of [n, {columns}] values, "
            f"got {tuple(image_index.shape)} and {tuple(values.shape)}"
        )
