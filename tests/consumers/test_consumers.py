"""Other programs' readers open what we write: poses, lenses and points, each against the truth.

`make consumers-check` builds their environment and runs this file. Programs that are published as source only are read
from checkouts in $BIRESNERF_CONSUMER_SOURCES (gaussian-splatting, gsplat, nerf-pytorch).
"""

from __future__ import annotations

import json
import os
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from biresnerf.data.formats.codec import WriteContext
from biresnerf.data.formats.convert import convert
from biresnerf.data.formats.read_dataset import read_dataset
from biresnerf.data.formats.result_formats import export_result, write_result_formats
from biresnerf.data.formats.simple.llff import write_llff
from biresnerf.data.model.refined_set import RefinedSet
from biresnerf.geometry.camera.camera_models import MODEL_PARAMETERS
from tests.data.formats.random_sets import random_result
from tests.data.formats.simple.test_pinhole import pack_of
from tests.data.scenes import blender_scene, save

ENVIRONMENT = os.environ.get(
    "BIRESNERF_CONSUMERS", ""
)  # set by the make target, so that `make test` stays short
SOURCES = os.environ.get("BIRESNERF_CONSUMER_SOURCES", "")
NAMES = [f"images/{name}.png" for name in ("r_0", "r_1", "r_10", "r_2", "r_3")][
    ::-1
]  # not the order of names
FLOAT32 = 2e-6  # relative, of programs that keep poses so


def read_by(program: str, place: Path, needs: str = "") -> dict:
    """What the program's reader says of ``place``; skips where the program is not there."""
    if not ENVIRONMENT:
        pytest.skip("other programs' readers are run by make consumers-check")
    python = Path(ENVIRONMENT) / "bin" / "python"
    if needs and not (Path(SOURCES) / needs).is_dir():
        pytest.skip(f"no source of {needs}: set BIRESNERF_CONSUMER_SOURCES to the folder that holds it")
    command = [str(python), str(Path(__file__).with_name("readers.py")), program, str(place)]
    done = subprocess.run(
        command,
        capture_output=True,
        text=True,
        check=False,
        timeout=300,
        env={**os.environ, "PYTHONPATH": ""},
    )
    assert done.returncode == 0, f"{program}: {done.stderr[-3000:]}"
    return json.loads(done.stdout.strip().splitlines()[-1])


def result(
    folder: Path, model: str = "SIMPLE_RADIAL", names: list[str] = NAMES, **changes: float
) -> RefinedSet:
    """A result in ``folder``, beside its photos; ``changes`` are parameters of the lens."""
    refined = random_result(1, model=model)
    camera = refined.cameras[0]
    values = dict(zip(MODEL_PARAMETERS[camera.model], camera.params, strict=True)) | changes
    refined = replace(refined, cameras=(replace(camera, params=tuple(values.values())),))
    refined = pack_of(folder, refined, names)
    images = {
        number: replace(image, name=name)
        for (number, image), name in zip(refined.model.images.items(), names, strict=True)
    }
    refined = replace(refined, model=replace(refined.model, cameras={1: refined.cameras[0]}, images=images))
    write_result_formats(refined, folder)
    return refined


def assert_poses(found: dict, refined: RefinedSet, names: list[str], close: float) -> None:
    assert sorted(found) == sorted(names)
    size = np.abs(refined.world_from_cam).max()
    for name, pose in zip(names, refined.world_from_cam, strict=True):
        np.testing.assert_allclose(found[name], pose, rtol=0, atol=close * size, err_msg=name)


def assert_same_points(found: list, refined: RefinedSet, close: float = FLOAT32) -> None:
    """In any order."""
    given, there = refined.model.points.xyz, np.array(found)
    assert there.shape == given.shape
    apart = np.linalg.norm(there[:, None] - given[None], axis=2).min(1)
    assert apart.max() < close * max(1.0, np.abs(given).max())


opens = pytest.mark.opens  # format, and the program that reads it: docs/formats.md has them in its table


@opens("nerfstudio", by="nerfstudio")
@pytest.mark.parametrize(
    ("model", "changes"),
    [
        ("PINHOLE", {}),
        ("OPENCV", {}),
        ("FULL_OPENCV", {"k4": 0.0, "k5": 0.0, "k6": 0.0}),
        ("OPENCV_FISHEYE", {}),
    ],
)
def test_nerfstudio_reads_poses_lenses_and_points(tmp_path, model, changes):
    refined = result(tmp_path, model, **changes)
    found = read_by("nerfstudio", tmp_path / "transforms_nerfstudio.json")
    assert_poses(found["poses"], refined, NAMES, FLOAT32)
    assert_same_points(found["points"], refined)
    full = refined.cameras[0].full()
    brown = [full.k1, full.k2, full.k3, full.k4 if full.fisheye else 0.0, full.p1, full.p2]
    for lens in found["lenses"].values():
        assert lens["size"] == [refined.cameras[0].width, refined.cameras[0].height]
        np.testing.assert_allclose(lens["pinhole"], [full.fx, full.fy, full.cx, full.cy], rtol=1e-6)
        np.testing.assert_allclose(lens["k1 k2 k3 k4 p1 p2"], brown, atol=1e-8)
        assert lens["type"] == (2 if full.fisheye else 1)  # CameraType.FISHEYE, PERSPECTIVE


@opens("nerfstudio", by="nerfstudio")
def test_nerfstudio_reads_a_set_in_blenders_dialect_once_it_is_converted(tmp_path):
    given = read_dataset(save(tmp_path, blender_scene(tmp_path), "transforms_train.json"))
    convert(given, ["nerfstudio"], tmp_path / "out")
    found = read_by("nerfstudio", tmp_path / "out/transforms_nerfstudio.json")
    assert len(found["poses"]) == len(given)
    for name, pose in zip(given.file_names, given.world_from_cam, strict=True):
        np.testing.assert_allclose(found["poses"][name], pose, atol=1e-5)


@pytest.fixture
def pinhole(tmp_path) -> tuple[Path, RefinedSet, list[str]]:
    """The export of a set whose lens the splatting programs do not know, and the names of its photos there."""
    refined = result(tmp_path, "FULL_OPENCV")
    export_result(refined, tmp_path, ["pinhole"], WriteContext())
    names = json.loads((tmp_path / "pinhole/names.json").read_text())
    return (
        tmp_path / "pinhole",
        refined,
        [there for name in NAMES for there, own in names.items() if own == name],
    )


@pytest.mark.parametrize(
    ("program", "place", "needs"),
    [
        pytest.param("nerfstudio", "transforms_nerfstudio.json", "", marks=opens("pinhole", by="nerfstudio")),
        pytest.param("nerfstudio_colmap", ".", "", marks=opens("pinhole", by="nerfstudio")),
        pytest.param("pycolmap", "sparse/0", "", marks=opens("pinhole", by="pycolmap")),
        pytest.param("gsplat", ".", "gsplat", marks=opens("pinhole", by="gsplat")),
        pytest.param("splatting", ".", "gaussian-splatting", marks=opens("pinhole", by="gaussian-splatting")),
    ],
)
def test_undistorted_photos_are_read_with_their_poses_and_points(pinhole, program, place, needs):
    folder, refined, names = pinhole
    found = read_by(program, folder / place, needs)
    named = [f"images/{name}" if place.endswith(".json") else name for name in names]
    if program == "splatting":  # it calls a photo by what is before the first dot
        named = [name.split(".")[0] for name in names]
    assert_poses(found["poses"], refined, named, FLOAT32 if "nerf" in program else 1e-9)
    assert_same_points(found["points"], refined)


@opens("colmap", by="pycolmap")
def test_pycolmap_reads_the_model(tmp_path):
    refined = result(tmp_path)
    found = read_by("pycolmap", tmp_path / "colmap/sparse/0")
    assert_poses(found["poses"], refined, NAMES, 1e-12)
    assert_same_points(found["points"], refined, 1e-12)


@opens("tum", by="evo")
@opens("kitti", by="evo")
def test_evo_reads_trajectories_in_the_sets_order(tmp_path):
    refined = result(tmp_path)
    export_result(refined, tmp_path, ["kitti"], WriteContext())
    tum, kitti = read_by("evo_tum", tmp_path / "tum.txt"), read_by("evo_kitti", tmp_path / "kitti.txt")
    np.testing.assert_allclose(tum["rows"], refined.world_from_cam, atol=1e-12)
    np.testing.assert_allclose(kitti["rows"], refined.world_from_cam, atol=1e-12)
    assert tum["times"] == [0.0, 1.0, 2.0, 3.0, 4.0]


@pytest.mark.parametrize(
    "program",
    [
        pytest.param("open3d_points", marks=opens("points", by="open3d")),
        pytest.param("trimesh_points", marks=opens("points", by="trimesh")),
    ],
)
def test_the_point_cloud_has_its_colours(tmp_path, program):
    refined = result(tmp_path)
    found = read_by(program, tmp_path / "points.ply")
    np.testing.assert_allclose(found["points"], refined.model.points.xyz, atol=1e-6)
    np.testing.assert_allclose(np.array(found["colours"]) * 255, refined.model.points.rgb, atol=1e-3)


@opens("scene", by="open3d")
def test_open3d_shows_the_cameras_of_the_scene(tmp_path):
    refined = result(tmp_path)
    mesh = read_by("open3d_mesh", tmp_path / "scene.glb")
    shown = np.array(mesh["vertices"])
    assert mesh["triangles"] == 5 * (len(refined) + sum(image.given is not None for image in refined.images))
    # glTF has y up: (x, y, z) of the world is (x, z, -y) there.
    centres = refined.world_from_cam[:, :3, 3][:, [0, 2, 1]] * [1, 1, -1]
    assert np.linalg.norm(shown[:, None] - centres[None], axis=2).min(0).max() < 1e-5


@opens("scene", by="trimesh")
def test_trimesh_reads_the_scene_with_points_edges_and_faces(tmp_path):
    refined = result(tmp_path)
    found = read_by("trimesh_scene", tmp_path / "scene.glb")
    assert set(found["kinds"]) == {"Path3D", "PointCloud", "Trimesh"}
    xyz = np.concatenate([refined.model.points.xyz, refined.world_from_cam[:, :3, 3]])[:, [0, 2, 1]] * [
        1,
        1,
        -1,
    ]
    low, high = np.array(found["bounds"])
    assert (low <= xyz.min(0) + 1e-5).all()
    assert (high >= xyz.max(0) - 1e-5).all()


@opens("scene", by="bpy")
def test_blender_shows_the_scene_at_the_inputs_own_coordinates(tmp_path):
    refined = result(tmp_path)
    found = read_by("blender", tmp_path / "scene.glb")
    assert set(found) == {"cameras before", "cameras after", "points"}
    np.testing.assert_allclose(found["points"]["vertices"], refined.model.points.xyz, atol=1e-5)
    after = found["cameras after"]
    assert after["faces"] == 5 * len(refined)
    away = np.array(after["vertices"])[:, None] - refined.world_from_cam[None, :, :3, 3]
    assert np.linalg.norm(away, axis=2).min(0).max() < 1e-5


@opens("realitycapture", by="nerfstudio")
def test_nerfstudio_converts_realitycaptures_csv(tmp_path):
    refined = result(tmp_path, "FULL_OPENCV", k4=0.0, k5=0.0, k6=0.0, fx=70.0, fy=70.0)
    export_result(refined, tmp_path, ["realitycapture"], WriteContext())
    found = read_by("nerfstudio_realitycapture", tmp_path)
    assert_poses(found["poses"], refined, NAMES, 1e-12)
    full = refined.cameras[0].full()
    expected = {"fl_x": full.fx, "fl_y": full.fy, "cx": full.cx, "cy": full.cy, "k4": 0.0}
    expected |= {name: getattr(full, name) for name in ("k1", "k2", "k3", "p1", "p2")}
    for lens in found["lenses"].values():
        for key, value in expected.items():
            assert lens[key] == pytest.approx(value, abs=1e-9), key


@opens("llff", by="nerf-pytorch")
def test_nerf_pytorch_pairs_llffs_rows_with_their_photos(tmp_path):
    # It passes imageio an option for PNG that current versions do not have.
    names = [name.replace(".png", ".jpg") for name in NAMES]
    refined = result(tmp_path, "SIMPLE_PINHOLE", names, cx=32.0, cy=24.0)
    write_llff(refined, tmp_path / "poses_bounds.npy")
    found = read_by("llff", tmp_path, "nerf-pytorch")
    by_name = sorted(range(len(refined)), key=lambda index: NAMES[index])
    for row, pixel, index in zip(found["rows"], found["pixels"], by_name, strict=True):
        photo = np.asarray(Image.open(tmp_path / names[index]))
        np.testing.assert_allclose(np.array(pixel) * 255, photo[0, 0], atol=1e-3)
        down, right, back, centre, (height, width, focal) = np.array(row).T
        pose = refined.world_from_cam[index]
        np.testing.assert_allclose(np.stack([right, down, -back, centre], 1), pose[:3], atol=1e-6)
        assert [height, width] == [48, 64]
        assert focal == pytest.approx(refined.cameras[0].full().fx)
