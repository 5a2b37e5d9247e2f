"""COLMAP's two forms: they read back bit by bit, here and in COLMAP, ids and rigs included."""

from __future__ import annotations

import importlib.util
import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from biresnerf.data.formats.colmap.read_model import read_colmap_model
from biresnerf.data.formats.colmap.write_binary import write_colmap_binary
from biresnerf.data.formats.colmap.write_text import write_colmap_text
from biresnerf.data.model.colmap_scene import matrix_of_pose
from biresnerf.data.model.result_model import model_at_poses
from biresnerf.errors import InputError
from biresnerf.geometry.camera.pixel_rays import pixels_of_points
from biresnerf.geometry.rigid import rigid_inverse, rotation_from_quat_wxyz
from tests.data.formats.random_sets import random_model, random_poses, random_result
from tests.data.scenes import assert_complete

needs_colmap = pytest.mark.skipif(
    importlib.util.find_spec("pycolmap") is None, reason="pycolmap is not installed"
)
OTHER_VERSIONS = os.environ.get("BIRESNERF_TEST_PYCOLMAPS")
PYCOLMAP = """
import zlib, json, sys
import pycolmap
def pose(p): return [p.rotation.quat[[3, 0, 1, 2]].tolist(), p.translation.tolist()]
answer = []
for folder in sys.argv[1:]:
    m = pycolmap.Reconstruction(folder)
    answer.append({
        "cameras": {i: [c.model.name, c.width, c.height, c.params.tolist()] for i, c in m.cameras.items()},
        "images": {i: [im.name, im.camera_id, im.frame_id, pose(im.cam_from_world()),
                       [[*p.xy.tolist(), p.point3D_id if p.has_point3D() else -1] for p in im.points2D]]
                   for i, im in m.images.items()},
        "points": {i: [p.xyz.tolist(), p.color.tolist(), p.error,
                       [[e.image_id, e.point2D_idx] for e in p.track.elements]] for i, p in m.points3D.items()},
        "rigs": {i: [r.ref_sensor_id.id, {s.id: pose(t) for s, t in r.non_ref_sensors.items()}]
                 for i, r in m.rigs.items()},
        "frames": {i: [f.rig_id, pose(f.rig_from_world), sorted(d.id for d in f.data_ids)]
                   for i, f in m.frames.items()},
    })
json.dump(answer, sys.stdout)
"""


# The same questions as every version since 3.11 takes them.
ANY_PYCOLMAP = """
import zlib, json, sys
import numpy as np
import pycolmap
assert pycolmap.__version__ == sys.argv[1], pycolmap.__version__
answer = []
for folder in sys.argv[2:]:
    m = pycolmap.Reconstruction(folder)
    said = {"cameras": {}, "images": {}, "points": {i: p.xyz.tolist() for i, p in m.points3D.items()}}
    for i, c in m.cameras.items():
        said["cameras"][i] = [c.model.name, c.width, c.height, c.params.tolist()]
    for i, image in m.images.items():
        pose = image.cam_from_world() if callable(image.cam_from_world) else image.cam_from_world
        matrix = np.array(pose.matrix())
        points = np.array([p.xyz for p in m.points3D.values()]) @ matrix[:, :3].T + matrix[:, 3] + [0, 0, 8]
        seen = [m.cameras[image.camera_id].img_from_cam(x).tolist() for x in points]
        said["images"][i] = [image.name, image.camera_id, matrix.tolist(), dict(zip(m.points3D, seen))]
    answer.append(said)
json.dump(answer, sys.stdout)
"""


def in_colmap(*folders):
    """What COLMAP itself reads in model folders."""
    answer = subprocess.run(
        [sys.executable, "-c", PYCOLMAP, *map(str, folders)],
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert answer.returncode == 0, answer.stderr
    return json.loads(answer.stdout)


def assert_equal_models(one, other):
    """To the bit."""
    assert one.cameras == other.cameras
    assert list(one.images) == list(other.images)
    for number, image in one.images.items():
        again = other.images[number]
        assert (image.name, image.camera_id) == (again.name, again.camera_id)
        assert_equal_poses(image.cam_from_world, again.cam_from_world)
        np.testing.assert_array_equal(image.points2d_px, again.points2d_px)
        np.testing.assert_array_equal(image.point3d_ids, again.point3d_ids)
    for field in ("ids", "xyz", "rgb", "errors", "track_starts", "track_image_ids", "track_point2d_indices"):
        np.testing.assert_array_equal(getattr(one.points, field), getattr(other.points, field))
    assert list(one.rigs) == list(other.rigs)
    for number, rig in one.rigs.items():
        assert rig.reference == other.rigs[number].reference
        assert list(rig.sensor_from_rig) == list(other.rigs[number].sensor_from_rig)
        for sensor, pose in rig.sensor_from_rig.items():
            assert_equal_poses(pose, other.rigs[number].sensor_from_rig[sensor])
    assert list(one.frames) == list(other.frames)
    for number, frame in one.frames.items():
        assert (frame.rig_id, frame.data_ids) == (other.frames[number].rig_id, other.frames[number].data_ids)
        assert_equal_poses(frame.rig_from_world, other.frames[number].rig_from_world)


def assert_equal_poses(one, other):
    np.testing.assert_array_equal(one.quat_wxyz, other.quat_wxyz)
    np.testing.assert_array_equal(one.translation, other.translation)


@pytest.mark.parametrize("write", [write_colmap_binary, write_colmap_text])
@pytest.mark.parametrize("rigs", [False, True])
def test_any_model_reads_back_to_the_bit(tmp_path, write, rigs):
    for seed in range(6):
        model = random_model(seed, rigs=rigs, spaces=rigs and write is write_colmap_binary)
        write(model, tmp_path / str(seed))
        assert_equal_models(read_colmap_model(tmp_path / str(seed)), model)


@needs_colmap
def test_colmap_reads_ids_names_lenses_poses_points_and_rigs_of_both_forms(tmp_path):
    models, folders = [], []
    for seed in range(12):
        rigs, text = bool(seed % 2), bool(seed % 3 == 0)
        models.append(random_model(seed, rigs=rigs, spaces=not text))
        folders.append(tmp_path / str(seed))
        (write_colmap_text if text else write_colmap_binary)(models[-1], folders[-1])
    for model, read in zip(models, in_colmap(*folders), strict=True):
        assert {int(i): (*c[:3], tuple(c[3])) for i, c in read["cameras"].items()} == {
            i: (c.model, c.width, c.height, c.params) for i, c in model.cameras.items()
        }
        assert {int(i) for i in read["images"]} == set(model.images)
        for number, image in model.images.items():
            name, camera, _, (quat, translation), features = read["images"][str(number)]
            assert (name, camera) == (image.name, image.camera_id)
            turned = rotation_from_quat_wxyz(np.array(quat))
            np.testing.assert_allclose(turned, matrix_of_pose(image.cam_from_world)[:3, :3], atol=1e-14)
            np.testing.assert_allclose(translation, image.cam_from_world.translation, atol=1e-14)
            written = np.column_stack([image.points2d_px, image.point3d_ids])
            np.testing.assert_array_equal(np.array(features), written)
        points = model.points
        assert {int(i) for i in read["points"]} == set(points.ids.tolist())
        for k, number in enumerate(points.ids.tolist()):
            xyz, colour, error, track = read["points"][str(number)]
            assert (xyz, colour, error) == (points.xyz[k].tolist(), points.rgb[k].tolist(), points.errors[k])
            rows = slice(points.track_starts[k], points.track_starts[k + 1])
            assert [e[0] for e in track] == points.track_image_ids[rows].tolist()
            assert [e[1] for e in track] == points.track_point2d_indices[rows].tolist()
        if model.rigs:
            [(number, (reference, others))] = read["rigs"].items()
            assert (int(number), reference, list(others)) == (5, 7, ["3"])
            assert {int(i): f[2] for i, f in read["frames"].items()} == {
                i: sorted(image for _, image in f.data_ids) for i, f in model.frames.items()
            }
            for i, frame in model.frames.items():
                np.testing.assert_allclose(
                    read["frames"][str(i)][1][1], frame.rig_from_world.translation, atol=1e-14
                )


def test_the_text_form_refuses_names_with_spaces_and_says_so(tmp_path):
    with pytest.raises(InputError) as caught:
        write_colmap_text(random_result(0).model, tmp_path / "0")
    assert_complete(caught.value, "export_not_possible", "colmap-text")
    assert "ö 00.jpg" in caught.value.detail
    assert not (tmp_path / "0").exists()


def refined_model(model, seed, moved):
    """The model with the moments of ``moved`` turned, all cameras of a moment alike, as a rig turns."""
    rows = list(model.images.values())
    poses = np.stack([rigid_inverse(matrix_of_pose(image.cam_from_world)) for image in rows])
    turns = random_poses(np.random.default_rng(seed), 3)
    changed = np.array([int(image.name[-5]) in moved for image in rows])
    for row, image in enumerate(rows):
        if changed[row]:
            poses[row] = turns[int(image.name[-5])] @ poses[row]
    cameras = tuple(model.cameras.values())
    indices = [list(model.cameras).index(image.camera_id) for image in rows]
    names = [image.name for image in rows]
    return model_at_poses(model, names, cameras, indices, poses, changed), poses


def test_a_model_comes_back_with_its_ids_and_what_did_not_move_to_the_bit():
    given = random_model(3, rigs=True)
    again, poses = refined_model(given, 1, moved={1})
    assert list(again.images) == list(given.images)
    assert list(again.frames) == list(given.frames)
    for row, (number, image) in enumerate(again.images.items()):
        np.testing.assert_allclose(
            matrix_of_pose(image.cam_from_world), np.linalg.inv(poses[row]), atol=1e-12
        )
        if image.name[-5] != "1":
            assert_equal_poses(image.cam_from_world, given.images[number].cam_from_world)
    for number, frame in again.frames.items():
        assert_equal_poses(
            frame.rig_from_world,
            given.frames[number].rig_from_world if number != 19 else again.images[83].cam_from_world,
        )


@needs_colmap
def test_colmap_places_every_sensor_of_a_refined_rig_where_its_image_says(tmp_path):
    again, poses = refined_model(random_model(4, rigs=True), 2, moved={0, 1, 2})
    write_colmap_binary(again, tmp_path)
    [read] = in_colmap(tmp_path)
    for row, number in enumerate(again.images):
        quat, translation = read["images"][str(number)][3]  # COLMAP composes it from the frame and the rig
        expected = np.linalg.inv(poses[row])
        np.testing.assert_allclose(rotation_from_quat_wxyz(np.array(quat)), expected[:3, :3], atol=1e-12)
        np.testing.assert_allclose(translation, expected[:3, 3], atol=1e-12)


def test_images_that_the_model_did_not_have_get_ids_and_frames_of_their_own(tmp_path):
    given = random_model(5, rigs=True)
    names = [image.name for image in given.images.values()] + ["cam7/new.jpg", "other.jpg"]
    cameras = (*given.cameras.values(), replace(next(iter(given.cameras.values())), width=65))
    indices = [list(given.cameras).index(image.camera_id) for image in given.images.values()] + [0, 2]
    poses = random_poses(np.random.default_rng(0), len(names))
    poses[: len(given.images)] = [
        rigid_inverse(matrix_of_pose(i.cam_from_world)) for i in given.images.values()
    ]
    again = model_at_poses(
        given, names, cameras, indices, poses, np.array([False] * len(given.images) + [True] * 2)
    )
    assert [(again.images[i].name, again.images[i].camera_id) for i in (98, 99)] == [
        ("cam7/new.jpg", 7),
        ("other.jpg", 8),
    ]
    assert again.cameras[8].width == 65
    write_colmap_binary(again, tmp_path)
    assert_equal_models(
        read_colmap_model(tmp_path), again
    )  # every image is in a frame, or it would be refused


@pytest.mark.skipif(
    not OTHER_VERSIONS, reason="set BIRESNERF_TEST_PYCOLMAPS to a folder of `pip install --target VERSION`s"
)
@pytest.mark.parametrize("version", ["3.11.1", "3.12.6", "3.13.0", "4.0.4"])
def test_other_versions_of_colmap_read_the_same_ids_names_poses_and_points_and_project_alike(
    tmp_path, version
):
    models, folders = [], []
    for seed in range(12):
        models.append(random_model(seed, rigs=bool(seed % 2), spaces=seed % 3 > 0))
        folders.append(tmp_path / str(seed))
        (write_colmap_binary if seed % 3 else write_colmap_text)(models[-1], folders[-1])
    environment = {**os.environ, "PYTHONPATH": str(Path(OTHER_VERSIONS) / version)}
    command = [sys.executable, "-c", ANY_PYCOLMAP, version, *map(str, folders)]
    said = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=120, check=False)
    assert said.returncode == 0, said.stderr
    for model, read in zip(models, json.loads(said.stdout), strict=True):
        assert {int(i): (*c[:3], tuple(c[3])) for i, c in read["cameras"].items()} == {
            i: (c.model, c.width, c.height, c.params) for i, c in model.cameras.items()
        }
        xyz = dict(zip(model.points.ids.tolist(), model.points.xyz, strict=True))
        assert {int(i): x for i, x in read["points"].items()} == {i: x.tolist() for i, x in xyz.items()}
        assert {int(i) for i in read["images"]} == set(model.images)
        for number, image in model.images.items():
            name, camera, matrix, seen = read["images"][str(number)]
            assert (name, camera) == (image.name, image.camera_id)
            pose = matrix_of_pose(image.cam_from_world)
            np.testing.assert_allclose(matrix, pose[:3], atol=1e-13)
            for point, pixel in seen.items():
                there = (xyz[int(point)] @ pose[:3, :3].T + pose[:3, 3] + [0, 0, 8])[None]
                ours = pixels_of_points(model.cameras[camera].full(), there)[0]
                np.testing.assert_allclose(np.ravel(pixel), ours, atol=1e-9)
