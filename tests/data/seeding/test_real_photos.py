"""Feature matches on real photos, as cameras write or users leave them, against the truth."""

from __future__ import annotations

import json
import posixpath

import numpy as np
import pytest

from biresnerf.data.formats.read_dataset import read_dataset
from biresnerf.data.photos.alike.copied_photos import without_copies
from biresnerf.data.seeding.seed_poses import seed_poses
from biresnerf.geometry.pose_error import rotation_between_deg
from tests.data.test_real_sets import ROOT

pytestmark = pytest.mark.slow

pytest.importorskip("pycolmap", reason="needs pycolmap (pip install 'biresnerf[colmap]')")
CASES = ROOT / "interop"
if not CASES.is_dir():
    pytest.skip(
        "no image set interop: set BIRESNERF_TEST_DATA to the folder that holds it", allow_module_level=True
    )
_AXES = np.diag([1.0, -1.0, -1.0, 1.0])


def true_poses(path) -> dict[str, np.ndarray]:
    document = json.loads(path.read_text())
    listed = {f["file_path"]: f["transform_matrix"] for f in document.get("frames", ())} or document
    return {posixpath.basename(name): np.array(pose) @ _AXES for name, pose in listed.items()}


@pytest.mark.parametrize(
    ("folder", "truth", "photos"),
    [
        ("47_exif_orientation", "47_exif_orientation/truth.json", 8),
        ("48_exif_of_a_phone", "48_exif_of_a_phone/truth.json", 8),
        ("52_pure_rotation/tripod", "52_pure_rotation/truth_tripod.json", 12),
        ("53_repeated_photos/frozen", "53_repeated_photos/truth_frozen.json", 11),
    ],
)
def test_matches_find_how_cameras_are_turned_to_each_other(folder, truth, photos):
    dataset = without_copies(read_dataset(CASES / folder))
    assert len(dataset) == photos
    seeding = seed_poses(dataset)
    assert seeding.dataset.faults == ()
    best = seeding.candidates[-1]
    placed = [
        i for i, source in enumerate(best.sources) if source == "colmap" or source.startswith("matches")
    ]
    assert len(placed) >= 0.4 * photos
    true = true_poses(CASES / truth)
    known = np.stack([true[posixpath.basename(dataset.names[i])] for i in placed])
    first_from_cam = [np.linalg.inv(poses[0]) @ poses for poses in (best.world_from_cam[placed], known)]
    assert np.median(rotation_between_deg(*first_from_cam)) < 1
