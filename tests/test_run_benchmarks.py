"""The benchmarks of whole runs: their figures are those of the run, and add up."""

from __future__ import annotations

import json
import subprocess
import sys
import time

import pytest

from benchmarks.runs import shares, time_left
from biresnerf.data.synthetic.scene import write_synthetic_scene

pytestmark = pytest.mark.slow

SMALL = {
    "start": "given", "steps": 60, "coarse_steps_min": 10, "coarse_steps_max": 20, "max_image_size": 24,
    "samples_per_step": 1024, "pose_resolution_max": 16, "reconstruction_levels": 1, "threads": 1,
    "reconstruction_resolution_max": 128, "table_size_log2": 10, "trial_steps": 10, "orbit_frames": 2,
}  # fmt: skip


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return write_synthetic_scene(tmp_path_factory.mktemp("scene"), 8, 24, seed=3).parent


def test_the_parts_of_a_run_add_up_to_it_by_both_clocks(scene):
    found = shares.run(scene, "fast", 1, 0.05, SMALL)
    assert found["photos"] == 8
    assert found["steps"] == 60
    for clock in shares.CLOCKS:
        spent = found[clock]
        parts = sum(seconds for part, seconds in spent.items() if part != "all")
        assert parts == pytest.approx(spent["all"], abs=0.05)
        work = sum(spent[part] for part in shares.WORK)
        assert found[f"{clock}_rest"] == pytest.approx(1 - work / spent["all"], abs=0.05)
    assert found["wall"]["stage 2"] > found["wall"]["writing"] > 0
    assert 0 < found["rotation_deg"] < 90


def test_a_set_that_fails_is_named_and_the_others_go_on(scene, tmp_path, monkeypatch, capsys):
    options = [f"--set={key}={value}" for key, value in SMALL.items()]
    lines = tmp_path / "lines.jsonl"
    arguments = ["shares", str(tmp_path / "absent"), str(scene), "--json", str(lines), *options]
    monkeypatch.setattr(sys, "argv", arguments)
    shares.main()
    failed, done = capsys.readouterr().out.splitlines()[2:]
    assert failed.startswith("| absent | InputError")
    assert done.startswith(f"| {scene.name} | ")
    assert json.loads(lines.read_text())["set"] == scene.name


def test_what_was_said_and_what_was_taken_are_of_the_same_phases(scene):
    seconds, ratios, phases, work = time_left.told_and_taken(scene, "fast", 0.05, SMALL)
    assert len(ratios) == len(phases) == len(work) == len(time_left.SHARES)
    assert 0.8 < max(work) < 1.25, "what a run without matches has before it is known, once it is read"
    early, late = phases[0], phases[-1]
    assert early["fine"][1] > 0
    assert sum(actual for _, actual in early.values()) < seconds
    assert late.get("coarse", (0.0, 0.0))[1] == 0


def test_by_the_processors_clock_a_run_is_predicted_as_well(scene):
    before = time.monotonic
    seconds, ratios, phases, _ = time_left.told_and_taken(scene, "fast", 0.05, SMALL, "cpu")
    assert time.monotonic is before
    assert len(ratios) == len(time_left.SHARES)
    assert 0 < sum(actual for _, actual in phases[0].values()) < seconds


def test_the_processors_clock_counts_children_that_run_and_those_that_ended():
    began, spins = (
        time_left.processor_s(),
        "import time\nwhile time.process_time() < 0.5: pass\nprint()\ninput()",
    )
    child = subprocess.Popen([sys.executable, "-c", spins], stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    child.stdout.readline()
    running = time_left.processor_s() - began
    child.communicate(b"\n")
    assert 0.45 < running < 1.5
    assert running - 0.05 < time_left.processor_s() - began < 1.5
