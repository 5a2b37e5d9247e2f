"""Guesses for images without pose: from the path that names tell, from shared features, from likeness."""

from __future__ import annotations

import numpy as np
import pytest
from PIL import Image

from biresnerf.data.model.dataset import Dataset, Frame, SourceFormat
from biresnerf.data.model.image_order import natural_order, taken_along_a_path
from biresnerf.data.photos.alike.image_likeness import unlikeness
from biresnerf.data.seeding.missing_poses import guess_missing
from biresnerf.geometry.camera.camera_models import Camera
from biresnerf.geometry.pose_error import rotation_between_deg
from tests.data.scenes import arc_poses, textured_arc, write_image

VIEWS = 12


def nobody_asked() -> np.ndarray:
    raise AssertionError("photos need not be looked at")


def guess(poses: np.ndarray, missing: list[int], names=None, matches=(), unlike=nobody_asked):
    known = np.ones(len(poses), dtype=bool)
    known[missing] = False
    found = poses.copy()
    found[missing] = np.eye(4)
    names = names or [f"IMG_{i + 98}.jpg" for i in range(len(poses))]
    sources = guess_missing(found, known, names, np.array(matches, np.int64).reshape(-1, 3), unlike)
    np.testing.assert_array_equal(found[known], poses[known])
    return found, sources


def test_names_are_ordered_by_their_numbers():
    names = ["b/2.png", "a/10.png", "a/9.png", "b/1.png", "a/9b.png"]
    assert [names[i] for i in natural_order(names)] == [
        "a/9.png",
        "a/9b.png",
        "a/10.png",
        "b/1.png",
        "b/2.png",
    ]


def test_an_arc_is_a_path_and_shuffled_it_is_none():
    poses = arc_poses(VIEWS)
    assert taken_along_a_path(poses)
    assert not taken_along_a_path(poses[np.random.default_rng(0).permutation(VIEWS)])


def test_between_neighbours_by_name_the_pose_is_near_the_truth():
    poses = arc_poses(VIEWS)
    found, sources = guess(poses, [4, 7, 8])  # IMG_99 comes before IMG_100
    assert [sources[i] for i in (4, 7, 8)] == ["neighbours"] * 3
    assert rotation_between_deg(found, poses).max() < 0.5
    assert all(source is None for i, source in enumerate(sources) if i not in (4, 7, 8))


def test_beyond_the_end_of_a_path_the_last_pose_is_taken():
    poses = arc_poses(VIEWS)
    found, sources = guess(poses, [0, 11])
    np.testing.assert_array_equal(found[0], poses[1])
    np.testing.assert_array_equal(found[11], poses[10])
    assert sources[0] == sources[11] == "neighbours"


def test_without_a_path_the_image_with_most_features_in_common_lends_its_pose():
    order = np.random.default_rng(0).permutation(VIEWS)
    poses = arc_poses(VIEWS)[order]
    matches = [(3, 5, 20), (3, 6, 90), (9, 3, 40)]
    nothing_alike = 1 - np.eye(VIEWS)
    found, sources = guess(
        poses,
        [3, 6],
        matches=matches,
        unlike=lambda: lambda some, others: nothing_alike[np.ix_(some, others)],
    )
    np.testing.assert_array_equal(found[3], poses[9])  # 6 has no pose itself
    assert sources[3] == "nearest-view"


def test_without_features_the_photo_that_looks_most_alike_lends_its_pose(tmp_path):
    order = np.random.default_rng(3).permutation(VIEWS)
    poses = textured_arc(tmp_path / "arc", VIEWS, 64)[order]
    paths = [tmp_path / "arc" / f"{i:02}.png" for i in order]
    frames = tuple(Frame(p.name, p, 0, None, None) for p in paths)
    camera = Camera("SIMPLE_PINHOLE", 64, 64, (64.0, 32.0, 32.0))
    dataset = Dataset(tmp_path, (camera,), frames, SourceFormat("images", None, {}, np.eye(4)))
    found, sources = guess(poses, [2, 8], unlike=lambda: unlikeness(dataset))
    assert sources[2] == sources[8] == "nearest-view"
    assert rotation_between_deg(found, poses)[[2, 8]].max() < 17  # neighbours on the arc are 8 degrees apart


def test_likeness_is_one_with_itself_and_nothing_for_a_blank_photo(tmp_path):
    write_image(tmp_path / "a.png", 1, (96, 72))
    Image.open(tmp_path / "a.png").resize((48, 36), Image.Resampling.BOX).save(tmp_path / "b.png")
    Image.new("RGB", (96, 72), (90, 90, 90)).save(tmp_path / "c.png")
    write_image(tmp_path / "d.png", 2, (10, 8))  # smaller than what photos are shrunk to
    Image.fromarray(np.asarray(Image.open(tmp_path / "a.png").convert("L")).astype(np.uint16) * 257).save(
        tmp_path / "e.png"
    )
    frames = tuple(Frame(f"{n}.png", tmp_path / f"{n}.png", 0, None, None) for n in "abcde")
    camera = Camera("SIMPLE_PINHOLE", 96, 72, (60.0, 48.0, 36.0))
    unlike = unlikeness(Dataset(tmp_path, (camera,), frames, SourceFormat("images", None, {}, np.eye(4))))
    alike = 1 - unlike(np.arange(5), np.arange(5))
    np.testing.assert_allclose(np.diag(alike), 1, atol=1e-6)
    assert alike[0, 1] > 0.9
    assert alike[0, 4] > 0.999  # the same in 16 bit
    np.testing.assert_array_equal(alike[2, [0, 1, 3, 4]], 0)


def test_without_any_pose_there_is_nothing_to_guess_from():
    with pytest.raises(ValueError, match="no pose"):
        guess(arc_poses(3), [0, 1, 2])
