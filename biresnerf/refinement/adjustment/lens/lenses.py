"""What is known of lenses before an adjustment, and after it.

A lens is a correction [8] of the pinhole that the evidence was made with: the logarithm l of the focal length's ratio,
k1, k2, the principal point's shift in focal lengths, p1, p2, and the logarithm a of the ratio of fy to fx. A point
at slopes u, v appears where that pinhole shows the slopes e^l u' + shift_x, e^(l + a) v' + shift_y, with u', v' as in
`biresnerf.geometry.camera.distortion`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from biresnerf.arrays import Array
from biresnerf.geometry.camera.distortion import Coefficients, distort, distort_jacobian

LENS = 8  # unknowns of a lens
FOCAL, K1, K2, CENTRE, TANGENTIAL, ASPECT = 0, 1, 2, slice(3, 5), slice(5, 7), 7
DISTORTION = [1, 2, 5, 6]  # k1, k2, p1, p2
# In the order in which they are freed; given up, last first, where the evidence does not determine them.
KINDS = ((0,), (3, 4), (1,), (2,), (5, 6), (7,))
NEWTON = 8
FURTHEST = 2.0  # times the slope itself that Newton's method may go
LEAST_AREA = 0.1  # that it takes a lens to shrink things to


@dataclass(frozen=True, eq=False)
class Lenses:
    """Lenses while they are adjusted, as corrections of those that the evidence was made with (see `Cameras`).

    Attributes:
        of_image: int64 [n], the lens of each image.
        correction: [g, 8], known before: zero, or what was found earlier.
        deviation: [g, 8], standard deviation of the error of what is known before. Zero: held. Infinite: not known.
    """

    of_image: NDArray[np.int64]
    correction: Array
    deviation: Array

    @property
    def free(self) -> NDArray[np.bool_]:
        """Which parameters [g, 8] may move."""
        return self.deviation > 0

    def held(self, which: NDArray[np.bool_]) -> Lenses:
        """The lenses with some parameters [g, 8] held."""
        return replace(self, deviation=np.where(which, 0.0, self.deviation))

    def known(self, correction: Array) -> Lenses:
        """The same lenses after a correction [g, 8], all held."""
        return Lenses(self.of_image, correction, np.zeros_like(correction))


@dataclass(frozen=True, eq=False)
class LensEstimate:
    """Lenses after an adjustment.

    Attributes:
        correction: [g, 8], of the evidence's lenses.
        deviation: [g, 8], standard deviation as prior and evidence give it; NaN where nothing was to be found.
        observable: [g, 8], whether the evidence determines it. If not, the parameter stays as it was.
    """

    correction: Array
    deviation: Array
    observable: NDArray[np.bool_]


def slopes_seen(lens: Array, shown: Array) -> Array:
    """Slopes [..., 2] that lenses [..., 8] show where the evidence's pinhole shows other slopes [..., 2].

    Newton's method. A lens that folds within twice a slope's radius has no answer there; what is returned is then
    wrong, but finite.
    """
    scale = np.exp(-lens[..., [FOCAL]] - lens[..., [ASPECT]] * [0.0, 1.0])
    aim = (shown - lens[..., CENTRE]) * scale
    c = Coefficients((lens[..., 1], lens[..., 2]), (), (lens[..., 5], lens[..., 6]))
    farthest = FURTHEST * np.linalg.norm(aim, axis=-1, keepdims=True)
    found = aim
    for _ in range(NEWTON):
        x, y = found[..., 0], found[..., 1]
        away = np.stack(distort(x, y, c), -1) - aim
        xx, xy, yx, yy = distort_jacobian(x, y, c)
        steep = np.maximum(xx * yy - xy * yx, LEAST_AREA)
        step = np.stack([yy * away[..., 0] - xy * away[..., 1], xx * away[..., 1] - yx * away[..., 0]], -1)
        found = found - step / steep[..., None]
        length = np.linalg.norm(found, axis=-1, keepdims=True)
        found = found * np.minimum(1.0, farthest / np.maximum(length, 1e-300))
    return np.asarray(found)
