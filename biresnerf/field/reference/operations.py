"""The operations of the radiance field in plain torch: the definition that every fast backend is tested against.

Any device, any float type, differentiable by autograd. Written to be read, not to be fast.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

from biresnerf.field.grid_levels import HASH_PRIMES, GridLevels
from biresnerf.field.radiance_field import Merging

Product = Callable[[Tensor, Tensor], Tensor]  # of two matrices

DENSITY_SHIFT, DENSITY_CAP = 1.0, 11.0
EDGE = 1e-6
LEAST_TRANSMITTANCE = 1e-4  # a ray ends behind the sample that leaves less of its light (instant-ngp's value)
GAP = 1e-2  # intervals: what rounding leaves between neighbours


def straight_through_fraction(fraction: Tensor, smoothing: float) -> Tensor:
    """The fraction itself, with gradient 1 + smoothing (pi/2) sin(pi w) instead of 1 (Heo et al. 2023)."""
    cosine = (1 - torch.cos(math.pi * fraction)) / 2
    return fraction + smoothing * (cosine - cosine.detach())


def encode(x: Tensor, table: Tensor, grid: GridLevels, smoothing: float = 0.0) -> Tensor:
    """Features [n, 2 levels] of points x [n, 3] in [0, 1]; table [entries, 2]. Trilinear in each level.

    `smoothing` shapes the gradient to x alone; the gradient to the table stays that of linear interpolation.
    """
    features = []
    for level in range(grid.levels):
        position = x * float(grid.scale[level]) + 0.5
        cell = position.detach().floor()
        smooth = straight_through_fraction(position - cell, smoothing)
        base, size = int(grid.offset[level]), int(grid.offset[level + 1] - grid.offset[level])
        total = x.new_zeros(1, table.shape[1])
        for corner in range(8):
            bits = [corner & 1, (corner >> 1) & 1, corner >> 2]
            vertex = cell.long() + torch.tensor(bits, device=x.device)
            if grid.hashed[level]:
                hashed = vertex * torch.tensor(HASH_PRIMES, device=x.device)
                index = (hashed[:, 0] ^ hashed[:, 1] ^ hashed[:, 2]) & (size - 1)
            else:
                stride = int(grid.stride[level])
                index = vertex[:, 0] + stride * (vertex[:, 1] + stride * vertex[:, 2])
            weight = torch.ones_like(x[:, 0])
            for axis in range(3):
                weight = weight * (smooth[:, axis] if bits[axis] else 1 - smooth[:, axis])
            total = total + weight[:, None] * table[base + index]
        features.append(total)
    return torch.cat(features, 1)


def network(
    features: Tensor, view: Tensor, weights: list[Tensor], product: Product = torch.matmul
) -> tuple[Tensor, Tensor]:
    """Density [n] and colour [n, 3] of features [n, width] and view harmonics [n, 16].

    `weights` = (64 x width, 16 x 64) of the density network and (64 x 32, 64 x 64, 3 x 64) of the colour network,
    no biases, rectified; density = exp(min(z0 - 1, 11)) of the first output (BAA-NGP's truncated exponential).
    """
    w1, w2, w3, w4, w5 = weights
    outputs = product(torch.relu(product(features, w1.T)), w2.T)
    hidden = torch.relu(product(torch.cat([view, outputs], 1), w3.T))
    colour = product(torch.relu(product(hidden, w4.T)), w5.T)
    return density_of(outputs[:, 0]), torch.sigmoid(colour)


def density(features: Tensor, weights: list[Tensor], product: Product = torch.matmul) -> Tensor:
    """The density [n] of `network` alone."""
    return density_of(product(torch.relu(product(features, weights[0].T)), weights[1].T)[:, 0])


def density_of(logit: Tensor) -> Tensor:
    """Density of the first network's first output: a shifted exponential, capped."""
    return torch.exp((logit - DENSITY_SHIFT).clamp(max=DENSITY_CAP))


def grid_position(x: Tensor, unbounded: bool) -> Tensor:
    """Position in [0, 1]^3 of points x [n, 3] of the unit frame.

    Bounded: (x + 1) / 2. Unbounded: (c(x) + 2) / 4 with mip-NeRF 360's contraction in the maximum norm,
    c(x) = x inside the box |x| <= 1 and (2 - 1/m) x/m, m = max |x_j|, outside.
    """
    if unbounded:
        m = x.abs().amax(-1, keepdim=True).clamp(min=1.0)
        x = (2 - 1 / m) / m * x / 2
    return (x / 2 + 0.5).clamp(EDGE, 1 - EDGE)


def march(
    origin: Tensor,
    direction: Tensor,
    jitter: Tensor,
    occupied: Tensor,
    step: float,
    near: float,
    far: float,
    unbounded: bool,
    most: int,
) -> tuple[Tensor, Tensor, Tensor]:
    """Live intervals of rays [rays, 3], ordered by ray: midpoint t [n], length dt [n], ray [n] (int64).

    Intervals are `step` long (times m^2 outside the inner box of an unbounded scene), the first one starts at a
    random offset; one is live if its midpoint lies in an occupied cell of `occupied` [side, side, side] (z, y, x).
    """
    side = occupied.shape[0]
    t, t_end = torch.full_like(jitter, near), torch.full_like(jitter, far)
    if not unbounded:
        safe = torch.where(direction.abs() < 1e-9, torch.full_like(direction, 1e-9), direction)
        ta, tb = (-1 - origin) / safe, (1 - origin) / safe
        t = torch.maximum(t, torch.minimum(ta, tb).amax(1))
        t_end = torch.minimum(t_end, torch.maximum(ta, tb).amin(1))

    def length(t: Tensor) -> Tensor:
        m = (origin + t[:, None] * direction).abs().amax(1).clamp(min=1.0)
        return step * m**2 if unbounded else torch.full_like(t, step)

    taken = torch.zeros_like(jitter, dtype=torch.long)
    rays, middles, lengths = [], [], []
    t = torch.where(t < t_end, t + jitter * length(t), t)
    while bool(((t < t_end) & (taken < most)).any()):
        dt = length(t)
        middle = t + dt / 2
        cell = (grid_position(origin + middle[:, None] * direction, unbounded) * side).long()
        cell = cell.clamp(0, side - 1)
        live = (middle < t_end) & (taken < most) & occupied[cell[:, 2], cell[:, 1], cell[:, 0]].bool()
        taken = taken + live
        ray = live.nonzero(as_tuple=True)[0]
        rays.append(ray)
        middles.append(middle[ray])
        lengths.append(dt[ray])
        t = t + dt
    if not rays:
        empty = jitter[:0]
        return empty, empty, torch.zeros(0, dtype=torch.long, device=jitter.device)
    ray = torch.cat(rays)
    order = torch.argsort(ray, stable=True)
    return torch.cat(middles)[order], torch.cat(lengths)[order], ray[order]


def merge(
    density: Tensor, t: Tensor, dt: Tensor, ray: Tensor, jitter: Tensor, merging: Merging
) -> tuple[Tensor, Tensor, Tensor]:
    """Fewer intervals with the same light: t, dt, ray of `march`, given an estimate of their densities [n].

    A run of neighbours is one interval as long as it gives at most `merging.light` of the ray's light and has at most
    `merging.most` members; its t is that of its only member, or where the ray's `jitter` [rays] says, 0 at its start
    and 1 at its end. Behind the interval that leaves less than `LEAST_TRANSMITTANCE` of the light the ray ends.
    """
    kept: list[tuple[float, float, int]] = []
    for r in range(len(jitter)):
        share = float(jitter[r])
        transmittance, light = 1.0, 0.0
        run: list[tuple[float, float]] = []
        for i in (ray == r).nonzero()[:, 0].tolist():
            if transmittance < LEAST_TRANSMITTANCE:
                break
            left = transmittance * math.exp(-float(density[i] * dt[i]))
            given, transmittance = transmittance - left, left
            begin, end = float(t[i] - dt[i] / 2), float(t[i] + dt[i] / 2)
            apart = bool(run) and begin - run[-1][1] > GAP * (end - begin)
            if run and (apart or light + given > merging.light or len(run) == merging.most):
                kept.append((*_one_interval(run, share), r))
                light, run = 0.0, []
            light += given
            run.append((begin, end))
        if run:
            kept.append((*_one_interval(run, share), r))
    middle, length, of = zip(*kept, strict=True) if kept else ((), (), ())
    return t.new_tensor(middle), dt.new_tensor(length), ray.new_tensor(of)


def _one_interval(run: list[tuple[float, float]], share: float) -> tuple[float, float]:
    """Where the sample of a run of intervals lies, and how long they are together."""
    begin, length = run[0][0], run[-1][1] - run[0][0]
    return begin + (0.5 if len(run) == 1 else share) * length, length


def composite(
    density: Tensor, colour: Tensor, t: Tensor, dt: Tensor, ray: Tensor, background: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Colour [rays, 3], opacity [rays] and depth [rays] of samples ordered by ray and along it.

    C = sum_k T_k alpha_k c_k + T_end bg, alpha = 1 - exp(-density dt), T_k = exp(-sum_{j<k} density_j dt_j)
    (Mildenhall et al. 2020, eq. 3), over the samples with T_k >= `LEAST_TRANSMITTANCE`; depth is the weights' mean
    distance.
    """
    rays = background.shape[0]
    count = torch.bincount(ray, minlength=rays)
    first = torch.cumsum(count, 0) - count

    def transmittance_of(thickness: Tensor) -> Tensor:
        # Over all rays at once, so in float64: in float32 thick rays would take the digits of those after them.
        inclusive = torch.cumsum(thickness, 0, dtype=torch.float64)
        before = torch.cat([inclusive.new_zeros(1), inclusive])[first]
        return torch.exp(-(inclusive - thickness - before[ray])).to(thickness.dtype)

    thickness = density * dt
    with torch.no_grad():
        reached = transmittance_of(thickness) >= LEAST_TRANSMITTANCE
    thickness = torch.where(reached, thickness, torch.zeros_like(thickness))
    transmittance = transmittance_of(thickness)
    weight = transmittance * (1 - torch.exp(-thickness))
    zeros = background.new_zeros(rays)
    last = torch.exp(-zeros.index_add(0, ray, thickness))
    rgb = torch.zeros_like(background).index_add(0, ray, weight[:, None] * colour)
    depth = zeros.index_add(0, ray, weight * t) / (1 - last).clamp(min=1e-6)
    return rgb + last[:, None] * background, 1 - last, depth
