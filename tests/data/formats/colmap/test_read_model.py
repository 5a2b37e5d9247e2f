"""COLMAP models: what pycolmap wrote is read as pycolmap reads it."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from biresnerf.data.formats.colmap.read_model import model_file_formats, read_colmap_model
from biresnerf.data.model.colmap_scene import ColmapModel, RigidPose
from biresnerf.geometry.camera.camera_models import MODEL_IDS
from tests.data.formats.colmap.colmap_files import (
    TINY_TEXT,
    by_pycolmap,
    image_record,
    tiny_tables,
    write_tables,
)
from tests.data.test_real_sets import ROOT
from tests.geometry.camera.lenses import CAMERAS, HEIGHT, WIDTH

pytestmark = pytest.mark.slow


def synthetic(seed: int, model: str, folder, rigs: int = 2, cameras_per_rig: int = 1):
    options = {
        "num_rigs": rigs, "num_cameras_per_rig": cameras_per_rig, "num_frames_per_rig": 3, "num_points3D": 20,
        "camera_width": WIDTH, "camera_height": HEIGHT, "num_points2D_without_point3D": 3,
        "camera_model_id": model, "camera_params": CAMERAS[model],
    }  # fmt: skip
    return {"seed": seed, "folder": str(folder), "options": options}


def assert_same_pose(pose: RigidPose, quat_and_translation):
    quat_wxyz, translation = quat_and_translation
    sign = np.sign(np.dot(pose.quat_wxyz, quat_wxyz))
    np.testing.assert_allclose(sign * pose.quat_wxyz, quat_wxyz, atol=1e-12)
    np.testing.assert_allclose(pose.translation, translation, rtol=1e-12, atol=1e-12)


def assert_reads_as_pycolmap(model: ColmapModel, said):
    assert {str(i): [c.model, c.width, c.height, list(c.params)] for i, c in model.cameras.items()} == said[
        "cameras"
    ]
    assert model.images.keys() == {int(i) for i in said["images"]}
    for image in model.images.values():
        name, camera, pose, points, ids = said["images"][str(image.id)]
        assert (image.name, image.camera_id) == (name, camera)
        assert_same_pose(image.cam_from_world, pose)
        np.testing.assert_array_equal(image.points2d_px, np.reshape(points, (-1, 2)))
        assert image.point3d_ids.tolist() == ids
    points = model.points
    assert set(points.ids.tolist()) == {int(i) for i in said["points"]}
    for k, number in enumerate(points.ids.tolist()):
        xyz, rgb, error, track = said["points"][str(number)]
        assert (points.xyz[k].tolist(), points.rgb[k].tolist(), points.errors[k]) == (xyz, rgb, error)
        part = slice(points.track_starts[k], points.track_starts[k + 1])
        elements = zip(points.track_image_ids[part], points.track_point2d_indices[part], strict=True)
        assert sorted([int(a), int(b)] for a, b in elements) == track
    if not model.rigs:
        return
    assert model.rigs.keys() == {int(i) for i in said["rigs"]}
    for rig in model.rigs.values():
        reference, others = said["rigs"][str(rig.id)]
        assert rig.reference == tuple(reference)
        assert sorted(list(sensor) for sensor in rig.sensor_from_rig) == [row[:2] for row in others]
        for kind, number, pose in others:
            assert_same_pose(rig.sensor_from_rig[kind, number], pose)
    assert model.frames.keys() == {int(i) for i in said["frames"]}
    for frame in model.frames.values():
        rig_id, pose, data_ids = said["frames"][str(frame.id)]
        assert frame.rig_id == rig_id
        assert_same_pose(frame.rig_from_world, pose)
        assert sorted([*sensor, data] for sensor, data in frame.data_ids) == data_ids


def test_every_supported_camera_model_is_among_those_tested():
    assert CAMERAS.keys() == MODEL_IDS.keys()


def test_random_models_of_every_camera_model_and_with_rigs_read_as_pycolmap_reads_them(tmp_path):
    made = [synthetic(seed, model, tmp_path / model) for seed, model in enumerate(CAMERAS)]
    made += [synthetic(s, "PINHOLE", tmp_path / f"rig{s}", 1 + s % 2, cameras_per_rig=3) for s in (90, 91)]
    answers = by_pycolmap(made)
    for one, said in zip(made, answers, strict=True):
        for file_format in ("binary", "text"):
            model = read_colmap_model(tmp_path / one["folder"] / file_format)
            assert model.file_format == file_format
            assert model.notes == ()
            assert len(model.points) == 20
            assert_reads_as_pycolmap(model, said)


@pytest.mark.parametrize(
    "path", ["kitchen25/sparse/0", "lund_door/colmap_sparse_fullres", "colmap_maupertuis/sparse_txt"]
)
def test_models_of_real_sets_read_as_pycolmap_reads_them(path):
    if not (ROOT / path).is_dir():
        pytest.skip(f"no model {path}: set BIRESNERF_TEST_DATA to the folder that holds it")
    assert_reads_as_pycolmap(read_colmap_model(ROOT / path), by_pycolmap([], [ROOT / path])[0])


def test_both_forms_of_a_model_read_the_same_and_binary_goes_first(tmp_path):
    text = read_colmap_model(write_tables(tmp_path, TINY_TEXT))
    write_tables(tmp_path, tiny_tables())
    assert model_file_formats(tmp_path) == ("binary", "text")
    binary = read_colmap_model(tmp_path)
    assert (text.file_format, binary.file_format) == ("text", "binary")
    assert text.notes == ()
    assert "the text model beside it was not" in binary.notes[0]
    assert [image.name for image in text.images.values()] == ["a.png", "left/b b.png", "c.png"]
    for image, other in zip(text.images.values(), binary.images.values(), strict=True):
        assert (image.id, image.name, image.camera_id) == (other.id, other.name, other.camera_id)
        np.testing.assert_array_equal(image.point3d_ids, other.point3d_ids)
        np.testing.assert_array_equal(image.world_from_cam, other.world_from_cam)
    assert text.cameras == binary.cameras
    assert text.frames.keys() == binary.frames.keys()
    assert text.rigs[2].reference == binary.rigs[2].reference == ("CAMERA", 7)


def test_a_model_from_before_rigs_and_one_without_points_are_read(tmp_path):
    tables = tiny_tables()
    del tables["rigs.bin"], tables["frames.bin"]
    model = read_colmap_model(write_tables(tmp_path / "old", tables))
    assert model.rigs == model.frames == {}
    del tables["points3D.bin"]
    model = read_colmap_model(write_tables(tmp_path / "bare", tables))
    assert len(model.points) == 0
    assert "points3D.bin is missing" in model.notes[0]
    assert all((image.point3d_ids == -1).all() for image in model.images.values())


def test_the_frames_poses_go_before_the_images_as_in_colmap(tmp_path):
    tables = tiny_tables()
    moved = image_record(11, b"a.png", pose=(0, 1, 0, 0))
    tables["images.bin"] = tables["images.bin"].replace(image_record(11, b"a.png"), moved)
    model = read_colmap_model(write_tables(tmp_path, tables))
    assert "different poses for 1 images (a.png" in model.notes[0]
    assert model.images[11].cam_from_world.quat_wxyz.tolist() == [1, 0, 0, 0]
    said = by_pycolmap([], [tmp_path])[0]
    assert_same_pose(model.images[11].cam_from_world, said["images"]["11"][2])


def test_a_camera_stands_where_its_pose_says(tmp_path):
    model = read_colmap_model(write_tables(tmp_path, tiny_tables()))
    pose = model.images[12].world_from_cam
    np.testing.assert_array_equal(pose[:3, 3], [-12.0, -0.5, -2.0])
    np.testing.assert_array_equal(pose[:3, :3], np.eye(3))


OTHER_VERSIONS = os.environ.get("BIRESNERF_TEST_PYCOLMAPS")
REWRITE = """
import zlib, sys, os
import pycolmap
assert pycolmap.__version__ == sys.argv[1], pycolmap.__version__
rec = pycolmap.Reconstruction(sys.argv[2])
for form in ("binary", "text"):
    os.makedirs(os.path.join(sys.argv[3], form))
    getattr(rec, "write_" + form)(os.path.join(sys.argv[3], form))
"""


@pytest.mark.skipif(
    not OTHER_VERSIONS, reason="set BIRESNERF_TEST_PYCOLMAPS to a folder of `pip install --target VERSION`s"
)
@pytest.mark.parametrize("rigged", [False, True])
@pytest.mark.parametrize("version", ["3.10.0", "3.11.1", "3.12.6", "3.13.0", "4.0.4"])
def test_what_other_versions_of_colmap_write_is_read(tmp_path, version, rigged):
    made = synthetic(5, "OPENCV", tmp_path / "made", 2, cameras_per_rig=3 if rigged else 1)
    said = by_pycolmap([made])[0]
    rewritten = subprocess.run(
        [sys.executable, "-c", REWRITE, version, tmp_path / "made/binary", tmp_path / "rewritten"],
        env={**os.environ, "PYTHONPATH": str(Path(OTHER_VERSIONS) / version)},
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert rewritten.returncode == 0, rewritten.stderr
    for file_format in ("binary", "text"):
        model = read_colmap_model(tmp_path / "rewritten" / file_format)
        assert model.notes == ()
        assert bool(model.rigs) == (version >= "3.12")
        assert_reads_as_pycolmap(model, said)
