"""The tracks through COLMAP's verified matches, in the child process: handed on, and some kept from the mapping."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from biresnerf.data.model.atomic_file import whole_file
from biresnerf.data.points.tracks import KEPT, Tracks

# Handed on: checkpoints carry them, 16 bytes each. Of an image, where that is more: adjusted to 80 of each, a flight of
# 500 photos ends at 0.052 deg, to 200 at 0.032, to 400 at 0.020, to 800 at 0.016, to all 1,300 at 0.010.
_MOST_OBSERVATIONS, _OF_IMAGE = 400_000, 800


def most_observations(images: int) -> int:
    """How many observations the tracks of so many images have at most."""
    return max(_MOST_OBSERVATIONS, _OF_IMAGE * images)


def write_tracks(database_path: Path, work: Path) -> Tracks | None:
    """The tracks through all verified matches, thinned by whole points, also to a file; None where nothing matches.

    Images go by their number, the order of names; positions are in px of the full-size photos.
    """
    import pycolmap

    database = pycolmap.Database.open(database_path)
    number, features = _numbers(database), _features(database)
    images, xy = [np.zeros((0, 2), np.int64)], [np.zeros((0, 2, 2), np.float32)]
    for pair, geometry in zip(*database.read_two_view_geometries(), strict=True):
        found = np.asarray(geometry.inlier_matches).reshape(-1, 2)
        a, b = pycolmap.pair_id_to_image_pair(pair)
        images.append(np.tile(np.array([[number[a], number[b]]]), (len(found), 1)))
        xy.append(np.stack([features[a][found[:, 0]], features[b][found[:, 1]]], axis=1))
    database.close()
    tracks = Tracks.of_matches(np.concatenate(images), np.concatenate(xy))
    if tracks is None:
        return None
    tracks = tracks.thinned(most_observations(len(number)), len(number))
    arrays: dict[str, Any] = tracks.kept()
    with whole_file(work / KEPT) as temporary:  # if this process is stopped, its parent takes what is there
        np.savez(temporary, **arrays)
    return tracks


def keep_from_mapping(database_path: Path, tracks: Tracks) -> None:
    """Remove the matches of the points that are left out to judge poses by, so that no model is fitted to them."""
    import pycolmap

    left_out = tracks.split()[1]
    if left_out is None:
        return
    database = pycolmap.Database.open(database_path)
    number, features = _numbers(database), _features(database)
    hidden = {
        image: np.isin(
            _as_scalars(features[image]), _as_scalars(left_out.xy[left_out.image == number[image]])
        )
        for image in number
    }
    for pair, geometry in zip(*database.read_two_view_geometries(), strict=True):
        found = np.asarray(geometry.inlier_matches).reshape(-1, 2)
        a, b = pycolmap.pair_id_to_image_pair(pair)
        shown = ~(hidden[a][found[:, 0]] | hidden[b][found[:, 1]])
        if not shown.all():
            geometry.inlier_matches = found[shown]
            database.update_two_view_geometry(a, b, geometry)
    database.close()


def _numbers(database: Any) -> dict[int, int]:
    """The number of each of the database's images, in the order of names."""
    named = sorted((image.name, image.image_id) for image in database.read_all_images())
    return {image: i for i, (_, image) in enumerate(named)}


def _features(database: Any) -> dict[int, NDArray[np.float32]]:
    """Positions [k, 2] of each image's features, px."""
    return {
        image.image_id: np.asarray(database.read_keypoints(image.image_id), np.float32)[:, :2]
        for image in database.read_all_images()
    }


def _as_scalars(xy: NDArray[Any]) -> NDArray[np.complex128]:
    """Positions [k, 2] as numbers [k] to look up."""
    return xy[:, 0] + 1j * xy[:, 1].astype(np.float64)
