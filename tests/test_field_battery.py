"""The battery of real sets: its list, what it gives the product, and how it judges poses."""

from __future__ import annotations

import subprocess
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from benchmarks.field.colmap_child import epipolar
from benchmarks.field.inputs import gps_residual, lens, metres_from, photos_alone, with_poses
from benchmarks.field.run_set import _true_frames
from benchmarks.field.sets import FieldSet, lay_out, read_sets
from benchmarks.field.table import table
from biresnerf.data.formats.read_dataset import read_dataset
from tests.data.scenes import arc_poses

DOCUMENTED = Path(__file__).parents[1] / "docs" / "field.md"
LENS: dict[str, Any] = {
    "model": "OPENCV",
    "width": 64,
    "height": 48,
    "params": [60.0, 61.0, 31.0, 25.0, 0.1, -0.02, 1e-3, 2e-3],
}


def test_the_list_has_many_kinds_and_holds_half_of_them_back():
    sets, documented = read_sets(), DOCUMENTED.read_text()
    assert len(sets) >= 9
    assert len({each.name for each in sets}) == len({each.kind for each in sets}) == len(sets)
    assert abs(2 * sum(each.held_back for each in sets) - len(sets)) <= 1
    for each in sets:
        assert len(each.commit) == 40
        assert each.licence
        assert each.repository.count("/") == 1
        assert 5 <= len(each.photos) == len(set(each.photos)) <= 20
        assert f"\n| {each.name} {'*(held back)* ' * each.held_back}|" in documented


def _git(folder: Path, *arguments: str) -> str:
    who = ("-c", "user.name=a", "-c", "user.email=a@b.c")
    done = subprocess.run(
        ["git", "-C", str(folder), *who, *arguments], capture_output=True, text=True, check=True
    )
    return done.stdout.strip()


def test_a_set_is_the_files_of_its_commit_byte_for_byte(tmp_path):
    clone = tmp_path / "someone+photos"
    (clone / "full").mkdir(parents=True)
    _git(clone, "init", "-q")
    for name in ("a.jpg", "b.jpg", "c.jpg", "poses.txt"):
        (clone / "full" / name).write_bytes(name.encode() + b"\r\n\xff")
    _git(clone, "add", ".")
    _git(clone, "commit", "-qm", "first")
    commit = _git(clone, "rev-parse", "HEAD")
    (clone / "full" / "a.jpg").write_bytes(b"changed since")
    _git(clone, "commit", "-qam", "second")
    taken = FieldSet(
        "few", "a kind", "someone/photos", commit, "full", "CC0", ("a.jpg", "c.jpg"), ("poses.txt",)
    )
    folder = lay_out(taken, tmp_path)
    assert sorted(path.name for path in folder.iterdir()) == ["a.jpg", "c.jpg", "poses.txt"]
    assert (folder / "a.jpg").read_bytes() == b"a.jpg\r\n\xff"
    with pytest.raises(FileNotFoundError, match="lacks some files"):
        lay_out(replace(taken, name="more", photos=("a.jpg", "gone.jpg")), tmp_path)


def _laid_out(folder: Path, noise: float):
    source = folder / "published"
    source.mkdir(parents=True)
    poses = arc_poses(8)
    frames = []
    for i, pose in enumerate(poses):
        Image.new("RGB", (64, 48), (i, 9, 9)).save(source / f"{i}.jpg")
        frames.append({"name": f"{i}.jpg", "world_from_cam": pose.tolist(), "lens": LENS})
    names = tuple(frame["name"] for frame in frames)
    given = with_poses(photos_alone(source, names, folder / "given"), frames, noise=noise)
    return poses, source, read_dataset(given)


def test_the_product_reads_the_poses_and_lenses_that_the_battery_writes(tmp_path):
    poses, source, dataset = _laid_out(tmp_path, noise=0.0)
    found = np.stack([frame.world_from_cam for frame in dataset.frames])
    np.testing.assert_allclose(found, poses, atol=1e-12)
    assert dataset.cameras[0].model == "OPENCV"
    np.testing.assert_allclose(dataset.cameras[0].params, LENS["params"])
    assert dataset.frames[3].path.read_bytes() == (source / "3.jpg").read_bytes()


def test_noisy_poses_are_off_by_about_fourteen_degrees(tmp_path):
    poses, _, dataset = _laid_out(tmp_path, noise=0.15)
    found = np.stack([frame.world_from_cam for frame in dataset.frames])
    cosines = (np.trace(np.swapaxes(found[:, :3, :3], 1, 2) @ poses[:, :3, :3], axis1=1, axis2=2) - 1) / 2
    assert 8 < np.degrees(np.arccos(cosines)).mean() < 20


def test_gps_is_metres_and_asks_for_a_similarity_only():
    there = metres_from((50.0, 14.0, 200.0), (50.001, 14.001, 203.0))
    np.testing.assert_allclose(there, (71.5, 111.2, 3.0), atol=0.1)
    poses = {str(i): pose for i, pose in enumerate(arc_poses(8))}
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    places = {name: 7.0 * turn @ pose[:3, 3] + np.array([10.0, 20.0, 30.0]) for name, pose in poses.items()}
    assert gps_residual(poses, places) == pytest.approx(0.0, abs=1e-9)
    assert gps_residual(poses, dict(list(places.items())[:5])) is None


def test_epipolar_distances_are_zero_at_the_true_poses_and_count_what_a_point_is_off():
    points = np.random.default_rng(0).uniform((-1, -1, 3), (1, 1, 6), (50, 3))
    shift = np.array([-1.0, 0.0, 0.0])  # other_from_one: seen from a place one to the right
    one, other = points / points[:, 2:], (points + shift) / points[:, 2:]
    np.testing.assert_allclose(epipolar(np.eye(3), shift, one, other), 0.0, atol=1e-12)
    off = other + np.array([0.3, 0.01, 0.0])  # along the line nothing is seen
    np.testing.assert_allclose(epipolar(np.eye(3), shift, one, off), 0.01, atol=1e-12)
    assert np.isinf(epipolar(np.eye(3), np.zeros(3), one, other)).all()


def test_the_table_has_what_failed_too():
    run = {
        "placed": 8,
        "epipolar_px": 0.412,
        "gps_m": 2.345,
        "verdict": "kept_input",
        "warnings": ["a"],
        "seconds": 9,
    }
    row = {
        "set": "x", "kind": "a tree", "photos": 8, "size": (40, 30), "given": {"own_frame_deg": 13.0}, "peer": run,
        "alone": {"error": "first\nlast line", "seconds": 5},
        "noisy": run | {"deg": 0.084, "own_frame_deg": 0.1},
    }  # fmt: skip
    counted = table([row | {"alone": run | {"known": 7}}]).splitlines()[-1]
    assert "| 7 of 8 known; 0.41 px; 2.3 m; kept input |" in counted
    assert table([row]).splitlines()[-1] == (
        "| x: a tree | 8 of 40 x 30 | 8 of 8; 0.41 px; 2.3 m; kept input | failed: last line "
        "| 13.0° -> 0.08°, own frame 0.10°; 0.41 px; 2.3 m; kept input | 5, 9 | -, 1 |"
    )


def test_the_truth_is_colmaps_richest_model_whose_lenses_see_every_pixel():
    def model(count: int, **lens: Any) -> dict[str, Any]:
        pose = np.eye(4).tolist()
        return {
            "frames": [
                {"name": f"{i}.jpg", "world_from_cam": pose, "lens": LENS | lens} for i in range(count)
            ]
        }

    simple = {"model": "SIMPLE_RADIAL", "params": [60.0, 31.0, 25.0, 0.01]}
    folding = {"params": [60.0, 61.0, 31.0, 25.0, -2.0, 0.0, 0.0, 0.0]}
    good, default, few = model(4), model(5, **simple), model(2)
    assert _true_frames({"reference": good, "peer": default}) == good["frames"]
    assert _true_frames({"reference": model(4, **folding), "peer": default}) == default["frames"]
    assert _true_frames({"reference": few, "peer": default}) == default["frames"]
    assert _true_frames({"reference": few, "peer": model(5, **folding)}) == []
    assert lens(default["frames"][0]) == {
        "w": 64,
        "h": 48,
        "fl_x": 60.0,
        "fl_y": 60.0,
        "cx": 31.0,
        "cy": 25.0,
        "k1": 0.01,
        "k2": 0.0,
        "p1": 0.0,
        "p2": 0.0,
    }
