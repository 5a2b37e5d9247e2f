"""The real job program asks for the parts of a large set, refines them, and joins what they found."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from biresnerf import load
from biresnerf.data.synthetic.scene import synthetic_focal
from biresnerf.geometry.perturb import perturb_poses
from biresnerf.uncertainty import NOT_REFINED, PartReport
from tests.data.scenes import textured_arc
from tests.workers.conftest import ROOT
from workers.records import EXIT_SPLIT, SPLIT_NAME
from workers.run.staging import JOINED_FROM

pytest.importorskip("pycolmap", reason="pycolmap is not installed (extra: colmap)")
pytest.importorskip("pymetis", reason="pymetis is not installed (extra: colmap)")
pytestmark = [pytest.mark.server, pytest.mark.slow]

PHOTOS, SIZE, MOST = 26, 200, 20
SMALL = {
    "preset": "fast", "device": "cpu", "steps": 20, "max_image_size": 24, "samples_per_step": 1024, "holdout": 0,
    "pose_resolution_max": 16, "reconstruction_levels": 1, "reconstruction_resolution_max": 128,
    "table_size_log2": 10, "start": "colmap", "threads": 1, "fixed": ["00.png"], "trial_steps": 20,
    "known_distance": "00.png, 25.png, 2", "orbit_frames": 2,
}  # fmt: skip


def ran(folder: Path, photos: Path, options: dict[str, object], **order: object) -> int:
    folder.mkdir(parents=True, exist_ok=True)
    shutil.copytree(photos, folder / "input")
    order = {"input": "input", "output": "output", "options": options, **order}
    (folder / "output").mkdir()
    (folder / "job.json").write_text(json.dumps(order))
    command = [sys.executable, "-m", "workers.run.job_process", str(folder)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=300)
    assert done.returncode in (0, EXIT_SPLIT), done.stderr[-3000:]
    return done.returncode


def photos_with_poses(folder: Path) -> np.ndarray:
    poses = textured_arc(folder, PHOTOS, SIZE)
    focal = synthetic_focal(SIZE)
    lens = {"w": SIZE, "h": SIZE, "fl_x": focal, "fl_y": focal, "cx": SIZE / 2, "cy": SIZE / 2}
    frames = [
        {"file_path": f"{row:02}.png", "transform_matrix": (pose @ np.diag([1.0, -1, -1, 1])).tolist()}
        for row, pose in enumerate(perturb_poses(poses, 0.01, seed=1))
    ]
    (folder / "transforms.json").write_text(json.dumps({**lens, "frames": frames}), "utf-8")
    return poses


def test_a_large_set_is_cut_refined_in_parts_and_joined(tmp_path: Path) -> None:
    photos = tmp_path / "photos"
    photos_with_poses(photos)
    split = {"above": 25, "most": MOST}
    assert ran(tmp_path / "whole", photos, SMALL, split=split) == EXIT_SPLIT
    asked = json.loads((tmp_path / "whole" / SPLIT_NAME).read_text())
    assert len(asked) == 2
    names = [set(options["photos"]) for options in asked]
    assert set().union(*names) == {f"{row:02}.png" for row in range(PHOTOS)}
    assert len(names[0] & names[1]) >= 3
    assert sum("00.png" in options["fixed"] for options in asked) >= 1
    for number, options in enumerate(asked, start=1):
        assert set(options["fixed"]) <= set(options["photos"])
        assert "known_distance" not in options
        assert options["verdict"] is False
        part = tmp_path / f"job-{number}"
        assert ran(part, photos, options) == 0
        for path in (part / "output").rglob("*"):
            name = path.relative_to(part / "output").as_posix()
            if path.is_file() and name.startswith(JOINED_FROM):
                place = tmp_path / "again/parts" / f"part-0{number}" / name
                place.parent.mkdir(parents=True, exist_ok=True)
                shutil.copy(path, place)
    bad = PartReport(name="part-03", photos=9, why_not="its photos are black")
    (tmp_path / "again/parts/part-03").mkdir()
    (tmp_path / "again/parts/part-03" / NOT_REFINED).write_text(bad.model_dump_json())
    assert ran(tmp_path / "again", photos, SMALL, parts="parts") == 0
    report = load(tmp_path / "again/output").report
    assert report.parts is not None
    assert [(one.name, one.why_not) for one in report.parts.parts] == [
        ("part-01", None), ("part-02", None), ("part-03", "its photos are black"),
    ]  # fmt: skip
    (seam,) = report.parts.seams
    assert seam.photos == len(names[0] & names[1])
    assert any("part-03 was not joined" in warning for warning in report.warnings)
    assert len(load(tmp_path / "again/output").names) == PHOTOS


def test_a_set_that_is_small_enough_or_begun_is_not_cut(tmp_path: Path) -> None:
    photos = tmp_path / "photos"
    photos_with_poses(photos)
    few = {**SMALL, "photos": [f"{row:02}.png" for row in range(8)], "known_distance": ""}
    del few["fixed"]
    assert ran(tmp_path / "few", photos, few, split={"above": 25, "most": MOST}) == 0
    assert not (tmp_path / "few" / SPLIT_NAME).exists()


def test_without_a_result_of_any_part_the_whole_says_why(tmp_path: Path) -> None:
    folder, photos = tmp_path / "whole", tmp_path / "photos"
    photos_with_poses(photos)
    for number in (1, 2):
        (folder / f"parts/part-0{number}").mkdir(parents=True)
        bad = PartReport(name=f"part-0{number}", photos=9, why_not="its photos are black")
        (folder / f"parts/part-0{number}" / NOT_REFINED).write_text(bad.model_dump_json())
    with pytest.raises(AssertionError):
        ran(folder, photos, SMALL, parts="parts")
    error = json.loads((folder / "error.json").read_text())
    assert error["code"] == "parts_failed"
    assert "its photos are black" in error["detail"]
