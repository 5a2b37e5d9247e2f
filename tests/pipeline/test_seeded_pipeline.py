"""A folder of images without poses: COLMAP is asked once, however often the run is stopped."""

from __future__ import annotations

import importlib.util
import shutil
from pathlib import Path

import pytest
from PIL import Image

from biresnerf.data.seeding import colmap_process
from biresnerf.errors import InputError, Interrupted
from biresnerf.options.refine_options import RefineOptions
from biresnerf.pipeline import refine_poses
from biresnerf.progress import Progress
from biresnerf.report import Report
from biresnerf.stages import CHECKPOINT
from tests.data.scenes import textured_arc

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(
        importlib.util.find_spec("pycolmap") is None, reason="pycolmap is not installed (extra: colmap)"
    ),
]
QUICK = RefineOptions(
    preset="fast", device="cpu", steps=20, max_image_size=24, samples_per_step=1024, orbit_frames=0, holdout=0,
    pose_resolution_max=16, reconstruction_levels=1, reconstruction_resolution_max=128, table_size_log2=10,
)  # fmt: skip


@pytest.fixture(scope="module")
def photos(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("photos")
    textured_arc(folder, 6, 320)
    return folder


@pytest.fixture(scope="module")
def stopped(photos, tmp_path_factory) -> tuple[Path, list[Progress]]:
    """The folder of a run that was stopped after COLMAP and before the first step."""
    output = tmp_path_factory.mktemp("stopped") / "out"
    told: list[Progress] = []
    with pytest.raises(Interrupted):
        refine_poses(
            photos, output, QUICK, told.append, lambda: any(p.message.endswith("read") for p in told)
        )
    return output, told


@pytest.fixture
def without_colmap(monkeypatch, tmp_path) -> None:
    """Whoever asks COLMAP from now on fails."""
    monkeypatch.setattr(colmap_process, "CHILD", tmp_path / "no_such_program.py")


def assert_matches_were_heard(report: Report) -> None:
    """The verdict hears feature matches of points that the poses to start from were not made from."""
    assert report.verdict is not None
    epipolar = report.verdict.epipolar
    assert epipolar is not None
    assert epipolar.matches > 100
    assert epipolar.independent
    assert epipolar.error_px.before < 2


def test_seeding_is_a_stage_of_its_own(stopped):
    _, told = stopped
    stages = list(dict.fromkeys(progress.stage for progress in told))
    assert stages == ["preparing", "seeding", "coarse"]
    fractions = [progress.fraction for progress in told]
    assert fractions == sorted(fractions)


def test_a_resumed_run_goes_on_from_the_poses_colmap_gave_the_first_time(
    photos, stopped, tmp_path, without_colmap
):
    output = shutil.copytree(stopped[0], tmp_path / "out")
    told: list[Progress] = []
    report = refine_poses(photos, output, QUICK, told.append)
    assert report.resumed == 1
    assert {image.pose_source for image in report.images} == {"colmap"}
    assert [image.name for image in report.images] == [f"{i:02}.png" for i in range(6)]
    assert not (output / "checkpoint").exists()
    assert_matches_were_heard(report)


def test_the_checkpoint_alone_is_enough(photos, stopped, tmp_path, without_colmap):
    (tmp_path / "out" / CHECKPOINT).parent.mkdir(parents=True)
    shutil.copy(stopped[0] / CHECKPOINT, tmp_path / "out" / CHECKPOINT)
    report = refine_poses(photos, tmp_path / "out", QUICK)
    assert report.resumed == 1
    assert_matches_were_heard(report)


def test_a_run_killed_before_its_first_checkpoint_does_not_ask_again(
    photos, stopped, tmp_path, without_colmap
):
    (tmp_path / "out").mkdir()
    shutil.copytree(stopped[0] / "checkpoint", tmp_path / "out" / "checkpoint")
    (tmp_path / "out" / CHECKPOINT).unlink()
    report = refine_poses(photos, tmp_path / "out", QUICK)
    assert report.resumed == 0
    assert_matches_were_heard(report)


def test_a_changed_photo_is_not_taken_for_the_same_run(photos, stopped, tmp_path):
    changed = shutil.copytree(photos, tmp_path / "photos")
    with Image.open(changed / "00.png") as picture:
        Image.eval(picture, lambda v: min(255, v + 3)).save(changed / "00.png")
    output = shutil.copytree(stopped[0], tmp_path / "out")
    with pytest.raises(InputError) as caught:
        refine_poses(changed, output, QUICK)
    assert caught.value.code == "output_not_resumable"
    assert refine_poses(photos, output, QUICK).resumed == 1  # and the folder is as good as before


def test_a_stop_while_colmap_runs_leaves_no_folder(photos, tmp_path):
    told: list[Progress] = []
    with pytest.raises(Interrupted):
        refine_poses(photos, tmp_path / "out", QUICK, told.append, lambda: told[-1].stage == "seeding")
    assert not (tmp_path / "out").exists()
