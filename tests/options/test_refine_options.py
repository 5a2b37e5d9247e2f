"""Options as requested and as resolved, and the declaration of each."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
from click.testing import CliRunner

from biresnerf.commands.poses.refine import refine_command
from biresnerf.errors import InputError
from biresnerf.options.option import Option, divided, lowered
from biresnerf.options.presets import METHOD_VALUES, PRESETS
from biresnerf.options.refine_options import (
    OPTIONS,
    RESULT_OPTIONS,
    STAGE_1_OPTIONS,
    RefineOptions,
    ResolvedOptions,
    parse_options,
)

DEVICES = ("cpu", "cuda")


@pytest.mark.parametrize("name", RefineOptions.model_fields)
def test_every_option_says_what_it_touches(name: str):
    said = [item for item in RefineOptions.model_fields[name].metadata if isinstance(item, Option)]
    assert len(said) == 1
    schema = RefineOptions.model_json_schema()["properties"][name]
    assert {key: schema[key] for key in ("stage", "changes_result", "level")} == {
        "stage": said[0].stage,
        "changes_result": said[0].changes_result,
        "level": said[0].level,
    }


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("preset", PRESETS)
@pytest.mark.parametrize("method", METHOD_VALUES)
def test_nothing_is_left_open_once_resolved(preset, method, device):
    resolved = RefineOptions(preset=preset, method=method).resolved(device)
    assert type(resolved) is ResolvedOptions
    assert None not in resolved.model_dump().values()
    assert resolved.device == device
    again = parse_options(resolved.model_dump())
    assert again.resolved(device) == resolved, "resolving twice changes nothing"


@pytest.mark.parametrize("missing", ["steps", "max_image_size", "holdout", "device"])
def test_resolved_options_refuse_what_is_left_open(missing: str):
    values = RefineOptions().resolved("cpu").model_dump(exclude={missing})
    with pytest.raises(ValueError, match=missing):
        ResolvedOptions.model_validate(values)
    with pytest.raises(ValueError, match=missing):
        ResolvedOptions.model_validate({**values, missing: None})


def test_a_run_that_names_no_preset_is_fast_on_a_cpu_and_balanced_on_a_gpu():
    named = {device: RefineOptions().resolved(device) for device in ("cpu", "cuda")}
    assert named == {
        "cpu": RefineOptions(preset="fast").resolved("cpu"),
        "cuda": RefineOptions(preset="balanced").resolved("cuda"),
    }


def test_a_gpu_takes_larger_images_and_batches_unless_they_are_asked_for():
    cpu, cuda = (RefineOptions(preset="fast").resolved(device) for device in DEVICES)
    assert (cuda.max_image_size, cuda.samples_per_step) == (2 * cpu.max_image_size, 4 * cpu.samples_per_step)
    changed = {"device", "max_image_size", "samples_per_step"}
    assert cuda.model_dump(exclude=changed) == cpu.model_dump(exclude=changed)
    asked = RefineOptions(max_image_size=100, samples_per_step=2048).resolved("cuda")
    assert (asked.max_image_size, asked.samples_per_step) == (100, 2048)
    of_paper = [RefineOptions(preset="paper").resolved(device) for device in DEVICES]
    assert of_paper[0].max_image_size == of_paper[1].max_image_size


def test_a_run_made_shorter_by_its_steps_alone_keeps_the_proportions():
    whole, half = (RefineOptions(preset="balanced", steps=steps).resolved("cpu") for steps in (None, 4000))
    for name in ("steps", "coarse_steps_min", "coarse_steps_max", "check_every", "warmup_steps"):
        assert getattr(half, name) == getattr(whole, name) / 2


@pytest.mark.parametrize("value", [201, -1, 1.5, "some"])
def test_a_wrong_count_of_held_out_views_is_one_error_at_its_own_place(value):
    with pytest.raises(InputError) as caught:
        parse_options({"holdout": value})
    assert "holdout: Value error, must be auto or a whole number from 0 to 200" in caught.value.detail


@pytest.mark.parametrize(
    ("values", "told"),
    [
        ({"steps": "60"}, "steps: Input should be a valid integer"),
        ({"pose_rate": "0.01"}, "pose_rate: Input should be a valid number"),
        ({"verdict": "yes"}, "verdict: Input should be a valid boolean"),
        ({"fixed": "a"}, "fixed: Value error, must be a list"),
        ({"fixed": ["a", "b", "a"]}, "fixed: Value error, 'a' is named twice"),
        ({"exports": ["kitti", "kitti"]}, "exports: Value error, 'kitti' is named twice"),
        ({"checkpoint_every_s": 1e-9}, "checkpoint_every_s: Input should be greater than or equal to 1"),
    ],
)
def test_a_value_of_another_type_or_a_name_given_twice_is_refused(values: dict[str, object], told: str):
    with pytest.raises(InputError) as caught:
        parse_options(values)
    assert told in caught.value.detail


def test_every_number_is_bounded_on_both_sides():
    for name, field in RefineOptions.model_json_schema()["properties"].items():
        for kind in field.get("anyOf", [field]):
            if kind.get("type") in ("integer", "number"):
                assert kind.keys() & {"minimum", "exclusiveMinimum"}, name
                assert kind.keys() & {"maximum", "exclusiveMaximum"}, name


def test_what_changes_no_result_may_change_on_resuming_and_what_comes_later_keeps_stage_1():
    free = {
        *("threads", "checkpoint_every_s", "orbit_frames", "shown_views", "exports", "poses_of"),
        "known_distance",
    }
    assert set(OPTIONS) - RESULT_OPTIONS == free
    assert set(OPTIONS) - STAGE_1_OPTIONS == free | {
        *("reconstruction_levels", "reconstruction_resolution_min", "reconstruction_resolution_max"),
        *(
            "table_size_log2",
            "warmup_steps",
            "verdict",
            "trial_steps",
            "input_rotation_deg",
            "input_position",
        ),
    }


@pytest.mark.slow
def test_the_type_checker_tells_options_asked_for_from_resolved_ones(tmp_path: Path):
    program = tmp_path / "program.py"
    program.write_text(
        "from biresnerf.options.refine_options import RefineOptions, ResolvedOptions\n"
        "def size(options: ResolvedOptions) -> int:\n"
        "    return options.max_image_size\n"
        "def asked(options: RefineOptions) -> int:\n"
        "    return options.max_image_size\n"
        "size(RefineOptions())\n"
    )
    # With the cache of the last lint, where there is one.
    command = [sys.executable, "-m", "mypy", str(program)]
    found = subprocess.run(command, capture_output=True, text=True, check=False)
    assert found.returncode == 1, found.stdout + found.stderr
    wrong = {int(line.split(":")[1]) for line in found.stdout.splitlines() if ": error:" in line}
    assert wrong == {5, 6}, found.stdout


def test_the_first_screen_of_help_names_no_option_for_research():
    screen = CliRunner().invoke(refine_command, ["--help"]).output
    assert "--preset" in screen
    assert not [name for name, option in OPTIONS.items() if option.level == "research" and name in screen]


def test_less_memory_never_means_more_of_anything():
    assert [divided(2, 64)(value) for value in (400, 100, 64, 32)] == [200, 64, 64, 32]
    assert [lowered(2, 10)(value) for value in (19, 11, 10, 8)] == [17, 10, 10, 8]
