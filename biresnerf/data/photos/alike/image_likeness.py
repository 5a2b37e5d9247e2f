"""How alike whole photos are: shows, without any features, which of them may depict the same."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from numpy.typing import NDArray

from biresnerf.data.model.dataset import Dataset
from biresnerf.data.model.image_distances import Distances
from biresnerf.data.photos.area_resize import area_resize
from biresnerf.data.photos.image_files import is_sixteen_bit, open_image, quiet_pillow
from biresnerf.data.photos.kinds.sixteen_bit import as_eight_bit

SIDE = 24  # px that photos are shrunk to
_DRAFT = 8 * SIDE  # px that a JPEG is decoded at
_DECODERS = 4


def unlikeness(dataset: Dataset) -> Distances:
    """One minus the normalised correlation of the photos in grey, each shrunk to 24 x 24 px: 0 to 2.

    A photo of one colour is like no other (1), but itself. Raises `InputError` as `open_image` does.
    """
    small = thumbnails(dataset, range(len(dataset)))
    small = small.reshape(len(small), -1)
    small = small - small.mean(1, keepdims=True)
    lengths = np.linalg.norm(small, axis=1, keepdims=True)
    unit = np.divide(small, lengths, out=np.zeros_like(small), where=lengths > 1e-6)
    return lambda some, others: np.where(some[:, None] == others, 0, 1 - unit[some] @ unit[others].T)


def thumbnails(dataset: Dataset, indices: Sequence[int]) -> NDArray[np.float32]:
    """Photos in grey, shrunk to 24 x 24 px [n, 24, 24], as bright as they are decoded, to 255.

    Raises `InputError` as `open_image` does.
    """
    with quiet_pillow(), ThreadPoolExecutor(_DECODERS, thread_name_prefix="thumbnail") as pool:
        return np.stack(list(pool.map(lambda i: _thumbnail(dataset, i), indices)))


def _thumbnail(dataset: Dataset, index: int) -> NDArray[np.float32]:
    frame = dataset.frames[index]
    with open_image(frame.path, frame.name) as image:
        image.draft("L", (_DRAFT, _DRAFT))
        if is_sixteen_bit(image):
            grey = as_eight_bit(np.asarray(image), frame.levels).astype(np.float32)
        else:
            wide = image.mode.startswith(("I", "F"))  # Pillow would clip them
            grey = np.asarray(image if wide else image.convert("L"), dtype=np.float32)
    side_y, side_x = min(SIDE, grey.shape[0]), min(SIDE, grey.shape[1])
    small = area_resize(grey[..., None], side_x, side_y)[..., 0]
    padded = np.full((SIDE, SIDE), small.mean(), dtype=np.float32)
    padded[:side_y, :side_x] = small
    return padded
