"""Rigid motions as float64 matrices [..., 4, 4]."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def rigid_inverse(b_from_a: NDArray[np.float64]) -> NDArray[np.float64]:
    """The ``a_from_b`` [..., 4, 4] of rigid motions: the transposed rotation, no elimination."""
    given = np.asarray(b_from_a, dtype=np.float64)
    inverse = np.zeros_like(given)
    inverse[..., :3, :3] = np.swapaxes(given[..., :3, :3], -1, -2)
    inverse[..., :3, 3] = -(inverse[..., :3, :3] @ given[..., :3, 3, None])[..., 0]
    inverse[..., 3, 3] = 1.0
    return inverse
