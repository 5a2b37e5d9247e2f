"""Real spherical harmonics up to degree 3: the view encoding of the colour network (16 values)."""

from __future__ import annotations

import torch
from torch import Tensor

VIEW_FEATURES = 16


def spherical_harmonics(direction: Tensor) -> Tensor:
    """16 harmonics [..., 16] of unit directions [..., 3], in tiny-cuda-nn's order and signs."""
    x, y, z = direction.unbind(-1)
    xx, yy, zz, xy, yz, xz = x * x, y * y, z * z, x * y, y * z, x * z
    return torch.stack(
        [
            torch.full_like(x, 0.28209479177387814),
            -0.48860251190291987 * y,
            0.48860251190291987 * z,
            -0.48860251190291987 * x,
            1.0925484305920792 * xy,
            -1.0925484305920792 * yz,
            0.94617469575756 * zz - 0.31539156525252,
            -1.0925484305920792 * xz,
            0.5462742152960396 * (xx - yy),
            0.5900435899266435 * y * (-3 * xx + yy),
            2.890611442640554 * xy * z,
            0.4570457994644658 * y * (1 - 5 * zz),
            0.3731763325901154 * z * (5 * zz - 3),
            0.4570457994644658 * x * (1 - 5 * zz),
            1.445305721320277 * z * (xx - yy),
            0.5900435899266435 * x * (-xx + 3 * yy),
        ],
        -1,
    )
