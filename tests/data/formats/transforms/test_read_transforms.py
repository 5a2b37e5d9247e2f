"""transforms.json of three dialects: what is read from it, and what is refused and how."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from biresnerf.data.formats.colmap.write_binary import write_colmap_binary
from biresnerf.data.formats.read_dataset import read_dataset
from biresnerf.data.formats.transforms.write_transforms import write_transforms
from biresnerf.data.model.refined_set import refined_set
from biresnerf.geometry.camera.camera_models import Camera
from tests.data.scenes import (
    HEIGHT,
    WIDTH,
    blender_scene,
    nerfstudio_scene,
    save,
    write_image,
)

OPENGL = np.diag([1.0, -1, -1, 1])


def test_opengl_becomes_opencv(tmp_path):
    document = nerfstudio_scene(tmp_path)
    dataset = read_dataset(save(tmp_path, document))
    for frame, row in zip(dataset.frames, document["frames"], strict=True):
        given = np.array(row["transform_matrix"])
        np.testing.assert_allclose(frame.world_from_cam[:3, 3], given[:3, 3], atol=1e-14)
        np.testing.assert_allclose(frame.world_from_cam[:3, 0], given[:3, 0], atol=1e-14)  # right stays right
        np.testing.assert_allclose(frame.world_from_cam[:3, 1], -given[:3, 1], atol=1e-14)  # up turns down
        np.testing.assert_allclose(
            frame.world_from_cam[:3, 2], -given[:3, 2], atol=1e-14
        )  # it looks along -z
        assert frame.pose_source == "given"
        assert frame.raw == row


def test_shared_intrinsics_make_one_camera(tmp_path):
    dataset = read_dataset(save(tmp_path, nerfstudio_scene(tmp_path, k1=-0.01, p2=0.001)))
    assert dataset.cameras == (
        Camera("OPENCV", WIDTH, HEIGHT, (18.0, 18.5, 10.25, 7.75, -0.01, 0, 0, 0.001)),
    )
    assert dataset.names == tuple(f"images/{i:03}.jpg" for i in range(4))
    assert dataset.source.dialect == "nerfstudio"
    assert dataset.warnings == ()


def test_intrinsics_of_a_frame_go_before_the_shared_ones(tmp_path):
    document = nerfstudio_scene(tmp_path)
    document["frames"][2] |= {"fl_x": 21.0, "fl_y": 22.0, "cx": 9.0, "k1": 0.02}
    dataset = read_dataset(save(tmp_path, document))
    assert dataset.camera_of(2).full()[:5] == (21.0, 22.0, 9.0, 7.75, 0.02)
    assert dataset.camera_of(1).full()[:5] == (18.0, 18.5, 10.25, 7.75, 0.0)
    assert len(dataset.cameras) == 2


def test_images_of_mixed_sizes_with_their_own_intrinsics_are_read(tmp_path):
    document = nerfstudio_scene(tmp_path)
    for index, row in enumerate(document["frames"]):
        size = (20 + index, 16)
        write_image(tmp_path / row["file_path"], size=size)
        row |= {"w": size[0], "h": size[1], "fl_x": 20.0 + index, "fl_y": 20.0, "cx": 10.0, "cy": 8.0}
    dataset = read_dataset(save(tmp_path, document))
    assert [c.width for c in dataset.cameras] == [20, 21, 22, 23]
    assert [c.full().fx for c in dataset.cameras] == [20.0, 21.0, 22.0, 23.0]


def test_a_file_without_any_lens_gets_a_guessed_one_which_the_result_then_names(tmp_path):
    document = nerfstudio_scene(tmp_path)
    for key in ("camera_model", "fl_x", "fl_y", "cx", "cy", "w", "h"):
        del document[key]
    exif = Image.Exif()
    exif.get_ifd(0x8769)[0xA405] = 50  # focal length on 35 mm film
    Image.new("RGB", (WIDTH, HEIGHT)).save(tmp_path / "images/003.jpg", exif=exif)
    dataset = read_dataset(save(tmp_path, document))
    from_exif = 50 * math.hypot(WIDTH, HEIGHT) / math.hypot(36, 24)
    middle = (WIDTH / 2, HEIGHT / 2, 0.0)
    assert dataset.cameras == (
        Camera("SIMPLE_RADIAL", WIDTH, HEIGHT, (1.2 * WIDTH, *middle)),
        Camera("SIMPLE_RADIAL", WIDTH, HEIGHT, (from_exif, *middle)),
    )
    assert dataset.intrinsics_sources == ("guessed", "exif")
    assert {note.rpartition(" ")[2] for note in dataset.warnings if "focal length" in note} == {
        "guess",
        "EXIF",
    }
    write_transforms(dataset, dataset.world_from_cam, tmp_path / "out.json")
    again = read_dataset(tmp_path / "out.json")
    assert again.intrinsics_sources == ()
    assert [again.camera_of(i).full() for i in range(4)] == [dataset.camera_of(i).full() for i in range(4)]


def test_a_guessed_lens_is_of_the_model_that_the_file_declares(tmp_path):
    document = nerfstudio_scene(tmp_path)
    for key in ("fl_x", "fl_y", "cx", "cy"):
        del document[key]
    (camera,) = read_dataset(save(tmp_path, document)).cameras
    assert camera == Camera(
        "OPENCV", WIDTH, HEIGHT, (1.2 * WIDTH, 1.2 * WIDTH, WIDTH / 2, HEIGHT / 2, 0, 0, 0, 0)
    )


def test_blender_takes_the_focal_length_from_the_angle_and_the_true_width(tmp_path):
    dataset = read_dataset(save(tmp_path, blender_scene(tmp_path), "transforms_train.json"))
    focal = 0.5 * WIDTH / math.tan(0.5 * 0.6911112070083618)
    assert dataset.cameras == (Camera("PINHOLE", WIDTH, HEIGHT, (focal, focal, WIDTH / 2, HEIGHT / 2)),)
    assert dataset.source.dialect == "blender"
    assert dataset.names[1] == "./train/r_1"
    assert dataset.file_names[1] == "train/r_1.png"


def test_instant_ngp_takes_pixels_before_angles(tmp_path):
    document = nerfstudio_scene(tmp_path, aabb_scale=16, camera_angle_x=0.1, camera_angle_y=0.1)
    del document["camera_model"]
    dataset = read_dataset(save(tmp_path, document))
    assert dataset.source.dialect == "instant-ngp"
    assert dataset.cameras[0].full()[:4] == (18.0, 18.5, 10.25, 7.75)


def test_instant_ngp_degrees_of_view_are_read(tmp_path):
    document = nerfstudio_scene(tmp_path, x_fov=50.0)
    for key in ("fl_x", "fl_y", "camera_model"):
        del document[key]
    focal = 0.5 * WIDTH / math.tan(math.radians(25.0))
    assert read_dataset(save(tmp_path, document)).cameras[0].full().fx == pytest.approx(focal)


def test_paths_relative_to_the_working_directory_are_read(tmp_path, monkeypatch):
    save(tmp_path, nerfstudio_scene(tmp_path))
    monkeypatch.chdir(tmp_path)
    for path in (Path("."), Path("transforms.json")):
        assert read_dataset(path).file_names[0] == "images/000.jpg"


def test_one_focal_length_serves_both_axes(tmp_path):
    document = nerfstudio_scene(tmp_path)
    del document["fl_y"], document["cx"]
    dataset = read_dataset(save(tmp_path, document))
    assert dataset.cameras[0].full()[:4] == (18.0, 18.0, WIDTH / 2, 7.75)
    assert "image centre" in dataset.warnings[0]


@pytest.mark.parametrize(
    ("declared", "extra", "model"),
    [
        ("OPENCV", {}, "PINHOLE"),
        ("opencv", {"k1": 0.01}, "OPENCV"),
        ("PINHOLE", {}, "PINHOLE"),
        ("SIMPLE_PINHOLE", {"fl_y": 18.0}, "SIMPLE_PINHOLE"),
        ("SIMPLE_PINHOLE", {}, "PINHOLE"),
        ("SIMPLE_RADIAL", {"fl_y": 18.0, "k1": 0.01}, "SIMPLE_RADIAL"),
        ("RADIAL", {"fl_y": 18.0, "k1": 0.01, "k2": 0.01}, "RADIAL"),
        ("RADIAL", {"k1": 0.01, "p1": 0.001}, "OPENCV"),
        ("OPENCV", {"k1": 0.01, "k3": 0.001}, "FULL_OPENCV"),
        ("FULL_OPENCV", {"k1": 0.01, "k4": 0.02, "k6": 0.001}, "FULL_OPENCV"),
        ("OPENCV_FISHEYE", {}, "OPENCV_FISHEYE"),
        ("OPENCV_FISHEYE", {"k1": 0.01, "k3": -0.003, "k4": 0.001, "p1": 0.0}, "OPENCV_FISHEYE"),
        ("RADIAL_FISHEYE", {"fl_y": 18.0, "k1": 0.01}, "RADIAL_FISHEYE"),
        ("RADIAL_FISHEYE", {"k1": 0.01}, "OPENCV_FISHEYE"),
        (None, {"is_fisheye": True, "k1": 0.01, "k4": 0.001}, "OPENCV_FISHEYE"),
        (None, {"is_fisheye": False, "k1": 0.01}, "OPENCV"),
        (None, {}, "PINHOLE"),
        (None, {"p1": 0.001}, "OPENCV"),
    ],
)
def test_the_camera_model_is_the_declared_one_where_it_holds_the_numbers(tmp_path, declared, extra, model):
    document = nerfstudio_scene(tmp_path, camera_model=declared, **extra)
    camera = read_dataset(save(tmp_path, document)).cameras[0]
    assert camera.model == model
    expected = {"fl_y": 18.5} | extra
    full = camera.full()
    assert (full.fx, full.fy) == (18.0, expected["fl_y"])
    assert full.fisheye == ("FISHEYE" in model)
    for key in ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"):
        assert getattr(full, key) == expected.get(key, 0.0)


def test_applied_transform_and_scale_are_undone(tmp_path):
    applied = [[1.0, 0, 0, 0.5], [0, 0, 1, -2], [0, -1, 0, 3]]
    document = nerfstudio_scene(tmp_path, applied_transform=applied, applied_scale=2.5)
    a = np.vstack([applied, [0, 0, 0, 1]])
    originals = [np.array(row["transform_matrix"]) for row in document["frames"]]
    for row, original in zip(document["frames"], originals, strict=True):
        moved = a @ original
        moved[:3, 3] *= 2.5
        row["transform_matrix"] = moved.tolist()
    dataset = read_dataset(save(tmp_path, document))
    for frame, original in zip(dataset.frames, originals, strict=True):
        np.testing.assert_allclose(frame.world_from_cam, original @ OPENGL, atol=1e-12)


def test_intrinsics_of_a_larger_copy_are_scaled_by_the_true_ratios(tmp_path):
    document = nerfstudio_scene(tmp_path, w=41, h=33, fl_x=41.0, fl_y=33.0, cx=20.5, cy=16.5)
    dataset = read_dataset(save(tmp_path, document))
    assert dataset.cameras[0].full()[:4] == pytest.approx((WIDTH, HEIGHT, WIDTH / 2, HEIGHT / 2))
    assert "scaled" in dataset.warnings[0]


def test_three_by_four_matrices_are_read(tmp_path):
    document = nerfstudio_scene(tmp_path)
    expected = read_dataset(save(tmp_path, document)).world_from_cam
    for row in document["frames"]:
        row["transform_matrix"] = row["transform_matrix"][:3]
    assert np.array_equal(read_dataset(save(tmp_path, document)).world_from_cam, expected)


def test_rounded_rotations_are_made_orthonormal_and_said_so(tmp_path):
    document = nerfstudio_scene(tmp_path)
    document["frames"][1]["transform_matrix"] = np.round(
        document["frames"][1]["transform_matrix"], 3
    ).tolist()
    dataset = read_dataset(save(tmp_path, document))
    rotation = dataset.world_from_cam[1, :3, :3]
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-14)
    assert "orthonormal" in dataset.warnings[0]
    assert "images/001.jpg" in dataset.warnings[0]


@pytest.mark.parametrize("without", [[2], [0, 3], [0, 1, 2, 3]])
def test_frames_without_a_matrix_have_no_pose_yet_and_keep_their_camera(tmp_path, without):
    document = nerfstudio_scene(tmp_path)
    for index in without:
        document["frames"][index]["transform_matrix"] = None
    del document["frames"][without[0]]["transform_matrix"]
    dataset = read_dataset(save(tmp_path, document))
    assert dataset.posed.tolist() == [index not in without for index in range(4)]
    assert [frame.pose_source for frame in dataset.frames] == [
        None if index in without else "given" for index in range(4)
    ]
    assert len(dataset.cameras) == 1
    assert any(f"{len(without)} of 4 frames have no pose yet" in text for text in dataset.warnings)


def test_the_turn_that_older_nerfstudio_left_out_is_taken_from_the_model_that_shows_it(tmp_path):
    turn = np.array([[0.0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 0], [0, 0, 0, 1]])
    document = nerfstudio_scene(tmp_path)
    originals = read_dataset(save(tmp_path, document)).world_from_cam
    write_colmap_binary(refined_set(read_dataset(tmp_path), originals).model, tmp_path / "colmap/sparse/0")
    dataset = read_dataset(tmp_path)  # the model agrees with the file as it stands: nothing was left out
    np.testing.assert_array_equal(dataset.source.applied_transform, np.eye(4))
    for row in document["frames"]:
        row["transform_matrix"] = (turn @ np.array(row["transform_matrix"])).tolist()
    dataset = read_dataset(save(tmp_path, document))
    np.testing.assert_array_equal(dataset.source.applied_transform, turn)
    np.testing.assert_allclose(dataset.world_from_cam, originals, atol=1e-12)
    assert any("colmap/sparse/0 shows" in text for text in dataset.warnings)
    write_transforms(dataset, dataset.world_from_cam, tmp_path / "out.json")
    assert "applied_transform" not in json.loads((tmp_path / "out.json").read_text())
    for row, other in zip(
        document["frames"], json.loads((tmp_path / "out.json").read_text())["frames"], strict=True
    ):
        np.testing.assert_allclose(row["transform_matrix"], other["transform_matrix"], atol=1e-12)
