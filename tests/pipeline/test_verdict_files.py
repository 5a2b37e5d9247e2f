"""What a run leaves if refinement did not help; an interrupted verdict is reached when the run resumes."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from biresnerf.data.formats.read_dataset import read_dataset
from biresnerf.data.synthetic.scene import write_synthetic_scene
from biresnerf.errors import Interrupted
from biresnerf.pipeline import refine_poses
from biresnerf.progress import Progress
from biresnerf.report import Report
from tests.refinement.tiny_scene import tiny_run

pytestmark = pytest.mark.slow

# So few steps at so high a rate can only spoil true poses.
OPTIONS = tiny_run(start="given", trial_steps=40, pose_rate=0.02, pose_rate_final=0.02)


@pytest.fixture(scope="module")
def scene(tmp_path_factory) -> Path:
    return write_synthetic_scene(tmp_path_factory.mktemp("scene"), 12, 24, seed=3)


@pytest.fixture(scope="module")
def run(scene, tmp_path_factory) -> tuple[Path, Report, list[Progress]]:
    """A run that was stopped while the verdict was passed, and then gone on with."""
    output = tmp_path_factory.mktemp("results") / "out"
    told: list[Progress] = []
    with pytest.raises(Interrupted):
        refine_poses(scene, output, OPTIONS, told.append, lambda: "comparing" in told[-1].message)
    assert json.loads((output / "report.json").read_text())["state"] == "partial"
    told.clear()
    return output, refine_poses(scene, output, OPTIONS, told.append), told


def test_a_verdict_cut_short_is_passed_when_the_run_goes_on(run):
    _, report, told = run
    assert (report.state, report.resumed) == ("complete", 1)
    assert report.verdict is not None
    assert report.seconds["judging"] > 0
    fractions = [progress.fraction for progress in told]
    assert fractions == sorted(fractions)


def test_the_result_holds_the_inputs_poses_to_the_last_digit(scene, run):
    output, report, _ = run
    assert report.verdict.returned == "input"
    given, result = (json.loads(path.read_text()) for path in (scene, output / "transforms.json"))
    assert result == given
    refined = json.loads((output / "refined/transforms.json").read_text())
    assert all(
        a["transform_matrix"] != b["transform_matrix"]
        for a, b in zip(refined["frames"], given["frames"], strict=True)
    )
    assert (output / "refined/colmap/sparse/0/images.bin").is_file()


def test_the_report_says_how_far_the_refined_poses_had_moved(scene, run):
    output, report, _ = run
    copy = scene.with_name("refined.json")
    copy.write_text((output / "refined/transforms.json").read_text())
    moved = read_dataset(copy).world_from_cam[:, :3, 3] - read_dataset(scene).world_from_cam[:, :3, 3]
    told = [image.moved_units for image in report.images]
    np.testing.assert_allclose(told, np.linalg.norm(moved, axis=1), rtol=1e-6, atol=1e-9)
    scored = [image.trial_psnr_before is not None for image in report.images]
    assert sum(scored) == report.verdict.heldout.psnr.count


def test_without_a_verdict_the_refined_poses_are_returned(scene, tmp_path):
    options = OPTIONS.model_copy(update={"verdict": False})
    assert refine_poses(scene, tmp_path / "out", options).verdict is None
    given, result = (json.loads(p.read_text()) for p in (scene, tmp_path / "out/transforms.json"))
    assert result != given
    assert not (tmp_path / "out/refined").exists()
