"""Which earlier work a run may resume: its own, and stage 1 of a run that differs only later."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from biresnerf.errors import InputError
from biresnerf.resume import refuse_other_run, run_origin
from biresnerf.studies.scenes import with_poses
from tests.refinement.stages.test_checkpoint import checkpoint
from tests.refinement.tiny_scene import tiny_recipe, tiny_set


@pytest.fixture(scope="module")
def begun(tmp_path_factory):
    """Photos, a recipe, and what a run of them is told by."""
    folder = tmp_path_factory.mktemp("set")
    dataset, images = tiny_set(folder, views=5, size=16)
    return folder, dataset, images, tiny_recipe()


def refusal(begun, dataset, images, recipe, *, of_stage_1: bool = False) -> str:
    """The code with which another run may not go on from the one begun; empty where it may."""
    folder, *own = begun
    origin = run_origin(folder, *own)
    earlier = checkpoint({}).model_copy(update={"origin": origin, "ends_stage_1": of_stage_1})
    try:
        refuse_other_run(folder, earlier, run_origin(folder, dataset, images, recipe))
    except InputError as error:
        return error.code
    return ""


def test_a_run_goes_on_from_its_own_work_with_options_that_change_no_result(begun):
    _, dataset, images, recipe = begun
    assert refusal(begun, dataset, images, recipe) == ""
    elsewhere = tiny_recipe(threads=1, checkpoint_every_s=7.0, exports=("kitti",), orbit_frames=3)
    assert refusal(begun, dataset, images, elsewhere) == ""


@pytest.mark.parametrize("of_stage_1", [False, True])
def test_work_on_other_photos_poses_or_options_is_refused(begun, of_stage_1):
    _, dataset, images, recipe = begun
    poses, pixels = dataset.world_from_cam.copy(), images.pixels.copy()
    poses[2, 0, 3] += 1e-9
    pixels[-1, 0] ^= 1
    masked = replace(images, counts=np.ones(len(pixels), dtype=bool))
    renamed = replace(dataset, frames=(*dataset.frames[:-1], replace(dataset.frames[-1], name="other.png")))
    code = "stage_1_not_usable" if of_stage_1 else "output_not_resumable"
    for other in (
        (with_poses(dataset, poses), images, recipe),
        (renamed, images, recipe),
        (dataset, replace(images, pixels=pixels), recipe),
        (dataset, masked, recipe),
        (dataset, images, tiny_recipe(seed=5)),
        (dataset, images, tiny_recipe(pose_rate=2e-4)),
    ):
        assert refusal(begun, *other, of_stage_1=of_stage_1) == code


def test_the_first_stage_serves_runs_that_differ_only_later_and_a_whole_run_does_not(begun):
    _, dataset, images, _ = begun
    later = tiny_recipe(warmup_steps=3, trial_steps=11)
    assert refusal(begun, dataset, images, later, of_stage_1=True) == ""
    assert refusal(begun, dataset, images, later) == "output_not_resumable"
