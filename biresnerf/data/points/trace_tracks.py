"""From matches between pairs of photos to tracks: one point's features in all photos that show it."""

from __future__ import annotations

from collections import defaultdict

import numpy as np
from numpy.typing import NDArray


def trace_tracks(image: NDArray[np.int64], a: NDArray[np.int64], b: NDArray[np.int64]) -> NDArray[np.int64]:
    """The track of each feature, int64 [features]: numbered from 0, in the order of their first features; -1 of none.

    Matched features are one point's. Where matches lead from a feature to another one of the same photo, some are
    wrong: there they are believed one by one, those first that most others confirm (features of third photos that
    match both), and a match that would join two features of one photo is not believed.

    Args:
        image: of each feature, int64 [features].
        a, b: features that match, int64 [matches] each.
    """
    label = _components(len(image), a, b)
    clashing = _clashing(label, image)
    doubtful = np.flatnonzero(clashing[a])
    label[clashing] = np.flatnonzero(clashing)
    pairs = list(zip(a[doubtful].tolist(), b[doubtful].tolist(), strict=True))
    partners: dict[int, set[int]] = defaultdict(set)
    for one, other in pairs:
        partners[one].add(other)
        partners[other].add(one)
    support = np.array([len(partners[one] & partners[other]) for one, other in pairs], dtype=np.int64)
    members = {feature: {int(image[feature]): feature} for feature in partners}
    track = {feature: feature for feature in partners}
    for i in np.argsort(-support, kind="stable").tolist():
        one, other = (track[feature] for feature in pairs[i])
        if one == other or members[one].keys() & members[other].keys():
            continue
        if len(members[one]) < len(members[other]):
            one, other = other, one
        joining = members.pop(other)
        members[one].update(joining)
        track.update(dict.fromkeys(joining.values(), one))
    for feature, owner in track.items():
        label[feature] = owner
    return _numbered(label)


def _clashing(label: NDArray[np.int64], image: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Which features [f] lie in a component with two features of one photo."""
    order = np.lexsort((image, label))
    same = (np.diff(label[order]) == 0) & (np.diff(image[order]) == 0)
    mask = np.zeros(len(label), dtype=np.bool_)
    mask[label[order][1:][same]] = True  # labels are features: the lowest of each component
    clashing: NDArray[np.bool_] = mask[label]
    return clashing


def _numbered(label: NDArray[np.int64]) -> NDArray[np.int64]:
    """Labels that several features share, numbered in the order of their first features; -1 for the others."""
    _, first, index, count = np.unique(label, return_index=True, return_inverse=True, return_counts=True)
    rank = np.full(len(first), -1)
    several = np.flatnonzero(count >= 2)
    rank[several[np.argsort(first[several])]] = np.arange(len(several))
    numbered: NDArray[np.int64] = rank[index]
    return numbered


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
