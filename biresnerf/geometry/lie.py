"""Exponential of rotations and rigid motions on torch tensors, finite everywhere with gradient.

A rotation vector is axis times angle (rad). Rotation and translation are always two arguments, never packed.
The exponential takes its coefficients and their derivatives from the Stumpff functions, see `_Stumpff`.
"""

from __future__ import annotations

from functools import cache
from math import factorial
from typing import Any

import torch
from torch import Tensor

# Terms of the Stumpff functions' series: below one radian the first one left out is under 1e-17.
_SERIES_TERMS = 9


def hat(vector: Tensor) -> Tensor:
    """The matrix [..., 3, 3] with ``hat(v) @ x == cross(v, x)``, of vectors [..., 3]."""
    _require(vector, "vector")
    flat = vector @ _generators(vector.dtype, vector.device)
    return flat.reshape(*flat.shape[:-1], 3, 3)


def so3_exp(rotvec: Tensor) -> Tensor:
    """Rotation matrices [..., 3, 3] of rotation vectors [..., 3] (rad); value and gradient finite everywhere.

    Raises:
        ValueError: if the last axis is not 3 or the tensor is not of a float type.
    """
    _require(rotvec, "rotvec")
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
    _require(rotvec, "rotvec")
    _require(velocity, "velocity")
    sine_term, cosine_term, cubic_term = _exp_coefficients(rotvec)
    skew = hat(rotvec)
    square = skew @ skew
    identity = _identity_like(skew)
    rotation = identity + sine_term * skew + cosine_term * square
    left_jacobian = identity + cosine_term * skew + cubic_term * square
    return rotation, (left_jacobian @ velocity.unsqueeze(-1)).squeeze(-1)


def moved_poses(rotvec: Tensor, velocity: Tensor, pose: Tensor) -> Tensor:
    """Poses [n, 3, 4] that have followed twists [n, 3] for unit time, see `se3_exp`."""
    turn, shift = se3_exp(rotvec, velocity)
    centre = (turn @ pose[:, :, 3:])[:, :, 0] + shift
    return torch.cat([turn @ pose[:, :, :3], centre[:, :, None]], 2)


def _exp_coefficients(rotvec: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """sin(a)/a, (1 - cos a)/a^2 and (a - sin a)/a^3 of the angles a = |rotvec|, each [..., 1, 1]."""
    found: Tensor = _Stumpff.apply((rotvec * rotvec).sum(-1))  # type: ignore[no-untyped-call]
    sine, cosine, cubic = found[..., None, None, :].unbind(-1)
    return sine, cosine, cubic


class _Stumpff(torch.autograd.Function):
    """The first three Stumpff functions c_k(s) = sum_j (-s)^j / (k + 2j)! of squared angles [...], as [..., 3].

    Below one radian they are the series, above it closed forms. The derivative of c_k is (k c_(k+2) - c_(k+1)) / 2,
    finite everywhere (Danby 1992, Fundamentals of Celestial Mechanics, chapter 6).
    """

    @staticmethod
    def forward(ctx: Any, squared: Tensor) -> Tensor:
        small = squared < 1.0
        powers = torch.where(small, squared, 0.0)[..., None] ** _exponents(squared.device)
        series = powers @ _stumpff_series(squared.dtype, squared.device)
        high = torch.where(small, 1.0, squared)
        angle = high.sqrt()
        c1 = angle.sin() / angle
        c2 = 2.0 * ((0.5 * angle).sin() / angle) ** 2  # no cancellation near whole turns
        c3, c4 = (1.0 - c1) / high, (0.5 - c2) / high
        closed = torch.stack([c1, c2, c3, c4, (1 / 6 - c3) / high], -1)
        values = torch.where(small[..., None], series, closed)
        ctx.save_for_backward(values)
        return values[..., :3].clone()

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> Tensor:
        (values,) = ctx.saved_tensors
        slopes = values @ _stumpff_slopes(values.dtype, values.device)
        found: Tensor = (gradient * slopes).sum(-1)
        return found


# Made once for each device: copying a constant there would make the host wait.
@cache
def _generators(dtype: torch.dtype, device: torch.device) -> Tensor:
    """Row k [9] is hat of the k-th unit vector."""
    rows = torch.zeros(3, 3, 3, dtype=dtype)
    for x, y, z in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        rows[x, z, y], rows[x, y, z] = 1, -1
    return rows.flatten(1).to(device)


@cache
def _exponents(device: torch.device) -> Tensor:
    return torch.arange(_SERIES_TERMS, device=device)


@cache
def _stumpff_series(dtype: torch.dtype, device: torch.device) -> Tensor:
    """The coefficients [terms, 5] of the first five functions."""
    rows = [[(-1.0) ** j / factorial(k + 2 * j) for k in range(1, 6)] for j in range(_SERIES_TERMS)]
    return torch.tensor(rows, dtype=dtype, device=device)


@cache
def _stumpff_slopes(dtype: torch.dtype, device: torch.device) -> Tensor:
    """The derivatives of the first three functions from the first five [5, 3]."""
    slopes = torch.zeros(5, 3, dtype=dtype)
    for k in (1, 2, 3):
        slopes[k + 1, k - 1], slopes[k, k - 1] = k / 2, -1 / 2
    return slopes.to(device)


def _identity_like(matrix: Tensor) -> Tensor:
    return torch.eye(3, dtype=matrix.dtype, device=matrix.device).expand_as(matrix)


def _require(tensor: Tensor, name: str) -> None:
    if tensor.shape[-1:] != (3,):
        raise ValueError(f"{name} must have shape [..., 3], got {tuple(tensor.shape)}")
    if not tensor.is_floating_point():
        raise ValueError(f"{name} must be of a float type, got {tensor.dtype}")
