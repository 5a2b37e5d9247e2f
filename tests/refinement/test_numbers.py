"""The numbers that decide what a run does: all are explained and used, and a run follows the method's values."""

from __future__ import annotations

import ast
import inspect
import math
from collections.abc import Iterator
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from typing import Any

import pytest
import torch

from biresnerf.commands.settings_option import parse_settings
from biresnerf.errors import InputError
from biresnerf.field.radiance_field import Merging
from biresnerf.geometry.perturb import perturb_poses
from biresnerf.judging.compare import Rule
from biresnerf.refinement.finish.gather_evidence import without_patches
from biresnerf.refinement.lost.lost_cameras import LostCameraRepair
from biresnerf.refinement.optimise.method_changes import changed, differences
from biresnerf.refinement.optimise.methods import BIRESNERF
from biresnerf.refinement.views.evaluation import fit_held_out_poses
from biresnerf.studies.scenes import with_poses
from tests.refinement.tiny_scene import (
    TinyRun,
    given_scene,
    tiny_optimiser,
    tiny_options,
    tiny_recipe,
    tiny_set,
    true_matches,
)

ROOT = Path(__file__).resolve().parents[2]
DATA = [ROOT / "biresnerf/data" / name for name in ("scene_kind.py", "workload.py")]
READERS = [*DATA, *(ROOT / "biresnerf/refinement").rglob("*.py")]


def rooms(holder: Any = BIRESNERF) -> Iterator[type]:
    """Classes of numbers that the method holds, at any depth."""
    for field in fields(holder):
        value = getattr(holder, field.name)
        if is_dataclass(value) and not isinstance(value, type | Merging | Rule):
            yield type(value)
            yield from rooms(value)


ROOMS = sorted(set(rooms()), key=lambda room: room.__name__)


def unexplained(room: type) -> list[str]:
    """Fields without a comment beside or right above them."""
    source = inspect.getsource(room)
    lines = source.splitlines()
    declared = [node for node in ast.parse(source).body[0].body if isinstance(node, ast.AnnAssign)]
    return [
        node.target.id
        for node in declared
        if not any("# " in line for line in lines[node.lineno - 1 : node.end_lineno])
        and not lines[node.lineno - 2].strip().startswith("# ")
    ]


@pytest.mark.parametrize("room", ROOMS, ids=lambda room: room.__name__)
def test_every_number_says_its_unit_and_reason(room):
    assert room.__dataclass_params__.frozen
    assert unexplained(room) == []


def test_every_number_is_read_where_runs_are_made():
    read = {
        node.attr
        for path in READERS
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Load)
    }
    declared = {field.name for room in ROOMS for field in fields(room)}
    assert len(declared) > 30
    assert declared - read == set()


def test_a_run_names_the_numbers_that_it_changed_and_no_others():
    method = changed(BIRESNERF, {"course.freeze_share": 0.5, "kinds.open.facing_forward.least": 0.2})
    assert differences(tiny_recipe(method)) == {
        "course.freeze_share": "0.5",
        "kinds.open.facing_forward.least": "0.2",
    }


def test_a_comparison_changes_numbers_as_it_sets_options():
    asked = parse_settings(("kinds.open.repairs=[0.25,1]", "lost.rounds=[[2,24,3]]", "finish.slack=0"))
    method = changed(BIRESNERF, asked)
    assert method.kinds.open.repairs == (0.25, 1.0)
    assert method.lost.rounds == ((2, 24, 3),)
    assert method.finish.slack == 0
    with pytest.raises(InputError, match="number"):
        changed(BIRESNERF, parse_settings(("lost.distinct_deg=far",)))


@pytest.fixture(scope="module")
def tiny(tmp_path_factory):
    return tiny_set(tmp_path_factory.mktemp("tiny"))


def optimiser(tiny, changes, *, unbounded=False):
    """The tiny scene's at its first step, by our method with other numbers; open where it has no background."""
    dataset, images = tiny
    if unbounded:
        images = replace(images, background=None, alpha=None)
    return tiny_optimiser(dataset, images, tiny_options(), [3], changed(BIRESNERF, changes))


def test_steps_follow_the_methods_schedule(tiny):
    ours, early = optimiser(tiny, {}), optimiser(tiny, {"course.freeze_share": 0.25})
    assert early.schedule.pose_rate(9, None) == ours.schedule.pose_rate(9, None) > 0
    assert early.schedule.pose_rate(10, None) == 0 < ours.schedule.pose_rate(10, None)


def test_only_open_scenes_have_the_numbers_of_open_scenes(tiny):
    change = {"kinds.open.samples": 6}
    for unbounded, times in ((True, 3), (False, 1)):
        before, after = (optimiser(tiny, each, unbounded=unbounded) for each in ({}, change))
        assert after.schedule.samples(0, None) == times * before.schedule.samples(0, None)


def test_doubted_cameras_weigh_as_much_as_the_method_says(tiny):
    found = optimiser(tiny, {"errors.doubted_weight": 0.3}).camera_errors
    found.doubt((torch.arange(7) == 2).numpy())
    assert found.weights.tolist() == pytest.approx([1, 1, 0.3, 1, 1, 1, 1])


def test_the_switch_waits_for_as_many_checks_as_the_method_says(tiny, tmp_path):
    steps = []
    for confirmations in (0, 10**6):
        run = TinyRun(optimiser(tiny, {"switch.confirmations": confirmations}), given_scene(*tiny), tmp_path)
        run.stages.run_stage_1()
        steps.append(run.optimiser.switch)
    assert steps == [10, 20]  # the least and the greatest length of stage 1


@pytest.mark.parametrize(
    ("changes", "unbounded", "first"),
    [
        ({}, False, 5),
        ({}, True, 10),
        ({"kinds.bounded.repairs": (0.8,)}, False, 8),
        ({"kinds.open.repairs": (0.3,)}, True, 3),
    ],
)
def test_lost_cameras_are_looked_for_when_the_method_says(tiny, changes, unbounded, first):
    run = optimiser(tiny, changes, unbounded=unbounded)
    repair = LostCameraRepair(run)
    due = []
    for run.step_index in range(12):
        due.append(repair.due())
    assert due.index(True) == first  # the least length of stage 1 is 10


def test_a_repair_costs_no_more_than_the_method_says(tiny):
    spent = []
    for share in (0.0, 0.5):
        run = optimiser(
            tiny, {"lost.event_share": share, "lost.run_share": share, "lost.rounds": ((1, 8, 2),)}
        )
        run.camera_errors.doubt((torch.arange(7) == 2).numpy())
        repair = LostCameraRepair(run)
        repair.run()
        spent.append(repair.state().spent)
    assert spent[1] > 2 * spent[0]  # the first is of the scores of cameras that are not lost


def test_held_out_poses_are_fitted_for_as_many_steps_as_the_method_says(tiny):
    moved = []
    for steps in (0, 3):
        run = optimiser(tiny, {"views.fit_steps": steps})
        before = run.poses.poses()
        fit_held_out_poses(run, [3])
        moved.append(torch.nonzero((run.poses.poses() != before).any((1, 2))).ravel().tolist())
    assert moved == [[], [3]]


def test_the_verdict_takes_for_unchanged_what_the_method_cannot_measure(tiny, tmp_path):
    dataset, images = tiny
    given = given_scene(dataset, images, given=perturb_poses(dataset.world_from_cam, 0.05, seed=1))
    noisy = replace(given, dataset=with_poses(dataset, given.start.world_from_cam))
    verdict = TinyRun(optimiser(tiny, {"verdict.measurable_px": 50.0}), noisy, tmp_path).judged()
    assert verdict.verdict.moved_px > 2 * BIRESNERF.verdict.measurable_px
    assert verdict.verdict.verdict == "unchanged"
    assert "50 px" in verdict.verdict.why[0]


def test_cameras_are_adjusted_to_as_many_tracks_as_the_method_says(tiny):
    scene = replace(given_scene(*tiny), tracks=true_matches(tiny[0]))
    amounts = []
    for most, cameras in ((200, 7), (200, 4), (10**6, 7)):
        changed = {"evidence.most_observations": most, "evidence.up_to_cameras": cameras}
        run = optimiser(tiny, changed)
        placed = torch.ones(7, dtype=torch.bool).numpy()
        fitted = without_patches(scene, run.joint, "auto", placed, run.method.evidence).fitted
        assert fitted.numbers is run.method.evidence
        amounts.append(len(fitted.tracks.point))
    assert amounts[0] <= 200 < amounts[1] <= 350 < amounts[2]


def test_photos_are_asked_about_motions_that_the_method_takes_for_seen(tiny, tmp_path):
    dataset, images = tiny
    matched = perturb_poses(dataset.world_from_cam, 0.02, seed=1)
    scene = replace(given_scene(dataset, images), tracks=true_matches(dataset))
    scene = replace(scene, start=replace(scene.start, matched_poses=matched))
    asked = []
    for unseen_px in (0.0, 100.0):
        run = TinyRun(optimiser(tiny, {"finish.unseen_px": unseen_px}), scene, tmp_path)
        asked.append(run.ahead.checks())
    assert asked == [True, False]


def test_the_box_is_as_much_wider_than_what_photos_show_as_the_method_says(tiny):
    frames = [optimiser(tiny, {"scene.content_margin": margin}).frame for margin in (0.4, 0.6)]
    scales = [frame.unit_from_world.scale for frame in frames]
    assert scales[0] / scales[1] == pytest.approx(1.5)


def test_exposures_stay_within_the_methods_factor(tiny):
    dataset, images = tiny
    options = tiny_options(exposure="on")
    run = tiny_optimiser(
        dataset, images, options, [3], changed(BIRESNERF, {"parameters.exposure_most": 1.001})
    )
    for _ in range(4):
        run.step()
    logarithms = run.exposure.log_gain.detach().abs().max()
    assert float(logarithms) == pytest.approx(math.log(1.001), rel=1e-4)
