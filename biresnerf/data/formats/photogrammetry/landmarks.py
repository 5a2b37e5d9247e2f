"""The points of a set as photogrammetry programs keep them: each with the feature that every view sees of it."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

from biresnerf.data.model.refined_set import RefinedSet


class Landmark(NamedTuple):
    """One point.

    Attributes:
        number: its id.
        xyz, rgb: position in the world; colour, 0 to 255.
        seen: of each view (its row in the set) the feature's number and its x and y, px. A view sees a point once: of
            several features that COLMAP may list, the first.
    """

    number: int
    xyz: list[float]
    rgb: list[int]
    seen: dict[int, tuple[int, list[float]]]


def landmarks(refined: RefinedSet) -> Iterator[Landmark]:
    """All points of the set."""
    points, row_of = refined.model.points, {number: row for row, number in enumerate(refined.image_ids)}
    for k, (number, xyz, rgb) in enumerate(
        zip(points.ids.tolist(), points.xyz.tolist(), points.rgb.tolist(), strict=True)
    ):
        seen: dict[int, tuple[int, list[float]]] = {}
        track = slice(points.track_starts[k], points.track_starts[k + 1])
        images, features = (
            points.track_image_ids[track].tolist(),
            points.track_point2d_indices[track].tolist(),
        )
        for image, feature in zip(images, features, strict=True):
            if image in row_of:
                xy = refined.model.images[image].points2d_px[feature].tolist()
                seen.setdefault(row_of[image], (feature, xy))
        yield Landmark(number, xyz, rgb, seen)
