"""Merging the intervals of rays that give little light, in Numba.

The definition is `field.reference.operations.merge`.
"""

from __future__ import annotations

import numpy as np
from numba import njit, prange

from biresnerf.field.cpu.matrix_blocks import exponential
from biresnerf.field.cpu.vector_access import PARALLEL_KERNEL
from biresnerf.field.reference import operations

f4 = np.float32
ONE, HALF = f4(1), f4(0.5)
GAP, LEAST_TRANSMITTANCE = f4(operations.GAP), f4(operations.LEAST_TRANSMITTANCE)


@njit(**PARALLEL_KERNEL)
def merge(density, offset, jitter, light_most, run_most, t_buffer, dt_buffer, count):
    """Put the merged intervals of each ray in the place of its intervals in t_buffer, dt_buffer and count.

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
