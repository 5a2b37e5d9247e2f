"""Sets of other programs with true poses: each is read at these poses."""

from __future__ import annotations

import json

import numpy as np
import pytest

from biresnerf.data.formats.read_dataset import read_dataset
from tests.data.test_real_sets import ROOT

CASES = ROOT / "interop"
if not CASES.is_dir():
    pytest.skip(
        "no image set interop: set BIRESNERF_TEST_DATA to the folder that holds it", allow_module_level=True
    )

# The set: format, photos, focal length in pixels (None where it is a guess), and what a warning says.
SETS = {
    "24_colmap_model_elsewhere/colmap_text": ("colmap", 8, 116.9192, None),
    "24_colmap_model_elsewhere/dense_0": ("colmap", 8, 116.9192, "poses were read from dense/0/sparse"),
    "24_colmap_model_elsewhere/dslr_colmap": ("colmap", 8, 116.9192, None),
    "25_colmap_photos_in_another_folder/images_4": ("colmap", 8, 116.9192, None),
    "25_colmap_photos_in_another_folder/root_model": ("colmap", 8, 116.9192, "dense/sparse was read"),
    "26_3d_scanner_app/chair": ("3d-scanner-app", 6, None, None),
    "27_nerfpp/scene": ("matrix-files", 8, 116.9192, "left out: test/rgb/ (3)"),
    "27_nerfpp/train_alone": ("matrix-files", 8, 116.9192, None),
    "29_other_poses_ignored/pose_csv": ("csv", 8, None, "poses.csv was read as camera to world"),
    "29_other_poses_ignored/realestate10k": ("realestate10k", 8, 116.9192, None),
    "31_neus2/transform_json": ("instant-ngp", 8, 116.9192, "from_na"),
    "31_neus2/transforms_json": ("instant-ngp", 8, 116.9192, "from_na"),
    "39_ns_export_cameras/set": ("nerfstudio", 8, None, "ns-export"),
    "41_photos_in_sibling_folder/dslr": ("nerfstudio", 8, 116.9192, "nerfstudio2/transforms.json was not"),
    "42_polycam_without_size/capture": ("polycam", 8, 116.9192, None),
    "43_metashape_rig/set": ("metashape", 12, 116.9192, None),
    "44_largest_model_is_1/set": ("colmap", 12, 116.9192, "sparse/1 (12 images) was read"),
}


@pytest.mark.parametrize("name", SETS)
def test_a_set_is_read_at_its_true_poses_with_its_lens(name):
    dialect, frames, focal, said = SETS[name]
    case, _, folder = name.partition("/")
    expected = json.loads((CASES / case / f"expected_{folder}.json").read_text())
    dataset = read_dataset(CASES / name)
    assert (dataset.source.dialect, len(dataset)) == (dialect, frames)
    found = {frame.path.name: frame for frame in dataset.frames}
    for photo, pose in expected.items():
        np.testing.assert_allclose(found[photo].world_from_cam, pose, atol=2e-6)
    for camera in dataset.cameras:
        assert focal is None or camera.full().fx == pytest.approx(focal, rel=1e-6)
    assert focal is None or set(dataset.intrinsics_sources) <= {"given"}
    assert said is None or any(said in text for text in dataset.warnings), dataset.warnings
