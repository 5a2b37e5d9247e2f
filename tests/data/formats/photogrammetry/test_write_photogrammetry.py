"""Files of photogrammetry programs and of NeuS, read by those programs' rules: points project as ours do."""

from __future__ import annotations

import csv
import json
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from biresnerf.data.formats.datasets.neus import write_neus
from biresnerf.data.formats.photogrammetry.meshroom import write_meshroom
from biresnerf.data.formats.photogrammetry.openmvg import write_openmvg
from biresnerf.data.formats.photogrammetry.opensfm import write_opensfm
from biresnerf.data.formats.photogrammetry.realitycapture import write_realitycapture
from biresnerf.errors import InputError
from biresnerf.geometry.camera.camera_models import FAMILY_MODELS, MODEL_PARAMETERS, Camera
from tests.data.formats.random_sets import random_result
from tests.data.formats.readers import ours, seen_points
from tests.data.scenes import assert_complete

CLOSE_PX = 1e-6


def with_values(refined, **values):
    """The same with lens parameters changed; a callable is given the camera."""
    cameras = []
    for camera in refined.cameras:
        named = dict(zip(MODEL_PARAMETERS[camera.model], camera.params, strict=True))
        named |= {key: value for key, value in values.items() if key in named}
        if "fy" in named and values.get("square"):
            named["fy"] = named["fx"]
        cameras.append(replace(camera, params=tuple(named.values())))
    return replace(refined, cameras=tuple(cameras))


def made(model, *, several=False, square=True):
    """A result without terms that only COLMAP has, and whose pixels are ``square`` where a format needs that."""
    beyond = {"FULL_OPENCV": ("k4", "k5", "k6"), "THIN_PRISM_FISHEYE": ("p1", "p2", "sx1", "sy1")}
    without = dict.fromkeys(beyond.get(model, ()), 0.0)
    return with_values(random_result(21, model=model, several=several), **without, square=square)


def brown(in_cam, k1=0.0, k2=0.0, k3=0.0, p1=0.0, p2=0.0):
    x, y = in_cam[:, 0] / in_cam[:, 2], in_cam[:, 1] / in_cam[:, 2]
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    across = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    return np.stack([across, y * radial + 2 * p2 * x * y + p1 * (r2 + 2 * y * y)], 1)


def opencv_fisheye(in_cam, k1, k2, k3, k4):
    xy = in_cam[:, :2] / in_cam[:, 2:]
    r = np.linalg.norm(xy, axis=1, keepdims=True)
    t = np.arctan(r)
    return xy / r * t * (1 + k1 * t**2 + k2 * t**4 + k3 * t**6 + k4 * t**8)


def through_opensfm(path, refined, index, points):
    [reconstruction] = json.loads(path.read_text())
    shot = reconstruction["shots"][refined.images[index].file_name.removeprefix("images/")]
    lens = reconstruction["cameras"][shot["camera"]]
    in_cam = Rotation.from_rotvec(shot["rotation"]).apply(points) + shot["translation"]
    if lens["projection_type"] == "fisheye_opencv":
        xy = opencv_fisheye(in_cam, *(lens[k] for k in ("k1", "k2", "k3", "k4")))
    else:
        assert lens["projection_type"] == "brown"
        xy = brown(in_cam, *(lens[k] for k in ("k1", "k2", "k3", "p1", "p2")))
    size = max(lens["width"], lens["height"])
    shares = xy * [lens["focal_x"], lens["focal_y"]] + [lens["c_x"], lens["c_y"]]
    # denormalized_image_coordinates gives indices of pixels; their middles lie half a pixel on.
    return shares * size - 0.5 + np.array([lens["width"], lens["height"]]) / 2 + 0.5


def through_meshroom(path, refined, index, points):
    document = json.loads(path.read_text())
    assert document["version"] == ["1", "0", "0"]
    [view] = [v for v in document["views"] if v["path"] == refined.images[index].file_name]
    [pose] = [p["pose"]["transform"] for p in document["poses"] if p["poseId"] == view["poseId"]]
    [lens] = [i for i in document["intrinsics"] if i["intrinsicId"] == view["intrinsicId"]]
    rotation = np.array(pose["rotation"], float).reshape(3, 3, order="F")  # Eigen's storage
    in_cam = (points - np.array(pose["center"], float)) @ rotation.T
    coefficients = [float(value) for value in lens["distortionParams"]]
    shape = {"fisheye4": opencv_fisheye, "radial3": brown, "brown": brown}[lens["type"]]
    assert (view["width"], view["height"]) == (lens["width"], lens["height"])
    return float(lens["pxFocalLength"]) * shape(in_cam, *coefficients) + np.array(
        lens["principalPoint"], float
    )


def through_openmvg(path, refined, index, points):
    document = json.loads(path.read_text())
    names = {}
    for entry in document["intrinsics"]:  # as cereal keeps track of types
        value = entry["value"]
        if value["polymorphic_id"] & 2**31:
            names[value["polymorphic_id"] - 2**31] = value["polymorphic_name"]
    pointers = [e["value"]["ptr_wrapper"]["id"] for e in (*document["views"], *document["intrinsics"])]
    assert pointers == [2**31 + 1 + k for k in range(len(pointers))]
    data = [e["value"]["ptr_wrapper"]["data"] for e in document["views"]]
    [view] = [d for d in data if d["filename"] == refined.images[index].file_name]
    [value] = [e["value"] for e in document["intrinsics"] if e["key"] == view["id_intrinsic"]]
    [pose] = [e["value"] for e in document["extrinsics"] if e["key"] == view["id_pose"]]
    lens, kind = value["ptr_wrapper"]["data"], names[value["polymorphic_id"] & (2**31 - 1)]
    in_cam = (points - pose["center"]) @ np.array(pose["rotation"]).T
    shape, key = {
        "fisheye": (opencv_fisheye, "fisheye"),
        "pinhole_radial_k3": (brown, "disto_k3"),
        "pinhole_brown_t2": (brown, "disto_t2"),
    }[kind]
    return lens["focal_length"] * shape(in_cam, *lens[key]) + lens["principal_point"]


def through_realitycapture(path, refined, index, points):
    with path.open(newline="") as file:
        rows = list(csv.DictReader(file))
    name = refined.images[index].file_name.rpartition("/")[2]
    [row] = [{k: v if k == "#name" else float(v) for k, v in r.items()} for r in rows if r["#name"] == name]
    camera = refined.camera_of(index)
    size = max(camera.width, camera.height)
    angles = [-row["heading"], row["pitch"], row["roll"]]
    turned = Rotation.from_euler("ZXY", angles, degrees=True).as_matrix()
    in_cam = (points - [row["x"], row["y"], row["alt"]]) @ turned * [1, -1, -1]
    xy = brown(in_cam, row["k1"], row["k2"], row["k3"], row["t1"], row["t2"])
    middle = np.array([row["px"], row["py"]]) * size + np.array([camera.width, camera.height]) / 2
    return row["f"] * size / 36 * xy + middle


FORMS = {
    "opensfm": (write_opensfm, through_opensfm),
    "meshroom": (write_meshroom, through_meshroom),
    "openmvg": (write_openmvg, through_openmvg),
    "realitycapture": (write_realitycapture, through_realitycapture),
}


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("model", sorted(FAMILY_MODELS))
@pytest.mark.parametrize("several", [False, True])
def test_points_appear_where_they_do_for_us(tmp_path, form, model, several):
    refined = made(model, several=several)
    write, through = FORMS[form]
    path = tmp_path / "file"
    if form == "realitycapture" and "FISHEYE" in model:
        with pytest.raises(InputError) as caught:
            write(refined, path)
        assert_complete(caught.value, "export_not_possible", "file")
        return
    write(refined, path)
    for index in range(len(refined)):
        points = seen_points(refined, index)
        apart = through(path, refined, index, points) - ours(refined, index, points)
        assert np.abs(apart).max() < CLOSE_PX


@pytest.mark.parametrize("form", FORMS)
def test_lenses_that_a_program_does_not_have_are_refused(tmp_path, form):
    write, _ = FORMS[form]
    rational, oblong = random_result(21, model="FULL_OPENCV"), random_result(21, model="OPENCV")
    carried = random_result(21, model="FOV")
    wide = replace(carried, cameras=(Camera("EUCM", 64, 48, (25.0, 25.0, 32.0, 24.0, 0.6, 1.1)),))
    assert wide.cameras[0].full().fisheye
    assert not carried.cameras[0].full().fisheye
    for refined in [rational, carried, wide] + ([] if form == "opensfm" else [oblong]):
        with pytest.raises(InputError) as caught:
            write(refined, tmp_path / "file")
        assert_complete(caught.value, "export_not_possible", "file")
        assert list(tmp_path.iterdir()) == []
    if form == "opensfm":
        write(oblong, tmp_path / "file")


@pytest.mark.parametrize("form", ["meshroom", "openmvg"])
def test_points_are_seen_by_their_views_at_their_features(tmp_path, form):
    refined = made("SIMPLE_RADIAL")
    FORMS[form][0](refined, tmp_path / "file")
    document, model = json.loads((tmp_path / "file").read_text()), refined.model
    found = {}
    for row in document["structure"]:
        if form == "meshroom":
            seen = {int(o["observationId"]) - 1: (o["featureId"], o["x"]) for o in row["observations"]}
            number, xyz = row["landmarkId"], row["X"]
            k = int(np.flatnonzero(model.points.ids == int(number))[0])
            assert [int(value) for value in row["color"]] == model.points.rgb[k].tolist()
        else:
            seen = {o["key"]: (o["value"]["id_feat"], o["value"]["x"]) for o in row["value"]["observations"]}
            number, xyz = row["key"], row["value"]["X"]
        found[int(number)] = (np.array(xyz, float), seen)
    assert len(found) == len(model.points) > 0
    for k, number in enumerate(model.points.ids.tolist()):
        xyz, seen = found[number]
        np.testing.assert_array_equal(xyz, model.points.xyz[k])
        track = slice(model.points.track_starts[k], model.points.track_starts[k + 1])
        images, features = model.points.track_image_ids[track], model.points.track_point2d_indices[track]
        assert set(seen) == {refined.image_ids.index(image) for image in images.tolist()}
        first = dict(
            zip(images.tolist()[::-1], features.tolist()[::-1], strict=True)
        )  # a view sees a point once
        for image, feature in first.items():
            there, xy = seen[refined.image_ids.index(image)]
            assert int(there) == feature
            np.testing.assert_array_equal(np.array(xy, float), model.images[image].points2d_px[feature])


def test_opensfm_has_the_points_with_their_colours(tmp_path):
    refined = made("SIMPLE_RADIAL")
    write_opensfm(refined, tmp_path / "file")
    [reconstruction] = json.loads((tmp_path / "file").read_text())
    points = refined.model.points
    assert list(reconstruction["points"]) == [str(number) for number in points.ids.tolist()]
    for row, xyz, rgb in zip(reconstruction["points"].values(), points.xyz, points.rgb, strict=True):
        assert (row["coordinates"], row["color"]) == (xyz.tolist(), rgb.tolist())


@pytest.mark.parametrize("turn", [np.eye(3), np.diag([1.0, -1.0, -1.0]), np.diag([-1.0, -1.0, 1.0])])
@pytest.mark.parametrize("pitch", [0.0, 90.0, -90.0])
def test_realitycapture_and_opensfm_hold_every_rotation(tmp_path, turn, pitch):
    refined = made("PINHOLE")
    pose = np.eye(4)
    pose[:3, :3] = turn @ Rotation.from_euler("X", pitch, degrees=True).as_matrix()
    refined = replace(refined, images=(replace(refined.images[0], world_from_cam=pose), *refined.images[1:]))
    for form in ("realitycapture", "opensfm"):
        write, through = FORMS[form]
        write(refined, tmp_path / form)
        points = seen_points(refined, 0)
        apart = through(tmp_path / form, refined, 0, points) - ours(refined, 0, points)
        assert np.abs(apart).max() < CLOSE_PX


@pytest.mark.parametrize("model", ["SIMPLE_PINHOLE", "PINHOLE"])
def test_neus_sees_points_where_we_do_in_the_order_of_names_and_has_them_in_its_sphere(tmp_path, model):
    refined = random_result(5, model=model)
    names = ["r_10.png", "r_2.png", "r_1.png", "r_0.png", "r_3.png"]
    images = [replace(i, file_name=name) for i, name in zip(refined.images, names, strict=True)]
    refined = replace(refined, images=tuple(images))
    write_neus(refined, tmp_path / "cameras_sphere.npz")
    with np.load(tmp_path / "cameras_sphere.npz") as file:
        matrices = dict(file)
    assert len(matrices) == 2 * len(refined)
    for row, name in enumerate(sorted(names)):
        index = names.index(name)
        points = seen_points(refined, index)
        x, y, z = matrices[f"world_mat_{row}"][:3] @ np.c_[points, np.ones(len(points))].T
        pixel = np.stack([x / z, y / z], 1) + 0.5  # its coordinates are the pixels' indices
        assert np.abs(pixel - ours(refined, index, points)).max() < CLOSE_PX
        inside = np.linalg.inv(matrices[f"scale_mat_{row}"]) @ np.c_[refined.model.points.xyz, np.ones(8)].T
        assert (np.linalg.norm(inside[:3], axis=0) <= 1).sum() >= 7


def test_neus_refuses_distortion(tmp_path):
    for model in ("SIMPLE_RADIAL", "OPENCV_FISHEYE"):
        with pytest.raises(InputError) as caught:
            write_neus(random_result(5, model=model), tmp_path / "cameras_sphere.npz")
        assert_complete(caught.value, "export_not_possible", "cameras_sphere.npz")
