"""A search for poses that is killed, or takes too long, loses little of what it has found."""

from __future__ import annotations

import sqlite3
import time
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from biresnerf.data.model.dataset import Dataset, Frame, SourceFormat
from biresnerf.data.points.tracks import KEPT, Tracks
from biresnerf.data.seeding import cached_mapping, colmap_process, map_images, seeding_progress
from biresnerf.data.seeding.seed_poses import seed_poses
from biresnerf.data.synthetic.scene import synthetic_focal
from biresnerf.errors import Interrupted
from biresnerf.geometry.camera.camera_models import Camera
from biresnerf.geometry.perturb import perturb_poses
from tests.data.scenes import plain_features, textured_arc

pytestmark = pytest.mark.slow

pytest.importorskip("pycolmap", reason="needs pycolmap (pip install 'biresnerf[colmap]')")
VIEWS, SIZE = 8, 200
TAKEN_UP = "taken up again"


@pytest.fixture(scope="module", autouse=True)
def quick():
    with plain_features():
        yield


@pytest.fixture(scope="module")
def noisy(tmp_path_factory) -> Dataset:
    """Photos by two cameras in turn: COLMAP is asked for the features of one after the other."""
    folder = tmp_path_factory.mktemp("arc")
    poses = perturb_poses(np.asarray(textured_arc(folder, VIEWS, SIZE)), 0.1, seed=2)
    camera = Camera("SIMPLE_PINHOLE", SIZE, SIZE, (synthetic_focal(SIZE), SIZE / 2, SIZE / 2))
    frames = tuple(
        Frame(path.name, path, i % 2, pose, "given")
        for i, (path, pose) in enumerate(zip(sorted(folder.iterdir()), poses, strict=True))
    )
    return Dataset(folder, (camera, camera), frames, SourceFormat("nerfstudio", None, {}, np.eye(4)))


@pytest.fixture(scope="module")
def undisturbed(noisy) -> np.ndarray:
    return seed_poses(noisy).candidates[-1].world_from_cam


def rows(folder: Path, table: str) -> int:
    """Of the copy in the folder; none where there is none."""
    for path in folder.glob("features-*.db"):
        with closing(sqlite3.connect(path)) as opened:
            return int(opened.execute(f"SELECT COUNT(*) FROM {table}").fetchone()[0])
    return 0


@pytest.mark.parametrize(
    ("table", "count"), [("keypoints", VIEWS // 2), ("keypoints", VIEWS), ("matches", 1)]
)
def test_a_search_that_is_killed_goes_on_from_its_last_copy_to_the_same_poses(
    noisy, undisturbed, tmp_path, monkeypatch, caplog, table, count
):
    monkeypatch.setattr(map_images, "COPY_EVERY_S", 0.0)
    monkeypatch.setattr(seeding_progress, "LOOK_EVERY_S", 0.0)
    monkeypatch.setattr(seeding_progress, "LOOK_SHARE", 1.0)
    caplog.set_level("INFO", logger=colmap_process.__name__)
    remember, told = tmp_path / "seeding.json", []
    with pytest.raises(Interrupted):
        seed_poses(
            noisy,
            remember=remember,
            should_stop=lambda: rows(tmp_path, table) >= count,
            on_progress=lambda found: told.append(found.kept),
        )
    (copy,) = tmp_path.glob("features-*.db")
    assert copy in told
    assert TAKEN_UP not in caplog.text
    again = seed_poses(noisy, remember=remember)
    assert TAKEN_UP in caplog.text
    np.testing.assert_array_equal(again.candidates[-1].world_from_cam, undisturbed)
    assert not copy.exists()


def test_a_copy_of_other_photos_is_not_taken_up(noisy, tmp_path, monkeypatch, caplog):
    monkeypatch.setattr(map_images, "COPY_EVERY_S", 0.0)
    monkeypatch.setattr(seeding_progress, "LOOK_EVERY_S", 0.0)
    monkeypatch.setattr(seeding_progress, "LOOK_SHARE", 1.0)
    caplog.set_level("INFO", logger=colmap_process.__name__)
    remember = tmp_path / "seeding.json"
    with pytest.raises(Interrupted):
        seed_poses(noisy, remember=remember, should_stop=lambda: rows(tmp_path, "keypoints") > 0)
    fewer = replace(noisy, frames=noisy.frames[:-1])
    assert len(seed_poses(fewer, remember=remember).candidates[0].world_from_cam) == VIEWS - 1
    assert TAKEN_UP not in caplog.text


def test_where_mapping_takes_too_long_its_tracks_stay(noisy, tmp_path, monkeypatch):
    endless = tmp_path / "endless.py"
    began = tmp_path / "mapping has begun"
    endless.write_text(
        "import sys, time\n"
        "from pathlib import Path\n"
        "from biresnerf.data.seeding import colmap_child\n"
        "def map_incrementally(*_):\n"
        f"    Path({str(began)!r}).touch()\n"
        "    time.sleep(3600)\n"
        "colmap_child.map_incrementally = map_incrementally\n"
        "colmap_child.main(Path(sys.argv[1]))\n"
    )
    monkeypatch.setattr(colmap_process, "CHILD", endless)
    clock = SimpleNamespace(sleep=time.sleep, monotonic=lambda: 1e9 if began.exists() else 0.0)
    monkeypatch.setattr(colmap_process, "time", clock)
    found = seed_poses(noisy, remember=tmp_path / "seeding.json")
    assert [candidate.source for candidate in found.candidates] == ["given"]
    assert any("did not finish within" in warning for warning in found.dataset.warnings)
    tracks = Tracks.load(tmp_path / KEPT, noisy.names)
    assert tracks is not None
    assert set(tracks.image) == set(range(VIEWS))


def test_many_photos_have_longer(noisy, monkeypatch):
    limits = []

    def ask(_dataset, *, limit_s, **_how):
        limits.append(limit_s)
        return {"models": [], "matches": []}

    monkeypatch.setattr(cached_mapping, "ask_colmap", ask)
    for photos in (150, VIEWS / 2):
        monkeypatch.setattr(cached_mapping, "MANY", photos)
        seed_poses(noisy)
    assert limits[1] == 2 * limits[0]
