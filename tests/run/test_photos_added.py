"""Photos added to those of a finished result, with made photos of which the poses are known."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

import biresnerf
from biresnerf.errors import InputError
from biresnerf.geometry.pose_error import rotation_between_deg
from biresnerf.geometry.similarity import align_by_spread
from biresnerf.refinement.optimise.method_changes import changed
from biresnerf.refinement.optimise.methods import BIRESNERF
from biresnerf.refinement.start import choose_start
from tests.data.scenes import plain_features, textured_arc

pytestmark = pytest.mark.slow

pytest.importorskip("pycolmap", reason="needs pycolmap (pip install 'biresnerf[colmap]')")
OLD, ALL = 8, 10
OPTIONS = {
    "preset": "fast", "device": "cpu", "steps": 80, "max_image_size": 24, "samples_per_step": 1024, "orbit_frames": 0,
    "verdict": False, "method": changed(BIRESNERF, {"start.moving_steps": 80}),
    "pose_resolution_max": 16, "reconstruction_levels": 1, "reconstruction_resolution_max": 128, "table_size_log2": 10,
}  # fmt: skip


@pytest.fixture(scope="module", autouse=True)
def short_trials():
    """Trials of the start are long enough for photos of so few pixels."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(choose_start, "TRIAL_STEPS", 40)
        yield


@pytest.fixture(scope="module")
def truth(tmp_path_factory) -> tuple[Path, np.ndarray]:
    folder = tmp_path_factory.mktemp("all")
    return folder, textured_arc(folder, ALL, 320)


@pytest.fixture(scope="module")
def earlier(truth, tmp_path_factory) -> biresnerf.Result:
    folder = tmp_path_factory.mktemp("old")
    for photo in sorted(truth[0].iterdir())[:OLD]:
        shutil.copy(photo, folder)
    with plain_features():
        return biresnerf.refine(folder, folder.with_name("result"), **OPTIONS)


def test_new_photos_join_the_frame_of_a_result_whose_poses_and_lenses_stay(truth, earlier, tmp_path):
    folder, poses = truth
    with plain_features():
        joined = biresnerf.refine(folder, tmp_path / "more", fixed_from=earlier.folder, **OPTIONS)
    assert joined.names[:OLD] == earlier.names
    np.testing.assert_allclose(joined.poses[:OLD], earlier.poses, atol=1e-9)
    assert set(joined.intrinsics) == set(earlier.intrinsics)
    world_from_result = align_by_spread(earlier.poses, poses[:OLD])
    found = world_from_result.apply_to_poses(joined.poses)
    assert (
        rotation_between_deg(found, poses)[OLD:].max()
        < 3 * rotation_between_deg(found, poses)[:OLD].max() + 0.3
    )


def test_a_result_of_other_photos_is_refused_by_name(earlier, truth, tmp_path):
    for number, photo in enumerate(sorted(truth[0].iterdir())):
        shutil.copy(photo, tmp_path / f"other{number}.png")
    with pytest.raises(InputError) as caught:
        biresnerf.refine(tmp_path, tmp_path / "more", fixed_from=earlier.folder, **OPTIONS)
    assert caught.value.code == "no_common_images"
