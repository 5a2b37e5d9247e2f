"""Evaluating and compositing the samples of many rays in Numba, segment by segment.

A segment is a run of whole rays, so it composites its own samples while they are in cache and its sums do not depend
on which worker takes it: results are the same bits for any number of threads. Behind the first sample that less than
`LEAST_TRANSMITTANCE` of the light reaches, a ray has ended (`reference.composite`); what is left of a segment's samples
is kept without gaps from the segment's first sample on: `kept` holds their indices, and arrays called kept_* their
values. The backward pass is in `segments_backward`.
"""

from __future__ import annotations

import numpy as np

from biresnerf.field.cpu.matrix_blocks import BLOCK, STRIDE, copy_in, copy_out, exponential, gather_in
from biresnerf.field.cpu.network import (
    COLOUR_INPUTS,
    HIDDEN,
    OUT,
    VIEW,
    colours_of,
    density_of,
    hidden_colours,
    outputs_of,
    view_in,
)
from biresnerf.field.cpu.vector_access import KERNEL, PARALLEL_KERNEL, load, next_task, store
from biresnerf.field.numba_kernels import njit, prange
from biresnerf.field.reference import operations

f4, i4 = np.float32, np.int32
ONE = f4(1)
LEAST_TRANSMITTANCE = f4(operations.LEAST_TRANSMITTANCE)


@njit(**KERNEL)
def _densities(features, width, begin, end, dt, w1, w2, x, h1, z, outputs, density, alpha):
    """Outputs [16 total] of the first network, density and opacity of samples [begin, end)."""
    total = density.shape[0]
    for i in range(begin, end, BLOCK):
        n = min(BLOCK, end - i)
        copy_in(features, x, width, total, i, n)
        outputs_of(x, width, n, w1, w2, h1, z)
        copy_out(z, outputs, OUT, total, i, n)
        for t in range(n):
            sigma = density_of(load(z, t))
            store(density, i + t, sigma)
            store(alpha, i + t, ONE - exponential(-sigma * load(dt, i + t)))


@njit(**KERNEL)
def _keep_visible(first, last, offset, alpha, kept, kept_begin, kept_end):
    """Indices of the samples that light comes through to; where each ray's lie. Returns the end of the segment's."""
    at = offset[first]
    for r in range(first, last):
        transmittance = ONE
        kept_begin[r] = at
        for i in range(offset[r], offset[r + 1]):
            if transmittance < LEAST_TRANSMITTANCE:
                break
            kept[at] = i
            at += 1
            transmittance *= ONE - alpha[i]
        kept_end[r] = at
    return at


@njit(**KERNEL)
def _composite(
    first, last, kept_begin, kept_end, kept, t, alpha, colour, background, out_colour, out_opacity, out_depth
):
    """Quadrature of the volume rendering integral (Max 1995; Mildenhall et al. 2020, eq. 3)."""
    total = alpha.shape[0]
    for r in range(first, last):
        transmittance, c0, c1, c2, depth = ONE, f4(0), f4(0), f4(0), f4(0)
        for p in range(kept_begin[r], kept_end[r]):
            i = kept[p]
            weight = transmittance * alpha[i]
            c0 += weight * colour[p]
            c1 += weight * colour[total + p]
            c2 += weight * colour[2 * total + p]
            depth += weight * t[i]
            transmittance *= ONE - alpha[i]
        out_colour[r, 0] = c0 + transmittance * background[r, 0]
        out_colour[r, 1] = c1 + transmittance * background[r, 1]
        out_colour[r, 2] = c2 + transmittance * background[r, 2]
        out_opacity[r] = ONE - transmittance
        out_depth[r] = depth / max(ONE - transmittance, f4(1e-6))


@njit(**PARALLEL_KERNEL)
def render_segments(
    segment, offset, t, dt, ray, features, width, view, background, weights,
    composited, out_colour, out_opacity, out_depth, counter, workers,
):  # fmt: skip
    """Colour [rays, 3], opacity and depth [rays] of samples ordered by ray.

    Segment s holds rays segment[s]:segment[s + 1], ray r the samples offset[r]:offset[r + 1]; features [width n],
    view [rays 16] harmonics, `weights` the five layers. Fills `composited` for the backward pass.
    """
    w1, w2, w3, w4, w5 = weights
    outputs, density, alpha, kept, kept_begin, kept_end, colour = composited
    total = density.shape[0]
    for _ in prange(workers):
        x, h1 = np.empty(width * STRIDE, f4), np.empty(HIDDEN * STRIDE, f4)
        z, h3 = np.empty(COLOUR_INPUTS * STRIDE, f4), np.empty(HIDDEN * STRIDE, f4)
        h4, out = np.empty(HIDDEN * STRIDE, f4), np.empty(4 * STRIDE, f4)
        s = next_task(counter)
        while s < segment.shape[0] - 1:
            first, last = segment[s], segment[s + 1]
            begin = offset[first]
            _densities(features, width, begin, offset[last], dt, w1, w2, x, h1, z, outputs, density, alpha)
            end = _keep_visible(first, last, offset, alpha, kept, kept_begin, kept_end)
            for p in range(begin, end, BLOCK):
                n = min(BLOCK, end - p)
                view_in(view, ray, kept, p, n, z)
                gather_in(outputs, z[VIEW * STRIDE :], OUT, total, kept, p, n)
                hidden_colours(z, n, w3, w4, h3, h4)
                colours_of(h4, n, w5, out)
                copy_out(out, colour, 3, total, p, n)
            _composite(
                first, last, kept_begin, kept_end, kept, t, alpha, colour, background,
                out_colour, out_opacity, out_depth,
            )  # fmt: skip
            s = next_task(counter)
