"""Dialects of transforms.json: other keys mean what their programs mean by them, and unknown ones are refused."""

from __future__ import annotations

import json

import numpy as np
import pytest

from biresnerf.data.formats.read_dataset import read_dataset
from biresnerf.data.formats.transforms.write_transforms import write_transforms
from biresnerf.errors import InputError
from tests.data.formats.random_sets import random_poses
from tests.data.scenes import assert_complete, nerfstudio_scene, save, write_image

TRUTH = random_poses(np.random.default_rng(5), 4)  # world_from_cam, OpenCV axes
K = [[18.0, 0.0, 10.25], [0.0, 18.5, 7.75], [0.0, 0.0, 1.0]]
LENS = (18.0, 18.5, 10.25, 7.75)


def frames(folder, matrices, **more):
    for index in range(len(matrices)):
        write_image(folder / f"images/{index}.png", index)
    return [
        {"file_path": f"images/{index}.png", "transform_matrix": matrix.tolist(), **more}
        for index, matrix in enumerate(matrices)
    ]


# What each program has the camera's axes as, by columns of OpenCV's.
AXES = {"from_na": (1.0, 1.0, 1.0, 1.0), "normal_mts_args": (-1.0, -1.0, 1.0, 1.0)}


@pytest.mark.parametrize("key", AXES)
def test_cameras_of_other_axes_are_read_and_written_with_opengls(tmp_path, key):
    rows = frames(tmp_path, TRUTH * AXES[key], intrinsic_matrix=K)
    save(tmp_path, {key: True, "w": 20, "h": 16, "aabb_scale": 1, "frames": rows}, "transform.json")
    dataset = read_dataset(tmp_path)
    np.testing.assert_allclose(dataset.world_from_cam, TRUTH, atol=1e-12)
    assert {camera.params for camera in dataset.cameras} == {LENS}
    assert dataset.intrinsics_sources == ()
    assert any(key in text for text in dataset.warnings)
    out = tmp_path / "out"
    out.mkdir()
    write_transforms(dataset, TRUTH, out / "transforms.json")
    document = json.loads((out / "transforms.json").read_text())
    assert key not in document
    for row, pose in zip(document["frames"], TRUTH, strict=True):
        np.testing.assert_allclose(row["transform_matrix"], pose * (1, -1, -1, 1), atol=1e-12)


@pytest.mark.parametrize(
    "lens",
    [
        K,
        np.pad(K, ((0, 1), (0, 1))).tolist(),
        np.ravel(K).tolist(),
        list(LENS),
        dict(zip(("fx", "fy", "cx", "cy"), LENS, strict=True)),
    ],
    ids=["3 x 3", "4 x 4", "flat", "four numbers", "four names"],
)
@pytest.mark.parametrize("key", ["intrinsic_matrix", "K", "intrinsics"])
def test_a_matrix_at_the_top_is_the_lens_unless_a_focal_length_is_given(tmp_path, key, lens):
    document = nerfstudio_scene(tmp_path)
    given = {name: document.pop(name) for name in ("fl_x", "fl_y", "cx", "cy")}
    save(tmp_path, document | {key: lens})
    assert read_dataset(tmp_path).cameras[0].params == LENS
    save(tmp_path, document | given | {"fl_x": 17.0, key: lens})
    assert read_dataset(tmp_path).cameras[0].params == (17.0, *LENS[1:])


def test_fx_and_fy_are_focal_lengths_where_no_other_is_given(tmp_path):
    document = nerfstudio_scene(tmp_path)
    document |= {"fx": document.pop("fl_x"), "fy": document.pop("fl_y")}
    assert read_dataset(save(tmp_path, document)).cameras[0].params == LENS


def test_the_first_of_two_poses_of_a_rolling_shutter_is_the_frames(tmp_path):
    document = nerfstudio_scene(tmp_path)
    given = read_dataset(save(tmp_path, document)).world_from_cam
    for row in document["frames"]:
        row["transform_matrix_start"] = row.pop("transform_matrix")
        row["transform_matrix_end"] = np.eye(4).tolist()
    np.testing.assert_array_equal(read_dataset(save(tmp_path, document)).world_from_cam, given)


@pytest.mark.parametrize("above", ["", "/home/a/data/scene/", "data/scene/"])
def test_cameras_that_nerfstudio_exported_are_read_with_those_of_its_evaluation(tmp_path, above):
    opengl = TRUTH * (1, -1, -1, 1)
    rows = [
        {"file_path": above + row["file_path"], "transform": row["transform_matrix"][:3]}
        for row in frames(tmp_path, opengl)
    ]
    save(tmp_path, rows[:3], "transforms_train.json")
    save(tmp_path, rows[3:], "transforms_eval.json")
    dataset = read_dataset(tmp_path)
    np.testing.assert_allclose(dataset.world_from_cam, TRUTH, atol=1e-12)
    assert dataset.intrinsics_sources == ("guessed",)
    assert any("ns-export" in text for text in dataset.warnings)


@pytest.mark.parametrize(
    ("change", "code", "where"),
    [
        (lambda d: d.update(camera_convention="opencv"), "pose_file_invalid", "camera_convention"),
        (lambda d: d.update(is_opencv=True), "pose_file_invalid", "is_opencv"),
        (lambda d: d.update(world_to_camera=True), "pose_file_invalid", "world_to_camera"),
        (lambda d: d.update(distortion=[0.1, 0, 0, 0]), "intrinsics_invalid", "distortion"),
        (
            lambda d: [row.update(w2c=row.pop("transform_matrix")) for row in d["frames"]],
            "pose_file_invalid",
            "frames[0].w2c",
        ),
        (
            lambda d: [d.pop("fl_x"), d.pop("fl_y"), d.update(K=[[18, 3, 10], [0, 18, 8], [0, 0, 1]])],
            "intrinsics_invalid",
            "transforms.json K",
        ),
    ],
)
def test_a_key_that_would_change_the_meaning_is_refused_by_name(tmp_path, change, code, where):
    document = nerfstudio_scene(tmp_path)
    change(document)
    save(tmp_path, document)
    with pytest.raises(InputError) as caught:
        read_dataset(tmp_path)
    assert_complete(caught.value, code, where)


def test_keys_that_say_what_is_so_anyway_are_left_alone(tmp_path):
    more = {
        "coordinate_system": "opengl",
        "convention": "nerfstudio",
        "is_opencv": False,
        "distortion": [0, 0],
    }
    assert len(read_dataset(save(tmp_path, nerfstudio_scene(tmp_path, **more)))) == 4
