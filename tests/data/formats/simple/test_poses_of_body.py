"""Poses of the camera's carrier: written if the offset is known, else refused or reported as unknown."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from click.testing import CliRunner

from biresnerf.commands.poses.export import export_command
from biresnerf.data.formats.codec import WriteContext
from biresnerf.data.formats.read_dataset import read_dataset
from biresnerf.data.formats.result_formats import (
    export_result,
    read_result,
    write_body_beside,
    write_result_formats,
)
from biresnerf.data.model.refined_set import BODY, refined_set
from biresnerf.errors import InputError
from biresnerf.geometry.body_offset import BodyOffset
from biresnerf.geometry.rigid import rigid_inverse
from tests.data.formats.random_sets import random_poses, random_result
from tests.data.formats.readers import tum_poses
from tests.data.scenes import assert_complete

BODY_FROM_CAM = np.array([[0, -1, 0, 0.1], [1, 0, 0, 0.2], [0, 0, 1, 0.3], [0, 0, 0, 1.0]])
WHOLE = BodyOffset(BODY_FROM_CAM, 0.01, np.eye(3))


def with_offset(offset: BodyOffset | None):
    return replace(random_result(1, model="PINHOLE"), body_offset=offset)


def test_the_offset_is_read_back_from_a_result(tmp_path):
    refined = with_offset(BodyOffset(BODY_FROM_CAM, 0.01, np.eye(3)[:, :2]))
    write_result_formats(refined, tmp_path)
    found = read_result(tmp_path).body_offset
    assert found is not None
    np.testing.assert_array_equal(found.body_from_cam, BODY_FROM_CAM)
    np.testing.assert_array_equal(found.known_along, np.eye(3)[:, :2])
    assert found.shift_deviation == 0.01
    assert not (tmp_path / BODY).exists()


def test_a_finished_result_is_exported_with_the_poses_of_the_body(tmp_path):
    refined = with_offset(WHOLE)
    expected = refined.world_from_cam @ rigid_inverse(BODY_FROM_CAM)
    write_result_formats(refined, tmp_path)
    cameras = (tmp_path / "tum.txt").read_text()
    done = CliRunner().invoke(export_command, [str(tmp_path), "kitti", "--poses-of", "body", "--json"])
    assert done.exit_code == 0, done.output
    said = json.loads(done.stdout)
    assert (set(said["formats"]), said["warnings"]) == ({"tum", "csv", "kitti"}, [])
    np.testing.assert_allclose(tum_poses(tmp_path / BODY / "tum.txt")[1], expected, atol=1e-9)
    rows = np.loadtxt(tmp_path / BODY / "kitti.txt").reshape(-1, 3, 4)
    np.testing.assert_allclose(rows, expected[:, :3], atol=1e-9)
    assert (tmp_path / "tum.txt").read_text() == cameras, "those of the cameras stay"
    assert not (tmp_path / BODY / "poses.json").exists(), "whose names are those of cameras"


def test_without_an_offset_or_where_cameras_see_the_export_is_refused(tmp_path):
    for refined, names, word in (
        (with_offset(None), ["kitti"], "no offset"),
        (with_offset(WHOLE), ["kitti", "bundler"], "bundler"),
    ):
        with pytest.raises(InputError) as caught:
            export_result(refined, tmp_path, names, WriteContext(), "body")
        assert_complete(caught.value, "export_not_possible", "poses_of=body")
        assert word in str(caught.value)
        assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(("known", "words"), [(2, "along 1 of 3 directions."), (0, "sits on the body.")])
def test_a_shift_that_is_not_known_is_said(tmp_path, known, words):
    refined = with_offset(BodyOffset(BODY_FROM_CAM, 0.01 if known else None, np.eye(3)[:, :known]))
    _, notes = export_result(refined, tmp_path, [], WriteContext(), "body")
    assert any(words in note for note in notes)


def test_beside_a_result_the_input_file_is_written_with_its_own_poses(tmp_path):
    """A transforms.json of a flange comes back as one of the flange, bodies' axes and all."""
    rng = np.random.default_rng(2)
    rows = [
        {"file_path": f"{i}.jpg", "transform_matrix": pose.tolist()}
        for i, pose in enumerate(random_poses(rng, 4))
    ]
    given = {"w": 8, "h": 8, "fl_x": 9.0, "fl_y": 9.0, "cx": 4, "cy": 4, "station": "arm", "frames": rows}
    (tmp_path / "in").mkdir()
    (tmp_path / "in/transforms.json").write_text(json.dumps(given))
    for row in rows:
        _photo(tmp_path / "in" / row["file_path"])
    read = read_dataset(tmp_path / "in")
    frames = tuple(
        replace(f, world_from_cam=f.world_from_cam @ BODY_FROM_CAM, raw={"file_path": f.raw["file_path"]})
        for f in read.frames
    )
    dataset = replace(read, frames=frames, body_offset=WHOLE)
    refined = refined_set(dataset, dataset.world_from_cam, body_offset=WHOLE)
    notes = write_body_beside(refined, tmp_path / "out", ["kitti", "bundler"], WriteContext(dataset))
    written = json.loads((tmp_path / "out" / BODY / "transforms.json").read_text())
    assert written["station"] == "arm"
    found = np.array([row["transform_matrix"] for row in written["frames"]])
    np.testing.assert_allclose(found, [row["transform_matrix"] for row in rows], atol=1e-9)
    assert (tmp_path / "out" / BODY / "kitti.txt").is_file()
    (note,) = notes
    assert note.startswith("bundler ")
    nothing = write_body_beside(
        replace(refined, body_offset=None), tmp_path / "no", [], WriteContext(dataset)
    )
    assert "no offset" in nothing[0]
    assert not (tmp_path / "no").exists()


def _photo(path):
    from PIL import Image

    Image.new("RGB", (8, 8), "grey").save(path)
