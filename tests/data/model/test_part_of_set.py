"""A set from which photos were removed equals one that never had them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from biresnerf.data.formats.read_dataset import read_dataset
from biresnerf.data.model.part_of_set import without_photos
from biresnerf.errors import InputError
from tests.data.formats.simple import trajectories


def test_what_is_left_keeps_its_poses_lenses_and_model(tmp_path: Path) -> None:
    trajectories.colmap_set(tmp_path)
    whole = read_dataset(tmp_path)
    # The second photo has a lens of its own, the others share one.
    other = replace(whole.cameras[0], params=tuple(2 * value for value in whole.cameras[0].params))
    frames = tuple(replace(frame, camera=int(row != 1)) for row, frame in enumerate(whole.frames))
    both = replace(
        whole, cameras=(other, whole.cameras[0]), frames=frames, intrinsics_sources=("guessed", "exif")
    )
    part = without_photos(both, [whole.file_names[1]])
    assert part.names == tuple(name for row, name in enumerate(whole.names) if row != 1)
    assert [frame.camera for frame in part.frames] == [0, 0, 0]
    assert (part.cameras, part.intrinsics_sources) == ((whole.cameras[0],), ("exif",))
    np.testing.assert_array_equal(part.world_from_cam, whole.world_from_cam[[0, 2, 3]])
    assert part.source.colmap is not None
    assert {image.name for image in part.source.colmap.images.values()} == set(part.names)
    assert without_photos(both, (), only=part.names).names == part.names
    assert without_photos(both, part.names[:1], only=whole.names).names == (
        *whole.names[1:2],
        *part.names[1:],
    )
    last = without_photos(both, [whole.names[0]])
    assert [frame.camera for frame in last.frames] == [0, 1, 1]


def test_a_name_of_no_photo_and_too_few_photos_are_refused(tmp_path: Path) -> None:
    trajectories.colmap_set(tmp_path)
    whole = read_dataset(tmp_path)
    for names, code in (
        (["nosuch.png"], "left_out_not_found"),
        (list(whole.names[:2]), "too_few_images"),
    ):
        with pytest.raises(InputError) as caught:
            without_photos(whole, names)
        assert (caught.value.code, caught.value.where) == (code, "leave_out")
        assert caught.value.hint
    for only, code in ((["nosuch.png"], "photos_not_found"), (list(whole.names[:2]), "too_few_images")):
        with pytest.raises(InputError) as caught:
            without_photos(whole, (), only)
        assert (caught.value.code, caught.value.where) == (code, "photos")
        assert caught.value.hint
    assert without_photos(whole, []) is whole
