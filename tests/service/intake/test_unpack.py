"""Unpacking without a service around it: what comes out, and that no limit is passed by a byte or a file."""

from __future__ import annotations

import io
import tarfile
import zipfile
from pathlib import Path

import pytest

from biresnerf.errors import InputError
from service.intake.unpack import RATIO_FREE_BYTES, UnpackRequest, unpack

FILES = {"transforms.json": b"{}", "images/a.png": b"a" * 100, "images/b.png": b"b" * 50}
TOTAL = sum(map(len, FILES.values()))


def write_zip(path: Path, files: dict[str, bytes]) -> None:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in files.items():
            archive.writestr(name, content)


def write_tar(path: Path, files: dict[str, bytes], mode: str = "w:gz") -> None:
    with tarfile.open(path, mode) as archive:  # type: ignore[call-overload]
        for name, content in files.items():
            info = tarfile.TarInfo(name)
            info.size = len(content)
            archive.addfile(info, io.BytesIO(content))


WRITERS = {
    "zip": write_zip,
    "tar.gz": write_tar,
    "tar": lambda path, files: write_tar(path, files, "w"),
}


def request(archive: Path, **limits: float) -> UnpackRequest:
    into = archive.parent / "into"
    into.mkdir()
    most = {"files_max": 10, "bytes_max": 10**9, "file_bytes_max": 10**9, "ratio_max": 100.0}
    return UnpackRequest(archive=archive, into=into, **(most | limits))


def unpacked(folder: Path) -> dict[str, bytes]:
    return {p.relative_to(folder).as_posix(): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


@pytest.mark.parametrize("kind", WRITERS)
def test_every_kind_gives_the_same_files_and_counts(tmp_path: Path, kind: str):
    WRITERS[kind](tmp_path / "archive", FILES)
    asked = request(tmp_path / "archive")
    assert unpack(asked) == {"files": 3, "bytes": TOTAL}
    assert unpacked(asked.into) == FILES


@pytest.mark.parametrize("kind", WRITERS)
@pytest.mark.parametrize(
    ("limit", "enough", "code"),
    [
        ("files_max", 3, "too_many_files"),
        ("bytes_max", TOTAL, "archive_too_large"),
        ("file_bytes_max", 100, "archive_too_large"),
    ],
)
def test_a_limit_admits_what_equals_it_and_refuses_one_more(
    tmp_path: Path, kind: str, limit: str, enough: int, code: str
):
    WRITERS[kind](tmp_path / "archive", FILES)
    asked = request(tmp_path / "archive", **{limit: enough})
    assert unpack(asked)["files"] == 3
    with pytest.raises(InputError) as refused:
        unpack(asked.model_copy(update={limit: enough - 1, "into": tmp_path / "second"}))
    assert refused.value.code == code


def test_an_archive_that_unpacks_to_many_times_its_size_is_refused(tmp_path: Path):
    write_zip(tmp_path / "archive", {"zeros.png": bytes(RATIO_FREE_BYTES + 2**20)})
    with pytest.raises(InputError, match="more than 2 times its size") as refused:
        unpack(request(tmp_path / "archive", ratio_max=2.0))
    assert refused.value.code == "archive_too_large"


@pytest.mark.parametrize("kind", WRITERS)
def test_names_that_lead_out_leave_nothing_outside(tmp_path: Path, kind: str):
    WRITERS[kind](tmp_path / "archive", {"../escaped.png": b"x"})
    with pytest.raises(InputError) as refused:
        unpack(request(tmp_path / "archive"))
    assert refused.value.code == "unsafe_path"
    assert not (tmp_path / "escaped.png").exists()


def test_a_cut_tar_is_refused_though_its_files_are_whole(tmp_path: Path):
    write_tar(tmp_path / "whole", FILES, "w")
    content = (tmp_path / "whole").read_bytes().rstrip(b"\0")
    (tmp_path / "archive").write_bytes(content.ljust(-(-len(content) // 512) * 512, b"\0"))
    with pytest.raises(InputError) as refused:
        unpack(request(tmp_path / "archive"))
    assert refused.value.code == "archive_rejected"


def test_files_that_operating_systems_add_are_left_out(tmp_path: Path):
    write_zip(tmp_path / "archive", {**FILES, "__MACOSX/._a.png": b"x", "images/.DS_Store": b"x"})
    asked = request(tmp_path / "archive")
    unpack(asked)
    assert unpacked(asked.into) == FILES


def damaged(folder: Path, find: bytes, at: int, change: bytes) -> Path:
    """A zip with one entry, of whose part that begins with ``find`` some bytes are changed."""
    path = folder / "archive"
    write_zip(path, {"a": b"a"})
    content = bytearray(path.read_bytes())
    start = content.index(find) + at
    content[start : start + len(change)] = change
    path.write_bytes(bytes(content))
    return path


# The name's length in the central directory, and the directory's place at the end of the archive.
@pytest.mark.parametrize(
    ("find", "at", "change"),
    [(b"PK\x01\x02", 28, b"\0\0\1\0"), (b"PK\x05\x06", 16, b"\xff\xff\xff\x7f")],
    ids=["an entry without a name", "a directory beyond the file"],
)
def test_a_damaged_table_of_contents_is_the_archives_fault(
    tmp_path: Path, find: bytes, at: int, change: bytes
):
    with pytest.raises(InputError) as caught:
        unpack(request(damaged(tmp_path, find, at, change)))
    assert caught.value.code == "archive_rejected"
