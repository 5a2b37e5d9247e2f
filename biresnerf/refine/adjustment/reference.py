"""What the kernels compute, in plain torch: residuals as functions that can be differentiated."""

from __future__ import annotations

from torch import Tensor

from biresnerf.geometry.lie import so3_exp


def moved(rotation: Tensor, centre: Tensor, motion: Tensor) -> tuple[Tensor, Tensor]:
    """Cameras (rotation [n, 3, 3] world from cam, centre [n, 3]) after increments [n, 6] in the world's axes."""
    return so3_exp(motion[:, :3]) @ rotation, centre + motion[:, 3:]


def in_pixels(lens: Tensor, in_cam: Tensor) -> Tensor:
    """Pixel positions [..., 2] of points [..., 3] in camera axes; lens [..., 4] is fx, fy, cx, cy."""
    return lens[..., :2] * in_cam[..., :2] / in_cam[..., 2:] + lens[..., 2:]


def track_residuals(
    rotation: Tensor, centre: Tensor, lens: Tensor, xyz: Tensor, point: Tensor, image: Tensor, xy: Tensor
) -> Tensor:
    """Where points [p, 3] appear less where they were observed, px [m, 2]."""
    away = xyz[point] - centre[image]
    in_cam = (rotation[image].transpose(1, 2) @ away[:, :, None])[:, :, 0]
    return in_pixels(lens[image], in_cam) - xy


def robust(square: Tensor, scale: float) -> Tensor:
    """Geman and McClure's cost of squared residuals in noise levels: S^2 e^2 / (S^2 + e^2)."""
    return scale**2 * square / (scale**2 + square)
