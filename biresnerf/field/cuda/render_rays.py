"""Ties the kernels to autograd."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

from biresnerf.field.radiance_field import Rays

if TYPE_CHECKING:
    from biresnerf.field.cuda.field import CudaField


class RenderRays(torch.autograd.Function):
    """Ties the kernels to autograd at the rays, so that poses are optimised like any other torch parameter.

    One of the field's weights is an input so that the backward pass is reached where poses stand still.
    """

    @staticmethod
    def forward(ctx, origin, direction, _weight, field: CudaField, rays: Rays):
        colour, opacity, depth, number = field.run_forward(rays)
        ctx.kept = (field, number, len(origin), rays.trained)
        ctx.mark_non_differentiable(depth)
        return colour, opacity, depth

    @staticmethod
    def backward(ctx, g_colour, g_opacity, _g_depth):
        field, number, count, trained = ctx.kept
        g_origin, g_direction = field.run_backward(number, count, trained, g_colour, g_opacity)
        return g_origin, g_direction, *(None,) * 3
