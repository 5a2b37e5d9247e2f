"""cameras.sfm of Meshroom and sfm_data.json of OpenMVG: each version is interpreted as by its loader."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest

from biresnerf.data.formats.photogrammetry.meshroom import write_meshroom
from biresnerf.data.formats.photogrammetry.openmvg import write_openmvg
from biresnerf.data.formats.read_dataset import read_dataset
from biresnerf.errors import InputError
from biresnerf.geometry.camera.camera_models import FAMILY_MODELS, MODEL_PARAMETERS
from tests.data.formats.photogrammetry.test_write_photogrammetry import made
from tests.data.formats.posed_sets import assert_reads_as, write_photos, write_plain_photos
from tests.data.scenes import assert_complete
from tests.data.test_real_sets import ROOT

FORMS = {"meshroom": ("cameras.sfm", write_meshroom), "openmvg": ("sfm_data.json", write_openmvg)}
REAL = ROOT / "interop/05_poses_silently_ignored"


def written(folder, form, refined, change=lambda document: None):
    """The set with its photos, after a change of the document; returns the file."""
    name, write = FORMS[form]
    write_photos(folder, refined)
    write(refined, folder / name)
    document = json.loads((folder / name).read_text())
    change(document)
    (folder / name).write_text(json.dumps(document))
    return folder / name


@pytest.mark.parametrize("model", sorted(FAMILY_MODELS))
@pytest.mark.parametrize("several", [False, True])
@pytest.mark.parametrize("form", FORMS)
def test_what_is_written_comes_back(tmp_path, form, model, several):
    refined = made(model, several=several)
    file = written(tmp_path, form, refined)
    for path in (tmp_path, file):
        assert_reads_as(read_dataset(path), refined, form)


def later(version, model, oblong=1.1):
    """A change of cameras.sfm 1.0.0 into a later version, as saveIntrinsic of that version writes a lens."""

    def change(document):
        document["version"] = [str(number) for number in version]
        for lens in document["intrinsics"]:
            focal, width = float(lens.pop("pxFocalLength")), float(lens["width"])
            if version < (1, 2, 2):
                lens["pxFocalLength"] = [str(focal), str(focal * oblong)]
            else:
                lens["sensorWidth"] = "24.0"
                in_x = focal / width * 24.0
                lens["focalLength"] = str(in_x * oblong if version >= (1, 2, 11) else in_x)
                lens["pixelRatio"] = str(1 / oblong if version < (1, 2, 5) else oblong)
            if version >= (1, 2, 1):
                half = (width / 2, float(lens["height"]) / 2)
                lens["principalPoint"] = [
                    str(float(at) - middle) for at, middle in zip(lens["principalPoint"], half, strict=True)
                ]
            if version >= (1, 2, 8):
                names = {"radial3": "radialk3", "fisheye4": "fisheye"}
                lens["distortionType"] = names.get(lens["type"], lens["type"])
                lens["type"], lens["undistortionType"] = "pinhole", "none"

    return change


@pytest.mark.parametrize("version", [(1, 2, 0), (1, 2, 1), (1, 2, 2), (1, 2, 6), (1, 2, 8), (1, 2, 12)])
@pytest.mark.parametrize("model", ["OPENCV", "RADIAL", "OPENCV_FISHEYE"])
def test_later_versions_of_meshroom_have_two_focal_lengths_and_the_centre_elsewhere(tmp_path, version, model):
    refined = made(model)
    cameras = []
    for camera in refined.cameras:
        full = camera.full()
        names = MODEL_PARAMETERS["OPENCV_FISHEYE" if full.fisheye else "OPENCV"]
        values = full._asdict() | {"fy": full.fx * 1.1}
        cameras.append(
            replace(
                camera,
                model="OPENCV_FISHEYE" if full.fisheye else "OPENCV",
                params=tuple(values[name] for name in names),
            )
        )
    written(tmp_path, "meshroom", refined, later(version, model))
    assert_reads_as(read_dataset(tmp_path), replace(refined, cameras=tuple(cameras)), "meshroom")


@pytest.mark.parametrize("form", FORMS)
def test_a_view_without_a_pose_has_none(tmp_path, form):
    key = {"meshroom": "poses", "openmvg": "extrinsics"}[form]
    written(tmp_path, form, made("PINHOLE"), lambda document: document[key].pop(1))
    dataset = read_dataset(tmp_path)
    assert dataset.posed.tolist() == [True, False, True, True, True]
    assert any("1 of 5 images have no pose yet" in text for text in dataset.warnings)


BAD = [
    ("meshroom", lambda d: d["poses"][1]["pose"]["transform"].update(center=["0", "nan", "0"]), "not_finite"),
    ("meshroom", lambda d: d["poses"][1]["pose"]["transform"].update(rotation=["2"] * 9), "not_rotation"),
    ("meshroom", lambda d: d["views"][1].update(intrinsicId="9"), "file_invalid"),
    ("meshroom", lambda d: d["views"][1].update(rigId="3", isPoseIndependant="0"), "file_invalid"),
    ("openmvg", lambda d: d["extrinsics"][1]["value"].update(center=[0, 1]), "file_invalid"),
    ("openmvg", lambda d: d["extrinsics"][1]["value"].update(rotation=[[2, 0, 0]] * 3), "not_rotation"),
    ("openmvg", lambda d: d["views"][1]["value"]["ptr_wrapper"]["data"].update(id_intrinsic=9), "invalid"),
]


@pytest.mark.parametrize(("form", "change", "code"), BAD)
def test_one_bad_row_costs_one_image_its_pose(tmp_path, form, change, code):
    file = written(tmp_path, form, made("PINHOLE"), change)
    assert read_dataset(tmp_path).posed.tolist() == [True, False, True, True, True]
    with pytest.raises(InputError) as caught:
        read_dataset(tmp_path, strict=True)
    assert code in caught.value.code
    assert_complete(caught.value, caught.value.code, file.name)


REFUSED = [
    ("meshroom", lambda d: d.update(version="1"), "pose_file_invalid"),
    ("meshroom", lambda d: d.pop("views"), "pose_file_invalid"),
    ("meshroom", lambda d: d["intrinsics"][0].update(type="equidistant"), "camera_model_unsupported"),
    ("meshroom", lambda d: d["intrinsics"][0].update(distortionParams=["1"]), "pose_file_invalid"),
    ("openmvg", lambda d: d.pop("extrinsics"), "pose_file_invalid"),
    (
        "openmvg",
        lambda d: d["intrinsics"][0]["value"]["ptr_wrapper"]["data"].pop("focal_length"),
        "camera_model_unsupported",
    ),
    (
        "openmvg",
        lambda d: d["intrinsics"][0]["value"]["ptr_wrapper"]["data"].update(disto_k3=[1, 2]),
        "pose_file_invalid",
    ),
]


@pytest.mark.parametrize(("form", "change", "code"), REFUSED)
def test_a_file_of_which_nothing_can_be_used_is_refused(tmp_path, form, change, code):
    file = written(tmp_path, form, made("SIMPLE_RADIAL"), change)
    with pytest.raises(InputError) as caught:
        read_dataset(tmp_path)
    assert_complete(caught.value, code, file.name)


@pytest.mark.parametrize("form", FORMS)
def test_a_real_file_is_read_as_its_numbers_say(tmp_path, form):
    name = FORMS[form][0]
    if not (REAL / form).is_dir():
        pytest.skip("no image set interop: set BIRESNERF_TEST_DATA to the folder that holds it")
    shutil.copyfile(REAL / form / name, tmp_path / name)
    document = json.loads((tmp_path / name).read_text())
    if form == "meshroom":  # version 1.2.6
        views = {row["path"].rpartition("/")[2]: row["poseId"] for row in document["views"]}
        numbers = {row["poseId"]: row["pose"]["transform"] for row in document["poses"]}
        found = {key: (np.array(row["rotation"], float), row["center"]) for key, row in numbers.items()}
        size, [lens] = (4000, 3000), document["intrinsics"]
        focal = float(lens["focalLength"]) / float(lens["sensorWidth"]) * 4000
    else:
        data = [row["value"]["ptr_wrapper"]["data"] for row in document["views"]]
        views = {row["filename"]: row["id_pose"] for row in data}
        found = {
            row["key"]: (np.array(row["value"]["rotation"]).T.ravel(), row["value"]["center"])
            for row in document["extrinsics"]
        }
        size = (data[0]["width"], data[0]["height"])
        focal = document["intrinsics"][0]["value"]["ptr_wrapper"]["data"]["focal_length"]
    write_plain_photos(tmp_path / "images", views, size)
    dataset = read_dataset(tmp_path)
    assert len(dataset) == len(views)
    assert int(dataset.posed.sum()) == sum(number in found for number in views.values())
    assert dataset.posed.any() == (
        form == "meshroom"
    )  # OpenMVG's lists photos and lenses, before reconstruction
    for frame, path in zip(dataset.frames, dataset.file_names, strict=True):
        number = views[path.removeprefix("images/")]
        if frame.world_from_cam is not None:
            rotation, centre = found[number]
            np.testing.assert_allclose(frame.world_from_cam[:3, :3].ravel(), rotation, atol=1e-9)
            np.testing.assert_allclose(frame.world_from_cam[:3, 3], np.array(centre, float), atol=1e-9)
    assert dataset.camera_of(0).full().fx == pytest.approx(focal)
