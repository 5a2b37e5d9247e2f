"""A run on photos that show a small thing before much black."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from biresnerf.data.synthetic.scene import write_synthetic_scene
from biresnerf.pipeline import refine_poses
from biresnerf.report import Report
from tests.refinement.tiny_scene import tiny_run

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("small")
    near = write_synthetic_scene(folder / "near", 6, 40, seed=3)
    sizes = ("--thing", "30", "--photo", "240")
    command = [sys.executable, "-m", "benchmarks.sets.small_things", str(near), str(folder / "far"), *sizes]
    subprocess.run(command, check=True)
    return folder / "far"


def refined(scene: Path, output: Path, max_image_size: int | None) -> Report:
    options = tiny_run(start="given", steps=20, verdict=False, orbit_frames=0, max_image_size=max_image_size)
    return refine_poses(scene, output, options)


def test_photos_are_larger_than_the_presets_size_unless_a_size_is_named(scene: Path, tmp_path: Path) -> None:
    assert refined(scene, tmp_path / "preset", None).working_size == (240, 240)  # of 240; the preset has 128
    assert refined(scene, tmp_path / "named", 48).working_size == (48, 48)
