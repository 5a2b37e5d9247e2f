"""A whole run on poses of the user's own frame, with measured positions and a known distance beside them."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from biresnerf.data.formats.read_dataset import read_dataset
from biresnerf.data.formats.simple.poses_json import read_poses_json
from biresnerf.data.model.measured_places import PositionPriors
from biresnerf.data.photos.images import load_images
from biresnerf.data.synthetic.scene import write_synthetic_scene
from biresnerf.errors import InputError
from biresnerf.pipeline import refine_poses
from biresnerf.refinement.start.refined_poses import RefinedPoses
from biresnerf.write.output_folder import GEOREFERENCE
from tests.refinement.tiny_scene import tiny_optimiser, tiny_options, tiny_run

pytestmark = pytest.mark.slow

METRES_PER_UNIT = 5.0


def test_the_frame_stays_the_users_and_the_report_says_where_on_earth_it_is(tmp_path):
    path = write_synthetic_scene(tmp_path / "scene", 8, 24, seed=3)
    given = read_dataset(path)
    centres = METRES_PER_UNIT * given.world_from_cam[:, :3, 3] + [1000.0, 2000.0, 300.0]
    rows = [f"{name},{x},{y},{z},0.5" for name, (x, y, z) in zip(given.file_names, centres, strict=True)]
    (path.parent / "positions.csv").write_text("\n".join(["name,x,y,z,accuracy", *rows]))
    names = given.names
    ends = f"{names[0]}, {names[3]}, {np.linalg.norm(centres[0] - centres[3])}"
    said = []
    options = tiny_run(start="given", verdict=False, known_distance=ends, fixed=(names[0], names[3]))
    report = refine_poses(
        path.parent, tmp_path / "out", options, lambda progress: said.append(progress.message)
    )
    found = np.array([image.world_from_cam for image in read_poses_json(tmp_path / "out/poses.json").images])
    assert (
        np.abs(found[:, :3, 3] - given.world_from_cam[:, :3, 3]).max() < 1
    )  # in the input's frame and scale
    matrix = np.array(report.geo_reference.metres_from_world)
    np.testing.assert_allclose(found[:, :3, 3] @ matrix[:3, :3].T + matrix[:3, 3], centres, atol=3)
    assert report.geo_reference.residual_m < 1.5
    assert report.known_scale.metres_per_unit == pytest.approx(METRES_PER_UNIT)
    written = json.loads((tmp_path / "out" / GEOREFERENCE).read_text())
    assert [camera["name"] for camera in written["cameras"]] == list(names)
    assert "reading 8 photos: 100 %" in said


def test_where_nobody_gave_poses_the_result_lies_where_it_was_measured(tmp_path):
    path = write_synthetic_scene(tmp_path / "scene", 8, 24, seed=3)
    given = read_dataset(path)
    frames = tuple(replace(frame, pose_source="colmap") for frame in given.frames)
    rows, places = np.arange(8), given.world_from_cam[:, :3, 3]
    # A metre, the unit of the poses found, is seven parts in a thousand more than it is by the positions.
    positions = PositionPriors("EXIF", rows, 1.007 * places, np.full((8, 3), 0.01), None, None)
    dataset = replace(given, frames=frames, positions=positions)
    optimiser = tiny_optimiser(dataset, load_images(dataset, 24), tiny_options())
    found = RefinedPoses.now(dataset, optimiser.joint).world_from_cam
    np.testing.assert_allclose(found[:, :3, 3], 1.007 * places, atol=1e-6)
    given = RefinedPoses.now(replace(given, positions=positions), optimiser.joint).world_from_cam
    np.testing.assert_allclose(given[:, :3, 3], places, atol=1e-6)


def test_a_distance_between_unknown_photos_is_refused_before_the_run(tmp_path):
    path = write_synthetic_scene(tmp_path / "scene", 4, 24, seed=3)
    with pytest.raises(InputError, match="neither a photo"):
        refine_poses(path.parent, tmp_path / "out", tiny_run(start="given", known_distance="a.jpg, b.jpg, 1"))
    assert not (tmp_path / "out").exists()
