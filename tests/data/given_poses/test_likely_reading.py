"""Photos show whether given poses follow their format's conventions; the user is asked only if they do not."""

from __future__ import annotations

import json
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from biresnerf.data.formats.read_dataset import read_dataset
from biresnerf.data.given_poses.likely_reading import best_turn, borne_out, pose_question
from biresnerf.data.given_poses.matched_details import MatchedPair, matched_pairs, off_by
from biresnerf.data.given_poses.readings import poses_read_as
from biresnerf.data.model.dataset import Dataset
from biresnerf.geometry.focus import focus_point
from biresnerf.geometry.perturb import perturb_poses
from tests.data.given_poses.views import SIZE, around, inside, looking, written

ROOT = Path(os.environ.get("BIRESNERF_TEST_DATA", Path(__file__).parents[4] / "shared" / "data"))
F = np.diag([1.0, -1.0, -1.0, 1.0])
# Real sets, and what each of them asks once all of its axes, or matrices, are wrong.
REAL = [
    "banana", "fern", "fox", "temple", "horns", "kitchen25", "lund_door", "mobilebrick", "fountain_p11", "entry_p10",
    "coffee", "scarf", "lego", "lego_tiny100", "dtu_scan24",
]  # fmt: skip


def with_poses(dataset: Dataset, world_from_cam: np.ndarray) -> Dataset:
    poses = iter(world_from_cam)
    frames = (
        replace(f, world_from_cam=next(poses)) if f.world_from_cam is not None else f for f in dataset.frames
    )
    return replace(dataset, frames=tuple(frames))


def given(dataset: Dataset) -> np.ndarray:
    return np.stack([frame.world_from_cam for frame in dataset.frames if frame.world_from_cam is not None])


def asked(dataset: Dataset, pairs: list[MatchedPair]) -> tuple[str, ...]:
    question = borne_out(dataset, pairs)
    return () if question is None else question.given_poses


def transposed(poses: np.ndarray) -> np.ndarray:
    turned = poses.copy()
    turned[:, :3, :3] = poses[:, :3, :3].swapaxes(1, 2)
    return turned


# World from camera as a transforms.json with each mistake is read.
MISREAD = {
    ("opencv_axes",): lambda poses: poses @ F,
    ("inverted",): lambda poses: np.linalg.inv(poses @ F) @ F,
    ("inverted", "opencv_axes"): lambda poses: np.linalg.inv(poses) @ F,
    ("transposed",): lambda poses: transposed(poses @ F) @ F,
}


@pytest.mark.parametrize(("cameras", "noise"), [(around, 0.0), (around, 0.05), (inside, 0.0)])
def test_each_mistake_is_asked_about_and_right_poses_are_not(tmp_path: Path, cameras, noise: float) -> None:
    truth = cameras()
    poses = perturb_poses(truth, noise, 1) if noise else truth
    dataset = written(tmp_path, poses, truth)
    pairs = matched_pairs(dataset)
    assert asked(dataset, pairs) == ()
    found = {wrong: asked(with_poses(dataset, misread(poses)), pairs) for wrong, misread in MISREAD.items()}
    assert found == dict(zip(MISREAD, MISREAD, strict=True))


def turns(count: int) -> list[np.ndarray]:
    """Of cameras on what carries them, [4, 4]: any, and one by which a reading may seem right."""
    rng, found = np.random.default_rng(3), [np.eye(4) for _ in range(count)]
    for turn in found[1:]:
        q, _ = np.linalg.qr(rng.normal(size=(3, 3)))
        turn[:3, :3] = q * np.sign(np.linalg.det(q))
    found[0][:2, :2] = [[np.sqrt(0.75), -0.5], [0.5, np.sqrt(0.75)]]
    return found


@pytest.mark.parametrize("noise", [0.0, 0.05])
def test_poses_of_what_carries_the_camera_are_not_asked_about(tmp_path: Path, noise: float) -> None:
    truth = around()
    dataset = written(tmp_path, truth)
    pairs = matched_pairs(dataset)
    poses = perturb_poses(truth, noise, 1) if noise else truth
    assert [asked(with_poses(dataset, poses @ turn), pairs) for turn in turns(8)] == [()] * 8


def test_the_turn_of_a_camera_on_its_carrier_is_found(tmp_path: Path) -> None:
    truth = around()
    pairs = matched_pairs(written(tmp_path, truth))
    for turn in turns(4):
        found = best_turn(dict(enumerate(truth @ turn)), pairs) @ turn[:3, :3]
        assert np.degrees(np.arccos((np.trace(found) - 1) / 2)) < 3.0


def test_cameras_that_look_outward_are_not_taken_for_ones_that_look_backward(tmp_path: Path) -> None:
    dataset = written(tmp_path, inside())
    assert (
        focus_point(given(dataset)).in_front == 0.0
    )  # by axes alone, all of them seem to look the wrong way
    assert pose_question(dataset) is None


def test_photos_that_show_nothing_leave_it_open(tmp_path: Path) -> None:
    dataset = written(tmp_path, around())
    for frame in dataset.frames:
        Image.new("L", (SIZE, SIZE), 200).save(frame.path)
    assert pose_question(dataset) is None


def test_what_two_cameras_see_lies_on_the_ray_of_the_first_in_front_of_both() -> None:
    first, second = (looking(np.array([x, 0.0, 0.0]), np.array([0.0, 1.0, 0.0]), 0.0) for x in (-1.0, 1.0))
    point = np.array([0.3, 5.0, 0.7])
    a, b = ((point - pose[:3, 3]) @ pose[:3, :3] for pose in (first, second))
    a, b = a[None] / np.linalg.norm(a), b[None] / np.linalg.norm(b)
    assert off_by(first, second, a, b)[0] == pytest.approx(0.0, abs=1e-7)
    turn = np.radians(4.0)  # about the first camera's ray: out of the plane of both
    off = np.array([[1, 0, 0], [0, np.cos(turn), -np.sin(turn)], [0, np.sin(turn), np.cos(turn)]]) @ b[0]
    assert 0.9 * turn < off_by(first, second, a, off[None])[0] < turn + 1e-6
    # As lines they meet, behind both cameras, or behind one of them.
    assert off_by(first, second, -a, -b)[0] > np.radians(10.0)
    assert off_by(first, second, -a, b)[0] > np.radians(10.0)
    assert off_by(first, second, b, a)[0] > np.radians(10.0)


@pytest.mark.parametrize("name", REAL)
def test_a_real_set_is_asked_about_once_its_axes_or_matrices_are_wrong(name: str) -> None:
    if not (ROOT / name).is_dir():
        pytest.skip(f"no image set {name}: set BIRESNERF_TEST_DATA to the folder that holds it")
    dataset = read_dataset(ROOT / name)
    pairs = matched_pairs(dataset)
    assert asked(dataset, pairs) == ()
    axes = "opengl_axes" if dataset.source.dialect == "colmap" else "opencv_axes"
    poses = given(dataset)
    assert asked(with_poses(dataset, poses @ F), pairs) == (axes,)
    # Its own inverse where the format has it so: the mistake of one who exchanges the two.
    inverted = poses_read_as(poses, dataset.source, ["inverted"])
    assert asked(with_poses(dataset, inverted), pairs) == ("inverted",)
    assert [asked(with_poses(dataset, poses @ turn), pairs) for turn in turns(4)] == [()] * 4


def test_real_poses_of_a_flange_are_not_asked_about() -> None:
    case = ROOT / "interop/50_camera_side_turn/flange"
    if not case.is_dir():
        pytest.skip("no image set interop: set BIRESNERF_TEST_DATA to the folder that holds it")
    assert pose_question(read_dataset(case)) is None


def test_a_real_transforms_json_with_opencv_axes_is_asked_about() -> None:
    case = ROOT / "interop/50_camera_side_turn"
    if not case.is_dir():
        pytest.skip("no image set interop: set BIRESNERF_TEST_DATA to the folder that holds it")
    dataset = read_dataset(case / "opencv_axes")
    question = pose_question(dataset)
    assert question is not None
    assert question.given_poses == ("opencv_axes",)
    truth = json.loads((case / "truth_opencv_axes.json").read_text())
    read = poses_read_as(given(dataset), dataset.source, question.given_poses)
    for frame, pose in zip(dataset.frames, read, strict=True):
        np.testing.assert_allclose(pose @ F, truth[frame.name], atol=1e-6)
