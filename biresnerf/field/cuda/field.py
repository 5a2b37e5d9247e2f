"""The radiance field on the Triton kernels. Nothing in a training step waits for the device.

How many samples a step takes is known on the device only: buffers have a fixed capacity, kernels read counts from
device memory, and they reach the host a step late. See docs/cuda.md.
"""

from __future__ import annotations

import logging
import math

import numpy as np
import torch
from torch import Tensor

from biresnerf.field.cuda import plans
from biresnerf.field.cuda.launches import refuse_the_wrong_mode
from biresnerf.field.cuda.workspace import Capacity, Pass, Workspace
from biresnerf.field.grid_field import BETA1, BETA2, GridField
from biresnerf.field.radiance_field import (
    FieldShape,
    Marching,
    PositionGradient,
    Rays,
    Rendering,
)

logger = logging.getLogger(__name__)

RAYS_LEAST, SAMPLES_LEAST = 256, 1 << 16
MARGIN = 1.3  # counts change from step to step by less; a step with more leaves its last rays out
GROWTH = 1.6  # of what is needed, where buffers have to grow
BOX_DIAGONAL = 2 * math.sqrt(3)
RESULTS = ("ray_colour", "opacity", "depth")


class SampleCount:
    """Remembers the last count that has arrived, as samples a ray and unit length of interval."""

    def __init__(self, device: torch.device) -> None:
        self._on_device = device.type == "cuda"
        self._arriving = torch.zeros(1, dtype=torch.int32, pin_memory=self._on_device)
        self._arrived = torch.cuda.Event() if self._on_device else None
        self._waiting: tuple[int, float] | None = None
        self._density: float | None = None

    def note(self, total: Tensor, rays: int, interval: float) -> None:
        """Request the count `total` [1] of this many rays marched at `interval`."""
        self._arriving.copy_(total, non_blocking=True)
        if self._arrived is not None:
            self._arrived.record()
        self._waiting = (rays, interval)

    def latest(self) -> int:
        """The count last requested, after waiting for it; 0 if there is none. Call before the next `note`."""
        if self._arrived is not None and self._waiting is not None:
            self._arrived.synchronize()
        count = int(self._arriving)
        if self._waiting is not None:
            rays, interval = self._waiting
            self._density = count * interval / max(1, rays)
            self._waiting = None
        return count

    def expected(self, rays: int, interval: float) -> int | None:
        """The count to expect of other rays, from the last one; None if there is none."""
        return None if self._density is None else round(self._density * rays / interval)

    def forget(self) -> None:
        self._waiting = self._density = None


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


class CudaField(GridField):
    """Backend `cuda`.

    Args:
        samples: samples that fit at first; grows by itself.

    Raises:
        InputError: Triton's interpreter is on (or, for a device without CUDA, off).
    """

    backend = "cuda"

    def __init__(
        self, shape: FieldShape, seed: int, device: torch.device, samples: int = SAMPLES_LEAST
    ) -> None:
        refuse_the_wrong_mode(device)
        super().__init__(shape, seed, device)
        self._samples = self._samples_least = samples
        self._workspace: Workspace | None = None
        self._sample_count = SampleCount(device)
        self._forward_number = 0  # of the forward pass whose samples the buffers hold
        self._pending: int | None = None  # the forward pass whose gradients wait for `step`

    def start_reconstruction(self) -> None:
        super().start_reconstruction()
        self._drop_workspace()

    def load_state(self, state: dict[str, Tensor]) -> None:
        super().load_state(state)
        self._drop_workspace()

    def _drop_workspace(self) -> None:
        self._workspace, self._pending = None, None

    def render(self, rays: Rays, marching: Marching, gradient: PositionGradient) -> Rendering:
        moving = rays.origin.requires_grad or rays.direction.requires_grad
        if not (torch.is_grad_enabled() and (moving or rays.trained)):
            return self._view(rays, marching, gradient)
        count = len(rays.origin)
        samples = self._foreseen(count, marching)
        if samples is None:
            samples = self._counted(rays, marching, gradient)
        self._begin(Pass(count, rays.trained, marching, gradient, samples))
        rendering = Rendering(
            *RenderRays.apply(rays.origin, rays.direction, self.networks[0], self, rays), samples
        )
        self._note()
        return rendering

    def density(self, position: Tensor) -> Tensor:
        return self._density(position, None, whole=True)

    def estimate(self, position: Tensor, count: Tensor | None = None) -> Tensor:
        return self._density(position, count, whole=False)

    def _density(self, position: Tensor, count: Tensor | None, *, whole: bool) -> Tensor:
        if count is None:
            count = torch.full((1,), len(position), device=self.device)
        w = self._reserve(0, 1, 1, 1 if self._workspace is None else self._workspace.capacity.side)
        self._forward_number += 1
        results = [position.new_zeros(0)]
        for begin in range(0, len(position), w.capacity.samples):
            part = position[begin : begin + w.capacity.samples]
            w.buffers["x"][:, : len(part)].copy_(part.T)
            w.buffers["taken"].copy_((count - begin).clamp(0, len(part)))
            w.record()
            w.plan(plans.density, whole).run()
            results.append(w.buffers["density"][: len(part)].clone())
        return torch.cat(results)

    def _view(self, rays: Rays, marching: Marching, gradient: PositionGradient) -> Rendering:
        """Rendering without gradient, in parts that fit the buffers whatever their number of samples."""
        side = marching.occupied.shape[0]
        w = self._reserve(0, self._most_of_a_ray(marching), marching.most, side)
        parts, total = [], torch.zeros(1, dtype=torch.int32, device=self.device)
        size = w.capacity.samples // self._most_of_a_ray(marching)
        for begin in range(0, max(1, len(rays.origin)), size):
            taken = slice(begin, begin + size)
            part = Rays(
                rays.origin[taken], rays.direction[taken], rays.background[taken], rays.jitter[taken], trained=0
            )  # fmt: skip
            w = self._reserve(len(part.origin), 1, marching.most, side)
            self._begin(Pass(len(part.origin), 0, marching, gradient, 0))
            self._write_rays(w, part)
            w.plan(plans.viewing, marching.merging is not None).run()
            n = len(part.origin)
            parts.append([w.buffers[name][:n].clone() for name in RESULTS])
            total += w.buffers["marched"]
        colour, opacity, depth = (torch.cat(tensors) for tensors in zip(*parts, strict=True))
        return Rendering(colour, opacity, depth, int(total))

    def _foreseen(self, count: int, marching: Marching) -> int | None:
        """Samples to expect of so many rays; None where none were counted yet, or so many might not fit."""
        w = self._reserve(count, 1, marching.most, marching.occupied.shape[0])
        needed = self._sample_count.latest()
        if needed > w.capacity.samples:
            logger.warning(
                "a step needed %d samples of %d: its last rays were left out", needed, w.capacity.samples
            )
        samples = self._sample_count.expected(count, marching.step)
        certain = count * self._most_of_a_ray(marching) <= w.capacity.samples
        fits = samples is not None and (certain or samples * MARGIN <= w.capacity.samples)
        return samples if fits else None

    def _counted(self, rays: Rays, marching: Marching, gradient: PositionGradient) -> int:
        """Count samples of rays, and grow buffers for them. Only here does an optimisation step wait for the device."""
        count, side = len(rays.origin), marching.occupied.shape[0]
        w = self._reserve(count, 1, marching.most, side)
        self._begin(Pass(count, rays.trained, marching, gradient, 0))
        self._write_rays(w, rays)
        w.plan(plans.marching).run()
        samples = int(w.buffers["marched"])
        if samples * MARGIN > w.capacity.samples:
            del w  # frees its memory before the larger one takes its own
            self._reserve(count, int(samples * GROWTH), marching.most, side)
        return samples

    def run_forward(self, rays: Rays) -> tuple[Tensor, Tensor, Tensor, int]:
        """Colour, opacity and depth for a backward pass to follow; the number of this pass."""
        w, count = self._workspace, len(rays.origin)
        assert w is not None
        self._write_rays(w, rays)
        w.plan(plans.forward, self._pass.marching.merging is not None).run()
        colour, opacity, depth = (w.buffers[name][:count].clone() for name in RESULTS)
        return colour, opacity, depth, self._forward_number

    def _note(self) -> None:
        """Request the count of the last pass."""
        assert self._workspace is not None
        self._sample_count.note(self._workspace.buffers["marched"], self._pass.rays, self._pass.marching.step)

    def run_backward(
        self, number: int, count: int, trained: int, g_colour: Tensor, g_opacity: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Gradients to origin and direction; keeps those to the field for `step`."""
        w = self._workspace
        if w is None or number != self._forward_number:
            raise RuntimeError("the field was used for something else between render and backward")
        w.buffers["g_ray_colour"][:count].copy_(g_colour)
        w.buffers["g_opacity"][:count].copy_(g_opacity)
        w.plan(plans.backward).run()
        if trained:
            self._pending = number
            weights = (*w.density_weights, *w.colour_weights)
            for weight, gradient in zip(weights, w.weight_gradients(), strict=True):
                weight.grad = gradient
        return w.buffers["g_origin"][:count].clone(), w.buffers["g_direction"][:count].clone()

    def _update_table(self, name: str, rates: np.ndarray) -> None:
        w, step = self._workspace, self.steps[name]
        if self._pending is None:
            return
        if w is None or self._pending != self._forward_number:
            raise RuntimeError("the field was used for something else between backward and step")
        corrections = (1 / (1 - BETA1**step), 1 / math.sqrt(1 - BETA2**step))
        w.write_controls({f"{name}_rates": rates.tolist(), f"{name}_corrections": corrections})
        w.plan(plans.update, name).run()

    def discard_gradients(self) -> None:
        self._pending = None
        super().discard_gradients()

    def release_memory(self) -> None:
        super().release_memory()
        self._samples = self._samples_least
        self._drop_workspace()

    def _most_of_a_ray(self, marching: Marching) -> int:
        """The most samples that a ray can have."""
        if self.unbounded:
            return marching.most
        return min(marching.most, math.ceil(BOX_DIAGONAL / marching.step) + 1)

    def _reserve(self, rays: int, samples: int, most: int, side: int) -> Workspace:
        """A workspace for at least so many rays and samples: the current one, or a larger one that replaces it."""
        held = self._workspace
        if held is not None and held.capacity.holds(Capacity(rays, samples, most, side)):
            return held
        before = held.capacity if held is not None else Capacity(RAYS_LEAST, self._samples, 1, side)
        rays = max(before.rays, 1 << (rays - 1).bit_length() if rays else 0)
        self._samples = max(before.samples, samples)
        held = None
        self._workspace = None  # frees its memory before the larger one takes its own
        self._forward_number += 1
        self._workspace = Workspace(self, Capacity(rays, self._samples, max(before.most, most), side))
        return self._workspace

    def _begin(self, of: Pass) -> None:
        """Write the numbers of a pass to the device."""
        w = self._workspace
        assert w is not None
        self._forward_number += 1
        self._pass = of
        w.buffers["occupied"].copy_(of.marching.occupied)
        w.write_controls(of.controls())
        w.record()

    def _write_rays(self, w: Workspace, rays: Rays) -> None:
        for name in ("origin", "direction", "background", "jitter"):
            w.buffers[name][: len(rays.origin)].copy_(getattr(rays, name).detach())
