"""Ray marching through the occupancy grid, and merging of intervals that give little light, in Numba.

The definitions are in `field.reference.operations`. Rays live in the unit frame; the encoding sees positions in
[0, 1]: (x + 1) / 2 when the scene is bounded, (contract(x) + 2) / 4 when it is not.
"""

from __future__ import annotations

import numpy as np

from biresnerf.field.cpu.matrix_blocks import exponential
from biresnerf.field.cpu.vector_access import KERNEL, PARALLEL_KERNEL
from biresnerf.field.numba_kernels import njit, prange
from biresnerf.field.reference import operations

f4, i4 = np.float32, np.int32
ONE, TWO, HALF = f4(1), f4(2), f4(0.5)
BLOCK = 4  # cells a side that are passed at once where all are empty
FARTHEST = 8  # blocks
SAFETY = f4(1e-2)  # intervals: a midpoint that rounding puts beyond a face is looked at
GAP, LEAST_TRANSMITTANCE = f4(operations.GAP), f4(operations.LEAST_TRANSMITTANCE)
EDGE = f4(operations.EDGE)  # keeps grid positions strictly inside [0, 1)
_LARGEST_BITS = np.array(ONE - EDGE, f4).view(np.uint32)


@njit(inline="always", fastmath=True)
def _largest(px, py, pz):
    return max(abs(px), max(abs(py), abs(pz)))


@njit(inline="always", fastmath=True)
def _grid_position(px, py, pz, unbounded):
    """Position in [0, 1]^3. A bounded scene must not pay for the divisions of an unbounded one."""
    factor = HALF
    if unbounded:
        m = _largest(px, py, pz)
        factor = f4(0.25) * (ONE if m <= ONE else (TWO - ONE / m) / m)
    return px * factor + HALF, py * factor + HALF, pz * factor + HALF


@njit(inline="always", fastmath=True)
def _inside(v):
    return min(max(v, EDGE), ONE - EDGE)


def clearances(occupied):
    """Distance of each block from the nearest that is not empty, in blocks: uint8 [b, b, b] for cells [side] * 3.

    Distances count diagonal neighbours, and end at `FARTHEST`. A block has `BLOCK` cells a side, one if they do not
    divide the grid.
    """
    side = occupied.shape[0]
    block = BLOCK if side % BLOCK == 0 else 1
    distance = np.full((side // block,) * 3, FARTHEST, np.uint8)
    _mark_occupied(occupied, block, distance)
    # Two passes, from either end, carry distances to all blocks (Rosenfeld and Pfaltz 1966).
    _carry_distances(distance)
    _carry_distances(distance[::-1, ::-1, ::-1])
    return distance


@njit(**KERNEL)
def _mark_occupied(occupied, block, distance):
    """Zero the distance of blocks with an occupied cell."""
    for z in range(occupied.shape[0]):
        for y in range(occupied.shape[1]):
            row, cells = distance[z // block, y // block], occupied[z, y]
            for b in range(row.shape[0]):
                for x in range(b * block, (b + 1) * block):
                    if cells[x]:
                        row[b] = 0


@njit(**KERNEL)
def _carry_distances(distance):
    """No block is farther than one more than its neighbours before it, in the order of memory or its reverse."""
    blocks = distance.shape[0]
    for z in range(blocks):
        for y in range(blocks):
            for x in range(blocks):
                least = distance[z, y, x]
                for at in range(13):
                    u, v, w = z + at // 9 - 1, y + at // 3 % 3 - 1, x + at % 3 - 1
                    if u >= 0 and 0 <= v < blocks and 0 <= w < blocks:
                        least = min(least, distance[u, v, w] + 1)
                distance[z, y, x] = least


@njit(inline="always", fastmath=True)
def _entering(o, inverse):
    """Where a ray enters the slab -1..1 along one axis."""
    return (-ONE - o) * inverse if inverse > f4(0) else (ONE - o) * inverse


@njit(inline="always", fastmath=True)
def _leaving(o, inverse, low, high):
    """Where a ray leaves the slab low..high along one axis."""
    return (high - o) * inverse if inverse > f4(0) else (low - o) * inverse


@njit(inline="always", fastmath=True)
def _leaving_blocks(o, inverse, b, empty, middle, size):
    """Where a ray leaves block b and its `empty` - 1 neighbours on either side, along one axis."""
    return _leaving(o, inverse, (f4(b - empty + 1) - middle) * size, (f4(b + empty) - middle) * size)


@njit(inline="always", fastmath=True)
def _inverse(d):
    return ONE / d if abs(d) >= f4(1e-9) else f4(1e9)


@njit(**PARALLEL_KERNEL)
def march(
    origin, direction, jitter, occupied, side, clearance, step, near, far, unbounded, t_buffer, dt_buffer, count
):  # fmt: skip
    """Middle and length of the live intervals of each ray: t_buffer, dt_buffer [rays, most], count [rays].

    Intervals are `step` long, growing as m^2 outside the inner box (even in contracted space, along rays from its
    centre); one is live if the cell of its midpoint is. Within the inner box, where rays are straight and intervals
    even, those in empty blocks are passed at once (`clearances`).
    """
    most, blocks = t_buffer.shape[1], clearance.shape[0]
    block, centre, size = side // blocks, f4(0.5) * f4(blocks), (f4(4) if unbounded else TWO) / f4(blocks)
    for r in prange(origin.shape[0]):
        ox, oy, oz = origin[r, 0], origin[r, 1], origin[r, 2]
        dx, dy, dz = direction[r, 0], direction[r, 1], direction[r, 2]
        vx, vy, vz = _inverse(dx), _inverse(dy), _inverse(dz)
        leaving = min(_leaving(ox, vx, -ONE, ONE), _leaving(oy, vy, -ONE, ONE), _leaving(oz, vz, -ONE, ONE))
        t, t_end = near, far
        if not unbounded:
            entering = max(_entering(ox, vx), _entering(oy, vy), _entering(oz, vz))
            t, t_end = max(t, entering), min(t_end, leaving)
        n = 0
        first = True
        while t < t_end and n < most:
            dt, m = step, f4(0)
            if unbounded:
                m = _largest(ox + t * dx, oy + t * dy, oz + t * dz)
                if m > ONE:
                    dt = step * m * m
            if first:  # a random start within the first interval decorrelates the rays
                t += jitter[r] * dt
                first = False
                continue
            middle = t + f4(0.5) * dt
            if middle >= t_end:
                break
            gx, gy, gz = _grid_position(ox + middle * dx, oy + middle * dy, oz + middle * dz, unbounded)
            ix = min(max(i4(gx * side), 0), side - 1)
            iy = min(max(i4(gy * side), 0), side - 1)
            iz = min(max(i4(gz * side), 0), side - 1)
            if occupied[(iz * side + iy) * side + ix]:
                t_buffer[r, n] = middle
                dt_buffer[r, n] = dt
                n += 1
                t += dt
                continue
            bx, by, bz = ix // block, iy // block, iz // block
            empty = i4(clearance[bz, by, bx])
            if empty == 0 or (unbounded and m > ONE):
                t += dt
                continue
            until = min(
                min(leaving, t_end),
                _leaving_blocks(ox, vx, bx, empty, centre, size),
                _leaving_blocks(oy, vy, by, empty, centre, size),
                _leaving_blocks(oz, vz, bz, empty, centre, size),
            )
            t += dt * f4(max(i4((until - middle) / step - SAFETY) + 1, 1))
        count[r] = n


@njit(**PARALLEL_KERNEL)
def pack(origin, direction, t_buffer, dt_buffer, count, offset, unbounded, x, t, dt, ray):
    """The intervals of all rays one after another: x [3 n] grid positions of samples, t, dt, ray [n]."""
    for r in prange(origin.shape[0]):
        base = offset[r]
        for k in range(count[r]):
            i = base + k
            at = t_buffer[r, k]
            gx, gy, gz = _grid_position(
                origin[r, 0] + at * direction[r, 0],
                origin[r, 1] + at * direction[r, 1],
                origin[r, 2] + at * direction[r, 2],
                unbounded,
            )
            x[3 * i], x[3 * i + 1], x[3 * i + 2] = _inside(gx), _inside(gy), _inside(gz)
            t[i], dt[i], ray[i] = at, dt_buffer[r, k], r


def bring_inside(x):
    """Replaces positions [3 n] that are not finite by the grid's edge, in place: tables are read without bounds checks.

    As unsigned numbers, positive floats keep their order, and negative or non-finite ones are larger.
    """
    bits = x.view(np.uint32)
    np.minimum(bits, _LARGEST_BITS, out=bits)


@njit(**PARALLEL_KERNEL)
def merge(density, offset, jitter, light_most, run_most, t_buffer, dt_buffer, count):
    """Replace the intervals of each ray in t_buffer, dt_buffer and count by the merged ones.

    density [n] is of the intervals one after another, those of ray r from offset[r] on.
    """
    for r in prange(count.shape[0]):
        kept, members = 0, 0
        transmittance, light, begin, end = ONE, f4(0), f4(0), f4(0)
        for k in range(count[r]):
            if transmittance < LEAST_TRANSMITTANCE:
                break
            t, dt = t_buffer[r, k], dt_buffer[r, k]
            left = transmittance * exponential(-density[offset[r] + k] * dt)
            given, transmittance = transmittance - left, left
            apart = t - HALF * dt - end > GAP * dt
            if members > 0 and (apart or light + given > light_most or members == run_most):
                t_buffer[r, kept] = begin + (HALF if members == 1 else jitter[r]) * (end - begin)
                dt_buffer[r, kept] = end - begin
                kept += 1
                members, light = 0, f4(0)
            if members == 0:
                begin = t - HALF * dt
            end = t + HALF * dt
            light += given
            members += 1
        if members > 0:
            t_buffer[r, kept] = begin + (HALF if members == 1 else jitter[r]) * (end - begin)
            dt_buffer[r, kept] = end - begin
            kept += 1
        count[r] = kept
