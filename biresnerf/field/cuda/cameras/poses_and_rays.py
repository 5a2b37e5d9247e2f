"""Poses of cameras and rays of their pixels on a GPU, each in one launch and one on the way back.

Torch takes some hundred operations for both, which the host launches more slowly than the device runs them.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

BLOCK = 64


def moved_poses(rotation: Tensor, translation: Tensor, body: Tensor, length: Tensor, start: Tensor) -> Tensor:
    """`start` [n, 3, 4] moved by ``exp(rotation, length * translation)`` [bodies, 3] of each one's body [n].

    Differentiable by the increments. `length` is a tensor [1].
    """
    found: Tensor = _MovedPoses.apply(rotation, translation, body, length, start)
    return found


def rays_of_cameras(matrices: Tensor, camera: Tensor, in_cam: Tensor) -> tuple[Tensor, Tensor]:
    """Origin and direction [rays, 3] of rays with directions `in_cam` [rays, 3] in cameras `camera` [rays].

    Differentiable by `matrices` [n, 3, 4], which are unit_from_cam.
    """
    origin, direction = _CastRays.apply(matrices, camera, in_cam)
    return origin, direction


def _launch(kernel: str, count: int, *arguments: Tensor) -> None:
    from biresnerf.field.cuda.cameras import kernels  # where Triton is, and not before it is needed

    if count:
        launch: Callable[..., Any] = getattr(kernels, kernel)[(-(-count // BLOCK),)]
        launch(*arguments, count, BLOCK=BLOCK)


class _MovedPoses(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, rotation: Tensor, translation: Tensor, body: Tensor, length: Tensor, start: Tensor
    ) -> Tensor:
        moved = (rotation.detach(), translation.detach(), start)
        if any(ctx.needs_input_grad):  # a step moves increments in place
            moved = tuple(each.clone() for each in moved)
        turns, shifts, begin = (each.contiguous() for each in moved)
        ctx.kept = (turns, shifts, body, begin, length)
        matrices = torch.empty_like(begin)
        _launch("move", len(start), *ctx.kept, matrices)
        return matrices

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, g_matrices: Tensor) -> tuple[Tensor | None, ...]:
        g_rotation, g_translation = (torch.zeros_like(each) for each in ctx.kept[:2])
        _launch(
            "move_backward", len(g_matrices), *ctx.kept, g_matrices.contiguous(), g_rotation, g_translation
        )
        return g_rotation, g_translation, None, None, None


class _CastRays(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, matrices: Tensor, camera: Tensor, in_cam: Tensor) -> tuple[Tensor, Tensor]:
        ctx.kept, ctx.shape = (camera.contiguous(), in_cam.contiguous()), matrices.shape
        origin, direction = torch.empty_like(ctx.kept[1]), torch.empty_like(ctx.kept[1])
        _launch("cast", len(camera), matrices.detach().contiguous(), *ctx.kept, origin, direction)
        return origin, direction

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, g_origin: Tensor, g_direction: Tensor) -> tuple[Tensor | None, ...]:
        camera, in_cam = ctx.kept
        found = in_cam.new_zeros(ctx.shape)
        gradients = (g_origin.contiguous(), g_direction.contiguous())
        _launch("cast_backward", len(camera), camera, in_cam, *gradients, found)
        return found, None, None
