"""Poses found by COLMAP: against the truth of the synthetic scene, and every way it can end without them."""

from __future__ import annotations

import importlib.util
import shutil
import time
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from biresnerf.data import colmap_process
from biresnerf.data.read import read_dataset
from biresnerf.data.seed_colmap import seed_poses
from biresnerf.data.synthetic import synthetic_focal
from biresnerf.data.write import write_transforms
from biresnerf.errors import InputError, Interrupted, RefinementError
from biresnerf.geometry.pose_error import pose_error
from tests.data.scenes import arc_poses, assert_complete, textured_arc, write_image

needs_colmap = pytest.mark.skipif(
    importlib.util.find_spec("pycolmap") is None, reason="pycolmap is not installed (extra: colmap)"
)
VIEWS, SIZE = 10, 320


def seeded(folder, **how):
    """What a folder of images becomes once COLMAP has placed them."""
    return seed_poses(read_dataset(folder), **how)


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
def test_poses_and_focal_length_are_found_and_a_stranger_is_left_out_by_name(folder):
    write_image(folder / "images/stranger 1.png", seed=9, size=(SIZE, SIZE))
    dataset = seeded(folder)
    assert dataset.names == tuple(f"images/{i:02}.png" for i in range(VIEWS))
    assert {frame.pose_source for frame in dataset.frames} == {"colmap"}
    assert dataset.source.dialect == "images"
    assert len(dataset.cameras) == 1
    assert dataset.cameras[0].full().fx == pytest.approx(synthetic_focal(SIZE), rel=0.1)
    assert any("images/stranger 1.png" in text and "1 of 11" in text for text in dataset.warnings)
    error = pose_error(dataset.world_from_cam, arc_poses(VIEWS))
    # A short arc of smooth textures leaves the focal length loose, and the rotations with it.
    assert error.aligned.rotation_deg.max < 3.0
    assert error.aligned.centre_percent.max < 2.0

    write_transforms(dataset, dataset.world_from_cam, folder / "transforms.json")
    again = read_dataset(folder)
    assert again.names == dataset.names
    np.testing.assert_allclose(again.world_from_cam, dataset.world_from_cam, atol=1e-12)
    assert again.cameras[0].full() == dataset.cameras[0].full()


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
    assert_complete(caught.value, "seed_failed", tmp_path.name)
    assert "0 of 4" in caught.value.what


@needs_colmap
def test_a_wish_to_stop_ends_the_child_at_once(folder):
    began = time.monotonic()
    with pytest.raises(Interrupted):
        seeded(folder, should_stop=lambda: time.monotonic() > began + 0.5)


@needs_colmap
def test_the_time_limit_ends_the_child(folder):
    with pytest.raises(InputError) as caught:
        seeded(folder, limit_s=0.3)
    assert_complete(caught.value, "seed_timeout", folder.name)


@needs_colmap
def test_a_crash_of_colmap_is_told_with_its_last_words(folder, monkeypatch, tmp_path):
    broken = tmp_path / "colmap_child.py"
    broken.write_text("import os, sys; print('out of luck', file=sys.stderr, flush=True); os.abort()")
    monkeypatch.setattr(colmap_process, "CHILD", broken)
    with pytest.raises(RefinementError, match="out of luck") as caught:
        seeded(folder)
    assert caught.value.code == "seeding_crashed"


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
    monkeypatch.setattr(colmap_process, "CHILD", tmp_path / "no_such_program.py")
    again = seeded(folder, remember=kept)
    assert np.array_equal(again.world_from_cam, first.world_from_cam)
    assert again.cameras == first.cameras
    write_image(folder / "images/00.png", size=(SIZE, SIZE))
    with pytest.raises(RefinementError):  # COLMAP is asked anew
        seeded(folder, remember=kept)
