"""Rays of cameras from viewing directions and their way back, in Numba. `optimise.cast_rays.turned` defines them."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from biresnerf.field.numba_kernels import njit

KERNEL = {"nogil": True, "cache": True, "error_model": "numpy"}


@njit(**KERNEL)
def _cast(matrices, camera, in_cam, origin, direction):
    for r in range(camera.shape[0]):
        m = matrices[camera[r]]
        x, y, z = in_cam[r, 0], in_cam[r, 1], in_cam[r, 2]
        for i in range(3):
            direction[r, i] = m[i, 0] * x + m[i, 1] * y + m[i, 2] * z
            origin[r, i] = m[i, 3]


@njit(**KERNEL)
def _cast_backward(camera, in_cam, g_origin, g_direction, g_matrices):
    """Add the gradients of all rays, in float64, to those of their cameras [n, 3, 4]."""
    for r in range(camera.shape[0]):
        g = g_matrices[camera[r]]
        x, y, z = in_cam[r, 0], in_cam[r, 1], in_cam[r, 2]
        for i in range(3):
            along = g_direction[r, i]
            g[i, 0] += along * x
            g[i, 1] += along * y
            g[i, 2] += along * z
            g[i, 3] += g_origin[r, i]


class CastRays(torch.autograd.Function):
    """`_cast` of float32 CPU tensors, differentiable by the cameras."""

    @staticmethod
    def forward(ctx: Any, matrices: Tensor, camera: Tensor, in_cam: Tensor) -> tuple[Tensor, Tensor]:
        poses = matrices.detach().contiguous().numpy()
        ctx.kept = (poses.shape, camera.contiguous().numpy(), in_cam.contiguous().numpy())
        origin, direction = np.empty((2, len(camera), 3), np.float32)
        _cast(poses, *ctx.kept[1:], origin, direction)
        return torch.from_numpy(origin), torch.from_numpy(direction)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, g_origin: Tensor, g_direction: Tensor) -> tuple[Tensor | None, ...]:
        shape, camera, in_cam = ctx.kept
        found = np.zeros(shape)
        _cast_backward(camera, in_cam, g_origin.contiguous().numpy(), g_direction.contiguous().numpy(), found)
        return torch.from_numpy(found.astype(np.float32)), None, None
