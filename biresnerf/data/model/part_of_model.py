"""A COLMAP model without some of its images."""

from __future__ import annotations

from collections.abc import Set
from dataclasses import replace

import numpy as np

from biresnerf.data.model.colmap_scene import ColmapModel
from biresnerf.data.model.result_model import with_points


def without_images(model: ColmapModel, names: Set[str]) -> ColmapModel:
    """The model without the images of these names: out of its tracks, points and frames, too.

    Points that nothing sees any more go, and frames that hold no image any more.
    """
    gone = {image.id for image in model.images.values() if image.name in names}
    if not gone:
        return model
    points = model.points
    stays = ~np.isin(points.track_image_ids, list(gone))
    owner = np.repeat(np.arange(len(points)), np.diff(points.track_starts))
    lengths = np.bincount(owner[stays], minlength=len(points))
    # A point that had no track to begin with loses nothing.
    seen = (lengths > 0) | (np.diff(points.track_starts) == 0)
    starts = np.concatenate([np.zeros(1, np.int64), np.cumsum(lengths[seen])])
    kept = replace(
        points,
        ids=points.ids[seen],
        xyz=points.xyz[seen],
        rgb=points.rgb[seen],
        errors=points.errors[seen],
        track_starts=starts,
        track_image_ids=points.track_image_ids[stays],
        track_point2d_indices=points.track_point2d_indices[stays],
    )
    frames = {}
    for number, frame in model.frames.items():
        data = tuple(one for one in frame.data_ids if one[0][0] != "CAMERA" or one[1] not in gone)
        if any(sensor[0] == "CAMERA" for sensor, _ in data):
            frames[number] = replace(frame, data_ids=data)
    images = {number: image for number, image in model.images.items() if number not in gone}
    return with_points(replace(model, images=images, frames=frames), kept)
