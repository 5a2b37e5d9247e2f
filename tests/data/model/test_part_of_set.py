"""A set without some of its photos is the set that never had them."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from biresnerf.data.formats.read_dataset import read_dataset
from biresnerf.data.model.part_of_set import without_copies, without_photos
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
    assert without_photos(whole, []) is whole


def test_copies_of_a_photo_are_left_out_and_named(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    for i in range(4):
        Image.fromarray(rng.integers(0, 255, (24, 32, 3), np.uint8)).save(tmp_path / f"{i}.png")
    for copy, original in (("1 (1)", "1"), ("z", "1"), ("z2", "3")):
        shutil.copy(tmp_path / f"{original}.png", tmp_path / f"{copy}.png")
    whole = read_dataset(tmp_path)
    part = without_copies(whole)
    first = {name: min(n for n in whole.names if same(tmp_path, n, name)) for name in whole.names}
    assert set(part.names) == set(first.values())
    (note,) = set(part.warnings) - set(whole.warnings)
    assert note.startswith("3 of 7 photos are copies of others")
    for copy in set(whole.names) - set(part.names):
        assert copy in note
    assert without_copies(part) is part
    kept = without_copies(whole, [name for name in whole.names if name.startswith("z")])
    assert {Path(name).stem for name in kept.names} == {"0", "2", "z", "z2"}, "what is to stay, stays"


def test_a_photo_whose_metadata_alone_a_program_changed_is_a_copy(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    for i in range(4):
        picture, exif = Image.fromarray(rng.integers(0, 255, (24, 32, 3), np.uint8)), Image.Exif()
        exif[0x010F] = "a maker"
        picture.save(tmp_path / f"{i}.jpg", exif=exif)
    stored = (tmp_path / "1.jpg").read_bytes()
    said = b"\xff\xfe\x00\x08edited"  # a comment behind the start of the image
    (tmp_path / "edited.jpg").write_bytes(stored[:2] + said + stored[2:])
    (tmp_path / "other.jpg").write_bytes(
        stored[:-3] + b"\x00" + stored[-2:]
    )  # another picture of the same size
    whole = read_dataset(tmp_path)
    part = without_copies(whole)
    assert {Path(name).stem for name in set(whole.names) - set(part.names)} == {"edited"}
    (note,) = set(part.warnings) - set(whole.warnings)
    assert "edited.jpg (of 1.jpg)" in note


def test_a_copy_whose_pose_differs_from_its_originals_is_said(tmp_path: Path) -> None:
    """As of a rig of which one photo was copied over another: two poses for one picture cannot both hold."""
    trajectories.colmap_set(tmp_path)
    first, second = (read_dataset(tmp_path).frames[row].path for row in (0, 1))
    shutil.copy(first, second)
    part = without_copies(whole := read_dataset(tmp_path))
    (note,) = set(part.warnings) - set(whole.warnings)
    assert f"other poses for {whole.names[1]} than" in note
    pose = whole.frames[0].world_from_cam
    assert pose is not None
    almost = pose.copy()
    almost[:3, 3] += 1e-7
    frames = tuple(
        replace(f, world_from_cam=almost if row == 1 else f.world_from_cam)
        for row, f in enumerate(whole.frames)
    )
    (note,) = set(without_copies(replace(whole, frames=frames)).warnings) - set(whole.warnings)
    assert "other poses" not in note


def same(folder: Path, one: str, other: str) -> bool:
    return (folder / one).read_bytes() == (folder / other).read_bytes()


def test_copies_stay_where_too_few_photos_would_be_left(tmp_path: Path) -> None:
    for i in range(5):
        Image.new("RGB", (32, 24), (90, 90, 90 + i // 4)).save(tmp_path / f"{i}.png")
    whole = read_dataset(tmp_path)
    assert without_copies(whole) is whole
