"""A run that takes over the work of another one's stages."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from biresnerf.data.formats.simple.poses_json import matrix_of, read_poses_json
from biresnerf.data.synthetic.scene import write_synthetic_scene
from biresnerf.errors import InputError
from biresnerf.options.refine_options import RefineOptions
from biresnerf.pipeline import refine_poses
from biresnerf.progress import Progress
from biresnerf.write.output_folder import OutputFolder

pytestmark = pytest.mark.slow

OPTIONS = RefineOptions(
    preset="fast", device="cpu", start="given", steps=60, coarse_steps_min=20, coarse_steps_max=30, check_every=10,
    max_image_size=24, samples_per_step=2048, pose_resolution_max=24, reconstruction_levels=2, table_size_log2=10,
    reconstruction_resolution_max=256, orbit_frames=0, verdict=False, threads=1,
)  # fmt: skip


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_synthetic_scene(tmp_path_factory.mktemp("scene"), 6, 24, seed=3)


@pytest.fixture(scope="module")
def coarse(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What a finished run kept of its stage 1, as it said itself."""
    output, told = tmp_path_factory.mktemp("first") / "out", list[Progress]()
    refine_poses(scene, OutputFolder(output, keep_reusable=True), OPTIONS, told.append)
    (said,) = [progress.reusable for progress in told if progress.reusable]
    assert set(said) == {"coarse"}, "COLMAP was not asked"
    (name,) = said["coarse"]
    return output / name


def forked(scene: Path, coarse: Path, output: Path, options: RefineOptions) -> np.ndarray:
    (output / "checkpoint").mkdir(parents=True)
    shutil.copy(coarse, output / "checkpoint" / coarse.name)
    told: list[Progress] = []
    report = refine_poses(scene, output, options, told.append)
    assert report.switch_step == json.loads((coarse.parents[1] / "report.json").read_text())["switch_step"]
    assert "coarse" not in {progress.stage for progress in told}
    assert not (output / "checkpoint").exists()
    return poses_of(output)


def poses_of(output: Path) -> np.ndarray:
    return np.stack(
        [matrix_of(image.world_from_cam) for image in read_poses_json(output / "poses.json").images]
    )


def test_a_run_that_shares_stage_1_ends_as_one_that_did_it_all(scene: Path, coarse: Path, tmp_path: Path):
    changed = OPTIONS.model_copy(update={"warmup_steps": 5})
    refine_poses(scene, tmp_path / "whole", changed)
    np.testing.assert_array_equal(
        forked(scene, coarse, tmp_path / "forked", changed), poses_of(tmp_path / "whole")
    )


def test_stage_2_may_be_of_another_size(scene: Path, coarse: Path, tmp_path: Path):
    changed = OPTIONS.model_copy(update={"reconstruction_levels": 4, "table_size_log2": 11})
    assert np.isfinite(forked(scene, coarse, tmp_path / "out", changed)).all()


@pytest.mark.parametrize("change", [{"seed": 1}, {"steps": 80}, {"max_image_size": 20}])
def test_stage_1_of_other_options_is_refused(
    scene: Path, coarse: Path, tmp_path: Path, change: dict[str, int]
):
    with pytest.raises(InputError) as caught:
        forked(scene, coarse, tmp_path / "out", OPTIONS.model_copy(update=change))
    assert caught.value.code == "stage_1_not_usable"
