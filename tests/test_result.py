"""A result in Python, against the files that it is read from."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

import biresnerf
from biresnerf.data.formats.colmap.read_model import read_colmap_model
from biresnerf.data.formats.result_formats import write_result_formats
from biresnerf.data.show.history import HISTORY
from biresnerf.errors import InputError
from biresnerf.options.refine_options import RefineOptions
from biresnerf.report import ImageReport, Report, SimilarityReport, Verdict
from biresnerf.uncertainty import PoseUncertainty
from tests.data.formats.random_sets import random_result

EYE = ((1, 0, 0), (0, 1, 0), (0, 0, 1))
NO_POSE_BEFORE = 1  # of `random_result`
COVARIANCE = tuple(tuple(float(6 * i + j) for j in range(6)) for i in range(6))


@pytest.fixture
def written(tmp_path):
    """A made result and its folder."""
    refined = random_result(1, model="SIMPLE_RADIAL")
    known = PoseUncertainty(known_from="matches", rotation_deg=0.1, position=0.2, covariance=COVARIANCE)
    images = (replace(refined.images[0], uncertainty=known), *refined.images[1:])
    refined = replace(refined, images=images)
    folder = tmp_path / "out"
    write_result_formats(refined, folder)
    report = Report(
        version="0", state="complete", options=RefineOptions(preset="fast").resolved("cpu"),
        verdict=Verdict(
            verdict="kept_input", returned="input", compared_with="given", why=("Too <weak>.",), moved_px=1.0
        ),
        images=tuple(
            ImageReport(name=i.name, pose_source="given", held_out=False, moved_deg=0, moved_units=0) for i in images
        ),
        steps_done=5, backend="cpu", device="cpu", threads=1, working_size=(4, 4),
        input_from_optimised=SimilarityReport(scale=1, rotation=EYE, translation=(0, 0, 0)),
        warnings=("<b> is no tag",),
    )  # fmt: skip
    (folder / "report.json").write_text(report.model_dump_json())
    lines = [
        {"step": 5, "stage": "coarse", "psnr": 9.5},
        {"step": 10, "stage": "fine", "psnr": 11.0, "odd": 1.0},
    ]
    (folder / HISTORY).write_text("".join(json.dumps(line) + "\n" for line in lines))
    return refined, folder


def test_arrays_are_those_of_the_result(written):
    refined, folder = written
    result = biresnerf.load(str(folder))
    assert result.names == tuple(image.name for image in refined.images)
    np.testing.assert_array_equal(result.poses, refined.world_from_cam)
    assert result.poses.dtype == np.float64
    assert result.intrinsics == tuple(refined.cameras[image.camera] for image in refined.images)
    np.testing.assert_array_equal(result.covariance[0], COVARIANCE)
    assert np.isnan(result.covariance[1:]).all()
    np.testing.assert_array_equal(result.history["psnr"], [9.5, 11.0])
    np.testing.assert_array_equal(result.history["odd"], [np.nan, 1.0])


def test_poses_of_the_body_that_carries_the_camera_follow_from_those_of_the_camera(written):
    _refined, folder = written
    assert biresnerf.load(folder).poses_of_body is None
    body_from_cam = np.array([[0, -1, 0, 0.1], [1, 0, 0, 0.2], [0, 0, 1, 0.3], [0, 0, 0, 1.0]])
    report = json.loads((folder / "report.json").read_text())
    report["input_accuracy"] = {
        "rotation_deg": 0.1,
        "position": 0.01,
        "body_from_camera": body_from_cam.tolist(),
    }
    (folder / "report.json").write_text(json.dumps(report))
    result = biresnerf.load(folder)
    np.testing.assert_allclose(result.poses_of_body @ body_from_cam, result.poses_refined, atol=1e-12)


def test_an_image_without_a_pose_before_has_none(written):
    refined, folder = written
    result = biresnerf.load(folder)
    given = [image.given for image in refined.images]
    for i, before in enumerate(given):
        if i == NO_POSE_BEFORE:
            assert np.isnan(result.poses_before[i]).all()
            assert np.isnan(result.moved[i])
        else:
            np.testing.assert_array_equal(result.poses_before[i], before)
            assert result.moved[i] == np.linalg.norm(result.poses[i, :3, 3] - before[:3, 3])


def test_refined_poses_are_there_where_the_inputs_are_returned(written):
    refined, folder = written
    np.testing.assert_array_equal(biresnerf.load(folder).poses_refined, refined.world_from_cam)
    others = random_result(2, model="SIMPLE_RADIAL")
    write_result_formats(others, folder / "refined")
    result = biresnerf.load(folder)
    np.testing.assert_array_equal(result.poses, refined.world_from_cam)
    np.testing.assert_array_equal(result.poses_refined, others.world_from_cam)


def test_a_colmap_model_is_written_where_it_is_asked_for_and_nothing_overwritten(written, tmp_path):
    refined, folder = written
    model = read_colmap_model(biresnerf.load(folder).to_colmap(tmp_path / "sparse"))
    assert {image.name for image in model.images.values()} == {image.file_name for image in refined.images}
    with pytest.raises(InputError, match="holds files"):
        biresnerf.load(folder).to_colmap(tmp_path / "sparse")


def test_further_formats_hold_the_returned_poses(written, tmp_path):
    refined, folder = written
    files = biresnerf.load(folder).export(tmp_path / "for others", "kitti", "opensfm", "nerfstudio")
    assert [path.relative_to(tmp_path).as_posix() for path in files] == [
        "for others/kitti.txt",
        "for others/reconstruction.json",
        "for others/transforms_nerfstudio.json",
    ]
    rows = np.loadtxt(files[0]).reshape(-1, 3, 4)
    np.testing.assert_allclose(rows, refined.world_from_cam[:, :3], atol=1e-8)
    with pytest.raises(InputError, match="did you mean `opensfm`"):
        biresnerf.load(folder).export(tmp_path, "opensfn")


def test_drawn_cameras_lie_where_the_poses_are(written):
    pytest.importorskip("matplotlib").use("Agg")
    refined, folder = written
    axes = biresnerf.load(folder).plot_cameras()
    drawn = [np.array(line.get_data_3d()) for line in axes.lines]
    after = drawn[len(refined.images) - 1 :]  # one has no pose before
    assert len(after) == len(refined.images)
    for line, pose in zip(after, refined.world_from_cam, strict=True):
        np.testing.assert_allclose(line[:, 0], pose[:3, 3])
        in_cam = (line[:, 1:5].T - pose[:3, 3]) @ pose[:3, :3]
        assert (in_cam[:, 2] > 0).all(), "pictures lie in front of their cameras"


def test_the_card_of_a_notebook_shows_text_as_text(written):
    card = biresnerf.load(written[1])._repr_html_()
    assert "Too &lt;weak&gt;." in card
    assert "&lt;b&gt; is no tag" in card


def test_a_folder_without_a_result_is_refused(tmp_path):
    with pytest.raises(InputError) as refused:
        biresnerf.load(tmp_path)
    assert refused.value.code == "result_missing"


def test_loading_needs_no_torch(written):
    program = f"import sys, biresnerf; biresnerf.load({str(written[1])!r}); sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", program]).returncode == 0
