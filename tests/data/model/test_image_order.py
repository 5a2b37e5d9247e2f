"""Poses that belong to photos by order alone: numbers in names compare as numbers unless the path shows otherwise."""

from __future__ import annotations

import numpy as np
import pytest

from biresnerf.data.model.image_order import names_of_poses, natural_order

NAMES = [f"frame_{number}.jpg" for number in range(12)]


def along_a_line(count: int = 12) -> list[np.ndarray]:
    """Poses [4, 4] of a camera that moves on in even steps."""
    poses = [np.eye(4) for _ in range(count)]
    for index, pose in enumerate(poses):
        pose[0, 3] = index
    return poses


def test_numbers_in_names_compare_as_numbers():
    names = ["b2.png", "b10.png", "a/10.png", "a/9.png", "b2a.png"]
    assert [names[i] for i in natural_order(names)] == ["a/9.png", "a/10.png", "b2.png", "b2a.png", "b10.png"]


@pytest.mark.parametrize("as_text", [False, True])
def test_the_order_along_which_the_cameras_path_is_short_is_taken(as_text):
    poses = along_a_line()
    assert names_of_poses(sorted(NAMES), poses, as_text=as_text)[0] == NAMES
    # A program that sorts names as text writes the pose of frame_10 behind that of frame_1.
    listed = sorted(NAMES)
    found, note = names_of_poses(NAMES, [poses[NAMES.index(name)] for name in listed], as_text=as_text)
    assert found == listed
    assert "as text (frame_10.jpg before frame_2.jpg); the cameras' path shows it" in note


@pytest.mark.parametrize("as_text", [False, True])
def test_where_the_path_shows_no_order_the_formats_own_is_taken_and_said(as_text):
    poses = along_a_line()
    shuffled = [poses[i] for i in np.random.default_rng(3).permutation(12)]
    found, note = names_of_poses(NAMES, shuffled, as_text=as_text)
    assert found == (sorted(NAMES) if as_text else NAMES)
    assert "do not show which order is meant" in note


def test_names_with_one_order_get_no_note():
    names = [f"{number:03}.png" for number in range(12)]
    assert names_of_poses(names, along_a_line()) == (names, "")
