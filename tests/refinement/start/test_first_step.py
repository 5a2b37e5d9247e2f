"""Whether memory suffices to adjust all cameras is checked before anything is trained."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from biresnerf.data.points.tracks import Tracks
from biresnerf.errors import InputError
from biresnerf.refinement.optimise.methods import find_method
from biresnerf.refinement.start.first_step import adjusts_cameras, memory_needed
from tests.refinement.tiny_scene import given_scene, tiny_set

METHOD = find_method("biresnerf")
MANY = 30_000


def many_cameras(folder: Path, seen_by: int):
    """A scene of many cameras; points are seen by so many that follow each other."""
    scene = given_scene(*tiny_set(folder))
    frames = scene.dataset.frames
    names = [f"{number:05}.png" for number in range(MANY)]
    dataset = replace(
        scene.dataset,
        frames=tuple(replace(frames[i % len(frames)], name=name) for i, name in enumerate(names)),
    )
    points = MANY // seen_by
    image = np.arange(points * seen_by)
    tracks = Tracks.of(image // seen_by, image, np.zeros((len(image), 2)))
    return replace(scene, dataset=dataset, tracks=tracks)


def test_cameras_that_all_see_the_same_are_refused_where_memory_is_too_small(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"Adjusting 30000 cameras takes .* GiB of memory") as refused:
        memory_needed(many_cameras(tmp_path, MANY), METHOD)
    assert refused.value.code == "memory_too_small"
    assert "parts" in refused.value.hint


def test_as_many_that_see_what_is_near_them_are_adjusted(tmp_path: Path) -> None:
    scene = many_cameras(tmp_path, 10)
    assert adjusts_cameras(scene.dataset, METHOD)
    assert memory_needed(scene, METHOD) == ""


def test_methods_that_adjust_nothing_need_no_memory_for_it(tmp_path: Path) -> None:
    assert memory_needed(many_cameras(tmp_path, MANY), find_method("baa-ngp")) == ""


def test_what_takes_much_is_said(tmp_path: Path) -> None:
    assert memory_needed(many_cameras(tmp_path, 100), METHOD).endswith(" GiB")
