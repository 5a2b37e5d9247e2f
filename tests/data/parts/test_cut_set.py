"""A set is cut into parts of photos that see the same, each small enough, and overlapping its neighbours."""

from __future__ import annotations

import json
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from biresnerf.data.formats.read_dataset import read_dataset
from biresnerf.data.model.dataset import Dataset
from biresnerf.data.parts.cut_set import SHARED, cut_set
from biresnerf.errors import InputError
from tests.data.scenes import HEIGHT, WIDTH, write_image

COUNT, PHOTOS = 160, 50


@pytest.fixture(scope="module")
def corridor(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    """Photos along a line, a unit apart, looking ahead; their names are not in this order."""
    folder = tmp_path_factory.mktemp("corridor")
    write_image(folder / "photo.png")
    frames = []
    for index, place in enumerate(np.random.default_rng(1).permutation(COUNT).tolist()):
        (folder / f"{index:03}.png").hardlink_to(folder / "photo.png")
        pose = np.eye(4)
        pose[0, 3] = place
        frames.append({"file_path": f"{index:03}.png", "transform_matrix": pose.tolist()})
    (folder / "photo.png").unlink()
    lens = {"w": WIDTH, "h": HEIGHT, "fl_x": 18.0, "fl_y": 18.0, "cx": 10.0, "cy": 8.0}
    (folder / "transforms.json").write_text(json.dumps({**lens, "frames": frames}), "utf-8")
    return read_dataset(folder)


def test_parts_of_a_corridor_are_its_stretches_and_overlap_at_their_ends(corridor: Dataset) -> None:
    places = corridor.world_from_cam[:, 0, 3]
    parts = sorted(cut_set(corridor, PHOTOS), key=lambda rows: float(places[rows].mean()))
    assert len(parts) == 4
    assert set(np.concatenate(parts).tolist()) == set(range(COUNT))
    for rows in parts:
        assert len(rows) <= 1.1 * PHOTOS
        assert np.ptp(places[rows]) == len(rows) - 1, "no gap"
    for one, other in pairwise(parts):
        # An end of the corridor has one neighbour, which it shares twice as many photos with.
        assert len(np.intersect1d(one, other)) >= SHARED * PHOTOS / 2
    assert not len(np.intersect1d(parts[0], parts[2]))


def test_the_same_set_is_cut_in_the_same_way_again(corridor: Dataset) -> None:
    for one, other in zip(cut_set(corridor, PHOTOS), cut_set(corridor, PHOTOS), strict=True):
        np.testing.assert_array_equal(one, other)


def test_a_small_set_stays_whole_and_too_small_parts_are_refused(corridor: Dataset) -> None:
    (whole,) = cut_set(corridor, COUNT)
    np.testing.assert_array_equal(whole, np.arange(COUNT))
    with pytest.raises(InputError) as caught:
        cut_set(corridor, 5)
    assert (caught.value.code, caught.value.where) == ("invalid_options", "most")
    assert caught.value.hint


def test_photos_without_poses_are_cut_by_looks_and_names(tmp_path: Path) -> None:
    for index in range(60):
        write_image(tmp_path / f"{index:03}.png", seed=index // 20)
    parts = sorted(cut_set(read_dataset(tmp_path), 25), key=lambda rows: int(rows[0]))
    assert set(np.concatenate(parts).tolist()) == set(range(60))
    shared = sum(len(rows) for rows in parts) - 60
    assert 0 < shared < 60
