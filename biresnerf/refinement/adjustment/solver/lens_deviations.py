"""How exactly lenses are known after an adjustment, whatever the poses are."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from biresnerf.arrays import Array
from biresnerf.refinement.adjustment.cameras import POSE, Cameras
from biresnerf.refinement.adjustment.lens.lenses import LENS, Lenses
from biresnerf.refinement.adjustment.solver import dissection
from biresnerf.refinement.adjustment.solver.blocks import Blocks
from biresnerf.refinement.adjustment.solver.covariance import common_motions, seen_aligning
from biresnerf.refinement.adjustment.solver.elimination import inverse_blocks, largest_group

RANK = 1e-13  # of the largest eigenvalue: what is smaller is rounding, or one of the motions of the whole rig
ROUNDING = 1e-12  # of a lens's own information: what poses leave of it, if that is not more, is rounding
TOLD = 1e-9  # of a lens's own information, in systems that are not dense: lenses with less are unknown


def posterior(cameras: Cameras, information: Blocks, lenses: Lenses) -> Array:
    """Standard deviations [g, 8] of lenses, with poses unknown but for the evidence; NaN of those held.

    The prior of the poses is left out: errors that they share would be mistaken for knowledge of the lens.

    Args:
        information: of the evidence alone.
    """
    free, before = lenses.free.reshape(-1), np.zeros(LENS * len(lenses.correction))
    before[free] = 1 / lenses.deviation.reshape(-1)[free] ** 2
    deviation = np.full(len(free), np.nan)
    if information.parts > dissection.ONE_FRONT:
        deviation[free] = _by_blocks(cameras, information, free, before)[free]
    else:
        deviation[free] = _dense(information.dense(), POSE * information.cameras, free, np.diag(before[free]))
    return deviation.reshape(-1, LENS)


def _by_blocks(cameras: Cameras, information: Blocks, free: NDArray[np.bool_], before: Array) -> Array:
    """Deviations of all lenses [8g], with motions of the whole rig held, as these change no evidence.

    A weak prior on all unknowns keeps other groups of cameras regular; lenses of those alone keep their prior.
    """
    own = information.diagonal
    poses = len(own) - len(free)
    together = largest_group(information)
    used = np.concatenate([own[:poses] > 0, free & ((own[poses:] > 0) | (before > 0))])
    more = np.concatenate([np.zeros(poses), before])
    unit = 1 / np.sqrt(np.where(used, own + more, 1.0))
    held = seen_aligning(common_motions(cameras, together), together)
    border = unit[:, None] * np.concatenate([held, np.zeros((len(free), held.shape[1]))])
    border /= np.maximum(np.linalg.norm(border, axis=0), 1e-300)
    more = np.where(used, unit**2 * more + ROUNDING, 0.0)
    found = inverse_blocks(information.scaled(unit).with_diagonal(more), used, border)
    if found is None:
        return np.full(len(free), np.inf)
    variance = np.diagonal(found[information.cameras :], axis1=1, axis2=2).reshape(-1) * unit[poses:] ** 2
    of_group = np.isin(np.arange(information.lenses), cameras.lens_of[together])
    told = np.repeat(of_group, LENS) & used[poses:] & (variance > 0) & (variance * own[poses:] < 1 / TOLD)
    with np.errstate(divide="ignore"):
        return np.sqrt(np.where(told, variance, 1 / before))


def _dense(information: Array, poses: int, free: NDArray[np.bool_], before: Array) -> Array:
    """Deviations of the free parameters, from information [u, u]."""
    among = information[:poses, :poses]
    mixed, own = information[:poses, poses:][:, free], information[poses:, poses:][np.ix_(free, free)]
    size = np.sqrt(np.maximum(np.diagonal(among), 1e-300))
    values, vectors = np.linalg.eigh(among / size[:, None] / size[None, :])
    known = values > RANK * values.max(initial=1e-300)
    seen = (vectors[:, known].T @ (mixed / size[:, None])) / np.sqrt(values[known])[:, None]
    return _deviations(own, seen.T @ seen, before)


def _deviations(own: Array, shared: Array, before: Array) -> Array:
    """Deviations by the information `own` less `shared`, zero up to rounding where nothing is left, and the prior."""
    size = np.sqrt(np.maximum(np.diagonal(own) + np.diagonal(before), 1e-300))
    values, vectors = np.linalg.eigh((own - shared) / size[:, None] / size[None, :])
    evidence = (vectors * np.where(values > ROUNDING, values, 0)) @ vectors.T
    total = evidence + before / size[:, None] / size[None, :]
    values, vectors = np.linalg.eigh(total)
    with np.errstate(divide="ignore", invalid="ignore"):
        shares = np.where(vectors == 0, 0.0, vectors**2 / np.maximum(values, 0))
        return np.asarray(np.sqrt(shares.sum(1)) / size)
