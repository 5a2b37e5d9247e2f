"""`biresnerf inspect` and `biresnerf bench`, on real files."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner

from biresnerf.commands.machine.bench import bench_command
from biresnerf.commands.poses.inspect import in_minutes, inspect_command
from biresnerf.commands.poses.make_scene import make_scene_command
from biresnerf.data.seeding.match_poses import can_match
from biresnerf.errors import InputError
from tests.data.formats.simple import trajectories
from tests.data.given_poses.views import around, written
from tests.data.scenes import write_image


def inspected(*arguments: object) -> dict[str, Any]:
    result = CliRunner().invoke(inspect_command, [*map(str, arguments), "--json"])
    assert result.exit_code == 0, (result.output, result.exception)
    return json.loads(result.stdout)


def test_photos_of_something_that_turned_are_offered_the_turntable_and_others_are_not(tmp_path: Path) -> None:
    arguments = ["--kind", "turntable", "--views", "40", "--size", "32"]
    assert CliRunner().invoke(make_scene_command, [str(tmp_path / "table"), *arguments]).exit_code == 0
    assert any("start=turntable" in text for text in inspected(tmp_path / "table")["warnings"])
    found = inspected(tmp_path / "table", "--set", "start=turntable")
    assert "ring" in found["plan"]["start"]
    for index in range(20):
        write_image(tmp_path / f"same/{index}.png")
    assert not any("turntable" in text for text in inspected(tmp_path / "same")["warnings"])


def test_a_model_with_masks_and_unregistered_images_is_told_as_it_is(tmp_path: Path) -> None:
    trajectories.colmap_set(tmp_path, registered=3)
    write_image(tmp_path / "masks/a.png.png", mode="L")
    found = inspected(tmp_path, "--preset", "fast", "--set", "max_image_size=16", "--set", "steps=100")
    assert (found["format"], found["images"], found["with_pose"], found["masks"]) == ("colmap", 4, 3, 1)
    assert [Path(name).name for name in found["without_pose"]] == ["d.png"]
    lens = found["cameras"][0]
    assert (lens["model"], lens["width"], lens["height"], lens["images"]) == ("PINHOLE", 20, 16, 4)
    plan = found["plan"]
    assert (plan["preset"], plan["steps"], plan["working_size"]) == ("fast", 100, [16, 13])
    assert plan["photo_bytes"] == 4 * 3 * 16 * 13
    text = CliRunner().invoke(inspect_command, [str(tmp_path)]).output
    assert f"3 with a pose, 1 without: {found['without_pose'][0]}\n" in text


def test_photos_without_a_pose_are_said_in_one_line_however_many(tmp_path: Path) -> None:
    trajectories.colmap_set(tmp_path, registered=3)
    for index in range(20):
        write_image(tmp_path / f"images/more{index:02}.png", seed=100 + index)
    without = inspected(tmp_path)["without_pose"]
    assert len(without) == 21
    text = CliRunner().invoke(inspect_command, [str(tmp_path)]).output
    (line,) = [line for line in text.splitlines() if " without: " in line]
    assert line == f"  3 with a pose, 21 without: {', '.join(without[:3])} and 18 more"
    assert sum(name in text for name in without) <= 6, "and a warning that names a few"


def test_the_size_to_learn_at_is_told_from_the_photos_own(tmp_path: Path) -> None:
    trajectories.colmap_set(tmp_path)
    for own, asked in ((False, 16), (True, 4096)):
        arguments = [str(tmp_path), "--set", f"max_image_size={asked}"]
        said = CliRunner().invoke(inspect_command, arguments).output
        assert "4 images of 20 x 16 px" in said
        assert ("copies shrunk to 16 x 13 px" in said) is not own
        assert ("photos and results keep the full size" in said) is not own
        assert ("learn from the photos at their own size" in said) is own


@pytest.mark.parametrize(
    ("start", "said"),
    [
        ("auto", "COLMAP finds" if can_match() else "not installed"),
        ("none", "4 poses are guessed"),
        ("given", "refused: start=given, and 4 images"),
    ],
)
def test_photos_alone_are_told_where_their_poses_would_come_from(
    tmp_path: Path, start: str, said: str
) -> None:
    trajectories.write_images(tmp_path)
    found = inspected(tmp_path, "--set", f"start={start}")
    assert (found["format"], found["with_pose"]) == ("images", 0)
    assert said in found["plan"]["start"]


def test_poses_with_other_axes_are_asked_about_until_they_are_said_to_be_so(tmp_path: Path) -> None:
    written(tmp_path / "right", around())
    assert inspected(tmp_path / "right")["pose_question"] is None
    written(tmp_path / "wrong", around() @ np.diag([1.0, -1, -1, 1]), around())
    question = inspected(tmp_path / "wrong")["pose_question"]
    assert question["given_poses"] == ["opencv_axes"]
    assert "have OpenCV's axes" in question["question"]
    said = CliRunner().invoke(inspect_command, [str(tmp_path / "wrong")]).output
    assert question["question"] in said
    assert "If so: --set given_poses=opencv_axes" in said
    assert inspected(tmp_path / "wrong", "--set", "given_poses=opencv_axes")["pose_question"] is None


def test_damage_is_found_where_pixels_are_asked_for(tmp_path: Path) -> None:
    trajectories.colmap_set(tmp_path)
    photo = tmp_path / "images/b.png"
    photo.write_bytes(photo.read_bytes()[:-30])
    assert inspected(tmp_path)["pixels_checked"] is False
    result = CliRunner().invoke(inspect_command, [str(tmp_path), "--pixels"])
    assert isinstance(result.exception, InputError)
    assert "b.png" in result.exception.where


def test_a_fixed_image_that_is_not_there_is_warned_of(tmp_path: Path) -> None:
    trajectories.colmap_set(tmp_path)
    assert inspected(tmp_path, "--set", "fixed=a.png,z.png")["warnings"] == ["fixed names no image: z.png"]


def test_bench_measures_both_stages() -> None:
    arguments = ["--steps", "4", "--views", "6", "--size", "24", "--device", "cpu", "--json"]
    result = CliRunner().invoke(bench_command, arguments)
    assert result.exit_code == 0, (result.output, result.exception)
    found = json.loads(result.stdout)
    assert [stage["stage"] for stage in found["stages"]] == ["coarse", "fine"]
    for stage in found["stages"]:
        assert 0 < stage["step_ms"] <= stage["step_ms_90"]
        assert stage["samples_per_s"] == pytest.approx(1000 * stage["samples"] / stage["step_ms"], rel=0.01)


def test_the_time_of_each_preset_is_predicted_and_longer_ones_take_longer(tmp_path: Path) -> None:
    trajectories.colmap_set(tmp_path)
    seconds = inspected(tmp_path)["plan"]["seconds"]
    for end in (0, 1):
        assert 0 < seconds["fast"][end] < seconds["balanced"][end] < seconds["quality"][end]
    assert re.search(
        r"take about \d+( s)? to \d+ (s|min) \(fast\), ",
        CliRunner()
        .invoke(inspect_command, [str(tmp_path)], env={"XDG_CACHE_HOME": str(tmp_path / "new")})
        .output,
    )


@pytest.mark.parametrize(
    ("least_s", "most_s", "words"),
    [
        (95, 95, "2 min"),
        (20, 45, "20 to 45 s"),
        (40, 120, "40 s to 2 min"),
        (190, 350, "3 to 6 min"),
        (3000, 9000, "50 min to 2.5 h"),
    ],
)
def test_a_time_is_said_no_more_exactly_than_it_is_known(least_s: float, most_s: float, words: str):
    assert in_minutes(least_s, most_s) == words
