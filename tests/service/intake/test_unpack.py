"""Unpacking without a service around it: the files, and that no limit is exceeded by a byte or a file."""

from __future__ import annotations

import io
import stat
import struct
import sys
import tarfile
import zipfile
from collections import Counter
from collections.abc import Callable
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
        unpack(request(tmp_path / "archive", ratio_max=2.0, all_room=True))
    assert refused.value.code == "archive_too_large"


def test_an_archive_for_which_the_disk_has_no_room_is_not_at_fault(tmp_path: Path):
    write_zip(tmp_path / "archive", FILES)
    with pytest.raises(InputError, match="no room") as refused:
        unpack(request(tmp_path / "archive", bytes_max=TOTAL - 1, all_room=True))
    assert refused.value.code == "storage_full"


@pytest.mark.parametrize("kind", WRITERS)
def test_names_that_lead_out_leave_nothing_outside(tmp_path: Path, kind: str):
    WRITERS[kind](tmp_path / "archive", {"../escaped.png": b"x"})
    with pytest.raises(InputError) as refused:
        unpack(request(tmp_path / "archive"))
    assert refused.value.code == "unsafe_path"
    assert not (tmp_path / "escaped.png").exists()


@pytest.mark.parametrize("kind", [stat.S_IFLNK, stat.S_IFIFO, stat.S_IFCHR, stat.S_IFBLK, stat.S_IFSOCK])
def test_an_entry_of_a_zip_that_is_no_file_is_refused(tmp_path: Path, kind: int):
    with zipfile.ZipFile(tmp_path / "archive", "w") as archive:
        info = zipfile.ZipInfo("odd")
        info.external_attr = (kind | 0o644) << 16
        archive.writestr(info, "/etc/passwd")
    with pytest.raises(InputError, match="a link or a device"):
        unpack(request(tmp_path / "archive"))


@pytest.mark.parametrize("kind", [tarfile.SYMTYPE, tarfile.LNKTYPE, tarfile.FIFOTYPE, tarfile.CHRTYPE])
def test_an_entry_of_a_tar_that_is_no_file_is_refused(tmp_path: Path, kind: bytes):
    with tarfile.open(tmp_path / "archive", "w") as archive:
        info = tarfile.TarInfo("odd")
        info.type, info.linkname = kind, "/etc/passwd"
        archive.addfile(info)
    with pytest.raises(InputError, match="a link, a device or sparse"):
        unpack(request(tmp_path / "archive"))


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


def zip_of_entries(n: int, extra: bytes = b"") -> bytes:
    """A zip with one file, which a table of contents of ``n`` entries calls by many names."""
    local = struct.pack("<IHHHHHIIIHH", 0x04034B50, 20, 0, 0, 0, 0x21, 0, 0, 0, 1, 0) + b"0"
    table = b"".join(
        struct.pack(
            "<IHHHHHHIIIHHHHHII", 0x02014B50, *(20, 20, 0, 0, 0, 0x21, 0, 0, 0), 7, len(extra), *(0,) * 5
        )
        + b"%07d" % number
        + extra
        for number in range(n)
    )
    wide = struct.pack("<IQHHIIQQQQ", 0x06064B50, 44, 45, 45, 0, 0, n, n, len(table), len(local))
    where = struct.pack("<IIQI", 0x07064B50, 0, len(local) + len(table), 1)
    end = struct.pack("<IHHHHIIH", 0x06054B50, 0, 0, 0xFFFF, 0xFFFF, 0xFFFFFFFF, 0xFFFFFFFF, 0)
    return local + table + wide + where + end


def tar_entry(kind: bytes, content: bytes = b"") -> bytes:
    entry = tarfile.TarInfo("x")
    entry.type, entry.size = kind, len(content)
    return entry.tobuf(tarfile.USTAR_FORMAT) + content + bytes(-len(content) % 512)


def said_for_all(n: int) -> bytes:
    """``n`` attributes that hold for each of the entries behind them."""
    said = tar_entry(tarfile.XGLTYPE, b"".join(b"16 k%07d=abc\n" % number for number in range(n)))
    return said + tar_entry(tarfile.DIRTYPE) * (n // 10)


def bytes_read() -> int:
    """By this process, of files."""
    return int(Path("/proc/self/io").read_text().split()[1])


UNREASONABLE: dict[str, Callable[[int], bytes]] = {
    "a zip of many entries": zip_of_entries,
    "a zip of many extra fields": lambda n: zip_of_entries(n // 1000, b"\xfe\xca\0\0" * 16_000),
    "a tar with much said for all": said_for_all,
    "a tar with a long head": lambda n: tar_entry(tarfile.XHDTYPE, b"9" * n) + tar_entry(tarfile.REGTYPE),
    "a tar with a head of heads": lambda n: tar_entry(tarfile.XHDTYPE, b"13 k=abcdefg\n") * n,
    "a tar of long names": lambda n: tar_entry(tarfile.GNUTYPE_LONGNAME, b"a" * n) * 10,
}


@pytest.mark.parametrize("case", UNREASONABLE)
def test_an_archive_that_says_too_much_of_its_entries_is_refused_before_that_is_read(
    tmp_path: Path, case: str
):
    def work(n: int) -> tuple[int, int]:
        """Calls of functions, and bytes read."""
        (tmp_path / f"{n}").mkdir()
        (tmp_path / f"{n}/archive").write_bytes(UNREASONABLE[case](n).ljust(2048, b"\0"))
        calls, before = Counter[str](), bytes_read()
        sys.setprofile(lambda _frame, event, _what: calls.update((event,)))
        try:
            with pytest.raises(InputError) as refused:
                unpack(request(tmp_path / f"{n}/archive", files_max=1000))
        finally:
            sys.setprofile(None)
        assert refused.value.code == "archive_rejected"
        return calls["call"] + calls["c_call"], bytes_read() - before

    (calls, read), (more_calls, more_read) = work(20_000), work(200_000)
    assert more_calls < 2 * calls + 1000
    assert more_read < 2 * read + 2**20
