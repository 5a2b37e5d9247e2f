"""`biresnerf convert` for programs with special rules for the photos' folder, order and lens."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from biresnerf.data.formats.read_dataset import read_dataset
from biresnerf.data.model.dataset import Dataset
from biresnerf.errors import InputError
from tests.commands.poses.test_convert import BOUNDS, assert_same, by_file, converted, run, write_set
from tests.data.scenes import assert_complete


def by_photo(dataset: Dataset) -> dict[Path, np.ndarray]:
    """Poses by what a link to a photo leads to, so by the photo itself, wherever a format has it."""
    photos = [frame.path.resolve() for frame in dataset.frames]
    return dict(zip(photos, dataset.world_from_cam, strict=True))


# Photos of one folder; of two folders with the same file names; of two folders whose order is not that of file names.
@pytest.mark.parametrize(
    ("folders", "same_names"), [(("train",), False), (("left", "right"), True), (("b", "a"), False)]
)
def test_llff_has_its_photos_in_images_in_the_order_of_its_rows(
    tmp_path: Path, folders: tuple[str, ...], same_names: bool
) -> None:
    write_set(tmp_path / "given", seed=1, count=6, k1=0.0)
    file = tmp_path / "given" / "transforms.json"
    document = json.loads(file.read_text())
    for index, frame in enumerate(document["frames"]):
        number = index // 2 if same_names else index
        place = tmp_path / "given" / folders[index % len(folders)] / f"{(5 * number) % 7}.png"
        place.parent.mkdir(exist_ok=True)
        (tmp_path / "given" / frame["file_path"]).rename(place)
        frame["file_path"] = place.relative_to(tmp_path / "given").as_posix()
    (tmp_path / "given/images").rmdir()
    file.write_text(json.dumps(document))
    truth = by_photo(read_dataset(tmp_path / "given"))
    beside = [] if same_names else [("beside", ("--to", "transforms", "--to", "kitti"))]
    for name, more in [("alone", ()), *beside]:
        there = tmp_path / name
        converted(tmp_path / "given", there, "--to", "llff", *more, *BOUNDS)
        own = folders if more else ()
        assert sorted(path.name for path in there.iterdir() if path.is_dir()) == sorted({"images", *own})
        # As LLFF's readers pair them: the files of images/ by name, and the rows.
        photos = sorted((there / "images").iterdir())
        rows = np.load(there / "poses_bounds.npy")
        assert len(photos) == len(rows) == 6
        for photo, row in zip(photos, rows, strict=True):
            np.testing.assert_array_equal(row[:15].reshape(3, 5)[:, 3], truth[photo.resolve()][:3, 3])
        for place in ("poses_bounds.npy", *(("transforms.json", "kitti.txt") if more else ())):
            found = by_photo(read_dataset(there / place))
            for path, pose in truth.items():
                np.testing.assert_allclose(found[path], pose, rtol=0, atol=1e-9)


def test_photos_below_images_do_not_lie_there_twice(tmp_path: Path) -> None:
    write_set(tmp_path / "given", seed=1, count=4, k1=0.0)
    file = tmp_path / "given" / "transforms.json"
    (tmp_path / "given/images").rename(tmp_path / "given/left")
    (tmp_path / "given/images").mkdir()
    (tmp_path / "given/left").rename(tmp_path / "given/images/left")
    file.write_text(file.read_text().replace("images/", "images/left/"))
    refused = run(tmp_path / "given", tmp_path / "out", "--to", "llff", "--to", "tum", *BOUNDS)
    assert isinstance(refused.exception, InputError)
    assert_complete(refused.exception, "export_not_possible", "llff")
    converted(tmp_path / "given", tmp_path / "out", "--to", "llff", *BOUNDS)
    assert_same(read_dataset(tmp_path / "out"), read_dataset(tmp_path / "given"))


def test_kitti_has_its_rows_in_the_sets_order_and_names_their_images(tmp_path: Path) -> None:
    write_set(tmp_path / "given", seed=3, count=6)
    given_set = read_dataset(tmp_path / "given")
    assert list(given_set.names) != sorted(given_set.names)
    converted(tmp_path / "given", tmp_path / "there", "--to", "kitti", "--to", "tum")
    rows = np.loadtxt(tmp_path / "there/kitti.txt").reshape(-1, 3, 4)
    np.testing.assert_array_equal(rows, given_set.world_from_cam[:, :3])
    np.testing.assert_array_equal(rows[:, :, 3], np.loadtxt(tmp_path / "there/tum.txt")[:, 1:4])
    assert_same(read_dataset(tmp_path / "there/kitti.txt"), given_set)
    listed = tmp_path / "there/kitti_images.txt"
    assert listed.read_text().splitlines() == list(given_set.file_names)
    for text, code, where in (
        (listed.read_text().replace("12.png", "77.png"), "image_missing", "kitti.txt"),
        ("0.png\n", "pose_file_invalid", "kitti_images.txt"),
    ):
        listed.write_text(text)
        with pytest.raises(InputError) as caught:
            read_dataset(tmp_path / "there/kitti.txt")
        assert_complete(caught.value, code, where)


def test_a_lens_that_a_form_cannot_hold_gives_undistorted_photos_in_its_place(tmp_path: Path) -> None:
    write_set(tmp_path / "scene", seed=1, count=4)
    file = tmp_path / "scene" / "transforms.json"
    document = json.loads(file.read_text())
    file.write_text(json.dumps({**document, "camera_model": "FULL_OPENCV", "k3": 0.01, "k4": 0.02}))
    asked = ("--to", "tum", "--to", "nerfstudio", "--to", "bundler", "--to", "instant-ngp")
    done = converted(tmp_path / "scene", tmp_path / "out", *asked)
    assert list(done["formats"]) == ["tum", "pinhole"]
    said = [warning for warning in done["warnings"] if warning.startswith("pinhole was written instead of ")]
    assert [warning.split()[5] for warning in said] == ["nerfstudio:", "bundler:", "instant-ngp:"]
    assert "FULL_OPENCV" in said[0]
    there = {path.name for path in (tmp_path / "out/pinhole").iterdir()}
    assert {"transforms_nerfstudio.json", "transforms_ngp.json", "bundle.out", "sparse"} <= there
    truth = by_file(read_dataset(tmp_path / "scene"))
    for place in ("transforms_nerfstudio.json", "transforms_ngp.json", "bundle.out", "sparse/0"):
        flat = read_dataset(tmp_path / "out/pinhole" / place)
        assert {camera.model for camera in flat.cameras} <= {"PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL"}
        assert not any(camera.full().distorted for camera in flat.cameras)
        for name, pose in by_file(flat).items():
            np.testing.assert_allclose(pose, truth[name], rtol=0, atol=1e-9)


def test_a_set_without_points_says_that_splatting_cannot_start(tmp_path: Path) -> None:
    write_set(tmp_path / "bare", seed=1, count=4)
    said = converted(tmp_path / "bare", tmp_path / "out", "--to", "colmap", "--to", "tum")["warnings"]
    assert [warning for warning in said if warning.startswith("colmap: there are no points")]
    said = converted(tmp_path / "bare", tmp_path / "poses", "--to", "tum")["warnings"]
    assert not [warning for warning in said if "no points" in warning]
