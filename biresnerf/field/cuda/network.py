"""The small networks in Triton: each block of samples goes through all layers without leaving the chip.

The definition is `field.reference.operations.network`. Weights stay in float32; products take TF32 inputs (10 bits of
mantissa, as float16, with float32's range, so that gradients need no scaling) and add up in float32. The backward
pass computes the activations again. Weight gradients are summed by a fixed number of programs, each over its own
blocks in order, and then over the programs in order: no atomics.
"""

from __future__ import annotations

import triton
import triton.language as tl

from biresnerf.field.cuda.access import sample_counts, samples_of_block
from biresnerf.field.reference import operations

DENSITY_SHIFT, DENSITY_CAP = tl.constexpr(operations.DENSITY_SHIFT), tl.constexpr(operations.DENSITY_CAP)
HIDDEN = tl.constexpr(64)
OUT = tl.constexpr(16)  # outputs of the density network, view harmonics, and the padded width of the colour


@triton.jit
def _weights(
    w, ROWS: tl.constexpr, ROW_PAD: tl.constexpr, COLUMNS: tl.constexpr, PAD: tl.constexpr, begin, stride
):
    """Columns begin... of a matrix w [ROWS, stride] as a tile [ROW_PAD, PAD], zero beyond."""
    o, k = tl.arange(0, ROW_PAD), tl.arange(0, PAD)
    inside = (o[:, None] < ROWS) & (k[None, :] < COLUMNS)
    return tl.load(w + o[:, None] * stride + begin + k[None, :], mask=inside, other=0.0)


@triton.jit
def _tile(features, row, i, here, capacity, COLUMNS: tl.constexpr, PAD: tl.constexpr):
    """Rows row... of features [width, capacity] at samples i as a tile [samples, PAD]."""
    k = tl.arange(0, PAD)
    at = (row + k).to(tl.int64)[None, :] * capacity + i[:, None]
    return tl.load(features + at, mask=here[:, None] & (k[None, :] < COLUMNS), other=0.0)


@triton.jit
def _store_tile(features, row, i, here, capacity, COLUMNS: tl.constexpr, PAD: tl.constexpr, values):
    k = tl.arange(0, PAD)
    at = (row + k).to(tl.int64)[None, :] * capacity + i[:, None]
    tl.store(features + at, values, mask=here[:, None] & (k[None, :] < COLUMNS))


@triton.jit
def _product(a, b, PRECISION: tl.constexpr):
    return tl.dot(a, b, input_precision=PRECISION, out_dtype=tl.float32)


@triton.jit
def _density_exponent(z):
    """The shifted first column of z [samples, 16]: density = exp(min(it, DENSITY_CAP))."""
    return tl.sum(tl.where(tl.arange(0, OUT)[None, :] == 0, z, 0.0), 1) - DENSITY_SHIFT


@triton.jit
def _first_layer(
    features, i, here, capacity, w1, columns, LOW: tl.constexpr, LOW_PAD: tl.constexpr, HIGH: tl.constexpr,
    HIGH_PAD: tl.constexpr, PRECISION: tl.constexpr,
):  # fmt: skip
    """Both modules' features of samples i, and the first hidden layer made of them; `high` is `low` without HIGH."""
    low = _tile(features, 0, i, here, capacity, LOW, LOW_PAD)
    high = low
    if HIGH > 0:
        high = _tile(features, LOW, i, here, capacity, HIGH, HIGH_PAD)
    h = _product(low, tl.trans(_weights(w1, HIDDEN, HIDDEN, LOW, LOW_PAD, 0, LOW)), PRECISION)
    if HIGH > 0:
        h += _product(high, tl.trans(_weights(columns, HIDDEN, HIDDEN, HIGH, HIGH_PAD, 0, HIGH)), PRECISION)
    return low, high, tl.maximum(h, 0.0)


@triton.jit
def _colour_layers(z, v, w3, w4, w5, PRECISION: tl.constexpr):
    """Hidden layers of the colour network and the colour [samples, 16], of which 3 count."""
    h3 = _product(v, tl.trans(_weights(w3, HIDDEN, HIDDEN, OUT, OUT, 0, 2 * OUT)), PRECISION)
    h3 += _product(z, tl.trans(_weights(w3, HIDDEN, HIDDEN, OUT, OUT, OUT, 2 * OUT)), PRECISION)
    h3 = tl.maximum(h3, 0.0)
    h4 = tl.maximum(
        _product(h3, tl.trans(_weights(w4, HIDDEN, HIDDEN, HIDDEN, HIDDEN, 0, HIDDEN)), PRECISION), 0.0
    )
    out = _product(h4, tl.trans(_weights(w5, 3, OUT, HIDDEN, HIDDEN, 0, HIDDEN)), PRECISION)
    return h3, h4, 1.0 / (1.0 + tl.exp(-out))


@triton.jit
def _view(view, ray, i, here):
    """The harmonics of each sample's ray, [samples, 16]."""
    r = tl.load(ray + i, mask=here, other=0)
    return tl.load(view + 16 * r[:, None] + tl.arange(0, OUT)[None, :], mask=here[:, None], other=0.0)


@triton.jit
def network_forward(
    features, view, ray, taken, w1, columns, w2, w3, w4, w5, outputs, density, colour, capacity,
    LOW: tl.constexpr, LOW_PAD: tl.constexpr, HIGH: tl.constexpr, HIGH_PAD: tl.constexpr,
    PRECISION: tl.constexpr, BLOCK: tl.constexpr, WITH_COLOUR: tl.constexpr,
):  # fmt: skip
    """Density [capacity] of `taken` samples; WITH_COLOUR also outputs [16, capacity] and colour [3, capacity]."""
    n = tl.load(taken)
    if tl.program_id(0) * BLOCK >= n:
        return
    i, here = samples_of_block(tl.program_id(0), n, BLOCK)
    _low, _high, h1 = _first_layer(
        features, i, here, capacity, w1, columns, LOW, LOW_PAD, HIGH, HIGH_PAD, PRECISION
    )
    z = _product(h1, tl.trans(_weights(w2, OUT, OUT, HIDDEN, HIDDEN, 0, HIDDEN)), PRECISION)
    tl.store(density + i, tl.exp(tl.minimum(_density_exponent(z), DENSITY_CAP)), mask=here)
    if WITH_COLOUR:
        _h3, _h4, rgb = _colour_layers(z, _view(view, ray, i, here), w3, w4, w5, PRECISION)
        _store_tile(outputs, 0, i, here, capacity, OUT, OUT, z)
        _store_tile(colour, 0, i, here, capacity, 3, OUT, rgb)


@triton.jit
def _store_sum(partial, values, ROWS: tl.constexpr, ROW_PAD: tl.constexpr, COLUMNS: tl.constexpr, PAD: tl.constexpr,
               begin, stride):  # fmt: skip
    """Columns begin... of a matrix [ROWS, stride] from a tile."""
    o, k = tl.arange(0, ROW_PAD), tl.arange(0, PAD)
    inside = (o[:, None] < ROWS) & (k[None, :] < COLUMNS)
    tl.store(partial + o[:, None] * stride + begin + k[None, :], values, mask=inside)


@triton.jit
def colour_backward(
    outputs, view, ray, taken, ray_offset, trained_rays, w3, w4, w5,
    g_density, g_colour, g_outputs, g_view, colour_sums, capacity, programs,
    PRECISION: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Gradients to the density network's outputs and to view, [16, capacity] each, and to w3, w4, w5.

    The latter are this program's share, colour_sums [programs, their numbers], from trained samples alone.
    """
    n, trained = sample_counts(taken, ray_offset, trained_rays)
    d3v = tl.zeros([HIDDEN, OUT], tl.float32)
    d3z = d3v
    d4 = tl.zeros([HIDDEN, HIDDEN], tl.float32)
    d5 = tl.zeros([OUT, HIDDEN], tl.float32)
    for block in range(tl.program_id(0), tl.cdiv(n, BLOCK), programs):
        i, here = samples_of_block(block, n, BLOCK)
        counts = (i < trained)[:, None]
        z = _tile(outputs, 0, i, here, capacity, OUT, OUT)
        v = _view(view, ray, i, here)
        h3, h4, rgb = _colour_layers(z, v, w3, w4, w5, PRECISION)
        g = _tile(g_colour, 0, i, here, capacity, 3, OUT) * rgb * (1.0 - rgb)
        d5 += _product(tl.trans(tl.where(counts, g, 0.0)), h4, PRECISION)
        g = tl.where(h4 > 0, _product(g, _weights(w5, 3, OUT, HIDDEN, HIDDEN, 0, HIDDEN), PRECISION), 0.0)
        d4 += _product(tl.trans(tl.where(counts, g, 0.0)), h3, PRECISION)
        g = _product(g, _weights(w4, HIDDEN, HIDDEN, HIDDEN, HIDDEN, 0, HIDDEN), PRECISION)
        g = tl.where(h3 > 0, g, 0.0)
        g_trained = tl.trans(tl.where(counts, g, 0.0))
        d3v += _product(g_trained, v, PRECISION)
        d3z += _product(g_trained, z, PRECISION)
        gv = _product(g, _weights(w3, HIDDEN, HIDDEN, OUT, OUT, 0, 2 * OUT), PRECISION)
        _store_tile(g_view, 0, i, here, capacity, OUT, OUT, gv)
        g = _product(g, _weights(w3, HIDDEN, HIDDEN, OUT, OUT, OUT, 2 * OUT), PRECISION)
        a = _density_exponent(z)
        slope = tl.where(a < DENSITY_CAP, tl.exp(tl.minimum(a, DENSITY_CAP)), 0.0)
        slope = slope * tl.load(g_density + i, mask=here, other=0.0)
        g += tl.where(tl.arange(0, OUT)[None, :] == 0, slope[:, None], 0.0)
        _store_tile(g_outputs, 0, i, here, capacity, OUT, OUT, g)
    out = colour_sums + tl.program_id(0) * (HIDDEN * 2 * OUT + HIDDEN * HIDDEN + 3 * HIDDEN)
    _store_sum(out, d3v, HIDDEN, HIDDEN, OUT, OUT, 0, 2 * OUT)
    _store_sum(out, d3z, HIDDEN, HIDDEN, OUT, OUT, OUT, 2 * OUT)
    out += HIDDEN * 2 * OUT
    _store_sum(out, d4, HIDDEN, HIDDEN, HIDDEN, HIDDEN, 0, HIDDEN)
    _store_sum(out + HIDDEN * HIDDEN, d5, 3, OUT, HIDDEN, HIDDEN, 0, HIDDEN)


@triton.jit
def density_backward(
    features, taken, ray_offset, trained_rays, w1, columns, w2, g_outputs, g_features, density_sums, capacity,
    programs, LOW: tl.constexpr, LOW_PAD: tl.constexpr, HIGH: tl.constexpr, HIGH_PAD: tl.constexpr,
    PRECISION: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Gradients to features [width, capacity] and, as in `colour_backward`, to w1, w2 and the columns."""
    n, trained = sample_counts(taken, ray_offset, trained_rays)
    d1 = tl.zeros([HIDDEN, LOW_PAD], tl.float32)
    d2 = tl.zeros([OUT, HIDDEN], tl.float32)
    d6 = tl.zeros([HIDDEN, HIGH_PAD], tl.float32)
    for block in range(tl.program_id(0), tl.cdiv(n, BLOCK), programs):
        i, here = samples_of_block(block, n, BLOCK)
        counts = (i < trained)[:, None]
        low, high, h1 = _first_layer(
            features, i, here, capacity, w1, columns, LOW, LOW_PAD, HIGH, HIGH_PAD, PRECISION
        )
        g = _tile(g_outputs, 0, i, here, capacity, OUT, OUT)
        d2 += _product(tl.trans(tl.where(counts, g, 0.0)), h1, PRECISION)
        g = _product(g, _weights(w2, OUT, OUT, HIDDEN, HIDDEN, 0, HIDDEN), PRECISION)
        g = tl.where(h1 > 0, g, 0.0)
        g_trained = tl.trans(tl.where(counts, g, 0.0))
        d1 += _product(g_trained, low, PRECISION)
        gl = _product(g, _weights(w1, HIDDEN, HIDDEN, LOW, LOW_PAD, 0, LOW), PRECISION)
        _store_tile(g_features, 0, i, here, capacity, LOW, LOW_PAD, gl)
        if HIGH > 0:
            d6 += _product(g_trained, high, PRECISION)
            gh = _product(g, _weights(columns, HIDDEN, HIDDEN, HIGH, HIGH_PAD, 0, HIGH), PRECISION)
            _store_tile(g_features, LOW, i, here, capacity, HIGH, HIGH_PAD, gh)
    out = density_sums + tl.program_id(0) * (HIDDEN * LOW + OUT * HIDDEN + HIDDEN * HIGH)
    _store_sum(out, d1, HIDDEN, HIDDEN, LOW, LOW_PAD, 0, LOW)
    out += HIDDEN * LOW
    _store_sum(out, d2, OUT, OUT, HIDDEN, HIDDEN, 0, HIDDEN)
    if HIGH > 0:
        _store_sum(out + OUT * HIDDEN, d6, HIDDEN, HIDDEN, HIGH, HIGH_PAD, 0, HIGH)
