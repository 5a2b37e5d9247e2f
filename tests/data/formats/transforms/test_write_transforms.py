"""Writers: their files read back equal, here and in COLMAP, and the caller's data is kept."""

from __future__ import annotations

import importlib.util
import json
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from biresnerf.data.formats.colmap.write_binary import write_colmap_binary
from biresnerf.data.formats.read_dataset import read_dataset
from biresnerf.data.formats.transforms.write_transforms import write_transforms
from biresnerf.data.model.atomic_file import whole_file
from biresnerf.data.model.refined_set import refined_set
from biresnerf.geometry.camera.camera_models import Camera, smallest_model
from biresnerf.geometry.perturb import perturb_poses
from tests.data.scenes import blender_scene, nerfstudio_scene, opengl_poses, save, write_image

PYCOLMAP = """
import zlib, json, sys
import pycolmap
model = pycolmap.Reconstruction(sys.argv[1])
json.dump({
    "images": {image.name: [image.cam_from_world().matrix().tolist(), image.camera_id]
               for _, image in sorted(model.images.items())},
    "cameras": {number: [c.model.name, c.width, c.height, c.params.tolist()] for number, c in model.cameras.items()},
    "points": len(model.points3D),
}, sys.stdout)
"""


def odd_scene(folder):
    """Everything at once: keys of nobody's, an applied transform, 3 x 4 and 4 x 4 matrices, odd names, two cameras."""
    document = nerfstudio_scene(
        folder, applied_transform=[[1, 0, 0, 1], [0, 0, 1, 2], [0, -1, 0, 3]], applied_scale=0.5, k1=0.01
    )
    document |= {"note": "für später", "train_filenames": ["images/000.jpg"], "big": 12345678901234567890}
    document["frames"] = [document["frames"][i] for i in (2, 0, 3, 1)]
    document["frames"][1]["transform_matrix"] = document["frames"][1]["transform_matrix"][:3]
    document["frames"][2] |= {"sharpness": 12.5, "near": None, "fl_x": 25.0}
    write_image(folder / "images/a b ü.jpg")
    document["frames"][3]["file_path"] = "./images/a b ü.jpg"
    return read_dataset(save(folder, document)), document


@pytest.mark.parametrize("scene", ["odd", "blender"])
def test_unchanged_poses_write_the_same_file(tmp_path, scene):
    if scene == "odd":
        dataset, document = odd_scene(tmp_path)
    else:
        document = blender_scene(tmp_path)
        dataset = read_dataset(save(tmp_path, document))
    write_transforms(dataset, dataset.world_from_cam, tmp_path / "out.json")
    written = json.loads((tmp_path / "out.json").read_text("utf-8"))
    assert list(written) == list(document)
    for row, given in zip(written["frames"], document["frames"], strict=True):
        assert list(row) == list(given)
        np.testing.assert_allclose(row.pop("transform_matrix"), given.pop("transform_matrix"), atol=1e-13)
    assert written == document


def test_changed_poses_read_back_equal(tmp_path):
    dataset, _ = odd_scene(tmp_path)
    refined = perturb_poses(dataset.world_from_cam, 0.1, 3)
    write_transforms(dataset, refined, tmp_path / "refined.json")
    again = read_dataset(tmp_path / "refined.json")
    np.testing.assert_allclose(again.world_from_cam, refined, atol=1e-12)
    assert again.names == dataset.names
    assert again.cameras == dataset.cameras
    assert again.source.dialect == dataset.source.dialect


def test_colmap_reads_the_model_with_the_same_names_cameras_and_poses(tmp_path):
    if importlib.util.find_spec("pycolmap") is None:
        pytest.skip("pycolmap is not installed")
    dataset, _ = odd_scene(tmp_path)
    refined = perturb_poses(dataset.world_from_cam, 0.1, 3)
    folder = tmp_path / "colmap/sparse/0"
    write_colmap_binary(refined_set(dataset, refined).model, folder)
    assert sorted(p.name for p in folder.iterdir()) == ["cameras.bin", "images.bin", "points3D.bin"]
    answer = subprocess.run(
        [sys.executable, "-c", PYCOLMAP, str(folder)], capture_output=True, text=True, timeout=60, check=True
    )
    model = json.loads(answer.stdout)
    assert list(model["images"]) == ["images/002.jpg", "images/000.jpg", "images/003.jpg", "images/a b ü.jpg"]
    assert model["points"] == 0
    for index, name in enumerate(dataset.file_names):
        matrix, camera_id = model["images"][name]
        expected = np.linalg.inv(refined[index])[:3]
        np.testing.assert_allclose(matrix, expected, atol=1e-12)
        assert Camera(*model["cameras"][str(camera_id)][:3], tuple(model["cameras"][str(camera_id)][3])) == (
            dataset.camera_of(index)
        )


@pytest.mark.parametrize(
    ("model", "extra"),
    [
        ("SIMPLE_PINHOLE", {"fl_y": 18.0}),
        ("PINHOLE", {}),
        ("SIMPLE_RADIAL", {"fl_y": 18.0, "k1": 0.01}),
        ("RADIAL", {"fl_y": 18.0, "k1": 0.01, "k2": -0.01}),
        ("OPENCV", {"k1": 0.01, "k2": -0.01, "p1": 0.001, "p2": 0.002}),
    ],
)
def test_colmap_reads_every_camera_model(tmp_path, model, extra):
    if importlib.util.find_spec("pycolmap") is None:
        pytest.skip("pycolmap is not installed")
    dataset = read_dataset(save(tmp_path, nerfstudio_scene(tmp_path, camera_model=model, **extra)))
    write_colmap_binary(refined_set(dataset, dataset.world_from_cam).model, tmp_path / "0")
    answer = subprocess.run(
        [sys.executable, "-c", PYCOLMAP, str(tmp_path / "0")],
        capture_output=True,
        text=True,
        timeout=60,
        check=True,
    )
    name, width, height, params = json.loads(answer.stdout)["cameras"]["1"]
    assert Camera(name, width, height, tuple(params)) == dataset.cameras[0]
    assert name == model


def test_poses_that_are_not_finite_or_too_few_are_never_written(tmp_path):
    dataset = read_dataset(save(tmp_path, nerfstudio_scene(tmp_path)))
    poses = dataset.world_from_cam
    broken = poses.copy()
    broken[2, 1, 3] = np.nan
    for wrong in (broken, poses[:3]):
        with pytest.raises(ValueError, match="poses must be finite"):
            write_transforms(dataset, wrong, tmp_path / "out.json")
        with pytest.raises(ValueError, match="poses must be finite"):
            refined_set(dataset, wrong)
    assert not (tmp_path / "out.json").exists()


def test_a_writer_that_fails_leaves_the_old_file_and_nothing_else(tmp_path):
    path = tmp_path / "out.json"
    path.write_text("old")

    def fail_half_way():
        with whole_file(path) as temporary:
            temporary.write_text("half")
            raise RuntimeError("the disk is full")

    with pytest.raises(RuntimeError, match="full"):
        fail_half_way()
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_whole_files_take_the_umask_like_any_other(tmp_path):
    with whole_file(tmp_path / "a.json") as temporary:
        temporary.write_text("{}")
    (tmp_path / "b.json").write_text("{}")
    assert (tmp_path / "a.json").stat().st_mode == (tmp_path / "b.json").stat().st_mode


def test_opengl_poses_of_the_test_scenes_are_rigid():
    for pose in np.array(opengl_poses(5)):
        np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-12)


LENSES = [
    Camera("SIMPLE_RADIAL", 20, 16, (18.0, 10.0, 8.0, 0.01)),
    Camera("FULL_OPENCV", 20, 16, (18.0, 19.0, 10.0, 8.0, 0.01, 0.02, 1e-3, -1e-3, 0.03, 0.04, 0.05, 0.06)),
    Camera("OPENCV_FISHEYE", 20, 16, (12.0, 12.5, 10.0, 8.0, 0.01, 0.002, -0.003, 0.0004)),
    Camera("RADIAL_FISHEYE", 20, 16, (12.0, 10.0, 8.0, 0.01, 0.002)),
]


@pytest.mark.parametrize("cameras", [*((lens,) for lens in LENSES), tuple(LENSES)])
def test_any_lens_of_a_folder_of_images_is_written_so_that_it_reads_back(tmp_path, cameras):
    dataset, _ = odd_scene(tmp_path)
    source = replace(dataset.source, dialect="images", document={}, applied_transform=np.eye(4))
    frames = tuple(replace(frame, camera=i % len(cameras), raw={}) for i, frame in enumerate(dataset.frames))
    dataset = replace(dataset, cameras=cameras, frames=frames, source=source)
    write_transforms(dataset, dataset.world_from_cam, tmp_path / "out.json")
    again = read_dataset(tmp_path / "out.json")
    for i, frame in enumerate(again.frames):
        given, read = dataset.camera_of(i), again.cameras[frame.camera]
        assert (read.width, read.height, read.full()) == (given.width, given.height, given.full())
    written = json.loads((tmp_path / "out.json").read_text("utf-8"))
    for row in (written, *written["frames"]):
        if "FISHEYE" in row.get("camera_model", ""):
            assert not row.keys() & {"p1", "p2"}  # instant-ngp would take them for k3 and k4


def refined(dataset, *, factor: float = 1.1):
    """The set with every lens changed and marked as refined."""
    cameras = []
    for camera in dataset.cameras:
        values = camera.full()._replace(fx=camera.full().fx * factor, fy=camera.full().fy * factor)
        model, params = smallest_model(values, camera.model)
        cameras.append(replace(camera, model=model, params=params))
    return replace(dataset, cameras=tuple(cameras), intrinsics_sources=("refined",) * len(cameras))


@pytest.mark.parametrize("scene", ["odd", "blender", "ngp", "fisheye", "scaled"])
def test_refined_intrinsics_are_written_where_the_input_has_them_and_read_back(tmp_path, scene):
    if scene == "odd":
        dataset, document = odd_scene(tmp_path)
    elif scene == "blender":
        document = blender_scene(tmp_path)
    else:
        extra = {
            "ngp": {"aabb_scale": 4, "camera_angle_x": 1.0, "x_fov": 50.0, "k1": 0.01},
            "fisheye": {"camera_model": "OPENCV_FISHEYE", "k1": 0.01, "k3": 0.002},
            "scaled": {"w": 40, "h": 32, "fl_x": 36.0, "fl_y": 36.0, "cx": 20.0, "cy": 16.0},
        }[scene]
        document = nerfstudio_scene(tmp_path, **extra)
    dataset = read_dataset(save(tmp_path, document))
    changed = refined(dataset)
    write_transforms(changed, dataset.world_from_cam, tmp_path / "out.json")
    again = read_dataset(tmp_path / "out.json")
    for i in range(len(dataset)):
        assert again.camera_of(i).model == dataset.camera_of(i).model
        np.testing.assert_allclose(again.camera_of(i).full(), changed.camera_of(i).full(), rtol=1e-12)
    written = json.loads((tmp_path / "out.json").read_text("utf-8"))
    lens_keys = {"w", "h", "fl_x", "fl_y", "cx", "cy"}
    assert set(written) - lens_keys == set(document) - lens_keys
    if scene == "blender":
        assert not set(written) & {"fl_x", "cx"}
    if scene == "ngp":  # instant-ngp takes fl_x first, others the angle: they must agree
        assert np.tan(written["camera_angle_x"] / 2) == pytest.approx(10 / written["fl_x"])
        assert np.radians(written["x_fov"]) == pytest.approx(written["camera_angle_x"])


def test_lenses_that_were_not_refined_keep_their_numbers_to_the_letter(tmp_path):
    dataset, document = odd_scene(tmp_path)
    changed = refined(dataset)
    own = dataset.frames[2].camera
    changed = replace(
        changed,
        cameras=tuple(c if i == own else dataset.cameras[i] for i, c in enumerate(changed.cameras)),
        intrinsics_sources=tuple("refined" if i == own else "given" for i in range(len(changed.cameras))),
    )
    write_transforms(changed, dataset.world_from_cam, tmp_path / "out.json")
    written = json.loads((tmp_path / "out.json").read_text("utf-8"))
    assert written["frames"][2]["fl_x"] == pytest.approx(1.1 * 25.0)
    for row in (written, written["frames"][2]):
        row.pop("frames", None)
    assert written == {key: value for key, value in document.items() if key != "frames"}
