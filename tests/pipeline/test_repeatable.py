"""Same photos, same options, same seed: the same poses to the last bit, whatever the number of threads."""

from __future__ import annotations

import json

import numpy as np
import pytest

from biresnerf.data.synthetic.scene import write_synthetic_scene
from biresnerf.options.refine_options import RefineOptions
from biresnerf.pipeline import refine_poses

pytestmark = pytest.mark.slow

OPTIONS = RefineOptions(
    preset="fast", device="cpu", start="given", steps=60, coarse_steps_min=20, coarse_steps_max=30,
    max_image_size=24, samples_per_step=4096, table_size_log2=12, orbit_frames=0, holdout=0, verdict=False,
)  # fmt: skip


def poses_after(scene, output, **changes) -> np.ndarray:
    refine_poses(scene, output, OPTIONS.model_copy(update=changes))
    document = json.loads((output / "transforms.json").read_text("utf-8"))
    return np.array([frame["transform_matrix"] for frame in document["frames"]])


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return write_synthetic_scene(tmp_path_factory.mktemp("scene"), 8, 24, seed=3)


def test_a_run_repeats_itself_to_the_bit_with_any_number_of_threads(scene, tmp_path):
    first = poses_after(scene, tmp_path / "one", threads=1)
    assert np.array_equal(first, poses_after(scene, tmp_path / "again", threads=1))
    assert np.array_equal(first, poses_after(scene, tmp_path / "two", threads=2))


def test_another_seed_gives_other_poses(scene, tmp_path):
    first = poses_after(scene, tmp_path / "one")
    assert not np.array_equal(first, poses_after(scene, tmp_path / "other", seed=1))
