"""The real job program on panoramas that were sent: its result holds the views that it names."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

from biresnerf.data.synthetic.captures import write_panoramas
from tests.workers.run.test_video_jobs import SMALL, run

pytestmark = [pytest.mark.server, pytest.mark.slow]


def test_the_result_of_panoramas_has_a_pose_for_each_and_its_views_can_be_exported(tmp_path: Path) -> None:
    job = tmp_path / "job"
    write_panoramas(job / "input", 3, 128, seed=1)
    run(job, {"input": "input", "output": "output", "options": {**SMALL, "start": "given"}})
    result = job / "output"
    document = json.loads((result / "transforms.json").read_text())
    assert document["camera_model"] == "EQUIRECTANGULAR"
    assert [frame["file_path"] for frame in document["frames"]] == [f"images/{i:03}.jpg" for i in range(3)]
    views = json.loads((result / "poses.json").read_text())["images"]
    assert len(views) == 18
    assert all((result / view["file_name"]).is_file() for view in views)
    export = tmp_path / "export"
    shutil.copytree(result, export / "result")
    shutil.copytree(job / "input", export / "input")
    order = {"task": "export", "input": "input", "output": "output", "options": {"formats": ["pinhole"]}}
    run(export, {**order, "result": "result"})
    assert len(list((export / "output").rglob("images/**/*.jpg"))) == 18
