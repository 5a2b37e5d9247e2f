"""`biresnerf evaluate` on files written by hand."""

from __future__ import annotations

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from imageio.v3 import imread
from scipy.spatial.transform import Rotation

from biresnerf.commands.poses.evaluate import evaluate_command, matched_names
from biresnerf.data.formats.colmap.write_binary import write_colmap_binary
from biresnerf.data.formats.simple.poses_json import write_poses_json
from biresnerf.data.model.colmap_scene import ColmapPoints
from biresnerf.data.model.result_model import with_points
from biresnerf.errors import InputError
from biresnerf.geometry.pose_error import pose_error
from tests.data.formats.random_sets import random_result
from tests.data.formats.simple import trajectories
from tests.geometry.rigs import dome, jitter, similar

OPENCV_FROM_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])


def write(path: Path, world_from_cam: np.ndarray, name: str = "images/{:02}.png", **keys: object) -> Path:
    frames = [
        {"file_path": name.format(i), "transform_matrix": (pose @ OPENCV_FROM_OPENGL).tolist()}
        for i, pose in enumerate(world_from_cam)
    ]
    path.write_text(json.dumps({**keys, "frames": frames}))
    return path


def run(*arguments: object) -> str:
    result = CliRunner().invoke(evaluate_command, [str(a) for a in arguments], catch_exceptions=False)
    assert result.exit_code == 0
    return result.output


def test_a_turned_camera_is_found_in_a_moved_frame_under_names_without_extension(tmp_path):
    truth = dome(12, np.random.default_rng(0))
    estimate = truth.copy()
    estimate[3, :3, :3] = truth[3, :3, :3] @ Rotation.from_euler("z", 24, degrees=True).as_matrix()
    moved = similar(estimate, 3.0, Rotation.from_euler("x", 50, degrees=True).as_matrix(), np.ones(3))
    error = json.loads(
        run(write(tmp_path / "a.json", moved), write(tmp_path / "b.json", truth, "./images/{:02}"), "--json")
    )
    assert error["cameras"] == 12
    assert error["aligned"]["rotation_deg"]["max"] == pytest.approx(24)
    assert error["aligned"]["rotation_deg"]["mean"] == pytest.approx(2)
    assert error["aligned"]["worst"] == "images/03.png"
    assert error["aligned"]["centre_percent"]["max"] == pytest.approx(0, abs=1e-9)
    assert error["own_frame"]["rotation_deg"]["median"] == pytest.approx(50)
    assert error["left_out"] == {"result": 0, "truth": 0}


def test_ate_rpe_and_auc_are_told_in_json_and_in_words(tmp_path):
    truth = dome(12, np.random.default_rng(0))
    estimate = truth.copy()
    estimate[3, :3, :3] = truth[3, :3, :3] @ Rotation.from_euler("z", 24, degrees=True).as_matrix()
    files = (
        write(tmp_path / "a.json", similar(estimate, 2.0, np.eye(3), np.ones(3))),
        write(tmp_path / "b.json", truth),
    )
    error = json.loads(run(*files, "--json"))
    assert error["ate_rmse"] == pytest.approx(0, abs=1e-9)
    assert error["rpe_rotation_deg_rmse"] == pytest.approx(24 * np.sqrt(2 / 11))
    # Of 66 pairs the 11 of the turned camera are wrong; the others are right.
    assert error["auc"]["10"] == pytest.approx(55 / 66, abs=1e-6)
    assert re.search(r"AUC of relative poses +@0\.5° 83\.3  @1° 83\.3", run(*files))


def test_pairs_that_share_no_view_of_a_true_model_are_told_apart_and_missing_cameras_count(tmp_path):
    truth = random_result(2, count=6)
    photos, tracks = truth.image_ids[:2], 5  # photos 0 and 1 see five common points, the others none
    points = ColmapPoints(
        np.arange(1, tracks + 1), np.zeros((tracks, 3)), np.zeros((tracks, 3), np.uint8), np.zeros(tracks),
        2 * np.arange(tracks + 1), np.tile(photos, tracks), np.repeat(np.arange(tracks), 2),
    )  # fmt: skip
    write_colmap_binary(with_points(truth.model, points), tmp_path / "sparse/0")
    poses = np.stack([image.world_from_cam for image in truth.images])
    poses[2, :3, :3] = poses[2, :3, :3] @ Rotation.from_euler("x", 40, degrees=True).as_matrix()
    result = write(tmp_path / "a.json", poses[:5], name="images/ö {:02}.jpg")
    error = json.loads(run(result, tmp_path / "sparse/0", "--json"))
    assert error["auc"]["1"] == pytest.approx(6 / 10, abs=1e-5)
    assert error["auc_all"]["1"] == pytest.approx(6 / 15, abs=1e-5)
    assert error["auc_covisible"]["1"] == pytest.approx(1.0, abs=1e-5)
    said = run(result, tmp_path / "sparse/0")
    assert re.search(r"of pairs that share a view +@0\.5° 100\.0", said)
    assert re.search(r"with cameras that were not placed +@0\.5° 40\.0", said)


def test_errors_before_and_after_stand_side_by_side_and_are_drawn(tmp_path):
    truth, rng = dome(9, np.random.default_rng(0)), np.random.default_rng(1)
    refined = random_result(1, count=9)
    given = [None if i == 4 else pose for i, pose in enumerate(jitter(truth, rng, 0.2, 0.2))]
    after = jitter(truth, rng, 0.01, 0.01)
    images = [
        replace(image, name=f"./images/{i:02}.png", world_from_cam=after[i], given=given[i])
        for i, image in enumerate(refined.images)
    ]
    write_poses_json(replace(refined, images=tuple(images)), tmp_path / "out" / "poses.json")
    write(tmp_path / "out" / "transforms.json", after)
    files = tmp_path / "out", write(tmp_path / "truth.json", truth)
    error = json.loads(run(*files, "--json"))
    known = [i for i in range(9) if i != 4]
    expected = pose_error(np.stack([given[i] for i in known]), truth[known])
    assert error["before"]["cameras"] == 8
    assert error["before"]["aligned_robust"]["rotation_deg"]["median"] == pytest.approx(
        expected.aligned_robust.rotation_deg.median
    )
    table = run(*files, "--plot", tmp_path / "errors.svg")
    was, now = error["before"]["aligned_robust"], error["aligned_robust"]
    assert f"rotation {was['rotation_deg']['median']:.3g} -> {now['rotation_deg']['median']:.3g} deg" in table
    assert "1 cameras had no pose before" in table
    drawn = (tmp_path / "errors.svg").read_text()
    for label, frame in (("before", was), ("after", now)):
        assert f"{label}: median {frame['rotation_deg']['median']:.3g}°" in drawn
        assert f"{label}: median {frame['centre_percent']['median']:.3g} %" in drawn
    run(*files, "-o", tmp_path / "errors.png")
    assert imread(tmp_path / "errors.png").shape[:2] == (600, 960)


def test_other_poses_stand_before_on_request_and_none_where_none_were(tmp_path):
    truth, rng = dome(9, np.random.default_rng(0)), np.random.default_rng(1)
    files = write(tmp_path / "a.json", truth), write(tmp_path / "b.json", truth)
    assert json.loads(run(*files, "--json"))["before"] is None
    before = write(tmp_path / "c.json", jitter(truth, rng, 0.2, 0.2))
    error = json.loads(run(*files, "--before", before, "--json"))
    assert error["before"]["aligned"]["rotation_deg"]["median"] > 1
    refused = CliRunner().invoke(evaluate_command, [*map(str, files), "-o", str(tmp_path / "errors.gif")])
    assert isinstance(refused.exception, InputError)
    assert "End it with .png" in str(refused.exception)


def test_the_published_alignment_is_added_on_request_only(tmp_path):
    rng = np.random.default_rng(0)
    truth = dome(9, rng)
    estimate = truth.copy()
    estimate[2, :3, 3] += 0.3
    files = write(tmp_path / "a.json", estimate), write(tmp_path / "b.json", truth)
    error = json.loads(run(*files, "--json", "--paper-compat"))
    # A rig with depth has no reflection to fix: both alignments are one.
    assert error["paper_compat"]["rotation_deg"] == pytest.approx(error["aligned"]["rotation_deg"])
    assert "paper_compat" not in json.loads(run(*files, "--json"))
    assert "paper compat" in run(*files, "--paper-compat")
    assert "paper compat" not in run(*files)


def test_applied_transform_and_scale_are_undone(tmp_path):
    truth = dome(6, np.random.default_rng(1))
    applied = np.eye(4)
    applied[:3, :3] = [[0, 1, 0], [1, 0, 0], [0, 0, -1]]
    applied[:3, 3] = [1, 2, 3]
    stored = applied @ truth
    stored[:, :3, 3] *= 0.25
    result = write(tmp_path / "a.json", stored, applied_transform=applied[:3].tolist(), applied_scale=0.25)
    error = json.loads(run(result, write(tmp_path / "b.json", truth), "--json"))
    assert error["own_frame"]["rotation_deg"]["max"] == pytest.approx(0, abs=1e-6)
    assert error["own_frame"]["centre_percent"]["max"] == pytest.approx(0, abs=1e-9)


def test_folders_stand_for_their_transforms_and_the_table_counts_what_is_left_out(tmp_path):
    truth = dome(8, np.random.default_rng(2))
    for name, poses in (("out", jitter(truth, np.random.default_rng(3), 0.1, 0.1)[:6]), ("true", truth)):
        (tmp_path / name).mkdir()
        write(tmp_path / name / "transforms.json", poses)
    table = run(tmp_path / "out", tmp_path / "true")
    assert "6 cameras" in table
    assert "0 only in the result, 2 only in the truth" in table
    for word in ("aligned", "robust", "own frame", "rotation (deg)"):
        assert word in table


def test_names_match_by_extension_only_where_nothing_else_tells_them_apart():
    assert matched_names(["a.png", "b"], ["b.JPG", "a"]) == [("a.png", "a"), ("b", "b.JPG")]
    assert matched_names(["a.png", "a.jpg"], ["a.png"]) == [("a.png", "a.png")]
    assert matched_names(["a.png", "a.jpg"], ["a"]) == []
    assert matched_names(["v1.2", "x/a"], ["v1", "y/b"]) == []


def test_names_match_by_file_name_alone_only_where_one_file_alone_has_it():
    assert matched_names(["images/a.png", "images/b.png"], ["b.jpg", "a.png"]) == [
        ("images/a.png", "a.png"),
        ("images/b.png", "b.jpg"),
    ]
    assert matched_names(["left/a.png", "right/a.png"], ["a.png"]) == []
    assert matched_names(["left/a.png"], ["l/a.png", "r/a.png"]) == []
    assert matched_names(["a.png", "x/a.png"], ["a.png"]) == [("a.png", "a.png")]


@pytest.mark.parametrize("form", trajectories.FORMS)
@pytest.mark.parametrize("with_images", [True, False])
def test_poses_in_every_form_compare_with_a_transforms_file(tmp_path, form, with_images):
    scene = tmp_path / "scene"
    trajectories.write_set(form, scene)
    named = with_images or form in ("colmap", "bundler", "metashape")
    if not with_images:
        shutil.rmtree(scene / "images")
    truth = write(tmp_path / "truth.json", trajectories.truth())
    document = json.loads(truth.read_text())
    for index, row in enumerate(document["frames"]):
        row["file_path"] = f"images/{trajectories.NAMES[index]}" if named else str(index)
    truth.write_text(json.dumps(document))
    error = json.loads(run(scene, truth, "--json"))
    assert error["cameras"] == 4
    assert error["own_frame"]["rotation_deg"]["max"] == pytest.approx(0, abs=1e-6)
    assert error["own_frame"]["centre_percent"]["max"] == pytest.approx(0, abs=1e-9)
    by_path = form == "bundler" or not named
    assert error["matched_by_file_name"] == (0 if by_path else 4)


@pytest.mark.parametrize(
    ("broken", "code", "where"),
    [
        ("{", "pose_file_invalid", "truth.json"),
        ('{"frames": 3}', "pose_file_invalid", "truth.json frames"),
        ('{"frames": [{}]}', "pose_file_invalid", "truth.json frames[0].file_path"),
        ('{"frames": [{"file_path": "a", "transform_matrix": [1]}]}', "pose_shape", "truth.json frames[0]"),
        ('{"frames": [{"file_path": "a"}, {"file_path": "./a"}]}', "duplicate_image", "truth.json frames[1]"),
        ('{"frames": [], "applied_scale": 0}', "pose_file_invalid", "truth.json applied_scale"),
        ('{"frames": []}', "no_common_images", "out.json"),
        (None, "input_missing", "truth.json"),
    ],
)
def test_a_file_that_cannot_be_compared_is_named(tmp_path, broken, code, where):
    result = write(tmp_path / "out.json", dome(4, np.random.default_rng(0)))
    truth = tmp_path / "truth.json"
    if broken is not None:
        truth.write_text(broken)
    outcome = CliRunner().invoke(evaluate_command, [str(result), str(truth)])
    assert isinstance(outcome.exception, InputError)
    assert outcome.exception.code == code
    assert outcome.exception.where.startswith(str(tmp_path / where))
    assert outcome.exception.hint
