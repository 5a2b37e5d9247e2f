"""The real job program on a video that was sent: its result holds the frames that it names."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from tests.data.photos.video.filmed import film
from tests.workers.conftest import ROOT

pytestmark = [pytest.mark.server, pytest.mark.slow]

SMALL = {
    "preset": "fast", "steps": 20, "max_image_size": 32, "samples_per_step": 2048, "reconstruction_levels": 2,
    "table_size_log2": 12, "orbit_frames": 2, "verdict": False, "threads": 1, "video_frames": 5,
}  # fmt: skip


def run(folder: Path, order: dict[str, object]) -> None:
    (folder / "job.json").write_text(json.dumps(order))
    command = [sys.executable, "-m", "workers.run.job_process", str(folder)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr[-2000:]


def test_the_result_of_a_video_has_the_frames_that_it_names_and_can_be_exported(tmp_path: Path) -> None:
    job = tmp_path / "job"
    (job / "input").mkdir(parents=True)
    film(job / "input/walk.mp4", np.linspace(0, 200, 40), [False] * 40)
    run(job, {"input": "input", "output": "output", "options": SMALL})
    result = job / "output"
    frames = json.loads((result / "transforms.json").read_text())["frames"]
    assert len(frames) == 5
    for frame in frames:
        assert frame["file_path"].startswith("video_frames/walk_mp4/00m0")
        assert (result / frame["file_path"]).is_file()
    export = tmp_path / "export"
    shutil.copytree(result, export / "result")
    (export / "input").mkdir()
    shutil.copy(job / "input/walk.mp4", export / "input")
    shutil.copytree(result / "video_frames", export / "input/video_frames")  # as `stage_job` lays it out
    order = {"task": "export", "input": "input", "output": "output", "options": {"formats": ["pinhole"]}}
    run(export, {**order, "result": "result"})
    assert len(list((export / "output").rglob("images/*.jpg"))) == 5
