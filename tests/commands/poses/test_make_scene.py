from __future__ import annotations

import json
from pathlib import Path

from click.testing import CliRunner

from biresnerf.commands.poses.evaluate import evaluate_command
from biresnerf.commands.poses.make_scene import make_scene_command
from biresnerf.errors import InputError


def make(folder: Path, noise: float) -> Path:
    arguments = [str(folder), "--views", "6", "--size", "16", "--noise", str(noise)]
    done = CliRunner().invoke(make_scene_command, arguments)
    assert done.exit_code == 0, done.output
    return folder.with_name(f"{folder.name}.truth.json")


def rotation_deg(poses: Path, truth: Path) -> float:
    said = CliRunner().invoke(evaluate_command, [str(poses), str(truth), "--json"])
    mean: float = json.loads(said.output)["own_frame"]["rotation_deg"]["mean"]
    return mean


def test_the_given_poses_are_off_the_true_ones_by_the_noise(tmp_path: Path) -> None:
    assert rotation_deg(tmp_path / "exact", make(tmp_path / "exact", 0.0)) < 1e-6
    assert 5.0 < rotation_deg(tmp_path / "noisy", make(tmp_path / "noisy", 0.15)) < 30.0
    assert (tmp_path / "exact.truth.json").read_bytes() == (tmp_path / "noisy.truth.json").read_bytes()


def test_a_folder_with_files_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "mine.txt").write_text("x")
    done = CliRunner().invoke(make_scene_command, [str(tmp_path)])
    assert isinstance(done.exception, InputError)
    assert [path.name for path in tmp_path.iterdir()] == ["mine.txt"]
