"""Whether a run may continue from what an earlier one left: by photos, given poses and options."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from biresnerf.data.model.dataset import Dataset
from biresnerf.data.photos.images import ImageSet
from biresnerf.errors import InputError
from biresnerf.refinement.optimise.methods import BIRESNERF, Method
from biresnerf.refinement.stages.checkpoint import COARSE, SEEDING, TRACKS, RunOrigin, save_checkpoint
from biresnerf.resume import earlier_work, refuse_other_run, reusable_seeding, run_origin
from tests.refinement.stages.test_checkpoint import checkpoint
from tests.refinement.tiny_scene import tiny_recipe, tiny_set

pytestmark = pytest.mark.slow

Scene = tuple[Dataset, ImageSet]


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    return tiny_set(tmp_path_factory.mktemp("scene"))


def origin(folder: Path, scene: Scene, method: Method | None = None, **changed: object) -> RunOrigin:
    return run_origin(folder, *scene, tiny_recipe(method, **changed))


def test_options_that_change_no_result_leave_the_origin_as_it_is(scene: Scene, tmp_path: Path):
    assert origin(tmp_path, scene, BIRESNERF) == origin(tmp_path, scene)
    changed = {"threads": 1, "checkpoint_every_s": 1.0, "orbit_frames": 9}
    assert origin(tmp_path, scene, **changed) == origin(tmp_path, scene)


def test_options_of_stage_2_change_the_origin_but_not_that_of_stage_1(scene: Scene, tmp_path: Path):
    one, other = origin(tmp_path, scene), origin(tmp_path, scene, warmup_steps=3)
    assert one.fingerprint != other.fingerprint
    assert one.stage_1_fingerprint == other.stage_1_fingerprint
    assert one.stage_1_fingerprint != origin(tmp_path, scene, seed=1).stage_1_fingerprint


def test_other_photos_names_or_given_poses_are_another_origin(scene: Scene, tmp_path: Path):
    dataset, images = scene
    pixels = images.pixels.copy()
    pixels[0] ^= 1
    frame = dataset.frames[0]
    moved = replace(frame, world_from_cam=1.0001 * dataset.world_from_cam[0])
    others = [
        (dataset, replace(images, pixels=pixels)),
        (replace(dataset, frames=(replace(frame, name="other"), *dataset.frames[1:])), images),
        (replace(dataset, frames=(moved, *dataset.frames[1:])), images),
        (replace(dataset, frames=(replace(frame, world_from_cam=None), *dataset.frames[1:])), images),
    ]
    found = {origin(tmp_path, other).stage_1_fingerprint for other in (scene, *others)}
    assert len(found) == 1 + len(others)


@pytest.mark.parametrize(
    ("ends_stage_1", "same", "code"),
    [(False, "stage_1_fingerprint", "output_not_resumable"), (True, "fingerprint", "stage_1_not_usable")],
)
def test_each_kind_of_earlier_work_is_held_to_its_own_fingerprint(
    tmp_path: Path, ends_stage_1: bool, same: str, code: str
):
    earlier = checkpoint({}).model_copy(update={"ends_stage_1": ends_stage_1})
    refuse_other_run(tmp_path, earlier, earlier.origin)
    wrong = earlier.origin.model_copy(update={"fingerprint": "x", "stage_1_fingerprint": "x"})
    wrong = wrong.model_copy(update={same: getattr(earlier.origin, same)})
    with pytest.raises(InputError) as caught:
        refuse_other_run(tmp_path, earlier, wrong)
    assert caught.value.code == code


def test_an_unfinished_run_comes_before_the_end_of_stage_1_and_brings_colmaps_answer_back(tmp_path: Path):
    assert earlier_work(tmp_path) is None
    ending = checkpoint({}, step=1).model_copy(update={"ends_stage_1": True})
    save_checkpoint(tmp_path, ending)
    assert earlier_work(tmp_path).optimiser.step_index == 1
    assert (tmp_path / SEEDING).read_text("utf-8") == ending.origin.seeding
    save_checkpoint(tmp_path, checkpoint({}, step=2))
    assert earlier_work(tmp_path).optimiser.step_index == 2
    assert (tmp_path / COARSE).is_file()


def test_only_colmaps_answer_makes_seeding_reusable(tmp_path: Path):
    (tmp_path / TRACKS).parent.mkdir()
    (tmp_path / TRACKS).write_bytes(b"")
    assert reusable_seeding(tmp_path) == {}
    (tmp_path / SEEDING).write_text("{}")
    assert reusable_seeding(tmp_path) == {"seeding": (SEEDING.as_posix(), TRACKS.as_posix())}
