"""RealityCapture: the csv as it is written and as users cut its columns, and the XMP beside each photo."""

from __future__ import annotations

import csv
import io
from dataclasses import replace
from pathlib import PurePosixPath

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from biresnerf.data.formats.photogrammetry.realitycapture import COLUMNS, write_realitycapture
from biresnerf.data.formats.read_dataset import read_dataset
from biresnerf.errors import InputError
from biresnerf.geometry.camera.camera_models import FAMILY_MODELS
from tests.data.formats.photogrammetry.test_write_photogrammetry import made
from tests.data.formats.posed_sets import assert_reads_as, write_photos
from tests.data.scenes import assert_complete, write_image

MODELS = sorted(name for name in FAMILY_MODELS if "FISHEYE" not in name)


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("several", [False, True])
def test_what_is_written_comes_back(tmp_path, model, several):
    refined = made(model, several=several)
    write_photos(tmp_path, refined)
    write_realitycapture(refined, tmp_path / "realitycapture.csv")
    for path in (tmp_path, tmp_path / "realitycapture.csv"):
        assert_reads_as(read_dataset(path), refined, "realitycapture")


def table_of(path) -> list[list[str]]:
    return list(csv.reader(path.read_text().splitlines()))


def save_table(path, table, head="") -> None:
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(table)
    path.write_text(head + text.getvalue())


def test_columns_that_a_lens_does_not_need_may_be_missing_and_a_count_may_stand_above(tmp_path):
    refined = made("SIMPLE_PINHOLE")
    cameras = [replace(camera, params=(camera.params[0], 32.0, 24.0)) for camera in refined.cameras]
    refined = replace(refined, cameras=tuple(cameras))
    write_photos(tmp_path, refined)
    write_realitycapture(refined, tmp_path / "out.csv")
    table = [[*row[:8][::-1]] for row in table_of(tmp_path / "out.csv")]  # in another order, too
    table = [[row[-1], *row[:-1]] for row in table]
    save_table(tmp_path / "out.csv", table, "#cameras 5\n")
    assert_reads_as(read_dataset(tmp_path), refined, "realitycapture")


@pytest.mark.parametrize("separator", [";", "\t"])
def test_semicolons_and_tabs_may_stand_between_columns(tmp_path, separator):
    refined = made("OPENCV")
    write_photos(tmp_path, refined)
    write_realitycapture(refined, tmp_path / "out.csv")
    text = (tmp_path / "out.csv").read_text().replace(",", separator)
    (tmp_path / "out.csv").write_text("# exported on a Tuesday\n" + text)
    assert_reads_as(read_dataset(tmp_path), refined, "realitycapture")


@pytest.mark.parametrize(
    ("row", "column", "value", "code"),
    [
        (2, "x", "east", "pose_file_invalid"),
        (2, "heading", "nan", "pose_not_finite"),
        (2, "k4", "0.1", "camera_model_unsupported"),
        (2, "roll", None, "pose_file_invalid"),
    ],
)
def test_one_bad_row_costs_one_image_its_pose(tmp_path, row, column, value, code):
    refined = made("PINHOLE")
    write_photos(tmp_path, refined)
    write_realitycapture(refined, tmp_path / "out.csv")
    table = table_of(tmp_path / "out.csv")
    if value is None:
        del table[row][-1]
    else:
        table[row][COLUMNS.index(column)] = value
    save_table(tmp_path / "out.csv", table)
    assert read_dataset(tmp_path).posed.tolist() == [True, False, True, True, True]
    with pytest.raises(InputError) as caught:
        read_dataset(tmp_path, strict=True)
    assert_complete(caught.value, code, "out.csv line 3")


def test_angles_that_may_be_radians_are_noted(tmp_path):
    refined = made("PINHOLE")
    write_photos(tmp_path, refined)
    write_realitycapture(refined, tmp_path / "out.csv")
    table, angles = (
        table_of(tmp_path / "out.csv"),
        [COLUMNS.index(name) for name in ("heading", "pitch", "roll")],
    )
    assert not any("radians" in note for note in read_dataset(tmp_path).warnings)
    for row in table[1:]:
        for column in angles:
            row[column] = str(np.radians(float(row[column])))
    save_table(tmp_path / "out.csv", table)
    assert any("if they are radians" in note for note in read_dataset(tmp_path).warnings)


def test_a_table_of_omega_phi_and_kappa_has_poses_and_no_lens(tmp_path):
    refined = made("SIMPLE_PINHOLE")
    write_photos(tmp_path, refined)
    table = ["#cameras 5", "#name,x,y,z,omega,phi,kappa"]
    for image, pose in zip(refined.images, refined.world_from_cam, strict=True):
        turn = Rotation.from_matrix(pose[:3, :3] @ np.diag([1, -1, -1]))
        kappa, phi, against_omega = turn.as_euler("YXZ", degrees=True)
        row = [PurePosixPath(image.file_name).name, *pose[:3, 3], -against_omega, phi, kappa]
        table.append(",".join(map(str, row)))
    (tmp_path / "survey.csv").write_text("\n".join(table))
    dataset = read_dataset(tmp_path)
    assert dataset.source.dialect == "realitycapture"
    names = [PurePosixPath(name).name for name in dataset.file_names]
    for image, pose in zip(refined.images, refined.world_from_cam, strict=True):
        index = names.index(PurePosixPath(image.file_name).name)
        np.testing.assert_allclose(dataset.world_from_cam[index], pose, atol=1e-9)
        assert dataset.source_of_intrinsics(dataset.frames[index].camera) != "given"


def test_a_table_without_focal_lengths_is_refused(tmp_path):
    write_image(tmp_path / "images/a.png")
    (tmp_path / "out.csv").write_text("#name,x,y,alt,heading,pitch,roll\na.png,0,0,0,0,0,0\n")
    with pytest.raises(InputError) as caught:
        read_dataset(tmp_path)
    assert_complete(caught.value, "pose_file_invalid", "out.csv line 1")


def xmp(pose, camera, as_elements=True, **extra) -> str:
    """As RealityCapture writes it: cam_from_world by rows, the centre, lengths in shares of the longer side."""
    full, size = camera.full(), max(camera.width, camera.height)
    values = {
        "Rotation": " ".join(map(repr, pose[:3, :3].T.ravel().tolist())),
        "Position": " ".join(map(repr, pose[:3, 3].tolist())),
        "DistortionCoeficients": f"{full.k1!r} {full.k2!r} {full.k3!r} 0 {full.p2!r} {full.p1!r}",
    }
    attributes = {
        "Version": 3, "DistortionModel": "brown3t2", "FocalLength35mm": full.fx * 36 / size, "Skew": 0,
        "AspectRatio": 1, "PrincipalPointU": (full.cx - camera.width / 2) / size,
        "PrincipalPointV": (full.cy - camera.height / 2) / size,
    } | extra  # fmt: skip
    if not as_elements:
        attributes, values = attributes | values, {}
    values = {key: value for key, value in values.items() if value}
    inside = "".join(f"<xcr:{key}>{value}</xcr:{key}>" for key, value in values.items())
    listed = " ".join(f'xcr:{key}="{value}"' for key, value in attributes.items())
    return (
        '<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">'
        f'<rdf:Description {listed} xmlns:xcr="http://www.capturingreality.com/ns/xcr/1.1#">{inside}'
        "</rdf:Description></rdf:RDF></x:xmpmeta>"
    )


def xmp_set(folder, refined, *, where="images", as_elements=True):
    write_photos(folder, refined)
    for index, image in enumerate(refined.images):
        text = xmp(refined.world_from_cam[index], refined.camera_of(index), as_elements)
        (folder / where / image.file_name.replace("images/", "")).with_suffix(".xmp").write_text(text)


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("as_elements", [True, False])
def test_the_xmp_beside_each_photo_is_its_pose_and_lens(tmp_path, model, as_elements):
    refined = made(model)
    xmp_set(tmp_path, refined, as_elements=as_elements)
    for path in (tmp_path, tmp_path / "images", next(tmp_path.rglob("*.xmp"))):
        assert_reads_as(read_dataset(path), refined, "realitycapture-xmp")


@pytest.mark.parametrize(
    ("text", "code"),
    [
        (lambda text: text.replace("brown3t2", "rationalP2D1"), "camera_model_unsupported"),
        (lambda text: text.replace('AspectRatio="1"', 'AspectRatio="1.1"'), "camera_model_unsupported"),
        (lambda text: text.replace("<xcr:Position>", "<xcr:Position>1 "), "pose_file_invalid"),
        (lambda text: text.replace("<xcr:Rotation>", "<xcr:Rotation>x"), "pose_file_invalid"),
        (lambda text: text[:-5], "pose_file_invalid"),
        (lambda text: "<!DOCTYPE a>" + text, "pose_file_invalid"),
    ],
)
def test_a_bad_xmp_costs_one_image_its_pose(tmp_path, text, code):
    xmp_set(tmp_path, made("OPENCV"))
    file = sorted(tmp_path.rglob("*.xmp"))[1]
    file.write_text(text(file.read_text()))
    assert read_dataset(tmp_path).posed.tolist() == [True, False, True, True, True]
    with pytest.raises(InputError) as caught:
        read_dataset(tmp_path, strict=True)
    assert_complete(caught.value, code, file.name)


def test_an_xmp_with_a_lens_alone_gives_no_pose(tmp_path):
    xmp_set(tmp_path, made("OPENCV"))
    for number, file in enumerate(sorted(tmp_path.rglob("*.xmp"))):
        if number == 1:
            text = file.read_text()
            file.write_text(text[: text.index("<xcr:Rotation")] + text[text.index("<xcr:Distortion") :])
    assert read_dataset(tmp_path).posed.tolist() == [True, False, True, True, True]


def test_the_articles_example_stands_where_its_numbers_say(tmp_path):
    rotation = (
        "-0.600806990019897 0.799386597570746 -0.00346819369376912 -0.210825371930633 -0.162635135620312 "
        "-0.963899618846316 -0.771092486861039 -0.578386445454965 0.266243303052733"
    )
    for index in range(3):
        write_image(tmp_path / f"images/{index}.png", index)
        text = xmp(np.eye(4), made("PINHOLE").cameras[0])
        start, end = text.index("<xcr:Rotation>") + 14, text.index("</xcr:Rotation>")
        text = text[:start] + rotation + text[end:]
        place = f"<xcr:Position>{2111.44219951044 + index} 1607.86624656544 2302.25896526736"
        text = text.replace("<xcr:Position>0.0 0.0 0.0", place)
        (tmp_path / f"images/{index}.xmp").write_text(text)
    pose = read_dataset(tmp_path).world_from_cam[0]
    np.testing.assert_allclose(pose[:3, 3], [2111.44219951044, 1607.86624656544, 2302.25896526736])
    np.testing.assert_allclose(pose[:3, 2], [-0.771092486861039, -0.578386445454965, 0.266243303052733])
