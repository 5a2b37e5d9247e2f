"""Real and published image sets: they read, load and write back the same. Third-party material, not kept here."""

from __future__ import annotations

import json
import os
from pathlib import Path

import numpy as np
import pytest

from biresnerf.data.formats.read_dataset import read_dataset
from biresnerf.data.formats.transforms.write_transforms import write_transforms
from biresnerf.data.photos.images import load_images

ROOT = Path(os.environ.get("BIRESNERF_TEST_DATA", Path(__file__).parents[3] / "shared" / "data"))
# Name, number of frames, camera model, dialect, background.
SETS = [
    ("lego_tiny100", 100, "PINHOLE", "blender", [1.0, 1.0, 1.0]),
    ("scarf", 100, "PINHOLE", "blender", None),
    ("fox", 50, "OPENCV", "nerfstudio", None),
    ("fountain_p11", 11, "PINHOLE", "nerfstudio", None),
    ("temple", 47, "PINHOLE", "nerfstudio", [0.0, 0.0, 0.0]),
    ("dtu_scan24", 49, "PINHOLE", "nerfstudio", None),
    ("lund_door", 12, "OPENCV", "nerfstudio", None),
    ("kitchen25", 23, "PINHOLE", "nerfstudio", None),
    ("mobilebrick", 5, "PINHOLE", "nerfstudio", None),
]


@pytest.mark.parametrize(("name", "frames", "model", "dialect", "background"), SETS)
def test_a_published_set_reads_loads_and_writes_back(tmp_path, name, frames, model, dialect, background):
    folder = ROOT / name
    if not folder.is_dir():
        pytest.skip(f"no image set {name}: set BIRESNERF_TEST_DATA to the folder that holds it")
    dataset = read_dataset(folder)
    assert len(dataset) == frames
    assert {camera.model for camera in dataset.cameras} == {model}
    assert dataset.source.dialect == dialect
    images = load_images(dataset, max_size=96)
    assert (None if images.background is None else images.background.tolist()) == background
    assert images.pixels.std() > 20

    write_transforms(dataset, dataset.world_from_cam, tmp_path / "transforms.json")
    assert dataset.source.file is not None
    given = json.loads(dataset.source.file.read_text())
    written = json.loads((tmp_path / "transforms.json").read_text())
    for row, other in zip(given["frames"], written["frames"], strict=True):
        # As far as the file's own rotations are rotations.
        np.testing.assert_allclose(row.pop("transform_matrix"), other.pop("transform_matrix"), atol=1e-6)
    assert written == given
