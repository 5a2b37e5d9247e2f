"""What is known of lenses before an adjustment, and after it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

LENS = 3  # unknowns of a lens: log focal length and two radial coefficients
# A parameter is known from the evidence if its standard deviation there is less than this share of the one before: the
# evidence then has eight ninths of the say.
OBSERVABLE = 1 / 3
RANK = 1e-13  # of the largest eigenvalue: what is smaller is rounding, or one of the motions of the whole rig
ROUNDING = 1e-12  # of a lens's own information: what poses leave of it, if that is not more, is rounding
NEWTON = 8
FURTHEST = 2.0  # times the slope itself that Newton's method may go


@dataclass(frozen=True, eq=False)
class Lenses:
    """Lenses while they are adjusted, as corrections of those that the evidence was made with (see `Cameras`).

    Attributes:
        of_image: int64 [n], the lens of each image.
        correction: [g, 3], known before: zero, or what was found earlier.
        deviation: [g, 3], standard deviation of the error of what is known before. Zero: held. Infinite: not known.
    """

    of_image: NDArray[np.int64]
    correction: Array
    deviation: Array

    @property
    def free(self) -> NDArray[np.bool_]:
        """Which parameters [g, 3] may move."""
        return self.deviation > 0

    def held(self, which: NDArray[np.bool_]) -> Lenses:
        """With some parameters [g, 3] held where they are."""
        return replace(self, deviation=np.where(which, 0.0, self.deviation))

    def known(self, correction: Array) -> Lenses:
        """The same lenses after a correction [g, 3], all held."""
        return Lenses(self.of_image, correction, np.zeros_like(correction))


@dataclass(frozen=True, eq=False)
class LensEstimate:
    """Lenses after an adjustment.

    Attributes:
        correction: [g, 3], of the evidence's lenses.
        deviation: [g, 3], standard deviation as prior and evidence give it; NaN where nothing was to be found.
        observable: [g, 3], whether the evidence tells. Where it does not, the parameter is as it was.
    """

    correction: Array
    deviation: Array
    observable: NDArray[np.bool_]


def posterior(information: Array, poses: int, lenses: Lenses) -> Array:
    """Standard deviations [g, 3] of lenses, with poses unknown but for the evidence; NaN of those held.

    The prior of the poses has no part in it: if they err alike, it would pass for knowledge of the lens.

    Args:
        information: [u, u], of the evidence alone.
        poses: how many of the u unknowns come first and are those of poses.
    """
    free = lenses.free.reshape(-1)
    among = information[:poses, :poses]
    mixed, own = information[:poses, poses:][:, free], information[poses:, poses:][np.ix_(free, free)]
    size = np.sqrt(np.maximum(np.diagonal(among), 1e-300))
    values, vectors = np.linalg.eigh(among / size[:, None] / size[None, :])
    known = values > RANK * values.max(initial=1e-300)
    seen = (vectors[:, known].T @ (mixed / size[:, None])) / np.sqrt(values[known])[:, None]
    before = np.diag(1 / lenses.deviation.reshape(-1)[free] ** 2)
    deviation = np.full(len(free), np.nan)
    deviation[free] = _deviations(own, seen.T @ seen, before)
    return deviation.reshape(-1, LENS)


def _deviations(own: Array, shared: Array, before: Array) -> Array:
    """Of the information `own` less `shared`, and of what was known before; what rounding has left of it is nothing."""
    size = np.sqrt(np.maximum(np.diagonal(own) + np.diagonal(before), 1e-300))
    values, vectors = np.linalg.eigh((own - shared) / size[:, None] / size[None, :])
    evidence = (vectors * np.where(values > ROUNDING, values, 0)) @ vectors.T
    total = evidence + before / size[:, None] / size[None, :]
    values, vectors = np.linalg.eigh(total)
    with np.errstate(divide="ignore", invalid="ignore"):
        shares = np.where(vectors == 0, 0.0, vectors**2 / np.maximum(values, 0))
        return np.asarray(np.sqrt(shares.sum(1)) / size)


def narrowing(lens: Array, slopes: Array) -> Array:
    """Factor [..., 1] that undoes e^l (1 + k1 t^2 + k2 t^4) for slopes [..., 2]; lens [..., 3] is l, k1, k2.

    Newton's method on the radius t. A lens that folds within twice a slope's radius has no answer there; the factor is
    then wrong, but finite.
    """
    radius = np.linalg.norm(slopes, axis=-1, keepdims=True)
    aim, k1, k2 = radius * np.exp(-lens[..., :1]), lens[..., 1:2], lens[..., 2:]
    found = aim
    for _ in range(NEWTON):
        square = found**2
        value = found * (1 + square * (k1 + square * k2)) - aim
        found = found - value / np.maximum(1 + square * (3 * k1 + 5 * square * k2), 0.1)
        found = np.clip(found, 0, FURTHEST * aim)
    return np.where(radius > 0, found / np.maximum(radius, 1e-300), np.exp(-lens[..., :1]))
