"""A run warns of poses that do not follow their format's conventions, and reads them as the user says."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from biresnerf.data.formats.read_dataset import read_poses
from biresnerf.geometry.pose_error import pose_error
from biresnerf.pipeline import refine_poses
from biresnerf.report import Report
from tests.data.given_poses.views import around, written
from tests.refinement.tiny_scene import tiny_run

pytestmark = pytest.mark.slow
ASKED = "If so, set given_poses=inverted,opencv_axes"


def run(folder: Path, output: Path, **options: object) -> tuple[Report, np.ndarray]:
    report = refine_poses(folder, output, tiny_run(start="given", verdict=False, **options))
    return report, np.stack(list(read_poses(output / "transforms.json").values()))


def test_inverted_matrices_are_warned_of_and_converted_on_request_only(tmp_path: Path) -> None:
    poses = around()
    written(tmp_path / "set", np.linalg.inv(poses) @ np.diag([1.0, -1, -1, 1]), poses)
    report, _ = run(tmp_path / "set", tmp_path / "as_they_are")
    assert [text for text in report.warnings if ASKED in text]
    report, found = run(tmp_path / "set", tmp_path / "converted", given_poses=["inverted", "opencv_axes"])
    assert not [text for text in report.warnings if "given_poses" in text]
    assert pose_error(found, poses).own_frame.rotation_deg.max < 10
