"""Child program that unpacks one uploaded archive (zip, tar, tar.gz) into an empty folder.

Sizes and counts in the archive's headers are not trusted: bytes and files are counted as they are unpacked.
"""

from __future__ import annotations

import errno
import gzip
import io
import os
import stat
import struct
import sys
import tarfile
import zipfile
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Any

from pydantic import Field

from biresnerf.errors import InputError
from biresnerf.frozen_model import FrozenModel
from biresnerf.wire.safe_paths import NameSet, checked_path, is_litter
from service.intake.sandboxed_child import run_child

_CHUNK = 2**20
# Text compresses far better than photos, so the ratio is not checked below this size.
RATIO_FREE_BYTES = 16 * 2**20
_METHODS = {zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED}
_ENCRYPTED = 0x1 | 0x40
_TAR_BLOCK = 512
# Most bytes of an entry in a zip's table of contents: its fixed part, a path of 900 bytes, and some extra fields.
_ENTRY_BYTES = 1200
# Most bytes of a tar's extended headers: before an entry (a long path, attributes), and global ones in sum. tarfile
# parses the former in quadratic time before Python 3.11.10 and 3.12.6, and copies the latter for each entry.
_HEAD_BYTES = 2**14
_HEADS = {
    *(tarfile.GNUTYPE_LONGNAME, tarfile.GNUTYPE_LONGLINK, tarfile.SOLARIS_XHDTYPE),
    tarfile.XHDTYPE,
    tarfile.XGLTYPE,
}
_PACK_HINT = "Pack plain files and folders only, as zip, tar or tar.gz."


class UnpackRequest(FrozenModel):
    """An archive, the target folder, and the limits."""

    archive: Path
    into: Path = Field(description="An empty folder of this process.")
    all_room: bool = Field(False, description="Whether `bytes_max` is what the disk has room for.")
    files_max: int
    bytes_max: int = Field(description="Bytes of all files together.")
    file_bytes_max: int = Field(description="Bytes of one file.")
    ratio_max: float = Field(description="Unpacked bytes to archive bytes, above the first 16 MiB.")


def unpack(request: UnpackRequest) -> dict[str, Any]:
    """Unpacks; returns ``{"files": count, "bytes": sum}``.

    Raises:
        InputError: ``archive_rejected``, ``unsafe_path``, ``name_collision``, ``too_many_files``,
            ``archive_too_large``; ``where`` names the entry.
    """
    sink = _Sink(request)
    try:
        with request.archive.open("rb") as file:
            head = file.read(265)
            file.seek(0)
            if head[:4] in {b"PK\x03\x04", b"PK\x05\x06"}:
                _unpack_zip(sink)
            elif head[:2] == b"\x1f\x8b":
                with gzip.GzipFile(fileobj=file) as plain:
                    _unpack_tar(plain, sink)
            elif head[257:262] == b"ustar":
                _unpack_tar(file, sink)
            else:
                raise sink.rejected("This is not a zip, tar or tar.gz archive.", hint=_PACK_HINT)
    except (zipfile.BadZipFile, tarfile.TarError, EOFError, zlib.error, gzip.BadGzipFile) as error:
        raise sink.rejected(f"The archive is broken: {error}.") from None
    except (
        NotImplementedError,
        ValueError,
        OverflowError,
        IndexError,
        RecursionError,
        struct.error,
    ) as error:
        raise sink.rejected(f"The archive is damaged or of an unknown kind: {error}.") from None
    except OSError as error:
        if error.errno != errno.EINVAL:  # the archive names an offset before the file's start
            raise
        raise sink.rejected("The archive is damaged: it names places outside of itself.") from None
    except MemoryError:
        raise sink.rejected("The archive's table of contents is unreasonably large.") from None
    if sink.files == 0:
        sink.current = ""  # the archive as a whole is at fault
        raise sink.rejected("The archive holds no files.", hint="Pack the images and transforms.json.")
    return {"files": sink.files, "bytes": sink.bytes}


class _Sink:
    """Writes entries into the folder, within the limits."""

    def __init__(self, request: UnpackRequest) -> None:
        self.request = request
        self.files = self.bytes = 0
        self.current = ""
        self._names = NameSet()
        self._entries = 0
        ratio_bytes = int(request.archive.stat().st_size * request.ratio_max)
        self.budget = min(request.bytes_max, max(ratio_bytes, RATIO_FREE_BYTES))
        self._by_ratio = self.budget < request.bytes_max
        # Folders count too: they also use inodes.
        self.entries_max = 2 * request.files_max + 64

    def entry(self, name: str) -> str | None:
        """The safe path of the next entry; None for files that an operating system added."""
        self.current = name.encode("unicode_escape").decode()[:300]
        self._entries += 1
        if self._entries > self.entries_max:
            raise self._too_many()
        if not name:
            raise self.rejected("The archive is damaged: an entry has no name.")
        path = checked_path(name)
        return None if is_litter(path) else path

    def write(self, path: str, content: IO[bytes]) -> None:
        self._names.add(path)
        self.files += 1
        if self.files > self.request.files_max:
            raise self._too_many()
        target = self.request.into / path
        target.parent.mkdir(parents=True, exist_ok=True)
        flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW
        written = 0
        with os.fdopen(os.open(target, flags, 0o600), "wb") as out:
            while chunk := content.read(_CHUNK):
                written += len(chunk)
                self._count(len(chunk), written)
                out.write(chunk)

    def _count(self, more: int, in_file: int) -> None:
        self.bytes += more
        if in_file > self.request.file_bytes_max:
            raise InputError(
                "archive_too_large",
                f"The file unpacks to more than {self.request.file_bytes_max} bytes.",
                where=self.current,
                hint="Send smaller files.",
            )
        if self.bytes > self.budget:
            raise self.over_budget()

    def over_budget(self) -> InputError:
        """The error for an archive that unpacks to more than is allowed."""
        if self.request.all_room and not self._by_ratio:
            return InputError("storage_full", "There is no room to unpack the archive.", where="")
        what = f"The archive unpacks to more than {self.budget} bytes."
        if self._by_ratio:
            what = f"The archive unpacks to more than {self.request.ratio_max:g} times its size."
        return InputError("archive_too_large", what, where=self.current, hint="Send fewer or smaller images.")

    def rejected(self, what: str, hint: str = "Create the archive again and resend it.") -> InputError:
        """The error for the archive or its current entry."""
        return InputError("archive_rejected", what, where=self.current, hint=hint)

    def _too_many(self) -> InputError:
        return InputError(
            "too_many_files",
            f"The archive holds more than {self.request.files_max} files.",
            where=self.current,
            hint="Send fewer images; leave out what is neither an image nor a pose file.",
        )


class _ZipBytes(io.BufferedReader):
    """A zip's bytes, limited per read: zipfile reads the table of contents as a whole."""

    most = sys.maxsize

    def read(self, size: int | None = -1, /) -> bytes:
        if size is not None and size > self.most:
            raise MemoryError
        return super().read(size)


def _unpack_zip(sink: _Sink) -> None:
    with _ZipBytes(io.FileIO(sink.request.archive)) as content:
        content.most = sink.entries_max * _ENTRY_BYTES
        archive = zipfile.ZipFile(content)
        content.most = sys.maxsize
        for info in archive.infolist():
            # zipfile truncates names at NUL and replaces separators; check the original name.
            path = sink.entry(info.orig_filename.removesuffix("/") if info.is_dir() else info.orig_filename)
            mode = info.external_attr >> 16
            if info.flag_bits & _ENCRYPTED:
                raise sink.rejected("The entry is encrypted.", hint="Pack without a password.")
            if stat.S_IFMT(mode) not in {0, stat.S_IFREG, stat.S_IFDIR}:
                raise sink.rejected("The entry is a link or a device.", hint=_PACK_HINT)
            if info.is_dir() or path is None:
                continue
            if info.compress_type not in _METHODS:
                raise sink.rejected(
                    f"The entry is packed by method {info.compress_type}.",
                    hint="Use deflate.",
                )
            with archive.open(info) as plain:
                sink.write(path, plain)


def _unpack_tar(plain: IO[bytes] | gzip.GzipFile, sink: _Sink) -> None:
    counted = _CountedReader(plain, sink)
    options: Any = {"mode": "r|", "bufsize": _TAR_BLOCK * 128, "tarinfo": _member_of(sink)}
    with tarfile.open(fileobj=counted, **options) as archive:  # type: ignore[call-overload]
        for member in _members(archive):
            path = sink.entry(member.name)
            if member.isdir():
                continue
            if not member.isreg() or member.issparse():
                raise sink.rejected("The entry is a link, a device or sparse.", hint=_PACK_HINT)
            if member.size < 0:
                raise sink.rejected("The entry has a negative size.")
            content = archive.extractfile(member)
            if content is None:
                raise sink.rejected("The entry has no content.")
            if path is not None:
                sink.write(path, content)
    # tarfile accepts a truncated archive; a complete one ends with blocks of zeros.
    while counted.read(_CHUNK):
        pass
    if counted.tail.strip(b"\0") or len(counted.tail) < _TAR_BLOCK:
        raise sink.rejected("The archive is cut short: its end mark is missing.")


def _member_of(sink: _Sink) -> type[tarfile.TarInfo]:
    """The type of this archive's entries; it refuses extended headers that are too long before it reads them."""
    heads, for_all = sink.entries_max * _ENTRY_BYTES, _HEAD_BYTES

    class Member(tarfile.TarInfo):
        def _proc_member(self, archive: tarfile.TarFile) -> tarfile.TarInfo:
            nonlocal heads, for_all
            if self.type in _HEADS:
                heads -= self.size
                for_all -= self.size if self.type == tarfile.XGLTYPE else 0
                if self.size > _HEAD_BYTES or min(heads, for_all) < 0:
                    raise sink.rejected(
                        "What the archive says of its entries is unreasonably long.", _PACK_HINT
                    )
            return super()._proc_member(archive)  # type: ignore[misc]

    return Member


def _members(archive: tarfile.TarFile) -> Iterator[tarfile.TarInfo]:
    while (member := archive.next()) is not None:
        # tarfile would keep all members of a stream, so memory would grow with the archive.
        archive.members = []  # type: ignore[attr-defined]
        # `tar czf x.tgz .` begins with an entry for `.` itself.
        if member.isdir() and member.name in {".", "./"}:
            continue
        yield member


class _CountedReader:
    """The decompressed bytes of a tar, headers and padding included, up to a limit."""

    def __init__(self, plain: IO[bytes] | gzip.GzipFile, sink: _Sink) -> None:
        self._plain, self._sink = plain, sink
        self._left = sink.budget + 4096 * (sink.request.files_max + 64)
        self.tail = b""

    def read(self, size: int) -> bytes:
        data = self._plain.read(size)
        self._left -= len(data)
        if self._left < 0:
            raise self._sink.over_budget()
        self.tail = (self.tail + data)[-_TAR_BLOCK:]
        return data


if __name__ == "__main__":
    run_child(lambda request: unpack(UnpackRequest.model_validate(request)))
