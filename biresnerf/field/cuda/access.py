"""Which samples a program takes, and loads and stores of three-vectors, for the Triton kernels."""

from __future__ import annotations

import triton
import triton.language as tl


@triton.jit
def samples_of_block(block, n, BLOCK: tl.constexpr):
    """Indices of the samples of a block, and which of them are below n."""
    i = block * BLOCK + tl.arange(0, BLOCK)
    return i, i < n


@triton.jit
def sample_counts(taken, ray_offset, trained_rays):
    """How many samples there are, and how many of them are of trained rays; those come first."""
    n = tl.load(taken)
    return n, tl.minimum(tl.load(ray_offset + tl.load(trained_rays).to(tl.int32)), n)


@triton.jit
def load_vector(pointer, step, here):
    """The numbers at `pointer`, one `step` and two steps further; 0 where not `here`."""
    x = tl.load(pointer, mask=here, other=0.0)
    y = tl.load(pointer + step, mask=here, other=0.0)
    z = tl.load(pointer + 2 * step, mask=here, other=0.0)
    return x, y, z


@triton.jit
def store_vector(pointer, step, x, y, z, here):
    """Write three numbers, `step` apart, where `here`."""
    tl.store(pointer, x, mask=here)
    tl.store(pointer + step, y, mask=here)
    tl.store(pointer + 2 * step, z, mask=here)
