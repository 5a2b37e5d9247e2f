"""How encodings open from coarse to fine: the cosine window of BARF, and BAA-NGP's way of using it on a hash grid."""

from __future__ import annotations

import numpy as np

START, END = 0.1, 0.5  # shares of the run that the window opens between, in both papers


def _ramp(q: np.ndarray) -> np.ndarray:
    return (1 - np.cos(np.pi * np.clip(q, 0.0, 1.0))) / 2


def band_weights(progress: float, bands: int) -> np.ndarray:
    """Weight [bands] of each frequency of a positional encoding (BARF, Lin et al. 2021, eq. 14).

    w_k = (1 - cos(pi clamp(alpha - k, 0, 1))) / 2 with alpha rising from 0 to `bands` over the window.
    """
    alpha = (progress - START) / (END - START) * bands
    return _ramp(alpha - np.arange(bands))


def level_weights(progress: float, levels: int) -> np.ndarray:
    """Weight [levels] of each level of a hash grid (BAA-NGP, Liu et al. 2023): as BARF's, the coarsest always open."""
    alpha = (progress - START) / (END - START) * (levels - 1)
    weights = _ramp(alpha - np.arange(-1, levels - 1))
    weights[0] = 1.0
    return weights


def level_mixing(progress: float, levels: int) -> np.ndarray:
    """The matrix [levels, levels] from the features of the grid's levels to those the network sees.

    A level that is not open yet repeats the finest open one: y_l = w_l f_l + (1 - w_l) f_l*, l* the highest level
    whose weight is not zero (BAA-NGP).
    """
    weights = level_weights(progress, levels)
    mixing = np.diag(weights)
    mixing[:, int(np.flatnonzero(weights)[-1])] += 1 - weights
    return mixing
