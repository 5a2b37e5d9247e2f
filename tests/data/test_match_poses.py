"""COLMAP guided by given poses, on rendered scenes whose true poses are known."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from biresnerf.data import match_poses
from biresnerf.data.dataset import Camera, Dataset, Frame, SourceFormat
from biresnerf.data.match_poses import poses_from_matches
from biresnerf.data.synthetic import synthetic_focal
from biresnerf.errors import Interrupted
from biresnerf.geometry.perturb import perturb_poses
from biresnerf.geometry.pose_error import rotation_angle_deg
from biresnerf.geometry.similarity import align_umeyama
from tests.data.scenes import textured_arc

pytest.importorskip("pycolmap", reason="needs pycolmap (pip install 'biresnerf[colmap]')")
VIEWS, SIZE = 10, 200


def with_poses(dataset: Dataset, poses: np.ndarray) -> Dataset:
    frames = tuple(replace(f, world_from_cam=p) for f, p in zip(dataset.frames, poses, strict=True))
    return replace(dataset, frames=frames)


def errors_deg(found: np.ndarray, truth: np.ndarray) -> np.ndarray:
    aligned = align_umeyama(found, truth).apply_to_poses(found)
    return rotation_angle_deg(np.swapaxes(aligned[:, :3, :3], 1, 2) @ truth[:, :3, :3])


@pytest.fixture(scope="module")
def truth(tmp_path_factory) -> Dataset:
    folder = tmp_path_factory.mktemp("arc")
    poses = textured_arc(folder, VIEWS, SIZE)
    camera = Camera("SIMPLE_PINHOLE", SIZE, SIZE, (synthetic_focal(SIZE), SIZE / 2, SIZE / 2))
    frames = tuple(
        Frame(path.name, path, 0, pose, "given")
        for path, pose in zip(sorted(folder.iterdir()), poses, strict=True)
    )
    return Dataset(folder, (camera,), frames, SourceFormat("nerfstudio", None, {}, np.eye(4)))


@pytest.fixture(scope="module")
def noisy(truth) -> Dataset:
    return with_poses(truth, perturb_poses(truth.world_from_cam, 0.1, seed=2))


@pytest.fixture(scope="module")
def found(noisy) -> list[match_poses.MatchedPoses]:
    return poses_from_matches(noisy)


def test_matches_bring_noisy_poses_near_the_truth(found, noisy, truth):
    best = found[0]
    before = errors_deg(noisy.world_from_cam[best.placed], truth.world_from_cam[best.placed])
    after = errors_deg(best.world_from_cam[best.placed], truth.world_from_cam[best.placed])
    assert before.mean() > 5
    assert np.median(after) < 0.15 * np.median(before)


def test_the_result_lies_in_the_frame_of_the_given_poses(found, noisy):
    best = found[0]
    between = align_umeyama(best.world_from_cam, noisy.world_from_cam)
    assert between.scale == pytest.approx(1, abs=0.1)
    assert rotation_angle_deg(between.rotation[None])[0] < 15


def test_the_same_request_gives_the_same_poses(found, noisy):
    again = poses_from_matches(noisy)
    assert [m.mapper for m in again] == [m.mapper for m in found]
    for one, other in zip(found, again, strict=True):
        np.testing.assert_array_equal(one.world_from_cam, other.world_from_cam)


def test_a_camera_that_strays_alone_is_not_believed(noisy, truth):
    names = list(noisy.file_names)
    cam_from_world = np.linalg.inv(truth.world_from_cam)
    cam_from_world[3, :3, :3] = np.diag([-1.0, 1, -1]) @ cam_from_world[3, :3, :3]
    images = [
        {"name": name, "cam_from_world": pose[:3].tolist()}
        for name, pose in zip(names, cam_from_world, strict=True)
    ]
    model = {"mapper": "global", "images": images, "points": 100}
    carried = match_poses._carried(model, names, noisy.world_from_cam)
    assert carried is not None
    assert np.flatnonzero(~carried.placed).tolist() == [3]
    np.testing.assert_array_equal(carried.world_from_cam[3], noisy.world_from_cam[3])


def test_a_model_with_many_strays_is_not_offered(noisy, truth):
    names = list(noisy.file_names)
    cam_from_world = np.linalg.inv(truth.world_from_cam)
    for i in (1, 4, 8):
        cam_from_world[i, :3, :3] = np.diag([-1.0, 1, -1]) @ cam_from_world[i, :3, :3]
    images = [
        {"name": name, "cam_from_world": pose[:3].tolist()}
        for name, pose in zip(names, cam_from_world, strict=True)
    ]
    model = {"mapper": "global", "images": images, "points": 100}
    assert match_poses._carried(model, names, noisy.world_from_cam) is None


def test_images_that_matches_do_not_place_keep_their_given_pose(found, noisy):
    for matched in found:
        kept = ~matched.placed
        np.testing.assert_array_equal(matched.world_from_cam[kept], noisy.world_from_cam[kept])


def test_models_of_too_few_images_are_not_offered(found):
    for matched in found:
        assert matched.placed.sum() >= 0.6 * VIEWS


def test_pictures_without_texture_give_no_poses(noisy, tmp_path):
    from PIL import Image

    frames = []
    for i, frame in enumerate(noisy.frames):
        path = tmp_path / f"{i}.png"
        Image.new("RGB", (160, 160), (90, 90, 90)).save(path)
        frames.append(replace(frame, path=path, name=path.name))
    assert poses_from_matches(replace(noisy, root=tmp_path, frames=tuple(frames))) == []


def test_many_images_are_matched_with_those_that_see_nearly_the_same(monkeypatch):
    monkeypatch.setattr(match_poses, "NEIGHBOURS", 2)
    turn = np.linspace(0, 2 * np.pi, 8, endpoint=False)
    poses = np.tile(np.eye(4), (8, 1, 1))
    for pose, angle in zip(poses, turn, strict=True):
        forward = -np.array([np.cos(angle), 0, np.sin(angle)])
        down = np.array([0.0, 1, 0])
        pose[:3, :3] = np.stack([np.cross(down, forward), down, forward], 1)
        pose[:3, 3] = -4 * forward
    pairs = match_poses._pairs([str(i) for i in range(8)], poses)
    ring = {tuple(sorted((i, (i + 1) % 8))) for i in range(8)}
    assert {(int(a), int(b)) for a, b in pairs} == ring


def test_matching_stops_when_asked(noisy):
    with pytest.raises(Interrupted):
        poses_from_matches(noisy, should_stop=lambda: True)


def test_the_request_is_plain_json(monkeypatch, noisy, tmp_path):
    """What crosses to the child process holds no arrays: a set of several cameras is listed camera by camera."""
    asked = {}

    def keep(request, work, should_stop, limit_s):
        asked.update(json.loads(json.dumps(request)))
        return {"models": []}

    monkeypatch.setattr(match_poses, "run_colmap", keep)
    first, second = (
        noisy.cameras[0],
        replace(noisy.cameras[0], params=(150.0, 80.0, 80.0), model="SIMPLE_PINHOLE"),
    )
    frames = tuple(replace(f, camera=i % 2) for i, f in enumerate(noisy.frames))
    assert poses_from_matches(replace(noisy, cameras=(first, second), frames=frames)) == []
    assert [len(camera["names"]) for camera in asked["cameras"]] == [VIEWS // 2, VIEWS // 2]
    assert asked["cameras"][1]["params"] == [150.0, 80.0, 80.0]


def test_names_with_spaces_are_matched_when_pairs_are_listed(monkeypatch, noisy, tmp_path):
    monkeypatch.setattr(match_poses, "ALL_PAIRS_UP_TO", 3)
    frames = []
    for i, frame in enumerate(noisy.frames):
        path = tmp_path / f"my photo {i:02}.png"
        path.write_bytes(frame.path.read_bytes())
        frames.append(replace(frame, path=path, name=path.name))
    (matched, *_) = poses_from_matches(replace(noisy, root=tmp_path, frames=tuple(frames)))
    assert matched.placed.all()
