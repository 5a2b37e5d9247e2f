"""What a whole run leaves when its input was a COLMAP model: the same ids, and points of the refined cameras."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from biresnerf.data.formats.colmap.read_model import read_colmap_model
from biresnerf.data.formats.colmap.write_text import write_colmap_text
from biresnerf.data.formats.read_dataset import read_dataset
from biresnerf.data.model.colmap_scene import matrix_of_pose
from biresnerf.data.model.result_model import model_of_poses
from biresnerf.data.synthetic.scene import synthetic_cameras, write_synthetic_scene
from biresnerf.geometry.camera.pixel_rays import pixels_of_points
from biresnerf.geometry.perturb import perturb_poses
from biresnerf.geometry.rigid import rigid_inverse
from biresnerf.pipeline import refine_poses
from tests.data.points.test_refined_points import seen_model
from tests.refinement.tiny_scene import tiny_run

pytestmark = pytest.mark.slow


def test_a_text_model_comes_back_in_both_forms_with_its_ids_and_points_of_the_refined_cameras(tmp_path):
    scene = tmp_path / "scene"
    given = read_dataset(write_synthetic_scene(tmp_path / "rendered", 7, 24, seed=3))
    (scene / "images").mkdir(parents=True)
    for frame in given.frames:
        frame.path.rename(scene / "images" / frame.path.name)
    names = [frame.path.name for frame in given.frames]
    truth = synthetic_cameras(7, 3)
    noisy = perturb_poses(truth, 0.01, 1)
    camera = given.cameras[0]
    # Points as the true cameras see them, in a model whose poses are noisy and whose ids have gaps.
    xyz = np.random.default_rng(0).uniform(-0.6, 0.6, (30, 3))
    exact = seen_model(1, truth, xyz, camera=camera)
    poses = model_of_poses(names, [camera], [0] * 7, noisy).images
    images = {
        10 * number: replace(
            image, id=10 * number, name=names[number - 1], cam_from_world=poses[number].cam_from_world
        )
        for number, image in exact.images.items()
    }
    points = replace(exact.points, track_image_ids=10 * exact.points.track_image_ids, xyz=xyz)
    write_colmap_text(replace(exact, images=images, points=points), scene / "sparse/0")

    options = tiny_run(
        start="given", verdict=False, exports=("kitti", "pinhole"), leave_out=(f"images/{names[6]}",)
    )
    report = refine_poses(scene, tmp_path / "out", options)
    del images[70]
    model = read_colmap_model(tmp_path / "out/colmap/sparse/0")
    text = read_colmap_model(tmp_path / "out/colmap/sparse_txt/0")
    assert {i: image.name for i, image in model.images.items()} == {
        i: image.name for i, image in images.items()
    }
    assert list(text.images) == list(model.images)
    assert report.points is not None
    assert report.points.source == "tracks"
    assert report.points.count == len(model.points) > 20
    assert set(model.points.ids) <= set(points.ids)
    assert not np.isin(model.points.xyz, xyz).any()
    for k in range(len(model.points)):  # the errors that the file names are those of its own cameras
        off = []
        for element in range(model.points.track_starts[k], model.points.track_starts[k + 1]):
            image = model.images[int(model.points.track_image_ids[element])]
            pose = matrix_of_pose(image.cam_from_world)
            in_cam = (pose[:3, :3] @ model.points.xyz[k] + pose[:3, 3])[None]
            seen = image.points2d_px[model.points.track_point2d_indices[element]]
            off.append(
                np.linalg.norm(pixels_of_points(model.cameras[image.camera_id].full(), in_cam)[0] - seen)
            )
        np.testing.assert_allclose(model.points.errors[k], np.mean(off), atol=1e-6)
    centres = np.stack(
        [rigid_inverse(matrix_of_pose(image.cam_from_world))[:3, 3] for image in model.images.values()]
    )
    assert np.abs(centres - noisy[:6, :3, 3]).max() > 1e-4
    assert (tmp_path / "out/kitti.txt").is_file()
    assert len(list((tmp_path / "out/pinhole/images").iterdir())) == len(report.images) == 6
