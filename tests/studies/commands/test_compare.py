"""`biresnerf compare` as a process: tables that agree with the files, stopping and going on, failed cells."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from biresnerf.data.formats.read_dataset import read_poses
from biresnerf.data.show.history import read_history
from biresnerf.data.synthetic.scene import write_synthetic_scene
from biresnerf.geometry.perturb import perturb_poses
from biresnerf.geometry.pose_error import pose_error
from biresnerf.studies.tables import Tables

SETTINGS = {
    "preset": "fast",
    "device": "cpu",
    "threads": 1,
    "steps": 60,
    "max_image_size": 24,
    "samples_per_step": 1024,
    "pose_resolution_max": 16,
    "reconstruction_levels": 1,
    "reconstruction_resolution_max": 128,
    "table_size_log2": 10,
}
# Each run is a process that loads torch and kernels: seconds alone, minutes beside other work.
LONGEST_S = 900
pytestmark = [pytest.mark.slow, pytest.mark.timeout(3 * LONGEST_S)]
PROGRAM = "import sys; from biresnerf.command_line import main; sys.argv[0] = 'biresnerf'; main()"


def command(*arguments: object) -> list[str]:
    flags = [flag for key, value in SETTINGS.items() for flag in ("--set", f"{key}={json.dumps(value)}")]
    return [sys.executable, "-c", PROGRAM, "compare", *map(str, arguments), *flags]


def compare(*arguments: object) -> subprocess.CompletedProcess[str]:
    return subprocess.run(command(*arguments), capture_output=True, text=True, check=False, timeout=LONGEST_S)


@pytest.fixture(scope="module")
def scene(tmp_path_factory) -> Path:
    """Six views to optimise and three of the same scene that no run sees."""
    folder = tmp_path_factory.mktemp("scenes") / "blocks"
    document = json.loads(write_synthetic_scene(folder, 9, 24, seed=1).read_text())
    frames = document["frames"]
    for name, part in (("train", frames[:6]), ("test", frames[6:])):
        (folder / f"transforms_{name}.json").write_text(json.dumps({**document, "frames": part}))
    (folder / "transforms.json").unlink()
    return folder


@pytest.fixture(scope="module")
def resumed(scene, tmp_path_factory) -> tuple[Path, subprocess.CompletedProcess[str]]:
    """The output of a comparison killed when its first cell was done, then run again; and what that said."""
    output = tmp_path_factory.mktemp("compared")
    variants = ["--variant", "slow:", "--variant", "quick: pose_rate=0.02", "--noise", "0.1"]
    arguments = (scene, "-o", output, *variants)
    first = subprocess.Popen(command(*arguments), stderr=subprocess.DEVNULL, start_new_session=True)
    try:
        end = time.monotonic() + LONGEST_S
        while not list(output.glob("cells/*/result.json")):
            assert first.poll() is None
            assert time.monotonic() < end
            time.sleep(0.05)
    finally:
        os.killpg(first.pid, signal.SIGKILL)
        first.wait()
    return output, compare(*arguments)


def test_a_killed_comparison_runs_only_what_was_not_finished(resumed):
    output, again = resumed
    assert again.returncode == 0, again.stderr
    assert "blocks, noise 0.1, seed 1: quick:" in again.stderr
    assert "slow" not in again.stderr
    assert len(list(output.glob("cells/*/result.json"))) == 2


def test_the_tables_say_what_the_written_poses_say(resumed, scene):
    output, again = resumed
    tables = Tables.model_validate_json((output / "tables.json").read_text())
    assert [row.variant for row in tables.rows] == ["slow", "quick"]
    truth = np.stack(list(read_poses(scene / "transforms_train.json").values()))
    results = [json.loads(path.read_text()) for path in output.glob("cells/*/result.json")]
    start = pose_error(perturb_poses(truth, 0.1, 1), truth).aligned
    for row in tables.rows:
        rate = 0.02 if row.variant == "quick" else None
        result = next(r for r in results if r["cell"]["options"]["pose_rate"] == rate)
        (run,) = [
            path.parent / "run"
            for path in output.glob("cells/*/cell.json")
            if json.loads(path.read_text()) == result["cell"]
        ]
        error = pose_error(np.stack(list(read_poses(run).values())), truth).aligned
        assert row.values["rotation_deg"] == pytest.approx(error.rotation_deg.mean, rel=1e-6)
        assert row.values["start_deg"] == pytest.approx(start.rotation_deg.mean, rel=1e-6)
        assert 50 < row.values["peak_mb"] < 4000
        # The curve ends where the result is: measured in the run and in its file.
        last = read_history(run / "history.jsonl")[-1]
        assert last["step"] == 60
        assert last["rotation_deg"] == pytest.approx(error.rotation_deg.mean, rel=1e-3)
        assert result["outcome"]["views"]["kind"] == "test"
        assert result["outcome"]["views"]["count"] == 3
        assert 5 < row.values["psnr"] < 40
    assert (output / "tables.md").read_text() in again.stdout
    assert "| rotation ° | quick - slow |" in again.stdout


def test_a_cell_that_fails_is_recorded_and_not_the_end(scene, tmp_path):
    damaged = shutil.copytree(scene, tmp_path / "damaged")
    picture = damaged / "train" / "r_3.png"
    picture.write_bytes(picture.read_bytes()[:200])  # its header says nothing of it
    first = compare(damaged, "-o", tmp_path / "out")
    assert first.returncode == 1
    assert "FAILED" in first.stderr
    assert "Traceback" not in first.stdout
    tables = Tables.model_validate_json((tmp_path / "out/tables.json").read_text())
    (failure,) = tables.failures
    assert failure.error.startswith("exit status 1")
    assert "r_3" in failure.error
    assert tables.rows[0].failed == 1
    again = compare(damaged, "-o", tmp_path / "out")
    assert again.returncode == 1
    assert "…" not in again.stderr  # nothing was run


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--variant", "no colon"], "is not 'NAME: KEY=VALUE"),
        (["--variant", "a: stepz=1"], "stepz: unknown option"),
        (["--variant", "a:", "--variant", "a:"], "same name"),
        (["--seeds", "one"], "no list of numbers"),
        (["--every", "4"], "at least 3"),
    ],
)
def test_wrong_arguments_are_refused_before_anything_runs(scene, tmp_path, arguments, said):
    result = compare(scene, "-o", tmp_path / "out", *arguments)
    assert result.returncode == 2
    assert said in result.stderr
    assert not (tmp_path / "out").exists()
