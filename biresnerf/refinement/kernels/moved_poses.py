"""Rigid motions of many cameras and their way back, in Numba. The definition is `PoseParameters.defined_matrices`.

For a few hundred cameras torch spends its time on calling some forty operations, and as many on the way back.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from biresnerf.field.numba_kernels import njit

KERNEL = {"nogil": True, "cache": True, "error_model": "numpy"}
SERIES_BELOW, TERMS = 1.0, 9  # squared angle (rad^2); as `biresnerf.geometry.lie`


@njit(**KERNEL)
def _stumpff(squared, c):
    """Fill c [5] with the first five Stumpff functions c_1 ... c_5 of a squared angle, see `biresnerf.geometry.lie`."""
    if squared < SERIES_BELOW:
        for k in range(5):
            term = 1.0
            for j in range(2, k + 2):
                term /= j
            total = term
            for j in range(1, TERMS):
                term *= -squared / ((k + 2 * j) * (k + 2 * j + 1))
                total += term
            c[k] = total
        return
    angle = np.sqrt(squared)
    c[0] = np.sin(angle) / angle
    c[1] = 2.0 * (np.sin(0.5 * angle) / angle) ** 2
    c[2] = (1.0 - c[0]) / squared
    c[3] = (0.5 - c[1]) / squared
    c[4] = (1.0 / 6.0 - c[2]) / squared


@njit(**KERNEL)
def _motion(w, v, c, turn, shift):
    """Rotation [3, 3] and translation [3] of the twist (w, v); fills c [5]."""
    squared = w[0] * w[0] + w[1] * w[1] + w[2] * w[2]
    _stumpff(squared, c)
    along = w[0] * v[0] + w[1] * v[1] + w[2] * v[2]
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        # hat(w)^2 = w w^T - |w|^2; the translation is v + c2 w x v + c3 (w (w . v) - |w|^2 v).
        turn[i, i] = 1.0 + c[1] * (w[i] * w[i] - squared)
        turn[i, j] = c[1] * w[i] * w[j] - c[0] * w[k]
        turn[i, k] = c[1] * w[i] * w[k] + c[0] * w[j]
        cross = w[j] * v[k] - w[k] * v[j]
        shift[i] = v[i] + c[1] * cross + c[2] * (w[i] * along - squared * v[i])


@njit(**KERNEL)
def _motion_backward(w, v, c, g_turn, g_shift, g_w, g_v):
    """Add the gradients to w and v [3] from those to the rotation [3, 3] and the translation [3]."""
    squared = w[0] * w[0] + w[1] * w[1] + w[2] * w[2]
    along = w[0] * v[0] + w[1] * v[1] + w[2] * v[2]
    g_c1 = g_c2 = g_c3 = g_squared = g_along = 0.0
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        skew = g_turn[k, j] - g_turn[j, k]
        cross = w[j] * v[k] - w[k] * v[j]
        g_c1 += w[i] * skew
        g_c2 += (w[i] * w[i] - squared) * g_turn[i, i] + g_shift[i] * cross
        g_c2 += w[i] * (w[j] * g_turn[i, j] + w[k] * g_turn[i, k])
        g_c3 += g_shift[i] * (w[i] * along - squared * v[i])
        g_squared -= c[1] * g_turn[i, i] + c[2] * g_shift[i] * v[i]
        g_along += c[2] * g_shift[i] * w[i]
    # The derivative of c_k by the squared angle is (k c_(k+2) - c_(k+1)) / 2.
    g_squared += 0.5 * (g_c1 * (c[2] - c[1]) + g_c2 * (2.0 * c[3] - c[2]) + g_c3 * (3.0 * c[4] - c[3]))
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        symmetric = 2.0 * w[i] * g_turn[i, i]
        symmetric += w[j] * (g_turn[i, j] + g_turn[j, i]) + w[k] * (g_turn[i, k] + g_turn[k, i])
        g_w[i] += c[0] * (g_turn[k, j] - g_turn[j, k]) + c[1] * symmetric
        g_w[i] += c[1] * (v[j] * g_shift[k] - v[k] * g_shift[j])
        g_w[i] += c[2] * along * g_shift[i] + 2.0 * w[i] * g_squared + v[i] * g_along
        g_v[i] += (1.0 - c[2] * squared) * g_shift[i] + w[i] * g_along
        g_v[i] += c[1] * (w[k] * g_shift[j] - w[j] * g_shift[k])


@njit(**KERNEL)
def moved(rotation, translation, body, length, start, matrices):
    """Fill matrices [n, 3, 4] with start [n, 3, 4] moved by the increments [bodies, 3] of each camera's body [n]."""
    w, v, c = np.empty(3), np.empty(3), np.empty(5)
    turn, shift = np.empty((3, 3)), np.empty(3)
    for camera in range(start.shape[0]):
        row = body[camera]
        for i in range(3):
            w[i], v[i] = rotation[row, i], translation[row, i] * length
        _motion(w, v, c, turn, shift)
        s = start[camera]
        for i in range(3):
            for j in range(4):
                value = turn[i, 0] * s[0, j] + turn[i, 1] * s[1, j] + turn[i, 2] * s[2, j]
                matrices[camera, i, j] = value + shift[i] if j == 3 else value


@njit(**KERNEL)
def moved_backward(rotation, translation, body, length, start, g_matrices, g_rotation, g_translation):
    """Add the gradients to the increments [bodies, 3] from those to `moved`'s matrices [n, 3, 4]."""
    w, v, c = np.empty(3), np.empty(3), np.empty(5)
    turn, shift, g_w, g_v = np.empty((3, 3)), np.empty(3), np.empty(3), np.empty(3)
    g_turn, g_shift = np.empty((3, 3)), np.empty(3)
    for camera in range(start.shape[0]):
        row, s, g = body[camera], start[camera], g_matrices[camera]
        for i in range(3):
            w[i], v[i] = rotation[row, i], translation[row, i] * length
            g_w[i] = g_v[i] = 0.0
            g_shift[i] = g[i, 3]
            for j in range(3):
                g_turn[i, j] = g[i, 0] * s[j, 0] + g[i, 1] * s[j, 1] + g[i, 2] * s[j, 2] + g[i, 3] * s[j, 3]
        _motion(w, v, c, turn, shift)
        _motion_backward(w, v, c, g_turn, g_shift, g_w, g_v)
        for i in range(3):
            g_rotation[row, i] += g_w[i]
            g_translation[row, i] += g_v[i] * length


class MovedPoses(torch.autograd.Function):
    """`moved` of float32 CPU tensors, differentiable by the increments."""

    @staticmethod
    def forward(
        ctx: Any, rotation: Tensor, translation: Tensor, body: Tensor, length: float, start: Tensor
    ) -> Tensor:
        tensors = (rotation.detach(), translation.detach(), body, start)
        if any(ctx.needs_input_grad):  # a step moves increments in place
            tensors = tuple(tensor.clone() for tensor in tensors)
        w, v, bodies, begin = (tensor.contiguous().numpy() for tensor in tensors)
        ctx.kept = (w, v, bodies, length, begin)
        matrices = np.empty(begin.shape, np.float32)
        moved(*ctx.kept, matrices)
        return torch.from_numpy(matrices)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        rotation, translation = (np.zeros_like(ctx.kept[k]) for k in range(2))
        moved_backward(*ctx.kept, gradient.contiguous().numpy(), rotation, translation)
        return torch.from_numpy(rotation), torch.from_numpy(translation), None, None, None
