"""COLMAP guided by given poses, on rendered scenes whose true poses are known."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from biresnerf.data.model.dataset import Dataset, Frame, SourceFormat
from biresnerf.data.seeding import cached_mapping as remembered_mapping
from biresnerf.data.seeding import map_images
from biresnerf.data.seeding.initial_poses import InitialPoses
from biresnerf.data.seeding.seed_poses import Seeding, seed_poses
from biresnerf.data.synthetic.camera_photos import MAKERS
from biresnerf.data.synthetic.scene import synthetic_focal
from biresnerf.errors import FAULTS_RAISE, Interrupted, RefinementError
from biresnerf.geometry.camera.camera_models import Camera
from biresnerf.geometry.perturb import perturb_poses
from biresnerf.geometry.pose_error import rotation_angle_deg, rotation_between_deg
from biresnerf.geometry.similarity import align_by_spread
from tests.data.photos.geotagged import geotag
from tests.data.scenes import plain_features, textured_arc

pytestmark = pytest.mark.slow

pytest.importorskip("pycolmap", reason="needs pycolmap (pip install 'biresnerf[colmap]')")
VIEWS, SIZE = 10, 200
MISSING, BLANK = (2, 6), 4  # not a photo that its camera turns
ORIENTATION = 0x0112


def with_poses(dataset: Dataset, poses: np.ndarray) -> Dataset:
    frames = tuple(replace(f, world_from_cam=p) for f, p in zip(dataset.frames, poses, strict=True))
    return replace(dataset, frames=frames)


def errors_deg(found: np.ndarray, truth: np.ndarray) -> np.ndarray:
    aligned = align_by_spread(found, truth).apply_to_poses(found)
    return rotation_between_deg(aligned, truth)


@pytest.fixture(scope="module", autouse=True)
def quick():
    with plain_features():
        yield


@pytest.fixture(scope="module")
def truth(tmp_path_factory) -> Dataset:
    folder = tmp_path_factory.mktemp("arc")
    poses = textured_arc(folder, VIEWS, SIZE, MAKERS["android"])
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
def found(noisy) -> Seeding:
    return seed_poses(noisy)


@pytest.fixture(scope="module")
def completed(noisy) -> Seeding:
    """What becomes of the noisy set where two poses are missing and a photo is blank."""
    frames = list(noisy.frames)
    for i in MISSING:
        frames[i] = replace(frames[i], world_from_cam=None, pose_source=None)
    blank = frames[BLANK].path.with_name("blank.jpg")
    Image.new("RGB", (SIZE, SIZE), (90, 90, 90)).save(blank)
    frames[BLANK] = replace(frames[BLANK], path=blank, world_from_cam=None, pose_source=None)
    return seed_poses(replace(noisy, frames=tuple(frames)))


def placed(candidate: InitialPoses) -> np.ndarray:
    return np.array([source.startswith("matches") for source in candidate.sources])


def test_matches_bring_noisy_poses_near_the_truth(found, noisy, truth):
    given, best = found.candidates[:2]
    assert set(given.sources) == {"given"}
    np.testing.assert_array_equal(given.world_from_cam, noisy.world_from_cam)
    at = placed(best)
    before = errors_deg(noisy.world_from_cam[at], truth.world_from_cam[at])
    after = errors_deg(best.world_from_cam[at], truth.world_from_cam[at])
    assert before.mean() > 5
    assert np.median(after) < 0.15 * np.median(before)


def test_the_result_lies_in_the_frame_of_the_given_poses(found, noisy):
    best = found.candidates[1]
    between = align_by_spread(best.world_from_cam, noisy.world_from_cam)
    assert between.scale == pytest.approx(1, abs=0.1)
    assert rotation_angle_deg(between.rotation[None])[0] < 15


def test_the_same_request_gives_the_same_poses(found, noisy):
    again = seed_poses(noisy)
    assert [c.source for c in again.candidates] == [c.source for c in found.candidates]
    for one, other in zip(found.candidates, again.candidates, strict=True):
        np.testing.assert_array_equal(one.world_from_cam, other.world_from_cam)


def test_missing_poses_are_found_by_matches_in_the_frame_of_the_noisy_ones(completed, noisy, truth):
    given, best = completed.candidates[:2]
    for i in MISSING:
        assert given.sources[i].startswith("matches")
        assert best.sources[i].startswith("matches")
    kept = [i for i in range(VIEWS) if i not in (*MISSING, BLANK)]
    np.testing.assert_array_equal(given.world_from_cam[kept], noisy.world_from_cam[kept])
    at = [*kept, *MISSING]
    assert np.median(errors_deg(best.world_from_cam[at], truth.world_from_cam[at])) < 1.0


def test_what_matches_cannot_place_is_guessed_and_said(completed, truth):
    for candidate in completed.candidates:
        assert candidate.sources[BLANK] == "neighbours"
    best = completed.candidates[1]
    assert errors_deg(best.world_from_cam, truth.world_from_cam)[BLANK] < 8  # less than a step of the arc
    assert any("04.jpg (neighbours)" in text for text in completed.dataset.warnings)


def test_pictures_without_texture_give_no_poses(noisy, tmp_path):
    frames = []
    for i, frame in enumerate(noisy.frames):
        path = tmp_path / f"{i}.png"
        Image.new("RGB", (160, 160), (90, 90, 90)).save(path)
        frames.append(replace(frame, path=path, name=path.name))
    (candidate,) = seed_poses(replace(noisy, root=tmp_path, frames=tuple(frames))).candidates
    assert set(candidate.sources) == {"given"}


def test_matching_stops_when_asked(noisy):
    with pytest.raises(Interrupted):
        seed_poses(noisy, should_stop=lambda: True)


def test_the_request_is_plain_json(monkeypatch, noisy, tmp_path):
    """What crosses to the child process holds no arrays: a set of several cameras is listed camera by camera."""
    asked = {}

    def keep(request, *_):
        asked.update(json.loads(json.dumps(request)))
        return {"models": [], "matches": []}

    monkeypatch.setattr(map_images, "run_colmap", keep)
    first, second = (
        noisy.cameras[0],
        replace(noisy.cameras[0], params=(150.0, 80.0, 80.0), model="SIMPLE_PINHOLE"),
    )
    frames = tuple(replace(f, camera=i % 2) for i, f in enumerate(noisy.frames))
    assert len(seed_poses(replace(noisy, cameras=(first, second), frames=frames)).candidates) == 1
    assert [len(camera["names"]) for camera in asked["cameras"]] == [VIEWS // 2, VIEWS // 2]
    assert asked["cameras"][1]["params"] == [150.0, 80.0, 80.0]


def test_names_with_spaces_are_matched_when_pairs_are_listed(monkeypatch, noisy, tmp_path):
    monkeypatch.setattr(map_images, "GUIDED_ALL_PAIRS_UP_TO", 3)
    frames = []
    for i, frame in enumerate(noisy.frames):
        path = tmp_path / f"my photo {i:02}.jpg"
        path.write_bytes(frame.path.read_bytes())
        frames.append(replace(frame, path=path, name=path.name))
    _, matched, *_ = seed_poses(replace(noisy, root=tmp_path, frames=tuple(frames))).candidates
    assert placed(matched).all()


def test_long_sequences_are_matched_along_their_names_and_where_photos_look_alike(truth, monkeypatch):
    monkeypatch.setattr(map_images, "ALL_PAIRS_UP_TO", 3)
    monkeypatch.setattr(map_images, "BY_NAME", 1)
    monkeypatch.setattr(map_images, "BY_LIKENESS", 1)
    frames = [replace(f, world_from_cam=None) for f in truth.frames]
    frames[9] = replace(frames[9], path=frames[0].path)  # the path comes back to where it began
    pairs = map_images._pairs(replace(truth, frames=tuple(frames)), [str(i) for i in range(VIEWS)])
    assert pairs is not None
    assert {(str(i), str(i + 1)) for i in range(VIEWS - 1)} <= set(pairs)
    assert ("0", "9") in pairs
    assert len(pairs) < 2 * VIEWS


def test_a_failure_of_colmap_leaves_the_given_poses_and_a_fault(noisy, monkeypatch, caplog):
    def fail(*_, **__):
        raise RefinementError("seeding_crashed", "COLMAP failed.", hint="Report it.")

    monkeypatch.setattr(remembered_mapping, "ask_colmap", fail)
    with pytest.raises(RefinementError):
        seed_poses(noisy)
    monkeypatch.delenv(FAULTS_RAISE)
    with pytest.raises(RefinementError):
        seed_poses(noisy, "colmap")
    found = seed_poses(noisy)
    assert set(found.candidates[0].sources) == {"given"}
    assert [fault.code for fault in found.dataset.faults] == ["seeding_crashed"]
    assert found.dataset.warnings == noisy.warnings
    assert "COLMAP failed. Report it." in caplog.text


@pytest.mark.parametrize("others", [0, 2])
def test_what_cameras_write_into_photos_does_not_keep_given_poses_from_their_matches(
    found, noisy, tmp_path, others
):
    """Of each photo with an Orientation or a GPS position COLMAP writes a prior of its own."""
    frames = []
    for i, frame in enumerate(noisy.frames):
        path = tmp_path / f"{frame.path.stem}.jpg"
        exif = geotag(48.0 + i, 11.0, 500.0)
        exif[ORIENTATION] = 1
        Image.open(frame.path).save(path, exif=exif, quality=97)
        pose = None if i < others else frame.world_from_cam
        frames.append(replace(frame, path=path, world_from_cam=pose))
    written = seed_poses(replace(noisy, root=tmp_path, frames=tuple(frames)))
    best, bare = written.candidates[1], found.candidates[1]
    assert placed(best).all()
    assert np.median(errors_deg(best.world_from_cam, noisy.world_from_cam)) == pytest.approx(
        np.median(errors_deg(bare.world_from_cam, noisy.world_from_cam)), rel=0.2
    )


def test_more_posed_photos_than_colmap_adjusts_directly_are_matched_and_not_mapped(
    noisy, tmp_path, monkeypatch
):
    monkeypatch.setattr(map_images, "POSED_MAPPED_UP_TO", VIEWS - 1)
    seeding = seed_poses(noisy, remember=tmp_path / "seeding.json")
    assert [candidate.source for candidate in seeding.candidates] == ["given"]
    with np.load(tmp_path / "tracks.npz") as tracks:
        assert len(tracks["point"]) > 100
