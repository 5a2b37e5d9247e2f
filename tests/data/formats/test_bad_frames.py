"""What a few bad frames do to a set: the others are read, the report says what was left out, and strict refuses it."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pycolmap
import pytest

from biresnerf.data.formats.colmap.write_binary import write_colmap_binary
from biresnerf.data.formats.read_dataset import read_dataset
from biresnerf.data.model.part_of_set import without_images
from biresnerf.errors import InputError
from tests.data.formats.random_sets import random_result
from tests.data.formats.simple import trajectories
from tests.data.formats.simple.trajectories import truth
from tests.data.scenes import assert_complete, nerfstudio_scene, opengl_poses, save, write_image


def _pose(change):
    def apply(folder, row):
        matrix = np.array(row["transform_matrix"])
        change(matrix)
        row["transform_matrix"] = matrix.tolist()

    return apply


def _set(row, column, value):
    def change(matrix):
        matrix[row, column] = value

    return _pose(change)


# Each: the code, how many frames and how many poses are left of five.
BAD = {
    "no photo": ("image_missing", 4, 4, lambda folder, row: (folder / row["file_path"]).unlink()),
    "no picture": (
        "not_an_image",
        4,
        4,
        lambda folder, row: (folder / row["file_path"]).write_bytes(b"text"),
    ),
    "NaN": ("pose_not_finite", 5, 4, _set(0, 3, math.nan)),
    "mirrored": ("pose_not_rotation", 5, 4, _pose(lambda m: m[:3, 0].__imul__(-1))),
    "lens": ("intrinsics_invalid", 4, 4, lambda folder, row: row.update(fl_x=-3.0)),
    "no name": ("frame_without_image", 4, 4, lambda folder, row: row.pop("file_path")),
    "twice": ("duplicate_image", 4, 4, lambda folder, row: row.update(file_path="./images/000.jpg")),
    "mask": ("mask_missing", 4, 4, lambda folder, row: row.update(mask_path="none.png")),
}


@pytest.mark.parametrize("case", BAD)
def test_one_bad_frame_is_left_out_and_named_and_strict_reading_refuses_it(tmp_path, case):
    code, frames, posed, change = BAD[case]
    document = nerfstudio_scene(tmp_path, count=5)
    change(tmp_path, document["frames"][3])
    path = save(tmp_path, document)
    dataset = read_dataset(path)
    assert (len(dataset), int(dataset.posed.sum())) == (frames, posed)
    expected = np.delete(np.array(opengl_poses(5)), 3, axis=0)[:, :3, 3]
    found = [frame.world_from_cam[:3, 3] for frame in dataset.frames if frame.world_from_cam is not None]
    np.testing.assert_allclose(found, expected, atol=1e-12)
    [warning] = [text for text in dataset.warnings if " left out" in text and "beside" not in text]
    assert "1 of 5" in warning
    assert "frames[3]" in warning or "003.jpg" in warning
    with pytest.raises(InputError) as caught:
        read_dataset(path, strict=True)
    assert caught.value.code == code


@pytest.mark.parametrize(("count", "bad"), [(3, 1), (6, 3), (40, 38)])
def test_a_set_of_which_less_than_most_is_good_is_refused(tmp_path, count, bad):
    document = nerfstudio_scene(tmp_path, count=count)
    for index in range(bad):
        (tmp_path / f"images/{index:03}.jpg").unlink()
    with pytest.raises(InputError) as caught:
        read_dataset(save(tmp_path, document))
    assert_complete(caught.value, "image_missing", "transforms.json", "frames[0]")


def test_a_colmap_model_is_read_without_the_image_whose_photo_is_missing(tmp_path):
    refined = random_result(0, 6)
    for image in refined.images:
        write_image(tmp_path / image.file_name, size=(64, 48))
    write_colmap_binary(refined.model, tmp_path / "sparse/0")
    whole = read_dataset(tmp_path)
    gone = whole.frames[2]
    gone.path.unlink()
    dataset = read_dataset(tmp_path)
    assert dataset.names == tuple(name for name in whole.names if name != gone.name)
    assert any("1 of 6 images not found" in text for text in dataset.warnings)
    model = dataset.source.colmap
    assert gone.name not in {image.name for image in model.images.values()}
    write_colmap_binary(model, tmp_path / "again")
    read = pycolmap.Reconstruction(tmp_path / "again")  # checks tracks and features against each other
    assert read.num_images() == 5
    seen = {point.image_id for track in read.points3D.values() for point in track.track.elements}
    assert seen <= set(read.images)
    assert read.num_points3D() == len(without_images(whole.source.colmap, {gone.name}).points)


def test_a_label_of_metashape_without_photo_and_a_bad_camera_of_a_json_are_left_out(tmp_path):
    trajectories.write_images(tmp_path)
    (tmp_path / "cameras.xml").write_text(trajectories.metashape_xml())
    (tmp_path / "images/b.png").unlink()
    dataset = read_dataset(tmp_path)
    assert dataset.names == ("a.png", "c.png", "d.png")
    np.testing.assert_allclose(dataset.world_from_cam, truth()[[0, 2, 3]], atol=1e-12)


def test_comments_in_a_transforms_file_are_read_over_and_wrong_json_is_still_placed(tmp_path):
    document = json.dumps(
        nerfstudio_scene(tmp_path) | {"note": "http://example.org/* no comment */"}, indent=1
    )
    lines = document.splitlines()
    lines[2] += " // said by a person"
    path = save(tmp_path, "/* by hand\n */\n" + "\n".join(lines))
    assert read_dataset(path).source.document["note"] == "http://example.org/* no comment */"
    path.write_text(path.read_text().replace('"frames"', "frames", 1))
    with pytest.raises(InputError, match="line"):
        read_dataset(path)


def spoil_line(path: Path, line: int, text: str) -> None:
    lines = path.read_text().splitlines()
    lines[line] = text
    path.write_text("\n".join(lines) + "\n")


def spoil_row(path: Path) -> None:
    rows = np.load(path)
    rows[1, 0] = np.nan
    np.save(path, rows)


SPOILED = {
    "tum": lambda folder: spoil_line(folder / "trajectory.txt", 1, "1 0 0 0 0 0 0 one"),
    "kitti": lambda folder: spoil_line(folder / "poses.txt", 1, "1 0 0"),
    "bundler": lambda folder: spoil_line(folder / "bundle.out", 8, "2 0 0"),
    "llff": lambda folder: spoil_row(folder / "poses_bounds.npy"),
    "metashape": lambda folder: (folder / "cameras.xml").write_text(
        (folder / "cameras.xml").read_text().replace('label="b"><transform>', 'label="b"><transform>7 ')
    ),
}
PLACES = {
    "tum": "line 2",
    "kitti": "line 2",
    "bundler": "camera 1",
    "llff": "row 1",
    "metashape": "camera 'b'",
}


@pytest.mark.parametrize("form", SPOILED)
def test_one_bad_line_costs_one_image_its_pose_and_is_named(tmp_path, form):
    trajectories.write_set(form, tmp_path)
    SPOILED[form](tmp_path)
    dataset = read_dataset(tmp_path)
    assert dataset.posed.tolist() == [True, False, True, True]
    kept = [frame.world_from_cam for frame in dataset.frames if frame.world_from_cam is not None]
    np.testing.assert_allclose(kept, trajectories.truth()[[0, 2, 3]], atol=1e-12)
    said = [text for text in dataset.warnings if "1 of 4 poses cannot be used" in text]
    assert len(said) == 1
    assert PLACES[form] in said[0]
    with pytest.raises(InputError) as caught:
        read_dataset(tmp_path, strict=True)
    assert PLACES[form] in caught.value.where
