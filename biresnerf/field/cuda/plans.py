"""Which kernels run in which order: one function for each operation of the field."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch

from biresnerf.field.cuda import encoding, harmonics, merging, network, rays
from biresnerf.field.cuda.launches import Launch, bind, block
from biresnerf.field.cuda.workspace import Workspace
from biresnerf.field.grid_field import BETA1, BETA2, EPSILON

SAMPLES = 128  # a program takes, in kernels of one thread a sample
RAYS = 32  # a program takes, in kernels of one thread a ray
LANES = 32  # samples of a ray at once, in kernels of one program a ray
TILE = 64  # samples that go through the networks at once
BACKWARD_WARPS = 8
ENTRIES = 1024  # numbers of a table that a program updates


def marching(w: Workspace) -> list[Any]:
    """Live intervals of the rays, counted, and where each ray's samples will lie."""
    b = w.buffers
    return [
        _per_ray_block(
            rays.march, w, side=w.capacity.side, most=w.capacity.most, ray_capacity=w.capacity.rays
        ),
        _offsets(w),
        lambda: b["marched"].copy_(b["ray_offset"][-1:]),
    ]


def viewing(w: Workspace, merged: bool) -> list[Any]:
    """Colour, opacity and depth of rays."""
    return _rendering(w, merged, with_jacobian=False)


def forward(w: Workspace, merged: bool) -> list[Any]:
    """The same, leaving what the backward pass needs."""
    return _rendering(w, merged, with_jacobian=True)


def backward(w: Workspace) -> list[Any]:
    """Gradients to rays, weights and features, from those of the rays' colour and opacity."""
    b = w.buffers
    networks = {**b, **_networks(w)}
    launches: list[Any] = [
        _per_ray(rays.composite_backward, w),
        bind(network.colour_backward, (w.programs,), networks, warps=BACKWARD_WARPS, programs=w.programs),
        bind(network.density_backward, (w.programs,), networks, warps=BACKWARD_WARPS, programs=w.programs),
        lambda: torch.sum(b["colour_sums"], 0, out=b["g_colour_weights"]),
        lambda: torch.sum(b["density_sums"], 0, out=b["g_density_weights"]),
    ]
    for name in w.modules:
        launches.append(
            _per_sample(
                encoding.position_gradient, w, name,
                levels=w.grids[name].levels, share=b[f"{name}_share"], ACCUMULATE=name != "pose",
            )
        )  # fmt: skip
    launches.append(_per_ray(rays.ray_gradients, w))
    launches.append(_per_ray_block(harmonics.harmonics_gradient, w))
    return launches


def density(w: Workspace, whole: bool) -> list[Any]:
    """Density of the points given as samples; if not `whole`, by the pose-estimation module alone."""
    if whole:
        modules, features = w.modules, {}
    else:
        modules, features = w.modules[:1], {"HIGH": 0}
    return [
        *_encoding(w, modules, with_jacobian=False),
        _per_tile(network.network_forward, w, WITH_COLOUR=False, **features),
    ]


def update(w: Workspace, name: str) -> list[Any]:
    """Adam on the table of a module, from the last backward pass."""
    grid, size = w.grids[name], block(ENTRIES)
    largest = 2 * max(int(entries) for entries in grid.offset[1:] - grid.offset[:-1])
    return [
        _per_sample(encoding.table_gradient, w, name, per_level=True),
        bind(
            encoding.adam_touched, (-(-largest // size), grid.levels), w.tables[name],
            BETA1=BETA1, BETA2=BETA2, EPSILON=EPSILON, BLOCK=size,
        ),
    ]  # fmt: skip


def _rendering(w: Workspace, merged: bool, with_jacobian: bool) -> list[Any]:
    return [
        *marching(w),
        *_packing(w),
        *(_merging(w) if merged else []),
        _per_ray_block(harmonics.view_harmonics, w),
        *_encoding(w, w.modules, with_jacobian),
        _per_tile(network.network_forward, w, WITH_COLOUR=True),
        _per_ray(rays.composite, w),
    ]


def _packing(w: Workspace) -> list[Any]:
    return [w.buffers["taken"].zero_, _per_ray(rays.pack, w, most=w.capacity.most)]


def _merging(w: Workspace) -> list[Any]:
    """Merge intervals by the densities of the pose-estimation module, and pack them again."""
    return [
        *density(w, whole=False),
        _per_ray_block(
            merging.merge,
            w,
            most=w.capacity.most,
            capacity=w.capacity.samples,
            ray_capacity=w.capacity.rays,
        ),
        _offsets(w),
        *_packing(w),
    ]


def _offsets(w: Workspace) -> Callable[[], Any]:
    b = w.buffers
    return lambda: torch.cumsum(b["count"], 0, dtype=torch.int32, out=b["ray_offset"][1:])


def _encoding(w: Workspace, modules: tuple[str, ...], with_jacobian: bool) -> list[Launch]:
    return [
        _per_sample(
            encoding.encode, w, name, per_level=True,
            smoothing=w.buffers[f"{name}_smoothing"], WITH_JACOBIAN=with_jacobian,
        )
        for name in modules
    ]  # fmt: skip


def _per_ray(kernel: Any, w: Workspace, **others: Any) -> Launch:
    return bind(
        kernel, (w.capacity.rays,), w.buffers, warps=1,
        capacity=w.capacity.samples, UNBOUNDED=w.shape.unbounded, CHUNK=block(LANES), **others,
    )  # fmt: skip


def _per_ray_block(kernel: Any, w: Workspace, **others: Any) -> Launch:
    size = block(RAYS)
    return bind(
        kernel, (-(-w.capacity.rays // size),), w.buffers, warps=1,
        UNBOUNDED=w.shape.unbounded, BLOCK=size, **others,
    )  # fmt: skip


def _per_sample(kernel: Any, w: Workspace, name: str, *, per_level: bool = False, **others: Any) -> Launch:
    size = block(SAMPLES)
    grid: tuple[int, ...] = (-(-w.capacity.samples // size),)
    if per_level:
        grid = (*grid, w.grids[name].levels)
    module = {
        **w.tables[name],
        "jacobian": w.buffers[f"{name}_jacobian"],
        "row": 0 if name == "pose" else w.grids["pose"].width,
    }
    return bind(kernel, grid, {**w.buffers, **module}, capacity=w.capacity.samples, BLOCK=size, **others)


def _per_tile(kernel: Any, w: Workspace, **others: Any) -> Launch:
    settings = _networks(w)
    return bind(kernel, (-(-w.capacity.samples // settings["BLOCK"]),), {**w.buffers, **settings}, **others)


def _networks(w: Workspace) -> dict[str, Any]:
    """Widths of both modules' features, as they are and as powers of two that a tile can have."""
    low = w.grids["pose"].width
    high = w.width - low
    return {
        "capacity": w.capacity.samples,
        "LOW": low, "LOW_PAD": _tile_width(low), "HIGH": high, "HIGH_PAD": _tile_width(high),
        "PRECISION": "tf32", "BLOCK": block(TILE),
    }  # fmt: skip


def _tile_width(width: int) -> int:
    return max(16, 1 << (width - 1).bit_length()) if width else 16
