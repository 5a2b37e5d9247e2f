"""Small cases of other programs' sets whose photos, names, masks, places, times or units went wrong once."""

from __future__ import annotations

import json

import numpy as np
import pytest

from biresnerf.data.formats.read_dataset import read_dataset
from biresnerf.data.photos.images import load_images
from biresnerf.errors import InputError
from tests.data.test_real_sets import ROOT

CASES = ROOT / "interop"
if not CASES.is_dir():
    pytest.skip(
        "no image set interop: set BIRESNERF_TEST_DATA to the folder that holds it", allow_module_level=True
    )

# The case: frames, frames with a pose, and what a warning says of it.
READ = {
    "30_unpadded_numbers/kitti": (12, 12, "as numbers (frame_2.jpg before frame_10.jpg)"),
    "30_unpadded_numbers/log": (12, 12, "as numbers (2.jpg before 10.jpg)"),
    "32_panoramas_taken_as_perspective/metashape_spherical": (8, 8, None),
    "34_times_of_photos/ns_names": (12, 10, "by time (by the images' names"),
    "34_times_of_photos/prefixed": (12, 10, "by time (by the images' names"),
    "35_geo_txt/epsg_4258": (8, 8, "measured positions of 8 of 8"),
    "35_geo_txt/no_height": (8, 8, "geo.txt line 2 has no height"),
    "35_geo_txt/proj_header": (8, 8, "measured positions of 8 of 8"),
    "36_unrelated_gps_csv/logger": (8, 8, "names no photo of the set"),
    "37_pictures_that_are_no_photos/nerf_synthetic_test": (6, 0, "12 pictures are called as maps"),
    "37_pictures_that_are_no_photos/odm_masks": (6, 0, "masks were found for 6 of 6"),
    "38_masks_under_other_names/stem": (6, 6, "masks were found for 6 of 6"),
    "38_masks_under_other_names/beside": (6, 6, "masks were found for 6 of 6"),
    "40_only_images_8/set": (8, 8, "in a folder of smaller copies (images/0001.jpg is images_8/0001.jpg)"),
    "46_png_beside_jpg/set": (6, 6, "0001.jpg (not 0001.png)"),
}
REFUSED = {
    "33_focal_in_other_units/normalised": ("intrinsics_invalid", "looks like a share of the photo's width"),
    "45_unread_kinds_in_images/jp2": ("no_images", "4 JPEG 2000 (images/0001.jp2"),
}


def test_photos_of_low_contrast_in_16_bits_show_as_much_as_the_same_in_8():
    dataset = read_dataset(CASES / "51_low_contrast_16bit/thermal")
    images = load_images(dataset)
    assert min(len(np.unique(images.image(index))) for index in range(len(dataset))) > 150
    assert any("16 bits and use those from 29126 to 30296" in text for text in dataset.warnings)


@pytest.mark.parametrize("name", READ)
def test_a_case_is_read_with_its_true_poses_and_says_what_was_done(name):
    frames, posed, said = READ[name]
    dataset = read_dataset(CASES / name)
    assert (len(dataset), int(dataset.posed.sum())) == (frames, posed)
    if said is not None:
        assert any(said in text for text in dataset.warnings), dataset.warnings
    case, _, one = name.rpartition("/")
    expected = json.loads((CASES / case / f"expected_{one}.json").read_text())
    for frame in dataset.frames:
        assert frame.path.name in expected
        if frame.world_from_cam is not None:
            np.testing.assert_allclose(frame.world_from_cam, expected[frame.path.name], atol=1e-6)


@pytest.mark.parametrize("name", REFUSED)
def test_a_case_that_cannot_be_read_is_refused_by_its_name(name):
    code, said = REFUSED[name]
    with pytest.raises(InputError) as caught:
        read_dataset(CASES / name)
    assert caught.value.code == code
    assert said in caught.value.detail
    assert caught.value.hint.endswith(".")
