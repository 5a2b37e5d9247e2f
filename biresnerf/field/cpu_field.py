"""The radiance field on the Numba kernels. Works on CPU tensors in place, sharing their memory with NumPy."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from biresnerf.field.cpu import encoding, network
from biresnerf.field.cpu import rays as ray_kernels
from biresnerf.field.grid_levels import GridLevels
from biresnerf.field.radiance_field import (
    BETA1,
    BETA2,
    EPSILON,
    HIDDEN,
    FieldShape,
    Marching,
    PositionGradient,
    RadianceField,
    Rays,
    Rendering,
)
from biresnerf.field.spherical_harmonics import VIEW_FEATURES, spherical_harmonics

f4 = np.float32


class Buffers:
    """Arrays that live from step to step and grow by 1.3, so that a step allocates nothing large."""

    def __init__(self) -> None:
        self._held: dict[str, np.ndarray] = {}

    def take(self, name: str, *shape: int, dtype: Any = f4) -> np.ndarray:
        """An uninitialised array of this shape; valid until the same name is taken again."""
        size = int(np.prod(shape))
        held = self._held.get(name)
        if held is None or held.size < size or held.dtype != dtype:
            held = self._held[name] = np.empty(int(size * 1.3) + 1024, dtype)
        return held[:size].reshape(shape)


@dataclass(frozen=True)
class Samples:
    """What the forward pass leaves for the backward pass; arrays are views of `Buffers`."""

    offset: np.ndarray
    x: np.ndarray
    t: np.ndarray
    dt: np.ndarray
    ray: np.ndarray
    features: np.ndarray
    jacobians: list[np.ndarray]
    density: np.ndarray
    colour: np.ndarray


class CpuField(RadianceField):
    """Backend `cpu`."""

    backend = "cpu"

    def __init__(self, shape: FieldShape, seed: int, device: torch.device, workers: int) -> None:
        super().__init__(shape, seed, device)
        self.workers = workers
        self._buffers = Buffers()
        largest = max(int(np.diff(g.offset).max()) for g in (shape.pose_grid, shape.reconstruction_grid))
        self._scratch = np.zeros((workers, 2 * largest), f4)
        self._pending: tuple[Samples, np.ndarray, int] | None = None

    def _grids(self) -> list[tuple[GridLevels, np.ndarray]]:
        grids = [(self.shape.pose_grid, self.pose_table.numpy())]
        if self.reconstructing:
            grids.append((self.shape.reconstruction_grid, self.reconstruction_table.numpy()))
        return grids

    def _width(self) -> int:
        return -4 * (-sum(grid.width for grid, _ in self._grids()) // 4)  # whole register tiles

    def _weights(self) -> list[np.ndarray]:
        """The five layers as contiguous arrays; input columns and colour rows padded to multiples of 4."""
        first = np.zeros((HIDDEN, self._width()), f4)
        low = self.shape.pose_grid.width
        first[:, :low] = self.networks[0].detach().numpy()
        if self.reconstructing:
            high = self.shape.reconstruction_grid.width
            first[:, low : low + high] = self.reconstruction_columns.detach().numpy()
        last = np.zeros((4, HIDDEN), f4)
        last[:3] = self.networks[4].detach().numpy()
        return [first, *(w.detach().numpy() for w in self.networks[1:4]), last]

    def _encode(
        self, x: np.ndarray, gradient: PositionGradient, role: str
    ) -> tuple[np.ndarray, list[np.ndarray]]:
        n, width = len(x) // 3, self._width()
        features = self._buffers.take(f"{role} features", width, n)
        jacobians, row = [], 0
        smoothings = (gradient.pose_smoothing, gradient.reconstruction_smoothing)
        for i, (grid, table) in enumerate(self._grids()):
            jacobian = self._buffers.take(f"{role} jacobian {i}", grid.levels, 6, n)
            encoding.encode(
                x, table.reshape(-1).view(np.uint64), grid.scale, grid.stride, grid.hashed, grid.offset,
                f4(smoothings[i]), features[row : row + grid.width], jacobian,
            )  # fmt: skip
            jacobians.append(jacobian)
            row += grid.width
        features[row:] = 0
        return features, jacobians

    def render(self, rays: Rays, marching: Marching, gradient: PositionGradient) -> Rendering:
        harmonics = spherical_harmonics(rays.direction)
        colour, opacity, depth, count = _RenderRays.apply(
            rays.origin, rays.direction, harmonics, self, rays, marching, gradient
        )
        return Rendering(colour, opacity, depth, int(count))

    def density(self, position: Tensor) -> Tensor:
        x = position.contiguous().numpy().reshape(-1)
        features, _ = self._encode(x, PositionGradient(), "density")
        result = np.empty(len(position), f4)
        w1, w2 = (w.reshape(-1) for w in self._weights()[:2])
        network.network_density(features.reshape(-1), features.shape[0], w1, w2, result, self.workers)
        return torch.from_numpy(result)

    def sample(self, origin: np.ndarray, direction: np.ndarray, view: np.ndarray, jitter: np.ndarray,
               marching: Marching, gradient: PositionGradient) -> Samples:  # fmt: skip
        """March the rays and evaluate the field at every live sample."""
        rays, take = len(origin), self._buffers.take
        t_buffer = take("march t", rays, marching.most)
        dt_buffer = take("march dt", rays, marching.most)
        count = take("count", rays, dtype=np.int32)
        occupied = marching.occupied.numpy().reshape(-1)
        ray_kernels.march(
            origin, direction, jitter, occupied, marching.occupied.shape[0], f4(marching.step),
            f4(marching.near), f4(marching.far), self.shape.unbounded, t_buffer, dt_buffer, count,
        )  # fmt: skip
        offset = np.zeros(rays + 1, np.int64)
        np.cumsum(count, out=offset[1:])
        n = int(offset[-1])
        x, t, dt = take("x", 3 * n), take("t", n), take("dt", n)
        ray = take("ray", n, dtype=np.int32)
        ray_kernels.pack(
            origin, direction, t_buffer, dt_buffer, count, offset, self.shape.unbounded, x, t, dt, ray
        )
        features, jacobians = self._encode(x, gradient, "render")
        density, colour = take("density", n), take("colour", 3 * n)
        weights = [w.reshape(-1) for w in self._weights()]
        network.network_forward(
            features.reshape(-1),
            features.shape[0],
            view.reshape(-1),
            ray,
            *weights,
            density,
            colour,
            self.workers,
        )
        return Samples(offset, x, t, dt, ray, features, jacobians, density, colour)

    def backward_samples(self, samples: Samples, view: np.ndarray, trained_rays: int,
                         g_density: np.ndarray, g_colour: np.ndarray, gradient: PositionGradient,
                         ) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
        """Gradients to grid positions [n, 3] and view harmonics [16 n]; keeps those to the field for `step`."""
        take, n = self._buffers.take, len(samples.t)
        width = samples.features.shape[0]
        weights = self._weights()
        transposed = [np.ascontiguousarray(w.T).reshape(-1) for w in weights]
        sums = [np.zeros((self.workers, w.size), f4) for w in weights]
        g_features, g_view = take("g features", width, n), take("g view", VIEW_FEATURES * n)
        trained = int(samples.offset[trained_rays])
        for first, last, with_weights in ((0, trained, True), (trained, n, False)):
            if first < last:
                network.network_backward(
                    samples.features.reshape(-1), width, view.reshape(-1), samples.ray, first, last, with_weights,
                    *(w.reshape(-1) for w in weights), *transposed,
                    g_density, g_colour, g_features.reshape(-1), g_view, *sums,
                )  # fmt: skip
        if trained:
            self._keep_network_gradients(
                [s.sum(0).reshape(w.shape) for s, w in zip(sums, weights, strict=True)]
            )
            self._pending = (samples, g_features, trained)
        dx, row = take("dx", n, 3), 0
        shares = (1.0, gradient.reconstruction_share)
        for i, jacobian in enumerate(samples.jacobians):
            height = 2 * jacobian.shape[0]
            encoding.position_gradient(g_features[row : row + height], jacobian, f4(shares[i]), dx, i > 0)
            row += height
        return dx, g_view

    def _keep_network_gradients(self, gradients: list[np.ndarray]) -> None:
        low = self.shape.pose_grid.width
        first = torch.from_numpy(gradients[0])
        self.networks[0].grad = first[:, :low].clone()
        if self.reconstructing:
            self.reconstruction_columns.grad = first[
                :, low : low + self.shape.reconstruction_grid.width
            ].clone()
        for weight, gradient in zip(self.networks[1:4], gradients[1:4], strict=True):
            weight.grad = torch.from_numpy(gradient)
        self.networks[4].grad = torch.from_numpy(gradients[4][:3].copy())

    def _update_table(self, name: str, rates: np.ndarray) -> None:
        if self._pending is None:
            return
        samples, g_features, trained = self._pending
        pose = name == "pose"
        grid = self.shape.pose_grid if pose else self.shape.reconstruction_grid
        table = self.pose_table if pose else self.reconstruction_table
        row = 0 if pose else self.shape.pose_grid.width
        step = self.steps[name]
        adam = (
            f4(BETA1),
            f4(BETA2),
            f4(EPSILON),
            f4(1 / (1 - BETA1**step)),
            f4(1 / (1 - BETA2**step) ** 0.5),
        )
        moment1, moment2 = (m.numpy().reshape(-1) for m in self.moments[name])
        encoding.update_table(
            samples.x, trained, g_features[row : row + grid.width], grid.scale, grid.stride, grid.hashed, grid.offset,
            table.numpy().reshape(-1), moment1, moment2, rates, adam, self._scratch, self.workers,
        )  # fmt: skip

    def discard_gradients(self) -> None:
        self._pending = None
        for weight in (*self.networks, self.reconstruction_columns):
            weight.grad = None

    def buffers(self) -> Buffers:
        return self._buffers


class _RenderRays(torch.autograd.Function):
    """Ties the kernels to autograd at the rays, so that poses are optimised like any other torch parameter."""

    @staticmethod
    def forward(ctx, origin, direction, harmonics, field: CpuField, rays: Rays, marching, gradient):  # noqa: ANN001
        o, d, view = origin.detach().numpy(), direction.detach().numpy(), harmonics.detach().numpy()
        background = rays.background.numpy()
        samples = field.sample(o, d, view, rays.jitter.numpy(), marching, gradient)
        count = len(o)
        colour, opacity, depth = np.empty((count, 3), f4), np.empty(count, f4), np.empty(count, f4)
        ray_kernels.composite(
            samples.offset, samples.t, samples.dt, samples.density, samples.colour, background, colour, opacity, depth
        )  # fmt: skip
        ctx.kept = (field, samples, o, d, view, background, colour, opacity, rays.trained, gradient)
        results = tuple(torch.from_numpy(a) for a in (colour, opacity, depth))
        ctx.mark_non_differentiable(results[2])
        return (*results, len(samples.t))

    @staticmethod
    def backward(ctx, g_colour, g_opacity, _g_depth, _g_count):  # noqa: ANN001
        field, samples, o, d, view, background, colour, opacity, trained, gradient = ctx.kept
        take, n = field.buffers().take, len(samples.t)
        g_density, g_sample = take("g density", n), take("g colour", 3 * n)
        ray_kernels.composite_backward(
            samples.offset, samples.dt, samples.density, samples.colour, background, colour, opacity,
            np.ascontiguousarray(g_colour.numpy()), np.ascontiguousarray(g_opacity.numpy()), g_density, g_sample,
        )  # fmt: skip
        dx, g_view = field.backward_samples(samples, view, trained, g_density, g_sample, gradient)
        g_origin, g_direction = np.empty_like(o), np.empty_like(d)
        g_harmonics = np.empty((len(o), VIEW_FEATURES), f4)
        ray_kernels.ray_gradients(
            o,
            d,
            samples.offset,
            samples.t,
            dx,
            g_view,
            field.shape.unbounded,
            g_origin,
            g_direction,
            g_harmonics,
        )
        grads = (torch.from_numpy(a) for a in (g_origin, g_direction, g_harmonics))
        return (*grads, None, None, None, None)
