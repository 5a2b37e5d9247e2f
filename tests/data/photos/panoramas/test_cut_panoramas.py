"""Panoramas are cut into views of one rig, and one pose for each comes back."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from biresnerf.data.formats.codec import WriteContext
from biresnerf.data.formats.colmap.read_model import read_colmap_model
from biresnerf.data.formats.positions.control_points import control_points
from biresnerf.data.formats.positions.position_priors import position_priors
from biresnerf.data.formats.read_dataset import read_dataset, read_poses
from biresnerf.data.formats.registry import ALL_CODECS
from biresnerf.data.formats.result_formats import read_result, write_result_formats
from biresnerf.data.model.colmap_scene import matrix_of_pose
from biresnerf.data.model.dataset import Dataset
from biresnerf.data.model.refined_set import refined_set
from biresnerf.data.photos.decode import decode
from biresnerf.data.photos.masks import load_mask
from biresnerf.data.photos.panoramas.cut_panoramas import called_panoramas, cut_panoramas
from biresnerf.data.scene_kind import OPEN
from biresnerf.data.seeding.seed_poses import seed_poses
from biresnerf.data.synthetic.captures import TABLE_SCENE, table_textures, write_panoramas
from biresnerf.data.synthetic.scene import render_shapes
from biresnerf.data.workload import workload
from biresnerf.errors import InputError
from biresnerf.geometry.camera.camera_models import Camera
from biresnerf.geometry.perturb import perturb_poses
from biresnerf.geometry.pose_error import pose_error
from biresnerf.geometry.rigid import rigid_inverse
from biresnerf.options.refine_options import RefineOptions
from biresnerf.pipeline import refine_poses
from biresnerf.refinement.parameters.rigid_bodies import rigid_bodies
from biresnerf.run.photos_added import joined_to
from biresnerf.write.georeference import control_report
from tests.refinement.tiny_scene import tiny_run

WIDTH, VIEWS, FACES = 256, 3, 6


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> Path:
    """A folder of panoramas with their true poses."""
    folder: Path = tmp_path_factory.mktemp("panoramas")
    write_panoramas(folder, VIEWS, WIDTH, seed=1)
    return folder


def cut(dataset: Dataset, folder: Path) -> Dataset:
    return cut_panoramas(dataset, folder, lambda _done: None)


def test_each_view_shows_what_a_pinhole_with_its_pose_would(made, tmp_path):
    dataset = cut(read_dataset(made), tmp_path)
    assert len(dataset) == VIEWS * FACES
    for index in range(FACES):
        camera, pose = dataset.camera_of(index), dataset.world_from_cam[index]
        rendered, _ = render_shapes(
            TABLE_SCENE, table_textures(1), pose, camera.width, camera.height, camera.params[0]
        )
        shown = decode(dataset.frames[index], camera)
        difference = np.abs(shown.astype(float) - rendered[..., :3])
        shifted = np.abs(np.roll(shown, 1, axis=1).astype(float) - rendered[..., :3])
        assert difference.mean() < shifted.mean() / 1.2, dataset.names[index]


def test_a_pixel_of_a_view_lies_in_the_panorama_where_colmap_puts_its_ray(tmp_path):
    pycolmap = pytest.importorskip("pycolmap", reason="needs pycolmap (pip install 'biresnerf[colmap]')")
    size = (512, 256)
    sphere = pycolmap.Camera.create_from_model_name(1, "EQUIRECTANGULAR", 1.0, *size)
    # Colours that are the position in the panorama: smooth but for the seam.
    x, y = np.meshgrid(np.arange(size[0]) / 2, np.arange(size[1]))
    picture = np.stack([np.abs(x - 128), y, 0 * x], axis=-1)
    (tmp_path / "in").mkdir()
    for number in range(3):
        Image.fromarray(picture.astype(np.uint8)).save(tmp_path / "in" / f"{number}.png")
    dataset = cut(called_panoramas(read_dataset(tmp_path / "in")), tmp_path / "out")
    for index in range(FACES):
        camera, turn = dataset.camera_of(index), dataset.cut.cam_from_whole[index, :3, :3]
        shown = decode(dataset.frames[index], camera).astype(float)
        for u, v in ((20.5, 70.5), (64.5, 64.5), (100.5, 33.5)):
            ray = np.array([u / (camera.width / 2) - 1, v / (camera.height / 2) - 1, 1.0]) @ turn
            at = np.asarray(sphere.img_from_cam(ray / np.linalg.norm(ray))).ravel() - 0.5
            expected = (abs(at[0] / 2 - 128), at[1])
            np.testing.assert_allclose(shown[int(v), int(u), :2], expected, atol=3)


def test_panoramas_without_metadata_are_cut_when_asked(made, tmp_path):
    for path in (made / "images").iterdir():
        Image.open(path).save(tmp_path / path.name)
    plain = read_dataset(tmp_path)
    assert cut(plain, tmp_path / "no") is plain
    assert len(cut(called_panoramas(plain), tmp_path / "yes")) == VIEWS * FACES


def test_what_a_mask_hides_wholly_is_left_out_and_the_rest_hidden_in_its_view(made, tmp_path):
    for path in (made / "images").iterdir():
        (tmp_path / path.name).symlink_to(path)
        mask = np.full((WIDTH // 2, WIDTH), 255, np.uint8)
        mask[WIDTH * 3 // 8 - 14 :] = 0  # from within the level views downward
        (tmp_path / "masks").mkdir(exist_ok=True)
        Image.fromarray(mask).save(tmp_path / "masks" / f"{path.name}.png")
    dataset = cut(read_dataset(tmp_path), tmp_path / "out")
    assert not any("down" in name for name in dataset.names)
    assert len(dataset) == VIEWS * (FACES - 1)
    front = load_mask(dataset.frames[0], dataset.camera_of(0))
    assert front[0].all()
    assert not front[-1].any()
    up = next(i for i, name in enumerate(dataset.names) if "up" in name)
    assert load_mask(dataset.frames[up], dataset.camera_of(up)).all()


def test_views_of_a_panorama_are_one_body_and_called_by_its_name(made, tmp_path):
    dataset = cut(read_dataset(made), tmp_path)
    options = RefineOptions(fixed=("images/001.jpg",))
    bodies = rigid_bodies(dataset, options)
    assert np.array_equal(bodies.of, dataset.cut.rows)
    assert np.array_equal(bodies.fixed, dataset.cut.rows == 1)
    # They stand at one point, so they say nothing of the scale.
    free = replace(bodies, fixed=np.zeros_like(bodies.fixed))
    assert free.input_from_optimised(dataset.world_from_cam, dataset.world_from_cam) is None


def test_a_measured_position_counts_once(made, tmp_path):
    for path in (made / "images").iterdir():
        (tmp_path / path.name).symlink_to(path)
    lines = [f"{number:03}.jpg,{number},{2 * number},3" for number in range(VIEWS)]
    (tmp_path / "positions.csv").write_text("\n".join(["name,x,y,z", *lines]) + "\n")
    dataset = cut(read_dataset(tmp_path), tmp_path / "out")
    found = position_priors(dataset)
    assert dataset.cut.rows[found.rows].tolist() == [0, 1, 2]
    np.testing.assert_array_equal(found.positions_m[:, 1], [0.0, 2.0, 4.0])


def test_a_result_has_one_pose_a_panorama_in_the_inputs_form_and_rigs_of_views(made, tmp_path):
    given = read_dataset(made)
    dataset = cut(given, tmp_path)
    moved = perturb_poses(given.world_from_cam, 0.1, seed=1)
    poses = dataset.cut.poses_of_views(moved)
    write_result_formats(refined_set(dataset, poses), tmp_path, (), WriteContext(dataset))
    back = read_poses(tmp_path / "transforms.json")
    assert list(back) == ["images/000.jpg", "images/001.jpg", "images/002.jpg"]
    np.testing.assert_allclose(np.stack([*back.values()]), moved, atol=1e-12)
    document = json.loads((tmp_path / "transforms.json").read_text())
    assert (document["camera_model"], document["w"], document["h"]) == ("EQUIRECTANGULAR", WIDTH, WIDTH // 2)

    model = read_colmap_model(tmp_path / "colmap/sparse/0")
    assert (len(model.rigs), len(model.frames), len(model.images)) == (1, VIEWS, VIEWS * FACES)
    rig = model.rigs[1]
    for frame in model.frames.values():
        for sensor, image in frame.data_ids:
            known = rig.sensor_from_rig.get(sensor)
            cam_from_rig = np.eye(4) if known is None else matrix_of_pose(known)
            cam_from_world = cam_from_rig @ matrix_of_pose(frame.rig_from_world)
            np.testing.assert_allclose(
                rigid_inverse(model.images[image].world_from_cam), cam_from_world, atol=1e-12
            )
    kept = read_result(tmp_path, made)
    assert all(image.path is not None and image.path.is_file() for image in kept.images)


def test_poses_that_did_not_move_keep_their_digits(made, tmp_path):
    dataset = cut(read_dataset(made), tmp_path)
    write_result_formats(refined_set(dataset, dataset.world_from_cam), tmp_path, (), WriteContext(dataset))
    before, after = (json.loads((folder / "transforms.json").read_text()) for folder in (made, tmp_path))
    assert [frame["transform_matrix"] for frame in after["frames"]] == [
        frame["transform_matrix"] for frame in before["frames"]
    ]


def spherical_opensfm(document):
    document[0]["cameras"]["0"] = {"projection_type": "spherical", "width": WIDTH, "height": WIDTH // 2}


def spherical_openmvg(document):
    lens = document["intrinsics"][0]["value"]
    lens["polymorphic_name"] = "spherical"
    lens["ptr_wrapper"]["data"] = {"width": WIDTH, "height": WIDTH // 2}


def spherical_meshroom(document):
    document["intrinsics"][0]["type"] = "equirectangular"


@pytest.mark.parametrize("name", ["opensfm", "openmvg", "meshroom"])
def test_spherical_cameras_of_other_programs_are_read_with_their_poses(made, tmp_path, name):
    given = read_dataset(made)
    plain = Camera("PINHOLE", WIDTH, WIDTH // 2, (100.0, 100.0, WIDTH / 2, WIDTH / 4))
    codec = ALL_CODECS[name]
    path = tmp_path / codec.format.in_set
    refined = refined_set(replace(given, cameras=(plain,)), given.world_from_cam)
    codec.write_set(refined, path, WriteContext())
    document = json.loads(path.read_text())
    {"opensfm": spherical_opensfm, "openmvg": spherical_openmvg, "meshroom": spherical_meshroom}[name](
        document
    )
    path.write_text(json.dumps(document))
    (tmp_path / "images").symlink_to(made / "images")
    read = read_dataset(path)
    assert [camera.model for camera in read.cameras] == ["EQUIRECTANGULAR"]
    np.testing.assert_allclose(read.world_from_cam, given.world_from_cam, atol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("noise", [None, 0.1])
def test_photos_alone_and_noisy_poses_end_near_the_truth(tmp_path, noise):
    pytest.importorskip("pycolmap", reason="needs pycolmap (pip install 'biresnerf[colmap]')")
    path = write_panoramas(tmp_path / "in", 6, 640, seed=2)
    whole = read_dataset(path)
    truth = whole.world_from_cam
    given = [None] * len(truth) if noise is None else list(perturb_poses(truth, noise, seed=1))
    frames = (replace(f, world_from_cam=p) for f, p in zip(whole.frames, given, strict=True))
    dataset = cut(replace(whole, frames=tuple(frames)), tmp_path / "out")
    best = seed_poses(dataset).candidates[-1]
    assert set(best.sources) <= {"colmap", "matches-incremental", "matches-global"}
    found = pose_error(dataset.cut.poses_of_whole(best.world_from_cam), truth).aligned
    assert found.rotation_deg.max < 0.15
    assert found.centre_percent.max < 1.0
    # All views of a panorama are at one place.
    views = dataset.cut.poses_of_views(dataset.cut.poses_of_whole(best.world_from_cam))
    np.testing.assert_allclose(best.world_from_cam, views, atol=1e-9)


def test_what_no_format_of_lenses_can_hold_is_refused_by_name(made, tmp_path):
    from biresnerf.data.formats.convert import convert

    with pytest.raises(InputError) as caught:
        convert(read_dataset(made), ["colmap"], tmp_path / "a")
    assert caught.value.code == "export_not_possible"
    convert(read_dataset(made), ["transforms", "tum"], tmp_path / "b")
    again = read_dataset(tmp_path / "b" / "transforms.json")
    np.testing.assert_array_equal(again.world_from_cam, read_dataset(made).world_from_cam)


def test_control_points_marked_in_panoramas_are_seen_in_their_views(made, tmp_path):
    folder = tmp_path / "in"
    shutil.copytree(made, folder)
    whole = read_dataset(folder)
    places = np.array([[2.0, 1.0, 0.3], [-1.0, 2.0, 0.5], [0.5, -2.0, 0.1], [0.2, 0.1, -1.0]])
    rows = ["name,x,y,z,image,px,py"]
    for frame in whole.frames:
        seen = (places - frame.world_from_cam[:3, 3]) @ frame.world_from_cam[:3, :3]
        for number, (place, (x, y, z)) in enumerate(zip(places, seen, strict=True)):
            # As docs/conventions.md has a panorama.
            px = WIDTH * (np.arctan2(x, z) / (2 * np.pi) + 0.5)
            py = WIDTH / 2 * (np.arctan2(y, np.hypot(x, z)) / np.pi + 0.5)
            at = ",".join(f"{value:.9f}" for value in (*place, px, py))
            x_y_z, marks = at.split(",")[:3], at.split(",")[3:]
            rows.append(",".join([f"p{number}", *x_y_z, frame.name, *marks]))
    (folder / "gcp.csv").write_text("\n".join(rows))
    dataset = cut(read_dataset(folder), tmp_path / "out")
    dataset = replace(dataset, control=control_points(dataset))
    assert len(dataset.control.image) == len(places) * VIEWS
    report = control_report(dataset, dataset.world_from_cam)
    assert report.control_m < 1e-5
    assert report.control_px < 1e-4


def test_a_forecast_counts_the_views(made, tmp_path):
    whole, asked = read_dataset(made), RefineOptions(preset="fast")
    foretold, views = (
        workload(each, asked, asked.resolved("cpu"), kind=OPEN, adjusts=True)
        for each in (whole, cut(whole, tmp_path))
    )
    assert foretold == views


@pytest.mark.slow
def test_panoramas_of_an_earlier_result_keep_their_poses(made, tmp_path):
    report = refine_poses(made, tmp_path / "out", tiny_run(start="given", verdict=False))
    assert len(report.images) == VIEWS * FACES
    shutil.copytree(made / "images", tmp_path / "more/images")
    joined, options = joined_to(read_dataset(tmp_path / "more"), RefineOptions(), tmp_path / "out")
    assert set(options.fixed) == {"images/000.jpg", "images/001.jpg", "images/002.jpg"}
    kept = read_poses(tmp_path / "out/transforms.json")
    np.testing.assert_array_equal(joined.world_from_cam, np.stack([*kept.values()]))
    assert all(camera.panorama for camera in joined.cameras)
