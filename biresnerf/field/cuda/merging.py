"""Merging the intervals of rays that give little light, in Triton.

The definition is `field.reference.operations.merge`.
"""

from __future__ import annotations

import triton
import triton.language as tl

from biresnerf.field.reference import operations

GAP, LEAST = tl.constexpr(operations.GAP), tl.constexpr(operations.LEAST_TRANSMITTANCE)


@triton.jit
def _close(middle, length, at, begin, end, members, share, here):
    """Write the interval that a run of `members` from `begin` to `end` becomes."""
    tl.store(middle + at, begin + tl.where(members == 1, 0.5, share) * (end - begin), mask=here)
    tl.store(length + at, end - begin, mask=here)


@triton.jit
def merge(
    density, jitter, ray_offset, ray_count, merged_light, merged_most, middle, length, count, most, capacity,
    ray_capacity, BLOCK: tl.constexpr,
):  # fmt: skip
    """Replace the intervals of each ray by the merged ones; a thread per ray.

    A ray whose samples do not all fit the buffers, so that their densities are not known, is left without any.
    """
    r = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    here = r < tl.load(ray_count).to(tl.int32)
    first = tl.load(ray_offset + r, mask=here, other=0)
    last = tl.load(ray_offset + r + 1, mask=here, other=0)
    n = tl.where(last <= capacity, last - first, 0)
    share = tl.load(jitter + r, mask=here, other=0.0)
    light_most, run_most = tl.load(merged_light), tl.load(merged_most).to(tl.int32)
    row = r.to(tl.int64) * most
    k, kept, members = tl.zeros([BLOCK], tl.int32), tl.zeros([BLOCK], tl.int32), tl.zeros([BLOCK], tl.int32)
    light, begin, end = share * 0.0, share * 0.0, share * 0.0
    transmittance = share * 0.0 + 1.0
    active = here & (k < n)
    while tl.max(active.to(tl.int32), 0) > 0:
        t = tl.load(middle + row + k, mask=active, other=0.0)
        dt = tl.load(length + row + k, mask=active, other=0.0)
        left = transmittance * tl.exp(-tl.load(density + first + k, mask=active, other=0.0) * dt)
        given = transmittance - left
        ends = (t - 0.5 * dt - end > dt * GAP) | (light + given > light_most) | (members == run_most)
        ends = active & ends & (members > 0)
        _close(middle, length, row + kept, begin, end, members, share, ends)
        kept += ends.to(tl.int32)
        begins = active & (ends | (members == 0))
        begin = tl.where(begins, t - 0.5 * dt, begin)
        light = tl.where(begins, given, light + tl.where(active, given, 0.0))
        members = tl.where(begins, 1, members + active.to(tl.int32))
        end = tl.where(active, t + 0.5 * dt, end)
        transmittance = tl.where(active, left, transmittance)
        k += 1
        active = active & (k < n) & (transmittance >= LEAST)
    _close(middle, length, row + kept, begin, end, members, share, members > 0)
    tl.store(count + r, kept + (members > 0).to(tl.int32), mask=r < ray_capacity)
