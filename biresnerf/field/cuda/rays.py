"""Ray marching through the occupancy grid, compositing and gradients to rays, in Triton.

The definitions are in `field.reference.operations`. Rays live in the unit frame, positions in [0, 1]. Every sum over
the samples of a ray is taken by one program in a fixed order.
"""

from __future__ import annotations

import triton
import triton.language as tl

from biresnerf.field.cuda.access import load_vector, store_vector
from biresnerf.field.reference import operations

LEAST, EDGE = tl.constexpr(operations.LEAST_TRANSMITTANCE), tl.constexpr(operations.EDGE)
OPAQUE = tl.constexpr(100.0)  # e^-100 is 0 in float32; larger numbers would cost the sums their last digits


@triton.jit
def _contraction(px, py, pz, UNBOUNDED: tl.constexpr):
    """The factor that contracts a point to [-0.5, 0.5]^3, and its largest coordinate m."""
    m = tl.maximum(tl.abs(px), tl.maximum(tl.abs(py), tl.abs(pz)))
    factor = m * 0.0 + 0.5
    if UNBOUNDED:
        outside = tl.maximum(m, 1.0)
        factor = (2.0 - 1.0 / outside) / outside * 0.25
    return factor, m


@triton.jit
def _length(px, py, pz, step, UNBOUNDED: tl.constexpr):
    """Length of the interval that starts at a point."""
    outside = tl.maximum(tl.maximum(tl.abs(px), tl.maximum(tl.abs(py), tl.abs(pz))), 1.0)
    return step * outside * outside if UNBOUNDED else outside * 0.0 + step


@triton.jit
def _cell(v, side):
    return tl.minimum(tl.maximum((v * side).to(tl.int32), 0), side - 1)


@triton.jit
def _inside(v):
    """A coordinate of [-0.5, 0.5] as one strictly inside [0, 1]."""
    return tl.minimum(tl.maximum(v + 0.5, EDGE), 1.0 - EDGE)


@triton.jit
def _axis(o, d, t, t_end):
    """Narrow [t, t_end] to where a ray is within [-1, 1] of one axis."""
    d = tl.where(tl.abs(d) < 1e-9, 1e-9, d)
    ta, tb = (-1.0 - o) / d, (1.0 - o) / d
    return tl.maximum(t, tl.minimum(ta, tb)), tl.minimum(t_end, tl.maximum(ta, tb))


@triton.jit
def march(
    origin, direction, jitter, occupied, ray_count, interval, near, far, middle, length, count, side, most,
    ray_capacity, UNBOUNDED: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Live intervals, middle and length [rays, most], and how many a ray has, count [rays]; a thread per ray."""
    r = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    here = r < tl.load(ray_count).to(tl.int32)
    ox, oy, oz = load_vector(origin + 3 * r, 1, here)
    dx, dy, dz = load_vector(direction + 3 * r, 1, here)
    step = tl.load(interval)
    t = ox * 0.0 + tl.load(near)
    t_end = ox * 0.0 + tl.load(far)
    if not UNBOUNDED:
        t, t_end = _axis(ox, dx, t, t_end)
        t, t_end = _axis(oy, dy, t, t_end)
        t, t_end = _axis(oz, dz, t, t_end)
    # A random start within the first interval decorrelates the rays.
    shift = tl.load(jitter + r, mask=here, other=0.0)
    shift = shift * _length(ox + t * dx, oy + t * dy, oz + t * dz, step, UNBOUNDED)
    t = tl.where(t < t_end, t + shift, t)
    n = tl.zeros([BLOCK], tl.int32)
    active = here & (t < t_end)
    row = r.to(tl.int64) * most
    while tl.max(active.to(tl.int32), 0) > 0:
        dt = _length(ox + t * dx, oy + t * dy, oz + t * dz, step, UNBOUNDED)
        at = t + 0.5 * dt
        px, py, pz = ox + at * dx, oy + at * dy, oz + at * dz
        factor, _m = _contraction(px, py, pz, UNBOUNDED)
        ix = _cell(px * factor + 0.5, side)
        iy = _cell(py * factor + 0.5, side)
        iz = _cell(pz * factor + 0.5, side)
        active = active & (at < t_end)
        live = tl.load(occupied + (iz * side + iy) * side + ix, mask=active, other=0) != 0
        tl.store(middle + row + n, at, mask=live)
        tl.store(length + row + n, dt, mask=live)
        n += live.to(tl.int32)
        t = tl.where(active, t + dt, t)
        active = active & (t < t_end) & (n < most)
    tl.store(count + r, n, mask=r < ray_capacity)


@triton.jit
def _span(ray_offset, r, capacity):
    """Samples [begin, end) of ray r; a ray whose samples do not all fit the buffers has none."""
    begin, end = tl.load(ray_offset + r), tl.load(ray_offset + r + 1)
    return begin, tl.where(end <= capacity, end, begin)


@triton.jit
def pack(
    origin, direction, middle, length, ray_offset, ray_count, taken, x, t, dt, ray, most, capacity,
    UNBOUNDED: tl.constexpr, CHUNK: tl.constexpr,
):  # fmt: skip
    """The intervals one after another: x [3, capacity] grid positions of their samples, t, dt, ray; one ray each.

    The last ray that fits writes the number of samples, `taken` [1] (zero before).
    """
    r = tl.program_id(0)
    rays = tl.load(ray_count).to(tl.int32)
    if r >= rays:
        return
    begin, end = _span(ray_offset, r, capacity)
    ox, oy, oz = load_vector(origin + 3 * r, 1, True)
    dx, dy, dz = load_vector(direction + 3 * r, 1, True)
    row = r.to(tl.int64) * most
    for first in range(begin, end, CHUNK):
        i = first + tl.arange(0, CHUNK)
        here = i < end
        at = tl.load(middle + row + (i - begin), mask=here, other=0.0)
        px, py, pz = ox + at * dx, oy + at * dy, oz + at * dz
        factor, _m = _contraction(px, py, pz, UNBOUNDED)
        store_vector(x + i, capacity, _inside(px * factor), _inside(py * factor), _inside(pz * factor), here)
        tl.store(t + i, at, mask=here)
        tl.store(dt + i, tl.load(length + row + (i - begin), mask=here, other=0.0), mask=here)
        tl.store(ray + i, r, mask=here)
    full = tl.load(ray_offset + r + 1) > capacity
    next_full = tl.load(ray_offset + r + 2, mask=r + 1 < rays, other=capacity + 1) > capacity
    if (full == 0) & next_full:
        tl.store(taken, end)


@triton.jit
def _weights(density, dt, i, here, before):
    """Length and optical thickness of samples i, thickness up to their ends, whether light reaches them, and weights.

    `before` is the thickness in front of the first one.
    """
    length = tl.load(dt + i, mask=here, other=0.0)
    thickness = tl.minimum(tl.load(density + i, mask=here, other=0.0) * length, OPAQUE)
    inclusive = before + tl.cumsum(thickness, 0)
    transmittance = tl.exp(thickness - inclusive)
    reached = transmittance >= LEAST
    return (
        length,
        thickness,
        inclusive,
        reached,
        tl.where(reached, transmittance * (1.0 - tl.exp(-thickness)), 0.0),
    )


@triton.jit
def composite(
    ray_offset, t, dt, density, colour, background, ray_count, ray_colour, opacity, depth, capacity,
    CHUNK: tl.constexpr,
):  # fmt: skip
    """Quadrature of the volume rendering integral (Mildenhall et al. 2020, eq. 3) over packed samples, a ray each."""
    r = tl.program_id(0)
    if r >= tl.load(ray_count).to(tl.int32):
        return
    begin, end = _span(ray_offset, r, capacity)
    c0 = tl.zeros([CHUNK], tl.float32)
    c1, c2, distance = c0, c0, c0
    before = tl.sum(c0, 0)  # thickness in front of the chunk
    taken_in = before  # and of the samples that light reaches
    for first in range(begin, end, CHUNK):
        i = first + tl.arange(0, CHUNK)
        here = i < end
        _length, thickness, _inclusive, reached, weight = _weights(density, dt, i, here, before)
        q0, q1, q2 = load_vector(colour + i, capacity, here)
        c0, c1, c2 = c0 + weight * q0, c1 + weight * q1, c2 + weight * q2
        distance += weight * tl.load(t + i, mask=here, other=0.0)
        before += tl.sum(thickness, 0)
        taken_in += tl.sum(tl.where(reached, thickness, 0.0), 0)
    last = tl.exp(-taken_in)
    b0, b1, b2 = load_vector(background + 3 * r, 1, True)
    c0, c1, c2 = tl.sum(c0, 0) + last * b0, tl.sum(c1, 0) + last * b1, tl.sum(c2, 0) + last * b2
    store_vector(ray_colour + 3 * r, 1, c0, c1, c2, True)
    tl.store(opacity + r, 1.0 - last)
    tl.store(depth + r, tl.sum(distance, 0) / tl.maximum(1.0 - last, 1e-6))


@triton.jit
def composite_backward(
    ray_offset, dt, density, colour, ray_count, ray_colour, opacity, g_ray_colour, g_opacity, g_density, g_colour,
    capacity, CHUNK: tl.constexpr,
):  # fmt: skip
    """Gradients to density and sample colour from those of the rays' colour and opacity, a ray each."""
    r = tl.program_id(0)
    if r >= tl.load(ray_count).to(tl.int32):
        return
    begin, end = _span(ray_offset, r, capacity)
    g0, g1, g2 = load_vector(g_ray_colour + 3 * r, 1, True)
    c0, c1, c2 = load_vector(ray_colour + 3 * r, 1, True)
    # The colour behind the current sample, background included, times the colour's gradient.
    behind = g0 * c0 + g1 * c1 + g2 * c2
    through = tl.load(g_opacity + r) * (1.0 - tl.load(opacity + r))
    before = behind * 0.0
    for first in range(begin, end, CHUNK):
        i = first + tl.arange(0, CHUNK)
        here = i < end
        length, thickness, inclusive, reached, weight = _weights(density, dt, i, here, before)
        q0, q1, q2 = load_vector(colour + i, capacity, here)
        q = g0 * q0 + g1 * q1 + g2 * q2
        later = behind - tl.cumsum(weight * q, 0)
        g = tl.where(reached, length * (tl.exp(-inclusive) * q - later + through), 0.0)
        tl.store(g_density + i, g, mask=here)
        store_vector(g_colour + i, capacity, weight * g0, weight * g1, weight * g2, here)
        behind -= tl.sum(weight * q, 0)
        before += tl.sum(thickness, 0)


@triton.jit
def ray_gradients(
    origin, direction, ray_offset, ray_count, t, g_x, g_view, g_origin, g_direction, g_harmonics, capacity,
    UNBOUNDED: tl.constexpr, CHUNK: tl.constexpr,
):  # fmt: skip
    """Sum the samples' gradients to grid positions g_x [3, n] and view harmonics g_view [16, n] into their rays."""
    r = tl.program_id(0)
    if r >= tl.load(ray_count).to(tl.int32):
        return
    begin, end = _span(ray_offset, r, capacity)
    ox, oy, oz = load_vector(origin + 3 * r, 1, True)
    dx, dy, dz = load_vector(direction + 3 * r, 1, True)
    lane, k = tl.arange(0, CHUNK), tl.arange(0, 16)
    a0 = tl.zeros([CHUNK], tl.float32)
    a1, a2, b0, b1, b2 = a0, a0, a0, a0, a0
    harmonics = tl.zeros([16], tl.float32)
    for first in range(begin, end, CHUNK):
        i = first + lane
        here = i < end
        at = tl.load(t + i, mask=here, other=0.0)
        u, v, w = load_vector(g_x + i, capacity, here)
        px, py, pz = ox + at * dx, oy + at * dy, oz + at * dz
        factor, m = _contraction(px, py, pz, UNBOUNDED)
        if UNBOUNDED:
            # y = f(m) x, f = (2 - 1/m)/m: J^T g = f g + f'(m) sign(x_k) (x . g) e_k, k the largest axis.
            inverse = 1.0 / tl.maximum(m, 1.0)
            along = 0.25 * (2.0 * inverse - 2.0) * inverse * inverse * (px * u + py * v + pz * w)
            first_axis = tl.abs(px) == m
            second_axis = (tl.abs(py) == m) & (first_axis == 0)
            third_axis = (first_axis == 0) & (second_axis == 0)
            u = factor * u + tl.where(first_axis, tl.where(px > 0, along, -along), 0.0)
            v = factor * v + tl.where(second_axis, tl.where(py > 0, along, -along), 0.0)
            w = factor * w + tl.where(third_axis, tl.where(pz > 0, along, -along), 0.0)
        else:
            u, v, w = factor * u, factor * v, factor * w
        a0, a1, a2 = a0 + u, a1 + v, a2 + w
        b0, b1, b2 = b0 + at * u, b1 + at * v, b2 + at * w
        tile = tl.load(g_view + k[:, None] * capacity + i[None, :], mask=here[None, :], other=0.0)
        harmonics += tl.sum(tile, 1)
    store_vector(g_origin + 3 * r, 1, tl.sum(a0, 0), tl.sum(a1, 0), tl.sum(a2, 0), True)
    store_vector(g_direction + 3 * r, 1, tl.sum(b0, 0), tl.sum(b1, 0), tl.sum(b2, 0), True)
    tl.store(g_harmonics + 16 * r + k, harmonics)
