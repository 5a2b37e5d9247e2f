"""Broken and hostile trajectories, npy, bundle and XML files: each gets its clear error, at once, in little memory."""

from __future__ import annotations

import contextlib
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from biresnerf.data.formats.read_dataset import read_dataset
from biresnerf.data.model.dataset import Dataset
from biresnerf.errors import InputError
from tests.data.formats.simple import trajectories
from tests.data.formats.simple.trajectories import NAMES, npy_bytes
from tests.data.scenes import refused_at_once, write_image


def refused(path: Path) -> InputError:
    """The error that the input gets, within bounds of time and memory."""
    error = refused_at_once(lambda: read_dataset(path, strict=True))
    assert error.where
    return error


HEADER = "{'descr': '<f8', 'fortran_order': False, 'shape': (%s), }"
NPY = {
    "empty file": (b"", "pose_file_invalid"),
    "no npy": (b"PK\x03\x04 something else", "pose_file_invalid"),
    "pickled objects": (npy_bytes(HEADER.replace("<f8", "|O") % "4, 17", b"\x80\x04."), "pose_file_invalid"),
    "2^60 rows": (npy_bytes(HEADER % f"{2**60}, 17", b""), "pose_file_invalid"),
    "more rows than numbers": (npy_bytes(HEADER % "4, 17", bytes(8 * 17)), "pose_file_invalid"),
    "more numbers than rows": (npy_bytes(HEADER % "4, 17", bytes(5 * 8 * 17)), "pose_file_invalid"),
    "negative rows": (npy_bytes(HEADER % "-4, 17", b""), "pose_file_invalid"),
    "other columns": (npy_bytes(HEADER % "4, 15", bytes(4 * 8 * 15)), "pose_file_invalid"),
    "whole numbers": (
        npy_bytes(HEADER.replace("<f8", "<i8") % "4, 17", bytes(4 * 8 * 17)),
        "pose_file_invalid",
    ),
    "a program for a header": (npy_bytes("__import__('os').system('true')", b""), "pose_file_invalid"),
    "an endless header": (npy_bytes("(" * 60_000, b""), "pose_file_invalid"),
    "NaN": (npy_bytes(HEADER % "4, 17", np.full(68, np.nan).tobytes()), "pose_not_finite"),
    "no rotation": (npy_bytes(HEADER % "4, 17", bytes(4 * 8 * 17)), "pose_not_rotation"),
}


@pytest.mark.parametrize("fault", NPY)
def test_a_bad_poses_bounds_is_refused(tmp_path, fault):
    trajectories.llff_set(tmp_path)
    content, code = NPY[fault]
    (tmp_path / "poses_bounds.npy").write_bytes(content)
    assert refused(tmp_path).code == code


def test_poses_bounds_cut_off_at_any_of_many_bytes_is_refused(tmp_path):
    file = trajectories.llff_set(tmp_path)
    whole = file.read_bytes()
    for length in [*range(0, 140), *range(140, len(whole), 37)]:
        file.write_bytes(whole[:length])
        assert refused(file).code == "pose_file_invalid"


@pytest.mark.parametrize("focal", [0.0, -18.0, 1e12])
def test_an_llff_camera_that_is_none_is_refused(tmp_path, focal):
    trajectories.llff_set(tmp_path, focal=focal)
    assert refused(tmp_path).code == "intrinsics_invalid"


@pytest.mark.parametrize("form", ["llff", "kitti", "tum", "bundler"])
def test_poses_that_go_by_order_are_refused_where_there_are_more_or_fewer_images(tmp_path, form):
    if form == "llff":
        trajectories.llff_set(tmp_path)
    elif form == "kitti":
        trajectories.kitti_set(tmp_path)
    elif form == "tum":
        trajectories.tum_set(tmp_path, ["10", "11", "12", "13"])
    else:
        trajectories.bundler_set(tmp_path, listed=False)
    write_image(tmp_path / "images/e.png")
    assert refused(tmp_path).code == "pose_count_mismatch"


LINES = {
    "a word": ("0 0 0 0 0 0 0 one", "pose_file_invalid"),
    "seven numbers": ("0 0 0 0 0 0 1", "pose_file_invalid"),
    "twelve among eights": ("1 0 0 0 0 1 0 0 0 0 1 0", "pose_file_invalid"),
    "NaN": ("9 nan 0 0 0 0 0 1", "pose_not_finite"),
    "infinite": ("9 0 0 1e999 0 0 0 1", "pose_not_finite"),
    "zero quaternion": ("9 0 0 0 0 0 0 0", "pose_not_rotation"),
    "far away": ("9 1e12 0 0 0 0 0 1", "pose_out_of_range"),
    "a time twice": ("3 0 0 0 0 0 0 1", "pose_file_invalid"),
}


@pytest.mark.parametrize("fault", LINES)
def test_a_bad_line_of_a_trajectory_is_refused_with_its_number(tmp_path, fault):
    file = trajectories.tum_set(tmp_path, ["0", "1", "2", "3"])
    line, code = LINES[fault]
    file.write_text(file.read_text() + line + "\n")
    error = refused(tmp_path)
    assert error.code == code
    assert error.where == ("trajectory.txt" if fault == "a time twice" else "trajectory.txt line 5")


@pytest.mark.parametrize("content", [b"", b"# nothing but a comment\n", b"\xff\xfe\x00\x01"])
def test_a_trajectory_of_no_poses_is_refused(tmp_path, content):
    file = trajectories.tum_set(tmp_path, ["0", "1", "2", "3"])
    file.write_bytes(content)
    assert refused(tmp_path).code == "pose_file_invalid"


@pytest.mark.parametrize(
    ("name", "text", "code"),
    [
        ("camera.json", "{", "pose_file_invalid"),
        ("camera.json", "{}", "intrinsics_missing"),
        ("camera.json", '{"fl_x": -1}', "intrinsics_invalid"),
        ("cameras.txt", "", "pose_file_invalid"),
        ("cameras.txt", "1 PINHOLE 20 16 18 18 10 8\n2 PINHOLE 20 16 18 18 10 8\n", "pose_file_invalid"),
        ("cameras.txt", "1 PINHOLE 30 16 18 18 15 8\n", "image_size_mismatch"),
        ("calib.txt", "P1: 0 0 0\n", "pose_file_invalid"),
        ("calib.txt", "P0: 18 0 10\n", "pose_file_invalid"),
        ("calib.txt", "P0: nan 0 10 0 0 18 8 0 0 0 1 0\n", "intrinsics_invalid"),
    ],
)
def test_a_bad_camera_beside_a_trajectory_is_refused(tmp_path, name, text, code):
    trajectories.tum_set(tmp_path, ["0", "1", "2", "3"])
    (tmp_path / "camera.json").unlink()
    (tmp_path / name).write_text(text)
    assert refused(tmp_path).code == code


def test_a_bundle_file_cut_off_at_any_line_is_refused(tmp_path):
    file = trajectories.bundler_set(tmp_path)
    lines = file.read_text().splitlines()
    for length in range(len(lines)):
        file.write_text("\n".join(lines[:length]))
        assert refused(tmp_path).code == "pose_file_invalid"


@pytest.mark.parametrize(
    ("old", "new", "code"),
    [
        ("4 1", "1000000000 1", "pose_file_invalid"),
        ("4 1", f"4 {2**62}", "pose_file_invalid"),
        ("4 1", "-4 1", "pose_file_invalid"),
        ("18.5", "nan", "pose_not_finite"),
        ("18.5", "-18.5", "intrinsics_invalid"),
        ("18.5", "wide", "pose_file_invalid"),
    ],
)
def test_a_bundle_file_of_bad_numbers_is_refused(tmp_path, old, new, code):
    file = trajectories.bundler_set(tmp_path)
    file.write_text(file.read_text().replace(old, new, 1))
    assert refused(tmp_path).code == code


@pytest.mark.parametrize(
    ("names", "code"),
    [
        (NAMES[:3], "pose_count_mismatch"),
        (("a.png", "a.png", "c.png", "d.png"), "duplicate_image"),
        (("../a.png", "b.png", "c.png", "d.png"), "unsafe_path"),
        (("z.png", "b.png", "c.png", "y.png"), "image_missing"),
    ],
)
def test_a_bad_list_of_images_is_refused(tmp_path, names, code):
    trajectories.bundler_set(tmp_path)
    (tmp_path / "list.txt").write_text("\n".join(names))
    assert refused(tmp_path).code == code


LAUGHS = "".join(f'<!ENTITY l{i} "{f"&l{i - 1};" * 10}">' for i in range(1, 12))
XML = {
    "cut off": (lambda text: text[:400], "pose_file_invalid"),
    "a thousand million laughs": (
        lambda text: text.replace("<document", f'<!DOCTYPE d [<!ENTITY l0 "ha">{LAUGHS}]><document', 1),
        "pose_file_invalid",
    ),
    "a file of ours": (
        lambda text: text.replace("<document", '<!DOCTYPE d [<!ENTITY x SYSTEM "file:///etc/passwd">]><document', 1),
        "pose_file_invalid",
    ),
    "too deep": (
        lambda text: text.replace("<cameras>", "<a>" * 100_000 + "</a>" * 100_000 + "<cameras>"),
        "pose_file_invalid",
    ),
    "two chunks": (lambda text: text.replace("</document>", "<chunk/></document>"), "pose_file_invalid"),
    "a label twice": (lambda text: text.replace('label="b"', 'label="a"'), "duplicate_image"),
    "a label that leads out": (lambda text: text.replace('label="b"', 'label="../b"'), "unsafe_path"),
    "no such image": (lambda text: text.replace('label="b"', 'label="z"'), "image_missing"),
    "NaN": (lambda text: text.replace("<transform>", "<transform>nan ", 1), "pose_not_finite"),
    "a number too many": (lambda text: text.replace("<transform>", "<transform>1 ", 1), "pose_file_invalid"),
    "fisheye": (lambda text: text.replace('ion type="frame"', 'ion type="fisheye"'), "camera_model_unsupported"),
    "skewed pixels": (lambda text: text.replace("<f>", "<b2>2.5</b2><f>"), "intrinsics_invalid"),
    "no focal length": (lambda text: text.replace("<f>18.5</f>", ""), "intrinsics_invalid"),
    "no size": (lambda text: text.replace('width="20"', 'width="wide"'), "pose_file_invalid"),
}  # fmt: skip


@pytest.mark.parametrize("fault", XML)
def test_a_bad_metashape_export_is_refused(tmp_path, fault):
    trajectories.write_images(tmp_path)
    change, code = XML[fault]
    text = change(trajectories.metashape_xml())
    assert text != trajectories.metashape_xml()
    (tmp_path / "cameras.xml").write_text(text)
    assert refused(tmp_path / "cameras.xml").code == code


@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data(), form=st.sampled_from(["llff", "tum", "kitti", "bundler", "metashape"]))
def test_no_change_of_a_file_makes_its_reader_fail_otherwise_than_by_an_input_error(tmp_path, data, form):
    folder = tmp_path / form
    file = {
        "llff": trajectories.llff_set,
        "tum": lambda f: trajectories.tum_set(f, ["0", "1", "2", "3"]),
        "kitti": trajectories.kitti_set,
        "bundler": trajectories.bundler_set,
        "metashape": lambda f: f / "cameras.xml",
    }[form](folder)
    if form == "metashape":
        trajectories.write_images(folder)
        file.write_text(trajectories.metashape_xml())
    content = file.read_bytes()
    at = data.draw(st.integers(0, len(content)))
    words = [
        b"",
        b" ",
        b"\n",
        b"nan",
        b"-",
        b"1e400",
        b"0",
        b"\xff",
        b"\x00",
        b"<",
        b'"',
        b"99999999999999999999",
    ]
    patch = data.draw(st.sampled_from(words) | st.binary(max_size=4))
    kept = at + data.draw(st.sampled_from([0, 1, len(patch), 40]))
    file.write_bytes(content[:at] + patch + content[kept:])
    with contextlib.suppress(InputError):
        assert isinstance(read_dataset(file), Dataset)
