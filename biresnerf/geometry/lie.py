"""Exponential and logarithm of rotations and rigid motions on torch tensors, finite everywhere with gradient.

A rotation vector is axis times angle (rad). Rotation and translation are always two arguments, never packed.
Closed forms are used for angles above one radian and Taylor series below; the argument of the form not taken
is guarded too, since ``where`` passes NaN gradients of the branch it discards.
"""

from __future__ import annotations

from math import factorial

import torch
from torch import Tensor

# Terms of the series in the squared angle: below one radian the first one left out is under 1e-17.
_SERIES_TERMS = 9
# Squared tangent of the half angle below which the logarithm takes its series (8 terms: under 1e-16).
_LOG_SERIES_BELOW = 1e-2
_LOG_SERIES_TERMS = 8


def hat(vector: Tensor) -> Tensor:
    """The matrix [..., 3, 3] with ``hat(v) @ x == cross(v, x)``, of vectors [..., 3]."""
    _require(vector, (3,), "vector")
    x, y, z = vector.unbind(-1)
    zero = torch.zeros_like(x)
    flat = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=-1)
    return flat.reshape(*flat.shape[:-1], 3, 3)


def so3_exp(rotvec: Tensor) -> Tensor:
    """Rotation matrices [..., 3, 3] of rotation vectors [..., 3] (rad); value and gradient finite everywhere.

    Raises:
        ValueError: if the last axis is not 3 or the tensor is not of a float type.
    """
    _require(rotvec, (3,), "rotvec")
    sine_term, cosine_term, _ = _exp_coefficients(rotvec)
    skew = hat(rotvec)
    return _identity_like(skew) + sine_term * skew + cosine_term * (skew @ skew)


def se3_exp(rotvec: Tensor, velocity: Tensor) -> tuple[Tensor, Tensor]:
    """Rigid motion reached by following a twist for unit time.

    Args:
        rotvec: [..., 3], angular part of the twist (rad).
        velocity: [..., 3], linear part of the twist (world units); equals the translation where ``rotvec`` is
            zero.

    Returns:
        rotation [..., 3, 3] and translation [..., 3], so that ``x -> rotation @ x + translation``.

    Raises:
        ValueError: if a last axis is not 3 or a tensor is not of a float type.
    """
    _require(rotvec, (3,), "rotvec")
    _require(velocity, (3,), "velocity")
    sine_term, cosine_term, cubic_term = _exp_coefficients(rotvec)
    skew = hat(rotvec)
    square = skew @ skew
    identity = _identity_like(skew)
    rotation = identity + sine_term * skew + cosine_term * square
    left_jacobian = identity + cosine_term * skew + cubic_term * square
    return rotation, (left_jacobian @ velocity.unsqueeze(-1)).squeeze(-1)


def so3_log(rotation: Tensor) -> Tensor:
    """Rotation vectors [..., 3] of angle at most pi, of rotation matrices [..., 3, 3].

    Goes through the unit quaternion, read from the row of the matrix ``4 q q^T`` that is largest for the
    rotation at hand: linear in the matrix, no square root of a difference, and so exact near pi as well as
    near zero.

    Raises:
        ValueError: if the last axes are not 3 x 3 or the tensor is not of a float type.
    """
    _require(rotation, (3, 3), "rotation")
    real, vector = _unit_quaternion(rotation)
    norm_squared = (vector * vector).sum(-1, keepdim=True)
    small = norm_squared < _LOG_SERIES_BELOW * real * real

    # Small: 2 atan(n / w) / n as a series in (n / w)^2.
    real_small = torch.where(small, real, torch.ones_like(real))
    ratio = torch.where(small, norm_squared, torch.zeros_like(norm_squared)) / (real_small * real_small)
    series = _horner(ratio, [(-1.0) ** k / (2 * k + 1) for k in range(_LOG_SERIES_TERMS)]) * 2.0 / real_small
    # Large: the closed form; a real part of zero (angle pi) is an ordinary point of it.
    norm = torch.where(small, torch.ones_like(norm_squared), norm_squared).sqrt()
    closed = 2.0 * torch.atan2(norm, real) / norm
    return torch.where(small, series, closed) * vector


def _unit_quaternion(rotation: Tensor) -> tuple[Tensor, Tensor]:
    """Real part [..., 1] (never negative) and vector part [..., 3] of the unit quaternion of a rotation."""
    r00, r01, r02, r10, r11, r12, r20, r21, r22 = rotation.flatten(-2).unbind(-1)
    wx, wy, wz = r21 - r12, r02 - r20, r10 - r01
    xy, xz, yz = r10 + r01, r02 + r20, r21 + r12
    one = torch.ones_like(r00)
    rows = [
        [one + r00 + r11 + r22, wx, wy, wz],
        [wx, one + r00 - r11 - r22, xy, xz],
        [wy, xy, one - r00 + r11 - r22, yz],
        [wz, xz, yz, one - r00 - r11 + r22],
    ]
    outer = torch.stack([torch.stack(row, dim=-1) for row in rows], dim=-2)
    largest = outer.diagonal(dim1=-2, dim2=-1).argmax(-1)
    index = largest[..., None, None].expand(*largest.shape, 1, 4)
    quat_wxyz = outer.gather(-2, index).squeeze(-2)
    # The chosen row is 4 q_k q with |q_k| >= 1/2: its norm is at least 2 for a rotation.
    quat_wxyz = quat_wxyz / quat_wxyz.norm(dim=-1, keepdim=True)
    quat_wxyz = torch.where(quat_wxyz[..., :1] < 0, -quat_wxyz, quat_wxyz)
    return quat_wxyz[..., :1], quat_wxyz[..., 1:]


def _exp_coefficients(rotvec: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """sin(a)/a, (1 - cos a)/a^2 and (a - sin a)/a^3 of the angles a = |rotvec|, each [..., 1, 1]."""
    angle_squared = (rotvec * rotvec).sum(-1)[..., None, None]
    small = angle_squared < 1.0
    low = torch.where(small, angle_squared, torch.zeros_like(angle_squared))
    high = torch.where(small, torch.ones_like(angle_squared), angle_squared)
    angle = high.sqrt()
    sine_closed = angle.sin() / angle
    # Half-angle form: no cancellation near whole turns.
    cosine_closed = 2.0 * ((0.5 * angle).sin() / angle) ** 2
    cubic_closed = (1.0 - sine_closed) / high
    closed = (sine_closed, cosine_closed, cubic_closed)
    series = [
        _horner(low, [(-1.0) ** k / factorial(2 * k + first) for k in range(_SERIES_TERMS)])
        for first in (1, 2, 3)
    ]
    sine, cosine, cubic = (torch.where(small, s, c) for s, c in zip(series, closed, strict=True))
    return sine, cosine, cubic


def _horner(x: Tensor, coefficients: list[float]) -> Tensor:
    value = torch.full_like(x, coefficients[-1])
    for coefficient in reversed(coefficients[:-1]):
        value = value * x + coefficient
    return value


def _identity_like(matrix: Tensor) -> Tensor:
    return torch.eye(3, dtype=matrix.dtype, device=matrix.device).expand_as(matrix)


def _require(tensor: Tensor, tail: tuple[int, ...], name: str) -> None:
    if tuple(tensor.shape[-len(tail) :]) != tail:
        raise ValueError(
            f"{name} must have shape [..., {', '.join(map(str, tail))}], got {tuple(tensor.shape)}"
        )
    if not tensor.is_floating_point():
        raise ValueError(f"{name} must be of a float type, got {tensor.dtype}")
