"""Every format, read by its own rules, projects points as we do, or says why it cannot."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from biresnerf.data.formats.result_formats import write_result_formats
from biresnerf.data.formats.simple.bundler import write_bundler
from biresnerf.data.formats.simple.llff import write_llff
from biresnerf.data.formats.simple.poses_json import matrix_of, read_poses_json, write_poses_json
from biresnerf.data.formats.simple.scene_glb import write_scene
from biresnerf.data.formats.simple.trajectory import write_kitti, write_tum
from biresnerf.data.formats.transforms.instant_ngp import write_transforms_ngp
from biresnerf.data.model.refined_set import RefinedSet
from biresnerf.errors import InputError
from biresnerf.geometry.camera.camera_models import FAMILY_MODELS, MODEL_PARAMETERS
from biresnerf.options.formats import formats
from tests.data.formats.random_sets import random_result
from tests.data.formats.readers import (
    bundler_cameras,
    glb_accessor,
    glb_parts,
    ours,
    seen_points,
    through_bundler,
    through_json_frame,
    tum_poses,
)
from tests.data.scenes import assert_complete
from tests.geometry.camera.lenses import BEYOND_OPENCV

NGP_MODELS = sorted({*FAMILY_MODELS} - {*BEYOND_OPENCV})
CLOSE_PX = 0.01


def with_(refined: RefinedSet, **changes) -> RefinedSet:
    return RefinedSet(
        **{**{name: getattr(refined, name) for name in refined.__dataclass_fields__}, **changes}
    )


def centred(refined: RefinedSet) -> RefinedSet:
    """The same with principal points in the middle, which Bundler takes for granted."""
    cameras = []
    for camera in refined.cameras:
        middle = {"cx": camera.width / 2, "cy": camera.height / 2}
        names = MODEL_PARAMETERS[camera.model]
        params = tuple(middle.get(n, v) for n, v in zip(names, camera.params, strict=True))
        cameras.append(replace(camera, params=params))
    return with_(refined, cameras=tuple(cameras))


def test_poses_json_loses_nothing(tmp_path):
    refined = random_result(1, several=True)
    write_poses_json(refined, tmp_path / "poses.json")
    document = read_poses_json(tmp_path / "poses.json")
    assert [(c.model, c.width, c.height, c.params) for c in document.cameras] == [
        (c.model, c.width, c.height, c.params) for c in refined.cameras
    ]
    for row, image, inverse in zip(document.images, refined.images, refined.cam_from_world, strict=True):
        assert (row.name, row.file_name, row.camera, row.flags) == (
            image.name,
            image.file_name,
            image.camera,
            image.flags,
        )
        np.testing.assert_array_equal(matrix_of(row.world_from_cam), image.world_from_cam)
        np.testing.assert_array_equal(matrix_of(row.cam_from_world), inverse)
        np.testing.assert_allclose(
            matrix_of(row.cam_from_world) @ image.world_from_cam, np.eye(4), atol=1e-12
        )
        assert (row.world_from_cam_before is None) == (image.given is None)
    assert document.input_from_optimised.scale == refined.similarity.scale


@pytest.mark.parametrize("damage", ["version", "matrix", "unknown"])
def test_a_damaged_poses_json_is_refused_with_the_field(tmp_path, damage):
    path = tmp_path / "poses.json"
    write_poses_json(random_result(1), path)
    document = json.loads(path.read_text())
    if damage == "version":
        document["version"] = 2
    elif damage == "matrix":
        document["images"][2]["world_from_cam"].pop()
    else:
        document["images"][0]["colour"] = "red"
    path.write_text(json.dumps(document))
    with pytest.raises(InputError) as caught:
        read_poses_json(path)
    where = {"version": "version", "matrix": "images.2.world_from_cam", "unknown": "images.0.colour"}[damage]
    assert caught.value.code == "pose_file_invalid"
    assert where in caught.value.where


@pytest.mark.parametrize("backwards", [False, True])
def test_llff_holds_every_pose_by_name_and_the_depths_that_its_image_sees(tmp_path, backwards):
    refined = centred(random_result(4, model="SIMPLE_PINHOLE"))
    if backwards:  # rows go by name, whatever the set's order
        last = len(refined) - 1
        named = [replace(image, file_name=f"{last - i}.png") for i, image in enumerate(refined.images)]
        refined = with_(refined, images=tuple(named))
    write_llff(refined, tmp_path / "poses_bounds.npy")
    rows = np.load(tmp_path / "poses_bounds.npy")
    for index, row in enumerate(rows[::-1] if backwards else rows):
        down, right, back, centre, (height, width, focal) = row[:15].reshape(3, 5).T
        pose, camera = refined.world_from_cam[index], refined.camera_of(index)
        np.testing.assert_array_equal(np.stack([right, down, -back, centre], axis=1), pose[:3])
        assert (height, width, focal) == (camera.height, camera.width, camera.full().fx)
        seen = [
            refined.model.points.xyz[k]
            for k in range(len(refined.model.points))
            for element in range(
                refined.model.points.track_starts[k], refined.model.points.track_starts[k + 1]
            )
            if refined.model.points.track_image_ids[element] == refined.image_ids[index]
        ]
        depths = (refined.cam_from_world[index, :3, :3] @ np.transpose(seen)).T[:, 2]
        depths = depths + refined.cam_from_world[index, 2, 3]
        np.testing.assert_allclose(row[15:], np.percentile(depths, [0.1, 99.9]))


def test_trajectories_hold_every_pose_in_order(tmp_path):
    refined = random_result(2)
    write_tum(refined, tmp_path / "tum.txt")
    times, poses = tum_poses(tmp_path / "tum.txt")
    assert times.tolist() == [0, 1, 2, 3, 4]
    np.testing.assert_allclose(poses, refined.world_from_cam, atol=1e-12)
    write_tum(with_(refined, timestamps_s=(1305031098.6659, 2.5, 3.0, 4.0, 5.25)), tmp_path / "tum.txt")
    assert tum_poses(tmp_path / "tum.txt")[0].tolist() == [1305031098.6659, 2.5, 3.0, 4.0, 5.25]
    write_kitti(refined, tmp_path / "kitti.txt")
    rows = np.loadtxt(tmp_path / "kitti.txt").reshape(-1, 3, 4)
    np.testing.assert_array_equal(rows, refined.world_from_cam[:, :3])


@pytest.mark.parametrize("model", NGP_MODELS)
@pytest.mark.parametrize("several", [False, True])
def test_instant_ngp_sees_points_where_we_do(tmp_path, model, several):
    refined = random_result(3, model=model, several=several)
    write_transforms_ngp(refined, tmp_path / "t.json")
    document = json.loads((tmp_path / "t.json").read_text("utf-8"))
    lint_for_instant_ngp(document)
    for index, frame in enumerate(document["frames"]):
        points = seen_points(refined, index)
        apart = through_json_frame(document, frame, points) - ours(refined, index, points)
        assert np.abs(apart).max() < CLOSE_PX


def lint_for_instant_ngp(document):
    """What its loader takes silently in another way than meant."""
    assert document["aabb_scale"] in (1, 2, 4, 8, 16, 32, 64, 128)
    for frame in document["frames"]:
        values = {**document, **frame}
        if values.get("is_fisheye"):
            assert not {"p1", "p2"} & set(values)  # they would take the places of k3 and k4
        else:
            assert not {"k3", "k4"} & set(values)
        assert {"w", "h", "fl_x", "fl_y", "cx", "cy"} <= set(values)
        assert not {"x_fov", "camera_angle_x", "sharpness", "n_frames", "aabb"} & set(values)
        assert not frame["file_path"].startswith("/")
        assert "\\" not in frame["file_path"]
    matrices = np.array([frame["transform_matrix"] for frame in document["frames"]])
    inside = document["scale"] * matrices[:, :3, 3] + document["offset"]
    assert np.abs(inside - 0.5).max() <= 0.5 * document["aabb_scale"]


def test_instant_ngp_refuses_what_it_would_misread(tmp_path):
    refined = random_result(4)
    images = tuple(replace(i, file_name=i.file_name.replace(".jpg", ".webp")) for i in refined.images)
    with pytest.raises(InputError) as caught:
        write_transforms_ngp(with_(refined, images=images), tmp_path / "t.json")
    assert_complete(caught.value, "export_not_possible")
    assert ".webp" in caught.value.detail
    assert not (tmp_path / "t.json").exists()


@pytest.mark.parametrize("model", ["SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL"])
def test_bundler_sees_points_and_tracks_where_we_do(tmp_path, model):
    refined = centred(random_result(5, model=model, several=True))
    write_bundler(refined, tmp_path)
    assert (tmp_path / "list.txt").read_text("utf-8").splitlines() == [i.file_name for i in refined.images]
    cameras, tracks = bundler_cameras(tmp_path / "bundle.out")
    for index, camera in enumerate(cameras):
        points = seen_points(refined, index)
        apart = through_bundler(camera, (64, 48), points) - ours(refined, index, points)
        assert np.abs(apart).max() < CLOSE_PX
    assert len(tracks) == len(refined.model.points) > 0
    rows = {image.id: row for row, image in enumerate(refined.model.images.values())}
    points = refined.model.points
    for k, (xyz, rgb, views) in enumerate(tracks):
        assert xyz == points.xyz[k].tolist()
        assert rgb == points.rgb[k].tolist()
        track = range(points.track_starts[k], points.track_starts[k + 1])
        assert views[:, 0].tolist() == [rows[int(points.track_image_ids[t])] for t in track]
        for view, t in zip(views, track, strict=True):
            image = refined.model.images[int(points.track_image_ids[t])]
            expected = image.points2d_px[points.track_point2d_indices[t]] - [32, 24]
            np.testing.assert_allclose(view[2:], expected * [1, -1], atol=1e-12)


@pytest.mark.parametrize("model", ["PINHOLE", "OPENCV", "SIMPLE_RADIAL"])
def test_bundler_refuses_lenses_that_it_cannot_hold(tmp_path, model):
    refined = random_result(6, model=model)
    with pytest.raises(InputError) as caught:
        write_bundler(centred(refined) if model != "SIMPLE_RADIAL" else refined, tmp_path)
    assert_complete(caught.value, "export_not_possible")


def test_the_scene_is_a_valid_gltf_and_blender_would_show_the_callers_coordinates(tmp_path):
    refined = random_result(7)
    write_scene(refined, tmp_path / "scene.glb")
    document, binary = glb_parts(tmp_path / "scene.glb")
    assert document["asset"]["version"] == "2.0"
    names = [node["name"] for node in document["nodes"]]
    assert names == ["cameras before", "cameras after", "points", "world"]
    [top] = document["scenes"][document["scene"]]["nodes"]
    root = document["nodes"][top]
    assert sorted(root["children"]) == [0, 1, 2]
    shown = {}
    for node in document["nodes"][:3]:
        primitive, *faces = document["meshes"][node["mesh"]]["primitives"]
        xyz = glb_accessor(document, binary, primitive["attributes"]["POSITION"])
        accessor = document["accessors"][primitive["attributes"]["POSITION"]]
        np.testing.assert_array_equal(accessor["min"], xyz.min(0))
        np.testing.assert_array_equal(accessor["max"], xyz.max(0))
        colours = glb_accessor(document, binary, primitive["attributes"]["COLOR_0"])
        assert len(colours) == len(xyz)
        if "indices" in primitive:
            indices = glb_accessor(document, binary, primitive["indices"])
            assert indices.max() < len(xyz)
            assert len(indices) % 2 == 0
            [drawn] = faces
            assert (drawn["mode"], drawn["attributes"]) == (4, primitive["attributes"])
            sides = glb_accessor(document, binary, drawn["indices"])[:, 0].reshape(-1, 3)
            # Every face joins vertices of one camera, and of each camera there are four sides and the tip.
            np.testing.assert_array_equal(
                sides // 6, np.repeat(np.arange(len(xyz) // 6), 5)[:, None].repeat(3, 1)
            )
            assert document["materials"][drawn["material"]]["alphaMode"] == "BLEND"
        # Node, then the turn that Blender's importer makes: (x, y, z) of glTF becomes (x, -z, y).
        x, y, z = turned(xyz, root["rotation"]).T + np.array(root["translation"])[:, None]
        shown[node["name"]] = np.stack([x, -z, y], 1)
    centres = refined.world_from_cam[:, :3, 3]
    np.testing.assert_allclose(shown["cameras after"][::6], centres, atol=1e-5)
    given = np.stack([image.given for image in refined.images if image.given is not None])
    np.testing.assert_allclose(shown["cameras before"][::6], given[:, :3, 3], atol=1e-5)
    np.testing.assert_allclose(shown["points"], refined.model.points.xyz, atol=1e-5)
    # The picture's middle lies ahead of the centre, along the camera's z axis.
    corners = shown["cameras after"].reshape(-1, 6, 3)[:, 1:5].mean(1) - centres
    ahead = (corners * refined.world_from_cam[:, :3, 2]).sum(1) / np.linalg.norm(corners, axis=1)
    assert (ahead > 0.95).all()


def turned(xyz, quaternion):
    return Rotation.from_quat(quaternion).apply(xyz)


def test_coordinates_of_a_map_keep_their_digits_in_the_scene(tmp_path):
    refined = random_result(8)
    far = np.array([4.5e5, 5.4e6, 120.0])
    images = []
    for image in refined.images:
        pose = image.world_from_cam.copy()
        pose[:3, 3] += far
        images.append(replace(image, world_from_cam=pose))
    write_scene(with_(refined, images=tuple(images)), tmp_path / "scene.glb")
    document, binary = glb_parts(tmp_path / "scene.glb")
    after = document["meshes"][1]["primitives"][0]["attributes"]["POSITION"]
    assert np.abs(glb_accessor(document, binary, after)).max() < 100


def test_all_exports_are_written_and_those_that_cannot_be_say_why(tmp_path):
    refined = centred(random_result(9, model="SIMPLE_RADIAL"))
    notes = write_result_formats(refined, tmp_path, ["colmap-text", "instant-ngp", "kitti", "bundler"])
    [note] = notes
    assert note.startswith("colmap-text was not written")
    assert "space" in note
    found = {path.relative_to(tmp_path).as_posix() for path in tmp_path.rglob("*") if path.is_file()}
    assert found == {
        *(f"colmap/sparse/0/{table}.bin" for table in ("cameras", "images", "points3D")),
        *("tum.txt", "scene.glb", "poses.json", "poses.csv", "kitti.txt", "kitti_images.txt"),
        *("transforms_ngp.json", "transforms_nerfstudio.json", "points.ply"),
        *("bundler/bundle.out", "bundler/list.txt"),
    }
    always = {name for name, one in formats().items() if one.always}
    assert always == {"transforms", "nerfstudio", "colmap", "tum", "scene", "points", "poses", "csv"}
