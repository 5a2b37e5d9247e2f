"""What the benchmarks measure and gather is what they say."""

from __future__ import annotations

import importlib.util
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from benchmarks.gpu import gpu_report
from benchmarks.method import peers
from benchmarks.speed.clock import timed
from biresnerf.data.model.dataset import Dataset, Frame, SourceFormat
from biresnerf.data.synthetic.scene import synthetic_focal
from biresnerf.geometry.camera.camera_models import Camera
from biresnerf.geometry.perturb import perturb_poses
from biresnerf.studies.scenes import with_poses
from tests.data.scenes import textured_arc
from tests.docs.forms_of_commands import check_shell

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


def test_a_gpu_report_holds_what_each_command_printed_and_how_it_ended(tmp_path, monkeypatch):
    works, fails = (sys.executable, "-c", "print(6 * 7)"), (sys.executable, "-c", "raise SystemExit(3)")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(gpu_report, "commands", lambda _work: [works, fails, ("no-such-program",)])
    gpu_report.main()
    parts = (tmp_path / "gpu-report.txt").read_text().split("$ ")[1:]
    for part, expected in zip(
        parts, ("42\n\nexit status 0", "exit status 3", "exit status not there"), strict=True
    ):
        assert expected in part


def test_the_commands_of_a_gpu_report_are_there(tmp_path):
    for command in gpu_report.commands(tmp_path):
        words = list(command)
        if words[0] == sys.executable:
            assert importlib.util.find_spec(words[2]) is not None
        elif words[0] != "nvidia-smi":
            assert Path(words[0]).is_file()
            check_shell(" ".join(["biresnerf", *words[1:]]))
        for path in (word for word in words if word.startswith("tests/")):
            assert (Path(__file__).parents[1] / path).exists()
