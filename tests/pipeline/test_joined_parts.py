"""Parts of a set that were refined by themselves are joined by a run of the whole set, which does not ask COLMAP."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from biresnerf import load, refine
from biresnerf.data.seeding import colmap_process
from biresnerf.data.synthetic.scene import synthetic_focal
from biresnerf.errors import InputError
from biresnerf.geometry.perturb import perturb_poses
from biresnerf.geometry.pose_error import camera_errors
from biresnerf.geometry.similarity import align_robust
from tests.data.scenes import plain_features, textured_arc

pytest.importorskip("pycolmap", reason="pycolmap is not installed (extra: colmap)")
pytestmark = pytest.mark.slow

QUICK = {
    "preset": "fast", "device": "cpu", "steps": 20, "max_image_size": 24, "samples_per_step": 1024, "orbit_frames": 0,
    "holdout": 0, "pose_resolution_max": 16, "reconstruction_levels": 1, "reconstruction_resolution_max": 128,
    "table_size_log2": 10, "start": "colmap",
}  # fmt: skip
PHOTOS, SIZE = 8, 320


@pytest.fixture(scope="module")
def truth(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, np.ndarray]:
    """Photos with poses that are somewhat wrong, and their true world_from_cam."""
    folder = tmp_path_factory.mktemp("arc") / "photos"
    poses = textured_arc(folder, PHOTOS, SIZE)
    given = perturb_poses(poses, 0.02, seed=1)
    frames = [
        {"file_path": f"{row:02}.png", "transform_matrix": (pose @ np.diag([1.0, -1, -1, 1])).tolist()}
        for row, pose in enumerate(given)
    ]
    focal = synthetic_focal(SIZE)
    lens = {"w": SIZE, "h": SIZE, "fl_x": focal, "fl_y": focal, "cx": SIZE / 2, "cy": SIZE / 2}
    (folder / "transforms.json").write_text(json.dumps({**lens, "frames": frames}), "utf-8")
    return folder, poses


@pytest.fixture(scope="module")
def results(truth: tuple[Path, np.ndarray], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the results of two parts that share four photos, as far as they go in the given frame."""
    folder = tmp_path_factory.mktemp("results")
    with plain_features():
        for name, rows in (("part-1", range(6)), ("part-2", range(2, PHOTOS))):
            refine(truth[0], folder / name, photos=[f"{row:02}.png" for row in rows], **QUICK)
    return folder


def mean_error(poses: np.ndarray, truth: np.ndarray) -> float:
    aligned = align_robust(poses, truth, with_rotations=True).apply_to_poses(poses)
    return float(camera_errors(aligned, truth).rotation_deg.mean())


def test_joined_parts_are_one_rig_that_all_matches_speak_for(
    truth: tuple[Path, np.ndarray], results: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert [len(load(results / name).names) for name in ("part-1", "part-2")] == [6, 6]
    monkeypatch.setattr(colmap_process, "CHILD", tmp_path / "no_such_program.py")
    whole = refine(truth[0], tmp_path / "out", parts=[results], **QUICK)
    assert len(whole.names) == PHOTOS
    report = whole.report
    assert report.parts is not None
    assert [(one.name, one.photos, one.why_not) for one in report.parts.parts] == [
        ("part-1", 6, None), ("part-2", 6, None),
    ]  # fmt: skip
    (seam,) = report.parts.seams
    assert seam.photos == 4
    assert seam.rotation_deg < 1
    assert report.verdict is not None
    assert report.verdict.epipolar is not None
    assert report.verdict.epipolar.matches > 100
    before, after = (mean_error(poses, truth[1]) for poses in (whole.poses_before, whole.poses))
    assert after < 0.5 * before


def test_what_is_no_finished_result_of_the_set_is_refused_before_anything_is_computed(
    truth: tuple[Path, np.ndarray], results: Path, tmp_path: Path
) -> None:
    (tmp_path / "parts" / "part-3").mkdir(parents=True)
    with pytest.raises(InputError) as caught:
        refine(truth[0], tmp_path / "out", parts=[tmp_path / "parts"], **QUICK)
    assert (caught.value.code, caught.value.where) == ("result_missing", str(tmp_path / "parts" / "part-3"))
    shutil.copytree(truth[0], tmp_path / "other")
    renamed = (truth[0] / "transforms.json").read_text("utf-8").replace(f"{PHOTOS - 1:02}.png", "other.png")
    (tmp_path / "other" / "transforms.json").write_text(renamed, "utf-8")
    (tmp_path / "other" / f"{PHOTOS - 1:02}.png").rename(tmp_path / "other" / "other.png")
    with pytest.raises(InputError) as caught:
        refine(tmp_path / "other", tmp_path / "out", parts=[results / "part-2"], **QUICK | {"start": "auto"})
    assert caught.value.code == "part_of_other_set"
    assert caught.value.hint
