"""Does a set of opaque images show its scene before plain black or white?"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

T = TypeVar("T", bound=np.generic)
BLACK_BELOW = 24  # of 255: sensors and JPEG leave some light in black
WHITE_ABOVE = 250  # of 255: bright walls and skies stay below it or vary
BORDER_SHARE = 0.75  # of an image's border pixels that must show the colour; a pedestal may cover one side
IMAGE_SHARE = 0.9  # of the images that must agree; the others may have the object cut by the border


def uniform_background(
    images: Sequence[NDArray[np.uint8]], counts: Sequence[NDArray[np.bool_] | None]
) -> NDArray[np.float32] | None:
    """Black or white, float32 [3] of 0 or 1, where nearly all borders of ``images`` [h, w, 3] show it.

    Only pixels that count are looked at; images whose border is masked have no say.
    """
    black, white, asked = 0, 0, 0
    for image, counting in zip(images, counts, strict=True):
        border = _border(image)
        if counting is not None:
            border = border[_border(counting)]
        if len(border) == 0:
            continue
        asked += 1
        black += bool((border.max(axis=1) < BLACK_BELOW).mean() >= BORDER_SHARE)
        white += bool((border.min(axis=1) > WHITE_ABOVE).mean() >= BORDER_SHARE)
    if asked == 0:
        return None
    needed = IMAGE_SHARE * asked
    if black >= needed:
        return np.zeros(3, dtype=np.float32)
    if white >= needed:
        return np.ones(3, dtype=np.float32)
    return None


def _border(image: NDArray[T]) -> NDArray[T]:
    return np.concatenate((image[0], image[-1], image[:, 0], image[:, -1]))
