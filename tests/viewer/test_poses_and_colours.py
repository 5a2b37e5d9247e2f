"""The page's own arithmetic, in Node, against the library's."""

from __future__ import annotations

import base64
import json
import subprocess
from pathlib import Path

import numpy as np
import pytest

import hatch_build
from biresnerf.data.show.renders import ramp_colours
from biresnerf.geometry.pose_error import rotation_between_deg
from biresnerf.geometry.rigid import interpolate_pose

ROOT = Path(__file__).resolve().parents[2]
ESBUILD = ROOT / "node_modules" / "esbuild" / "bin" / "esbuild"
VALUES = [-1.0, 0.0, 0.13, 0.5, 0.99, 1.0, 7.0]
CAMERAS = [
    {"model": "SIMPLE_RADIAL", "width": 40, "height": 30, "params": [20.0, 21.0, 14.0, 0.1]},
    {"model": "RADIAL_FISHEYE", "width": 40, "height": 30, "params": [20.0, 20.0, 15.0, 0.1, 0.0]},
    {"model": "OPENCV", "width": 40, "height": 30, "params": [20.0, 25.0, 21.0, 14.0, 0, 0, 0, 0]},
]


def random_pose(rng: np.random.Generator, angle: float) -> np.ndarray:
    """A pose turned by an angle about some axis."""
    axis = rng.normal(size=3)
    x, y, z = axis / np.linalg.norm(axis)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    pose = np.eye(4)
    pose[:3, :3] += np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
    pose[:3, 3] = rng.normal(size=3) * 100
    return pose


@pytest.fixture(scope="module")
def pairs() -> list[tuple[np.ndarray, np.ndarray, float]]:
    rng = np.random.default_rng(3)
    angles = [0.0, 1e-9, 1e-5, 0.01, 0.3, 1.0, 2.0, 3.0, 3.1]
    found = []
    for angle in angles:
        first = random_pose(rng, rng.uniform(0, 3))
        turn = random_pose(rng, angle)
        second = first.copy()
        second[:3, :3] = first[:3, :3] @ turn[:3, :3]
        second[:3, 3] += turn[:3, 3]
        found.append((first, second, float(rng.uniform(0.05, 0.95))))
    return found


@pytest.fixture(scope="module")
def answers(pairs, tmp_path_factory) -> dict:
    if not ESBUILD.is_file():
        pytest.skip("esbuild is not installed; make web installs it.")
    bundle = tmp_path_factory.mktemp("bundle") / "answers.mjs"
    source = Path(__file__).with_name("poses_and_colours.ts")
    node = hatch_build.node()
    build = [str(ESBUILD), str(source), "--bundle", "--platform=node", "--format=esm", f"--outfile={bundle}"]
    subprocess.run([*node, *build, "--log-level=warning"], cwd=ROOT, check=True)
    content = np.arange(6, dtype="<f4").tobytes() + bytes(range(6))
    asked = {
        "pairs": [(a[:3].tolist(), b[:3].tolist(), share) for a, b, share in pairs],
        "values": VALUES,
        "cameras": CAMERAS,
        "history": '{"step": 5, "psnr": 20}\n[]\n{"step": 10, "ps',
        "points": {
            "entry": {"source": "field", "file": "", "count": 2, "origin": [0, 0, 0]},
            "base64": base64.b64encode(content).decode(),
        },
    }
    said = subprocess.run(
        [*node, str(bundle)], input=json.dumps(asked), capture_output=True, text=True, check=True
    )
    return json.loads(said.stdout)


def test_a_pose_between_two_is_the_librarys(answers, pairs):
    for found, (first, second, share) in zip(answers["between"], pairs, strict=True):
        np.testing.assert_allclose(found, interpolate_pose(first, second, share)[:3], atol=1e-9)


def test_turns_are_as_large_as_the_library_says(answers, pairs):
    for found, (first, second, _) in zip(answers["turned"], pairs, strict=True):
        assert found == pytest.approx(float(rotation_between_deg(first[None], second[None])[0]), abs=1e-6)


def test_colours_are_a_part_of_the_ramp_of_pictures_that_neither_ground_hides(answers):
    inside = np.clip(VALUES, 0, 1)
    light, dark = np.array(answers["ramp"]).transpose(1, 0, 2)
    assert np.abs(light - ramp_colours(0.88 * inside)).max() <= 1
    assert np.abs(dark - ramp_colours(0.22 + 0.78 * inside)).max() <= 1


def test_pictures_borders_follow_from_the_lens_whatever_its_model(answers):
    assert answers["borders"] == [
        [-21 / 20, -14 / 20, 19 / 20, 16 / 20],
        [-1.0, -15 / 20, 1.0, 15 / 20],
        [-21 / 20, -14 / 25, 19 / 20, 16 / 25],
    ]


def test_a_torn_line_of_a_history_is_left_out(answers):
    assert answers["history"] == [{"step": 5, "psnr": 20}]


def test_points_are_read_as_they_were_written(answers):
    assert answers["points"] == {"positions": [0, 1, 2, 3, 4, 5], "colours": [0, 1, 2, 3, 4, 5]}
