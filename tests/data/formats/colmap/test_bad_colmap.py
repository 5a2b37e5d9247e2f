"""Hostile and broken COLMAP models: each gets a clear error at once; none is accepted silently or exhausts memory."""

from __future__ import annotations

import contextlib
import struct

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from biresnerf.data.formats.colmap.model_checks import model_name_of_id
from biresnerf.data.formats.colmap.read_model import read_colmap_model
from biresnerf.data.model.colmap_scene import ColmapModel
from biresnerf.errors import InputError
from tests.data.formats.colmap.colmap_files import TINY_TEXT, image_record, tiny_tables, write_tables
from tests.data.scenes import assert_complete, refused_at_once


def refused(folder, tables) -> InputError:
    """The error that the model gets, within bounds of time and memory."""
    write_tables(folder, tables)
    return refused_at_once(lambda: read_colmap_model(folder))


def packed(table: str, at: int, form: str, *values) -> dict[str, bytes]:
    """The tiny model with ``values`` written over a table's bytes ``at``."""
    tables = tiny_tables()
    content = bytearray(tables[table])
    struct.pack_into("<" + form, content, at, *values)
    tables[table] = bytes(content)
    return tables


@pytest.mark.parametrize("table", sorted(tiny_tables()))
def test_a_file_cut_off_at_any_byte_is_refused(tmp_path, table):
    whole = tiny_tables()[table]
    for length in range(len(whole)):
        error = refused(tmp_path, tiny_tables() | {table: whole[:length]})
        assert_complete(error, "pose_file_invalid", table)
    error = refused(tmp_path, tiny_tables() | {table: whole + b"\0"})
    assert "1 bytes follow the last record" in error.detail


HUGE = [
    ("cameras.bin", 0), ("images.bin", 0), ("points3D.bin", 0), ("rigs.bin", 0), ("frames.bin", 0),
    ("images.bin", 8 + 64 + 6),  # features of the first image
    ("points3D.bin", 8 + 43),  # its track
]  # fmt: skip


@pytest.mark.parametrize(("table", "at"), HUGE)
@pytest.mark.parametrize("count", [2**60, 2**64 - 1, 10**6])
def test_a_count_beyond_the_file_is_refused_before_anything_is_allocated(tmp_path, table, at, count):
    assert_complete(refused(tmp_path, packed(table, at, "Q", count)), "pose_file_invalid", table)


@pytest.mark.parametrize(("table", "at"), [("rigs.bin", 12), ("frames.bin", 8 + 64)])
def test_a_rig_or_frame_of_four_thousand_million_sensors_is_refused(tmp_path, table, at):
    assert_complete(refused(tmp_path, packed(table, at, "I", 2**32 - 1)), "pose_file_invalid", table)


NAN, INF = float("nan"), float("inf")
WRONG = {
    "unknown camera model": (packed("cameras.bin", 12, "i", 99), "camera_model_unsupported"),
    "negative camera model": (packed("cameras.bin", 12, "i", -2), "camera_model_unsupported"),
    "zero width": (packed("cameras.bin", 16, "Q", 0), "intrinsics_invalid"),
    "huge height": (packed("cameras.bin", 24, "Q", 2**63), "intrinsics_invalid"),
    "focal length NaN": (packed("cameras.bin", 32, "d", NAN), "intrinsics_invalid"),
    "focal length negative": (packed("cameras.bin", 32, "d", -18.0), "intrinsics_invalid"),
    "principal point infinite": (packed("cameras.bin", 48, "d", INF), "intrinsics_invalid"),
    "quaternion NaN": (packed("images.bin", 12, "d", NAN), "pose_not_finite"),
    "quaternion zero": (packed("images.bin", 12, "d", 0.0), "pose_not_rotation"),
    "quaternion of length 2": (packed("images.bin", 12, "d", 2.0), "pose_not_rotation"),
    "translation infinite": (packed("images.bin", 44, "d", -INF), "pose_not_finite"),
    "translation beyond reach": (packed("images.bin", 44, "d", 1e12), "pose_out_of_range"),
    "dangling camera": (packed("images.bin", 68, "I", 8), "pose_file_invalid"),
    "feature NaN": (packed("images.bin", 86, "d", NAN), "pose_not_finite"),
    "feature of a missing point": (packed("images.bin", 102, "Q", 6), "pose_file_invalid"),
    "feature without the point that names it": (packed("images.bin", 102, "Q", 2**64 - 1), "pose_file_invalid"),
    "point id out of range": (packed("images.bin", 102, "Q", 2**63 + 9), "pose_file_invalid"),
    "point NaN": (packed("points3D.bin", 16, "d", NAN), "pose_not_finite"),
    "point error NaN": (packed("points3D.bin", 43, "d", NAN), "pose_not_finite"),
    "point beyond float32": (packed("points3D.bin", 16, "d", 1e308), "pose_out_of_range"),
    "point error beyond float32": (packed("points3D.bin", 43, "d", -1e300), "pose_out_of_range"),
    "feature far from its image": (packed("images.bin", 86, "d", 1e300), "pose_out_of_range"),
    "track of a missing image": (packed("points3D.bin", 59, "I", 99), "pose_file_invalid"),
    "track of a missing feature": (packed("points3D.bin", 63, "I", 2), "pose_file_invalid"),
    "rig of a missing camera": (packed("rigs.bin", 20, "I", 8), "pose_file_invalid"),
    "rig of an unknown sensor": (packed("rigs.bin", 16, "i", 5), "pose_file_invalid"),
    "frame of a missing rig": (packed("frames.bin", 12, "I", 8), "pose_file_invalid"),
    "frame quaternion zero": (packed("frames.bin", 16, "d", 0.0), "pose_not_rotation"),
    "frame of a missing image": (packed("frames.bin", 84, "Q", 99), "pose_file_invalid"),
    "image in two frames": (packed("frames.bin", 84, "Q", 12), "pose_file_invalid"),
    "frame of a sensor the rig lacks": (packed("frames.bin", 80, "I", 8), "pose_file_invalid"),
}  # fmt: skip


@pytest.mark.parametrize("fault", WRONG)
def test_what_no_model_can_say_is_refused(tmp_path, fault):
    tables, code = WRONG[fault]
    assert refused(tmp_path, tables).code == code


def with_images(*records: bytes) -> dict[str, bytes]:
    """The tiny model without rigs and points, with other images."""
    tables = tiny_tables()
    del tables["rigs.bin"], tables["frames.bin"], tables["points3D.bin"]
    return tables | {"images.bin": struct.pack("<Q", len(records)) + b"".join(records)}


@pytest.mark.parametrize(
    "name",
    [
        b"../x.png",
        b"/etc/passwd",
        b"a/../../x.png",
        b"..\\x.png",
        b"C:\\x.png",
        b"c:/x.png",
        b"..",
        b"a/../..",
    ],
)
def test_a_name_that_leads_out_of_the_images_is_refused(tmp_path, name):
    assert_complete(refused(tmp_path, with_images(image_record(1, name))), "unsafe_path", "image 1")


@pytest.mark.parametrize("name", [b"", b"a\nb.png", b"\xff\xfe.png", b"x" * 5000])
def test_a_name_that_is_none_is_refused(tmp_path, name):
    assert_complete(refused(tmp_path, with_images(image_record(1, name))), "pose_file_invalid", "images.bin")


def test_ids_and_names_that_stand_twice_are_refused(tmp_path):
    a = image_record(1, b"a.png")
    error = refused(tmp_path, with_images(a, image_record(2, b"a.png")))
    assert_complete(error, "duplicate_image", "image 2")
    error = refused(tmp_path, with_images(a, image_record(1, b"b.png")))
    assert_complete(error, "pose_file_invalid", "images.bin image 1")
    camera = tiny_tables()["cameras.bin"]
    error = refused(tmp_path, tiny_tables() | {"cameras.bin": struct.pack("<Q", 2) + camera[8:] * 2})
    assert_complete(error, "pose_file_invalid", "cameras.bin camera 7")
    points = tiny_tables()["points3D.bin"]
    error = refused(tmp_path, tiny_tables() | {"points3D.bin": struct.pack("<Q", 2) + points[8:] * 2})
    assert_complete(error, "pose_file_invalid", "points3D.bin")


@pytest.mark.parametrize("missing", ["rigs.bin", "frames.bin"])
def test_rigs_without_frames_and_frames_without_rigs_are_refused(tmp_path, missing):
    tables = tiny_tables()
    del tables[missing]
    assert_complete(refused(tmp_path, tables), "pose_file_invalid")


TEXT_FAULTS = {
    "word for a number": ("cameras.txt", "18.5", "wide", "pose_file_invalid"),
    "too few parameters": ("cameras.txt", " 7.75", "", "intrinsics_invalid"),
    "too many parameters": ("cameras.txt", "7.75", "7.75 0", "intrinsics_invalid"),
    "unknown model": ("cameras.txt", "PINHOLE", "CYLINDER", "camera_model_unsupported"),
    "negative width": ("cameras.txt", " 20 ", " -20 ", "pose_file_invalid"),
    "camera id that binary tables cannot hold": ("cameras.txt", "7 P", "4294967296 P", "pose_file_invalid"),
    "image id that binary tables cannot hold": (
        "images.txt",
        "13 1 0",
        "4294967295 1 0",
        "pose_file_invalid",
    ),
    "rig id that binary tables cannot hold": (
        "rigs.txt",
        "2 1",
        "9223372036854775807 1",
        "pose_file_invalid",
    ),
    "NaN": ("images.txt", "11 1 0 0 0 11", "11 1 0 0 0 nan", "pose_not_finite"),
    "zero quaternion": ("images.txt", "11 1 0 0 0", "11 0 0 0 0", "pose_not_rotation"),
    "no name": ("images.txt", " a.png", "", "pose_file_invalid"),
    "path that leads out": ("images.txt", " a.png", " ../a.png", "unsafe_path"),
    "line of features missing": ("images.txt", "a.png\n3 4 5 4 4 -1\n", "a.png\n", "pose_file_invalid"),
    "half a feature": ("images.txt", "3 4 5 4 4 -1", "3 4 5 4 4", "pose_file_invalid"),
    "name twice": ("images.txt", "c.png", "a.png", "duplicate_image"),
    "id twice": ("images.txt", "13 1 0", "11 1 0", "pose_file_invalid"),
    "colour out of range": ("points3D.txt", "255", "256", "pose_file_invalid"),
    "half a track": ("points3D.txt", " 13 0", " 13", "pose_file_invalid"),
    "track too large for any id": ("points3D.txt", " 13 0", f" {10**30} 0", "pose_file_invalid"),
    "dangling image": ("points3D.txt", " 13 0", " 14 0", "pose_file_invalid"),
    "huge rig": ("rigs.txt", "2 1", "2 4000000000", "pose_file_invalid"),
    "huge frame": ("frames.txt", " 1 CAMERA 7 11", " 4000000000 CAMERA 7 11", "pose_file_invalid"),
    "trailing words": ("frames.txt", "CAMERA 7 11", "CAMERA 7 11 12", "pose_file_invalid"),
    "unknown sensor": ("rigs.txt", "CAMERA", "LIDAR", "pose_file_invalid"),
}


@pytest.mark.parametrize("fault", TEXT_FAULTS)
def test_what_no_text_model_can_say_is_refused(tmp_path, fault):
    table, old, new, code = TEXT_FAULTS[fault]
    assert old in TINY_TEXT[table]
    error = refused(tmp_path, TINY_TEXT | {table: TINY_TEXT[table].replace(old, new, 1)})
    assert error.code == code, str(error)


def test_text_that_is_no_text_is_refused(tmp_path):
    assert_complete(refused(tmp_path, TINY_TEXT | {"images.txt": b"\xff\xfe\x00"}), "pose_file_invalid")


@settings(max_examples=200, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_no_change_of_bytes_makes_the_reader_fail_otherwise_than_by_an_input_error(tmp_path, data):
    tables = tiny_tables()
    for _ in range(data.draw(st.integers(1, 3))):
        table = data.draw(st.sampled_from(sorted(tables)))
        content = tables[table]
        at = data.draw(st.integers(0, len(content)))
        patch = data.draw(
            st.binary(max_size=8) | st.sampled_from([b"\xff" * 8, b"\0" * 8, b"\x01" + b"\0" * 7])
        )
        kept = at + data.draw(st.sampled_from([0, len(patch)]))
        tables[table] = content[:at] + patch + content[kept:]
    write_tables(tmp_path, tables)
    with contextlib.suppress(InputError):
        assert isinstance(read_colmap_model(tmp_path), ColmapModel)


@settings(max_examples=200, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_no_change_of_words_makes_the_text_reader_fail_otherwise_than_by_an_input_error(tmp_path, data):
    tables = dict(TINY_TEXT)
    table = data.draw(st.sampled_from(sorted(tables)))
    words = tables[table].split(" ")
    at = data.draw(st.integers(0, len(words) - 1))
    odd = st.sampled_from(
        ["", "\n", "nan", "-1", "1e400", "99999999999999999999", "1_0", "٣", "#", "x", "0x1", "\0"]
    )
    words[at] = data.draw(odd | st.text(max_size=4))
    write_tables(tmp_path, tables | {table: " ".join(words)})
    with contextlib.suppress(InputError):
        assert isinstance(read_colmap_model(tmp_path), ColmapModel)


def test_a_model_of_panoramas_is_refused_with_the_way_to_give_their_poses():
    with pytest.raises(InputError) as caught:
        model_name_of_id(17, "cameras.bin")
    assert caught.value.code == "camera_model_unsupported"
    assert "transforms.json" in caught.value.hint
    assert "image_undistorter" not in caught.value.hint
