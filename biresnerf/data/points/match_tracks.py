"""From matches between pairs of photos to tracks: one point's features in all photos that show it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from biresnerf.data.points.feature_matches import FeatureMatches


def match_tracks(
    matches: FeatureMatches, images: int
) -> tuple[list[NDArray[np.float64]], list[NDArray[np.int64]]]:
    """The features of each photo, and the tracks through them.

    A track that runs through two features of one photo says two things of it, and that photo is left out of it; tracks
    of fewer than two photos are none.

    Args:
        matches: between pairs.
        images: how many photos there are.

    Returns:
        for each photo float64 [k, 2], px; and for each track int64 [photos, 2]: photo, and row among its features.
    """
    rows = np.concatenate(
        [np.column_stack([matches.images[:, side], matches.xy[:, side]]) for side in (0, 1)]
    )
    nodes, index = np.unique(rows, axis=0, return_inverse=True)
    photo = nodes[:, 0].astype(np.int64)
    first = np.searchsorted(photo, np.arange(images))
    features = [nodes[photo == k, 1:] for k in range(images)]
    label = _components(len(nodes), *index.reshape(2, -1))
    order = np.lexsort((photo, label))
    tracks = []
    for part in np.split(order, np.flatnonzero(np.diff(label[order])) + 1):
        _, position, times = np.unique(photo[part], return_index=True, return_counts=True)
        clear = part[position[times == 1]]
        if len(clear) >= 2:
            tracks.append(np.column_stack([photo[clear], clear - first[photo[clear]]]))
    return features, tracks


def _components(nodes: int, a: NDArray[np.int64], b: NDArray[np.int64]) -> NDArray[np.int64]:
    """The lowest node that each node is connected to by edges a-b, int64 [nodes]."""
    label = np.arange(nodes)
    while True:
        lowest = np.minimum(label[a], label[b])
        lower = label.copy()
        np.minimum.at(lower, a, lowest)
        np.minimum.at(lower, b, lowest)
        lower = lower[lower]
        if np.array_equal(lower, label):
            return label
        label = lower
