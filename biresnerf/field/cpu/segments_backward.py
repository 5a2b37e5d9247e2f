"""The backward pass of `segments`: gradients to weights, features, positions and view harmonics, in Numba."""

from __future__ import annotations

import numpy as np

from biresnerf.field.cpu.matrix_blocks import BLOCK, STRIDE, copy_out, gather_in, rectified_product, zero_rest
from biresnerf.field.cpu.network import (
    COLOUR_INPUTS,
    DENSITY_CAP,
    DENSITY_SHIFT,
    HIDDEN,
    OUT,
    VIEW,
    colour_backward,
    hidden_colours,
    outputs_backward,
    view_in,
)
from biresnerf.field.cpu.vector_access import KERNEL, PARALLEL_KERNEL, load, next_task, reload, store
from biresnerf.field.numba_kernels import njit, prange

f4 = np.float32
ONE = f4(1)
# Smaller gradients of a sample count as zero: they do not affect Adam, and processors take many times as long for
# products that are too small for a float's full precision, as those of empty space and of black become.
FAINT = f4(1e-20)


@njit(inline="always")
def _empty_block(channels):
    return np.empty(channels * STRIDE, f4)


@njit(**KERNEL)
def _composite_backward(
    first, last, kept_begin, kept_end, kept, dt, alpha, colour, out_colour, out_opacity, g_colour, g_opacity, gd, gc
):  # fmt: skip
    """Gradients to density gd and colour gc [3 n] of the kept samples, from those to the rays' colour and opacity."""
    total = alpha.shape[0]
    for r in range(first, last):
        g0, g1, g2 = g_colour[r, 0], g_colour[r, 1], g_colour[r, 2]
        behind = g_opacity[r] * (ONE - out_opacity[r])
        transmittance = ONE
        # The colour behind the current sample: sum of w_j c_j over later samples, and the background.
        s0, s1, s2 = out_colour[r, 0], out_colour[r, 1], out_colour[r, 2]
        for p in range(kept_begin[r], kept_end[r]):
            i = kept[p]
            weight = transmittance * alpha[i]
            q0, q1, q2 = colour[p], colour[total + p], colour[2 * total + p]
            s0 -= weight * q0
            s1 -= weight * q1
            s2 -= weight * q2
            gc[p], gc[total + p], gc[2 * total + p] = weight * g0, weight * g1, weight * g2
            transmittance *= ONE - alpha[i]
            gd[p] = dt[i] * (
                g0 * (transmittance * q0 - s0)
                + g1 * (transmittance * q1 - s1)
                + g2 * (transmittance * q2 - s2)
                + behind
            )


@njit(**KERNEL)
def _logit_gradients(begin, n, colour, gc, total, g_out):
    """The gradient through the colours' sigmoid."""
    for c in range(3):
        for t in range(n):
            v = load(colour, c * total + begin + t)
            g = load(gc, c * total + begin + t) * v * (ONE - v)
            store(g_out, c * STRIDE + t, g if abs(g) > FAINT else f4(0))
    zero_rest(g_out, 3, n)


@njit(**KERNEL)
def _add_density_gradient(begin, n, kept, outputs, density, gd, g):
    """Add the gradient through the exponential to that of the first output."""
    for t in range(n):
        i = kept[begin + t]
        if outputs[i] - DENSITY_SHIFT < DENSITY_CAP:
            through = gd[begin + t] * density[i]
            if abs(through) > FAINT:
                g[t] += through


@njit(**KERNEL)
def _spread(block, channels, kept, begin, n, start, target, stride):
    """target[:channels, kept - start] = block[:channels, :n]."""
    first = kept[begin] - start
    if kept[begin + n - 1] - start - first == n - 1:
        for c in range(channels):
            for t in range(n):
                store(target, c * stride + first + t, load(block, c * STRIDE + t))
        return
    for c in range(channels):
        for t in range(n):
            target[c * stride + kept[begin + t] - start] = block[c * STRIDE + t]


@njit(**KERNEL)
def add_position_gradient(g, row, stride, jacobian, begin, count, factor, dx):
    """dx [3, count] (row stride `stride`) += factor J^T g over all levels, for samples from `begin` on.

    Nothing is added where the Jacobian [levels, 6, n] was not computed, [levels, 0, n].
    """
    if factor == f4(0) or jacobian.shape[1] == 0:
        return
    for level in range(jacobian.shape[0]):
        j = jacobian[level]
        j0, j1, j2, j3, j4, j5 = j[0], j[1], j[2], j[3], j[4], j[5]
        at = (row + 2 * level) * stride
        for k in range(count):
            i = begin + k
            u, v = factor * load(g, at + k), factor * load(g, at + stride + k)
            store(dx, k, reload(dx, k) + u * load(j0, i) + v * load(j3, i))
            m = stride + k
            store(dx, m, reload(dx, m) + u * load(j1, i) + v * load(j4, i))
            m = 2 * stride + k
            store(dx, m, reload(dx, m) + u * load(j2, i) + v * load(j5, i))


@njit(**KERNEL)
def _add_view_gradient(ga, ray, kept, begin, n, g_view):
    """Add the gradients of a block's view harmonics to those of their rays."""
    for t in range(n):
        r = ray[kept[begin + t]]
        for c in range(VIEW):
            g_view[r, c] += ga[c * STRIDE + t]


@njit(**KERNEL)
def _close_gaps(x, kept, begin, n):
    """Move the positions of kept samples to where their gradients lie."""
    for q in range(begin, begin + n):
        i = kept[q]
        x[3 * q], x[3 * q + 1], x[3 * q + 2] = x[3 * i], x[3 * i + 1], x[3 * i + 2]


@njit(**PARALLEL_KERNEL)
def render_segments_backward(
    segment, trained, longest, offset, dt, ray, features, width, view, weights, composited,
    out_colour, out_opacity, g_colour, g_opacity, jacobian, second_jacobian, second_share,
    x, gd, gc, g_features, dx, g_view, sums, counter, workers,
):  # fmt: skip
    """The backward pass of `render_segments`, from the gradients g_colour [rays, 3] and g_opacity [rays].

    Fills dx [3, n] (gradient to positions, zero where not kept) and g_view [rays, 16]. For the first `trained`
    segments also g_features [width n] and x [3 n], both kept, and adds to the segments' weight gradients `sums`,
    five of [segments, size]. No segment holds more than `longest` samples. The second grid's gradient to positions
    is scaled by `second_share`. gd [n] and gc [3 n] are scratch.
    """
    w1, w2, w3, w4, w5 = weights
    d1, d2, d3, d4, d5 = sums
    outputs, density, alpha, kept, kept_begin, kept_end, colour = composited
    total, rows = density.shape[0], 2 * jacobian.shape[0]
    for _ in prange(workers):
        h1, h3, h4 = _empty_block(HIDDEN), _empty_block(HIDDEN), _empty_block(HIDDEN)
        ga, gb = _empty_block(max(width, HIDDEN)), _empty_block(HIDDEN)
        z, g_out = _empty_block(COLOUR_INPUTS), np.zeros(4 * STRIDE, f4)
        f, spread = _empty_block(width), np.empty(width * longest, f4)
        d_position = np.empty(3 * longest, f4)
        s = next_task(counter)
        while s < segment.shape[0] - 1:
            first, last = segment[s], segment[s + 1]
            begin, count, end = offset[first], offset[last] - offset[first], kept_end[last - 1]
            learn = s < trained
            _composite_backward(
                first, last, kept_begin, kept_end, kept, dt, alpha, colour, out_colour, out_opacity,
                g_colour, g_opacity, gd, gc,
            )  # fmt: skip
            g_view[first:last] = f4(0)
            if end - begin < count:
                spread[:] = f4(0)
            for p in range(begin, end, BLOCK):
                n = min(BLOCK, end - p)
                gather_in(features, f, width, total, kept, p, n)
                rectified_product(w1, f, h1, HIDDEN, width, n)
                view_in(view, ray, kept, p, n, z)
                gather_in(outputs, z[VIEW * STRIDE :], OUT, total, kept, p, n)
                hidden_colours(z, n, w3, w4, h3, h4)
                _logit_gradients(p, n, colour, gc, total, g_out)
                colour_backward(g_out, z, h3, h4, n, w3, w4, w5, learn, d3[s], d4[s], d5[s], ga, gb)
                _add_view_gradient(ga, ray, kept, p, n, g_view)
                g = ga[VIEW * STRIDE :]
                _add_density_gradient(p, n, kept, outputs, density, gd, g)
                outputs_backward(g, f, h1, width, n, w1, w2, learn, d1[s], d2[s], ga, gb)
                _spread(ga, width, kept, p, n, begin, spread, longest)
                if learn:
                    copy_out(ga, g_features, width, total, p, n)
                    _close_gaps(x, kept, p, n)
            d_position[:] = f4(0)
            add_position_gradient(spread, 0, longest, jacobian, begin, count, ONE, d_position)
            add_position_gradient(
                spread, rows, longest, second_jacobian, begin, count, second_share, d_position
            )
            for a in range(3):
                dx[a, begin : begin + count] = d_position[a * longest : a * longest + count]
            s = next_task(counter)
