"""The radiance field on the Numba kernels. Works on CPU tensors in place, sharing their memory with NumPy."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from torch import Tensor

from biresnerf.field.cpu import encoding, network
from biresnerf.field.cpu import marching as march_kernels
from biresnerf.field.cpu.marching import merge
from biresnerf.field.cpu.matrix_blocks import CHANNELS, from_tiles
from biresnerf.field.cpu.ray_kernels import add_harmonics_gradient, harmonics, ray_gradients
from biresnerf.field.cpu.samples import Composited, Samples, segments
from biresnerf.field.cpu.segments import render_segments
from biresnerf.field.cpu.segments_backward import render_segments_backward
from biresnerf.field.grid_field import BETA1, BETA2, EPSILON, HIDDEN, MODULES, OUTPUTS, GridField
from biresnerf.field.radiance_field import FieldShape, Marching, PositionGradient, Rays, Rendering
from biresnerf.field.spherical_harmonics import VIEW_FEATURES

f4 = np.float32


def tasks() -> np.ndarray:
    """The counter that the workers of one kernel call draw their tasks from."""
    return np.zeros(1, np.int64)


class Buffers:
    """Arrays that live from step to step and grow by 1.3, so that a step allocates nothing large."""

    def __init__(self) -> None:
        self._held: dict[str, np.ndarray] = {}

    def take(self, name: str, *shape: int, dtype: Any = f4) -> np.ndarray:
        """An uninitialised array of this shape; valid until the same name is requested again."""
        size = math.prod(shape)
        held = self._held.get(name)
        if held is None or held.size < size or held.dtype != dtype:
            held = self._held[name] = np.empty(int(size * 1.3) + 1024, dtype)
        return held[:size].reshape(shape)


class CpuField(GridField):
    """Backend `cpu`."""

    backend = "cpu"

    def __init__(self, shape: FieldShape, seed: int, device: torch.device, workers: int) -> None:
        super().__init__(shape, seed, device)
        self.workers = workers
        self._buffers = Buffers()
        largest = int(np.concatenate([np.diff(grid.offset) for grid in self.grids.values()]).max())
        self._scratch = np.zeros((workers, 2 * largest), f4)
        self._pending: tuple[Samples, np.ndarray] | None = None
        # Tables, their moments and weights stay where they are for good.
        self._layers = [weight.detach().numpy() for weight in self.networks]
        self._columns = self.reconstruction_columns.detach().numpy()
        self._words = {name: table.numpy().reshape(-1).view(np.uint64) for name, table in self.tables.items()}
        self._flat = {
            name: tuple(t.numpy().reshape(-1) for t in (table, *self.moments[name]))
            for name, table in self.tables.items()
        }
        self._clearances: tuple[Tensor | None, int, np.ndarray] = (None, 0, np.empty(0))

    def _width(self, modules: tuple[str, ...]) -> int:
        width = sum(self.grids[name].width for name in modules)
        return -CHANNELS * (-width // CHANNELS)  # whole register tiles

    def _first_layer(self, modules: tuple[str, ...]) -> np.ndarray:
        """The columns of these modules, padded to whole tiles."""
        first = np.zeros((HIDDEN, self._width(modules)), f4)
        low = self.shape.pose_grid.width
        first[:, :low] = self._layers[0]
        if len(modules) > 1:
            first[:, low : low + self._columns.shape[1]] = self._columns
        return first

    def _weights(self) -> tuple[np.ndarray, ...]:
        """The five layers as contiguous arrays; input columns padded to whole tiles, colour rows to 4."""
        last = np.zeros((4, HIDDEN), f4)
        last[:3] = self._layers[4]
        return (self._first_layer(self.modules), *self._layers[1:4], last)

    def _encode(
        self, x: np.ndarray, gradient: PositionGradient | None, role: str, modules: tuple[str, ...]
    ) -> tuple[np.ndarray, list[np.ndarray]]:
        """Features [width, n] and each module's Jacobian, [levels, 0, n] where no gradient is needed."""
        n, width = len(x) // 3, self._width(modules)
        derivatives, gradient = (0, PositionGradient()) if gradient is None else (6, gradient)
        features = self._buffers.take(f"{role} features", width, n)
        jacobians, row = [], 0
        smoothings = (gradient.pose_smoothing, gradient.reconstruction_smoothing)
        for name, smoothing in zip(modules, smoothings, strict=False):
            grid = self.grids[name]
            jacobian = self._buffers.take(f"{role} jacobian {name}", grid.levels, derivatives, n)
            encoding.encode(
                x, self._words[name], grid.scale, grid.stride, grid.hashed, grid.offset, f4(smoothing),
                features[row : row + grid.width], jacobian,
            )  # fmt: skip
            jacobians.append(jacobian)
            row += grid.width
        features[row:] = 0
        return features, jacobians

    def render(self, rays: Rays, marching: Marching, gradient: PositionGradient) -> Rendering:
        colour, opacity, depth, count = _RenderRays.apply(
            rays.origin, rays.direction, self.networks[0], self, rays, marching, gradient
        )
        return Rendering(colour, opacity, depth, int(count))

    def density(self, position: Tensor) -> Tensor:
        return self._density_at(position, self.modules)

    def estimate(self, position: Tensor, count: Tensor | None = None) -> Tensor:
        return self._density_at(position, MODULES[:1])

    def _density_at(self, position: Tensor, modules: tuple[str, ...]) -> Tensor:
        result = np.empty(len(position), f4)
        self._density(position.contiguous().numpy().reshape(-1), modules, result)
        return torch.from_numpy(result)

    def _density(self, x: np.ndarray, modules: tuple[str, ...], density: np.ndarray) -> None:
        """Fill `density` [n] with the density that these modules give at x [3 n]."""
        features, _ = self._encode(x, None, "density", modules)
        w1, w2 = self._first_layer(modules).reshape(-1), self._layers[1].reshape(-1)
        network.network_density(
            features.reshape(-1), features.shape[0], w1, w2, density, tasks(), self.workers
        )

    def march(self, origin: np.ndarray, direction: np.ndarray, jitter: np.ndarray, marching: Marching,
              ) -> tuple[np.ndarray, ...]:  # fmt: skip
        """Where the samples of rays are: offset [rays + 1], grid positions x [3 n], t, dt, ray [n].

        And how many there were before any were merged.
        """
        rays, take = len(origin), self._buffers.take
        t_buffer = take("march t", rays, marching.most)
        dt_buffer = take("march dt", rays, marching.most)
        count = take("count", rays, dtype=np.int32)
        march_kernels.march(
            origin, direction, jitter, marching.occupied.numpy().reshape(-1), marching.occupied.shape[0],
            self._clearance(marching.occupied), f4(marching.step), f4(marching.near), f4(marching.far),
            self.shape.unbounded, t_buffer, dt_buffer, count,
        )  # fmt: skip
        packed = self._pack(origin, direction, t_buffer, dt_buffer, count)
        marched, merging = len(packed[2]), marching.merging
        if merging is not None:
            density = take("estimate", marched)
            self._density(packed[1], MODULES[:1], density)
            merge(density, packed[0], jitter, f4(merging.light), merging.most, t_buffer, dt_buffer, count)
            packed = self._pack(origin, direction, t_buffer, dt_buffer, count)
        return (*packed, marched)

    def _pack(self, origin: np.ndarray, direction: np.ndarray, t_buffer: np.ndarray, dt_buffer: np.ndarray,
              count: np.ndarray) -> tuple[np.ndarray, ...]:  # fmt: skip
        take, offset = self._buffers.take, np.zeros(len(count) + 1, np.int64)
        np.cumsum(count, out=offset[1:])
        n = int(offset[-1])
        x, t, dt, ray = take("x", 3 * n), take("t", n), take("dt", n), take("ray", n, dtype=np.int32)
        march_kernels.pack(
            origin, direction, t_buffer, dt_buffer, count, offset, self.shape.unbounded, x, t, dt, ray
        )
        march_kernels.bring_inside(x)
        return offset, x, t, dt, ray

    def _clearance(self, occupied: Tensor) -> np.ndarray:
        """`march_kernels.clearances`, kept until the grid changes."""
        known, version, clearance = self._clearances
        if known is not occupied or version != occupied._version:
            clearance = march_kernels.clearances(occupied.numpy())
            self._clearances = (occupied, occupied._version, clearance)
        return clearance

    def _samples(
        self, marched: tuple[Any, ...], trained: int, features: np.ndarray, jacobians: list[np.ndarray]
    ) -> Samples:
        """What `march` found, with the features there, and room for what compositing leaves."""
        offset, _x, t, *_ = marched
        segment, learning = segments(offset, trained)
        take, n, count = self._buffers.take, len(t), len(offset) - 1
        composited = Composited(
            take("outputs", OUTPUTS * n), take("density", n), take("alpha", n), take("kept", n, dtype=np.int32),
            take("kept begin", count, dtype=np.int64), take("kept end", count, dtype=np.int64),
            take("colour", 3 * n),
        )  # fmt: skip
        return Samples(segment, learning, *marched, features, jacobians, composited, self._weights())

    def unseen_sample(self) -> Samples:
        """One ray with one sample that no light reaches, as a forward pass leaves it.

        Kernels of the backward pass compile with it while another process compiles those of the forward pass.
        """
        features = np.zeros((self._width(self.modules), 1), f4)
        jacobians = [np.zeros((self.grids[name].levels, 6, 1), f4) for name in self.modules]
        t, dt, ray = np.ones(1, f4), np.ones(1, f4), np.zeros(1, np.int32)
        samples = self._samples((np.arange(2), np.zeros(3, f4), t, dt, ray, 1), 1, features, jacobians)
        for array in samples.composited:
            array.fill(0)
        return samples

    def render_forward(self, origin: np.ndarray, direction: np.ndarray, view: np.ndarray, rays: Rays,
                       marching: Marching, gradient: PositionGradient | None,
                       ) -> tuple[Samples, np.ndarray, np.ndarray, np.ndarray]:  # fmt: skip
        """March, evaluate the field at every sample and composite: colour [rays, 3], opacity, depth [rays].

        `gradient` is None where positions need none.
        """
        count = len(origin)
        offset, x, t, dt, ray, marched = self.march(origin, direction, rays.jitter.numpy(), marching)
        features, jacobians = self._encode(x, gradient, "render", self.modules)
        samples = self._samples((offset, x, t, dt, ray, marched), rays.trained, features, jacobians)
        colour, opacity, depth = np.empty((count, 3), f4), np.empty(count, f4), np.empty(count, f4)
        render_segments(
            samples.segment, offset, t, dt, ray, features.reshape(-1), len(features), view.reshape(-1),
            rays.background.numpy(), tuple(w.reshape(-1) for w in samples.weights), samples.composited,
            colour, opacity, depth, tasks(), self.workers,
        )  # fmt: skip
        return samples, colour, opacity, depth

    def render_backward(self, s: Samples, view: np.ndarray, colour: np.ndarray, opacity: np.ndarray,
                        g_colour: np.ndarray, g_opacity: np.ndarray, gradient: PositionGradient | None,
                        ) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
        """Gradients to grid positions [3, n] and view harmonics [rays, 16]; keeps those to the field for `step`."""
        take, n, width = self._buffers.take, len(s.t), len(s.features)
        sums = [take(f"sums {k}", max(1, s.learning), w.size) for k, w in enumerate(s.weights)]
        for layer in sums:
            layer.fill(0)
        g_features, dx = take("g features", width, n), take("dx", 3, n)
        g_view = np.empty((len(opacity), VIEW_FEATURES), f4)
        longest = int(np.diff(s.offset[s.segment]).max(initial=0))
        second = s.jacobians[1] if len(s.jacobians) > 1 else np.empty((0, 6, n), f4)
        render_segments_backward(
            s.segment, s.learning, longest, s.offset, s.dt, s.ray, s.features.reshape(-1), width, view.reshape(-1),
            tuple(w.reshape(-1) for w in s.weights), s.composited, colour, opacity, g_colour, g_opacity,
            s.jacobians[0], second, f4(gradient.reconstruction_share if gradient else 0), s.x, take("g density", n),
            take("g colour", 3 * n), g_features.reshape(-1), dx, g_view, tuple(sums), tasks(), self.workers,
        )  # fmt: skip
        if s.learning:
            self._keep_network_gradients(
                [from_tiles(d.sum(0), *w.shape) for d, w in zip(sums, s.weights, strict=True)]
            )
            self._pending = (s, g_features)
        return dx, g_view

    def _keep_network_gradients(self, gradients: list[np.ndarray]) -> None:
        low = self.shape.pose_grid.width
        first = torch.from_numpy(gradients[0])
        self.networks[0].grad = first[:, :low].clone()
        if self.reconstructing:
            high = self.shape.reconstruction_grid.width
            self.reconstruction_columns.grad = first[:, low : low + high].clone()
        for weight, gradient in zip(self.networks[1:4], gradients[1:4], strict=True):
            weight.grad = torch.from_numpy(gradient)
        self.networks[4].grad = torch.from_numpy(gradients[4][:3].copy())

    def _update_table(self, name: str, rates: np.ndarray) -> None:
        if self._pending is None:
            return
        samples, g_features = self._pending
        # Kept samples lie without gaps from each segment's first sample on.
        begin = samples.offset[samples.segment[: samples.learning]]
        end = samples.composited.kept_end[samples.segment[1 : samples.learning + 1] - 1]
        grid, step = self.grids[name], self.steps[name]
        row = 0 if name == "pose" else self.grids["pose"].width
        adam = tuple(map(f4, (BETA1, BETA2, EPSILON, 1 / (1 - BETA1**step), 1 / (1 - BETA2**step) ** 0.5)))
        encoding.update_table(
            samples.x, begin, end, g_features[row : row + grid.width],
            grid.scale, grid.stride, grid.hashed, grid.offset,
            *self._flat[name], rates, adam, self._scratch, tasks(), self.workers,
        )  # fmt: skip

    def discard_gradients(self) -> None:
        self._pending = None
        super().discard_gradients()


class _RenderRays(torch.autograd.Function):
    """Ties the kernels to autograd at the rays, so that poses are optimised like any other torch parameter.

    One of the field's weights is an input so that the backward pass is reached where poses stand still.
    """

    @staticmethod
    def forward(ctx, origin, direction, _weight, field: CpuField, rays: Rays, marching, gradient):
        if not any(ctx.needs_input_grad[:2]):
            gradient = None
        o, d = origin.detach().numpy(), direction.detach().numpy()
        view = np.empty((len(d), VIEW_FEATURES), f4)
        harmonics(d, view)
        samples, colour, opacity, depth = field.render_forward(o, d, view, rays, marching, gradient)
        ctx.kept = (field, samples, o, d, view, colour, opacity, gradient)
        tensors = (torch.from_numpy(colour), torch.from_numpy(opacity), torch.from_numpy(depth))
        marched = torch.tensor(samples.marched)
        ctx.mark_non_differentiable(tensors[2], marched)
        return (*tensors, marched)

    @staticmethod
    def backward(ctx, g_colour, g_opacity, _g_depth, _g_count):
        field, samples, o, d, view, colour, opacity, gradient = ctx.kept
        dx, g_view = field.render_backward(
            samples, view, colour, opacity, np.ascontiguousarray(g_colour.numpy()),
            np.ascontiguousarray(g_opacity.numpy()), gradient,
        )  # fmt: skip
        if gradient is None:
            return (None,) * 7
        g_origin, g_direction = np.empty_like(o), np.empty_like(d)
        ray_gradients(o, d, samples.offset, samples.t, dx, field.shape.unbounded, g_origin, g_direction)
        add_harmonics_gradient(d, g_view, g_direction)
        return torch.from_numpy(g_origin), torch.from_numpy(g_direction), *(None,) * 5
