"""transforms.json that cannot be used: refused by code, file, field and hint, whatever is wrong with it."""

from __future__ import annotations

import copy
import math
import sys
from collections import Counter
from types import BuiltinFunctionType

import numpy as np
import pytest
from PIL import Image

from biresnerf.data.formats.pose_rows import MAX_ROWS, parsed_rows
from biresnerf.data.formats.read_dataset import read_dataset
from biresnerf.data.formats.transforms.read_transforms import read_transforms
from biresnerf.errors import InputError
from biresnerf.options.formats import formats
from tests.data.scenes import (
    HEIGHT,
    WIDTH,
    assert_complete,
    blender_scene,
    nerfstudio_scene,
    save,
    write_image,
)


# Each case: the code, what the place must name, and what is done to a good document.
def _frame(index, **values):
    return lambda document: document["frames"][index].update(values)


def _matrix(index, row, column, value):
    def change(document):
        document["frames"][index]["transform_matrix"][row][column] = value

    return change


def _scaled_rotation(document):
    matrix = np.array(document["frames"][1]["transform_matrix"])
    matrix[:3, :3] *= 1.5
    document["frames"][1]["transform_matrix"] = matrix.tolist()


def _mirrored(document):
    matrix = np.array(document["frames"][1]["transform_matrix"])
    matrix[:3, 0] *= -1
    document["frames"][1]["transform_matrix"] = matrix.tolist()


def _transposed(document):
    matrix = np.array(document["frames"][3]["transform_matrix"])
    document["frames"][3]["transform_matrix"] = matrix.T.tolist()


def _same_place(document):
    for row in document["frames"]:
        for axis in range(3):
            row["transform_matrix"][axis][3] = 1.0


def _angle(value):
    def change(document):
        del document["fl_x"], document["fl_y"]
        document["camera_angle_x"] = value

    return change


def _without(*keys):
    def change(document):
        for key in keys:
            del document[key]

    return change


BAD = {
    "nan in a pose": ("pose_not_finite", "frames[2].transform_matrix[0][3]", _matrix(2, 0, 3, math.nan)),
    "infinite pose": ("pose_not_finite", "frames[1].transform_matrix[2][1]", _matrix(1, 2, 1, math.inf)),
    "text in a pose": ("pose_shape", "frames[1].transform_matrix", _matrix(1, 2, 1, "0.5")),
    "true in a pose": ("pose_shape", "frames[1].transform_matrix", _matrix(1, 2, 1, True)),
    "huge number": ("pose_shape", "frames[1].transform_matrix", _matrix(1, 2, 1, 10**400)),
    "far away": ("pose_out_of_range", "frames[1].transform_matrix", _matrix(1, 2, 3, 1e12)),
    "flat matrix": ("pose_shape", "frames[0].transform_matrix", _frame(0, transform_matrix=[1.0] * 16)),
    "two rows": ("pose_shape", "frames[0].transform_matrix", _frame(0, transform_matrix=[[1, 0, 0, 0]] * 2)),
    "short rows": ("pose_shape", "frames[0].transform_matrix", _frame(0, transform_matrix=[[1, 0, 0]] * 3)),
    "last row": ("pose_not_rotation", "frames[0].transform_matrix", _matrix(0, 3, 3, 2.0)),
    "transposed": ("pose_shape", "frames[3].transform_matrix", _transposed),
    "sheared": ("pose_not_rotation", "frames[0].transform_matrix", _matrix(0, 0, 0, 3.0)),
    "zeros": ("pose_not_rotation", "frames[0]", _frame(0, transform_matrix=[[0] * 4] * 3 + [[0, 0, 0, 1]])),
    "scaled": ("pose_not_rotation", "frames[1].transform_matrix", _scaled_rotation),
    "mirrored": ("pose_not_rotation", "frames[1].transform_matrix", _mirrored),
    "one place": ("poses_coincide", "frames", _same_place),
    "no such mask": ("mask_missing", "frames[2].mask_path", _frame(2, mask_path="masks/2.png")),
    "number for a mask": ("mask_missing", "frames[2].mask_path", _frame(2, mask_path=7)),
    "no image name": (
        "frame_without_image",
        "frames[1].file_path",
        lambda d: d["frames"][1].pop("file_path"),
    ),
    "empty image name": ("frame_without_image", "frames[1].file_path", _frame(1, file_path="")),
    "number for a name": ("frame_without_image", "frames[1].file_path", _frame(1, file_path=7)),
    "missing image": ("image_missing", "frames[1].file_path", _frame(1, file_path="images/none.jpg")),
    "folder for an image": ("image_missing", "frames[1].file_path", _frame(1, file_path="images")),
    "nul in a name": ("image_missing", "frames[1].file_path", _frame(1, file_path="images/\0.jpg")),
    "long name": ("image_missing", "frames[1].file_path", _frame(1, file_path="x" * 5000)),
    "twice": ("duplicate_image", "frames[3].file_path", _frame(3, file_path="./images/001.jpg")),
    "two frames": ("too_few_images", "frames", lambda d: d["frames"].__delitem__(slice(2, None))),
    "no frames": ("too_few_images", "frames", lambda d: d.update(frames=[])),
    "frames is text": ("pose_file_invalid", "frames", lambda d: d.update(frames="images")),
    "frame is a list": ("pose_file_invalid", "frames[1]", lambda d: d["frames"].__setitem__(1, [])),
    "frames missing": ("pose_file_invalid", "frames", _without("frames")),
    "another fisheye": (
        "camera_model_unsupported",
        "camera_model",
        lambda d: d.update(camera_model="CYLINDER"),
    ),
    "own fisheye": ("camera_model_unsupported", "frames[2].camera_model", _frame(2, camera_model="CYLINDER")),
    "odd model": ("camera_model_unsupported", "camera_model", lambda d: d.update(camera_model=["OPENCV"])),
    "two lenses": ("camera_model_unsupported", "is_fisheye", lambda d: d.update(is_fisheye=True)),
    "fisheye perhaps": ("camera_model_unsupported", "is_fisheye", lambda d: d.update(is_fisheye="no")),
    "panorama": ("camera_model_unsupported", "equirectangular", lambda d: d.update(equirectangular=True)),
    "tangential fisheye": (
        "camera_model_unsupported",
        "p2",
        lambda d: d.update(camera_model="OPENCV_FISHEYE", p2=0.001),
    ),
    "k5 of OPENCV": ("camera_model_unsupported", "k5", lambda d: d.update(k5=0.01)),
    "fisheye all around": (
        "intrinsics_invalid",
        "k1",
        lambda d: d.update(camera_model="OPENCV_FISHEYE", fl_x=4.0, fl_y=4.0),
    ),
    "own k4": ("camera_model_unsupported", "frames[1].k4", _frame(1, k4=0.01)),
    "negative focal": ("intrinsics_invalid", "fl_x", lambda d: d.update(fl_x=-18.0)),
    "zero focal": ("intrinsics_invalid", "frames[2].fl_y", _frame(2, fl_y=0)),
    "focal is text": ("intrinsics_invalid", "fl_x", lambda d: d.update(fl_x="18")),
    "nan focal": ("pose_not_finite", "fl_x", lambda d: d.update(fl_x=math.nan)),
    "huge focal": ("intrinsics_invalid", "fl_x", lambda d: d.update(fl_x=10**400)),
    "centre without focal": ("intrinsics_missing", "frames[0]", _without("fl_x", "fl_y")),
    "negative angle": ("intrinsics_invalid", "camera_angle_x", _angle(-0.7)),
    "angle in degrees": ("intrinsics_invalid", "camera_angle_x", _angle(40.0)),
    "angle in radians": ("intrinsics_invalid", "x_fov", lambda d: d.update(x_fov=1.02)),
    "endless focal": ("intrinsics_invalid", "camera_angle_x", _angle(1e-9)),
    "wild lens": ("intrinsics_invalid", "k1", lambda d: d.update(k1=1000.0)),
    "wild tangential": ("intrinsics_invalid", "k1", lambda d: d.update(p1=50.0)),
    "centre outside": ("intrinsics_invalid", "cx", lambda d: d.update(cx=500.0)),
    "folding lens": ("intrinsics_invalid", "k1", lambda d: d.update(k1=-3.0)),
    "other shape": ("image_size_mismatch", "w", lambda d: d.update(w=40, h=20)),
    "turned": ("image_size_mismatch", "w", lambda d: d.update(w=HEIGHT, h=WIDTH)),
    "size zero": ("intrinsics_invalid", "w", lambda d: d.update(w=0)),
    "bad applied": ("pose_shape", "applied_transform", lambda d: d.update(applied_transform=[1, 2, 3])),
    "scaled applied": (
        "pose_not_rotation",
        "applied_transform",
        lambda d: d.update(applied_transform=[[2, 0, 0, 0], [0, 2, 0, 0], [0, 0, 2, 0]]),
    ),
    "applied scale": ("pose_file_invalid", "applied_scale", lambda d: d.update(applied_scale=0)),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_files_are_refused_with_file_field_and_hint(tmp_path, case):
    code, place, change = BAD[case]
    document = nerfstudio_scene(tmp_path)
    read_dataset(save(tmp_path, copy.deepcopy(document)))  # good before the change
    change(document)
    with pytest.raises(InputError) as caught:
        read_dataset(save(tmp_path, document), strict=True)
    assert_complete(caught.value, code, "transforms.json", place)


def test_mixed_sizes_with_shared_intrinsics_are_refused(tmp_path):
    for document in (nerfstudio_scene(tmp_path), blender_scene(tmp_path)):
        document.pop("w", None), document.pop("h", None)
        name = document["frames"][2]["file_path"]
        suffix = "" if name.endswith(".jpg") else ".png"
        write_image(tmp_path / (name + suffix), size=(WIDTH + 4, HEIGHT))
        with pytest.raises(InputError) as caught:
            read_dataset(save(tmp_path, document))
        assert_complete(caught.value, "mixed_sizes", "transforms.json", "frames[2]")


@pytest.mark.parametrize("content", [b"", b"not an image", b"\x89PNG\r\n\x1a\n", b"GIF89a" + b"\0" * 50])
def test_files_that_are_no_images_are_refused(tmp_path, content):
    document = nerfstudio_scene(tmp_path)
    (tmp_path / "images/001.jpg").write_bytes(content)
    with pytest.raises(InputError) as caught:
        read_dataset(save(tmp_path, document), strict=True)
    assert_complete(caught.value, "not_an_image", "images/001.jpg")


def test_an_image_that_would_unpack_to_gigabytes_is_refused_from_its_header(tmp_path):
    document = nerfstudio_scene(tmp_path)
    Image.new("1", (30_000, 20_000)).save(tmp_path / "images/001.png")
    document["frames"][1]["file_path"] = "images/001.png"
    with pytest.raises(InputError) as caught:
        read_dataset(save(tmp_path, document), strict=True)
    assert_complete(caught.value, "image_too_large", "images/001.png")


@pytest.mark.parametrize(
    "name", ["../secret.png", "/etc/passwd", "images/../../secret.png", "link.png", "a\\..\\..\\x"]
)
def test_names_that_lead_out_of_a_strangers_folder_are_refused_whether_or_not_the_file_is_there(
    tmp_path, name
):
    folder = tmp_path / "set"
    folder.mkdir()
    write_image(tmp_path / "secret.png")
    (folder / "link.png").symlink_to(tmp_path / "secret.png")
    document = nerfstudio_scene(folder)
    path = save(folder, document)
    read_transforms(path, within=folder)
    document["frames"][1]["file_path"] = name
    with pytest.raises(InputError) as caught:
        read_transforms(save(folder, document), within=folder)
    assert_complete(caught.value, "unsafe_path", "transforms.json", "frames[1].file_path")
    document["frames"][1] |= {"file_path": "images/001.jpg", "mask_path": name}
    with pytest.raises(InputError) as caught:
        read_transforms(save(folder, document), within=folder)
    assert_complete(caught.value, "unsafe_path", "transforms.json", "frames[1].mask_path")


def test_a_file_that_is_no_json_is_refused_by_its_name(tmp_path):
    (tmp_path / "notes.pdf").touch()
    with pytest.raises(InputError) as caught:
        read_dataset(tmp_path / "notes.pdf")
    assert_complete(caught.value, "input_unsupported", "notes.pdf")


def test_a_path_that_does_not_exist_is_refused(tmp_path):
    with pytest.raises(InputError) as caught:
        read_dataset(tmp_path / "nothing")
    assert_complete(caught.value, "input_missing", "nothing")


def test_twenty_thousand_frames_for_a_few_files_are_refused_without_looking_for_each(tmp_path):
    document = nerfstudio_scene(tmp_path)
    document["frames"] = [{"file_path": f"images/{n}.jpg"} for n in range(20_000)]
    path = save(tmp_path, document)
    looked: Counter[str] = Counter()

    def note(_frame: object, event: str, what: object) -> None:
        if event == "c_call" and isinstance(what, BuiltinFunctionType):
            looked[what.__name__] += 1

    sys.setprofile(note)
    try:
        with pytest.raises(InputError, match="20000 frames, but the set has only 5 files") as caught:
            read_transforms(path, within=tmp_path)
    finally:
        sys.setprofile(None)
    assert caught.value.code == "image_missing"
    assert 0 < looked["stat"] + looked["lstat"] < 1000


def test_frames_without_files_are_refused_before_their_poses_are_looked_at(tmp_path):
    document = nerfstudio_scene(tmp_path)
    document["frames"] = [{"file_path": f"images/{n}.jpg", "transform_matrix": "none"} for n in range(200)]
    with pytest.raises(InputError, match="200 frames, but the set has only 5 files"):
        read_dataset(save(tmp_path, document), within=tmp_path)


def test_rows_and_models_of_images_that_no_file_is_there_for_are_refused_without_looking_for_each(tmp_path):
    nerfstudio_scene(tmp_path)
    rows = "".join(f"images/{n}.png,0,0,{n},1,0,0,0\n" for n in range(3000))
    (tmp_path / "poses.csv").write_text("image,x,y,z,qw,qx,qy,qz\n" + rows)
    with pytest.raises(InputError, match="3000 frames, but the set has only") as caught:
        read_dataset(tmp_path, within=tmp_path)
    assert_complete(caught.value, "image_missing", "poses.csv")
    (tmp_path / "poses.csv").unlink()
    model = tmp_path / "sparse"
    model.mkdir()
    (model / "cameras.txt").write_text("1 PINHOLE 32 32 30 30 16 16\n")
    (model / "points3D.txt").touch()
    (model / "images.txt").write_text("".join(f"{n + 1} 1 0 0 0 0 0 {n} 1 {n}.png\n\n" for n in range(3000)))
    with pytest.raises(InputError, match="3000 frames, but the set has only") as caught:
        read_dataset(tmp_path, within=tmp_path)
    assert_complete(caught.value, "image_missing", "images.txt")


def test_more_rows_than_any_set_has_are_refused_before_they_are_read(tmp_path):
    def read(_value, _where):
        raise AssertionError("a row was read")

    rows = [(str(n), f"row {n}", n) for n in range(MAX_ROWS + 1)]
    with pytest.raises(InputError, match="more than 100000 poses"):
        parsed_rows(formats()["csv"], [tmp_path / "poses.csv"], rows, read)
