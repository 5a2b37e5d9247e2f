"""Poses found by COLMAP: against the truth of the synthetic scene, and every way it can end without them."""

from __future__ import annotations

import importlib.util
import shutil
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from biresnerf.data.formats.read_dataset import read_dataset
from biresnerf.data.formats.transforms.write_transforms import write_transforms
from biresnerf.data.model.dataset import Dataset
from biresnerf.data.seeding import colmap_process
from biresnerf.data.seeding.map_images import ask_colmap
from biresnerf.data.seeding.seed_poses import seed_poses
from biresnerf.data.synthetic.camera_photos import MAKERS, stored_poses
from biresnerf.data.synthetic.scene import synthetic_focal
from biresnerf.errors import InputError, Interrupted, RefinementError
from biresnerf.geometry.camera.camera_models import Camera
from biresnerf.geometry.perturb import perturb_poses
from biresnerf.geometry.pose_error import pose_error, rotation_between_deg
from tests.data.photos.geotagged import write_geotagged
from tests.data.scenes import arc_poses, assert_complete, plain_features, textured_arc, write_image

pytestmark = pytest.mark.slow

needs_colmap = pytest.mark.skipif(
    importlib.util.find_spec("pycolmap") is None, reason="pycolmap is not installed (extra: colmap)"
)
VIEWS, SIZE = 10, 320


def with_poses(folder: Path, poses: np.ndarray) -> Dataset:
    """The photos with these poses and their true intrinsics, both given."""
    bare = read_dataset(folder)
    camera = Camera("SIMPLE_PINHOLE", SIZE, SIZE, (synthetic_focal(SIZE), SIZE / 2, SIZE / 2))
    frames = tuple(
        replace(f, world_from_cam=p, pose_source="given") for f, p in zip(bare.frames, poses, strict=True)
    )
    return replace(bare, cameras=(camera,), frames=frames, intrinsics_sources=())


def without(dataset: Dataset, *missing: int) -> Dataset:
    """The set with the poses of some frames taken away."""
    frames = (
        replace(f, world_from_cam=None, pose_source=None) if i in missing else f
        for i, f in enumerate(dataset.frames)
    )
    return replace(dataset, frames=tuple(frames))


def seeded(folder, **how):
    """What a folder of images becomes once COLMAP has placed them."""
    return seed_poses(read_dataset(folder), **how).dataset


@pytest.fixture(scope="module", autouse=True)
def quick():
    with plain_features():
        yield


@pytest.fixture(scope="module")
def photos(tmp_path_factory):
    """A folder with images/00.png ... of the arc."""
    folder = tmp_path_factory.mktemp("photos")
    textured_arc(folder / "images", VIEWS, SIZE)
    return folder


@pytest.fixture
def folder(photos, tmp_path):
    shutil.copytree(photos / "images", tmp_path / "images")
    return tmp_path


@needs_colmap
def test_poses_and_focal_length_are_found_and_a_stranger_is_guessed_by_name(folder):
    write_image(folder / "images/stranger 1.png", seed=9, size=(SIZE, SIZE))
    dataset = seeded(folder)
    assert dataset.names == (*(f"images/{i:02}.png" for i in range(VIEWS)), "images/stranger 1.png")
    assert [frame.pose_source for frame in dataset.frames] == ["colmap"] * VIEWS + ["neighbours"]
    assert dataset.source.dialect == "images"
    assert len(dataset.cameras) == 1
    assert dataset.intrinsics_sources == ("colmap",)
    assert dataset.cameras[0].full().fx == pytest.approx(synthetic_focal(SIZE), rel=0.1)
    assert any("images/stranger 1.png" in text and "1 of 11" in text for text in dataset.warnings)
    error = pose_error(dataset.world_from_cam[:VIEWS], arc_poses(VIEWS))
    # A short arc of smooth textures leaves the focal length loose, and the rotations with it.
    assert error.aligned.rotation_deg.max < 3.0
    assert error.aligned.centre_percent.max < 2.0

    write_transforms(dataset, dataset.world_from_cam, folder / "transforms.json")
    again = read_dataset(folder)
    assert again.names == dataset.names
    np.testing.assert_allclose(again.world_from_cam, dataset.world_from_cam, atol=1e-12)
    assert again.cameras[0].full() == dataset.cameras[0].full()


@needs_colmap
def test_photos_with_gps_give_poses_in_metres_on_earth(photos, tmp_path):
    (tmp_path / "images").mkdir()
    poses = arc_poses(VIEWS)
    for i, (east, north, up) in enumerate(10 * poses[:, :3, 3]):
        place = (north / 110_574.0, 20 + east / 111_320.0, 50 + up)  # metres of a degree at the equator
        picture = Image.open(photos / f"images/{i:02}.png")
        write_geotagged(tmp_path / f"images/{i:02}.jpg", place, picture)
    seeding = seed_poses(read_dataset(tmp_path))
    found = seeding.dataset.world_from_cam
    apart = found[1:, :3, 3] - found[0, :3, 3] - 10 * (poses[1:, :3, 3] - poses[0, :3, 3])
    assert np.linalg.norm(apart, axis=1).max() < 0.5


@needs_colmap
def test_images_of_two_sizes_get_cameras_of_their_own(folder):
    for index in range(0, VIEWS, 2):
        path = folder / f"images/{index:02}.png"
        Image.open(path).resize((SIZE * 3 // 4, SIZE * 3 // 4), Image.Resampling.LANCZOS).save(path)
    dataset = seeded(folder)
    sizes = [dataset.camera_of(index).width for index in range(len(dataset))]
    assert set(sizes) == {SIZE, SIZE * 3 // 4}
    assert len(dataset.cameras) >= 2
    for index, frame in enumerate(dataset.frames):
        assert Image.open(frame.path).width == sizes[index]


@needs_colmap
def test_images_that_show_nothing_in_common_are_refused_with_counts(tmp_path):
    for index in range(4):
        write_image(tmp_path / f"{index}.png", index, size=(64, 48))
    with pytest.raises(InputError) as caught:
        seeded(tmp_path)
    assert_complete(caught.value, "insufficient_overlap", tmp_path.name)
    assert "0 of 4" in caught.value.detail
    with pytest.raises(InputError) as caught:
        seeded(tmp_path, start="colmap")
    assert_complete(caught.value, "seed_failed", tmp_path.name)


@needs_colmap
def test_photos_too_smooth_for_features_but_alike_face_forward(tmp_path):
    rows, columns = np.mgrid[0:48, 0:64]
    for index in range(4):
        wave = np.sin((columns + 2 * index) / 20) * np.cos(rows / 17)
        grey = np.repeat(np.uint8(127 + 90 * wave)[..., None], 3, axis=2)
        Image.fromarray(grey).save(tmp_path / f"{index}.png")
    found = seed_poses(read_dataset(tmp_path))
    assert [c.source for c in found.candidates] == ["forward-facing"]
    assert any("without features" in text for text in found.dataset.warnings)


@needs_colmap
def test_a_wish_to_stop_ends_the_child_at_once(folder):
    began = time.monotonic()
    with pytest.raises(Interrupted):
        seeded(folder, should_stop=lambda: time.monotonic() > began + 0.5)


@needs_colmap
def test_the_time_limit_ends_the_child(folder):
    with pytest.raises(InputError) as caught:
        seeded(folder, ask=lambda dataset, **how: ask_colmap(dataset, **{**how, "limit_s": 0.3}))
    assert_complete(caught.value, "seed_timeout", folder.name)


@needs_colmap
@pytest.mark.parametrize(
    ("how", "said"), [("abort()", "fault of the program"), ("kill(os.getpid(), 9)", "memory")]
)
def test_a_crash_of_colmap_is_told_in_words_and_its_own_go_to_the_log(
    folder, monkeypatch, tmp_path, caplog, how, said
):
    broken = tmp_path / "colmap_child.py"
    broken.write_text(
        f"import os, sys; print('{tmp_path}: out of luck', file=sys.stderr, flush=True); os.{how}"
    )
    monkeypatch.setattr(colmap_process, "CHILD", broken)
    caplog.set_level("INFO", logger=colmap_process.__name__)
    with pytest.raises(RefinementError) as caught:
        seeded(folder)
    assert caught.value.code == "seeding_crashed"
    assert said in caught.value.detail
    assert caught.value.hint
    assert "out of luck" not in str(caught.value)
    assert "out of luck" in caplog.text


def test_without_colmap_the_extra_is_named(folder, monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(InputError, match=r"pip install 'biresnerf\[colmap\]'") as caught:
        seeded(folder)
    assert_complete(caught.value, "colmap_missing", folder.name)


@needs_colmap
def test_linked_images_in_the_working_directory_keep_their_names(photos, tmp_path, monkeypatch):
    for index in range(4):
        (tmp_path / f"linked {index}.png").symlink_to(photos / f"images/{index:02}.png")
    monkeypatch.chdir(tmp_path)
    assert seeded(Path(".")).file_names == tuple(f"linked {index}.png" for index in range(4))


def test_two_images_are_too_few_and_broken_ones_are_named_before_colmap_runs(tmp_path):
    for index in range(2):
        write_image(tmp_path / f"{index}.png", index)
    with pytest.raises(InputError) as caught:
        seeded(tmp_path)
    assert_complete(caught.value, "too_few_images", tmp_path.name)
    (tmp_path / "2.png").write_bytes(b"no image")
    with pytest.raises(InputError) as caught:
        seeded(tmp_path)
    assert_complete(caught.value, "not_an_image", "2.png")


@needs_colmap
def test_a_continued_run_is_given_the_same_poses_until_an_image_changes(folder, tmp_path, monkeypatch):
    kept = tmp_path / "kept" / "seeding.json"
    first = seeded(folder, remember=kept)
    assert "Feature extraction" in (kept.parent / "colmap.log").read_text("utf-8")
    monkeypatch.setattr(colmap_process, "CHILD", tmp_path / "no_such_program.py")
    again = seeded(folder, remember=kept)
    assert np.array_equal(again.world_from_cam, first.world_from_cam)
    assert again.cameras == first.cameras
    write_image(folder / "images/00.png", size=(SIZE, SIZE))
    with pytest.raises(RefinementError):  # COLMAP is asked anew
        seeded(folder, remember=kept)


@needs_colmap
def test_known_intrinsics_are_kept_and_given_poses_only_say_what_the_frame_is(folder):
    truth = with_poses(folder, arc_poses(VIEWS))
    wrong = perturb_poses(arc_poses(VIEWS), 0.02, seed=4)
    noisy = replace(
        truth, frames=tuple(replace(f, world_from_cam=p) for f, p in zip(truth.frames, wrong, strict=True))
    )
    found = seed_poses(noisy, "colmap")
    assert found.dataset.cameras == truth.cameras
    np.testing.assert_array_equal(found.dataset.world_from_cam, wrong)  # what the result is measured against
    poses = found.candidates[0].world_from_cam
    assert set(found.candidates[0].sources) == {"colmap"}
    assert rotation_between_deg(poses, arc_poses(VIEWS)).max() < 3  # in the given frame, to within its noise
    assert pose_error(poses, arc_poses(VIEWS)).aligned.rotation_deg.max < 3.0


def test_given_poses_are_taken_as_they_are_and_missing_ones_refused_by_name(folder):
    truth = with_poses(folder, arc_poses(VIEWS))
    (candidate,) = seed_poses(truth, "given").candidates
    np.testing.assert_array_equal(candidate.world_from_cam, arc_poses(VIEWS))
    assert set(candidate.sources) == {"given"}
    with pytest.raises(InputError) as caught:
        seed_poses(without(truth, 3), "given")
    assert_complete(caught.value, "pose_missing", folder.name)
    assert "03.png" in caught.value.detail
    assert "start=auto" in caught.value.hint


def test_without_features_missing_poses_come_from_neighbours_and_all_missing_ones_face_forward(folder):
    truth = with_poses(folder, arc_poses(VIEWS))
    found = seed_poses(without(truth, 3, 7), "none")
    assert [f.pose_source for f in found.dataset.frames].count("neighbours") == 2
    assert rotation_between_deg(found.dataset.world_from_cam, arc_poses(VIEWS)).max() < 0.5
    (candidate,) = seed_poses(without(truth, *range(VIEWS)), "none").candidates
    assert set(candidate.sources) == {"forward-facing"}
    np.testing.assert_array_equal(candidate.world_from_cam, np.tile(np.eye(4), (VIEWS, 1, 1)))


def test_photos_of_a_camera_held_both_ways_begin_upright_side_by_side(tmp_path):
    textured_arc(tmp_path, 4, 48, MAKERS["android"])
    (candidate,) = seed_poses(read_dataset(tmp_path), "none").candidates
    upright = np.tile(np.eye(4), (4, 1, 1))
    np.testing.assert_array_equal(candidate.world_from_cam, stored_poses(upright, MAKERS["android"]))


def test_without_colmap_given_poses_are_completed_and_the_user_is_told(folder, monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    dataset = seed_poses(without(with_poses(folder, arc_poses(VIEWS)), 5)).dataset
    assert dataset.frames[5].pose_source == "neighbours"
    assert any("not installed" in text for text in dataset.warnings)
    assert any("05.png (neighbours)" in text for text in dataset.warnings)
