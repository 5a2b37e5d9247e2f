"""A user's own method: loss, schedule and field from a file elsewhere, and ours with parts left out."""

from __future__ import annotations

import importlib.util
import json
import sys
from dataclasses import fields, replace
from pathlib import Path

import pytest
import torch

from biresnerf import refine
from biresnerf.data.show.history import read_history
from biresnerf.data.synthetic.scene import write_synthetic_scene
from biresnerf.errors import InputError, Interrupted
from biresnerf.pipeline import refine_poses
from biresnerf.progress import Progress
from biresnerf.refinement.lost.lost_cameras import LostCameraRepair
from biresnerf.refinement.optimise.method_changes import changed, differences
from biresnerf.refinement.optimise.methods import BIRESNERF, Method, find_method
from biresnerf.stages import CHECKPOINT
from tests.refinement.tiny_scene import (
    tiny_optimiser,
    tiny_options,
    tiny_recipe,
    tiny_run,
    tiny_set,
)

PARTS = (
    "mobility", "short_where_matched", "near_plane", "weights", "repair", "adjustment", "uncertainty",
)  # fmt: skip
QUICK = {"steps": 20, "coarse_steps_min": 10, "coarse_steps_max": 10, "max_image_size": 16, "verdict": False}
MINE = """
from dataclasses import dataclass, replace

import torch

from biresnerf.field.grid_levels import grid_levels
from biresnerf.field.radiance_field import FieldShape
from biresnerf.field.reference.field import ReferenceField
from biresnerf.refinement.optimise.methods import BIRESNERF
from biresnerf.refinement.optimise.schedule import Schedule


@dataclass(frozen=True)
class Huber:
    delta: float

    def __call__(self, colour, target):
        return torch.nn.functional.huber_loss(colour, target, reduction="none", delta=self.delta)


class Constant(Schedule):
    def pose_rate(self, step, switch):
        return 1.5e-3


class Mine(ReferenceField):
    backend = "mine"


def build(options, frame, device, threads):
    shape = FieldShape(grid_levels(2, 8, 16, 12), grid_levels(3, 16, 32, 10), frame.unbounded)
    return Mine(shape, options.seed, device)


METHOD = replace(BIRESNERF, loss=Huber(0.1), schedule=Constant, build_field=build, merging=None)
"""


@pytest.fixture(scope="module")
def scene(tmp_path_factory) -> Path:
    return write_synthetic_scene(tmp_path_factory.mktemp("scene"), 6, 16, seed=3).parent


@pytest.fixture(scope="module")
def mine(tmp_path_factory) -> Method:
    file = tmp_path_factory.mktemp("elsewhere") / "mine.py"
    file.write_text(MINE)
    spec = importlib.util.spec_from_file_location("mine", file)
    module = importlib.util.module_from_spec(spec)
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(sys.modules, "mine", module)
        spec.loader.exec_module(module)
        yield module.METHOD


def test_a_loss_a_schedule_and_a_field_from_a_file_elsewhere_carry_a_whole_run(scene, mine, tmp_path):
    options = tiny_run(**QUICK).model_dump(exclude_none=True, exclude_defaults=True, exclude={"method"})
    refine(scene, tmp_path / "out", method=mine, **options)
    report = json.loads((tmp_path / "out/report.json").read_text())
    assert report["state"] == "complete"
    assert report["backend"] == "mine"
    assert {line["pose_rate"] for line in read_history(tmp_path / "out/history.jsonl")} == {1.5e-3}
    (said,) = [text for text in report["warnings"] if "method" in text]
    assert "loss=Huber(delta=0.1)" in said
    assert "schedule=mine.Constant" in said


def test_another_loss_moves_the_poses_otherwise_from_the_first_step(tmp_path, mine):
    dataset, images = tiny_set(tmp_path)
    ours, theirs = (
        tiny_optimiser(dataset, images, tiny_options(), method=method)
        for method in (BIRESNERF, replace(BIRESNERF, loss=mine.loss))
    )
    # Half the square within delta, a line of that slope beyond: less than half the square.
    assert 0 < theirs.step().loss < ours.step().loss


def test_what_a_run_did_by_another_method_is_not_resumed(scene, tmp_path):
    asked = tiny_run(**QUICK)
    told: list[Progress] = []
    with pytest.raises(Interrupted):
        refine_poses(
            scene, tmp_path, asked, told.append, lambda: any(p.message.endswith("read") for p in told)
        )
    assert (tmp_path / CHECKPOINT).is_file()
    with pytest.raises(InputError, match="other images"):
        refine_poses(scene, tmp_path, asked, method=replace(BIRESNERF, repair=False))


def test_plain_torch_takes_the_same_first_steps_as_the_kernels(tmp_path):
    dataset, images = tiny_set(tmp_path)
    found = []
    for field in ("kernels", "reference"):
        optimiser = tiny_optimiser(dataset, images, tiny_options(field=field))
        losses = [optimiser.step().loss for _ in range(3)]
        found.append((optimiser.field.backend, losses, optimiser.poses.poses()))
    (fast, fast_losses, fast_poses), (plain, plain_losses, plain_poses) = found
    assert (fast, plain) == ("cpu", "reference")
    assert fast_losses == pytest.approx(plain_losses, rel=1e-3)
    torch.testing.assert_close(fast_poses, plain_poses, atol=2e-4, rtol=0)


def test_a_field_of_the_method_is_changed_by_its_name_and_a_value_within_one_too():
    assert not changed(BIRESNERF, {"repair": False}).repair
    assert changed(BIRESNERF, {"merging": None}).merging is None
    merging = changed(BIRESNERF, {"merging.light": 0.06, "merging.most": 16}).merging
    assert (merging.light, merging.most) == (0.06, 16)
    assert changed(BIRESNERF, {}) == BIRESNERF


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"repairs": False}, "no field of the method"),
        ({"repair": "perhaps"}, "bool"),
        ({"loss": "huber"}, "callable"),
        ({"repair.most": 3}, "no field of the method"),
    ],
    ids=["unknown", "no bool", "no function", "nothing within"],
)
def test_a_wrong_change_of_the_method_is_refused_and_named(change, said):
    with pytest.raises(InputError, match=said) as error:
        changed(BIRESNERF, change)
    assert error.value.fault.where == f"method.{next(iter(change))}"


def test_each_part_of_ours_can_be_left_out_alone_and_published_methods_have_none():
    switches = {field.name for field in fields(Method) if getattr(BIRESNERF, field.name) is True}
    assert switches == {*PARTS, "two_stages", "robust_frame", "pruned"}
    for part in PARTS:
        assert differences(tiny_recipe(changed(BIRESNERF, {part: False}))) == {part: "False"}
        assert not getattr(find_method("biresnerf-paper"), part)


def test_without_a_near_plane_open_scenes_are_sampled_from_the_schedules_own_distance(tmp_path):
    dataset, images = tiny_set(tmp_path)
    images = replace(images, background=None, alpha=None)
    near = {}
    for on in (True, False):
        optimiser = tiny_optimiser(dataset, images, tiny_options(), method=replace(BIRESNERF, near_plane=on))
        optimiser.frame = replace(optimiser.frame, near=0.45)
        near[on] = optimiser.marching(0.01).near / optimiser.frame.distance
    assert near[True] == pytest.approx(0.45)
    assert near[False] == pytest.approx(optimiser.schedule.near(0, None))


def test_without_weights_lost_cameras_count_in_the_loss_as_all_do(tmp_path):
    dataset, images = tiny_set(tmp_path)
    losses = {}
    for on in (True, False):
        optimiser = tiny_optimiser(dataset, images, tiny_options(), method=replace(BIRESNERF, weights=on))
        optimiser.camera_errors.weights = torch.full((len(dataset),), 0.5)
        losses[on] = optimiser.step().loss
    assert losses[True] == pytest.approx(losses[False] / 2, rel=1e-5)


def test_without_repair_no_fixed_point_is_due(tmp_path):
    dataset, images = tiny_set(tmp_path)
    due = {}
    for on in (True, False):
        optimiser = tiny_optimiser(dataset, images, tiny_options(), method=replace(BIRESNERF, repair=on))
        optimiser.step_index = 10
        due[on] = LostCameraRepair(optimiser).due()
    assert due == {True: True, False: False}


@pytest.mark.slow
def test_without_uncertainty_and_adjustment_the_report_tells_neither(scene, tmp_path):
    method = changed(BIRESNERF, {"uncertainty": False, "adjustment": False})
    report = refine_poses(scene, tmp_path / "out", tiny_run(**QUICK), method=method)
    assert report.candidates == ()
    assert all(image.uncertainty is None for image in report.images)
    assert any("adjustment=False, uncertainty=False" in text for text in report.warnings)
