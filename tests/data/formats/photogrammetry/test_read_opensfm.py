"""reconstruction.json of OpenSfM, interpreted as by its source."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from biresnerf.data.formats.photogrammetry.opensfm import write_opensfm
from biresnerf.data.formats.read_dataset import read_dataset
from biresnerf.errors import InputError
from biresnerf.geometry.camera.camera_models import (
    FAMILY_MODELS,
    FullParameters,
    smallest_model,
)
from tests.data.formats.photogrammetry.test_write_photogrammetry import made
from tests.data.formats.posed_sets import assert_reads_as, write_photos, write_plain_photos
from tests.data.scenes import assert_complete
from tests.data.test_real_sets import ROOT

REAL = ROOT / "interop/05_poses_silently_ignored/opensfm"


def rewrite(path, change):
    document = json.loads(path.read_text())
    change(document)
    path.write_text(json.dumps(document))


@pytest.mark.parametrize("model", sorted(FAMILY_MODELS))
@pytest.mark.parametrize("several", [False, True])
def test_what_is_written_comes_back(tmp_path, model, several):
    refined = made(model, several=several, square=False)
    write_photos(tmp_path, refined)
    write_opensfm(refined, tmp_path / "reconstruction.json")
    for path in (tmp_path, tmp_path / "reconstruction.json"):
        assert_reads_as(read_dataset(path), refined, "opensfm")


def test_it_is_found_in_the_folder_of_opendronemap(tmp_path):
    refined = made("SIMPLE_RADIAL")
    write_photos(tmp_path, refined)
    (tmp_path / "opensfm").mkdir()
    write_opensfm(refined, tmp_path / "opensfm/reconstruction.json")
    for path in (tmp_path, tmp_path / "opensfm/reconstruction.json"):
        assert_reads_as(read_dataset(path), refined, "opensfm")


LENSES = {
    "perspective": {"focal": 1.1, "k1": -0.02, "k2": 0.01},
    "simple_radial": {"focal_x": 1.1, "focal_y": 1.2, "c_x": 0.01, "c_y": -0.02, "k1": -0.02},
    "radial": {"focal_x": 1.1, "focal_y": 1.2, "c_x": 0.01, "c_y": -0.02, "k1": -0.02, "k2": 0.01},
    "fisheye": {"focal": 1.1, "k1": -0.02, "k2": 0.01},
}


@pytest.mark.parametrize("kind", LENSES)
@pytest.mark.parametrize("declared", [True, False])
def test_the_other_lenses_of_opensfm_are_what_its_source_computes(tmp_path, kind, declared):
    """As camera_projections_functions.h and camera_distortions_functions.h have them, in shares of the longer side."""
    refined = made("SIMPLE_RADIAL")
    write_photos(tmp_path, refined)
    write_opensfm(refined, tmp_path / "reconstruction.json")
    values, size = LENSES[kind], {"width": 64, "height": 48} if declared else {}

    def change(document):
        document[0]["cameras"] = {"0": {"projection_type": kind, **size, **values}}

    rewrite(tmp_path / "reconstruction.json", change)
    focal_x, focal_y = (values.get(key, values.get("focal", 0.0)) * 64 for key in ("focal_x", "focal_y"))
    centre = values.get("c_x", 0.0) * 64 + 32, values.get("c_y", 0.0) * 64 + 24
    coefficients = {key: values[key] for key in ("k1", "k2") if key in values}
    full = FullParameters(focal_x, focal_y, *centre, **coefficients, fisheye=kind == "fisheye")
    model, params = smallest_model(full, None)
    expected = replace(
        refined, cameras=(replace(refined.cameras[0], model=model, params=params),) * len(refined.cameras)
    )
    assert_reads_as(read_dataset(tmp_path), expected, "opensfm")


def test_the_largest_of_several_reconstructions_is_read(tmp_path):
    refined = made("PINHOLE")
    write_photos(tmp_path, refined)
    write_opensfm(refined, tmp_path / "reconstruction.json")

    def change(document):
        shots = dict([document[0]["shots"].popitem()])
        document.insert(0, {**document[0], "shots": shots})

    rewrite(tmp_path / "reconstruction.json", change)
    dataset = read_dataset(tmp_path)
    assert int(dataset.posed.sum()) == len(dataset) == 4
    assert any("1 images belong to smaller reconstructions" in text for text in dataset.warnings)


@pytest.mark.parametrize(
    ("change", "code", "where"),
    [
        (lambda d: d[0]["shots"]["ö 01.jpg"].update(rotation=[1, 2]), "pose_file_invalid", "ö 01.jpg"),
        (lambda d: d[0]["shots"]["ö 01.jpg"].update(camera="9"), "pose_file_invalid", "cameras.9"),
        (lambda d: d[0]["shots"]["ö 01.jpg"].update(translation=[0, 0, 1e99]), "pose_out_of_range", "ö 01"),
    ],
)
def test_one_bad_shot_costs_one_image_its_pose(tmp_path, change, code, where):
    refined = made("PINHOLE")
    write_photos(tmp_path, refined)
    write_opensfm(refined, tmp_path / "reconstruction.json")
    rewrite(tmp_path / "reconstruction.json", change)
    dataset = read_dataset(tmp_path)
    assert [frame.name for frame in dataset.frames if frame.world_from_cam is None] == ["ö 01.jpg"]
    assert any("1 of 5 poses cannot be used" in text for text in dataset.warnings)
    with pytest.raises(InputError) as caught:
        read_dataset(tmp_path, strict=True)
    assert_complete(caught.value, code, "reconstruction.json", where)


def test_degrees_in_place_of_radians_are_refused_by_name(tmp_path):
    refined = made("PINHOLE")
    write_photos(tmp_path, refined)
    write_opensfm(refined, tmp_path / "reconstruction.json")

    def in_degrees(document):
        for shot in document[0]["shots"].values():
            shot["rotation"] = np.degrees(shot["rotation"]).tolist()

    rewrite(tmp_path / "reconstruction.json", in_degrees)
    with pytest.raises(InputError, match="it looks like degrees") as caught:
        read_dataset(tmp_path)
    assert_complete(caught.value, "pose_out_of_range", "reconstruction.json")


@pytest.mark.parametrize(
    ("change", "code"),
    [
        (lambda d: d[0]["cameras"]["0"].update(projection_type="dual"), "camera_model_unsupported"),
        (lambda d: d[0]["cameras"]["0"].update(focal_x=-1), "intrinsics_invalid"),
        (lambda d: d[0].pop("shots"), "pose_file_invalid"),
        (lambda d: d[0]["shots"].update({"../a.jpg": {}}), "unsafe_path"),
    ],
)
def test_a_file_of_which_nothing_can_be_used_is_refused(tmp_path, change, code):
    refined = made("PINHOLE")
    write_photos(tmp_path, refined)
    write_opensfm(refined, tmp_path / "reconstruction.json")
    rewrite(tmp_path / "reconstruction.json", change)
    with pytest.raises(InputError) as caught:
        read_dataset(tmp_path)
    assert_complete(caught.value, code, "reconstruction.json")


def test_a_real_file_is_read_as_its_numbers_say(tmp_path):
    if not REAL.is_dir():
        pytest.skip("no image set interop: set BIRESNERF_TEST_DATA to the folder that holds it")
    shutil.copyfile(REAL / "reconstruction.json", tmp_path / "reconstruction.json")
    shots = max((part["shots"] for part in json.loads((REAL / "reconstruction.json").read_text())), key=len)
    write_plain_photos(tmp_path / "images", shots, (2880, 2160))
    dataset = read_dataset(tmp_path)
    assert len(dataset) == len(shots) == 19
    for frame in dataset.frames:
        shot = shots[frame.name]
        rotation = Rotation.from_rotvec(shot["rotation"]).as_matrix()
        np.testing.assert_allclose(frame.world_from_cam[:3, :3], rotation.T, atol=1e-12)
        np.testing.assert_allclose(
            rotation @ frame.world_from_cam[:3, 3], -np.array(shot["translation"]), atol=1e-9
        )
