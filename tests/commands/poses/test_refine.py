"""The real `biresnerf refine` process: errors for bad input, and how it ends and resumes when killed."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from biresnerf.commands.poses.refine import summary
from biresnerf.data.synthetic.scene import write_synthetic_scene
from biresnerf.refinement.stages.checkpoint import load_checkpoint
from biresnerf.report import Report
from biresnerf.stages import CHECKPOINT
from biresnerf.uncertainty import PartReport, PartsReport, SeamReport

pytestmark = pytest.mark.slow

PROGRAM = Path(sys.executable).with_name("biresnerf")
STEPS = 200
SETTINGS = {
    "preset": "fast",
    "device": "cpu",
    "threads": 1,
    "steps": STEPS,
    "max_image_size": 24,
    "samples_per_step": 1024,
    "pose_resolution_max": 16,
    "reconstruction_levels": 1,
    "reconstruction_resolution_max": 128,
    "table_size_log2": 10,
    "holdout": 0,
    "trial_steps": 0,
    "orbit_frames": 0,
    "checkpoint_every_s": 1,
}


def command(scene: Path, output: Path, **changed: object) -> list[str]:
    settings = {**SETTINGS, **changed}
    flags = [flag for key, value in settings.items() for flag in ("--set", f"{key}={json.dumps(value)}")]
    return [str(PROGRAM), "refine", str(scene), "--output", str(output), *flags]


def run(*arguments: object, **changed: object) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        command(*arguments, **changed), capture_output=True, text=True, check=False, timeout=300
    )


def stop_after_checkpoint(scene: Path, output: Path, number: signal.Signals) -> tuple[int, str]:
    """Runs until the first checkpoint is there, sends the signal; exit status and what was said on stderr."""
    process = subprocess.Popen(command(scene, output), stderr=subprocess.PIPE, text=True)
    try:
        end = time.monotonic() + 400
        while not (output / CHECKPOINT).is_file():
            assert process.poll() is None, process.communicate()
            assert time.monotonic() < end
            time.sleep(0.02)
        process.send_signal(number)
        _, said = process.communicate(timeout=200)
    finally:
        process.kill()
    return process.returncode, said


def report_of(output: Path) -> Report:
    return Report.model_validate_json((output / "report.json").read_text())


@pytest.fixture(scope="module")
def scene(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("scene")
    write_synthetic_scene(folder, 6, 24, seed=1)
    return folder


@pytest.fixture(scope="module")
def terminated(scene, tmp_path_factory) -> tuple[Path, int, str]:
    """The folder of a run ended by SIGTERM, the exit status and what it said."""
    output = tmp_path_factory.mktemp("terminated") / "out"
    return (output, *stop_after_checkpoint(scene, output, signal.SIGTERM))


def assert_refused(result: subprocess.CompletedProcess[str], *parts: str) -> None:
    """Exit status 2, one message that has all these parts, and no traceback."""
    assert result.returncode == 2, result.stderr
    assert "Traceback" not in result.stderr
    for part in parts:
        assert part in result.stderr, f"{part!r} is not in {result.stderr!r}"


def test_an_input_that_is_not_there_is_named(tmp_path):
    result = run(tmp_path / "nowhere", tmp_path / "out")
    assert_refused(result, str(tmp_path / "nowhere"), "does not exist", "Give a folder, or a file with poses")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(("output", "code"), [("out", "no_images"), ("taken", "output_not_empty")])
def test_what_cannot_be_read_or_written_is_told_before_torch_is_loaded(tmp_path, output, code):
    (tmp_path / "taken").mkdir()
    (tmp_path / "taken/thesis.txt").write_text("mine")
    program = """
import sys
from biresnerf.command_line import main
try:
    main()
finally:
    print("torch" in sys.modules)
"""
    arguments = ["refine", str(tmp_path), "-o", str(tmp_path / output)]
    done = subprocess.run(
        [sys.executable, "-c", program, *arguments], capture_output=True, text=True, check=False
    )
    assert done.returncode == 2
    assert code in done.stderr
    assert done.stdout.split() == ["False"]


def test_every_wrong_option_is_named_with_what_is_wrong(scene, tmp_path):
    result = run(scene, tmp_path / "out", stepz=5, steps=3, pose_rate=-1)
    assert_refused(
        result,
        "stepz: unknown option",
        "steps: ",
        "greater than or equal to 20",
        "pose_rate: ",
        "did you mean `steps`",
        "docs/options.md",
    )
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("flags", "parts"),
    [
        (["--set", "steps"], ["'steps' is not key=value"]),
        (["--set", "steps=100", "--set", "steps=200"], ["steps is set twice"]),
        (["--set", "steps=many"], ["steps: ", "valid integer"]),
        (["--set", "pose_rate=1e999"], ["pose_rate: "]),
        (["--preset", "slow"], ["--preset", "balanced"]),
        (["--seed", "x"], ["--seed", "integer"]),
        (
            ["--set", "coarse_steps_min=500", "--set", "coarse_steps_max=100"],
            ["coarse_steps_min (500)", "(100)"],
        ),
    ],
)
def test_wrong_flags_are_refused_by_name(scene, tmp_path, flags, parts):
    arguments = [str(PROGRAM), "refine", str(scene), "-o", str(tmp_path / "out"), *flags]
    result = subprocess.run(arguments, capture_output=True, text=True, check=False, timeout=60)
    assert_refused(result, *parts)


def test_photos_are_chosen_by_the_lines_of_a_file(scene, tmp_path):
    (tmp_path / "names.txt").write_text("\nnosuch.png\n", "utf-8")
    for name, code in (("missing.txt", "invalid_options"), ("names.txt", "photos_not_found")):
        asked = [*command(scene, tmp_path / "out"), "--photos-from", str(tmp_path / name)]
        refused = subprocess.run(asked, capture_output=True, text=True, check=False, timeout=300)
        assert_refused(refused, code, name if code == "invalid_options" else "nosuch.png")


def test_a_broken_transforms_file_is_named_with_the_field(scene, tmp_path):
    broken = shutil.copytree(scene, tmp_path / "scene")
    document = json.loads((broken / "transforms.json").read_text())
    document["frames"] = document["frames"][:3]
    document["frames"][2]["transform_matrix"][0][0] = "one"
    (broken / "transforms.json").write_text(json.dumps(document))
    assert_refused(run(broken, tmp_path / "out"), "transforms.json", "frames[2].transform_matrix")


def test_a_folder_that_holds_something_else_is_left_alone(scene, tmp_path):
    (tmp_path / "letter.txt").write_text("dear")
    result = run(scene, tmp_path)
    assert_refused(result, str(tmp_path), "is not empty", "another output folder")
    assert [path.name for path in tmp_path.iterdir()] == ["letter.txt"]


def test_a_file_is_no_output_folder(scene, tmp_path):
    (tmp_path / "out").write_text("")
    assert_refused(run(scene, tmp_path / "out"), str(tmp_path / "out"), "is a file", "Name a folder")


def test_sigterm_writes_checkpoint_and_partial_result_and_ends_with_143(terminated):
    output, status, said = terminated
    assert status == 143
    assert "run again to go on" in said
    report = report_of(output)
    assert report.state == "partial"
    assert 0 < report.steps_done < STEPS
    assert load_checkpoint(output).optimiser.step_index == report.steps_done
    frames = json.loads((output / "transforms.json").read_text())["frames"]
    assert len(frames) == 6
    assert (output / "colmap/sparse/0/images.bin").is_file()


def test_the_same_command_goes_on_after_sigterm_and_is_then_finished(scene, terminated, tmp_path):
    output = shutil.copytree(terminated[0], tmp_path / "out")
    before = report_of(output)
    result = run(scene, output)
    assert result.returncode == 0, result.stderr
    report = report_of(output)
    assert (report.state, report.steps_done, report.resumed) == ("complete", STEPS, 1)
    assert f"of {STEPS}" in result.stdout
    assert not (output / CHECKPOINT).exists()
    assert report.seconds["coarse"] >= before.seconds["coarse"]
    assert_refused(run(scene, output), str(output), "holds a finished result", "--overwrite")
    again = subprocess.run(
        [*command(scene, output), "--overwrite"], capture_output=True, text=True, timeout=300
    )
    assert again.returncode == 0, again.stderr
    assert f"report: {output / 'report.html'}" in again.stdout
    (output / "report.html").unlink()  # as of an installation without its viewer
    assert "report.html" not in summary(report_of(output), output)
    names = (PartReport(name="a", photos=3), PartReport(name="b", photos=3))
    seam = SeamReport(
        parts=("a", "b"), photos=2, rotation_deg=0.02, rotation_deg_worst=1, position=1, position_worst=2
    )
    joined = report_of(output).model_copy(update={"parts": PartsReport(parts=names, seams=(seam,))})
    assert "2 parts; on the photos that two have they agree to 0.02 deg" in summary(joined, output)


@pytest.mark.parametrize("changed", [{"seed": 3}, {"max_image_size": 20}])
def test_an_unfinished_folder_of_other_options_is_refused_and_kept(scene, terminated, changed):
    output = terminated[0]
    before = (output / CHECKPOINT).read_bytes()
    assert_refused(
        run(scene, output, **changed), str(output), "unfinished run of other", "another output folder"
    )
    assert (output / CHECKPOINT).read_bytes() == before


def test_a_damaged_checkpoint_is_named(scene, terminated, tmp_path):
    output = shutil.copytree(terminated[0], tmp_path / "out")
    os.truncate(output / CHECKPOINT, 500)
    assert_refused(run(scene, output), str(output / CHECKPOINT), "cannot be read", "another output folder")


def test_a_killed_run_goes_on_from_its_last_checkpoint(scene, tmp_path):
    status, _ = stop_after_checkpoint(scene, tmp_path / "out", signal.SIGKILL)
    assert status == -signal.SIGKILL
    kept = load_checkpoint(tmp_path / "out").optimiser.step_index
    assert kept > 0
    # What changes neither result nor effort may differ when going on.
    again = command(scene, tmp_path / "out", checkpoint_every_s=100, orbit_frames=1)
    result = subprocess.run([*again, "--json"], capture_output=True, text=True, check=False, timeout=300)
    assert result.returncode == 0, result.stderr
    assert Report.model_validate_json(result.stdout) == report_of(tmp_path / "out")
    assert (tmp_path / "out/renders/orbit.mp4").is_file()
    report = report_of(tmp_path / "out")
    assert (report.state, report.steps_done, report.resumed) == ("complete", STEPS, 1)


def test_ctrl_c_ends_with_130_and_can_be_gone_on_from(scene, tmp_path):
    status, said = stop_after_checkpoint(scene, tmp_path / "out", signal.SIGINT)
    assert status == 130
    assert "run again to go on" in said
    assert report_of(tmp_path / "out").state == "partial"


def test_a_second_signal_ends_at_once_and_harms_no_checkpoint(scene, tmp_path):
    output = tmp_path / "out"
    process = subprocess.Popen(command(scene, output), stderr=subprocess.PIPE, text=True)
    try:
        while not (output / CHECKPOINT).is_file():
            assert process.poll() is None
            time.sleep(0.02)
        process.send_signal(signal.SIGTERM)
        process.send_signal(signal.SIGINT)
        assert process.wait(timeout=100) in (130, 143)
    finally:
        process.kill()
        process.communicate()
    assert load_checkpoint(output).optimiser.step_index > 0
