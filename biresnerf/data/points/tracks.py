"""Tracks: points of the scene, each with its features in the photos that show it. They depend on no pose."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from biresnerf.data.model.atomic_file import whole_file

KEPT = "tracks.npz"  # in the work folder of `colmap_child`, and beside what else is kept of COLMAP's answer
# Of all points: left out of every estimate, to judge estimates by.
LEFT_OUT = 0.2
_GOLDEN, _MIX = 0x9E3779B97F4A7C15, (0xBF58476D1CE4E5B9, 0x94D049BB133111EB)


@dataclass(frozen=True, eq=False)
class Tracks:
    """Observations of points, grouped by point; each point is seen in two photos at least, and once in each.

    Attributes:
        point: int64 [m], ascending, 0 to the number of points - 1.
        image: int64 [m], indices into the frames of the set, ascending for each point.
        xy: float64 [m, 2], px of the full-size photos.
    """

    point: NDArray[np.int64]
    image: NDArray[np.int64]
    xy: NDArray[np.float64]

    def __len__(self) -> int:
        """Number of observations."""
        return len(self.point)

    @property
    def points(self) -> int:
        """Number of points."""
        return int(self.point[-1]) + 1 if len(self.point) else 0

    @property
    def lengths(self) -> NDArray[np.int64]:
        """In how many photos each point is seen, [points]."""
        return np.bincount(self.point, minlength=self.points)

    @classmethod
    def of_matches(cls, images: NDArray[Any], xy: NDArray[Any]) -> Tracks | None:
        """The tracks through matches between photos; None where there are none.

        Features at one position of a photo are one: a detector may find several directions there.

        Args:
            images: [matches, 2], the two photos of each match.
            xy: [matches, 2, 2], where the point lies in the first and in the second of them, px.
        """
        flat = np.asarray(xy, np.float32).astype(np.float64).reshape(-1, 2)
        rows = np.column_stack([np.asarray(images, np.float64).reshape(-1), flat])
        features, index = np.unique(rows, axis=0, return_inverse=True)
        image = features[:, 0].astype(np.int64)
        point = trace_tracks(image, *index.reshape(-1, 2).T)
        order = np.lexsort((image, point))
        order = order[point[order] >= 0]
        return cls.of(point[order], image[order], features[order, 1:])

    @classmethod
    def of(cls, point: NDArray[Any], image: NDArray[Any], xy: NDArray[Any]) -> Tracks | None:
        """From observations in the order of their points, numbered in any way; None where no point has two of them.

        They have the precision of `kept`, so that a resumed run has the same.
        """
        seen = np.unique(point, return_inverse=True, return_counts=True)
        several = seen[2][seen[1]] >= 2
        if not several.any():
            return None
        numbers = np.unique(np.asarray(point)[several], return_inverse=True)[1].astype(np.int64)
        as_kept = np.asarray(xy, np.float32)[several].astype(np.float64)
        return cls(numbers, np.asarray(image, np.int64)[several], as_kept)

    def where(self, observations: NDArray[np.bool_]) -> Tracks | None:
        """These observations [m], of points that keep two at least; None if there are none."""
        return Tracks.of(self.point[observations], self.image[observations], self.xy[observations])

    def left_out(self, share: float = LEFT_OUT, seed: int = 0) -> NDArray[np.bool_]:
        """Mask [points] of a fixed share of the points, chosen by a hash of their numbers."""
        with np.errstate(over="ignore"):
            mixed = (np.arange(1, self.points + 1, dtype=np.uint64) + np.uint64(seed << 32)) * np.uint64(
                _GOLDEN
            )
            for shift, factor in zip((30, 27), _MIX, strict=True):
                mixed = (mixed ^ (mixed >> np.uint64(shift))) * np.uint64(factor)
        chosen: NDArray[np.bool_] = (mixed >> np.uint64(11)) < np.uint64(share * 2.0**53)
        return chosen

    def split(self, share: float = LEFT_OUT, seed: int = 0) -> tuple[Tracks | None, Tracks | None]:
        """The points that an estimate may be fitted to, and those `left_out` to judge it by."""
        left_out = self.left_out(share, seed)[self.point]
        return self.where(~left_out), self.where(left_out)

    def thinned(self, most: int, images: int) -> Tracks:
        """At most `most` observations, by whole points: those first that many of the photos see.

        A point is taken if half of its photos still have few features, so that each photo keeps some.
        """
        if len(self) <= most:
            return self
        room = np.full(images, max(1, most // (2 * images)))
        starts = np.concatenate(([0], np.cumsum(self.lengths)))
        taken = np.zeros(self.points, dtype=np.bool_)
        for point in np.argsort(-self.lengths, kind="stable").tolist():
            seen_by = self.image[starts[point] : starts[point + 1]]
            if 2 * (room[seen_by] > 0).sum() >= len(seen_by):
                taken[point] = True
                room[seen_by] -= 1
        return self.where(taken[self.point]) or self

    def pairs(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Pairs of observations of one point in two photos, as their indices [k] and [k].

        Each is paired with the next of its point, and the last with the first: each is in two pairs, or in one where
        only two photos see the point.
        """
        first = np.concatenate(([0], np.cumsum(self.lengths)))[self.point]
        following = np.arange(1, len(self) + 1)
        last = np.append(np.diff(self.point) != 0, True)
        following[last] = first[last]
        used = ~(last & (self.lengths[self.point] == 2))
        return np.flatnonzero(used), following[used]

    @classmethod
    def load(cls, path: Path, names: tuple[str, ...]) -> Tracks | None:
        """What `keep_tracks` left at `path`, of the images `names`; None where there is no such file or track."""
        if not path.is_file():
            return None
        index = {name: i for i, name in enumerate(names)}
        with np.load(path, allow_pickle=False) as kept:
            place = np.array([index.get(str(name), -1) for name in kept["names"]], dtype=np.int64)
            point, image, xy = kept["point"], place[kept["image"]], kept["xy"]
        order = np.lexsort((image, point))
        order = order[image[order] >= 0]
        return cls.of(point[order], image[order], xy[order])

    def kept(self) -> dict[str, NDArray[Any]]:
        """Arrays to keep, named like the attributes."""
        return {
            "point": self.point.astype(np.int32),
            "image": self.image.astype(np.int32),
            "xy": self.xy.astype(np.float32),
        }


def keep_tracks(work: Path, names: tuple[str, ...], path: Path) -> None:
    """Keep what COLMAP's child process wrote to its folder `work`, of images in the order of `names`, as `path`."""
    if not (work / KEPT).is_file():
        return  # nothing matched
    with np.load(work / KEPT, allow_pickle=False) as written, whole_file(path) as temporary:
        np.savez(temporary, names=np.array(names), **{name: written[name] for name in written.files})


def trace_tracks(image: NDArray[np.int64], a: NDArray[np.int64], b: NDArray[np.int64]) -> NDArray[np.int64]:
    """The track of each feature, int64 [features]: numbered from 0, in the order of their first features; -1 of none.

    Matched features are one point's. Where matches lead from a feature to another one of the same photo, some are
    wrong: there they are believed one by one, those first that most others confirm (features of third photos that
    match both), and a match that would join two features of one photo is not believed.

    Args:
        image: of each feature, int64 [features].
        a, b: features that match, int64 [matches] each.
    """
    label = components(len(image), a, b)
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


def components(nodes: int, a: NDArray[np.int64], b: NDArray[np.int64]) -> NDArray[np.int64]:
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
