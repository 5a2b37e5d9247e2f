"""Hostile and broken archives over HTTP. The `http` fixture checks that the service survives and nothing is left."""

from __future__ import annotations

import gzip
import io
import os
import socket
import stat
import tarfile
import time
import zipfile
from collections.abc import Callable
from pathlib import Path

import httpx
import pytest

from tests.service.conftest import MIB, Running, new_dataset, problem, scene_files, upload, zip_of


def tar_of(
    files: dict[str, bytes], mode: str = "w:gz", extra: Callable[[tarfile.TarFile], None] | None = None
) -> bytes:
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode=mode) as archive:  # type: ignore[call-overload]
        for name, content in files.items():
            info = tarfile.TarInfo(name)
            info.size = len(content)
            archive.addfile(info, io.BytesIO(content))
        if extra:
            extra(archive)
    return buffer.getvalue()


def odd_tar(kind: bytes, target: str = "/etc/passwd") -> bytes:
    def add(archive: tarfile.TarFile) -> None:
        info = tarfile.TarInfo("odd")
        info.type, info.linkname = kind, target
        archive.addfile(info)

    return tar_of({"good.png": b"x"}, extra=add)


def odd_zip(mode: int) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        info = zipfile.ZipInfo("odd")
        info.external_attr = mode << 16
        archive.writestr(info, "/etc/passwd")
    return buffer.getvalue()


def encrypted_zip() -> bytes:
    content = bytearray(zip_of({"secret.png": b"x" * 100}))
    for mark, offset in ((b"PK\x03\x04", 6), (b"PK\x01\x02", 8)):
        content[content.index(mark) + offset] |= 1
    return bytes(content)


def with_bad_crc() -> bytes:
    content = bytearray(zip_of({"a.png": b"abcdefgh" * 10}, zipfile.ZIP_STORED))
    content[content.index(b"abcdefgh")] ^= 0xFF
    return bytes(content)


def raw_name_zip(name: bytes) -> bytes:
    stand_in = b"n" * len(name)
    return zip_of({stand_in.decode(): b"x"}).replace(stand_in, name)


@pytest.mark.parametrize("below", ["", "./", "scene/", "outer/inner/"])
@pytest.mark.parametrize(
    "pack", [zip_of, tar_of, lambda files: tar_of(files, "w")], ids=["zip", "tar.gz", "tar"]
)
def test_an_archive_gives_its_files_without_the_folders_around_them(
    http: httpx.Client, scene: Path, pack: Callable[[dict[str, bytes]], bytes], below: str
) -> None:
    if below == "./" and pack is zip_of:
        pytest.skip("no zip program writes ./")
    files = scene_files(scene)
    litter = {f"__MACOSX/{below}._r_0.png": b"x", f"{below}.DS_Store": b"x"}
    dataset = new_dataset(http)
    answer = upload(
        http, dataset, pack({**{below + name: content for name, content in files.items()}, **litter})
    )
    assert answer.status_code == 200, answer.text
    assert answer.json()["files"] == len(files)
    stored = http.get(f"/v1/datasets/{dataset}/files").json()["items"]
    assert [item["path"] for item in stored] == sorted(files)
    assert [item["size"] for item in stored] == [len(files[name]) for name in sorted(files)]


REJECTED = {
    "not an archive": (b"hello" * 1000, "archive_rejected", None),
    "empty body": (b"", "archive_rejected", None),
    "empty zip": (zip_of({}), "archive_rejected", None),
    "only litter": (zip_of({"__MACOSX/._a": b"x"}), "archive_rejected", None),
    "zip cut short": (zip_of({"a.png": os.urandom(5000)})[:-40], "archive_rejected", None),
    "zip with a wrong checksum": (with_bad_crc(), "archive_rejected", "a.png"),
    "tar.gz cut short": (tar_of({"a.png": os.urandom(5000)})[:-1000], "archive_rejected", None),
    "tar cut short in a file": (tar_of({"a.png": os.urandom(5000)}, "w")[:3000], "archive_rejected", None),
    "tar cut short after a file": (
        tar_of({"a.png": bytes(range(256)) * 2}, "w")[:1024],
        "archive_rejected",
        None,
    ),
    "gzip of something else": (gzip.compress(b"hello" * 1000), "archive_rejected", None),
    "encrypted": (encrypted_zip(), "archive_rejected", "secret.png"),
    "zip method unknown here": (zip_of({"a": b"x" * 99}, zipfile.ZIP_LZMA), "archive_rejected", "a"),
    "zip symbolic link": (odd_zip(stat.S_IFLNK | 0o777), "archive_rejected", "odd"),
    "zip device": (odd_zip(stat.S_IFCHR | 0o666), "archive_rejected", "odd"),
    "tar symbolic link": (odd_tar(tarfile.SYMTYPE), "archive_rejected", "odd"),
    "tar hard link": (odd_tar(tarfile.LNKTYPE), "archive_rejected", "odd"),
    "tar device": (odd_tar(tarfile.CHRTYPE), "archive_rejected", "odd"),
    "tar fifo": (odd_tar(tarfile.FIFOTYPE), "archive_rejected", "odd"),
    "zip ..": (zip_of({"../evil.png": b"x"}), "unsafe_path", "../evil.png"),
    "zip .. inside": (zip_of({"a/../../evil.png": b"x"}), "unsafe_path", "a/../../evil.png"),
    "tar ..": (tar_of({"../evil.png": b"x"}), "unsafe_path", "../evil.png"),
    "zip absolute": (zip_of({"/tmp/evil.png": b"x"}), "unsafe_path", "/tmp/evil.png"),
    "tar absolute": (tar_of({"/tmp/evil.png": b"x"}), "unsafe_path", "/tmp/evil.png"),
    "drive letter": (zip_of({"C:evil.png": b"x"}), "unsafe_path", "C:evil.png"),
    "backslash": (zip_of({"..\\evil.png": b"x"}), "unsafe_path", "..\\\\evil.png"),
    "NUL": (raw_name_zip(b"a.png\0b.exe"), "unsafe_path", "a.png\\x00b.exe"),
    "control character": (zip_of({"a\x1b[2J.png": b"x"}), "unsafe_path", "a\\x1b[2J.png"),
    "newline": (tar_of({"a\nb.png": b"x"}), "unsafe_path", "a\\nb.png"),
    "long part": (tar_of({"a" * 256: b"x"}), "unsafe_path", "a" * 256),
    "long part in bytes": (zip_of({"ä" * 128: b"x"}), "unsafe_path", None),
    "deep": (tar_of({"a/" * 20 + "b": b"x"}), "unsafe_path", "a/" * 20 + "b"),
    "not text": (tar_of({"a\udcff.png": b"x"}), "unsafe_path", None),
    "same name twice": (
        tar_of({"a.png": b"x"}, "w")[:1024] + tar_of({"a.png": b"y"}, "w"),
        "name_collision",
        "a.png",
    ),
    "names equal but for case": (zip_of({"a.png": b"x", "A.png": b"y"}), "name_collision", "A.png"),
    "folders equal but for case": (zip_of({"a/1": b"x", "A/2": b"y"}), "name_collision", "A/2"),
    "names equal in NFC": (
        zip_of({"\u00e9.png": b"x", "e\u0301.png": b"y"}),
        "name_collision",
        "e\\u0301.png",
    ),
    "file and folder": (zip_of({"a": b"x", "a/b": b"y"}), "name_collision", "a/b"),
}


@pytest.mark.parametrize("case", REJECTED)
def test_a_bad_archive_is_422_and_stores_nothing(http: httpx.Client, service: Running, case: str) -> None:
    content, code, where = REJECTED[case]
    dataset = new_dataset(http)
    body = problem(upload(http, dataset, content), 422, code)
    assert where is None or body["where"] == where
    assert body["hint"]
    found = http.get(f"/v1/datasets/{dataset}").json()
    assert (found["files"], found["bytes"], found["state"]) == (0, 0, "open")
    stored = service.data_dir / "files" / "datasets" / dataset
    assert not stored.exists() or not any(path.is_file() for path in stored.rglob("*"))
    assert not Path("/tmp/evil.png").exists()


def test_after_a_bad_archive_the_dataset_takes_a_good_one(http: httpx.Client) -> None:
    dataset = new_dataset(http)
    problem(upload(http, dataset, zip_of({"good.png": b"x", "../bad.png": b"x"})), 422, "unsafe_path")
    assert upload(http, dataset, zip_of({"good.png": b"x"})).json()["files"] == 1


# Made when a test wants one: some are large.
TOO_LARGE: dict[str, tuple[Callable[[], bytes], str]] = {
    "archive": (lambda: os.urandom(7 * MIB), "body_too_large"),
    "file": (lambda: zip_of({"a.png": bytes(3 * MIB)}), "archive_too_large"),
    "files": (lambda: zip_of({f"{i}.png": bytes(2 * MIB) for i in range(21)}), "archive_too_large"),
    "ratio": (lambda: zip_of({f"{i}.png": bytes(2 * MIB) for i in range(9)}), "archive_too_large"),
    "ratio of tar": (lambda: tar_of({f"{i}.png": bytes(2 * MIB) for i in range(9)}), "archive_too_large"),
    "gzip bomb": (lambda: gzip.compress(bytes(200 * MIB)), "archive_too_large"),
    "number of files": (lambda: zip_of({f"{i}.png": b"" for i in range(121)}), "too_many_files"),
    "number of folders": (lambda: zip_of({f"{i}/": b"" for i in range(500)}), "too_many_files"),
}


@pytest.mark.parametrize("case", TOO_LARGE)
def test_a_too_large_archive_is_refused_and_stores_nothing(http: httpx.Client, case: str) -> None:
    make, code = TOO_LARGE[case]
    dataset = new_dataset(http)
    body = problem(upload(http, dataset, make()), 413, code)
    if case.startswith("ratio"):
        assert "200 times" in body["detail"]
    assert http.get(f"/v1/datasets/{dataset}").json()["files"] == 0


def test_an_archive_without_a_length_is_refused_at_the_limit(http: httpx.Client) -> None:
    dataset = new_dataset(http)
    pieces = (os.urandom(MIB // 4) for _ in range(40))
    problem(http.post(f"/v1/datasets/{dataset}/archive", content=pieces), 413, "body_too_large")
    assert http.get(f"/v1/datasets/{dataset}").json()["files"] == 0


def test_an_upload_that_breaks_off_leaves_nothing(service: Running, http: httpx.Client) -> None:
    dataset = new_dataset(http)
    host, port = service.url.removeprefix("http://").split(":")
    with socket.create_connection((host, int(port))) as line:
        head = f"POST /v1/datasets/{dataset}/archive HTTP/1.1\r\nHost: x\r\nContent-Length: 5000\r\n\r\n"
        line.sendall(head.encode() + b"PK\x03\x04")
    end = time.monotonic() + 10
    while not service.staging_is_empty():
        assert time.monotonic() < end
        time.sleep(0.05)
    assert http.get(f"/v1/datasets/{dataset}").json()["files"] == 0
