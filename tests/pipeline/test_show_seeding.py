"""What a run shows while COLMAP works, on photos without poses and lenses."""

from __future__ import annotations

import importlib.util
import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from biresnerf.data.formats.read_dataset import read_dataset
from biresnerf.data.seeding import seeding_progress
from biresnerf.data.seeding.cached_mapping import remembered_mapping
from biresnerf.data.seeding.seeding_preview import TILE, write_contact_sheet
from biresnerf.data.seeding.seeding_progress import SeedingProgress
from biresnerf.data.workload import EACH_MAPPED
from biresnerf.errors import Interrupted
from biresnerf.geometry.pose_error import pose_error
from biresnerf.options.refine_options import RefineOptions
from biresnerf.pipeline import refine_poses
from biresnerf.progress import Monitor, Progress
from biresnerf.write.output_folder import OutputFolder
from biresnerf.write.preview import SeedingPreview
from tests.data.scenes import arc_poses, plain_features, textured_arc

pytestmark = pytest.mark.slow

needs_colmap = pytest.mark.skipif(
    importlib.util.find_spec("pycolmap") is None, reason="pycolmap is not installed (extra: colmap)"
)
VIEWS, SIZE = 10, 320


@pytest.fixture(scope="module")
def photos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("photos")
    textured_arc(folder / "images", VIEWS, SIZE)
    return folder


@pytest.fixture(autouse=True)
def often(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(seeding_progress, "LOOK_EVERY_S", 0.0)
    monkeypatch.setattr(seeding_progress, "LOOK_SHARE", 1.0)
    with plain_features():
        yield


@needs_colmap
def test_what_is_told_on_the_way_is_what_colmap_answers(photos: Path):
    told = []
    mapping = remembered_mapping(read_dataset(photos), lambda: False, 0, "full", None, told.append)
    assert not told[0].features
    counts = [(len(found.features), len(found.matches)) for found in told]
    assert counts == sorted(counts)
    assert set(told[-1].features) == set(range(VIEWS))
    assert [found.matched for found in told] == sorted(found.matched for found in told)
    assert told[-1].matched
    shown = {(min(a, b), max(a, b)): count for (a, b), count in told[-1].matches.items()}
    mapped = {(min(a, b), max(a, b)): count for a, b, count in mapping.matches.tolist()}
    # COLMAP maps with these. About a fifth of all points is left out, to judge poses by.
    assert shown.keys() == mapped.keys()
    assert all(count <= mapped[pair] for pair, count in shown.items())
    assert sum(shown.values()) == pytest.approx(0.8 * sum(mapped.values()), rel=0.1)


@needs_colmap
def test_photos_alone_are_shown_at_once_then_what_matches_then_the_poses(photos: Path, tmp_path: Path):
    shown: list[tuple[Progress, dict[str, bytes]]] = []

    def keep(progress: Progress) -> None:
        if progress.preview:
            files = {name: (tmp_path / "out" / name).read_bytes() for name in progress.preview}
            shown.append((progress, files))

    options = RefineOptions(preset="fast", steps=20, max_image_size=32, verdict=False, orbit_frames=0)
    with pytest.raises(Interrupted):
        refine_poses(photos, tmp_path / "out", options, keep, lambda: bool(shown))
    assert len(shown) == 1
    refine_poses(photos, tmp_path / "out", options, keep)  # what was shown does not stand in the way
    assert not (tmp_path / "out" / "preview").exists()
    shown = [(progress, files) for progress, files in shown if progress.stage == "seeding"]
    first, last = shown[0][1], shown[-1][1]
    assert set(first) == {"preview/photos.jpg", "preview/seeding.json"}
    before = json.loads(first["preview/seeding.json"])
    assert before["matched_pairs"] == 0
    assert [(image["features"], image["posed"]) for image in before["images"]] == [(None, False)] * VIEWS
    after = json.loads(last["preview/seeding.json"])
    assert after["matched_pairs"] >= VIEWS - 1
    assert all(image["partners"] > 0 for image in after["images"])
    found = json.loads(last["preview/poses.json"])["images"]
    assert [image["name"] for image in found] == [image["name"] for image in after["images"]]
    poses = np.array([[*image["world_from_cam"], (0, 0, 0, 1)] for image in found])
    assert pose_error(poses, arc_poses(VIEWS)).aligned.rotation_deg.max < 3.0


def test_what_is_left_of_matching_follows_from_the_features_found_and_mapping_stays_mapping(photos, tmp_path):
    monitor = Monitor()
    monitor.forecast.left = {"features": 1.0, "matching": 1.0, "mapping": 1.0}
    counts = dict.fromkeys(range(VIEWS), 2000)
    with SeedingPreview(read_dataset(photos), OutputFolder(tmp_path / "out"), monitor) as show:
        show(SeedingProgress({0: 2000, 1: 2000}, {}, 0, 45))
        assert monitor.forecast.left == {"features": 1.0, "matching": 1.0, "mapping": 1.0}
        show(SeedingProgress(counts, {}, 9, 45))
        mapping = VIEWS * (EACH_MAPPED + 2)
        assert monitor.forecast.left == {"matching": pytest.approx(45 * 2000 / 1e6), "mapping": mapping}
        show(SeedingProgress(counts, {(0, 1): 90}, 45, 45, matched=True))
        assert monitor.forecast.left == {"mapping": mapping}
        show(SeedingProgress(counts, {}, 20, 45, matched=True))  # contradicting pairs were taken out
        assert monitor.forecast.left == {"mapping": mapping}
        assert monitor.forecast.left_s() > 0


def test_the_sheet_shows_each_photo_at_its_place_and_leaves_out_the_unreadable(tmp_path: Path):
    for index, colour in enumerate([(255, 0, 0), (0, 255, 0), (0, 0, 255)]):
        Image.new("RGB", (300, 200), colour).save(tmp_path / f"{index}.png")
    frames = read_dataset(tmp_path).frames
    (tmp_path / "1.png").write_bytes(b"no photo any more")
    write_contact_sheet(frames, tmp_path / "sheet.jpg")
    sheet = np.asarray(Image.open(tmp_path / "sheet.jpg")).astype(int)
    assert sheet.shape == (TILE, 3 * TILE, 3)
    middle = [sheet[TILE // 2, TILE // 2 + TILE * place] for place in range(3)]
    assert np.abs(np.array(middle) - [(255, 0, 0), (238, 238, 238), (0, 0, 255)]).max() < 12
