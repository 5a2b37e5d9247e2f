"""Copies of a photo, in the same bytes or in others, are left out and named; photos that differ stay."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from biresnerf.data.formats.read_dataset import read_dataset
from biresnerf.data.model.dataset import Dataset
from biresnerf.data.photos.alike.copied_photos import without_copies
from tests.data.formats.simple import trajectories

SIZE = (641, 480)


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


def landscape(seed: int, *, shift_px: float = 0.0) -> Image.Image:
    """A picture with detail of all sizes, as photos have, moved to the left."""
    rng = np.random.default_rng(seed)
    total = np.zeros((SIZE[1], SIZE[0]), np.float32)
    for cells, strength in ((6, 60), (24, 40), (96, 25), (320, 12)):
        noise = Image.fromarray(rng.normal(0, strength, (cells, cells)).astype(np.float32))
        step = cells * shift_px / (2 * SIZE[0])
        wide = noise.resize(SIZE, Image.Resampling.BICUBIC, box=(step, 0, cells / 2 + step, cells / 2))
        total += np.asarray(wide)
    return Image.fromarray(np.clip(128 + total, 0, 255).astype(np.uint8)).convert("RGB")


def four_photos(folder: Path) -> None:
    for i in range(4):
        landscape(i).save(folder / f"{i}.png")


def left_out(folder: Path) -> set[str]:
    whole = read_dataset(folder)
    return set(whole.names) - set(without_copies(whole).names)


@pytest.mark.parametrize("name", ["c95.jpg", "c50.jpg", "c75.webp"])
def test_a_picture_compressed_again_is_a_copy(tmp_path, name):
    four_photos(tmp_path)
    landscape(2).save(tmp_path / name, quality=int(name[1:3]))
    whole = read_dataset(tmp_path)
    part = without_copies(whole)
    assert set(whole.names) - set(part.names) == {name}
    (note,) = set(part.warnings) - set(whole.warnings)
    assert f"{name} (of 2.png, compressed again)" in note


def test_the_larger_of_two_pictures_stays_unless_the_other_alone_has_a_pose(tmp_path):
    four_photos(tmp_path)
    landscape(2).resize((320, 240), Image.Resampling.LANCZOS).save(tmp_path / "0 half.jpg", quality=85)
    assert left_out(tmp_path) == {"0 half.jpg"}
    whole = read_dataset(tmp_path)
    frames = tuple(
        replace(f, world_from_cam=np.eye(4), pose_source="given") if f.name == "0 half.jpg" else f
        for f in whole.frames
    )
    part = without_copies(replace(whole, frames=frames))
    assert set(whole.names) - set(part.names) == {"2.png"}


def test_a_photo_that_a_program_set_upright_is_a_copy_of_the_one_that_says_how_to_turn_it(tmp_path):
    four_photos(tmp_path)
    exif = Image.Exif()
    exif[0x0112] = 6
    landscape(9).save(tmp_path / "camera.jpg", exif=exif, quality=90)
    landscape(9).transpose(Image.Transpose.ROTATE_270).save(tmp_path / "upright.jpg", quality=80)
    assert left_out(tmp_path) == {"upright.jpg"}


@pytest.mark.parametrize("share", [0.002, 0.005, 0.02])
def test_a_camera_that_moved_by_a_five_hundredth_of_the_picture_took_another_photo(tmp_path, share):
    four_photos(tmp_path)
    landscape(2, shift_px=share * SIZE[0]).save(tmp_path / "next.jpg", quality=85)
    assert left_out(tmp_path) == set()


def test_a_small_thing_that_moved_before_a_still_scene_makes_another_photo(tmp_path):
    four_photos(tmp_path)
    scene = np.array(landscape(2))
    scene[200:230, 300:340] = np.minimum(scene[200:230, 300:340], 240) + 15
    Image.fromarray(scene).save(tmp_path / "walker.jpg", quality=90)
    assert left_out(tmp_path) == set()


def test_the_same_picture_with_given_poses_far_apart_is_no_copy(tmp_path):
    """A vase that turned looks alike from all sides."""
    four_photos(tmp_path)
    landscape(2).save(tmp_path / "c.jpg", quality=80)
    whole = read_dataset(tmp_path)

    def at(moved: float) -> Dataset:
        poses = np.tile(np.eye(4), (5, 1, 1))
        poses[:, 0, 3] = np.arange(5)
        row = {name: i for i, name in enumerate(whole.names)}
        poses[row["c.jpg"], 0, 3] = poses[row["2.png"], 0, 3] + moved
        frames = tuple(replace(f, world_from_cam=pose) for f, pose in zip(whole.frames, poses, strict=True))
        return replace(whole, frames=frames)

    assert len(without_copies(at(1.0))) == 5
    assert len(without_copies(at(0.01))) == 4


def test_pictures_without_anything_in_them_are_no_copies_of_each_other(tmp_path):
    four_photos(tmp_path)
    for i in range(2):
        dark = np.random.default_rng(i).integers(2, 5, (SIZE[1], SIZE[0], 3), np.uint8)
        Image.fromarray(dark).save(tmp_path / f"dark{i}.png")
    assert left_out(tmp_path) == set()
