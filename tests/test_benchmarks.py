"""The benchmarks measure and collect what they claim."""

from __future__ import annotations

import argparse
import re
import sys
import time
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks.gpu import report
from benchmarks.large import made_aerial
from benchmarks.method import field_floor, peers
from benchmarks.sets.aerial_ground import render
from benchmarks.speed.clock import timed
from biresnerf.data.formats.read_dataset import read_dataset
from biresnerf.data.model.dataset import Dataset, Frame, SourceFormat
from biresnerf.data.synthetic.scene import synthetic_focal, write_synthetic_scene
from biresnerf.geometry.camera.camera_models import Camera
from biresnerf.geometry.perturb import perturb_poses
from biresnerf.geometry.pose_error import pose_error, rotation_between_deg
from biresnerf.refinement.optimise.methods import find_method
from biresnerf.studies.scenes import with_poses
from tests.data.scenes import textured_arc

pytestmark = pytest.mark.slow


def test_time_within_another_part_counts_for_both():
    class Parts:
        def outer(self):
            time.sleep(0.01)
            self.inner()

        def inner(self):
            time.sleep(0.02)

    parts = [(Parts, "outer", "outer"), (Parts, "inner", "inner")]
    with timed(parts, time.perf_counter) as spent:
        Parts().outer()
        Parts().inner()
    assert spent["outer"] == pytest.approx(0.03, abs=0.015)
    assert spent["inner"] > 0.035


def test_colmap_on_a_rendered_arc_is_measured_against_its_truth(tmp_path):
    pytest.importorskip("pycolmap", reason="needs pycolmap (pip install 'biresnerf[colmap]')")
    poses = textured_arc(tmp_path, 10, 300)
    camera = Camera("SIMPLE_PINHOLE", 300, 300, (synthetic_focal(300), 150, 150))
    photos = sorted(tmp_path.iterdir())
    frames = tuple(Frame(p.name, p, 0, pose, "given") for p, pose in zip(photos, poses, strict=True))
    truth = Dataset(tmp_path, (camera,), frames, SourceFormat("nerfstudio", None, {}, np.eye(4)))
    lines = list(peers.measured("arc", truth, with_poses(truth, perturb_poses(poses, 0.1, seed=2)), seed=1))
    assert [line["peer"] for line in lines] == list(peers.PEERS)
    for line in lines:
        assert line["placed"] == 10
        assert line["rotation_deg"] <= line["worst_deg"] < 2  # of 12 with the noise
        assert line["centre_percent"] < 2
    assert lines[0]["rotation_deg"] != lines[1]["rotation_deg"], "priors have a say"
    assert len(peers.table(lines).splitlines()) == 3


def reported(monkeypatch: pytest.MonkeyPatch, out: Path, *arguments: str) -> list[str]:
    """The parts of a report: each its name, its command, what that printed, and a line that says how it ended."""
    monkeypatch.setattr(sys, "argv", ["report", "--out", str(out), "--device", "cpu", *arguments])
    report.main()
    return re.split(r"^===== ", out.read_text(), flags=re.M)[1:]


def test_a_gpu_report_goes_on_whatever_happens_to_a_part(tmp_path, monkeypatch):
    python = (sys.executable, "-c")
    planned = [
        report.Part("works", (*python, "print(6 * 7)"), 60),
        report.Part("fails", (*python, "print('so far'); raise SystemExit(3)"), 60),
        report.Part("hangs", (*python, "import time; print('so far', flush=True); time.sleep(60)"), 3),
        report.Part("lacks", ("no-such-program",), 60),
        report.Part("crashes", (*python, "import os; os.abort()"), 60),
    ]
    monkeypatch.setattr(report, "parts", lambda _asked, _work: planned)
    ended = ("works: exit status 0", "fails: exit status 3", "hangs: not done after 3 s", "lacks: not there")
    said = ("42\n", "so far\n", "so far\n", "no-such-program", "")
    for part, end, text in zip(
        reported(monkeypatch, tmp_path / "r.txt"), (*ended, "crashes: exit status -6"), said, strict=True
    ):
        assert part.splitlines()[-2].startswith(end)
        assert text in part


def test_a_report_made_on_a_cpu_has_a_scene_and_the_error_of_its_run(tmp_path, monkeypatch):
    quick = ("steps=40", "max_image_size=32", "start=given", "verdict=false")
    asked = (
        "--parts",
        "scene,runs",
        "--presets",
        "fast",
        "--views",
        "8",
        *(word for s in quick for word in ("--set", s)),
    )
    scene, run = reported(monkeypatch, tmp_path / "r.txt", *asked)
    assert "\nscene: exit status 0" in scene
    assert "8 views" in scene
    assert "\nruns: exit status 0" in run
    assert re.search(r"\| made \| noise 0.15 \| default \| \d+\.\d+ ", run)


def test_wheels_stand_in_for_what_is_missing(tmp_path):
    with zipfile.ZipFile(tmp_path / "carried-1-py3-none-any.whl", "w") as wheel:
        wheel.writestr("carried_for_this_test.py", "print('found')")
    asked = argparse.Namespace(wheels=tmp_path, device="cuda")
    variables = report.environment(asked, tmp_path / "work")
    part = report.Part("any", (sys.executable, "-c", "import carried_for_this_test, biresnerf"), 60)
    with (tmp_path / "said.txt").open("w") as said:
        assert report.run(part, variables, said) == "exit status 0"
    assert (tmp_path / "said.txt").read_text() == "found\n"


def test_photos_of_the_made_neighbourhood_show_one_place_where_their_poses_say():
    yaw, pitch, centres = made_aerial.flight(2, np.random.default_rng(3))
    poses, focal, width, height = made_aerial.poses_of(yaw, pitch, centres), 150.0, 220, 165
    (photo, depth), (other, other_depth) = (render(pose, width, height, focal, 1, 1) for pose in poses)
    x, y = np.meshgrid(np.arange(width) + 0.5 - width / 2, np.arange(height) + 0.5 - height / 2)
    at = np.stack([x / focal, y / focal, np.ones_like(x), 1 / depth], -1) * depth[..., None]
    moved = at @ (np.linalg.inv(poses[1]) @ poses[0]).T
    column = np.floor(moved[..., 0] / moved[..., 2] * focal + width / 2).astype(int)
    row = np.floor(moved[..., 1] / moved[..., 2] * focal + height / 2).astype(int)
    both = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    assert both.mean() > 0.5
    row, column = row[both], column[both]
    off = np.abs(moved[both][:, 2] - other_depth[row, column])
    assert np.median(off) < 0.2  # of 62 m, by pixels of 0.4 m; the rest is edges of roofs and trees
    assert np.mean(off < 0.5) > 0.9
    assert np.corrcoef(photo[both].mean(-1), other[row, column].mean(-1))[0, 1] > 0.8


def test_a_made_drone_photo_says_where_it_was_taken_and_how_the_gimbal_stood(tmp_path):
    yaw, pitch = np.array([37.0]), np.array([-90.0])
    pose = made_aerial.poses_of(yaw, pitch, np.array([[10.0, 20.0, 62.0]]))[0]
    path = tmp_path / "DJI_00001.JPG"
    made_aerial.write_photo(path, pose, pose, 0, 64, 1, 0.0)
    said = path.read_bytes()
    assert b'GimbalYawDegree="+37.00"' in said
    assert b'GimbalPitchDegree="-90.00"' in said
    assert b'RelativeAltitude="+62.000"' in said


def test_a_field_that_was_learned_at_true_poses_keeps_them_near_the_truth(tmp_path):
    truth = read_dataset(write_synthetic_scene(tmp_path / "made", 12, 48, 1))
    method = replace(find_method("biresnerf"), schedule=field_floor.HeldFirst)
    checked: list[np.ndarray] = []
    end = field_floor.field_end(truth, method, {"steps": 60, "check_every": 10, "seed": 1}, checked.append)
    moved = [rotation_between_deg(checked[0], poses).max() for poses in checked]
    assert max(moved[:2]) == 0
    assert moved[-1] > 0.001, "the poses are free in the end"
    assert pose_error(end, truth.world_from_cam).aligned.rotation_deg.mean < 1
