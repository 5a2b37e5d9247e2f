"""What the kernels compute, in plain torch: residuals as functions that can be differentiated."""

from __future__ import annotations

import torch
from torch import Tensor

from biresnerf.geometry.lie import so3_exp


def moved(rotation: Tensor, centre: Tensor, motion: Tensor) -> tuple[Tensor, Tensor]:
    """Cameras (rotation [n, 3, 3] world from cam, centre [n, 3]) after increments [n, 6] in the world's axes."""
    return so3_exp(motion[:, :3]) @ rotation, centre + motion[:, 3:]


def bent(slopes: Tensor, k1: Tensor, k2: Tensor, p1: Tensor, p2: Tensor) -> Tensor:
    """Slopes [..., 2] after distortion."""
    x, y = slopes[..., :1], slopes[..., 1:]
    s = x**2 + y**2
    radial = 1 + s * (k1 + s * k2)
    u = x * radial + 2 * p1 * x * y + p2 * (s + 2 * x**2)
    v = y * radial + p1 * (s + 2 * y**2) + 2 * p2 * x * y
    return torch.cat([u, v], -1)


def in_pixels(lens: Tensor, in_cam: Tensor) -> Tensor:
    """Pixel positions [..., 2] of points [..., 3] in camera axes; lens [..., 8] is fx, fy, cx, cy, k1, k2, p1, p2."""
    slopes = bent(in_cam[..., :2] / in_cam[..., 2:], *lens[..., 4:].split(1, -1))
    return lens[..., :2] * slopes + lens[..., 2:4]


def with_lens(rows: Tensor, correction: Tensor) -> Tensor:
    """Lenses [..., 8] from pinholes [..., 4] and corrections [..., 8], see `lens.lenses`."""
    centre = rows[..., 2:4] + rows[..., :2] * correction[..., 3:5]
    return torch.cat([rows[..., :2] * _longer(correction), centre, correction[..., [1, 2, 5, 6]]], -1)


def _longer(correction: Tensor) -> Tensor:
    return torch.stack([correction[..., 0], correction[..., 0] + correction[..., 7]], -1).exp()


def seen_by(rays: Tensor, correction: Tensor) -> Tensor:
    """Rays [..., 3] (z = 1) of pixels with a correction [8] of the lens, from those without; by fixed point."""
    aim = (rays[..., :2] - correction[3:5]) / _longer(correction)
    found = aim
    for _ in range(100):
        found = found + aim - bent(found, *correction[[1, 2, 5, 6]])
    return torch.cat([found, rays[..., 2:]], -1)


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


def bspline(coefficients: Tensor, xy: Tensor) -> Tensor:
    """Values [m, channels] of a cubic B-spline [h, w, channels] at pixels [m, 2], two inside the border at least."""
    position = xy - 0.5
    corner = position.detach().floor()
    near = torch.arange(-1, 3, dtype=xy.dtype)
    weight = _cubic((position - corner)[:, :, None] - near)
    column, row = (corner[:, axis, None].long() + near.long() for axis in (0, 1))
    around = coefficients[row[:, :, None], column[:, None, :]]
    return torch.einsum("ma,mb,mabc->mc", weight[:, 1], weight[:, 0], around)


def _cubic(x: Tensor) -> Tensor:
    """The cubic B-spline, centred, of distances within 2."""
    a = x.abs()
    return torch.where(a < 1, 2 / 3 - a**2 + a**3 / 2, (2 - a).clamp(min=0) ** 3 / 6)


def patch_residuals(
    rotation: Tensor,
    centre: Tensor,
    lens: Tensor,
    coefficients: Tensor,
    values: Tensor,
    rays: Tensor,
    inverse: Tensor,
) -> Tensor:
    """A patch of the first camera compared with the second's photo: differences of colour [k, channels].

    Args:
        rotation, centre: of host and target, [2, 3, 3] world from cam and [2, 3].
        lens: [6], the target's.
        coefficients: [h, w, channels], of the target's photo.
        values: [k, channels], of the host's.
        rays, inverse: [k, 3] with z = 1, and inverse depths [k] in the host.
    """
    away = rays @ rotation[0].T + inverse[:, None] * (centre[0] - centre[1])
    return bspline(coefficients, in_pixels(lens, away @ rotation[1])) - values
